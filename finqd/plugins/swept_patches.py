"""Quadrilaterals in a profile that comes as three- and four-sided patches.

How many edges a segment of a patch's rim gets is an integer program: as near as possible to length / size, opposite
sides of a four-sided patch equal, the three sides of a triangle such that it falls into three four-sided ones (midpoint
subdivision). Nodes inside a patch come from transfinite interpolation between its sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from finqd.errors import MeshError
from finqd.solid import Patch, ring_area

_SAME_POINT = 1e-9  # [m]


@dataclass(frozen=True, eq=False)
class PlaneMesh:
    """Nodes [m] (n, 2), quadrilaterals (m, 4) and triangles (k, 3), counter-clockwise."""

    points: np.ndarray
    quads: np.ndarray
    triangles: np.ndarray

    def area(self) -> float:
        """Return the area [m^2]."""
        return sum(abs(ring_area(self.points[corners])) for kind in (self.quads, self.triangles) for corners in kind)

    def worst(self) -> float:
        """Return the smallest sine of an element's corner angle, negative if it is turned over."""
        return min(float(corner_sines(self.points[e]).min()) for e in (self.quads, self.triangles) if len(e))


def corner_sines(corners: np.ndarray) -> np.ndarray:
    """Return the sines of the corner angles of polygons (..., n, 2), shape (..., n)."""
    after = np.roll(corners, -1, axis=-2) - corners
    before = np.roll(corners, 1, axis=-2) - corners
    cross = after[..., 0] * before[..., 1] - after[..., 1] * before[..., 0]
    scale = np.linalg.norm(after, axis=-1) * np.linalg.norm(before, axis=-1)
    return cross / np.maximum(scale, np.finfo(float).tiny)


def mesh_patches(patches: Sequence[Patch], size: float, least: int, grading: float = 1.0) -> PlaneMesh:
    """Return the mesh of a profile in patches, edges about ``size`` [m], at least ``least`` a segment.

    ``grading``: exponent of `graded`, by which nodes crowd towards the ends of each segment.

    Raises ``MeshError`` if no numbers of edges fit together.
    """
    points, sides = _numbered(patches)
    segments: dict[tuple[int, int], int] = {}
    for patch in sides:
        for side in patch:
            for a, b in zip(side, side[1:], strict=False):
                segments.setdefault((min(a, b), max(a, b)), len(segments))
    pairs = np.array(list(segments))
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    rims = [[[segments[min(a, b), max(a, b)] for a, b in zip(s, s[1:], strict=False)] for s in p] for p in sides]
    counts = edge_counts(rims, np.maximum(lengths / size, least), least)
    return _Builder(points, pairs, counts, grading).mesh(sides, segments)


def graded(count: int, grading: float) -> np.ndarray:
    """Return the count + 1 shares in [0, 1] at which a segment is divided, symmetric.

    (2 t)^g / 2 up to the middle, at even t: g = 1 is even; with g > 1 the edges shrink towards both ends, where patches
    meet and the stress of a notch is singular (Babuska, Kellogg and Pitkaranta, Numer. Math. 33 (1979) 447).
    """
    half = np.linspace(0.0, 1.0, count + 1)
    near = np.minimum(half, 1.0 - half)
    share = 0.5 * (2.0 * near) ** grading
    return np.where(half <= 0.5, share, 1.0 - share)


