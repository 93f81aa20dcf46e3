"""How far off one result is likely to be: the same grasps again, one level away in mesh and in time step.

Two or three companions run for every object, each away from the result in one thing only: a mesh whose elements are
about half as long again; one with half as many layers through the finger's thickness, where the design sets their
number (twice as many instead of one); and steps twice as long (half as long where stability sets their length). Size
and layers are apart since their errors have opposite signs in bending (large elements are stiff, few layers soft) and
would hide each other. From the difference d to a companion whose elements (or steps) are rho times as long,
Richardson's extrapolation takes the error of the result itself as d / |rho^p - 1|, for a method of order p (Roache, J.
Fluids Eng. 116, 1994). The spread is the sum of all, taken as absolute values.

What is taken for the order: p = 1 in the mesh and q = 1 in the step, whatever the elements and the stepper. Both can be
of second order or better where the solution is smooth; contact that comes and goes is not, and corners of ribs are not.
A lower order makes the estimate larger.

What is taken for rho: what came about, not what was asked for. In the mesh it is the cube root of the ratio of the
numbers of elements, the square root where their number through the thickness is held (a profile of thin walls leaves a
mesher little choice, and then a mesh for a larger size is hardly coarser), and the ratio itself for layers; in time,
the ratio of the numbers of steps, from 1/2 to 2. If no coarser mesh is to be had, a finer one is taken.

An estimate is no bound. It sees what a coarser level sees: a grasp that slips only on much finer meshes escapes it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from finqd.errors import InputError, MeshError
from finqd.grasp import GraspTask
from finqd.presets import TIME_STEP
from finqd.trajectory import Trajectory
from finqd.units import MM

if TYPE_CHECKING:
    from finqd.contracts import Fitness
    from finqd.design import Design
    from finqd.evaluate import Evaluation
    from finqd.mesh import Mesh
    from finqd.objects import GraspObject

MESH_FACTORS = (1.5, 2.0, 1 / 1.5)  # on the element size, tried in this order
STEP_FACTOR = 2.0
LAYER_FACTOR = 2
LEAST_RATIO = 1.15  # two levels nearer to each other than this say nothing about an error
MESH_ORDER = 1.0
STEP_ORDER = 1.0
LONGER, SHORTER = "longer_step", "shorter_step"


@dataclass(frozen=True, kw_only=True)
class Companion:
    """A grasp one level away: ``ratio`` is the length of its elements (or steps) over that of the result's."""

    level: str
    trajectory: Trajectory
    ratio: float
    order: float


