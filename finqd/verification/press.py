"""A finger pressed by a rigid cylinder: its reaction is what a grasp lives on, and what a mesh gets wrong first.

>>> from finqd.data import designs_folder
>>> from finqd.design import Design
>>> design = Design.from_json(designs_folder() / "benchmark.json").with_overrides({"mesher.size_mm": 12})
>>> press = press_finger(design, depth=0.001, duration=0.1, rest=0.0)
>>> press.status, bool(press.force > 0.0), round(float(press.depths[-1]), 9)
('ok', True, 0.001)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.errors import InputError, MeshError
from finqd.grasp import compile_clock
from finqd.meshing import mesh_solid
from finqd.objects import GraspObject, load_object
from finqd.scene import Motion, Scene, Shift, eased
from finqd.simulate import simulate
from finqd.units import MM, MS
from finqd.verification.cases import Case, Failed

if TYPE_CHECKING:
    from finqd.design import Design
    from finqd.mechanics.state import State
    from finqd.mechanics.system import System
    from finqd.mesh import Mesh
    from finqd.solid import Solid

OVERHANG = 10 * MM  # of the cylinder over the finger's sides, so that its rims touch nothing
BACK = np.array([-1.0, 0.0, 0.0])  # the press direction in the finger frame: towards the gripper's axis
WEIGHT_G = 10.0  # any: the cylinder is held


@dataclass(frozen=True, kw_only=True)
class Press:
    """What became of a press.

    status, reason: "ok", "mesh_failed", "diverged", "timeout" or "crashed", and one sentence
    force: reaction of the cylinder along the press direction in the end [N], NaN unless the status is "ok"
    depths [m], forces [N]: history after every step, shape (n_steps,)
    max_penetration: [m]; dofs: of the finger; steps, newton_iterations: counters
    seconds: of set-up and steps, without meshing and without compiling kernels
    energy: elastic, in the end [J]
    """

    status: str
    reason: str
    force: float
    depths: np.ndarray
    forces: np.ndarray
    max_penetration: float
    dofs: int
    steps: int
    newton_iterations: int
    seconds: float
    energy: float


def press_finger(
    design: Design, *, finger: int = 0, radius: float = 20 * MM, depth: float = 10 * MM, duration: float = 0.5,
    rest: float = 0.1, friction: float = 0.0, progress: Callable[[float], None] | None = None,
    wall_clock_limit: float = math.inf,
) -> Press:
    """Press a finger of ``design`` by ``depth`` [m] against a fixed cylinder of ``radius`` [m], without gravity.

    The cylinder's axis runs along the finger's thickness, and it touches the contact face at half the finger's length.
    The finger's base is driven towards it, eased, in ``duration`` [s], and then stands still for ``rest`` [s].
    Geometry, mesher, elasticity, stepper, contact and time step are the design's. ``progress``: called with the share
    done. Whatever fails in mesh or simulation is the status. Raises InputError for numbers that make no sense.
    """
    _refuse_nonsense(design, finger=finger, radius=radius, depth=depth, duration=duration, rest=rest, friction=friction)
    solid = design.plugin("geometry").build(design.finger_si(finger))
    try:
        mesh = mesh_solid(design.plugin("mesher"), solid)
    except MeshError as error:
        return _failed("mesh_failed", str(error))
    scene = press_scene(design, mesh, solid, radius=radius, depth=depth, duration=duration, friction=friction)
    depths, forces = [], []

    def watch(system: System, state: State) -> None:
        depths.append(depth * eased(float(state.progress[0])))
        forces.append(float(system.contact_forces_on_rigid(state)[0, :3] @ BACK))

    with compile_clock() as compiled:
        try:
            found = simulate(
                scene, duration=duration + rest, time_step=design.protocol.time_step_ms * MS,
                stepper=design.plugin("stepper"), contact=design.plugin("contact"), progress=progress,
                wall_clock_limit=wall_clock_limit, watch=watch,
            )
        except (ArithmeticError, RuntimeError, MemoryError, np.linalg.LinAlgError) as error:
            return _failed("crashed", f"{type(error).__name__}: {error}", dofs=3 * mesh.n_vertices)
        compiling = compiled()
    done = found.status == "ok" and bool(forces)
    return Press(
        status=found.status, reason=found.reason, force=forces[-1] if done else math.nan, depths=np.array(depths),
        forces=np.array(forces), max_penetration=float(np.max(found.penetrations, initial=0.0)),
        dofs=3 * mesh.n_vertices, steps=found.counters.get("steps", 0),
        newton_iterations=found.counters.get("newton_iterations", 0),
        seconds=max(found.timings["set_up"] + found.timings["steps"] - compiling, 0.0),
        energy=float(found.energies["elastic"][-1]),
    )


def press_scene(
    design: Design, mesh: Mesh, solid: Solid, *, radius: float, depth: float, duration: float, friction: float
) -> Scene:
    """Return the scene of a press, in the finger frame: one finger, one held cylinder."""
    scene = Scene(gravity=(0.0, 0.0, 0.0), friction=friction)
    body = scene.add_soft(mesh, design.material, elasticity=design.plugin("elasticity"), name="finger")
    body.drive("base", Motion(path=Shift(vector=depth * BACK), duration=duration))
    thickness = float(np.ptp(mesh.vertices[:, 2]))
    middle = 0.5 * float(mesh.vertices[:, 2].max() + mesh.vertices[:, 2].min())
    x, y = touching_centre(mesh, solid, radius)
    scene.add_rigid(cylinder(radius, 0.5 * thickness + OVERHANG), position=(x, y, middle), held=True)
    return scene


def cylinder(radius: float, half_length: float) -> GraspObject:
    """Return a rigid cylinder about its own z axis [m]."""
    r, a = radius / MM, half_length / MM
    profile = [[0.0, -a], [r, -a], [r, a], [0.0, a]]
    shape: dict[str, Any] = {"kind": "revolution", "profile_mm": profile}
    return load_object({"name": "cylinder", "shape": shape, "mass_g": WEIGHT_G})


def touching_centre(mesh: Mesh, solid: Solid, radius: float) -> tuple[float, float]:
    """Return x and y [m] of the axis of a cylinder that just touches the contact face at half the finger's length.

    A flat face (``contact_line``) is touched there by its tangent. At any other face the cylinder stands at that height
    and is brought up along x.
    """
    half = 0.5 * float(mesh.vertices[:, 1].max())
    if solid.contact_line is not None:
        foot, tip = np.asarray(solid.contact_line, dtype=float)
        along = (tip - foot) / np.linalg.norm(tip - foot)
        point = foot + (half - foot[1]) / along[1] * along
        normal = np.array([-along[1], along[0]])
        x, y = point + radius * (normal if normal[0] < 0.0 else -normal)
        return float(x), float(y)
    points = _samples(mesh)
    points = points[np.abs(points[:, 1] - half) < radius]
    if not len(points):
        raise InputError("the contact face does not reach half the finger's length", "press")
    return float(np.min(points[:, 0] - np.sqrt(radius**2 - (points[:, 1] - half) ** 2))), half


def _samples(mesh: Mesh, divisions: int = 8) -> np.ndarray:
    """Return points all over the contact faces' triangles [m], shape (n, 3)."""
    faces = [mesh.faces[kind][indices] for kind, indices in mesh.face_sets["contact"].items()]
    triangles = [np.concatenate([nodes[:, [0, 1, 2]], nodes[:, [0, 2, 3 % nodes.shape[1]]]]) for nodes in faces]
    corners = mesh.vertices[np.concatenate(triangles)]
    weights = [(i, j, divisions - i - j) for i in range(divisions + 1) for j in range(divisions + 1 - i)]
    return np.einsum("wk,nkd->nwd", np.array(weights) / divisions, corners).reshape(-1, 3)


