"""Scenes: soft bodies, rigid bodies, planes, prescribed motions and loads; all in SI and world coordinates.

A cantilever under its own weight (the verification cases are written in the same way)::

    from finqd.mesh_shapes import box_mesh
    from finqd.mechanics.material import Material
    from finqd.scene import Scene
    from finqd.simulate import simulate

    scene = Scene(gravity=(0, 0, -9.807))
    rubber = Material(youngs_modulus=263_824, poisson_ratio=0.499, density=1070)
    beam = scene.add_soft(box_mesh((0.1, 0.03, 0.03), (10, 3, 3)), rubber)
    beam.fix("xmin")
    trajectory = simulate(scene, duration=2.0, time_step=0.01, record=True)
    print(trajectory.soft_positions[-1][beam.vertices("xmax")].mean(axis=0))
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from finqd.errors import InputError

if TYPE_CHECKING:
    from finqd.mechanics.material import Material
    from finqd.mesh import Mesh
    from finqd.objects import GraspObject


class Path(Protocol):
    """A one-parameter family of rigid motions."""

    def pose(self, share: float) -> np.ndarray:
        """Return the (4, 4) motion from the start to ``share`` in [0, 1]; the identity at 0."""


@dataclass(frozen=True, kw_only=True)
class Turn:
    """Rotation by ``angle`` [rad] about the axis through ``point`` [m] along ``axis`` (unit vector)."""

    point: Sequence[float]
    axis: Sequence[float]
    angle: float

    def pose(self, share: float) -> np.ndarray:
        from finqd.mechanics.rotation_kernels import rotation_matrix

        pose = np.eye(4)
        pose[:3, :3] = rotation_matrix(share * self.angle * np.asarray(self.axis, dtype=float))
        point = np.asarray(self.point, dtype=float)
        pose[:3, 3] = point - pose[:3, :3] @ point
        return pose


@dataclass(frozen=True, kw_only=True)
class Shift:
    """Translation by ``vector`` [m]."""

    vector: Sequence[float]

    def pose(self, share: float) -> np.ndarray:
        pose = np.eye(4)
        pose[:3, 3] = share * np.asarray(self.vector, dtype=float)
        return pose


def eased(share: float) -> float:
    """Return the minimum-jerk course 10 s^3 - 15 s^4 + 6 s^5 of a rest-to-rest motion (Flash and Hogan 1985)."""
    s = min(max(share, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


@dataclass(frozen=True, kw_only=True)
class Timed:
    """A path run through once, eased, from ``start`` for ``duration`` [s]."""

    path: Path
    duration: float
    start: float = 0.0

    def pose(self, time: float) -> np.ndarray:
        return self.path.pose(eased((time - self.start) / self.duration))


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A drive: ``path`` is run through in ``duration`` [s] from ``start`` on, slowed as the body's contact force nears
    ``force_limit`` [N] and stalled above it; it never runs back. ``carriers`` move what the drive is mounted on.

    The speed is multiplied with (limit - force) / (band * limit), clipped to [0, 1]: a motor whose speed
    falls linearly near its stall force.
    """

    path: Path
    duration: float
    start: float = 0.0
    force_limit: float = math.inf
    band: float = 0.2
    carriers: tuple[Timed, ...] = ()

    def advanced(self, progress: float, *, time: float, dt: float, force: float) -> float:
        """Return the progress after a step of ``dt`` that starts at ``time`` with contact force ``force`` [N]."""
        throttle = 1.0
        if math.isfinite(self.force_limit):
            throttle = min(max((self.force_limit - force) / (self.band * self.force_limit), 0.0), 1.0)
        running = min(max(time + dt - self.start, 0.0), dt)
        return min(progress + throttle * running / self.duration, 1.0)

    def pose(self, progress: float, time: float) -> np.ndarray:
        """Return the (4, 4) motion of the driven vertices since the start of the scene."""
        return self.mount(time) @ self.path.pose(eased(progress))

    def mount(self, time: float) -> np.ndarray:
        """Return the (4, 4) motion of what the drive is mounted on since the start of the scene."""
        pose = np.eye(4)
        for carrier in self.carriers:
            pose = carrier.pose(time) @ pose
        return pose