@dataclass(frozen=True, kw_only=True)
class ObjectEstimate:
    """What is estimated of one object: value and spread of final force [N] and drop [m], NaN where there is none.

    force: sum over the fingers of the normal contact forces at the end; verdicts: "held", "lost", or why there is none,
    of the result ("base") and of each companion; uncertain: the verdict could be the other, for ``reason``
    """

    force: tuple[float, float]
    drop: tuple[float, float]
    verdicts: Mapping[str, str]
    reason: str

    @property
    def uncertain(self) -> bool:
        """Whether a better simulation might come to the other verdict."""
        return bool(self.reason)

    def to_dict(self) -> dict[str, Any]:
        """Return the estimate as JSON holds it."""
        return {
            "force_N": [_finite(value) for value in self.force],
            "drop_mm": [_finite(value / MM) for value in self.drop],
            "verdicts": dict(self.verdicts), "uncertain": self.uncertain, "reason": self.reason,
        }


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """The estimates of all objects; ``levels`` says of each companion how it was set and how long [s] it took."""

    objects: Mapping[str, ObjectEstimate]
    levels: Mapping[str, Mapping[str, Any]]
    seconds: Mapping[str, float] = field(compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Return what a result says of the estimate as a whole; each object's is in its own row."""
        return {
            "uncertain": sum(one.uncertain for one in self.objects.values()), "objects": len(self.objects),
            "levels": {name: dict(level) for name, level in self.levels.items()},
            "orders": {"mesh": MESH_ORDER, "step": STEP_ORDER}, "seconds": dict(self.seconds),
        }


@dataclass(frozen=True, kw_only=True)
class _Level:
    """Design and meshes of one companion; no meshes if there is none, for ``reason``."""

    name: str
    settings: Mapping[str, Any]
    design: Design
    meshes: tuple[Mesh, ...] = ()
    ratio: float = math.nan  # of element sizes; that of steps shows only afterwards
    reason: str = ""


def estimate_error(
    evaluation: Evaluation, *, objects: Sequence[str | Path | GraspObject] | None = None, jobs: int = 1,
    progress: Callable[[str, float], None] | None = None,
) -> Estimate:
    """Return how far off ``evaluation`` is likely to be, from simulations one level away in mesh and time step.

    objects: those of the evaluation, needed if they do not come with finqd; jobs, progress: as in `finqd.evaluate`.
    Objects whose simulation failed are uncertain without more ado, except those for which there was no room. Raises
    InputError for objects that are not the evaluation's.
    """
    from finqd.evaluate import load_objects, run_grasps

    base = evaluation.trajectories
    grasped = load_objects(list(base) if objects is None else objects)
    if [g.name for g in grasped] != list(base):
        raise InputError("these are not the objects of the evaluation", "objects")
    levels = _levels(evaluation) if any(t.status == "ok" for t in base.values()) else ()
    runs = [(level, g) for g in grasped if base[g.name].status == "ok" for level in levels if level.meshes]
    tasks = [GraspTask(design=level.design, meshes=level.meshes, grasped=g) for level, g in runs]
    labels = [f"{g.name} ({level.name.replace('_', ' ')})" for level, g in runs]
    found = run_grasps(tasks, labels=labels, jobs=jobs, progress=progress) if tasks else []
    others = {(level.name, g.name): trajectory for (level, g), trajectory in zip(runs, found, strict=True)}
    fitness = evaluation.design.plugin("fitness")
    estimates = {}
    for name, trajectory in base.items():
        companions = [_companion(level, name, trajectory, others) for level in levels]
        estimates[name] = estimate_object(name, trajectory, companions, fitness)
    seconds = {"base": sum(map(_seconds, base.values()))}
    for level in levels:
        seconds[level.name] = sum(_seconds(t) for (name, _), t in others.items() if name == level.name)
    return Estimate(objects=estimates, levels={level.name: _described(level) for level in levels}, seconds=seconds)


def estimate_object(name: str, base: Trajectory, companions: Sequence[Companion], fitness: Fitness) -> ObjectEstimate:
    """Return the estimate of one object from its trajectory and those of its companions.

    The verdict is uncertain if a companion's differs, if a simulation failed or is no other level, or if the drop with
    the spread added or taken away would be judged otherwise.
    """
    verdicts = {"base": _verdict(name, base, fitness)}
    if base.status != "ok":
        reason = "" if base.status == "no_room" else f"the simulation itself: {base.status}"
        return ObjectEstimate(force=(math.nan, math.nan), drop=(math.nan, math.nan), verdicts=verdicts, reason=reason)
    reasons, force, drop = [], 0.0, 0.0
    for other in companions:
        level = other.level.replace("_", " ")
        verdicts[other.level] = verdict = _verdict(name, other.trajectory, fitness)
        if other.trajectory.status != "ok":
            reasons.append(f"{level}: {other.trajectory.reason or other.trajectory.status}")
        elif max(other.ratio, 1 / other.ratio) < LEAST_RATIO:
            reasons.append(f"{level}: is no other level, the two are only {other.ratio:.2f} apart")
        elif verdict != verdicts["base"]:
            reasons.append(f"{verdicts['base']}, but {verdict} with the {level}")
        weight = richardson(other.ratio, other.order)
        force += weight * abs(_force(other.trajectory) - _force(base))
        drop += weight * abs(other.trajectory.object_drop - base.object_drop)
    shifted = {_verdict(name, replace(base, object_drop=base.object_drop + sign * drop), fitness) for sign in (-1, 1)}
    if math.isfinite(drop) and shifted != {verdicts["base"]}:
        reasons.append(f"a drop of {base.object_drop / MM:.2f} +- {drop / MM:.2f} mm reaches over the threshold")
    return ObjectEstimate(
        force=(_force(base), force), drop=(base.object_drop, drop), verdicts=verdicts, reason="; ".join(reasons)
    )


def richardson(ratio: float, order: float) -> float:
    """Return the error of a result over its difference to one with elements (or steps) ``ratio`` times as long.

    NaN if the two are no different levels. Below 1 the other one is the finer.

    >>> richardson(2.0, 1.0), richardson(2.0, 2.0) == 1 / 3, richardson(0.5, 1.0)
    (1.0, True, 2.0)
    """
    if not max(ratio, 1 / ratio) >= LEAST_RATIO:
        return math.nan
    return 1.0 / abs(ratio**order - 1.0)


def _levels(evaluation: Evaluation) -> tuple[_Level, ...]:
    design = evaluation.design
    solids = [design.plugin("geometry").build(design.finger_si(i)) for i in range(len(design.fingers))]
    longer = _step_level(design, solids)  # first: its meshes are those of the evaluation, which are kept for a while
    sized = _mesh_level(evaluation, solids)
    layered = layer_settings(design.plugin("mesher"))
    return (sized, longer) if layered is None else (sized, _layer_level(design, solids, *layered), longer)


def _step_level(design: Design, solids: Sequence[Any]) -> _Level:
    """Return the level in time, on the meshes of the design itself."""
    from finqd.evaluate import finger_meshes

    name, settings = step_settings(design)
    try:
        changed, meshes = design.with_overrides(settings), finger_meshes(design, solids)
    except (MeshError, InputError) as error:
        return _Level(name=name, settings=settings, design=design, reason=f"no other steps could be taken: {error}")
    return _Level(name=name, settings=settings, design=changed, meshes=meshes)


def _layer_level(design: Design, solids: Sequence[Any], name: str, settings: Mapping[str, Any], ratio: float) -> _Level:
    """Return the level with another number of layers."""
    from finqd.evaluate import finger_meshes

    try:
        changed = design.with_overrides(settings)
        meshes = finger_meshes(changed, solids)
    except (MeshError, InputError) as error:
        return _Level(name=name, settings=settings, design=design, reason=f"no other layers could be made: {error}")
    return _Level(name=name, settings=settings, design=changed, meshes=meshes, ratio=ratio)


def layer_settings(mesher: Any) -> tuple[str, dict[str, Any], float] | None:
    """Return name, settings (as overrides) and ratio of the level in the number of layers; None if it is not set.

    >>> from types import SimpleNamespace
    >>> layer_settings(SimpleNamespace(layers=3)), layer_settings(SimpleNamespace(layers=1))
    (('fewer_layers', {'mesher.layers': 2}, 1.5), ('more_layers', {'mesher.layers': 2}, 0.5))
    """
    layers = getattr(mesher, "layers", None)
    if layers is None:
        return None
    other = LAYER_FACTOR if layers == 1 else math.ceil(layers / LAYER_FACTOR)
    return "more_layers" if other > layers else "fewer_layers", {"mesher.layers": other}, layers / other


def step_settings(design: Design) -> tuple[str, dict[str, Any]]:
    """Return the level in time and its settings, as overrides.

    Steps are twice as long; a stepper that chooses its own (``error_tolerance_mm``) gets a looser tolerance too. One
    whose steps stability sets (``safety``) cannot take longer ones: there they are half as long.
    """
    stepper, dt = design.plugin("stepper"), design.protocol.time_step_ms
    if hasattr(stepper, "safety"):
        halves = {f"protocol.{TIME_STEP}": dt / STEP_FACTOR, "stepper.safety": stepper.safety / STEP_FACTOR}
        return SHORTER, halves
    settings = {f"protocol.{TIME_STEP}": min(STEP_FACTOR * dt, 1000.0)}
    tolerance = getattr(stepper, "error_tolerance_mm", None)
    if tolerance is not None:  # the error of one step of an order q goes with the power q + 1 of its length
        settings["stepper.error_tolerance_mm"] = STEP_FACTOR ** (STEP_ORDER + 1) * tolerance
    return LONGER, settings


def _mesh_level(evaluation: Evaluation, solids: Sequence[Any]) -> _Level:
    """Return the level with the first mesh that is different enough, or the reason why there is none."""
    from finqd.evaluate import finger_meshes

    design, elements = evaluation.design, sum(evaluation.mesh["elements"].values())
    reason, settings = "", {}
    for factor in MESH_FACTORS:
        name = "coarser_mesh" if factor > 1 else "finer_mesh"
        try:
            settings = mesh_settings(design.plugin("mesher"), factor)
            changed = design.with_overrides(settings)
            meshes = finger_meshes(changed, solids)
        except (MeshError, InputError) as error:
            reason = str(error)
            continue
        count = sum(len(block) for mesh in meshes for block in mesh.blocks.values())
        held = getattr(design.plugin("mesher"), "layers", None) is not None
        ratio = (elements / count) ** (1 / 2 if held else 1 / 3)
        if max(ratio, 1 / ratio) >= LEAST_RATIO and (ratio > 1) == (factor > 1):
            return _Level(name=name, settings=settings, design=changed, meshes=meshes, ratio=ratio)
        reason = f"{count} elements instead of {elements} are no other level"
    reason = f"no other mesh could be made: {reason}"
    return _Level(name="coarser_mesh", settings=settings, design=design, reason=reason)


def mesh_settings(mesher: Any, factor: float) -> dict[str, Any]:
    """Return the mesher's options for elements ``factor`` times as long, as overrides.

    Raises InputError for a mesher without ``size_mm``. The number of elements through a wall (``least_edges``) changes
    the other way round where it is set; one element stays one. For layers see `layer_settings`.
    """
    if not hasattr(mesher, "size_mm"):
        raise InputError("the mesher has no option size_mm")
    settings: dict[str, Any] = {"mesher.size_mm": mesher.size_mm * factor}
    number = getattr(mesher, "least_edges", None) or 1
    if number > 1:
        settings["mesher.least_edges"] = max(1, round(number / factor))
    return settings


def _companion(
    level: _Level, name: str, base: Trajectory, others: Mapping[tuple[str, str], Trajectory]
) -> Companion:
    trajectory = others.get((level.name, name), Trajectory(status="not_run", reason=level.reason))
    if level.name not in (LONGER, SHORTER):
        return Companion(level=level.name, trajectory=trajectory, ratio=level.ratio, order=MESH_ORDER)
    steps = _steps(trajectory)
    ratio = min(max(_steps(base) / steps, 1 / STEP_FACTOR), STEP_FACTOR) if steps else math.nan
    return Companion(level=level.name, trajectory=trajectory, ratio=ratio, order=STEP_ORDER)


def _described(level: _Level) -> dict[str, Any]:
    described: dict[str, Any] = {"settings": dict(level.settings)}
    if level.meshes and math.isfinite(level.ratio):
        described["elements"] = sum(len(block) for mesh in level.meshes for block in mesh.blocks.values())
        described["ratio"] = level.ratio
    return {**described, "reason": level.reason} if level.reason else described


def _verdict(name: str, trajectory: Trajectory, fitness: Fitness) -> str:
    if trajectory.status != "ok":
        return trajectory.status
    return "held" if fitness.score({name: trajectory}).verdicts[name].held else "lost"


def _force(trajectory: Trajectory) -> float:
    return float(trajectory.contact_forces[-1].sum()) if len(trajectory.contact_forces) else math.nan


def _seconds(trajectory: Trajectory) -> float:
    return trajectory.timings.get("set_up", 0.0) + trajectory.timings.get("steps", 0.0)


def _steps(trajectory: Trajectory) -> int:
    """Return the number of steps; an explicit stepper divides what it is asked for into steps of its own."""
    return trajectory.counters.get("substeps", 0) or trajectory.counters.get("steps", 0)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
