"""What an accuracy study measures: a press, a closing, a whole grasp, each as one function of a design.

`Case.measure` runs in a process of its own and returns plain values; whatever fails is a status and a reason there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.errors import InputError, MeshError
from finqd.units import MM, MS

if TYPE_CHECKING:
    from finqd.design import Design
    from finqd.objects import GraspObject

Measured = dict[str, Any]
#: design, options of the case, wall-clock limit [s], progress -> status, reason, values, seconds, counters
Measure = Callable[["Design", Mapping[str, Any], float, "Callable[[float], None] | None"], Measured]

PRESS_S = 0.6  # length of a press: finqd.verification.press_finger's own default


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A number that a case measures. ``relative``: its error is a share, in percent; otherwise it is in ``unit``."""

    label: str
    unit: str
    relative: bool = True

    @property
    def error_unit(self) -> str:
        """The unit of its error."""
        return "%" if self.relative else self.unit


@dataclass(frozen=True, kw_only=True)
class Case:
    """What is measured.

    quantities: key -> `Quantity`, the first being the one whose error the ladder is about
    simulated_s: how long the simulated time is, of a design [s]; fingers: how many are simulated
    physics: the keys of a resolved design on which the exact values depend
    """

    name: str
    title: str
    quantities: Mapping[str, Quantity]
    measure: Measure
    simulated_s: Callable[[Design], float]
    fingers: int
    physics: tuple[str, ...]
    overrides: Mapping[str, Any] = field(default_factory=dict)

    @property
    def main(self) -> str:
        """The key of the quantity whose error the ladder is about."""
        return next(iter(self.quantities))


def measured(
    *, status: str, reason: str, values: Mapping[str, Any] | None = None, seconds: float = 0.0, dofs: int = 0,
    steps: int = 0, newton_iterations: int = 0, max_penetration_mm: float = 0.0,
) -> Measured:
    """Return what `Case.measure` returns, complete; values that are not finite numbers are left out."""
    found = {k: v for k, v in (values or {}).items() if isinstance(v, bool) or math.isfinite(v)}
    return {
        "status": status, "reason": reason, "values": found if status == "ok" else {}, "seconds": seconds, "dofs": dofs,
        "steps": steps, "newton_iterations": newton_iterations, "max_penetration_mm": max_penetration_mm,
    }


def measure_press(
    design: Design, options: Mapping[str, Any], limit: float, progress: Callable[[float], None] | None
) -> Measured:
    """Press one finger against a fixed cylinder; see `finqd.verification.press`."""
    from finqd.verification.press import press_finger

    press = press_finger(design, finger=options["finger"], wall_clock_limit=limit, progress=progress)
    values: dict[str, Any] = {}
    if press.status == "ok":
        half = 0.5 * float(press.depths[-1])
        values = {
            "force_N": float(press.force), "half_force_N": float(np.interp(half, press.depths, press.forces)),
            "energy_mJ": 1e3 * float(press.energy),
        }
    return measured(
        status=press.status, reason=press.reason, values=values, seconds=press.seconds, dofs=press.dofs,
        steps=press.steps, newton_iterations=press.newton_iterations, max_penetration_mm=press.max_penetration / MM,
    )


def measure_grasp(
    design: Design, options: Mapping[str, Any], limit: float, progress: Callable[[float], None] | None
) -> Measured:
    """Close a gripper on one object, and lift it if the protocol does."""
    from finqd.evaluate import finger_meshes
    from finqd.grasp import GraspTask, simulate_grasp

    if math.isfinite(limit):
        design = design.with_overrides({"protocol.wall_clock_limit_s": min(max(limit, 1e-3), 1e6)})
    solids = [design.plugin("geometry").build(design.finger_si(i)) for i in range(len(design.fingers))]
    try:
        meshes = finger_meshes(design, solids)
    except MeshError as error:
        return measured(status="mesh_failed", reason=str(error))
    grasped: GraspObject = options["object"]
    found = simulate_grasp(GraspTask(design=design, meshes=meshes, grasped=grasped), progress=progress)
    values: dict[str, Any] = {}
    if found.status == "ok":
        verdict = design.plugin("fitness").score({grasped.name: found}).verdicts[grasped.name]
        values = {
            "final_force_N": float(np.mean(found.contact_forces[-1])),
            "elastic_mJ": 1e3 * float(found.energies["elastic"][-1]),
            "drop_mm": float(verdict.drop / MM), "held": bool(verdict.held),
        }
    timings = found.timings
    seconds = timings.get("set_up", 0.0) + timings.get("steps", 0.0) - timings.get("compile", 0.0)
    return measured(
        status=found.status, reason=found.reason, values=values, seconds=max(seconds, 0.0),
        dofs=3 * sum(mesh.n_vertices for mesh in meshes), steps=found.counters.get("steps", 0),
        newton_iterations=found.counters.get("newton_iterations", 0),
        max_penetration_mm=float(np.max(found.penetrations, initial=0.0)) / MM,
    )


