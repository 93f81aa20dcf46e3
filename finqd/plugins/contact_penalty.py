"""Contact model ``penalty``: C2 penalty on the signed distance, Coulomb friction with true stick."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from annotated_types import Ge, Gt, Le

from finqd.mechanics import contact_force_kernels as forces
from finqd.mechanics import contact_kernels as kernels
from finqd.mechanics.contact_pairs import ContactPairs
from finqd.mechanics.contact_rows import FrictionBounds, FrictionRows, KeyedValues, Rows
from finqd.mechanics.contact_surface import ContactSurface, Sight, contact_surface
from finqd.mechanics.mass_properties import thickness
from finqd.mechanics.near_faces_kernels import longest_move
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.reach import Reach, met_by_soft
from finqd.mechanics.rotation_kernels import inverse_left_jacobian, rotation_vector
from finqd.mechanics.rounding import rounded_field
from finqd.mechanics.soft_contact import SoftContact
from finqd.mechanics.state import Direction, State
from finqd.mechanics.system import Derivatives
from finqd.scene import Scene
from finqd.units import MM

if TYPE_CHECKING:
    from finqd.objects import GraspObject

SUPPORT_AREA = 1.0 * MM**2  # a point on which a rigid body stands is at least as stiff as this area of a soft face
SUPPORT_ALLOWANCE = 2.0  # multiples of `weight_penetration_mm` that such a point may move into a plane in one iteration
FITTING = 0.3  # [mm] spacing of samples that fits bodies of up to
THICK = 60.0 * MM  # this thickness; for thicker ones it grows with them
PLANE_CELLS = 8  # samples of that spacing along an edge of a face are no more than these if all there is are planes
SOFT_CELLS = 10  # along an edge of a face that touches other soft faces, at most: on coarse meshes contact is coarse
FACE_SHARE = 0.1  # of the size of soft faces that they keep apart from each other at most


@dataclass(frozen=True, kw_only=True)
class Penalty:
    """Penalty on the signed distance of points on soft faces, Coulomb friction with stored elastic slip.

    stiffness_N_mm3: pressure a penetration [N/mm^2 per mm]
    smoothing_mm: penetration over which the stiffness sets in
    sample_spacing_mm: largest distance of the points on soft faces that feel contact; in proportion more where the
        thinnest rigid body is thicker than 60 mm (see `thickness`), and on large faces where there are only planes
    edge_radius_mm: with which sharp edges of rigid bodies count as rounded where soft faces touch them
    friction_stiffness_ratio: tangential over normal stiffness
    step_allowance_mm: how far a point may move into a body in one Newton step
    weight_penetration_mm: how far a rigid body sinks into the floor at most on one support point under its own weight
    soft_contact: whether soft bodies touch each other and themselves
    soft_gap_mm: distance at which their faces begin to push each other apart, at most a tenth of the faces' size: a
        barrier keeps points on them from ever passing through
    soft_stiffness_N_mm3: scale of that barrier; at half the gap it presses with 0.6 of it times the gap
    """

    stiffness_N_mm3: Annotated[float, Gt(0), Le(1e6)] = 300.0
    smoothing_mm: Annotated[float, Gt(0), Le(1)] = 0.01
    sample_spacing_mm: Annotated[float, Ge(0.02), Le(20)] = 0.3
    edge_radius_mm: Annotated[float, Ge(0), Le(10)] = 0.5
    friction_stiffness_ratio: Annotated[float, Gt(0), Le(10)] = 0.5
    step_allowance_mm: Annotated[float, Gt(0), Le(10)] = 0.5
    weight_penetration_mm: Annotated[float, Gt(0), Le(1)] = 0.01
    soft_contact: bool = True
    soft_gap_mm: Annotated[float, Gt(0), Le(10)] = 0.1
    soft_stiffness_N_mm3: Annotated[float, Gt(0), Le(1e6)] = 10.0

    @property
    def effects(self) -> dict[str, str]:
        """Which effects this model leaves out."""
        if self.soft_contact:
            return {}
        off = "off: contact.soft_contact is false"
        return {"self_contact": off, "finger_to_finger_contact": off, "soft_object": f"only on the floor; {off[5:]}"}

    def potential(self, scene: Scene) -> PenaltyContact:
        """Return the potential of every pair in ``scene`` that can touch."""
        return PenaltyContact(self, scene)


class PenaltyContact:
    """Contacts of one scene with their history; see `finqd.contracts.ContactPotential`.

    Every possible contact has a *key*: soft sample and rigid body or plane, rigid support point and plane. History (the
    elastic slip, in the frame of the rigid body) is kept by key, of those that touch.
    """

    def __init__(self, options: Penalty, scene: Scene) -> None:
        self.options, self.scene = options, scene
        self.stiffness = options.stiffness_N_mm3 / MM**3
        shapes = [body.shape for body in scene.rigid_bodies]
        #: rigid bodies and planes that soft ones touch
        self.met = [r for r, body in enumerate(scene.rigid_bodies) if met_by_soft(scene, body)]
        self.planes = [p for p, plane in enumerate(scene.planes) if met_by_soft(scene, plane)]
        self.surface = self._surface([shapes[r] for r in self.met])
        touching = len(self.surface.faces) > 0
        radius = options.edge_radius_mm * MM
        self.fields = [
            rounded_field(s, radius) if touching and r in self.met else s.distance for r, s in enumerate(shapes)
        ]
        # under weightless conditions a body still must not sink into a plane: 1 g stands in for gravity
        weight = max(float(np.linalg.norm(scene.gravity)), 9.81)
        self.support_stiffness = [
            max(s.mass * weight / (options.weight_penetration_mm * MM), self.stiffness * SUPPORT_AREA) for s in shapes
        ]
        n_vertices = sum(body.mesh.n_vertices for body in scene.soft_bodies)
        self.sights = {r: Sight(self.surface, n_vertices) for r in self.met}
        self.reach = Reach(scene, self.surface.faces)
        self.soft = self._soft_contact()
        self.pairs = ContactPairs(scene, self.surface)
        self.first_key = self.pairs.first_key
        self.rows = Rows(256, self.surface.faces.shape[1])
        self.friction = FrictionRows.empty(self.surface.faces.shape[1])
        nothing = np.zeros(0, dtype=np.int64)
        self.slips = KeyedValues(keys=nothing, values=np.zeros((0, 3)))
        self.bounds = FrictionBounds()
        self.soft_forces = np.zeros(len(scene.soft_bodies))
        self.relagged_forces = self.soft_forces
        self.penetration = 0.0
        self.start: State | None = None
        self._rows_state: State | None = None

    def _surface(self, shapes: Sequence[GraspObject]) -> ContactSurface:
        """Return the soft faces with points as dense as ``shapes`` call for; the option scales them in any case."""
        share = self.options.sample_spacing_mm / FITTING
        spacing = self.options.sample_spacing_mm * MM
        if not shapes:  # planes are met by corners
            return contact_surface(self.scene.soft_bodies, spacing=spacing, most_cells=math.ceil(PLANE_CELLS / share))
        thinnest = min(thickness(s.vertices, s.triangles, s.volume) for s in shapes)
        return contact_surface(self.scene.soft_bodies, spacing=spacing * max(1.0, thinnest / THICK))

    def _soft_contact(self) -> SoftContact | None:
        """Return the contact of soft faces with each other, None if there is none."""
        options, areas = self.options, self.surface.face_area
        names = [body.name for body in self.scene.soft_bodies]
        none = all(not self.scene.touches(a, b) for i, a in enumerate(names) for b in names[i:])
        if not options.soft_contact or not len(areas) or none:
            return None
        gap = min(options.soft_gap_mm * MM, FACE_SHARE * math.sqrt(float(np.median(areas))))
        spacing = options.sample_spacing_mm * MM
        surface = contact_surface(self.scene.soft_bodies, spacing=spacing, most_cells=SOFT_CELLS, rims=True)
        ratio = options.friction_stiffness_ratio
        pressure = options.soft_stiffness_N_mm3 / MM**3
        return SoftContact(self.scene, surface, gap=gap, pressure=pressure, ratio=ratio)

    def bind(self, pattern: BlockPattern) -> None:
        """Look up where in the Hessian's blocks each face's pairs of vertices go."""
        self.pattern, self.face_slots = pattern, pattern.slots(self.surface.faces)
        if self.soft is not None:
            self.soft.bind(pattern)

    def couplings(self, state: State) -> np.ndarray:
        """Return the pairs of vertices (n, 2) that soft faces in touch couple and the pattern does not have yet."""
        if self.soft is None:
            return np.zeros((0, 2), dtype=np.int64)
        return self.soft.couplings(state.positions, self.pattern)

    def begin_step(self, state: State) -> None:
        """Take reference points and normals, and the friction bounds, from ``state``, the start of a step."""
        self.start = state
        self.bounds.begin()
        self.relag(state, whole=True)

    def relag(self, state: State, *, whole: bool = False) -> float:
        """Renew the friction bounds at ``state``; return which share of them, in sum, has changed since last time.

        ``whole``: without relaxation, so that what is left unbalanced is all that Coulomb's law leaves.
        """
        self._find(state)
        rows = self.rows
        force = rows.forces(self.options.smoothing_mm * MM)
        keys, wanted = rows.key[: rows.count].copy(), self.pairs.coefficients(rows) * force
        if self.soft is not None:
            self.soft.find(state.positions)
            keys = np.concatenate([keys, self.soft.keys + self.first_key["soft", 0]])
            wanted = np.concatenate([wanted, self.soft.bounds()])
        change = self.bounds.renew(keys, wanted, whole=whole)
        self.relagged_forces = self._forces_by_body(force, all_of_them=True)
        bound, slips = self.bounds.values.at(keys), self.slips.at(keys)
        self.friction = rows.friction(
            state=state, start=self.start, faces=self.surface.faces, bound=bound[: rows.count],
            slip=slips[: rows.count], ratio=self.options.friction_stiffness_ratio,
        )
        if self.soft is not None:
            self.soft.lag(self.start, bound=bound[rows.count :], slips=slips[rows.count :])
        return change

    def energy(self, state: State) -> float:
        """Return contact and friction energy [J]."""
        self._find(state)
        smoothing = self.options.smoothing_mm * MM
        rows, friction = self.rows, self.friction
        energy = forces.normal_contacts_energy(rows.gap, rows.stiffness, smoothing, rows.count)
        slips = self._trial_slips(state)
        energy += forces.friction_energy(slips, friction.bound, friction.stiffness, len(slips))
        return energy if self.soft is None else energy + self.soft.energy(state.positions)

    def add_gradient(self, state: State, derivatives: Derivatives) -> float:
        """Add the gradient, return the energy [J]; friction at the lagged bounds."""
        energy, slips = self._add(state, derivatives, gradient=True)
        energy += forces.friction_energy(slips, self.friction.bound, self.friction.stiffness, len(slips))
        return energy if self.soft is None else energy + self.soft.add_gradient(state.positions, derivatives.soft)

    def add_hessian(self, state: State, derivatives: Derivatives, *, projected: bool = False) -> None:
        """Add the Hessian; ``projected``: a semidefinite one, exact for friction, Gauss-Newton for the penalty."""
        self._add(state, derivatives, gradient=False, exact=not projected)
        if self.soft is not None:
            self.soft.add_hessian(state.positions, derivatives, projected=projected)

    def _add(
        self, state: State, d: Derivatives, *, gradient: bool, exact: bool = False
    ) -> tuple[float, np.ndarray]:
        self._find(state)
        rows, f = self.rows, self.friction
        if exact:
            rows.curve[: rows.count] = 0.0  # planes have none
            for r, field in enumerate(self.fields):
                kernels.find_curvatures(
                    field, np.ascontiguousarray(state.rigid_rotations[r]), r, rows.rigid, rows.turns, rows.gap,
                    rows.normal, rows.arm, rows.curve, rows.count,
                )
        out = (d.soft, d.rigid, d.blocks, d.coupling, d.rigid_matrix, gradient, not gradient)
        energy = forces.add_normal(
            self.surface.faces, self.face_slots, rows.face, rows.weight, rows.gap, rows.normal, rows.arm,
            rows.stiffness, rows.rigid, rows.turns, rows.curve, rows.count, self.options.smoothing_mm * MM, *out, exact,
        )
        slips = self._trial_slips(state)
        forces.add_friction(
            self.surface.faces, self.face_slots, f.face, f.weight, slips, f.bound, f.stiffness, f.normal, f.start_arm,
            f.rigid, self._turn_jacobians(state), len(slips), *out,
        )
        return energy, slips

    def step_limit(self, state: State, direction: Direction) -> float:
        """Return the largest share (0, 1] of ``direction`` in which no point sinks too far into anything."""
        allowance, limit = self.options.step_allowance_mm * MM, 1.0
        hard = SUPPORT_ALLOWANCE * self.options.weight_penetration_mm * MM
        farthest = longest_move(direction.soft, 0, len(direction.soft))
        ways = []  # that any point of a rigid body goes at most
        for r, body in enumerate(self.scene.rigid_bodies):
            shift, turn = np.linalg.norm(direction.rigid[r, :3]), np.linalg.norm(direction.rigid[r, 3:])
            ways.append(shift + turn * body.shape.bounding_radius)
            if r not in self.met or farthest + ways[r] <= allowance:
                continue
            limit = min(
                limit,
                kernels.soft_step_limit(
                    state.positions, direction.soft, *self.surface.lattices, *_pose(state, r), self.fields[r],
                    float(body.shape.bounding_radius), direction.rigid[r, :3], direction.rigid[r, 3:], allowance,
                ),
            )
        for p, plane in enumerate(self.scene.planes):
            if p in self.planes and not farthest <= allowance:  # takes a NaN too
                heights = (state.positions - plane.point) @ plane.normal
                limit = min(limit, kernels.plane_step_limit(heights, -direction.soft @ plane.normal, allowance))
            for r, body in enumerate(self.scene.rigid_bodies):
                if ways[r] <= hard or not self.scene.touches(body.name, plane.name):
                    continue
                arms = _support_arms(body.shape, state.rigid_rotations[r], plane.normal)
                moves = direction.rigid[r, :3] + np.cross(direction.rigid[r, 3:], arms)
                heights = (state.rigid_positions[r] + arms - plane.point) @ plane.normal
                limit = min(limit, kernels.plane_step_limit(heights, -moves @ plane.normal, hard))
        return limit if self.soft is None else self.soft.step_limit(state, direction, limit)

    def commit(self, state: State) -> None:
        """Accept ``state``: return mapping of the elastic slip; forces and penetration for the outside."""
        friction = self.friction
        slips = self._trial_slips(state)
        forces.return_mapping(slips, friction.bound, friction.stiffness, len(slips))
        for r in range(len(self.scene.rigid_bodies)):
            mine = friction.rigid == r
            slips[mine] = slips[mine] @ state.rigid_rotations[r]
        self.slips = KeyedValues.of(friction.key, slips)
        if self.soft is not None:
            soft = self.soft.mapped_slips(state.positions)
            keys = np.concatenate([friction.key, soft.keys + self.first_key["soft", 0]])
            self.slips = KeyedValues.of(keys, np.concatenate([slips, soft.values]))
            self.soft.find(state.positions)
        self._find(state)
        rows = self.rows
        self.soft_forces = self._forces_by_body(rows.forces(self.options.smoothing_mm * MM))
        self.penetration = float(np.max(-rows.gap[: rows.count], initial=0.0))
        self.reach.look(state, self.soft)

    def history(self) -> dict[str, np.ndarray]:
        """Return what later steps depend on: elastic slips by key, forces and penetration of the last commit."""
        return {
            "slip_keys": self.slips.keys, "slips": self.slips.values, "soft_forces": self.soft_forces,
            "penetration": np.array(self.penetration),
            "coupled": np.zeros(0, dtype=np.int64) if self.soft is None else self.soft.coupled,
            "met": self.reach.times.copy(),
        }

    def met_pairs(self) -> dict[tuple[str, str], float]:
        """Return when bodies first came within reach of each other [s], by their names."""
        return self.reach.met()

    def restore(self, history: dict[str, np.ndarray]) -> None:
        """Go on with a `history`."""
        self.slips = KeyedValues(keys=history["slip_keys"], values=history["slips"])
        self.soft_forces, self.penetration = history["soft_forces"], float(history["penetration"])
        self.reach.times = history["met"].copy()
        if self.soft is not None:
            self.soft.restore(history["coupled"], self.pattern)

    def _forces_by_body(self, force: np.ndarray, *, all_of_them: bool = False) -> np.ndarray:
        """Return the summed normal force on each soft body [N], from that of each row, and of soft contacts.

        What a body's own faces do to each other is left out, unless ``all_of_them`` is wanted.
        """
        face = self.rows.face[: self.rows.count]
        soft = face >= 0
        bodies = self.surface.face_body[face[soft]]
        n = len(self.scene.soft_bodies)
        found = np.bincount(bodies, force[soft], minlength=n).astype(float)
        if self.soft is not None and self.soft.rows.count:
            one, other = self.soft.bodies()
            force = np.where((one != other) | all_of_them, self.soft.forces(), 0.0)
            found += np.bincount(one, force, minlength=n) + np.bincount(other, force, minlength=n)
        return found

    def _trial_slips(self, state: State) -> np.ndarray:
        f, start = self.friction, self.start
        slips = np.empty((len(f.key), 3))
        shift = state.rigid_positions - start.rigid_positions
        forces.elastic_slips(
            state.positions, shift, self._turns(state), self.surface.faces, f.face, f.weight, f.start_point,
            f.start_arm, f.start_slip, f.normal, f.rigid, len(slips), slips,
        )
        return slips

    def _turns(self, state: State) -> np.ndarray:
        turns = np.zeros((len(self.scene.rigid_bodies), 3))
        for r, (now, then) in enumerate(zip(state.rigid_rotations, self.start.rigid_rotations, strict=True)):
            turns[r] = rotation_vector(now @ then.T)
        return turns

    def _turn_jacobians(self, state: State) -> np.ndarray:
        jacobians = np.zeros((len(self.scene.rigid_bodies), 3, 3))
        for r, turn in enumerate(self._turns(state)):
            jacobians[r] = inverse_left_jacobian(turn)
        return jacobians

    def _find(self, state: State) -> None:
        """Fill `rows` with all contacts at ``state``, unless they are there already."""
        at = self._rows_state
        if at is state or (
            at is not None and at.positions is state.positions and at.rigid_positions is state.rigid_positions
            and at.rigid_rotations is state.rigid_rotations
        ):
            return
        while True:
            count = self._fill(state)
            if count <= self.rows.capacity:
                break
            self.rows = Rows(2 * count, self.surface.faces.shape[1])
        self.rows.count, self._rows_state = count, state

    def _fill(self, state: State) -> int:
        """Write as many contacts at ``state`` to `rows` as there is room for; return how many there are."""
        rows, surface, scene = self.rows, self.surface, self.scene
        samples = (*surface.arrays, self.stiffness)
        count = 0
        for r, body in enumerate(scene.rigid_bodies):
            pose = _pose(state, r)
            if r in self.met and self.reach.any_near_rigid(state, r):
                count = kernels.find_soft_rigid(
                    state.positions, *samples, *pose, self.fields[r], float(body.shape.bounding_radius),
                    *self.sights[r].arrays, r, self.first_key["rigid", r], *rows.arrays, count,
                )
            for p, plane in enumerate(scene.planes):
                if not scene.touches(body.name, plane.name):
                    continue
                count = kernels.find_rigid_plane(
                    body.shape.support_points, float(body.shape.ball_radius), *pose, plane.point, plane.normal,
                    self.support_stiffness[r], r, self.first_key["support", r, p], *rows.arrays, count,
                )
        for p in self.planes:
            plane = scene.planes[p]
            count = kernels.find_soft_plane(
                state.positions, *samples, plane.point, plane.normal, self.first_key["plane", p], *rows.arrays, count,
            )
        return count


def _pose(state: State, r: int) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and rotation of a rigid body as kernels take them."""
    return np.ascontiguousarray(state.rigid_positions[r]), np.ascontiguousarray(state.rigid_rotations[r])


def _support_arms(shape: object, rotation: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the points of a rigid body that can touch a plane, relative to its centre of mass [m], shape (n, 3)."""
    if shape.ball_radius > 0.0:
        return -shape.ball_radius * normal[None, :]
    return shape.support_points @ rotation.T
