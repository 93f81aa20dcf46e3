"""Contact of soft bodies with each other and with themselves, with Coulomb friction: rows, lagging and history."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from finqd.errors import InputError
from finqd.mechanics import soft_contact_kernels as kernels
from finqd.mechanics.contact_force_kernels import friction_energy, return_mapping
from finqd.mechanics.contact_rows import KeyedValues
from finqd.mechanics.contact_surface import ContactSurface
from finqd.mechanics.near_faces import NearFaces
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.proximity_kernels import all_local_weights
from finqd.mechanics.soft_motion_kernels import pairs_step_limit
from finqd.mechanics.soft_rows_kernels import find_rows
from finqd.mechanics.state import Direction, State
from finqd.mechanics.system import Derivatives
from finqd.scene import Scene

NOTHING = 1e-3  # share of the gap that is none
AHEAD = 1e-3  # [m] faces that are nearer than this to faces in touch get room in the Hessian with them
NO_SLIPS = KeyedValues.of(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))


@dataclass(kw_only=True)
class _Rows:
    """Samples near another face; columns as in `soft_contact_kernels`, ``count`` of them in use."""

    key: np.ndarray
    face: np.ndarray
    weight: np.ndarray
    other: np.ndarray
    piece: np.ndarray
    share: np.ndarray
    distance: np.ndarray
    normal: np.ndarray
    stiffness: np.ndarray
    count: int = 0

    @classmethod
    def empty(cls, capacity: int, width: int) -> _Rows:
        """Return room for ``capacity`` rows of faces of up to ``width`` vertices."""
        ids = [np.zeros(capacity, dtype=np.int64) for _ in range(4)]
        return cls(
            key=ids[0], face=ids[1], weight=np.zeros((capacity, width)), other=ids[2], piece=ids[3],
            share=np.zeros((capacity, 3)), distance=np.zeros(capacity), normal=np.zeros((capacity, 3)),
            stiffness=np.zeros(capacity),
        )

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """The columns in the order in which they are filled."""
        return (
            self.key, self.face, self.weight, self.other, self.piece, self.share, self.distance, self.normal,
            self.stiffness,
        )


@dataclass(frozen=True, kw_only=True)
class _Friction:
    """Frictional rows of one step, with their lagged bounds mu N [N]; n rows.

    beside: weights of the other face's vertices, (n, k); start: the sample relative to the other point at the step's
    start [m], start_slip: elastic slip there [m], both (n, 3); stiffness: tangential [N/m], (n,)
    """

    key: np.ndarray
    face: np.ndarray
    weight: np.ndarray
    other: np.ndarray
    beside: np.ndarray
    normal: np.ndarray
    bound: np.ndarray
    stiffness: np.ndarray
    start: np.ndarray
    start_slip: np.ndarray


class SoftContact:
    """Contact of soft faces with each other: the potential of `soft_contact_kernels.barrier`, and friction.

    gap: distance at which faces begin to push each other apart [m]; pressure: stiffness of an area [N/m^3]
    ratio: tangential over normal stiffness. Slips and friction bounds are kept outside, by samples' numbers (`keys`).
    """

    def __init__(self, scene: Scene, surface: ContactSurface, *, gap: float, pressure: float, ratio: float) -> None:
        self.surface, self.gap, self.pressure, self.ratio = surface, gap, pressure, ratio
        bodies = scene.soft_bodies
        self.near = NearFaces(bodies, surface, gap=gap, touches=scene.touches)
        self.triangles = self.near.triangles
        self.points = np.zeros(0, dtype=np.int64)  # of each sample in touch, the row with the largest force,
        self.loads = np.zeros(0)  # and the force of all its rows [N]
        self.coefficients = np.array([[scene.friction_between(a.name, b.name) for b in bodies] for a in bodies])
        self.rows = _Rows.empty(64, surface.faces.shape[1])
        self.friction = self._friction(np.zeros(0, dtype=np.int64))
        self.coupled = np.zeros(0, dtype=np.int64)  # keys of pairs of faces that have room in the Hessian
        self._slots = np.zeros((0, 0, 0), dtype=np.int32)
        self._at: np.ndarray | None = None
        self._refuse_touching(scene)

    def _refuse_touching(self, scene: Scene) -> None:
        """Raise InputError if two soft bodies have no gap between them at the start: the barrier is infinite."""
        self.find(np.concatenate([body.start_positions for body in scene.soft_bodies]))
        one, other = self.bodies()
        none = np.flatnonzero((one != other) & (self.rows.distance[: self.rows.count] < NOTHING * self.gap))
        if len(none):
            names = [scene.soft_bodies[owner[none[0]]].name for owner in (one, other)]
            reason = f"soft bodies must not touch at the start (leave {1e3 * self.gap:.2g} mm)"
            raise InputError(reason, " and ".join(names))

    # -- what touches --------------------------------------------------------------------------------------------------

    def find(self, positions: np.ndarray) -> None:
        """Fill `rows` with all contacts at ``positions``, unless they are there already."""
        if self._at is positions:
            return
        pairs = self.near.at(positions)
        self._at, self.rows.count = positions, 0
        self.points, self.loads = np.zeros(0, dtype=np.int64), np.zeros(0)
        if len(pairs):
            both = np.concatenate([pairs, pairs[:, ::-1]])
            both = both[np.lexsort((both[:, 1], both[:, 0]))]
            groups, first = np.unique(both[:, 0], return_index=True)
            self._fill(positions, groups, np.append(first, len(both)), np.ascontiguousarray(both[:, 1]))
        if self.rows.count:
            self._gather()

    def _fill(self, positions: np.ndarray, groups: np.ndarray, first: np.ndarray, others: np.ndarray) -> None:
        while True:
            t = self.triangles
            count = find_rows(
                positions, *self.surface.arrays, self.pressure, t.first, t.corners, t.edges, t.vertices, t.valence,
                groups, first, others, self.gap, *self.rows.arrays,
            )
            if count <= len(self.rows.key):
                self.rows.count = count
                return
            self.rows = _Rows.empty(2 * count, self.rows.weight.shape[1])

    def _gather(self) -> None:
        """Sum up the rows of each sample, which follow each other."""
        n, forces = self.rows.count, self.forces()
        first = np.flatnonzero(np.diff(self.rows.key[:n], prepend=-1))
        order = np.lexsort((-forces, self.rows.key[:n]))
        self.points = order[first]
        with np.errstate(invalid="ignore"):  # at no distance forces are infinite, and so is the energy
            vectors = np.add.reduceat(forces[:, None] * self.rows.normal[:n], first, axis=0)
        self.loads = np.linalg.norm(vectors, axis=1)

    @property
    def keys(self) -> np.ndarray:
        """Number of each sample in touch."""
        return self.rows.key[self.points]

    def forces(self) -> np.ndarray:
        """Return the normal force of each row [N]."""
        found = np.empty(self.rows.count)
        kernels.row_forces(self.rows.distance, self.gap, self.rows.stiffness, self.rows.count, found)
        return found

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the soft bodies of each row's two faces."""
        owner, n = self.surface.face_body, self.rows.count
        return owner[self.rows.face[:n]], owner[self.rows.other[:n]]

    @property
    def _touching(self) -> bool:
        """Whether anything touches, or has friction from the last renewal."""
        return self.rows.count > 0 or len(self.friction.key) > 0

    def bounds(self) -> np.ndarray:
        """Return mu N of each sample in touch [N]."""
        if not self.rows.count:
            return np.zeros(0)
        one, other = self.bodies()
        return self.coefficients[one[self.points], other[self.points]] * self.loads

    # -- friction ------------------------------------------------------------------------------------------------------

    def lag(self, start: State, *, bound: np.ndarray, slips: np.ndarray) -> None:
        """Take the frictional contacts of this step from the samples: ``bound`` mu N [N] and stored ``slips`` [m]."""
        used = np.flatnonzero(bound > 0.0)
        if not len(used) and not len(self.friction.key):
            return
        self.friction = self._friction(self.points[used], start.positions, bound[used], slips[used])

    def _friction(
        self, used: np.ndarray, positions: np.ndarray | None = None, bound: np.ndarray | None = None,
        slips: np.ndarray | None = None,
    ) -> _Friction:
        rows, faces = self.rows, self.surface.faces
        face, weight, other = rows.face[used], rows.weight[used], rows.other[used]
        beside, start = np.zeros_like(weight), np.zeros((len(used), 3))
        all_local_weights(faces, other, self.triangles.corners, rows.piece[used], rows.share[used], beside)
        if positions is not None:
            kernels.relative_positions(positions, faces, face, weight, other, beside, len(used), start)
        return _Friction(
            key=rows.key[used], face=face, weight=weight, other=other, beside=beside, normal=rows.normal[used],
            bound=np.zeros(0) if bound is None else bound, stiffness=0.5 * self.ratio * np.abs(rows.stiffness[used]),
            start=start, start_slip=np.zeros((0, 3)) if slips is None else slips,
        )

    def trial_slips(self, positions: np.ndarray) -> np.ndarray:
        """Return the elastic slip that each frictional contact would have without a bound [m], (n, 3)."""
        f = self.friction
        faces, slips = self.surface.faces, np.empty((len(f.key), 3))
        kernels.relative_positions(positions, faces, f.face, f.weight, f.other, f.beside, len(slips), slips)
        slips += f.start_slip - f.start
        return slips - np.einsum("ni,ni->n", slips, f.normal)[:, None] * f.normal

    def mapped_slips(self, positions: np.ndarray) -> KeyedValues:
        """Return the elastic slips at the end of a step, by the samples' numbers: return mapping of the trial ones."""
        if not len(self.friction.key):
            return NO_SLIPS
        slips = self.trial_slips(positions)
        return_mapping(slips, self.friction.bound, self.friction.stiffness, len(slips))
        return KeyedValues.of(self.friction.key, slips)

    # -- the potential -------------------------------------------------------------------------------------------------

    def energy(self, positions: np.ndarray) -> float:
        """Return contact and friction energy [J]."""
        self.find(positions)
        rows, f = self.rows, self.friction
        if not self._touching:
            return 0.0
        energy = kernels.rows_energy(rows.distance, self.gap, rows.stiffness, rows.count)
        return energy + friction_energy(self.trial_slips(positions), f.bound, f.stiffness, len(f.key))

    def add_gradient(self, positions: np.ndarray, gradient: np.ndarray) -> float:
        """Add the gradient [N] to ``gradient`` (n_vertices, 3); return the energy [J]."""
        self.find(positions)
        rows, f, faces = self.rows, self.friction, self.surface.faces
        if not self._touching:
            return 0.0
        energy = kernels.add_gradient(
            faces, rows.face, rows.weight, rows.other, self.triangles.corners, rows.piece, rows.share, rows.distance,
            rows.normal, rows.stiffness, rows.count, self.gap, gradient,
        )
        if len(f.key):
            slips = self.trial_slips(positions)
            kernels.add_friction_gradient(
                faces, f.face, f.weight, f.other, f.beside, slips, f.bound, f.stiffness, len(slips), gradient
            )
            energy += friction_energy(slips, f.bound, f.stiffness, len(slips))
        return energy

    def add_hessian(self, positions: np.ndarray, derivatives: Derivatives, *, projected: bool) -> None:
        """Add the Hessian [N/m]; ``projected``: a positive semidefinite one."""
        self.find(positions)
        rows, f, faces = self.rows, self.friction, self.surface.faces
        if rows.count:
            pair = np.searchsorted(self.coupled, self._pair_keys(rows.face[: rows.count], rows.other[: rows.count]))
            kernels.add_hessian(
                positions, faces, pair, self._slots, rows.face, rows.weight, rows.other, self.triangles.corners,
                rows.piece, rows.share, rows.distance, rows.normal, rows.stiffness, rows.count, self.gap,
                derivatives.blocks, not projected,
            )
        if len(f.key):
            pair = np.searchsorted(self.coupled, self._pair_keys(f.face, f.other))
            kernels.add_friction_hessian(
                faces, pair, self._slots, f.face, f.weight, f.other, f.beside, self.trial_slips(positions), f.bound,
                f.stiffness, f.normal, len(f.key), derivatives.blocks,
            )

    def step_limit(self, state: State, direction: Direction, limit: float) -> float:
        """Return the share of ``direction``, up to ``limit``, on which no sample meets another face."""
        moves = direction.soft if limit == 1.0 else limit * direction.soft
        pairs = self.near.on_the_way(state.positions, moves)
        if not len(pairs) or not direction.soft.any():
            return limit
        s = self.surface
        return pairs_step_limit(
            state.positions, direction.soft, s.faces, s.face_lattice, s.lattice_first, s.lattice_weight,
            self.triangles.first, self.triangles.corners, pairs, limit,
        )

    # -- room in the Hessian -------------------------------------------------------------------------------------------

    def _pair_keys(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.minimum(one, other) * len(self.surface.faces) + np.maximum(one, other)

    def couplings(self, positions: np.ndarray, pattern: BlockPattern) -> np.ndarray:
        """Return the pairs of vertices (n, 2) that the Hessian at ``positions`` needs and ``pattern`` does not have."""
        self.find(positions)
        rows, f = self.rows, self.friction
        face = np.concatenate([rows.face[: rows.count], f.face])
        touching = np.unique(self._pair_keys(face, np.concatenate([rows.other[: rows.count], f.other])))
        new = touching[~np.isin(touching, self.coupled)]
        if not len(new):
            return np.zeros((0, 2), dtype=np.int64)
        touched = np.unique(np.divmod(new, len(self.surface.faces)))
        ahead = [pairs[np.isin(pairs, touched).any(axis=1)] for pairs in self._ahead(positions, new)]
        near = [self._pair_keys(pairs[:, 0], pairs[:, 1]) for pairs in ahead]
        self._take(np.unique(np.concatenate([self.coupled, new, *near])), pattern=None)
        pairs = self._vertices()
        pairs = np.unique(pairs[pattern.lacks(pairs)], axis=0)
        if not len(pairs):
            self._take(self.coupled, pattern=pattern)
        return pairs

    def _ahead(self, positions: np.ndarray, new: np.ndarray) -> list[np.ndarray]:
        """Return the pairs of faces that are near, of the bodies that have come to touch."""
        owner = self.surface.face_body
        bodies = {tuple(sorted(pair)) for pair in np.transpose(owner[np.array(np.divmod(new, len(owner)))]).tolist()}
        return [self.near.pairs(positions, watch, AHEAD)[0] for watch in self.near.watches if watch.bodies in bodies]

    def _vertices(self) -> np.ndarray:
        """Return all pairs of vertices of faces that are coupled, (n, 2)."""
        one, other = (self.surface.faces[face] for face in np.divmod(self.coupled, len(self.surface.faces)))
        pairs = np.stack(np.broadcast_arrays(one[:, :, None], other[:, None, :]), axis=-1).reshape(-1, 2)
        return pairs[(pairs >= 0).all(axis=1)]

    def _take(self, coupled: np.ndarray, *, pattern: BlockPattern | None) -> None:
        """Couple these pairs of faces; look up where in the Hessian they go if ``pattern`` has room for them."""
        self.coupled = coupled
        if pattern is not None:
            one, other = (self.surface.faces[face] for face in np.divmod(coupled, len(self.surface.faces)))
            self._slots = pattern.slots(np.concatenate([one, other], axis=1))

    def bind(self, pattern: BlockPattern) -> None:
        """Look up where in the Hessian's blocks pairs of faces go."""
        self._take(self.coupled, pattern=pattern)

    def restore(self, coupled: np.ndarray, pattern: BlockPattern) -> None:
        """Couple the pairs of faces that were coupled when ``coupled`` was kept."""
        self._take(coupled, pattern=pattern)
        self._at = None
