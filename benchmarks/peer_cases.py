"""The motions that `peers.py` gives to finqd and to its peers, each with a converged reference.

A task is what every program gets, as JSON in SI units: ``vertices``, ``blocks`` (elements by type) and, where these are
linear tetrahedra, ``tetrahedra``; ``clamped`` vertices, which are all those on the inner side of ``clamp_point`` and
``clamp_normal``; material, gravity, friction; ``watched`` vertices; ``rigid``: nothing, or a sphere or cylinder that is
free (``mass``) or follows a ``path`` (vector, duration), eased; ``duration``, ``time_step`` and a limit of computing;
``mujoco_solver``: which of its solvers is the faster one there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from finqd.data import designs_folder
from finqd.design import Design
from finqd.mechanics.material import Material
from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.mesh import Mesh
from finqd.mesh_shapes import box_mesh
from finqd.meshing import mesh_solid
from finqd.presets import apply_preset
from finqd.scene import Motion, Scene, Shift, eased
from finqd.simulate import simulate
from finqd.units import MM
from finqd.verification.cases import Failed, checked
from finqd.verification.meshes import mapped_box
from finqd.verification.press import BACK, OVERHANG, REFERENCE, touching_centre
from finqd.verification.statics import SILICONE, SILICONE_GRAVITY, at_rest

Task = dict[str, Any]
Outcome = dict[str, Any]
GRAVITY = (0.0, 0.0, -SILICONE_GRAVITY)
DAMPING = 0.03  # [s] of the stiffness: 0.7 of critical in the bar's first mode, which is at rest after half a second
IMPLICIT = {"name": "implicit_euler"}
STATIC = {"name": "quasi_static", "tolerance_N": 1e-4}
RADIUS, MASS = 20 * MM, 0.5  # of the sphere
BLOCK = (60 * MM, 60 * MM, 30 * MM)
PRESSED, PRESS_S, REST_S = 10 * MM, 0.5, 0.1


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Who is to run a case, on which mesh: ``program`` finqd, mujoco or drake; ``stepper`` of finqd."""

    program: str
    mesh: str
    stepper: Any = None


@dataclass(frozen=True, kw_only=True)
class PeerCase:
    """One motion. quantity, unit: what is compared, ``value`` reads it from an outcome; ``reference`` computes it.

    ``effects``: what was on; ``task``: of a mesh; ``check``: a second number with its right value, or nothing
    """

    title: str
    quantity: str
    unit: str
    effects: str
    variants: tuple[Variant, ...]
    task: Callable[[str], Task]
    value: Callable[[Outcome], float]
    reference: Callable[[], tuple[float, str]]
    check: Callable[[Outcome], str] = lambda outcome: ""


def shaped(mesh: Mesh, material: Material, *, clamped: np.ndarray, axis: int, damping: float) -> Task:
    """Return what tasks have in common: a body clamped at its lower end along ``axis``."""
    normal, point = np.zeros(3), np.zeros(3)
    normal[axis] = 1.0
    point[axis] = mesh.vertices[clamped, axis].max() + 1e-9
    if not np.array_equal(np.flatnonzero(mesh.vertices[:, axis] < point[axis]), np.sort(clamped)):
        raise Failed("what is clamped is no half space")
    task: Task = {
        "vertices": mesh.vertices.tolist(), "blocks": {name: nodes.tolist() for name, nodes in mesh.blocks.items()},
        "clamped": clamped.tolist(), "clamp_point": point.tolist(), "clamp_normal": normal.tolist(),
        "youngs_modulus": material.youngs_modulus, "poisson_ratio": material.poisson_ratio,
        "density": material.density, "damping_s": damping, "friction": 0.0, "gravity": [0.0, 0.0, 0.0], "rigid": None,
        "mujoco_solver": "Newton",
    }
    return {**task, "tetrahedra": task["blocks"].get("tet4")}


def divided(name: str) -> tuple[str, tuple[int, ...]]:
    """Return element and divisions of a name like ``tet4 20x6x6``."""
    element, divisions = name.split()
    return element, tuple(int(n) for n in divisions.split("x"))


def everyone(tetrahedra: str, bricks: str, *, stepper: Any = None) -> tuple[Variant, ...]:
    """Return the usual variants: all programs on tetrahedra, finqd on bricks."""
    stepper = stepper or IMPLICIT
    same = [Variant(program=p, mesh=tetrahedra, stepper=stepper) for p in ("mujoco", "drake", "finqd")]
    return (*same, Variant(program="finqd", mesh=bricks, stepper=stepper))