def _numbered(patches: Sequence[Patch]) -> tuple[np.ndarray, list[list[list[int]]]]:
    """Return the distinct points (n, 2) and the patches' sides as lists of point ids."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    flat = np.concatenate([side for patch in patches for side in patch])
    near = cKDTree(flat).query_pairs(_SAME_POINT, output_type="ndarray")
    links = coo_array((np.ones(len(near)), (near[:, 0], near[:, 1])), shape=(len(flat), len(flat)))
    count, ids = connected_components(links, directed=False)
    _, first = np.unique(ids, return_index=True)
    sides: list[list[list[int]]] = []
    start = 0
    for patch in patches:
        sides.append([])
        for side in patch:
            sides[-1].append(ids[start : start + len(side)].tolist())
            start += len(side)
    return flat[first], sides


def edge_counts(rims: Sequence[Sequence[Sequence[int]]], wanted: np.ndarray, least: int) -> np.ndarray:
    """Return the number of edges of each segment, as near to ``wanted`` (n,) as the patches allow.

    rims: the segments of each side of each patch. Minimises sum |n_s - w_s| / w_s subject to the sides' balance.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import coo_array

    n = len(wanted)
    rows: list[int] = []
    columns: list[int] = []
    values: list[float] = []
    n_rows, n_columns = 0, 2 * n

    def equation(*terms: tuple[Sequence[int], float]) -> None:
        nonlocal n_rows
        for indices, value in terms:
            rows.extend([n_rows] * len(indices))
            columns.extend(indices)
            values.extend([value] * len(indices))
        n_rows += 1

    for rim in rims:
        if len(rim) == 4:
            equation((rim[0], 1.0), (rim[2], -1.0))
            equation((rim[1], 1.0), (rim[3], -1.0))
        else:  # corner i owns the count of the side opposite to it, split in two
            for i in range(3):
                equation((rim[i], 1.0), ([n_columns + i, n_columns + (i + 1) % 3], -1.0))
            n_columns += 3
    equal_rows = n_rows
    for s in range(n):  # slack n + s bounds |n_s - w_s|
        equation(([s], 1.0), ([n + s], -1.0))
        equation(([s], -1.0), ([n + s], -1.0))
    upper = np.concatenate([np.zeros(equal_rows), np.column_stack([wanted, -wanted]).ravel()])
    lower = np.concatenate([np.zeros(equal_rows), np.full(2 * n, -np.inf)])
    matrix = coo_array((values, (rows, columns)), shape=(n_rows, n_columns)).tocsr()
    cost, integral, floor = np.zeros(n_columns), np.ones(n_columns), np.ones(n_columns)
    cost[n : 2 * n], integral[n : 2 * n], floor[n : 2 * n], floor[:n] = 1.0 / wanted, 0.0, 0.0, least
    result = milp(cost, integrality=integral, bounds=Bounds(floor, np.inf),
                  constraints=LinearConstraint(matrix, lower, upper), options={"time_limit": 20.0})
    if result.x is None:
        raise MeshError(f"no numbers of edges fit the profile's patches ({result.message})")
    return np.rint(result.x[:n]).astype(int)


class _Builder:
    """Collects nodes and quadrilaterals, patch by patch."""

    def __init__(self, points: np.ndarray, pairs: np.ndarray, counts: np.ndarray, grading: float) -> None:
        self.graded = grading != 1.0
        self.points = [np.asarray(points)]
        self.n_points = len(points)
        self.quads: list[np.ndarray] = []
        self.inner = []
        for (a, b), count in zip(pairs, counts, strict=True):
            share = graded(count, grading)[1:-1, None]
            self.inner.append(self._add(points[a] + share * (points[b] - points[a])))

    def mesh(self, sides: list[list[list[int]]], segments: dict[tuple[int, int], int]) -> PlaneMesh:
        for patch in sides:
            rim = [self._side(side, segments) for side in patch]
            if len(rim) == 4:
                self._grid(*rim)
            else:
                self._triangle(*rim)
        return PlaneMesh(np.concatenate(self.points), np.concatenate(self.quads), np.empty((0, 3), dtype=int))

    def _add(self, points: np.ndarray) -> np.ndarray:
        ids = np.arange(self.n_points, self.n_points + len(points))
        self.points.append(points)
        self.n_points += len(points)
        return ids

    def _side(self, corners: list[int], segments: dict[tuple[int, int], int]) -> np.ndarray:
        nodes = [np.array(corners[:1])]
        for a, b in zip(corners, corners[1:], strict=False):
            inner = self.inner[segments[min(a, b), max(a, b)]]
            nodes += [inner if a < b else inner[::-1], np.array([b])]
        return np.concatenate(nodes)

    def _grid(self, bottom: np.ndarray, right: np.ndarray, top: np.ndarray, left: np.ndarray) -> None:
        """Fill a four-sided patch, its sides' node ids in counter-clockwise order."""
        points = self._all()
        sides = [points[side] for side in (bottom, right, top, left)]
        inner = _coons(*sides, by_length=self.graded)[1:-1, 1:-1]
        ids = np.empty((len(right), len(bottom)), dtype=int)
        ids[0], ids[-1], ids[:, 0], ids[:, -1] = bottom, top[::-1], left[::-1], right
        ids[1:-1, 1:-1] = self._add(inner.reshape(-1, 2)).reshape(inner.shape[:2])
        self.quads.append(_cells(ids).reshape(-1, 4))

    def _triangle(self, *sides: np.ndarray) -> None:
        """Fill a three-sided patch by three grids that meet in a point inside it."""
        points = self._all()
        first, spokes = _halves([len(side) - 1 for side in sides])
        centre = _centre([points[side] for side in sides], first, spokes, by_length=self.graded)
        hub = self._add(centre[None])
        arms = []
        for side, k, edges in zip(sides, first, spokes, strict=True):
            inner = self._add(_between(points[side[k]], centre, edges)[1:-1])
            arms.append(np.concatenate([side[k : k + 1], inner, hub]))
        for i in range(3):
            self._grid(sides[i][: first[i] + 1], arms[i], arms[i - 1][::-1], sides[i - 1][first[i - 1] :])

    def _all(self) -> np.ndarray:
        if len(self.points) > 1:
            self.points = [np.concatenate(self.points)]
        return self.points[0]


