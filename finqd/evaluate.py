"""Design -> Evaluation: the whole pipeline on one screen."""

from __future__ import annotations

import math
import os
import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.accuracy_bands import accuracy
from finqd.assumptions import ASSUMPTIONS, reductions_of
from finqd.contracts import FitnessResult
from finqd.early_verdict import object_heights
from finqd.effects import effects_of
from finqd.errors import FinqdError, InputError, MeshError
from finqd.grasp import GraspTask, base_height, simulate_grasp
from finqd.meshing import mesh_solid
from finqd.objects import GraspObject, load_object, object_names
from finqd.presets import apply_preset
from finqd.provenance import versions
from finqd.trajectory import Trajectory
from finqd.units import MM
from finqd.workers import TaskFailure, run_tasks

if TYPE_CHECKING:
    from finqd.design import Design
    from finqd.estimate import Estimate
    from finqd.mesh import Mesh
    from finqd.solid import Solid



@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Everything that is known of one design.

    status: "ok", or "mesh_failed" if there was nothing to simulate; reason: one sentence then
    features: in the units that their names end in; trajectories: object name -> Trajectory
    object_assumptions: what had to be assumed of the objects, one sentence each
    timings: wall-clock seconds; the only part, with each object's ``seconds`` and the estimate's, that differs between
    equal runs. "compile" is part of "simulation" (summed over processes): kernels compiled, or loaded from Numba's
    cache. estimate: how far off the result is likely to be; profile: where the time went (`finqd.profiling.total`);
    each if that was asked for
    """

    design: Design
    preset: str
    status: str
    reason: str
    result: FitnessResult
    features: Mapping[str, float]
    trajectories: Mapping[str, Trajectory]
    mesh: Mapping[str, Any]
    timings: Mapping[str, float] = field(compare=False)
    object_assumptions: tuple[str, ...] = ()
    estimate: Estimate | None = None
    profile: Mapping[str, Any] | None = field(default=None, compare=False)

    @property
    def fitness(self) -> float:
        """Share of objects held."""
        return self.result.fitness

    @property
    def margin(self) -> float:
        """Mean margin over the objects; breaks ties of `fitness`."""
        return self.result.margin

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON holds it."""
        estimate = {} if self.estimate is None else {"estimate": self.estimate.to_dict()}
        profile = {} if self.profile is None else {"profile": dict(self.profile)}
        return {
            "format": "finqd result", "design": self.design.resolved(), "digest": self.design.digest(),
            "preset": self.preset, "accuracy": accuracy(self.design, self.preset), "status": self.status,
            "reason": self.reason, "fitness": self.fitness, "margin": self.margin, **estimate,
            "features": dict(self.features),
            "objects": {name: self._row(name, trajectory) for name, trajectory in self.trajectories.items()},
            "mesh": dict(self.mesh), "timings": dict(self.timings), **profile, "effects": effects_of(self.design),
            "reductions": reductions_of(self.design),
            "assumptions": [*ASSUMPTIONS, *self.object_assumptions, *self.design.warnings],
            "versions": dict(versions()),
        }

    def _row(self, name: str, trajectory: Trajectory) -> dict[str, Any]:
        verdict = self.result.verdicts[name]
        forces, penetrations = trajectory.contact_forces, trajectory.penetrations
        simulated = bool(len(trajectory.times))
        estimate = {} if self.estimate is None else {"estimate": self.estimate.objects[name].to_dict()}
        return {
            "status": trajectory.status, "reason": trajectory.reason, "held": verdict.held,
            "drop_mm": _finite(verdict.drop / MM), "margin": verdict.margin,
            "max_contact_force_N": _finite(np.max(forces, initial=0.0)) if simulated else None,
            "final_contact_force_N": [float(f) for f in forces[-1]] if simulated else None,
            "max_penetration_mm": _finite(np.max(penetrations, initial=0.0) / MM) if simulated else None,
            "final_height_mm": _finite(_final_height(trajectory) / MM) if simulated else None,
            "simulated_s": float(trajectory.times[-1]) if simulated else 0.0, "ended": trajectory.ended,
            "effects": dict(trajectory.effects), "steps": trajectory.counters.get("steps", 0),
            "newton_iterations": trajectory.counters.get("newton_iterations", 0),
            "counters": dict(trajectory.counters),
            "seconds": trajectory.timings.get("set_up", 0.0) + trajectory.timings.get("steps", 0.0), **estimate,
        }


