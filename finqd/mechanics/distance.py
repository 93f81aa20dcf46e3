"""Makes the `DistanceField` of a sphere, of a solid of revolution and of a closed triangle surface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from finqd.mechanics.distance_kernels import REVOLUTION, SPHERE, SURFACE, DistanceField

LEAF_SIZE = 4  # triangles a leaf of the tree holds at most; 2 to 8 measure alike
DISC_TRIANGLES = 512  # nodes of more triangles have no disc: surfaces are too much bent over them
SPARE = 1e-9  # [m] by which discs are larger than they must be, for rounding
FLAT = 1e-6  # a triangle lower than this share of its longest side is rounding noise in a single-precision file


def sphere_field(radius: float) -> DistanceField:
    """Return the field of a sphere of ``radius`` [m] about the origin."""
    return _field(kind=SPHERE, radius=float(radius))


def revolution_field(profile: np.ndarray, hollow: np.ndarray | None = None) -> DistanceField:
    """Return the field of a solid of revolution about z.

    profile: closed polygon (r, z) [m] with r >= 0, shape (n, 2), counterclockwise, not repeating its first point. Edges
    on the axis lie inside the solid and are left out; a profile that stays off the axis makes a ring or a tube.
    hollow: radius [m] of the circular arc, bent inwards, that a side is, and 0 for a straight one; shape (n,).
    """
    start = np.asarray(profile, dtype=float)
    edge = np.roll(start, -1, axis=0) - start
    length = np.hypot(edge[:, 0], edge[:, 1])
    normal = np.column_stack([edge[:, 1], -edge[:, 0]]) / length[:, None]
    radius = np.zeros(len(start)) if hollow is None else np.maximum(hollow, np.where(hollow, length / 2.0, 0.0))
    bend = np.divide(1.0, radius, where=radius > 0.0, out=np.zeros(len(start)))
    sine = 0.5 * bend * length  # of half the angle of an arc: its normal turns by that from the chord's to either end
    begins, ends = (np.sqrt(1.0 - sine**2)[:, None] * normal + s * (sine / length)[:, None] * edge for s in (1, -1))
    on_axis = (start[:, 0] == 0.0) & (edge[:, 0] == 0.0)
    mirrored = [np.where(on_axis[:, None], 0.0, n) for n in (begins, ends)]  # the axis says nothing about the surface
    at_start = mirrored[0] + np.roll(mirrored[1], 1, axis=0)
    at_start[start[:, 0] == 0.0, 0] = 0.0  # an apex: its pseudonormal is along the axis
    at_start /= np.maximum(np.hypot(at_start[:, 0], at_start[:, 1]), 1e-300)[:, None]
    at_end = np.roll(at_start, -1, axis=0)
    rows = np.column_stack([start, edge, length**-2.0, normal, at_start, at_end, bend])
    return _field(kind=REVOLUTION, rows=rows[~on_axis])


def surface_field(
    vertices: np.ndarray, triangles: np.ndarray, *, topology: tuple[np.ndarray, np.ndarray] | None = None
) -> DistanceField:
    """Return the field of a watertight, outward oriented triangle surface.

    vertices: [m], shape (n, 3); triangles: shape (m, 3), every edge shared by exactly two of them (else ValueError);
    topology: what `triangle_neighbours` returns for them, if it is known.
    """
    vertices = np.asarray(vertices, dtype=float)
    triangles = np.asarray(triangles, dtype=np.int64)
    edge_of, neighbours = topology or triangle_neighbours(triangles)
    normals, flat = triangle_normals(vertices, triangles, neighbours)
    edge_normals = _edge_normals(vertices, triangles, edge_of, neighbours, normals, flat)
    pseudonormals = _unit(np.concatenate([edge_normals, _vertex_normals(vertices, triangles, normals)]))
    features = np.concatenate([edge_of, triangles + len(edge_normals)], axis=1)
    solid = np.flatnonzero(~flat)  # a flat triangle is no closer to anything than its neighbours are
    order, leaf_size = _leaf_order(vertices[triangles[solid]].mean(axis=1))
    order = solid[order]
    corners = vertices[triangles[order]]
    return _field(
        kind=SURFACE,
        rows=np.concatenate([corners.reshape(-1, 9), normals[order]], axis=1),
        features=features[order],
        pseudonormals=pseudonormals,
        boxes=_tree_boxes(corners, normals[order], leaf_size),
        leaf_size=leaf_size,
    )


def field_arrays(field: DistanceField) -> dict[str, np.ndarray]:
    """Return a field as named arrays from which `field_of` makes it again."""
    return {name: np.asarray(value) for name, value in field._asdict().items()}


def field_of(arrays: Mapping[str, np.ndarray]) -> DistanceField:
    """Return the field that `field_arrays` took apart. Raises KeyError if something is missing."""
    given = {name: arrays[name] for name in DistanceField._fields}
    return DistanceField(**{name: value if value.ndim else value.item() for name, value in given.items()})


def triangle_normals(
    vertices: np.ndarray, triangles: np.ndarray, neighbours: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals of ``triangles``, shape (m, 3), and which of them are flat (without area), shape (m,).

    A flat triangle, as exporters leave them where one edge meets two, has no normal of its own: it gets that of its
    neighbour across its longest side, as if that side had been flipped.
    """
    points = vertices[triangles]
    cross = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    sides = np.linalg.norm(np.roll(points, -1, axis=1) - points, axis=2)
    flat = np.linalg.norm(cross, axis=1) <= FLAT * sides.max(axis=1) ** 2
    normals = _unit(cross)
    rows = np.flatnonzero(flat)
    normals[rows] = normals[neighbours[rows, np.argmax(sides[rows], axis=1)]]
    return normals, flat


