"""Contact model ``ipc``: incremental potential contact, where nothing ever passes through anything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import numpy as np
from annotated_types import Gt, Le

from finqd.errors import InputError
from finqd.mechanics.contact_rows import FrictionBounds
from finqd.mechanics.ipc_barrier import HALF_GAP, PlaneBarrier, PlaneContacts
from finqd.mechanics.ipc_friction import ContactRows, Friction
from finqd.mechanics.ipc_motion import KEPT, NEAR, Motion
from finqd.mechanics.ipc_pairs import PairBarrier
from finqd.mechanics.ipc_points import BlockSlots, Points
from finqd.mechanics.ipc_surface import IpcSurface
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.state import Direction, State
from finqd.mechanics.system import Derivatives
from finqd.scene import Scene
from finqd.units import MM

SUPPORT = 5.0  # [N] that one contact of rigid bodies or planes holds at half the gap at least: grasps press on floors
HALVINGS = 40  # of the way of bodies that turn, until it counts as blocked
SHORTEST = 1e-12  # share of a direction that is always left: what goes nowhere fails in the line search


@dataclass(frozen=True, kw_only=True)
class Ipc:
    """Incremental potential contact: a barrier between all surfaces, which never intersect; smooth Coulomb friction.

    Slower than ``penalty``, with a guarantee, and with contact of soft bodies with themselves and each other. Surfaces
    are triangles between the nodes of the meshes, without rounded edges. Bodies stay apart: what carries load keeps a
    gap between 0 and ``gap_mm``, and what starts nearer than that is pushed apart. Planes are the exception: there the
    gap is measured from ``gap_mm`` below the surface, as bodies start on it, and what they sink in is `penetration`.
    Parts of one soft body that are nearer than ``gap_mm`` at rest (thin notches) do not feel each other, ever.

    Static friction needs some slip, up to ``slip_mm`` a step, so a static hold creeps: by less than 1 - sqrt(1 - f) of
    that a step, f being the share of Coulomb's bound that is called for. A length, so that it needs no time step.

    gap_mm: distance at which surfaces begin to push each other
    half_gap_pressure_kPa: with which they do at half of it; ten times that is reached at about a twentieth
    slip_mm: in a step, above which friction is full

    Source: Li et al., Incremental Potential Contact, ACM Trans. Graph. 39 (2020) 49; computed by the IPC Toolkit.
    """

    effects: ClassVar[Mapping[str, str]] = {
        "self_contact": "on: the contact ipc",
        "finger_to_finger_contact": "on: the contact ipc",
    }

    gap_mm: Annotated[float, Gt(0), Le(10)] = 0.1
    half_gap_pressure_kPa: Annotated[float, Gt(0), Le(1e6)] = 100.0
    slip_mm: Annotated[float, Gt(0), Le(1)] = 1e-3

    def potential(self, scene: Scene) -> IpcContact:
        """Return the potential of every pair in ``scene`` that can touch.

        Raises InputError if two bodies intersect at the start, and for bodies that are to pass through each other,
        MissingLibraryError without the package ipctk.
        """
        if scene.ignored:
            names = " and ".join(sorted(min(sorted(pair) for pair in scene.ignored)))
            raise InputError("nothing passes through anything with the contact ipc", names)
        return IpcContact(self, scene)


@dataclass(kw_only=True)
class _Situation:
    """All contacts at one state.

    places: of all points [m], (n_points, 3); vertices: those of the surface, (n_vertices, 3)
    pairs: `ipctk.NormalCollisions`, None where the way here is not free; planes: contacts with planes
    energy: of all barriers [J], inf if something intersects; least: no more than the smallest distance of pairs [m]
    gradient: of the barriers [N], (n_points, 3); rows: with normal forces; both None before they are asked for
    second: pairs of points and second derivatives of the barriers, of which projected or not was asked for
    """

    state: State
    places: np.ndarray
    vertices: np.ndarray
    pairs: Any
    planes: PlaneContacts
    energy: float = np.inf
    least: float = 0.0
    gradient: np.ndarray | None = None
    rows: ContactRows | None = None
    second: dict[bool, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    def is_of(self, state: State) -> bool:
        """Tell whether these are the contacts at ``state``: arrays of states are never written to."""
        own = self.state
        return (
            own.positions is state.positions and own.rigid_positions is state.rigid_positions
            and own.rigid_rotations is state.rigid_rotations
        )


class IpcContact:
    """Contacts of one scene; see `finqd.contracts.ContactPotential`.

    Whether a state intersects cannot be seen from distances, which have no sign. So each new one must be reached on
    straight ways from one that is known to be free: from which a step was limited last, or friction renewed.
    """

    def __init__(self, options: Ipc, scene: Scene) -> None:
        self.options, self.scene = options, scene
        self.gap, self.slip = options.gap_mm * MM, options.slip_mm * MM
        half = options.half_gap_pressure_kPa * 1e3
        self.surface = IpcSurface(scene, gap=self.gap)
        self.points = self.surface.points
        self.motion = Motion(self.surface, gap=self.gap)
        # the area that holds a rigid body at half the gap; under weightless conditions 1 g stands in for gravity
        weight = max(float(np.linalg.norm(scene.gravity)), 9.81)
        own = [0.0 if body.held else max(body.shape.mass * weight, SUPPORT) / half for body in scene.rigid_bodies]
        supports = np.array([0.0] * len(scene.soft_bodies) + own)
        self.pairs = PairBarrier(
            self.surface, self.motion, gap=self.gap, pressure=half / HALF_GAP, supports=supports
        )
        self.planes = self._plane_barrier(supports, half / HALF_GAP)
        names = [body.name for body in (*scene.soft_bodies, *scene.rigid_bodies, *scene.planes)]
        self.names = names
        self.coefficients = np.array([[scene.friction_between(a, b) for b in names] for a in names]).reshape(
            len(names), len(names)
        )
        self.soft_forces = np.zeros(len(scene.soft_bodies))
        self.relagged_forces = np.zeros(len(scene.soft_bodies))
        self.penetration = 0.0
        self.start: State | None = None  # of the step
        self.friction: Friction | None = None
        self.lowest = _NOWHERE  # where balls touched planes when friction was renewed
        self.riders = self.points  # these and after them the lowest ones
        self.bounds = FrictionBounds()  # by the points that take part in it
        self._now: _Situation | None = None
        self._free: list[_Situation] = []  # of this step, known to be free, the last one last
        self._refuse_intersections()

    def _plane_barrier(self, supports: np.ndarray, pressure: float) -> PlaneBarrier:
        """Return the planes, with all points that may meet them: the vertices, a ball's centre instead of its own."""
        surface, points = self.surface, self.points
        balls = np.array([body.shape.ball_radius for body in self.scene.rigid_bodies])
        radii = np.append(balls, 0.0)[points.rigid]  # -1, of soft vertices, leads to the last one
        centre = np.arange(len(points.soft)) >= surface.n_vertices
        which = np.flatnonzero(~surface.held & (centre | (radii == 0.0)))
        areas = np.maximum(surface.areas, supports[surface.body]) if len(supports) else surface.areas
        return PlaneBarrier(
            self.scene.planes, which=which, radii=radii[which], areas=areas, gap=self.gap, pressure=pressure
        )

    def bind(self, pattern: BlockPattern) -> None:
        """Look up where in the Hessian's blocks pairs of vertices go."""
        self.slots = BlockSlots(pattern.indptr, pattern.indices)

    def begin_step(self, state: State) -> None:
        """Start from ``state`` with the friction bounds of its contacts; nothing depends on earlier steps."""
        known = self._known(state)
        free = known is not None and bool(np.isfinite(known.energy))
        self.motion.forget()
        self._free, self._now = [], None
        self.friction = None
        places = self.points.at(state)
        self._now = self._situation(state, places, free=free or self._intersecting(state) is None)
        self._keep(self._now)
        self.start = state
        self.bounds.begin()
        self.relag(state, whole=True)

    def relag(self, state: State, *, whole: bool = False) -> float:
        """Renew the friction bounds at ``state``; return which share of them, in sum over points, has changed.

        How contacts are parted into pairs changes as they slide; what each point bears does not. ``whole``: without
        relaxation.
        """
        now = self._keep(self._at(state))
        rows = self._rows(now)
        bound = self.coefficients[tuple(rows.bodies.T)] * rows.force
        wanted = rows.shares(bound, len(self.points.soft))
        everyone = np.arange(len(wanted))
        change = self.bounds.renew(everyone, wanted, whole=whole)
        self.relagged_forces = self._forces_by_body(rows)
        taken = np.divide(self.bounds.values.at(everyone), wanted, out=np.ones_like(wanted), where=wanted > 0.0)
        self._renew_friction(state, rows, bound * rows.mean(taken))
        return change

    def energy(self, state: State) -> float:
        """Return contact and friction energy [J], inf where something intersects or may have passed through."""
        now = self._at(state)
        return now.energy + self.friction.energy(self._riding(now)) if self.friction is not None else now.energy

    def add_gradient(self, state: State, derivatives: Derivatives) -> float:
        """Add the gradient, return the energy [J]; friction at the lagged bounds."""
        now = self._at(state)
        if np.isfinite(now.energy):
            self.riders.add_gradient(state, self._gradient(now), derivatives)
        return self.energy(state)

    def add_hessian(self, state: State, derivatives: Derivatives, *, projected: bool = False) -> None:
        """Add the Hessian; ``projected``: each pair's is made semidefinite, and turns count to first order."""
        now = self._at(state)
        if not np.isfinite(now.energy):
            return
        pairs, blocks = self._second_derivatives(now, projected=projected)
        self.riders.add_hessian(state, pairs, blocks, self.slots, derivatives)
        if not projected:
            self.riders.add_curvature(state, self._gradient(now), derivatives)

    def couplings(self, state: State) -> np.ndarray:
        """Return the pairs of vertices, (n, 2), that the Hessian lacks at ``state``; with them those that are near."""
        now = self._at(state)
        if not np.isfinite(now.energy) or not len(self._lacking(self._second_derivatives(now, projected=False)[0])):
            return np.zeros((0, 2), dtype=np.int64)
        near = self.pairs.near_vertices(now.vertices, NEAR * self.gap)
        return self._lacking(np.concatenate([self._second_derivatives(now, projected=False)[0], near]))

    def step_limit(self, state: State, direction: Direction) -> float:
        """Return the share (0, 1] of ``direction`` up to which nothing meets: a tenth of each distance is left."""
        now = self._keep(self._at(state))
        if not np.isfinite(now.energy):
            return 1.0
        places = self.points.at(state.moved(direction))
        limit = self.planes.limit(now.places, places, 1.0 - KEPT)
        limit = min(limit, self.motion.limit(now.vertices, self._vertices(places), now.least))
        turning = direction.rigid[:, 3:].any()
        for _ in range(HALVINGS if turning else 0):  # points of bodies that turn are on arcs, not on straight ways
            places = self.points.at(state.moved(direction, limit))
            if self.planes.is_free(places) and self.motion.is_free(now.vertices, self._vertices(places), now.least):
                break
            limit *= 0.5
        return max(limit, SHORTEST)

    def commit(self, state: State) -> None:
        """Accept ``state``: normal forces, and how deep planes are entered, for the outside."""
        now = self._at(state)
        self.soft_forces = self._forces_by_body(self._rows(now))
        self.penetration = float(np.max(now.planes.depth, initial=0.0))

    def history(self) -> dict[str, np.ndarray]:
        """Return forces and penetration of the last commit: friction keeps nothing from step to step."""
        return {"soft_forces": self.soft_forces, "penetration": np.array(self.penetration)}

    def restore(self, history: dict[str, np.ndarray]) -> None:
        """Go on with a `history`."""
        self.soft_forces, self.penetration = history["soft_forces"], float(history["penetration"])

    def _vertices(self, places: np.ndarray) -> np.ndarray:
        return np.asfortranarray(places[: self.surface.n_vertices])

    def _known(self, state: State) -> _Situation | None:
        """Return the contacts at ``state`` if they have been found already."""
        return next((one for one in (self._now, *self._free) if one is not None and one.is_of(state)), None)

    def _at(self, state: State) -> _Situation:
        """Return the contacts at ``state``."""
        known = self._known(state)
        if known is None:
            places = self.points.at(state)
            known = self._situation(state, places, free=self._is_reached(state, places))
        self._now = known
        return known

    def _keep(self, now: _Situation) -> _Situation:
        """Let ways to the states that follow begin at ``now``."""
        if np.isfinite(now.energy):
            self._free = [*(one for one in self._free if one is not now), now]
        return now

    def _is_reached(self, state: State, places: np.ndarray) -> bool:
        """Tell whether there is a way to ``state`` on which nothing meets, from where the last ways began or ended."""
        if not self._free:
            return self._intersecting(state) is None
        vertices = self._vertices(places)
        origins = [self._free[-1]]
        if self._now is not None and self._now is not origins[0] and np.isfinite(self._now.energy):
            origins.append(self._now)
        return any(self.motion.is_free(one.vertices, vertices, one.least) for one in origins)

    def _situation(self, state: State, places: np.ndarray, *, free: bool) -> _Situation:
        """Find the contacts at ``state``, where points are at ``places``; not ``free``: something intersects."""
        vertices, planes = self._vertices(places), self.planes.contacts(places)
        now = _Situation(state=state, places=places, vertices=vertices, pairs=None, planes=planes)
        if free and np.isfinite(planes.energy):
            now.pairs = self.pairs.at(vertices)
            now.energy = planes.energy + self.pairs.energy(now.pairs, vertices)
            now.least = self.pairs.least(now.pairs, vertices)
        return now

    def _rows(self, now: _Situation) -> ContactRows:
        """Return all contacts with their normal forces."""
        if now.rows is not None:
            return now.rows
        if not np.isfinite(now.energy):
            return ContactRows.empty()
        planes, first = now.planes, len(self.scene.soft_bodies) + len(self.scene.rigid_bodies)
        one = np.arange(4) == 0
        on_planes = ContactRows(
            points=planes.point[:, None] * one, weights=np.ones((len(planes.point), 1)) * one, normal=planes.normal,
            force=planes.force, bodies=np.stack([self.surface.body[planes.point], first + planes.plane], axis=1),
        )
        now.rows = self.pairs.rows(now.pairs, now.vertices).joined(on_planes)
        return now.rows

    def _renew_friction(self, state: State, rows: ContactRows, bound: np.ndarray) -> None:
        """Make friction of ``rows`` at ``state`` with bounds mu N [N]; a ball's on a plane is at its lowest point."""
        first = rows.points[:, 0]
        balls = np.flatnonzero((first >= self.surface.n_vertices) & (bound > 0.0))
        bodies = self.points.rigid[first[balls]]
        radii = np.array([self.scene.rigid_bodies[r].shape.ball_radius for r in bodies])
        arms = np.einsum("nij,ni->nj", state.rigid_rotations[bodies], -radii[:, None] * rows.normal[balls])
        self.lowest = _NOWHERE.with_rigid(bodies, arms)
        self.riders = self.points.with_rigid(bodies, arms)
        points = rows.points.copy()
        points[balls, 0] = len(self.points.soft) + np.arange(len(balls))
        self.friction = Friction(
            replace(rows, points=points), bound, start=self.riders.at(self.start), slip=self.slip
        )

    def _riding(self, now: _Situation) -> np.ndarray:
        """Return where the points are that friction acts on [m], (n_riders, 3): all, and where balls touch planes."""
        return np.concatenate([now.places, self.lowest.at(now.state)])

    def _gradient(self, now: _Situation) -> np.ndarray:
        """Return the derivatives of all energies to all points [N], shape (n_riders, 3)."""
        if now.gradient is None:
            now.gradient = np.zeros_like(now.places)
            now.gradient[: len(now.vertices)] = self.pairs.gradient(now.pairs, now.vertices)
            np.add.at(now.gradient, now.planes.point, -now.planes.force[:, None] * now.planes.normal)
        gradient = np.zeros((len(self.riders.soft), 3))
        gradient[: len(now.gradient)] = now.gradient
        return gradient + self.friction.gradient(self._riding(now)) if self.friction is not None else gradient

    def _second_derivatives(self, now: _Situation, *, projected: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs of points (k, 2), both ways, and all second derivatives (k, 3, 3) [N/m]."""
        if projected not in now.second:
            pairs, blocks = self.pairs.hessian(now.pairs, now.vertices, projected=projected)
            planes = now.planes
            stiff = planes.stiffness[:, None, None] * planes.normal[:, :, None] * planes.normal[:, None, :]
            pairs = np.concatenate([pairs, np.stack([planes.point, planes.point], axis=1)])
            now.second[projected] = pairs, np.concatenate([blocks, stiff])
        pairs, blocks = now.second[projected]
        if self.friction is None:
            return pairs, blocks
        more, others = self.friction.hessian(self._riding(now))
        return np.concatenate([pairs, more]), np.concatenate([blocks, others])

    def _lacking(self, pairs: np.ndarray) -> np.ndarray:
        """Return the pairs of soft vertices among ``pairs`` of points (k, 2) that have no block, each once, (n, 2)."""
        soft = self.riders.soft[pairs]
        soft = np.unique(soft[(soft[:, 0] >= 0) & (soft[:, 0] < soft[:, 1])], axis=0)
        return soft[self.slots.lacks(*soft.T)]

    def _forces_by_body(self, rows: ContactRows) -> np.ndarray:
        """Return the summed normal force on each soft body [N]; what it does to itself does not count."""
        apart = rows.bodies[:, 0] != rows.bodies[:, 1]
        both = np.concatenate([rows.bodies[apart, 0], rows.bodies[apart, 1]])
        n_soft = len(self.scene.soft_bodies)
        return np.bincount(both, np.tile(rows.force[apart], 2), minlength=len(self.names))[:n_soft].astype(float)

    def _intersecting(self, state: State) -> tuple[int, int] | None:
        """Return the numbers of two bodies that intersect or touch at ``state``, None if there are none."""
        places = self.points.at(state)
        for number, plane in enumerate(self.scene.planes):
            heights = self.planes.heights(places, plane)
            if np.any(heights <= -self.gap):
                point = self.planes.which[np.argmin(heights)]
                return int(self.surface.body[point]), len(self.names) - len(self.scene.planes) + number
        return self.pairs.crossing(self._vertices(places))

    def _refuse_intersections(self) -> None:
        """Raise InputError if the scene starts with bodies in each other: a barrier only keeps apart what is apart."""
        found = self._intersecting(_start(self.scene))
        if found is not None:
            one, other = (self.names[number] for number in found)
            what = f"{one!r} and {other!r} intersect" if one != other else f"{one!r} intersects itself"
            raise InputError(f"{what} (or touch) at the start: the contact ipc needs them apart")


_NOWHERE = Points(soft=np.zeros(0, dtype=np.int64), rigid=np.zeros(0, dtype=np.int64), arms=np.zeros((0, 3)))


def _start(scene: Scene) -> State:
    """Return where the bodies of ``scene`` start; no more than positions counts."""
    soft, rigid = scene.soft_bodies, scene.rigid_bodies
    still = np.zeros((len(rigid), 3))
    positions = np.concatenate([np.zeros((0, 3)), *(body.start_positions for body in soft)])
    return State(
        time=0.0, positions=positions, velocities=np.zeros_like(positions), angular_momenta=still,
        rigid_positions=np.array([body.position for body in rigid]).reshape(-1, 3), rigid_velocities=still,
        rigid_rotations=np.array([body.rotation for body in rigid]).reshape(-1, 3, 3), progress=np.zeros(0),
    )
