"""One grasp: a gripper over an object as a scene, its simulation, and what became of the object."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.early_verdict import EarlyVerdict, object_heights
from finqd.effects import effects_seen, with_effects
from finqd.placement import placement
from finqd.scene import Scene, Shift, Timed
from finqd.simulate import simulate
from finqd.trajectory import Trajectory
from finqd.units import MS

if TYPE_CHECKING:
    from finqd.design import Design
    from finqd.mesh import Mesh
    from finqd.objects import GraspObject
    from finqd.profiling import Profile
    from finqd.protocol import GraspProtocol

FLOOR = "floor"
#: what touches what in a grasp -> the protocol's coefficient for it, where that is given
FRICTION = {
    ("finger", "object"): "friction_finger_object", ("finger", "finger"): "friction_finger_finger",
    ("finger", FLOOR): "friction_finger_floor", ("object", FLOOR): "friction_object_floor",
}


@dataclass(frozen=True, kw_only=True)
class GraspTask:
    """What one simulation needs; travels to worker processes.

    meshes: one a finger, in the finger frame [m]
    checkpoint: file that the simulation is kept in, and goes on from (see `finqd.simulate.simulate`)
    profile: whether the trajectory's timings say where the time went (see `finqd.profiling`)
    """

    design: Design
    meshes: tuple[Mesh, ...]
    grasped: GraspObject
    record: bool = False
    checkpoint: Path | None = None
    profile: bool = False


def lift_start(protocol: GraspProtocol) -> float:
    """Return when the gripper starts to rise [s]."""
    return protocol.si("settle_s") + protocol.si("close_s") + protocol.si("squeeze_s")


def grasp_duration(protocol: GraspProtocol) -> float:
    """Return the length of a grasp [s]."""
    return lift_start(protocol) + protocol.si("lift_s") + protocol.si("hold_s")


def early_verdict(design: Design) -> EarlyVerdict:
    """Return what tells whether a grasp by ``design`` is decided before its end."""
    protocol = design.protocol
    return EarlyVerdict(
        lift=lift_start(protocol), hold=lift_start(protocol) + protocol.si("lift_s"), end=grasp_duration(protocol),
        rise=protocol.si("lift_mm"), threshold=protocol.si("drop_threshold_mm"), stepper=design.plugin("stepper"),
    )


def base_height(meshes: Sequence[Mesh], protocol: GraspProtocol) -> float:
    """Return the height [m] of the finger bases over the floor: the longest finger clears it as the protocol says."""
    return max(float(mesh.vertices[:, 1].max()) for mesh in meshes) + protocol.si("tip_clearance_mm")


def grasp_scene(task: GraspTask) -> Scene:
    """Return the scene of a grasp: first the fingers, then the object; the floor is z = 0, the gripper's axis is z.

    Effects that the design forces off are left out.
    """
    design = with_effects(task.design)
    protocol = design.protocol
    scene = Scene(gravity=(0.0, 0.0, -protocol.si("gravity_m_s2")), friction=protocol.friction_coefficient)
    height = base_height(task.meshes, protocol)
    count = len(task.meshes)
    placements = [placement(i, count, design.spacing, height) for i in range(count)]
    rise = Shift(vector=(0.0, 0.0, protocol.si("lift_mm")))
    lift = Timed(path=rise, start=lift_start(protocol), duration=protocol.si("lift_s"))
    elasticity = design.plugin("elasticity")
    motions = design.plugin("actuation").motions(placements)
    for i, (mesh, pose, motion) in enumerate(zip(task.meshes, placements, motions, strict=True)):
        finger = scene.add_soft(mesh.transformed(pose), design.material, elasticity=elasticity, name=f"finger {i + 1}")
        finger.weightless = design.forced_effects.get("gravity_on_fingers") == "off"
        finger.drive("base", replace(motion, start=motion.start + protocol.si("settle_s"), carriers=(lift,)))
    off = {name for name, state in design.forced_effects.items() if state == "off"}
    if "floor" not in off:
        scene.add_plane(name=FLOOR)
    _add_object(scene, replace(task.grasped, soft=None) if "soft_object" in off else task.grasped, protocol)
    _leave_out(scene, off, fingers=_named(scene, task, "finger"), grasped=task.grasped.name)
    for pair, key in FRICTION.items():
        if "floor" in off and FLOOR in pair:
            continue
        coefficient = getattr(protocol, key)
        if coefficient is not None:
            for one in _named(scene, task, pair[0]):
                for other in _named(scene, task, pair[1]):
                    scene.set_friction(one, other, coefficient)
    return scene


def _add_object(scene: Scene, grasped: GraspObject, protocol: GraspProtocol) -> None:
    pose = object_pose(grasped, protocol)
    if grasped.soft is None or grasped.mesh is None:
        scene.add_rigid(grasped, position=tuple(pose[:3, 3].tolist()), rotation=pose[:3, :3].copy())
        return
    material = grasped.soft.material(grasped.mass / grasped.mesh.volume)
    body = grasped.mesh.transformed(pose)
    scene.add_soft(body, material, elasticity=grasped.soft.elasticity, name=grasped.name)


def _leave_out(scene: Scene, off: set[str], *, fingers: Sequence[str], grasped: str) -> None:
    """Let bodies pass through each other whose contact is an effect that is ``off``."""
    for i, finger in enumerate(fingers):
        if "object_contact" in off:
            scene.ignore(finger, grasped)
        if "self_contact" in off:
            scene.ignore(finger, finger)
        for other in fingers[:i] if "finger_to_finger_contact" in off else ():
            scene.ignore(other, finger)


def object_pose(grasped: GraspObject, protocol: GraspProtocol) -> np.ndarray:
    """Return the (4, 4) matrix from an object's body frame to where it rests on the floor under the gripper."""
    pose = np.eye(4)
    pose[:3, :3] = grasped.rest_rotation
    pose[:3, 3] = protocol.si("object_offset_x_mm"), protocol.si("object_offset_y_mm"), grasped.rest_height
    if protocol.object_turn_deg:  # not even the sign of a zero changes without a turn
        angle = protocol.si("object_turn_deg")
        cosine, sine = math.cos(angle), math.sin(angle)
        pose[:2, :3] = np.array([[cosine, -sine], [sine, cosine]]) @ pose[:2, :3]
    return pose