# -- a bar that sags ---------------------------------------------------------------------------------------------------


def bar(poisson_ratio: float) -> Material:
    """Return the silicone of `finqd.verification.statics`, of another Poisson's ratio."""
    return Material(
        youngs_modulus=SILICONE.youngs_modulus, poisson_ratio=poisson_ratio, density=SILICONE.density
    )


def sag_task(poisson_ratio: float, name: str) -> Task:
    """Return a bar of 100 x 30 x 30 mm that is clamped at one end and let go."""
    element, divisions = divided(name)
    mesh = box_mesh((100 * MM, 30 * MM, 30 * MM), divisions, element)
    task = shaped(mesh, bar(poisson_ratio), clamped=mesh.node_sets["xmin"], axis=0, damping=DAMPING)
    return {**task, "gravity": list(GRAVITY), "watched": mesh.node_sets["xmax"].tolist(), "duration": 1.0}


@cache
def sag_reference(poisson_ratio: float) -> tuple[float, str]:
    """Return the sag of quadratic bricks [mm], and how much the next coarser mesh differs."""
    found = []
    for n in (4, 6):
        scene = Scene(gravity=GRAVITY)
        mesh = box_mesh((100 * MM, 30 * MM, 30 * MM), (3 * n, n, n), "hex20")
        beam = scene.add_soft(mesh, bar(poisson_ratio))
        beam.fix("xmin")
        found.append(-at_rest(scene, beam.vertices("xmax"), time_step=0.1, steps=4)[2] / MM)
    return found[-1], f"hex20 18x6x6, {100 * (found[-1] / found[0] - 1):+.2f} % from 12x4x4"


# -- a sphere at rest on a block ---------------------------------------------------------------------------------------


def weight_task(name: str) -> Task:
    """Return a block of 60 x 60 x 30 mm, clamped below, on which a heavy sphere is put down without a drop."""
    element, divisions = divided(name)
    mesh = box_mesh(BLOCK, divisions, element)
    task = shaped(mesh, bar(0.49), clamped=mesh.node_sets["zmin"], axis=2, damping=DAMPING)
    centre = [0.5 * BLOCK[0], 0.5 * BLOCK[1], BLOCK[2] + RADIUS]
    rigid = {"shape": "sphere", "radius": RADIUS, "mass": MASS, "position": centre}
    return {
        **task, "gravity": list(GRAVITY), "friction": 0.5, "rigid": rigid, "duration": 1.0, "mujoco_solver": "CG",
        "watched": mesh.node_sets["zmax"].tolist(),
    }


@cache
def weight_reference() -> tuple[float, str]:
    """Return how deep the sphere sinks [mm], of two meshes of a quarter of the block."""
    coarse, fine = indentation(6), indentation(9)
    return fine, f"a quarter, hex20 9x9x9 graded, {100 * (fine / coarse - 1):+.2f} % from 6x6x6"


def indentation(n: int) -> float:
    """Return how far [mm] a quarter of the block is pushed up against a held sphere where that carries its weight."""
    grade = 1.5

    def mapping(unit: np.ndarray) -> np.ndarray:
        x, y, z = (np.sinh(grade * s) / np.sinh(grade) for s in (unit[:, 0], unit[:, 1], 1.0 - unit[:, 2]))
        return np.column_stack([0.5 * BLOCK[0] * x, 0.5 * BLOCK[1] * y, BLOCK[2] * (1.0 - z)])

    scene, deepest = Scene(gravity=GRAVITY, friction=0.5), 2 * MM
    block = scene.add_soft(mapped_box((n, n, n), "hex20", mapping, straight=True), bar(0.49))
    block.fix("xmin", axes=(0,))
    block.fix("ymin", axes=(1,))
    block.drive("zmin", Motion(path=Shift(vector=(0.0, 0.0, deepest)), duration=1.0))
    from peer_finqd import CONTACT, rigid_shape

    shape = rigid_shape({"shape": "sphere", "radius": RADIUS, "mass": MASS})
    scene.add_rigid(shape, position=(0.0, 0.0, BLOCK[2] + RADIUS), held=True)
    history = [(0.0, 0.0)]

    def watch(system: System, state: State) -> None:
        push = float(system.contact_forces_on_rigid(state)[0, 2])
        history.append((4.0 * push, deepest * eased(float(state.progress[0]))))

    checked(simulate(scene, duration=1.0, time_step=0.1, stepper=STATIC, contact=CONTACT, watch=watch))
    forces, depths = np.array(history).T
    if not forces[-1] > MASS * SILICONE_GRAVITY:
        raise Failed(f"the block carries only {forces[-1]:.3g} N at {deepest / MM:g} mm")
    share = 2.0 / 3.0  # Hertz's: the depth is about straight over this power of the force
    return float(np.interp((MASS * SILICONE_GRAVITY) ** share, np.maximum(forces, 0.0) ** share, depths)) / MM