def _grasp_seconds(design: Design) -> float:
    from finqd.grasp import grasp_duration

    return grasp_duration(design.protocol)


_GRIPPER = ("geometry", "finger", "fingers", "spacing_mm", "material", "actuation", "protocol")
#: what a closing is judged by: its force is the actuators' limit, which a mesh that locks reaches as well as any
_ENERGY = Quantity(label="elastic energy in the end", unit="mJ")
_FORCE = Quantity(label="final contact force, mean of the fingers", unit="N")

CASES: dict[str, Case] = {
    "press": Case(
        name="press", title="one finger pressed 10 mm by a cylinder of 20 mm radius",
        quantities={
            "force_N": Quantity(label="force at 10 mm", unit="N"),
            "half_force_N": Quantity(label="force at 5 mm", unit="N"),
            "energy_mJ": Quantity(label="elastic energy", unit="mJ"),
        },
        measure=measure_press, simulated_s=lambda design: PRESS_S, fingers=1, physics=("geometry", "material"),
    ),
    "closing": Case(
        name="closing", title="the gripper closed on an object, before the lift",
        quantities={"elastic_mJ": _ENERGY, "final_force_N": _FORCE},
        measure=measure_grasp, simulated_s=_grasp_seconds, fingers=3, physics=_GRIPPER,
        # a lift of nothing, as short as a file may say it
        overrides={"protocol.lift_mm": 0.0, "protocol.lift_s": 0.01, "protocol.hold_s": 0.0},
    ),
    "grasp": Case(
        name="grasp", title="a whole grasp: closing, lift and hold",
        quantities={
            "elastic_mJ": _ENERGY, "final_force_N": _FORCE,
            "drop_mm": Quantity(label="drop", unit="mm", relative=False),
            "held": Quantity(label="verdict", unit="", relative=False),
        },
        measure=measure_grasp, simulated_s=_grasp_seconds, fingers=3, physics=(*_GRIPPER, "fitness"),
    ),
}


def case_options(case: Case, *, finger: int | None, grasped: str | None, design: Design) -> dict[str, Any]:
    """Return the options of a case. Raises ``InputError`` for one that is not the case's, or out of range."""
    if case.fingers == 1:
        if grasped is not None:
            raise InputError(f"goes with the cases closing and grasp, not with {case.name}", "--object")
        index = 0 if finger is None else finger
        if not 0 <= index < len(design.fingers):
            raise InputError(f"must be 0 to {len(design.fingers) - 1}, not {index}", "--finger")
        return {"finger": index}
    if finger is not None:
        raise InputError(f"goes with the case press, not with {case.name}", "--finger")
    from finqd.objects import load_object

    return {"object": load_object(grasped or "sphere")}


def expected_seconds(case: Case, design: Design) -> float:
    """Return about how long a rung takes on an ordinary core [s]: an order in which to run them, no more."""
    mesher, stepper, contact = design.spec("mesher"), design.spec("stepper"), design.plugin("contact")
    plugin = design.plugin("mesher")
    size, order = float(getattr(plugin, "size_mm", 4.0)), int(getattr(plugin, "order", 1))
    dofs, weight = _expected_dofs(mesher["name"], order, size)
    dofs *= 1.6 * (getattr(plugin, "least_edges", 1) - 1) + 1 if size > 2 else 1.0
    step = design.protocol.time_step_ms * MS
    if stepper.get("error_tolerance_mm") is not None:
        step = min(step, 0.03 * stepper["error_tolerance_mm"] ** 0.5)
    # contact asks the first two for substeps of microseconds, whatever the step
    slow = {"explicit": 300.0, "imex": 60.0, "quasi_static": 1.2}.get(stepper["name"], 1.0)
    slow *= {"jacobi": 12.0, "block_jacobi": 8.0}.get(stepper.get("preconditioner", ""), 1.0)
    slow *= {"superlu": 3.0, "cholmod": 1.5, "qdldl": 1.5}.get(stepper.get("backend", ""), 1.0)
    slow *= (0.3 / getattr(contact, "sample_spacing_mm", 0.3)) ** 0.5
    steps = case.simulated_s(design) / step * case.fingers
    return 0.3 + steps * weight * slow * 9e-6 * dofs * (dofs / 2800.0) ** 0.15


def _expected_dofs(mesher: str, order: int, size_mm: float) -> tuple[float, float]:
    """Return about how many unknowns a finger has, and how much dearer each is than in swept hexahedra.

    Fits to the benchmark finger's meshes at 4 and 2 mm.
    """
    if mesher == "tetrahedral":
        return (28_800 * (4 / size_mm) ** 1.65, 1.6) if order == 2 else (14_500 * (2 / size_mm) ** 2.3, 1.2)
    return (8_500 if order == 2 else 2_820) * (4 / size_mm) ** 1.7, 1.0