def _named(scene: Scene, task: GraspTask, what: str) -> list[str]:
    """Return the names of a grasp's "finger", "object" or "floor" in its scene."""
    fingers = [body.name for body in scene.soft_bodies[: len(task.meshes)]]
    return {"finger": fingers, "object": [task.grasped.name], "floor": [FLOOR]}[what]


def overlap_at_start(scene: Scene, grasped: GraspObject, protocol: GraspProtocol) -> str | None:
    """Return a sentence if fingers overlap each other or the object at the start, else None."""
    from finqd.collision import overlaps

    fingers = [body for body in scene.soft_bodies if body.name != grasped.name]
    surfaces = [(finger.mesh.vertices, finger.mesh.surface_triangles(), np.eye(4)) for finger in fingers]
    thing = (grasped.vertices, grasped.triangles, object_pose(grasped, protocol))
    for i, (finger, surface) in enumerate(zip(fingers, surfaces, strict=True)):
        for other, beside in zip(fingers[:i], surfaces, strict=False):
            if overlaps(beside, surface):
                return f"the open fingers overlap each other: {other.name} and {finger.name}"
        if overlaps(surface, thing):
            return f"{grasped.name} does not fit between the open fingers: it overlaps {finger.name}"
    return None


@contextmanager
def compile_clock() -> Iterator[Callable[[], float]]:
    """Yield a function that says how long [s] Numba has compiled kernels, or loaded them from its cache, so far."""
    from numba.core import event

    with event.install_listener("numba:compiler_lock", event.TimingListener()) as timer:
        yield lambda: timer.duration if timer.done else 0.0


def simulate_grasp(task: GraspTask, *, progress: Callable[[float], None] | None = None) -> Trajectory:
    """Run one grasp; whatever goes wrong in the mechanics is the trajectory's status and reason.

    The trajectory's timings hold "compile" too: what of the other timings went into compiling or loading kernels.
    """
    with compile_clock() as compiled, _profile_of(task) as profile:
        trajectory = _simulated(task, progress, profile)
        own = {} if profile is None else profile.timings()
        return replace(trajectory, timings={**trajectory.timings, "compile": compiled(), **own})


def _profile_of(task: GraspTask) -> AbstractContextManager[Profile | None]:
    if not task.profile:
        return nullcontext()
    from finqd.profiling import profiled

    return profiled()


def _simulated(
    task: GraspTask, progress: Callable[[float], None] | None, profile: Profile | None
) -> Trajectory:
    design = with_effects(task.design)
    protocol = design.protocol
    scene = grasp_scene(task)
    overlap = overlap_at_start(scene, task.grasped, protocol)
    if overlap is not None:
        return Trajectory(status="no_room", reason=overlap, object_name=task.grasped.name, protocol=protocol)
    trajectory = simulate(
        scene, duration=grasp_duration(protocol), time_step=protocol.time_step_ms * MS,
        stepper=design.plugin("stepper"), contact=design.plugin("contact"), record=task.record,
        wall_clock_limit=protocol.si("wall_clock_limit_s"), progress=progress, checkpoint=task.checkpoint,
        longest_step=protocol.calm_step_factor, decided=early_verdict(design) if protocol.early_verdict else None,
        profile=profile,
    )
    return replace(
        trajectory, effects=_effects(scene, task, trajectory), object_name=task.grasped.name, protocol=protocol,
        object_drop=object_drop(trajectory, protocol),
        contact_forces=trajectory.contact_forces[:, : len(task.meshes)],
    )


def _effects(scene: Scene, task: GraspTask, trajectory: Trajectory) -> dict[str, Any]:
    """Return since when effects between bodies were needed, and why; nothing if the contact model does not say."""
    met = {(a, b): time for a, b, time in trajectory.effects.get("met", ())}
    return effects_seen(
        met, fingers=_named(scene, task, "finger"), grasped=task.grasped.name, floor=FLOOR,
        rubs=lambda a, b: scene.friction_between(a, b) > 0.0,
    ) if met else {}


def object_drop(trajectory: Trajectory, protocol: GraspProtocol) -> float:
    """Return how far the object fell relative to the gripper between the start of the lift and the end [m].

    NaN if the simulation did not reach the end.
    """
    if trajectory.status != "ok":
        return math.nan
    heights = object_heights(trajectory.rigid_positions, trajectory.soft_centres)
    before = float(np.interp(lift_start(protocol), trajectory.times, heights))
    return before + protocol.si("lift_mm") - float(heights[-1])