def weight_check(outcome: Outcome) -> str:
    """Return by how much the contact force misses the weight."""
    return f"force {100 * (outcome['force'][2] / (MASS * SILICONE_GRAVITY) - 1):+.2f} % of the weight"


# -- a fin ray finger --------------------------------------------------------------------------------------------------


def press_task(name: str) -> Task:
    """Return the press of `finqd.verification.press`: a cylinder that is pushed 10 mm into the benchmark finger.

    ``name``: ``tet4 3`` for linear tetrahedra of that size [mm], or a preset.
    """
    design = Design.from_json(designs_folder() / "benchmark.json")
    if name.startswith("tet4"):
        mesher = {"name": "tetrahedral", "size_mm": float(name.split()[1]), "order": 1}
        design = Design.from_json({**design.to_dict(), "mesher": mesher})
    else:
        design = apply_preset(design, name)
    solid = design.plugin("geometry").build(design.finger_si(0))
    mesh = mesh_solid(design.plugin("mesher"), solid)
    task = shaped(mesh, design.material, clamped=mesh.node_sets["base"], axis=1, damping=0.0)
    x, y = touching_centre(mesh, solid, RADIUS)
    low, high = mesh.vertices[:, 2].min(), mesh.vertices[:, 2].max()
    rigid = {
        "shape": "cylinder", "radius": RADIUS, "half_length": float(0.5 * (high - low) + OVERHANG),
        "position": [x, y, float(0.5 * (low + high))],
        "path": {"vector": (-PRESSED * BACK).tolist(), "duration": PRESS_S},
    }
    return {**task, "rigid": rigid, "watched": mesh.node_sets["base"].tolist(), "duration": PRESS_S + REST_S}


def press_reference() -> tuple[float, str]:
    """Return the converged force of the press [N]."""
    return REFERENCE, "hex20 with 108,072 unknowns, confirmed by the limit of linear bricks"


def press_stepper() -> Any:
    """Return the stepper of the preset `standard`."""
    return apply_preset(Design.from_json(designs_folder() / "benchmark.json"), "standard").spec("stepper")


def sagging(poisson_ratio: float) -> PeerCase:
    """Return the bar of a Poisson's ratio."""
    return PeerCase(
        title=f"bar 100 x 30 x 30 mm sags under its weight, Poisson's ratio {poisson_ratio:g}, 1 s", quantity="sag",
        unit="mm", effects="on: gravity, large rotation, inertia, damping 0.03 s; off: contact",
        variants=everyone("tet4 20x6x6", "hex20 10x3x3"), task=partial(sag_task, poisson_ratio),
        value=lambda outcome: -outcome["displacement"][2] / MM, reference=partial(sag_reference, poisson_ratio),
    )


CASES = {
    "sag_0.3": sagging(0.3),
    "sag_0.49": sagging(0.49),
    "weight": PeerCase(
        title="sphere of 0.5 kg comes to rest on a block 60 x 60 x 30 mm, Poisson's ratio 0.49, 1 s", unit="mm",
        quantity="depth", effects="on: gravity, inertia, damping 0.03 s, contact, friction 0.5; off: self-contact",
        variants=everyone("tet4 12x12x6", "hex20 8x8x4"), task=weight_task, check=weight_check,
        value=lambda outcome: -outcome["rigid_displacement"][2] / MM, reference=weight_reference,
    ),
    "press": PeerCase(
        title="cylinder is pushed 10 mm into the benchmark finger in 0.5 s, and stays 0.1 s",
        quantity="force", unit="N", effects="on: inertia, contact; off: gravity, friction, damping, self-contact",
        variants=everyone("tet4 3", "standard", stepper=press_stepper()), task=press_task,
        value=lambda outcome: -float(np.dot(outcome["force"], -BACK)), reference=press_reference,
    ),
}
