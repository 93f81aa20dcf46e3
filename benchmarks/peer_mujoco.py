"""One motion of one soft body by MuJoCo's flexes: a task as JSON comes in, the outcome as JSON goes out.

Started by `peers.py`, in an interpreter that can import ``mujoco``; what a task holds is told in `peer_cases`. Elements
are linear tetrahedra of Saint Venant and Kirchhoff's law (its reference, flex/elasticity). Of the integrators
``discrete`` alone takes that elasticity implicitly. Of its solvers the task names the faster one: Newton's, or CG,
which the manual recommends for large soft 3D meshes and which took a fifteenth of the time on the sphere and block.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import mujoco
import numpy as np

TOLERANCE, ITERATIONS = 1e-5, 2000  # with the 100 iterations of its default, MuJoCo warns of inaccurate solves here
SKIN = 1e-6  # [m] radius about the elements: a flex must have one
SERIOUS = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC", "mjWARN_CONTACTFULL", "mjWARN_CNSTRFULL")
#: contacts as hard as they go, since softness here is in proportion to the masses of single vertices: the largest
#: impedance, and a time constant far below the step, which ``discrete`` takes where ``refsafe`` is disabled
STIFF = 'solimp="0.99 0.9999 0.0001" solref="0.0001 1"'


def text(values: Any) -> str:
    """Return numbers as MJCF has them."""
    return " ".join(f"{value:.9g}" for value in np.ravel(values))


def rigid_xml(rigid: dict[str, Any] | None, friction: float) -> str:
    """Return the rigid body of a task: free along all axes, or carried along by a mocap body."""
    if rigid is None:
        return ""
    held = "path" in rigid
    mocap = ' mocap="true"' if held else ""
    size = text([rigid["radius"]] if rigid["shape"] == "sphere" else [rigid["radius"], rigid["half_length"]])
    mass = "" if held else f'mass="{rigid["mass"]:.9g}"'
    joint = "" if held else "<freejoint/>"
    return (
        f'<body name="rigid" pos="{text(rigid["position"])}"{mocap}>{joint}'
        f'<geom type="{rigid["shape"]}" size="{size}" {mass} condim="{3 if friction else 1}" '
        f'friction="{friction:g}" {STIFF}/></body>'
    )


def model_of(task: dict[str, Any]) -> mujoco.MjModel:
    """Return the compiled model; the vertices weigh what linear tetrahedra give them, not all the same."""
    friction, touches = task["friction"], int(task["rigid"] is not None)
    vertices, tetrahedra = np.array(task["vertices"]), np.array(task["tetrahedra"])
    masses = task["density"] * lumped_volumes(vertices, tetrahedra)
    model = mujoco.MjModel.from_xml_string(f"""
    <mujoco>
      <option timestep="{task["time_step"]:.9g}" integrator="discrete" solver="{task["mujoco_solver"]}"
              jacobian="sparse" gravity="{text(task["gravity"])}" cone="elliptic"
              iterations="{ITERATIONS}" tolerance="{TOLERANCE}"><flag refsafe="disable"/></option>
      <size memory="2G"/>
      <worldbody>
        <flexcomp name="soft" type="direct" dim="3" dof="full" mass="{masses.sum():.9g}" radius="{SKIN}"
                  point="{text(vertices)}" element="{" ".join(map(str, tetrahedra.ravel()))}">
          <elasticity young="{task["youngs_modulus"]:.9g}" poisson="{task["poisson_ratio"]:.9g}"
                      damping="{task["damping_s"]:.9g}"/>
          <contact selfcollide="none" contype="{touches}" conaffinity="{touches}" condim="{3 if friction else 1}"
                   friction="{friction:g} 0 0" {STIFF}/>
          <pin id="{" ".join(map(str, task["clamped"]))}"/>
        </flexcomp>
        {rigid_xml(task["rigid"], friction)}
      </worldbody>
    </mujoco>""")
    bodies = model.flex_vertbodyid
    free = np.flatnonzero(model.body_dofnum[bodies] == 3)
    model.body_mass[bodies[free]] = masses[free]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def lumped_volumes(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return a quarter of the volume of the tetrahedra about each vertex [m^3]."""
    a, b, c, d = np.moveaxis(vertices[tetrahedra], 1, 0)
    volumes = np.abs(np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a))) / 6.0
    return np.bincount(tetrahedra.ravel(), np.repeat(volumes / 4.0, 4), len(vertices))


def contact_force(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> np.ndarray:
    """Return the force of the soft body on the rigid one [N]."""
    total, wrench = np.zeros(3), np.zeros(6)
    for i, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, i, wrench)
        sign = 1.0 if contact.geom[1] >= 0 and model.geom_bodyid[contact.geom[1]] == body else -1.0
        total += sign * np.asarray(contact.frame).reshape(3, 3).T @ wrench[:3]
    return total


def eased(share: float) -> float:
    """Return the minimum-jerk course that all programs follow."""
    s = min(max(share, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Step through the motion."""
    begun = time.process_time()
    model = model_of(task)
    data, rigid = mujoco.MjData(model), task["rigid"]
    body = model.body("rigid").id if rigid else -1
    start = np.array(rigid["position"]) if rigid else np.zeros(3)
    mujoco.mj_forward(model, data)
    rest = data.flexvert_xpos.copy()
    set_up = time.process_time() - begun
    steps, limit = round(task["duration"] / task["time_step"]), time.process_time() + task["limit_s"]
    before = rest
    for i in range(steps):
        if rigid and "path" in rigid:
            share = eased((i + 1) * task["time_step"] / rigid["path"]["duration"])
            data.mocap_pos[0] = start + share * np.array(rigid["path"]["vector"])
        before = data.flexvert_xpos.copy() if i == steps - 1 else before
        mujoco.mj_step(model, data)
        if serious := [name for name in SERIOUS if data.warning.number[mujoco.mjtWarning.__members__[name]]]:
            return {"failed": f"warns of {', '.join(serious)} at {(i + 1) * task['time_step']:.4f} s", "steps": i + 1}
        if time.process_time() > limit:
            return {"failed": f"not done after {task['limit_s']:g} s ({i + 1} of {steps} steps)", "steps": i + 1}
    seconds = time.process_time() - begun - set_up
    force = contact_force(model, data, body) if rigid else np.zeros(3)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_flex(model, data)
    watched, loose = task["watched"], int(data.warning.number[mujoco.mjtWarning.mjWARN_INERTIA])
    return {
        "note": f"warns of {loose} solves that were not accurate" if loose else "",
        "failed": "", "seconds": seconds, "set_up_s": set_up, "steps": steps,
        "displacement": (data.flexvert_xpos - rest)[watched].mean(axis=0).tolist(),
        "last_move": float(np.abs(data.flexvert_xpos - before).max()),
        "force": force.tolist(),
        "rigid_displacement": (data.xpos[body] - start).tolist() if rigid else [0.0] * 3,
    }


def main() -> None:
    """Read a task, print the outcome."""
    task = {"mujoco_solver": "CG", **json.load(sys.stdin)}
    about = {
        "program": f"MuJoCo {mujoco.__version__}", "element": "tet4", "law": "St. Venant-Kirchhoff",
        "solver": f"discrete, {task['mujoco_solver']}",
    }
    json.dump({**about, **run(task)}, sys.stdout)


if __name__ == "__main__":
    main()