@dataclass(kw_only=True, eq=False)
class SoftBody:
    """An elastic body of a `Scene`; ``mesh`` is at rest, in world coordinates."""

    name: str
    mesh: Mesh
    material: Material
    elasticity: Any
    first_vertex: int
    fixed: np.ndarray  # bool, (n_vertices, 3): degrees of freedom that are held or driven
    loads: np.ndarray  # dead loads [N], (n_vertices, 3)
    velocities: np.ndarray  # at the start [m/s], (n_vertices, 3)
    start_positions: np.ndarray  # at the start [m], (n_vertices, 3): the rest positions unless set
    extra_masses: np.ndarray  # beside the material's own [kg], (n_vertices,): inertia and weight, no stiffness
    weightless: bool = False  # gravity does not act on it; its inertia stays
    drives: list[tuple[np.ndarray, Motion]] = field(default_factory=list)

    def vertices(self, where: str | np.ndarray) -> np.ndarray:
        """Return vertex ids (of this body's mesh) of a named node set, a boolean mask or an id array."""
        if isinstance(where, str):
            if where not in self.mesh.node_sets:
                raise InputError(f"no node set {where!r}; there are {sorted(self.mesh.node_sets)}", self.name)
            return np.asarray(self.mesh.node_sets[where])
        where = np.asarray(where)
        return np.flatnonzero(where) if where.dtype == bool else where

    def fix(self, where: str | np.ndarray, axes: Sequence[int] = (0, 1, 2)) -> None:
        """Hold vertices at their start positions along ``axes``."""
        self.fixed[np.ix_(self.vertices(where), np.asarray(axes, dtype=int))] = True

    def drive(self, where: str | np.ndarray, motion: Motion) -> None:
        """Prescribe the motion of vertices."""
        nodes = self.vertices(where)
        self.fixed[nodes] = True
        self.drives.append((nodes, motion))

    def load(self, where: str | np.ndarray, force: Sequence[float]) -> None:
        """Spread a dead load [N], in all ``force``, evenly over vertices (consistent tractions: `face_tractions`)."""
        nodes = self.vertices(where)
        self.loads[nodes] += np.asarray(force, dtype=float) / len(nodes)

    def add_mass(self, where: str | np.ndarray, mass: float) -> None:
        """Spread a mass [kg] that hangs on the body, in all ``mass``, evenly over vertices: it has inertia and weight.

        Raises InputError for one that is negative or not finite.
        """
        if not 0.0 <= mass < math.inf:
            raise InputError(f"a mass must be at least 0 kg, not {mass}", self.name)
        nodes = self.vertices(where)
        self.extra_masses[nodes] += mass / len(nodes)


@dataclass(kw_only=True, eq=False)
class RigidBody:
    """A rigid body of a `Scene`; the pose is that of its centre of mass.

    ``shape`` carries mass, inertia, surface and distance.
    """

    name: str
    shape: GraspObject
    position: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    force: np.ndarray  # dead load at the centre of mass [N]
    held: bool = False  # stays where it is, whatever pushes it


@dataclass(frozen=True, kw_only=True, eq=False)
class Plane:
    """A fixed half space {x: (x - point) . normal <= 0}."""

    name: str
    point: np.ndarray
    normal: np.ndarray