def evaluate(
    design: Design, *, objects: Sequence[str | Path | GraspObject] | None = None, preset: str = "standard",
    overrides: Mapping[str, Any] | None = None, jobs: int = 1, record: Path | None = None,
    progress: Callable[[str, float], None] | None = None, estimate_error: bool = False,
    checkpoints: Path | None = None, profile: bool = False,
) -> Evaluation:
    """Build ``design``, mesh it, close it on every object (default: the ten that come with finqd), and score it.

    overrides: design values by JSON path, stronger than ``preset``; jobs: grasps side by side; record: folder for
    ParaView files; progress: called with object name and share done; estimate_error: simulate again one level away in
    mesh and in time step, and say how far off the result is (`finqd.estimate`); checkpoints: folder in which each grasp
    is kept as it goes on, and from which one that was stopped goes on; profile: note where the time goes, in all grasps
    but the estimate's. Raises InputError for bad input; whatever fails in mesh or simulation is in the result.
    """
    begun = clock.perf_counter()
    chosen = apply_preset(design, preset, overrides=overrides)
    grasped = load_objects(objects)
    solids = [chosen.plugin("geometry").build(chosen.finger_si(i)) for i in range(len(chosen.fingers))]
    features: dict[str, float] = {}
    for plugin in chosen.plugin("features"):
        features.update(plugin.measure(chosen, solids))
    timings = {"geometry": clock.perf_counter() - begun}
    status, reason, mesh = "ok", "", {}
    meshed = clock.perf_counter()
    try:
        meshes = finger_meshes(chosen, solids)
        mesh = describe_meshes(meshes, chosen)
    except MeshError as error:
        status, reason = "mesh_failed", str(error)
    timings["mesh"] = clock.perf_counter() - meshed
    simulated = clock.perf_counter()
    if status == "ok":
        tasks = [
            GraspTask(
                design=chosen, meshes=meshes, grasped=g, record=record is not None, profile=profile,
                checkpoint=None if checkpoints is None else Path(checkpoints) / f"{g.name}.npz",
            )
            for g in grasped
        ]
        found = run_grasps(tasks, jobs=jobs, record=record, progress=progress)
        trajectories = {g.name: trajectory for g, trajectory in zip(grasped, found, strict=True)}
    else:
        trajectories = {g.name: Trajectory(status=status, reason=reason, protocol=chosen.protocol) for g in grasped}
    timings["simulation"] = clock.perf_counter() - simulated
    timings["compile"] = sum(t.timings.get("compile", 0.0) for t in trajectories.values())
    timings["total"] = clock.perf_counter() - begun
    evaluation = Evaluation(
        design=chosen, preset=preset, status=status, reason=reason, result=chosen.plugin("fitness").score(trajectories),
        features=features, trajectories=trajectories, mesh=mesh, timings=timings,
        object_assumptions=tuple(sentence for g in grasped for sentence in g.assumptions),
        profile=_profile(trajectories, timings) if profile else None,
    )
    return _with_estimate(evaluation, grasped, jobs=jobs, progress=progress) if estimate_error else evaluation


def _profile(trajectories: Mapping[str, Trajectory], timings: Mapping[str, float]) -> dict[str, Any]:
    from finqd.profiling import total

    return total(
        [trajectory.timings for trajectory in trajectories.values()], set_up=timings["geometry"], mesh=timings["mesh"]
    )


def _with_estimate(
    evaluation: Evaluation, grasped: Sequence[GraspObject], *, jobs: int,
    progress: Callable[[str, float], None] | None,
) -> Evaluation:
    from finqd.estimate import estimate_error

    begun = clock.perf_counter()
    estimate = estimate_error(evaluation, objects=grasped, jobs=jobs, progress=progress)
    took = clock.perf_counter() - begun
    timings = {**evaluation.timings, "estimate": took, "total": evaluation.timings["total"] + took}
    return replace(evaluation, estimate=estimate, timings=timings)


