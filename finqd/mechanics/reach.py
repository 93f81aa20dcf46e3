"""Which bodies of a scene may touch, and when they first come within reach: contact costs from then on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from finqd.errors import InputError
from finqd.mechanics.near_faces_kernels import body_box

if TYPE_CHECKING:
    from finqd.mechanics.soft_contact import SoftContact
    from finqd.mechanics.state import State
    from finqd.scene import Plane, RigidBody, Scene

ROUNDING = 1e-9  # [m]
#: edges of faces by their number of vertices: corner, node between, corner
EDGES = {
    6: ((0, 3, 1), (1, 4, 2), (2, 5, 0)),
    8: ((0, 4, 1), (1, 5, 2), (2, 6, 3), (3, 7, 0)),
}


def met_by_soft(scene: Scene, other: RigidBody | Plane) -> bool:
    """Tell whether the soft bodies of ``scene`` touch ``other``; raises InputError if only some of them do."""
    touch = {scene.touches(body.name, other.name) for body in scene.soft_bodies}
    if len(touch) == 2:
        raise InputError("either all soft bodies touch it or none, with the contact penalty", other.name)
    return touch == {True}


class Reach:
    """Pairs of bodies that may touch, by name, and the time [s] at which they first were within reach of each other.

    Boxes about soft bodies against the balls that rigid ones fit into, heights over planes, and the lists of near faces
    (`finqd.mechanics.near_faces`). Nothing can touch before; ``times`` (n_pairs,) are NaN until then.
    """

    def __init__(self, scene: Scene, faces: np.ndarray) -> None:
        self.scene = scene
        self.spans = [(b.first_vertex, b.first_vertex + b.mesh.n_vertices) for b in scene.soft_bodies]
        self._edges = _bent_edges(faces)
        soft, rigid, planes = scene.soft_bodies, scene.rigid_bodies, scene.planes
        every = [("rigid", i, r, a.name, b.name) for i, a in enumerate(soft) for r, b in enumerate(rigid)]
        every += [("plane", i, p, a.name, b.name) for i, a in enumerate(soft) for p, b in enumerate(planes)]
        every += [("support", r, p, a.name, b.name) for r, a in enumerate(rigid) for p, b in enumerate(planes)]
        every += [("soft", i, j, soft[i].name, soft[j].name) for i in range(len(soft)) for j in range(i, len(soft))]
        self._pairs = [pair for pair in every if scene.touches(pair[3], pair[4])]
        self.times = np.full(len(self._pairs), np.nan)

    def near_rigid(self, state: State, i: int, r: int) -> bool:
        """Tell whether soft body ``i`` may touch rigid body ``r``: its box, against the ball that that fits into."""
        low, high = np.empty(3), np.empty(3)
        body_box(state.positions, *self.spans[i], low, high)
        centre = state.rigid_positions[r]
        away = np.maximum(np.maximum(low - centre, centre - high), 0.0)
        apart = float(np.sqrt(away @ away)) - self.scene.rigid_bodies[r].shape.bounding_radius - ROUNDING
        return not (apart > 0.0 and apart > self.bulge(state.positions))  # so for a NaN

    def bulge(self, positions: np.ndarray) -> float:
        """Return how far points on curved faces may lie outside the box of their vertices at ``positions`` [m].

        What lies on pieces between vertices is inside. A face's middle is the mean of its corners plus half of what
        its nodes between are off their edges, in sum: no more than the largest of these is outside.
        """
        if not len(self._edges):
            return 0.0
        one, between, other = self._edges.T
        off = positions[between] - 0.5 * (positions[one] + positions[other])
        return float(np.sqrt(np.max(np.einsum("ni,ni->n", off, off))))

    def any_near_rigid(self, state: State, r: int) -> bool:
        """Tell whether any soft body may touch rigid body ``r``."""
        return any(self.near_rigid(state, i, r) for i in range(len(self.spans)))

    def look(self, state: State, soft: SoftContact | None) -> None:
        """Note which pairs are within reach at ``state`` for the first time."""
        for k in np.flatnonzero(np.isnan(self.times)).tolist():
            kind, one, other, _, _ = self._pairs[k]
            if kind == "rigid":
                near = self.near_rigid(state, one, other)
            elif kind == "soft":
                near = soft is not None and soft.near.has_near(one, other)
            else:
                near = self._height(kind, state, one, other) <= 0.0
            if near:
                self.times[k] = state.time

    def _height(self, kind: str, state: State, one: int, p: int) -> float:
        """Return how high a soft body's lowest vertex is over a plane [m], or the ball that a rigid one fits into."""
        plane = self.scene.planes[p]
        if kind == "support":
            centre, shape = state.rigid_positions[one], self.scene.rigid_bodies[one].shape
            return float((centre - plane.point) @ plane.normal) - shape.bounding_radius
        first, end = self.spans[one]
        lowest = float(np.min((state.positions[first:end] - plane.point) @ plane.normal, initial=np.inf))
        return lowest - self.bulge(state.positions)

    def met(self) -> dict[tuple[str, str], float]:
        """Return when pairs came within reach first [s], by their names; pairs that have not are not in it."""
        return {(a, b): float(t) for (*_, a, b), t in zip(self._pairs, self.times) if not np.isnan(t)}


def _bent_edges(faces: np.ndarray) -> np.ndarray:
    """Return the edges of ``faces`` (n_faces, k) that have a node between their corners, (n, 3) vertices."""
    found = [np.zeros((0, 3), dtype=np.int64)]
    for size, edges in EDGES.items():
        mine = faces[np.sum(faces >= 0, axis=1) == size]
        if len(mine):
            found.append(mine[:, np.array(edges)].reshape(-1, 3))
    return np.unique(np.concatenate(found), axis=0)