def triangle_neighbours(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (edge_of, neighbours), both of shape (m, 3): edge number, and the triangle beyond sides ab, bc, ca.

    Raises ValueError if an edge is not shared by exactly two triangles.
    """
    edges, edge_of, counts = edge_table(triangles)
    if np.any(counts != 2):
        raise ValueError(f"{np.count_nonzero(counts != 2)} edges are not shared by exactly two triangles")
    pairs = np.argsort(edge_of.reshape(-1), kind="stable").reshape(-1, 2)
    neighbours = np.empty(triangles.size, dtype=np.int64)
    neighbours[pairs[:, 0]], neighbours[pairs[:, 1]] = pairs[:, 1] // 3, pairs[:, 0] // 3
    return edge_of, neighbours.reshape(-1, 3)


def edge_table(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return edges and who shares them: (edges (n, 2), edge_of (m, 3), counts (n,)).

    edge_of: row of ``edges`` for the edges ab, bc, ca of each triangle.
    """
    sides = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    ends = np.sort(sides.astype(np.int64), axis=1)
    n = int(triangles.max()) + 1
    keys, edge_of, counts = np.unique(ends[:, 0] * n + ends[:, 1], return_inverse=True, return_counts=True)
    return np.column_stack([keys // n, keys % n]), edge_of.reshape(-1, 3), counts


def _field(**given: Any) -> DistanceField:
    """Fill what is not given with empty arrays, and fix types and memory order: one Numba type for all shapes."""
    columns = {"rows": 12, "features": 6, "pseudonormals": 3, "boxes": 12}
    arrays = {
        name: np.ascontiguousarray(given.get(name, np.zeros((0, n))), dtype="i4" if name == "features" else "f8")
        for name, n in columns.items()
    }
    kind, radius, leaf_size = given["kind"], given.get("radius", 0.0), given.get("leaf_size", 0)
    return DistanceField(kind=kind, radius=radius, leaf_size=leaf_size, **arrays)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Return ``vectors`` at length 1 (a zero vector stays zero)."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)[:, None]


def _edge_normals(
    vertices: np.ndarray,
    triangles: np.ndarray,
    edge_of: np.ndarray,
    neighbours: np.ndarray,
    normals: np.ndarray,
    flat: np.ndarray,
) -> np.ndarray:
    """Return the sum of both triangle normals at each edge, shape (n_edges, 3)."""
    sums = np.empty((edge_of.max() + 1, 3))
    sums[edge_of] = normals[:, None, :] + normals[neighbours]
    for row in np.flatnonzero(flat):  # beyond the longest side lie, in truth, the neighbours of the other two
        points = vertices[triangles[row]]
        longest = np.argmax(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1))
        others = neighbours[row, [(longest + 1) % 3, (longest + 2) % 3]]
        sums[edge_of[row, longest]] = 2 * normals[neighbours[row, longest]] + normals[others].sum(axis=0)
    return sums


def _vertex_normals(vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the sum of triangle normals at each vertex, weighted by the angle each triangle has there."""
    angles = corner_angles(vertices, triangles)
    sums = np.zeros((len(vertices), 3))
    for corner in range(3):
        for axis in range(3):
            weights = angles[:, corner] * normals[:, axis]
            sums[:, axis] += np.bincount(triangles[:, corner], weights=weights, minlength=len(vertices))
    return sums


def corner_angles(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the angle [rad] of each triangle at each of its corners, shape (m, 3)."""
    points = vertices[triangles]
    to_next = np.roll(points, -1, axis=1) - points
    to_last = np.roll(points, 1, axis=1) - points
    sine = np.linalg.norm(np.cross(to_next, to_last), axis=2)
    return np.arctan2(sine, np.einsum("ijk,ijk->ij", to_next, to_last))


def _leaf_order(centres: np.ndarray) -> tuple[np.ndarray, int]:
    """Order triangles so that equal runs of them are compact: halve at the median of the longest axis, level by level.

    Returns (order, leaf_size). The last triangles repeat until all leaves are full, so that levels are plain reshapes.
    """
    n = len(centres)
    n_levels = max(0, int(np.ceil(np.log2(n / LEAF_SIZE))))
    leaf_size = -(-n // 2**n_levels)
    order = np.minimum(np.arange(leaf_size * 2**n_levels), n - 1)[None, :]
    for _ in range(n_levels):
        points = centres[order]
        axis = np.argmax(points.max(axis=1) - points.min(axis=1), axis=1)
        keys = np.take_along_axis(points, axis[:, None, None], axis=2)[:, :, 0]
        half = order.shape[1] // 2
        order = np.take_along_axis(order, np.argpartition(keys, half - 1, axis=1), axis=1).reshape(-1, half)
    return order.reshape(-1), leaf_size


def _tree_boxes(corners: np.ndarray, normals: np.ndarray, leaf_size: int) -> np.ndarray:
    """Return the boxes and discs of a complete binary tree over runs of ``leaf_size`` triangles, (2 n_leaves, 12).

    corners: of the triangles [m], (n_slots, 3, 3); normals: theirs, (n_slots, 3)
    """
    n_leaves = len(corners) // leaf_size
    boxes = np.zeros((2 * n_leaves, 12))
    runs = corners.reshape(n_leaves, -1, 3)
    boxes[n_leaves:, :3], boxes[n_leaves:, 3:6] = runs.min(axis=1), runs.max(axis=1)
    first = n_leaves // 2
    while first >= 1:
        children = boxes[2 * first : 4 * first, :6].reshape(first, 2, 6)
        boxes[first : 2 * first, :3] = children[:, :, :3].min(axis=1)
        boxes[first : 2 * first, 3:6] = children[:, :, 3:].max(axis=1)
        first //= 2
    boxes[:, 9:] = -np.inf, np.inf, np.inf  # a disc that leaves nothing out
    first, size = n_leaves, leaf_size
    while first >= 1 and size <= DISC_TRIANGLES:
        _add_discs(boxes[first : 2 * first], corners, normals)
        first, size = first // 2, 2 * size
    return boxes


def _add_discs(boxes: np.ndarray, corners: np.ndarray, normals: np.ndarray) -> None:
    """Write the discs of all nodes of one level into their ``boxes`` (n_nodes, 12); see `outside_disc`."""
    axes = _unit(normals.reshape(len(boxes), -1, 3).sum(axis=1))
    points = corners.reshape(len(boxes), -1, 3)
    along = np.einsum("npi,ni->np", points, axes)
    arms = points - 0.5 * (boxes[:, None, :3] + boxes[:, None, 3:6])
    beside2 = np.einsum("npi,npi->np", arms, arms) - np.einsum("npi,ni->np", arms, axes) ** 2
    boxes[:, 6:9] = axes
    boxes[:, 9], boxes[:, 10] = along.min(axis=1) - SPARE, along.max(axis=1) + SPARE
    boxes[:, 11] = np.sqrt(np.maximum(beside2.max(axis=1), 0.0)) + SPARE