def _between(start: np.ndarray, end: np.ndarray, edges: int) -> np.ndarray:
    """Return edges + 1 points evenly from ``start`` (2,) to ``end`` (..., 2), shape (..., edges + 1, 2)."""
    return start + np.linspace(0.0, 1.0, edges + 1)[:, None] * (end[..., None, :] - start)


def _coons(
    bottom: np.ndarray, right: np.ndarray, top: np.ndarray, left: np.ndarray, *, by_length: bool = False
) -> np.ndarray:
    """Return the points (..., rows, columns, 2) between four sides, counter-clockwise (discrete Coons patch).

    by_length: opposite sides are blended by the arc length along the other two instead of by number, so that graded
    sides do not skew the inside.
    """
    top, left = top[..., ::-1, :], left[..., ::-1, :]
    u = np.linspace(0.0, 1.0, bottom.shape[-2])[None, :, None]
    v = np.linspace(0.0, 1.0, left.shape[-2])[:, None, None]
    if by_length:
        u = 0.5 * (_arc_shares(bottom) + _arc_shares(top))[..., None, :, None]
        v = 0.5 * (_arc_shares(left) + _arc_shares(right))[..., :, None, None]
    ruled = (1 - v) * bottom[..., None, :, :] + v * top[..., None, :, :]
    ruled = ruled + (1 - u) * left[..., :, None, :] + u * right[..., :, None, :]
    for side, end, weight in ((bottom, 0, 1 - u), (bottom, -1, u)):
        ruled = ruled - weight * (1 - v) * side[..., end, :][..., None, None, :]
    for side, end, weight in ((top, 0, 1 - u), (top, -1, u)):
        ruled = ruled - weight * v * side[..., end, :][..., None, None, :]
    return ruled


def _arc_shares(side: np.ndarray) -> np.ndarray:
    """Return how far along a side (..., n, 2) its points lie, as shares (..., n) of its length."""
    edges = np.linalg.norm(np.diff(side, axis=-2), axis=-1)
    along = np.concatenate([np.zeros((*edges.shape[:-1], 1)), np.cumsum(edges, axis=-1)], axis=-1)
    return along / along[..., -1:]


def _cells(grid: np.ndarray) -> np.ndarray:
    """Return the corners of the cells of a grid (rows, columns, ...), (rows - 1, columns - 1, 4, ...)."""
    return np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2)


def _halves(counts: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return how many edges of each side of a triangle lie before its middle node, and edges from there to the hub."""
    first = [(counts[i] + counts[(i + 1) % 3] - counts[(i + 2) % 3]) // 2 for i in range(3)]
    return first, [counts[i - 1] - first[i - 1] for i in range(3)]


def _centre(
    sides: Sequence[np.ndarray], first: Sequence[int], spokes: Sequence[int], *, by_length: bool
) -> np.ndarray:
    """Return where the three grids of a triangle should meet: the best worst corner among many points tried."""
    corners = np.array([side[0] for side in sides])
    middle = np.array([side[k] for side, k in zip(sides, first, strict=True)])
    shares = np.array([(i, j, 16 - i - j) for i in range(1, 15) for j in range(1, 16 - i)]) / 16.0
    parts = [corners, middle, *(np.array([corners[i], middle[i], middle[i - 1]]) for i in range(3))]
    hubs = np.concatenate([shares @ part for part in parts])
    arms = [_between(side[k], hubs, edges) for side, k, edges in zip(sides, first, spokes, strict=True)]
    worst = np.full(len(hubs), np.inf)
    for i in range(3):
        start, end = sides[i][: first[i] + 1], sides[i - 1][first[i - 1] :]
        grid = _coons(start, arms[i], arms[i - 1][:, ::-1], end, by_length=by_length)
        worst = np.minimum(worst, corner_sines(_cells(np.moveaxis(grid, 0, 2)).swapaxes(2, 3)).min(axis=(0, 1, 3)))
    return hubs[int(np.argmax(worst))]
