"""Points that ride on soft vertices or on rigid bodies, and the chain rule from them to the unknowns of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from finqd.mechanics.state import State
from finqd.mechanics.system import Derivatives


@dataclass(frozen=True, kw_only=True)
class Points:
    """n points; each is a soft vertex x, or a point c + R y of a rigid body at centre c, turned by R.

    soft: scene vertex, -1 for a point of a rigid body; rigid: rigid body, -1 for a soft vertex; both of shape (n,)
    arms: y in the frame of the rigid body [m], zero for a soft vertex, shape (n, 3)

    No soft vertex comes twice.
    """

    soft: np.ndarray
    rigid: np.ndarray
    arms: np.ndarray

    @cached_property
    def riding(self) -> np.ndarray:
        """Which points are those of soft vertices, shape (m,)."""
        return np.flatnonzero(self.soft >= 0)

    @cached_property
    def of_bodies(self) -> dict[int, np.ndarray]:
        """Which points each rigid body has, by its number, each of shape (m,)."""
        return {int(body): np.flatnonzero(self.rigid == body) for body in np.unique(self.rigid[self.rigid >= 0])}

    def with_rigid(self, rigid: np.ndarray, arms: np.ndarray) -> Points:
        """Return these points and after them those at ``arms`` (m, 3) [m] of bodies ``rigid`` (m,)."""
        return Points(
            soft=np.concatenate([self.soft, np.full(len(rigid), -1)]), rigid=np.concatenate([self.rigid, rigid]),
            arms=np.concatenate([self.arms, arms.reshape(-1, 3)]),
        )

    def at(self, state: State) -> np.ndarray:
        """Return where the points are [m], shape (n, 3)."""
        found = self._turned_arms(state)
        for body, mine in self.of_bodies.items():
            found[mine] += state.rigid_positions[body]
        found[self.riding] = state.positions[self.soft[self.riding]]
        return found

    def add_gradient(self, state: State, gradient: np.ndarray, derivatives: Derivatives) -> None:
        r"""Add the gradient of an energy whose derivatives to the points are ``gradient`` [N], (n, 3).

        .. math:: dx = dc + d\\varphi \\times R y \\Rightarrow dE/dc = g, \\; dE/d\\varphi = R y \\times g
        """
        derivatives.soft[self.soft[self.riding]] += gradient[self.riding]
        hard = np.flatnonzero((self.soft < 0) & gradient.any(axis=1))
        if len(hard):
            turning = np.cross(self._turned_arms(state)[hard], gradient[hard])
            np.add.at(derivatives.rigid, self.rigid[hard], np.concatenate([gradient[hard], turning], axis=1))

    def add_curvature(self, state: State, gradient: np.ndarray, derivatives: Derivatives) -> None:
        r"""Add to the Hessian what rotations bend: the points' second derivatives times ``gradient`` [N], (n, 3).

        A rotation vector from the left moves a = R y by phi x a + phi x (phi x a) / 2 to second order, so that

        .. math:: g \\cdot \\tfrac12 \\varphi \\times (\\varphi \\times a) =
            \\tfrac12 \\varphi^T \\left[\\tfrac12 (g a^T + a g^T) - (g \\cdot a) I\\right] \\varphi
        """
        hard = np.flatnonzero((self.soft < 0) & gradient.any(axis=1))
        if not len(hard):
            return
        arms, forces = self._turned_arms(state)[hard], gradient[hard]
        outer = forces[:, :, None] * arms[:, None, :]
        bent = 0.5 * (outer + outer.transpose(0, 2, 1)) - np.einsum("nii->n", outer)[:, None, None] * np.eye(3)
        n_rigid = len(state.rigid_positions)
        turns = derivatives.rigid_matrix.reshape(n_rigid, 6, n_rigid, 6)
        for body in np.unique(self.rigid[hard]):
            turns[body, 3:, body, 3:] += bent[self.rigid[hard] == body].sum(axis=0)

    def add_hessian(
        self, state: State, pairs: np.ndarray, blocks: np.ndarray, slots: BlockSlots, derivatives: Derivatives
    ) -> None:
        """Add second derivatives ``blocks`` (m, 3, 3) [N/m] to pairs of points (m, 2): J^T H J, all pairs both ways."""
        one, other = pairs.T
        soft, n_rigid = self.soft >= 0, len(state.rigid_positions)
        upper = soft[one] & soft[other] & (self.soft[one] <= self.soft[other])
        places = slots.find(self.soft[one[upper]], self.soft[other[upper]])
        np.add.at(derivatives.blocks, places, blocks[upper])
        if not n_rigid:
            return
        mixed = soft[one] & ~soft[other]
        jacobians = self._jacobians(state, other[mixed])
        coupling = derivatives.coupling.reshape(-1, 3, n_rigid, 6)
        np.add.at(
            coupling, (self.soft[one[mixed]], slice(None), self.rigid[other[mixed]]), blocks[mixed] @ jacobians
        )
        hard = ~soft[one] & ~soft[other]
        left, right = self._jacobians(state, one[hard]), self._jacobians(state, other[hard])
        matrix = derivatives.rigid_matrix.reshape(n_rigid, 6, n_rigid, 6)
        np.add.at(
            matrix, (self.rigid[one[hard]], slice(None), self.rigid[other[hard]]),
            left.transpose(0, 2, 1) @ blocks[hard] @ right,
        )

    def _turned_arms(self, state: State) -> np.ndarray:
        turned = np.zeros((len(self.soft), 3))
        for body, mine in self.of_bodies.items():
            turned[mine] = self.arms[mine] @ state.rigid_rotations[body].T
        return turned

    def _jacobians(self, state: State, which: np.ndarray) -> np.ndarray:
        """Return dx / d(c, phi) of points of rigid bodies, shape (m, 3, 6): the identity and -[R y]x."""
        x, y, z = self._turned_arms(state)[which].T
        found = np.zeros((len(which), 3, 6))
        found[:, range(3), range(3)] = 1.0
        found[:, 0, 4], found[:, 0, 5] = z, -y
        found[:, 1, 3], found[:, 1, 5] = -z, x
        found[:, 2, 3], found[:, 2, 4] = y, -x
        return found


class BlockSlots:
    """Where in the soft Hessian's blocks a pair of vertices goes; from a `BlockPattern`."""

    def __init__(self, indptr: np.ndarray, indices: np.ndarray) -> None:
        self.n = len(indptr) - 1
        self.keys = np.repeat(np.arange(self.n, dtype=np.int64), np.diff(indptr)) * self.n + indices

    def find(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the blocks of pairs, rows <= columns, shape (m,). Raises KeyError if there is none."""
        places, known = self._look_up(rows, columns)
        if not known.all():
            raise KeyError("contact couples two vertices that have no entry in the Hessian")
        return places

    def lacks(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return which pairs, rows <= columns, have no block, shape (m,)."""
        return ~self._look_up(rows, columns)[1]

    def _look_up(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        wanted = rows.astype(np.int64) * self.n + columns
        places = np.minimum(np.searchsorted(self.keys, wanted), max(len(self.keys) - 1, 0))
        return places, self.keys[places] == wanted if len(self.keys) else np.zeros(len(wanted), dtype=bool)
