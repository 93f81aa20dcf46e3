"""Contact model ``penalty``: C2 penalty on the signed distance, Coulomb friction with true stick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Gt, Le

from finqd.mechanics import contact_feature_kernels as features
from finqd.mechanics import contact_force_kernels as forces
from finqd.mechanics import contact_kernels as kernels
from finqd.mechanics.contact_rows import FeaturePlanes, FrictionRows, Rows
from finqd.mechanics.contact_surface import contact_surface
from finqd.mechanics.distance_kernels import signed_distances
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.rotation_kernels import inverse_left_jacobian, rotation_vector
from finqd.mechanics.state import Direction, State
from finqd.mechanics.system import Derivatives
from finqd.scene import Scene
from finqd.units import MM

FEATURE_WIDTH = 1.0 * MM  # a sharp edge is as stiff as a strip of this width on the face it presses into
CORNER_LENGTH = 1.0 * MM  # and a corner as this length of edge
SHARE_RATE = 0.3  # share of the way to its new value that a feature's share of its stiffness goes in a step
FEATURE_REACH = 4.0 * MM  # candidates (feature, triangle) are looked up again before anything has moved this far
FEATURE_MARGIN = 1.0 * MM  # features within this distance of a soft face get its tangent plane at the start of a step
FEATURE_NEAR = 1.0 * MM  # and in a dent those of other triangles this near
PLANES = 8  # planes a feature has at most, on the average
LEAST_SHARE = 0.4  # of the way to their new values that friction bounds go at least in a renewal
FEATURE_DEPTH = 1.5 * MM  # features deeper than this inside a wall belong to its other side


@dataclass(frozen=True, kw_only=True)
class Penalty:
    """Penalty on the signed distance of soft faces and of sharp features, Coulomb friction with stored elastic slip.

    stiffness_N_mm3: pressure a penetration [N/mm^2 per mm]
    smoothing_mm: penetration over which the stiffness sets in
    sample_spacing_mm: largest distance of the points on soft faces that feel contact
    friction_stiffness_ratio: tangential over normal stiffness
    step_allowance_mm: how far a point may move into a body in one Newton step
    slide_limit_mm: how far an edge or corner may slide over a soft face in one step
    weight_penetration_mm: how far a rigid body sinks into the floor at most on one support point under its own weight
    """

    stiffness_N_mm3: Annotated[float, Gt(0), Le(1e6)] = 300.0
    smoothing_mm: Annotated[float, Gt(0), Le(1)] = 0.01
    sample_spacing_mm: Annotated[float, Gt(0), Le(20)] = 1.5
    friction_stiffness_ratio: Annotated[float, Gt(0), Le(10)] = 0.5
    step_allowance_mm: Annotated[float, Gt(0), Le(10)] = 0.5
    slide_limit_mm: Annotated[float, Gt(0), Le(100)] = 0.5
    weight_penetration_mm: Annotated[float, Gt(0), Le(1)] = 0.01

    def potential(self, scene: Scene) -> PenaltyContact:
        """Return the potential of every pair in ``scene`` that can touch."""
        return PenaltyContact(self, scene)


class PenaltyContact:
    """Contacts of one scene with their history; see `finqd.contracts.ContactPotential`.

    Every possible contact has a *key*: soft sample and rigid body or plane, rigid feature and soft body, rigid support
    point and plane. History (the elastic slip, in the frame of the rigid body) is kept by key.
    """

    def __init__(self, options: Penalty, scene: Scene) -> None:
        self.options, self.scene = options, scene
        self.surface = contact_surface(scene.soft_bodies, spacing=options.sample_spacing_mm * MM)
        stiffness = options.stiffness_N_mm3 / MM**3
        self.sample_stiffness = stiffness * self.surface.sample_area
        shapes = [body.shape for body in scene.rigid_bodies]
        self.feature_stiffness = [
            stiffness * FEATURE_WIDTH * np.where(s.feature_lengths > 0.0, s.feature_lengths, CORNER_LENGTH)
            for s in shapes
        ]
        self.feature_normals = [_outward(s) for s in shapes]
        # under weightless conditions a body still must not sink into a plane: 1 g stands in for gravity
        weight = max(float(np.linalg.norm(scene.gravity)), 9.81)
        self.support_stiffness = [
            max(s.mass * weight / (options.weight_penetration_mm * MM), stiffness * FEATURE_WIDTH * CORNER_LENGTH)
            for s in shapes
        ]
        self.boxes = [_box(shape) for shape in shapes]
        self._lay_out_keys()
        self.rows = Rows(self.n_keys, self.surface.faces.shape[1])
        self.friction = FrictionRows.empty(self.surface.faces.shape[1])
        self.slips = np.zeros((self.n_keys, 3))
        self.bounds = np.zeros(self.n_keys)  # lagged mu N of each key [N]
        self.facing = np.zeros((len(self.surface.faces), 3))  # unit normals of the faces at the start of the step
        self.facing_bodies: list[np.ndarray] = []  # the same in the frame of each rigid body
        self.shares = self.fresh_shares = np.full(self.n_keys, np.nan)
        self.planes: list[list[FeaturePlanes]] = []
        self.soft_forces = np.zeros(len(scene.soft_bodies))
        self.relagged_forces = self.soft_forces
        self.penetration = 0.0
        self.start: State | None = None
        self._missing: np.ndarray | None = None  # what the last renewal of this step found missing in the bounds [N]
        self._share = 1.0  # of which it took that share
        self.last_rows_state: State | None = None
        self._pairs: list[np.ndarray] = []
        self._kept: list[list[np.ndarray]] = []
        self._pairs_state: State | None = None

    def _lay_out_keys(self) -> None:
        scene, n = self.scene, len(self.surface.sample_face)
        body_names = [scene.soft_bodies[b].name for b in self.surface.sample_body]
        self.first_key: dict[tuple, int] = {}
        friction: list[np.ndarray] = []
        count = 0

        def reserve(pair: tuple, coefficients: np.ndarray) -> None:
            nonlocal count
            self.first_key[pair] = count
            friction.append(coefficients)
            count += len(coefficients)

        for kind, others in (("rigid", scene.rigid_bodies), ("plane", scene.planes)):
            for i, other in enumerate(others):
                by_body = {b.name: scene.friction_between(b.name, other.name) for b in scene.soft_bodies}
                reserve((kind, i), np.array([by_body[name] for name in body_names]))
        for r, rigid in enumerate(scene.rigid_bodies):
            for b, soft in enumerate(scene.soft_bodies):
                mu = scene.friction_between(rigid.name, soft.name)
                reserve(("feature", r, b), np.full(len(rigid.shape.feature_points), mu))
            for p, plane in enumerate(scene.planes):
                mu = scene.friction_between(rigid.name, plane.name)
                reserve(("support", r, p), np.full(max(len(rigid.shape.support_points), 1), mu))
        self.n_keys, self.n_samples = count, n
        self.coefficients = np.concatenate(friction) if friction else np.zeros(0)

    def bind(self, pattern: BlockPattern) -> None:
        """Look up where in the Hessian's blocks each face's pairs of vertices go."""
        self.face_slots = pattern.slots(self.surface.faces)

    def begin_step(self, state: State) -> None:
        """Take reference points and normals, and the friction bounds, from ``state``, the start of a step."""
        self.start = state
        # how far contacts look at each other is fixed for a step: a dent turns them, and they would flicker
        self.fresh_shares = np.full(self.n_keys, np.nan)
        self._forget_dents()
        kernels.face_normals(state.positions, self.surface.faces, self.surface.face_corners, self.facing)
        self.facing_bodies = [self.facing @ rotation for rotation in state.rigid_rotations]
        self._missing = None
        self.relag(state, whole=True)

    def relag(self, state: State, *, whole: bool = False) -> float:
        """Renew the friction bounds at ``state``; return which share of them, in sum, has changed since last time.

        ``whole``: without relaxation, so that what is left unbalanced is all that Coulomb's law leaves.
        """
        self._hold_geometry(state)
        self._find(state)
        bounds = np.zeros(self.n_keys)
        rows = self.rows
        force = rows.forces(self.options.smoothing_mm * MM)
        keys = rows.key[: rows.count]
        bound = self.coefficients[keys] * force
        np.add.at(bounds, keys, bound)  # a feature in a dent has several rows
        total = max(float(np.sum(bounds)), float(np.sum(self.bounds)))
        change = float(np.sum(np.abs(bounds - self.bounds))) / total if total > 0.0 else 0.0
        wanted, self.bounds = bounds, bounds if whole else self._relaxed(bounds)
        self.relagged_forces = self._forces_by_body(force)
        bound = bound * np.divide(self.bounds, wanted, out=np.zeros_like(wanted), where=wanted > 0.0)[keys]
        self.friction = rows.friction(
            state=state, start=self.start, faces=self.surface.faces, bound=bound, slips=self.slips,
            ratio=self.options.friction_stiffness_ratio,
        )
        return change

    def _relaxed(self, wanted: np.ndarray) -> np.ndarray:
        """Return the friction bounds to go on with, between the last ones and those ``wanted`` by the normal forces.

        Where friction carries much of the load, full renewals swing about Coulomb's law for ever: more friction, less
        normal force, less friction. Aitken's relaxation finds the middle; the first renewal of a step is a full one.
        Source: Kuettler and Wall, Comput. Mech. 43 (2008) 61, equation 44.
        """
        missing, before = wanted - self.bounds, self._missing
        if before is None:
            self._share = 1.0
        else:
            turn = missing - before
            size = float(np.vdot(turn, turn))
            if size > 0.0:
                self._share = min(max(-self._share * float(np.vdot(before, turn)) / size, LEAST_SHARE), 1.0)
        self._missing = missing
        return self.bounds + self._share * missing

    def energy(self, state: State) -> float:
        """Return contact and friction energy [J]."""
        self._find(state)
        smoothing = self.options.smoothing_mm * MM
        rows, friction = self.rows, self.friction
        energy = forces.normal_contacts_energy(rows.gap, rows.stiffness, smoothing, rows.count)
        slips = self._trial_slips(state)
        return energy + forces.friction_energy(slips, friction.bound, friction.stiffness, len(slips))

    def add_gradient(self, state: State, derivatives: Derivatives) -> float:
        """Add the gradient, return the energy [J]; friction at the lagged bounds."""
        energy, slips = self._add(state, derivatives, gradient=True)
        return energy + forces.friction_energy(slips, self.friction.bound, self.friction.stiffness, len(slips))

    def add_hessian(self, state: State, derivatives: Derivatives, *, projected: bool = False) -> None:
        """Add the Hessian; ``projected``: a semidefinite one, exact for friction, Gauss-Newton for the penalty."""
        self._add(state, derivatives, gradient=False, exact=not projected)

    def _add(
        self, state: State, d: Derivatives, *, gradient: bool, exact: bool = False
    ) -> tuple[float, np.ndarray]:
        self._find(state)
        rows, f = self.rows, self.friction
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
        allowance, spacing = self.options.step_allowance_mm * MM, self.options.sample_spacing_mm * MM
        surface, limit = self.surface, 1.0
        farthest = float(np.sqrt(np.max(np.sum(direction.soft**2, axis=1), initial=0.0)))
        for r, body in enumerate(self.scene.rigid_bodies):
            shift, turn = np.linalg.norm(direction.rigid[r, :3]), np.linalg.norm(direction.rigid[r, 3:])
            move = shift + turn * body.shape.bounding_radius
            if farthest + move <= allowance:
                continue
            limit = min(
                limit,
                kernels.soft_step_limit(
                    state.positions, direction.soft, surface.faces, surface.sample_face, surface.sample_weight, spacing,
                    state.rigid_positions[r], state.rigid_rotations[r], body.shape.distance, *self.boxes[r],
                    direction.rigid[r, :3], direction.rigid[r, 3:], allowance,
                ),
            )
        for plane in self.scene.planes:
            heights = (state.positions - plane.point) @ plane.normal
            limit = min(limit, kernels.plane_step_limit(heights, -direction.soft @ plane.normal, allowance))
            for r, body in enumerate(self.scene.rigid_bodies):
                arms = _support_arms(body.shape, state.rigid_rotations[r], plane.normal)
                moves = direction.rigid[r, :3] + np.cross(direction.rigid[r, 3:], arms)
                heights = (state.rigid_positions[r] + arms - plane.point) @ plane.normal
                limit = min(limit, kernels.plane_step_limit(heights, -moves @ plane.normal, allowance))
        return limit

    def strain(self, state: State) -> float:
        """Return the longest slide of a feature over a soft face in this step, in multiples of ``slide_limit_mm``.

        The tangent planes that features meet are held over a solve, so a longer slide would leave them behind.
        """
        self._find(state)
        rows, start = self.rows, self.start
        used = np.flatnonzero((rows.turns[: rows.count] == -1) & (rows.face[: rows.count] >= 0))
        if not len(used):
            return 0.0
        nodes = self.surface.faces[rows.face[used]]
        moved = (state.positions - start.positions)[nodes] * (nodes >= 0)[:, :, None]
        slide = np.einsum("na,nax->nx", rows.weight[used], moved)
        for r in range(len(self.scene.rigid_bodies)):
            mine = rows.rigid[used] == r
            arm = rows.arm[used][mine]
            turn = start.rigid_rotations[r] @ state.rigid_rotations[r].T
            slide[mine] -= state.rigid_positions[r] - start.rigid_positions[r] + arm - arm @ turn.T
        return float(np.max(np.linalg.norm(slide, axis=1))) / (self.options.slide_limit_mm * MM)

    def commit(self, state: State) -> None:
        """Accept ``state``: return mapping of the elastic slip; forces and penetration for the outside."""
        friction = self.friction
        slips = self._trial_slips(state)
        forces.return_mapping(slips, friction.bound, friction.stiffness, len(slips))
        for r in range(len(self.scene.rigid_bodies)):
            mine = friction.rigid == r
            slips[mine] = slips[mine] @ state.rigid_rotations[r]
        self.slips = np.zeros_like(self.slips)
        self.slips[friction.key] = slips
        self.shares = self.fresh_shares
        self._hold_geometry(state)  # so that what is reported is the true penetration
        self._find(state)
        rows = self.rows
        self.soft_forces = self._forces_by_body(rows.forces(self.options.smoothing_mm * MM))
        self.penetration = float(np.max(-rows.gap[: rows.count], initial=0.0))

    def _forces_by_body(self, force: np.ndarray) -> np.ndarray:
        """Return the summed normal force on each soft body [N], from that of each row."""
        face = self.rows.face[: self.rows.count]
        soft = face >= 0
        return np.bincount(self.surface.face_body[face[soft]], force[soft], minlength=len(self.scene.soft_bodies))

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
        if self.last_rows_state is state:
            return
        rows, surface, scene = self.rows, self.surface, self.scene
        samples = (surface.first_sample, surface.sample_weight, self.sample_stiffness)
        rows.count = 0
        for r, body in enumerate(scene.rigid_bodies):
            pose = (np.ascontiguousarray(state.rigid_positions[r]), np.ascontiguousarray(state.rigid_rotations[r]))
            rows.count = kernels.find_soft_rigid(
                state.positions, surface.faces, self.facing_bodies[r], *samples, *pose, body.shape.distance,
                *self.boxes[r], float(body.shape.bounding_radius), r, self.first_key["rigid", r], *rows.arrays,
                rows.count,
            )
            for b, planes in enumerate(self.planes[r]):
                rows.count = features.find_feature_plane(
                    state.positions, surface.faces, planes.point, planes.face, planes.weight, planes.normal,
                    planes.stiffness, body.shape.feature_points, *pose, r, self.first_key["feature", r, b],
                    *rows.arrays, rows.count,
                )
            for p, plane in enumerate(scene.planes):
                rows.count = kernels.find_rigid_plane(
                    body.shape.support_points, float(body.shape.ball_radius), *pose, plane.point, plane.normal,
                    self.support_stiffness[r], r, self.first_key["support", r, p], *rows.arrays, rows.count,
                )
        for p, plane in enumerate(scene.planes):
            rows.count = kernels.find_soft_plane(
                state.positions, surface.faces, self.facing, *samples, plane.point, plane.normal,
                self.first_key["plane", p], *rows.arrays, rows.count,
            )
        self.last_rows_state = state

    def _hold_geometry(self, state: State) -> None:
        """Fix what would make Newton's method stumble from face to face: the planes that features meet."""
        self._renew_pairs(state)
        self.planes = [
            [self._feature_planes(r, body, pairs, state) for body, pairs in enumerate(self._pairs[r])]
            for r in range(len(self.scene.rigid_bodies))
        ]
        self.last_rows_state = None

    def _feature_planes(self, r: int, body: int, pairs: np.ndarray, state: State) -> FeaturePlanes:
        surface, shape = self.surface, self.scene.rigid_bodies[r].shape
        n = PLANES * len(shape.feature_points)
        point, face, share = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64), np.empty(n)
        weight, normal = np.empty((n, surface.faces.shape[1])), np.empty((n, 3))
        count = features.pair_features(
            state.positions, surface.faces, surface.triangle_face, surface.triangle_weight, pairs,
            shape.feature_points,
            self.feature_normals[r], np.ascontiguousarray(state.rigid_positions[r]),
            np.ascontiguousarray(state.rigid_rotations[r]), FEATURE_DEPTH, FEATURE_MARGIN, FEATURE_NEAR,
            self._kept[r][body], point, face, weight, normal, share,
        )
        point, share = point[:count], share[:count]
        key = self.first_key["feature", r, body] + point
        old, fixed = self.shares[key], self.fresh_shares[key]
        share = np.where(np.isnan(fixed), np.where(np.isnan(old), share, old + SHARE_RATE * (share - old)), fixed)
        self.fresh_shares[key] = share
        return FeaturePlanes(
            point=point, face=face[:count], weight=weight[:count], normal=normal[:count],
            stiffness=share * self.feature_stiffness[r][point],
        )

    def _renew_pairs(self, state: State) -> None:
        """Look up candidate (feature, triangle) pairs if anything may have come near since the last time."""
        then = self._pairs_state
        if then is not None:
            moved = float(np.sqrt(np.max(np.sum((state.positions - then.positions) ** 2, axis=1), initial=0.0)))
            turned = np.linalg.norm(state.rigid_rotations - then.rigid_rotations, axis=(1, 2))
            shifted = np.linalg.norm(state.rigid_positions - then.rigid_positions, axis=1)
            radii = np.array([b.shape.bounding_radius for b in self.scene.rigid_bodies])
            if moved + float(np.max(shifted + turned * radii, initial=0.0)) < FEATURE_REACH - FEATURE_DEPTH:
                return
        self._pairs = [self._feature_pairs(r, state) for r in range(len(self.scene.rigid_bodies))]
        self._pairs_state = state
        self._forget_dents()

    def _forget_dents(self) -> None:
        """Start anew with which (feature, triangle) pairs have had a plane in this step."""
        self._kept = [[np.zeros(len(pairs), dtype=bool) for pairs in bodies] for bodies in self._pairs]

    def _feature_pairs(self, r: int, state: State) -> list[np.ndarray]:
        """Return for each soft body the (feature, triangle) pairs within reach of rigid body ``r``, sorted."""
        surface, shape = self.surface, self.scene.rigid_bodies[r].shape
        if not len(shape.feature_points) or not len(surface.faces):
            return []
        points = state.rigid_positions[r] + shape.feature_points @ state.rigid_rotations[r].T
        scratch = np.empty((2, len(surface.faces), 3))
        pairs = np.empty((4096, 2), dtype=np.int64)
        while True:
            count = features.near_triangles(
                state.positions, surface.faces, surface.triangle_face, points, FEATURE_REACH, scratch[0], scratch[1],
                pairs,
            )
            if count <= len(pairs):
                break
            pairs = np.empty((2 * count, 2), dtype=np.int64)
        pairs = pairs[:count]
        pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
        body = surface.triangle_body[pairs[:, 1]]
        return [np.ascontiguousarray(pairs[body == b]) for b in range(len(self.scene.soft_bodies))]


def _box(shape: object) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a shape's bounding box in its own frame; a ball's surface mesh lies inside the ball."""
    if shape.ball_radius > 0.0:
        return np.full(3, -shape.ball_radius), np.full(3, shape.ball_radius)
    margin = 1e-3 * shape.bounding_radius  # a tessellation of a curved surface lies inside it
    return shape.vertices.min(axis=0) - margin, shape.vertices.max(axis=0) + margin


def _outward(shape: object) -> np.ndarray:
    """Return the unit pseudonormals of a shape's features, in its own frame, shape (n, 3)."""
    distances, normals = np.empty(len(shape.feature_points)), np.empty((len(shape.feature_points), 3))
    signed_distances(shape.distance, shape.feature_points, distances, normals)
    return normals


def _support_arms(shape: object, rotation: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the points of a rigid body that can touch a plane, relative to its centre of mass [m], shape (n, 3)."""
    if shape.ball_radius > 0.0:
        return -shape.ball_radius * normal[None, :]
    return shape.support_points @ rotation.T
