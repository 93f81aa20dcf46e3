"""One grasp: a gripper over an object as a scene, its simulation, and what became of the object."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from finqd.placement import placement
from finqd.scene import RigidBody, Scene, Shift, Timed
from finqd.simulate import simulate
from finqd.trajectory import Trajectory
from finqd.units import MS

if TYPE_CHECKING:
    from finqd.design import Design
    from finqd.mesh import Mesh
    from finqd.objects import GraspObject
    from finqd.protocol import GraspProtocol

FLOOR = "floor"


@dataclass(frozen=True, kw_only=True)
class GraspTask:
    """What one simulation needs; travels to worker processes.

    meshes: one a finger, in the finger frame [m]
    checkpoint: file that the simulation is kept in, and goes on from (see `finqd.simulate.simulate`)
    """

    design: Design
    meshes: tuple[Mesh, ...]
    grasped: GraspObject
    record: bool = False
    checkpoint: Path | None = None


def lift_start(protocol: GraspProtocol) -> float:
    """Return when the gripper starts to rise [s]."""
    return protocol.si("settle_s") + protocol.si("close_s") + protocol.si("squeeze_s")


def grasp_duration(protocol: GraspProtocol) -> float:
    """Return the length of a grasp [s]."""
    return lift_start(protocol) + protocol.si("lift_s") + protocol.si("hold_s")


def base_height(meshes: Sequence[Mesh], protocol: GraspProtocol) -> float:
    """Return the height [m] of the finger bases over the floor: the longest finger clears it as the protocol says."""
    return max(float(mesh.vertices[:, 1].max()) for mesh in meshes) + protocol.si("tip_clearance_mm")


def grasp_scene(task: GraspTask) -> tuple[Scene, RigidBody]:
    """Return the scene of a grasp, in which the floor is z = 0 and the gripper's axis is z, and its object."""
    design, protocol = task.design, task.design.protocol
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
        finger.drive("base", replace(motion, start=motion.start + protocol.si("settle_s"), carriers=(lift,)))
    scene.add_plane(name=FLOOR)
    grasped = scene.add_rigid(
        task.grasped, position=(0.0, 0.0, task.grasped.rest_height), rotation=task.grasped.rest_rotation
    )
    return scene, grasped


def overlapping_finger(scene: Scene, grasped: RigidBody) -> str | None:
    """Return the name of a finger that the object overlaps at the start, or None."""
    from finqd.collision import overlaps

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = grasped.rotation, grasped.position
    for finger in scene.soft_bodies:
        low, high = finger.mesh.vertices.min(axis=0), finger.mesh.vertices.max(axis=0)
        reach = grasped.shape.bounding_radius
        if np.all(low <= grasped.position + reach) and np.all(high >= grasped.position - reach):
            surface = (finger.mesh.vertices, finger.mesh.surface_triangles(), np.eye(4))
            if overlaps(surface, (grasped.shape.vertices, grasped.shape.triangles, pose)):
                return finger.name
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
    with compile_clock() as compiled:
        trajectory = _simulated(task, progress)
        return replace(trajectory, timings={**trajectory.timings, "compile": compiled()})


def _simulated(task: GraspTask, progress: Callable[[float], None] | None) -> Trajectory:
    design, protocol = task.design, task.design.protocol
    scene, grasped = grasp_scene(task)
    finger = overlapping_finger(scene, grasped)
    if finger is not None:
        return Trajectory(
            status="no_room", reason=f"{task.grasped.name} does not fit between the open fingers: it overlaps {finger}",
            object_name=task.grasped.name, protocol=protocol,
        )
    trajectory = simulate(
        scene, duration=grasp_duration(protocol), time_step=protocol.time_step_ms * MS,
        stepper=design.plugin("stepper"), contact=design.plugin("contact"), record=task.record,
        wall_clock_limit=protocol.si("wall_clock_limit_s"), progress=progress, checkpoint=task.checkpoint,
    )
    return replace(
        trajectory, object_name=task.grasped.name, protocol=protocol, object_drop=object_drop(trajectory, protocol)
    )


def object_drop(trajectory: Trajectory, protocol: GraspProtocol) -> float:
    """Return how far the object fell relative to the gripper between the start of the lift and the end [m].

    NaN if the simulation did not reach the end.
    """
    if trajectory.status != "ok":
        return math.nan
    heights = trajectory.rigid_positions[:, 0, 2]
    before = float(np.interp(lift_start(protocol), trajectory.times, heights))
    return before + protocol.si("lift_mm") - float(heights[-1])
