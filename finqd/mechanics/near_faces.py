"""Which faces of soft bodies may come to touch: a broad phase that costs next to nothing while nothing is near."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from finqd.mechanics.contact_surface import ContactSurface
from finqd.mechanics.near_faces_kernels import body_box, called_watches, gaps_left, same_numbers
from finqd.mechanics.proximity_kernels import CENTRE, near_pairs, refine_gaps
from finqd.scene import SoftBody

MARGIN = 20.0  # gaps that faces may come closer before their list is made anew
STALE = 25  # looks at a list that may have been in vain, after which it is made anew
WORTH = 0.1  # of the margin that bodies must have moved for that
FAR = 0.25  # of the margin beyond the gap from which on a rough bound of faces' distance will do
ROUNDING = 1e-9  # [m] of a distance that does not count as free way, as ways are added up
NONE = np.zeros((0, 2), dtype=np.int64)  # pairs of faces
NOTCH = 2.0  # gaps that faces of one body are apart at rest, at least, for them to touch each other
#: triangles of a face by its number of vertices, between its local points (see `finqd.mechanics.proximity_kernels`)
PIECES = {
    3: [(0, 1, 2)],
    4: [(0, 1, CENTRE), (1, 2, CENTRE), (2, 3, CENTRE), (3, 0, CENTRE)],
    6: [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)],
    8: [(i, j, CENTRE) for i, j in ((0, 4), (4, 1), (1, 5), (5, 2), (2, 6), (6, 3), (3, 7), (7, 0))],
}


@dataclass(frozen=True, kw_only=True)
class Triangulation:
    """The triangles of faces: those of face f are first[f] to first[f + 1], of n in all.

    corners: local points of their face, vertices: numbers of these points in the whole surface, edges: numbers of edges
    from each corner to the next, all of shape (n, 3); valence: triangles round each vertex, -1 where they do not close
    """

    first: np.ndarray
    corners: np.ndarray
    vertices: np.ndarray
    edges: np.ndarray
    valence: np.ndarray

    @classmethod
    def of(cls, faces: np.ndarray) -> Triangulation:
        """Cut up ``faces`` (n_faces, k)."""
        tables = {n: np.array(pieces, dtype=np.int64) for n, pieces in PIECES.items()}
        cut = [tables[n] for n in np.sum(faces >= 0, axis=1).tolist()]
        first = np.concatenate([[0], np.cumsum([len(pieces) for pieces in cut])]).astype(np.int64)
        corners = np.concatenate([np.zeros((0, 3), dtype=np.int64), *cut])
        owner = np.repeat(np.arange(len(faces)), np.diff(first))
        inner = np.where(corners == CENTRE, 0, corners)
        middles = int(faces.max(initial=-1)) + 1 + owner
        points = np.where(corners == CENTRE, middles[:, None], np.take_along_axis(faces[owner], inner, axis=1))
        _, vertices = np.unique(points, return_inverse=True)
        vertices = vertices.reshape(-1, 3)
        ends = np.sort(np.stack([vertices, np.roll(vertices, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
        keys = ends @ np.array([len(points) * points.shape[1], 1])  # sorting numbers is ten times as fast as rows
        _, edges, counts = np.unique(keys, return_inverse=True, return_counts=True)
        open_ends = ends[counts[edges] != 2]
        valence = np.bincount(vertices.ravel()) if len(vertices) else np.zeros(0, dtype=np.int64)
        valence[np.unique(open_ends)] = -1
        return cls(
            first=first, corners=corners, vertices=vertices, edges=edges.reshape(-1, 3),
            valence=valence.astype(np.int64),
        )


@dataclass
class _Watch:
    """Pairs of faces of one body, or of two, that were near at ``reference`` (n_vertices, 3).

    gaps: lower bound of the distance that each of them had there [m], (n,)
    seen: positions that were asked for last; moved, remaining: how much nearer any faces may have come there since [m],
    and the lower bounds that remain (n,)
    looks: at pairs on the list that may be nearer than the gap, since it was made
    """

    number: int
    bodies: tuple[int, int]
    faces: np.ndarray
    side: np.ndarray
    reference: np.ndarray | None = None
    listed: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    gaps: np.ndarray = field(default_factory=lambda: np.zeros(0))
    seen: np.ndarray | None = None
    moved: float = 0.0
    remaining: np.ndarray = field(default_factory=lambda: np.zeros(0))
    looks: int = 0


class NearFaces:
    """Pairs of faces that may be nearer to each other than ``gap`` [m], of one body or of two.

    Lists are made by boxes and separating axes, with a margin, and made anew when a body has deviated from a rigid
    motion by half of it (faces of one body), or two bodies have moved by it in sum. Two bodies whose boxes are apart
    have none. As long as no vertex has moved farther than faces were apart, nothing is looked at. Which pairs are
    listed beyond those nearer than the gap depends on the way there; that must not matter.

    Faces of one body that share a vertex, or are nearer at rest than `NOTCH` gaps (beside a notch, or on both sides of
    the thinnest wall), never touch each other.
    """

    def __init__(
        self, bodies: Sequence[SoftBody], surface: ContactSurface, *, gap: float,
        touches: Callable[[str, str], bool] = lambda one, other: True,
    ) -> None:
        """touches: which bodies can touch, by their names, the same twice for the faces of one."""
        self.gap, self.margin = gap, MARGIN * gap
        self.surface, self.faces, self.triangles = surface, surface.faces, Triangulation.of(surface.faces)
        self.spans = np.array([(body.first_vertex, body.first_vertex + body.mesh.n_vertices) for body in bodies])
        mine = [np.flatnonzero(surface.face_body == i) for i in range(len(bodies))]
        self.watches: list[_Watch] = []
        for i in range(len(bodies)):
            for j in range(i, len(bodies)):
                if not touches(bodies[i].name, bodies[j].name):
                    continue
                one, other = mine[i], mine[j] if j > i else mine[i][:0]
                ids, side = np.concatenate([one, other]), np.repeat([0, 1], [len(one), len(other)])
                self.watches.append(_Watch(len(self.watches), (i, j), ids, side))
        n = len(self.watches)
        self._bodies = np.array([watch.bodies for watch in self.watches], dtype=np.int64).reshape(n, 2)
        # how much nearer a watch's faces may come until two are nearer than the gap [m], since its bodies had drifted
        self._slack, self._mark = np.full(n, -np.inf), np.zeros((n, 2))  # by the marks [m]
        self._numbers = np.zeros(n, dtype=np.int64)
        self._apart = np.zeros(0, dtype=np.int64)
        rest = np.concatenate([body.mesh.vertices for body in bodies])
        self._moves = np.zeros_like(rest)
        self._drift, self._last = np.zeros(len(bodies)), rest.copy()
        self._here: np.ndarray | None = None  # what `_last` is a copy of
        self._end = self._same = rest  # where the last move was to end, and an array with the same numbers
        self._room = 256  # for pairs
        alone = [watch for watch in self.watches if len(set(watch.bodies)) == 1]
        notches = [self.pairs(rest, watch, NOTCH * gap)[0] for watch in alone]
        self._apart = np.sort(np.concatenate([self._apart, *(pairs @ self._radix for pairs in notches)]))

    @property
    def _radix(self) -> np.ndarray:
        return np.array([len(self.faces), 1], dtype=np.int64)

    def pairs(
        self, positions: np.ndarray, watch: _Watch, reach: float, direction: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the pairs of a watch's faces that may be nearer than ``reach`` [m], (n, 2), ascending.

        And lower bounds (n,) of their distances [m]. With a ``direction`` (n_vertices, 3) [m]: anywhere on the way.
        """
        found, gaps, moving = np.zeros((self._room, 2), dtype=np.int64), np.zeros(self._room), direction is not None
        moves = positions if direction is None else direction
        while True:
            count = near_pairs(
                positions, moves, moving, self.faces, watch.faces, watch.side, reach, self._apart, found, gaps
            )
            if count <= len(found):
                order = np.argsort(found[:count] @ self._radix)
                found, gaps = found[order], gaps[order]
                if moving:
                    return found, gaps
                triangles = self.triangles.first, self.triangles.corners
                refine_gaps(positions, *self.surface.lattices, *triangles, found, gaps, NOTCH * self.gap)
                near = gaps < reach
                return found[near], gaps[near]
            self._room = 2 * count
            found, gaps = np.zeros((self._room, 2), dtype=np.int64), np.zeros(self._room)

    def has_near(self, one: int, other: int) -> bool:
        """Tell whether faces of these two bodies have been within the gap and the margin of each other."""
        return any(len(watch.listed) > 0 for watch in self.watches if watch.bodies == (one, other))

    def at(self, positions: np.ndarray) -> np.ndarray:
        """Return pairs (n, 2), lower id first, ascending, with all that are nearer than the gap at ``positions``."""
        positions = self._known(positions)
        return self._joined([self._listed(positions, watch) for watch in self._called(positions)])

    def on_the_way(self, positions: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return pairs (n, 2), as `at` does, with all that may meet on the way to ``positions + direction``."""
        positions = self._known(positions)
        called = self._called(positions, direction)
        if not called:
            return NONE
        end, listed = positions + direction, []
        self._end = self._same = end
        for watch in called:
            if self._apart_by(watch, positions, end) > self.gap:
                continue
            self._renew(positions, watch)
            now = self._remaining(positions, watch)
            if self._moved(end, watch) <= self.margin:
                listed.append(watch.listed[np.minimum(now, self._remaining(end, watch)) <= self.gap])
            else:
                listed.append(self.pairs(positions, watch, self.gap, direction)[0])
        return self._joined(listed)

    def _known(self, positions: np.ndarray) -> np.ndarray:
        """Return the array that has been looked at if ``positions`` are the same numbers: most moves are gone whole."""
        if positions is self._same:
            return self._end
        if positions is not self._here and same_numbers(positions, self._end):
            self._same = positions
            return self._end
        return positions

    def _called(self, positions: np.ndarray, direction: np.ndarray | None = None) -> list[_Watch]:
        """Return the watches whose faces may meet at ``positions``, or on the way along ``direction`` from there."""
        moves, moving = (positions, False) if direction is None else (direction, True)
        count = called_watches(
            positions, positions is not self._here, moves, moving, self.spans, self._last, self._drift, self._bodies,
            self._slack, self._mark, self._numbers,
        )
        self._here = positions
        if count < 0:  # far, or no number
            self._last, self._drift = positions.copy(), np.zeros(len(self.spans))
            self._slack[:] = -np.inf
            return self.watches
        return [self.watches[i] for i in self._numbers[:count].tolist()] if count else []

    def _listed(self, positions: np.ndarray, watch: _Watch) -> np.ndarray:
        """Return the pairs of a watch that may be nearer than the gap at ``positions``, and renew its slack."""
        k, (one, other) = watch.number, watch.bodies
        self._mark[k, 0], self._mark[k, 1] = self._drift[one], self._drift[other]
        apart = self._apart_by(watch, positions)
        if apart > self.gap:
            self._slack[k] = apart - self.gap - ROUNDING
            return NONE
        self._renew(positions, watch)
        remaining = self._remaining(positions, watch)
        nearest = float(remaining.min(initial=np.inf)) - self.gap
        self._slack[k] = min(nearest, self.margin - watch.moved) - ROUNDING
        if nearest > 0.0:
            return NONE
        watch.looks += 1
        return watch.listed[remaining <= self.gap]

    def _apart_by(self, watch: _Watch, *places: np.ndarray) -> float:
        """Return how far the boxes of a watch's two bodies, over all ``places``, are apart along some axis [m].

        Negative if along none, and for the faces of one body.
        """
        if watch.bodies[0] == watch.bodies[1]:
            return -np.inf
        corners = []
        for b in watch.bodies:
            boxes = np.empty((len(places), 2, 3))
            for positions, box in zip(places, boxes, strict=True):
                body_box(positions, self.spans[b, 0], self.spans[b, 1], box[0], box[1])
            corners.append((boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)))
        (low, high), (other_low, other_high) = corners
        return float(max((low - other_high).max(), (other_low - high).max()))

    def _renew(self, positions: np.ndarray, watch: _Watch) -> None:
        """Make the list of a watch anew where it might lack a pair at ``positions``."""
        stale = watch.looks >= STALE and self._moved(positions, watch) > WORTH * self.margin
        if watch.reference is None or stale or not self._moved(positions, watch) <= self.margin:
            watch.reference, watch.seen, watch.looks = positions, None, 0
            watch.listed, watch.gaps = self.pairs(positions, watch, self.gap + self.margin)

    def _joined(self, listed: list[np.ndarray]) -> np.ndarray:
        listed = [pairs for pairs in listed if len(pairs)]
        if len(listed) < 2:
            return listed[0] if listed else NONE
        found = np.concatenate(listed)
        return found[np.argsort(found @ self._radix)]

    def _moved(self, positions: np.ndarray, watch: _Watch) -> float:
        """Return how much nearer faces of a watch may have come since its list was made [m]."""
        if watch.seen is not positions:
            watch.seen = positions
            watch.remaining = np.empty(len(watch.listed))
            watch.moved = gaps_left(
                positions, watch.reference, self.spans, *watch.bodies, self._moves,
                self.gap + FAR * self.margin, self.faces, watch.listed, watch.gaps, watch.remaining,
            )
        return watch.moved

    def _remaining(self, positions: np.ndarray, watch: _Watch) -> np.ndarray:
        """Return a lower bound of the distance of each pair of faces on a watch's list at ``positions`` [m]."""
        self._moved(positions, watch)
        return watch.remaining