def load_objects(objects: Sequence[str | Path | GraspObject] | None) -> list[GraspObject]:
    """Return the objects of a grasp test, by default all that come with finqd. Raises InputError if names repeat."""
    wanted = object_names() if objects is None else objects
    grasped = [o if isinstance(o, GraspObject) else load_object(o) for o in wanted]
    names = [g.name for g in grasped]
    repeated = {name for name in names if names.count(name) > 1}
    if repeated or not names:
        message = f"each object once, please: {', '.join(sorted(repeated))}" if repeated else "no object"
        raise InputError(message, "objects")
    return grasped


def finger_meshes(design: Design, solids: Sequence[Solid]) -> tuple[Mesh, ...]:
    """Return the mesh of each finger; equal fingers share one. Raises MeshError."""
    mesher = design.plugin("mesher")
    made: dict[str, Mesh] = {}
    for i, solid in enumerate(solids):
        key = repr(sorted(design.fingers[i].items()))
        if key not in made:
            made[key] = mesh_solid(mesher, solid)
    return tuple(made[repr(sorted(finger.items()))] for finger in design.fingers)


def describe_meshes(meshes: Sequence[Mesh], design: Design) -> dict[str, Any]:
    """Return what a result says of its meshes."""
    kinds = sorted({kind for mesh in meshes for kind in mesh.blocks})
    return {
        "elements": {kind: sum(len(mesh.blocks.get(kind, ())) for mesh in meshes) for kind in kinds},
        "vertices": sum(m.n_vertices for m in meshes), "dofs": 3 * sum(m.n_vertices for m in meshes),
        "volume_mm3": sum(m.volume for m in meshes) / MM**3,
        "base_height_mm": base_height(meshes, design.protocol) / MM,
    }


def run_grasps(
    tasks: Sequence[GraspTask], *, labels: Sequence[str] | None = None, jobs: int = 1, record: Path | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> list[Trajectory]:
    """Return the trajectory of each grasp; a simulation that fails is one with a status.

    labels: what ``progress`` is told of, by default the names of the objects; jobs: grasps side by side; record: folder
    for ParaView files. Raises what is no fault of the design's (``InputError``, a library that is missing).
    """
    shown = [task.grasped.name for task in tasks] if labels is None else labels

    def on_progress(index: int, share: float) -> None:
        if progress is not None:
            progress(shown[index], share)

    def on_result(index: int, result: Any) -> None:
        if record is not None and isinstance(result, Trajectory) and len(result.times):
            _write_record(Path(record), tasks[index], result)
        on_progress(index, 1.0)

    results = run_tasks(simulate_grasp, tasks, jobs=jobs, on_progress=on_progress, on_result=on_result)
    return [_as_trajectory(r, task.design, task.grasped.name) for r, task in zip(results, tasks, strict=True)]


def _as_trajectory(result: Any, design: Design, name: str) -> Trajectory:
    if isinstance(result, TaskFailure):
        if isinstance(result.exception, FinqdError) and not isinstance(result.exception, MeshError):
            raise result.exception  # bad input, or a library that is missing: no fault of the design's
        return Trajectory(status=result.kind, reason=result.reason, object_name=name, protocol=design.protocol)
    return result


def _write_record(folder: Path, task: GraspTask, trajectory: Trajectory) -> None:
    from finqd.grasp import grasp_scene
    from finqd.record import write_paraview

    scene = grasp_scene(task)
    target = folder / task.grasped.name
    os.makedirs(target, exist_ok=True)
    trajectory.save(target / "trajectory.npz")
    surfaces = [(body.shape.vertices, body.shape.triangles) for body in scene.rigid_bodies]
    write_paraview(target, trajectory, [body.mesh for body in scene.soft_bodies], surfaces)


def _final_height(trajectory: Trajectory) -> float:
    return object_heights(trajectory.rigid_positions[-1:], trajectory.soft_centres[-1:])[0]


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
