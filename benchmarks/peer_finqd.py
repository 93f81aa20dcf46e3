"""One motion of one soft body by finqd itself: a task as JSON comes in, the outcome as JSON goes out.

Started by `peers.py` as its peers are, so that all of them pay for the same. ``repeats``: how often the motion is run
in this process; the first run may compile kernels, the last one is warm, and is what is reported.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np

from finqd import __version__
from finqd.mechanics.material import Material
from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.mesh import Mesh
from finqd.objects import GraspObject, load_object
from finqd.scene import Motion, Scene, Shift
from finqd.simulate import simulate
from finqd.units import MM
from finqd.verification.press import cylinder

#: as peers have it: soft bodies do not look for contact with themselves
CONTACT = {"name": "penalty", "soft_contact": False}


def rigid_shape(rigid: dict[str, Any]) -> GraspObject:
    """Return the rigid body of a task."""
    if rigid["shape"] == "cylinder":
        return cylinder(rigid["radius"], rigid["half_length"])
    shape = {"kind": "sphere", "diameter_mm": 2.0 * rigid["radius"] / MM}
    return load_object({"name": "sphere", "shape": shape, "mass_g": 1e3 * rigid.get("mass", 1.0)})


def scene_of(task: dict[str, Any]) -> Scene:
    """Return the scene; where a rigid body is carried along, it stands still and the clamped end comes to meet it."""
    scene, rigid = Scene(gravity=task["gravity"], friction=task["friction"]), task["rigid"]
    blocks = {name: np.array(nodes) for name, nodes in task["blocks"].items()}
    material = Material(
        youngs_modulus=task["youngs_modulus"], poisson_ratio=task["poisson_ratio"], density=task["density"],
        rayleigh_stiffness=task["damping_s"],
    )
    body = scene.add_soft(Mesh(np.array(task["vertices"]), blocks), material)
    clamped = np.array(task["clamped"])
    if rigid and "path" in rigid:
        way = -np.array(rigid["path"]["vector"])
        body.drive(clamped, Motion(path=Shift(vector=way), duration=rigid["path"]["duration"]))
    else:
        body.fix(clamped)
    if rigid:
        scene.add_rigid(rigid_shape(rigid), position=rigid["position"], held="path" in rigid)
    return scene


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Go through the motion once."""
    begun = time.process_time()
    scene, forces = scene_of(task), [np.zeros(3)]

    def watch(system: System, state: State) -> None:
        if scene.rigid_bodies:
            forces[0] = system.contact_forces_on_rigid(state)[0, :3]

    set_up = time.process_time() - begun
    found = simulate(
        scene, duration=task["duration"], time_step=task["time_step"], stepper=task["stepper"], contact=CONTACT,
        record=True, watch=watch, wall_clock_limit=task["limit_s"],
    )
    seconds = time.process_time() - begun - set_up
    if found.status != "ok":
        return {"failed": f"{found.status}: {found.reason}", "steps": found.counters.get("steps", 0)}
    path, moved = found.soft_positions, np.zeros(3)
    if scene.rigid_bodies:
        moved = found.rigid_positions[-1, 0] - found.rigid_positions[0, 0]
    return {
        "failed": "", "seconds": seconds, "set_up_s": set_up, "steps": found.counters["steps"],
        "displacement": (path[-1] - path[0])[task["watched"]].mean(axis=0).tolist(),
        "last_move": float(np.abs(path[-1] - path[-2]).max()), "force": forces[0].tolist(),
        "rigid_displacement": moved.tolist(),
    }


def main() -> None:
    """Read a task, print the outcome."""
    task = json.load(sys.stdin)
    outcomes = [run(task) for _ in range(task["repeats"])]
    about = {
        "program": f"finqd {__version__}", "element": "+".join(task["blocks"]), "law": "corotated",
        "solver": task["stepper"]["name"],
    }
    first = outcomes[0].get("seconds", 0.0) + outcomes[0].get("set_up_s", 0.0)
    json.dump({**about, **outcomes[-1], "first_s": first}, sys.stdout)


if __name__ == "__main__":
    main()