class Scene:
    """Any number of soft bodies, rigid bodies and planes under gravity [m/s^2].

    ``friction`` is Coulomb's coefficient of every pair that `set_friction` does not name.
    """

    def __init__(self, *, gravity: Sequence[float] = (0.0, 0.0, -9.81), friction: float = 0.6) -> None:
        self.gravity = np.asarray(gravity, dtype=float)
        self.friction = float(friction)
        self.soft_bodies: list[SoftBody] = []
        self.rigid_bodies: list[RigidBody] = []
        self.planes: list[Plane] = []
        self.pair_friction: dict[frozenset[str], float] = {}
        self.ignored: set[frozenset[str]] = set()

    def add_soft(
        self, mesh: Mesh, material: Material, *, elasticity: Any = "corotated", name: str = "",
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> SoftBody:
        """Add an elastic body at rest in ``mesh.vertices``; ``elasticity`` is a plugin or its name."""
        from finqd import registry

        if isinstance(elasticity, (str, dict)):
            elasticity = registry.create("elasticity", elasticity)
        shape = mesh.vertices.shape
        body = SoftBody(
            name=self._new_name(name or f"soft {len(self.soft_bodies)}"), mesh=mesh, material=material,
            elasticity=elasticity, first_vertex=self.n_vertices, fixed=np.zeros(shape, dtype=bool),
            loads=np.zeros(shape), velocities=np.tile(np.asarray(velocity, dtype=float), (shape[0], 1)),
            start_positions=mesh.vertices.copy(), extra_masses=np.zeros(shape[0]),
        )
        self.soft_bodies.append(body)
        return body

    def add_rigid(
        self, shape: GraspObject, *, position: Sequence[float], rotation: np.ndarray | None = None,
        velocity: Sequence[float] = (0.0, 0.0, 0.0), angular_velocity: Sequence[float] = (0.0, 0.0, 0.0),
        force: Sequence[float] = (0.0, 0.0, 0.0), name: str = "", held: bool = False,
    ) -> RigidBody:
        """Add a rigid body with its centre of mass at ``position`` [m]; ``held``: it stays there, come what may.

        Raises InputError for a held body that has a velocity.
        """
        if held and (np.any(np.asarray(velocity)) or np.any(np.asarray(angular_velocity))):
            raise InputError("a rigid body that is held must not have a velocity", name or shape.name)
        body = RigidBody(
            name=self._new_name(name or shape.name), shape=shape, position=np.asarray(position, dtype=float),
            rotation=np.eye(3) if rotation is None else np.asarray(rotation, dtype=float),
            velocity=np.asarray(velocity, dtype=float), angular_velocity=np.asarray(angular_velocity, dtype=float),
            force=np.asarray(force, dtype=float), held=held,
        )
        self.rigid_bodies.append(body)
        return body

    def add_plane(
        self, *, point: Sequence[float] = (0.0, 0.0, 0.0), normal: Sequence[float] = (0.0, 0.0, 1.0), name: str = ""
    ) -> Plane:
        """Add a fixed half space whose outward normal is ``normal``."""
        direction = np.asarray(normal, dtype=float)
        length = float(np.linalg.norm(direction))
        if not length > 0.0:
            raise InputError("the normal of a plane must not be zero")
        plane = Plane(
            name=self._new_name(name or f"plane {len(self.planes)}"), point=np.asarray(point, dtype=float),
            normal=direction / length,
        )
        self.planes.append(plane)
        return plane

    def set_friction(self, a: str, b: str, coefficient: float) -> None:
        """Set Coulomb's coefficient between two bodies (or a body and a plane), by name."""
        self._require(a, b)
        if not 0.0 <= coefficient < math.inf:
            raise InputError(f"a friction coefficient must be at least 0, not {coefficient}")
        self.pair_friction[frozenset((a, b))] = float(coefficient)

    def friction_between(self, a: str, b: str) -> float:
        """Return Coulomb's coefficient of a pair."""
        return self.pair_friction.get(frozenset((a, b)), self.friction)

    def ignore(self, a: str, b: str) -> None:
        """Let two bodies (or a body and a plane) pass through each other; the same name twice: a body's own faces."""
        self._require(a, b)
        self.ignored.add(frozenset((a, b)))

    def touches(self, a: str, b: str) -> bool:
        """Tell whether two bodies can touch, or the faces of one if it is named twice."""
        return frozenset((a, b)) not in self.ignored

    @property
    def names(self) -> set[str]:
        """Names of all bodies and planes."""
        things: list[SoftBody | RigidBody | Plane] = [*self.soft_bodies, *self.rigid_bodies, *self.planes]
        return {thing.name for thing in things}

    @property
    def n_vertices(self) -> int:
        """Number of soft vertices in the scene."""
        return sum(body.mesh.n_vertices for body in self.soft_bodies)

    @property
    def motions(self) -> list[tuple[SoftBody, np.ndarray, Motion]]:
        """All drives, in the order of `State.progress`."""
        return [(body, nodes, motion) for body in self.soft_bodies for nodes, motion in body.drives]

    def _require(self, *names: str) -> None:
        for name in names:
            if name not in self.names:
                raise InputError(f"no body is called {name!r}; there are {sorted(self.names)}")

    def _new_name(self, name: str) -> str:
        if name in self.names:
            raise InputError(f"two bodies are called {name!r}")
        return name
