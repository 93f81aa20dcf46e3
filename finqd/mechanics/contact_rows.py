"""Rows of contacts and of frictional contacts, as `finqd.mechanics.contact_kernels` fills and reads them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from finqd.mechanics.state import State

LEAST_SHARE = 0.4  # of the way to their new values that friction bounds go at least in a renewal


@dataclass(frozen=True, kw_only=True)
class FrictionRows:
    """Frictional contacts of one step, with their lagged bounds; n rows.

    key, face, rigid: (n,); weight: (n, k); bound: mu N [N], stiffness: tangential [N/m], (n,)
    normal, start_point [m], start_arm [m], start_slip [m]: (n, 3), the last three at the start of the step
    """

    key: np.ndarray
    face: np.ndarray
    weight: np.ndarray
    rigid: np.ndarray
    bound: np.ndarray
    stiffness: np.ndarray
    normal: np.ndarray
    start_point: np.ndarray
    start_arm: np.ndarray
    start_slip: np.ndarray

    @classmethod
    def empty(cls, width: int) -> FrictionRows:
        """Return no rows, for faces of up to ``width`` vertices."""
        ids, three = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        return cls(
            key=ids, face=ids, weight=np.zeros((0, width)), rigid=ids, bound=np.zeros(0), stiffness=np.zeros(0),
            normal=three, start_point=three, start_arm=three, start_slip=three,
        )


@dataclass(frozen=True, kw_only=True)
class KeyedValues:
    """Values of some of many contacts: ``keys`` (n,), ascending, and ``values`` (n, ...); all others have 0."""

    keys: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, keys: np.ndarray, values: np.ndarray) -> KeyedValues:
        """Return ``values`` by their ``keys``, of which none comes twice."""
        order = np.argsort(keys)
        return cls(keys=keys[order], values=values[order])

    def at(self, keys: np.ndarray) -> np.ndarray:
        """Return the values at ``keys``, in their order."""
        found = np.zeros((len(keys), *self.values.shape[1:]))
        if len(self.keys):
            place = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
            known = self.keys[place] == keys
            found[known] = self.values[place[known]]
        return found


class FrictionBounds:
    """Lagged friction bounds mu N [N] by key, ``values``; renewed within a step, towards what normal forces ask for."""

    def __init__(self) -> None:
        self.values = KeyedValues(keys=np.zeros(0, dtype=np.int64), values=np.zeros(0))
        self._missing: KeyedValues | None = None  # what the last renewal of this step found missing [N]
        self._share = 1.0  # of which it took that share

    def begin(self) -> None:
        """Begin a step: renewals before do not matter any more."""
        self._missing = None

    def renew(self, keys: np.ndarray, wanted: np.ndarray, *, whole: bool) -> float:
        """Go to the bounds ``wanted`` [N] at ``keys``, zero elsewhere; return which share of all, in sum, was missing.

        ``whole``: without relaxation.
        """
        goal = KeyedValues.of(keys, wanted)
        of_both = np.union1d(goal.keys, self.values.keys)
        missing = goal.at(of_both) - self.values.at(of_both)
        total = max(float(np.sum(goal.values)), float(np.sum(self.values.values)))
        self.values = goal if whole else self._relaxed(KeyedValues(keys=of_both, values=missing))
        return float(np.sum(np.abs(missing))) / total if total > 0.0 else 0.0

    def _relaxed(self, missing: KeyedValues) -> KeyedValues:
        """Return the bounds to go on with, between the last ones and those that normal forces ask for.

        missing: what they ask for more, at all keys of both. Where friction carries much of the load, full renewals
        swing about Coulomb's law for ever: more friction, less normal force, less friction. Aitken's relaxation finds
        the middle; the first renewal of a step is a full one.
        Source: Kuettler and Wall, Comput. Mech. 43 (2008) 61, equation 44.
        """
        before, self._missing = self._missing, missing
        if before is None:
            self._share = 1.0
        else:
            keys = np.union1d(missing.keys, before.keys)
            turn = missing.at(keys) - before.at(keys)
            size = float(np.vdot(turn, turn))
            if size > 0.0:
                share = -self._share * float(np.vdot(before.at(keys), turn)) / size
                self._share = min(max(share, LEAST_SHARE), 1.0)
        bounds = self.values.at(missing.keys) + self._share * missing.values
        return KeyedValues(keys=missing.keys, values=np.maximum(bounds, 0.0))


class Rows:
    """Contacts at one state: ``count`` of at most ``capacity`` rows are in use; columns as in `contact_kernels`."""

    def __init__(self, capacity: int, width: int) -> None:
        self.count = 0
        self.key = np.zeros(capacity, dtype=np.int64)
        self.face = np.zeros(capacity, dtype=np.int64)
        self.weight = np.zeros((capacity, width))
        self.gap = np.zeros(capacity)
        self.normal = np.zeros((capacity, 3))
        self.arm = np.zeros((capacity, 3))
        self.stiffness = np.zeros(capacity)
        self.rigid = np.zeros(capacity, dtype=np.int64)
        self.turns = np.zeros(capacity, dtype=np.int64)
        self.curve = np.zeros((capacity, 3, 3))

    @property
    def capacity(self) -> int:
        """Number of rows that there is room for."""
        return len(self.key)

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """The columns that finding contacts fills, in the order in which kernels take them."""
        return (
            self.key, self.face, self.weight, self.gap, self.normal, self.arm, self.stiffness, self.rigid, self.turns,
        )

    def forces(self, smoothing: float) -> np.ndarray:
        """Return the normal forces [N], shape (count,); see `contact_force_kernels.normal_force`."""
        depth, stiffness = -self.gap[: self.count], self.stiffness[: self.count]
        return stiffness * np.where(depth < smoothing, depth**2 / (2.0 * smoothing), depth - 0.5 * smoothing)

    def friction(
        self, *, state: State, start: State, faces: np.ndarray, bound: np.ndarray, slip: np.ndarray, ratio: float
    ) -> FrictionRows:
        """Return the frictional contacts among the rows found at ``state``, referred to ``start``.

        bound: lagged mu N [N] of each row; slip: its stored elastic slip [m], in the frame of the rigid body;
        ratio: tangential over normal stiffness.
        """
        used = np.flatnonzero(bound > 0.0)
        key, face, rigid, weight = self.key[used], self.face[used], self.rigid[used], self.weight[used]
        point = np.zeros((len(used), 3))
        soft = face >= 0
        nodes = faces[face[soft]]
        point[soft] = np.einsum("na,nax->nx", np.where(nodes >= 0, weight[soft], 0.0), start.positions[nodes])
        arm, slip = self.arm[used], slip[used]
        for r in range(len(start.rigid_positions)):
            mine = rigid == r
            turning = mine & (self.turns[used] != 0)  # a ball touches a plane with its lowest point, however it turns
            then = start.rigid_rotations[r]
            arm[turning] = arm[turning] @ (then @ state.rigid_rotations[r].T).T
            slip[mine] = slip[mine] @ then.T
        return FrictionRows(
            key=key, face=face, weight=weight, rigid=rigid, bound=bound[used], stiffness=ratio * self.stiffness[used],
            normal=self.normal[used], start_point=point, start_arm=arm, start_slip=slip,
        )