def _refuse_nonsense(design: Design, *, finger: int, rest: float, friction: float, **positive: float) -> None:
    if not 0 <= finger < len(design.fingers):
        raise InputError(f"finger must be 0 to {len(design.fingers) - 1}, not {finger}", "press")
    for name, value in positive.items():
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{name} must be a positive number, not {value}", "press")
    for name, value in (("rest", rest), ("friction", friction)):
        if not (math.isfinite(value) and value >= 0.0):
            raise InputError(f"{name} must be a number of at least 0, not {value}", "press")


def _failed(status: str, reason: str, *, dofs: int = 0) -> Press:
    return Press(
        status=status, reason=reason, force=math.nan, depths=np.zeros(0), forces=np.zeros(0), max_penetration=0.0,
        dofs=dofs, steps=0, newton_iterations=0, seconds=0.0, energy=math.nan,
    )


# -- cases -------------------------------------------------------------------------------------------------------------

#: force of the benchmark finger's press [N] by quadratic bricks with 108,072 unknowns, which the limit of linear bricks
#: confirms: studies/reference_press_benchmark.json
REFERENCE = 5.286
BANDS = {"draft": 0.15, "standard": 0.05, "fine": 0.02, "reference": 0.02}  # preset -> what is asked of it
FAST = ("draft", "standard")


def cases(fast: bool) -> Iterator[Case]:
    """Yield the press of the benchmark finger by the presets, against the converged force."""
    for preset in FAST if fast else BANDS:
        yield Case(
            name="press", quantity=f"benchmark finger, 10 mm deep: force, preset {preset}", unit="N",
            reference=REFERENCE, source="converged, two element families", band=BANDS[preset], absolute=False,
            compute=partial(benchmark_force, preset),
        )


@cache
def benchmark_force(preset: str) -> float:
    """Return the force [N] of the benchmark finger's press by a preset."""
    from finqd.data import designs_folder
    from finqd.design import Design
    from finqd.presets import apply_preset

    design = Design.from_json(designs_folder() / "benchmark.json")
    found = press_finger(apply_preset(design, preset))
    if found.status != "ok":
        raise Failed(f"{found.status}: {found.reason}")
    return found.force
