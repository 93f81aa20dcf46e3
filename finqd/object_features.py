"""What of an object pokes and what it stands on: samples of its sharp edges, points of its hull, its pose at rest."""

from __future__ import annotations

import numpy as np

from finqd.mechanics.distance import corner_angles, triangle_normals

SPACING = 1e-3  # between samples of a sharp edge [m]
SHARP = np.deg2rad(20.0)  # a smaller angle between two faces' normals is a curved surface's facet, not an edge
FEATURE_LIMIT = 20_000  # samples; a rough scan is sampled more coarsely
SUPPORT_LIMIT = 400  # points; on a ball of 20 mm in radius the floor then reaches up to 0.2 mm between them
STABLE = np.deg2rad(1.0)  # tilt that a resting pose must survive


def surface_features(
    vertices: np.ndarray, triangles: np.ndarray, topology: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return (points (n, 3), lengths (n,)) [m]: samples of sharp convex edges, then tips with length 0.

    vertices: [m], shape (k, 3); triangles: shape (m, 3), watertight and outward; topology: of `triangle_neighbours`.
    """
    normals, _ = triangle_normals(vertices, triangles, topology[1])
    ends = _sharp_edges(vertices, triangles, normals, topology)
    tips = _sharp_vertices(vertices, triangles, normals)
    edge_lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    spacing = SPACING
    while True:
        points, lengths = _sample_edges(ends, edge_lengths, spacing)
        if len(points) <= FEATURE_LIMIT:
            break
        spacing *= 2.0
    tips = tips[:: -(-len(tips) // FEATURE_LIMIT)] if len(tips) else tips
    return np.concatenate([points, vertices[tips]]), np.concatenate([lengths, np.zeros(len(tips))])


def revolution_features(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (points, lengths) as `surface_features`: rings on the sharp rims of a profile (r, z) [m], and its tips."""
    edges = np.roll(profile, -1, axis=0) - profile
    before = np.roll(edges, 1, axis=0)
    turn = np.arctan2(before[:, 0] * edges[:, 1] - before[:, 1] * edges[:, 0], np.einsum("ij,ij->i", before, edges))
    points, lengths = [np.zeros((0, 3))], [np.zeros(0)]
    for (r, z), angle in zip(profile, turn):
        # at the axis the profile meets its mirror image: an edge that leaves the axis at a right angle is no tip
        if r == 0.0 and angle > np.pi / 2.0 + SHARP / 2.0:
            points.append(np.array([[0.0, 0.0, z]]))
            lengths.append(np.zeros(1))
        elif r > 0.0 and angle > SHARP:
            n = max(8, int(np.ceil(2.0 * np.pi * r / SPACING)))
            points.append(ring(r, z, n))
            lengths.append(np.full(n, 2.0 * np.pi * r / n))
    return np.concatenate(points), np.concatenate(lengths)


def ring(r: float, z: float, n: int) -> np.ndarray:
    """Return ``n`` points [m] around z at radius r, height z, shape (n, 3); +x lies between the last and the first."""
    angles = 2.0 * np.pi * (np.arange(n) + 0.5) / n
    return np.column_stack([r * np.cos(angles), r * np.sin(angles), np.full(n, z)])


def revolution_supports(profile: np.ndarray, *, n_around: int) -> np.ndarray:
    """Return points [m], shape (m, 3), on which a solid of revolution can stand: its hull's tips and rings of samples.

    A ring lies so that a side of its polygon faces +x and one -x: a lathe laid down on that side rests on two samples
    of each rim rather than balancing on one.
    """
    from scipy.spatial import ConvexHull

    both = np.concatenate([profile, profile * [-1.0, 1.0]])
    hull = both[ConvexHull(both).vertices]
    rims = np.unique(hull[hull[:, 0] > 0.0], axis=0)
    tips = hull[hull[:, 0] == 0.0]
    n = min(n_around, max(24, 2 * n_around // max(len(rims), 1)))
    points = [ring(r, z, n) for r, z in rims] + [np.array([[0.0, 0.0, z]]) for _, z in tips]
    return thinned(np.concatenate(points), SUPPORT_LIMIT)


def surface_supports(vertices: np.ndarray) -> np.ndarray:
    """Return hull vertices [m] of a surface, at most `SUPPORT_LIMIT` of them."""
    from scipy.spatial import ConvexHull

    near_hull = _extremes(vertices) if len(vertices) > 20_000 else vertices
    return thinned(near_hull[np.sort(ConvexHull(near_hull).vertices)], SUPPORT_LIMIT)


def thinned(points: np.ndarray, limit: int) -> np.ndarray:
    """Return at most ``limit`` of ``points``, spread evenly: each next one is the farthest from those taken."""
    if len(points) <= limit:
        return points
    chosen = [int(np.argmax(np.einsum("ij,ij->i", points, points)))]
    distance2 = np.full(len(points), np.inf)
    for _ in range(limit - 1):
        offset = points - points[chosen[-1]]
        distance2 = np.minimum(distance2, np.einsum("ij,ij->i", offset, offset))
        chosen.append(int(np.argmax(distance2)))
    return points[np.sort(chosen)]


def rest_pose(supports: np.ndarray, orientation: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return how a body comes to rest on z = 0: (rotation (3, 3), height of the centre of mass [m], tilt [rad]).

    supports: hull points [m] about the centre of mass; orientation: how the body is set down, body to world. It topples
    by the smallest angle (``tilt``) that brings a stable facet of the hull down. A facet is stable if the centre of
    mass stays above it under a tilt of `STABLE`; a hull without such a facet takes the one with the lowest centre.
    """
    normals, heights, margins = support_facets(supports)
    stable = margins >= STABLE
    if not stable.any():
        stable = heights <= heights.min() * (1.0 + 1e-9)
    normals, heights = normals[stable], heights[stable]
    down = -orientation[2]
    tilts = np.arctan2(np.linalg.norm(np.cross(normals, down), axis=1), normals @ down)
    facing = normals @ orientation.T
    # a lathe topples to all sides alike: of those it takes the one towards +x
    ties = (-np.round(facing[:, 1], 6), -np.round(facing[:, 0], 6), np.round(heights, 9), np.round(tilts, 6))
    best = np.lexsort(ties)[0]
    rotation = _turn(facing[best], np.array([0.0, 0.0, -1.0])) @ orientation
    return rotation, float(-(supports @ rotation[2]).min()), float(tilts[best])


def support_facets(supports: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return facets of the hull: (outward normals (n, 3), heights of the centre of mass [m], tilt margins [rad]).

    The margin is the tilt at which the body falls over the nearest side of the facet; negative: it already does.
    """
    from scipy.spatial import ConvexHull

    size = np.ptp(supports, axis=0).max()
    equations = ConvexHull(supports).equations
    scaled = np.round(np.column_stack([equations[:, :3], equations[:, 3] / size]), 6)
    _, first = np.unique(scaled, axis=0, return_index=True)
    normals, heights = equations[np.sort(first), :3], -equations[np.sort(first), 3]
    margins = np.array([_tilt_margin(supports, n, h, 1e-5 * size) for n, h in zip(normals, heights)])
    return normals, heights, margins


def _tilt_margin(supports: np.ndarray, normal: np.ndarray, height: float, tolerance: float) -> float:
    """Return the smallest tilt [rad] about a side of a facet that brings the centre of mass over that side."""
    base = supports[supports @ normal > height - tolerance]
    across = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.7 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    flat = base @ np.column_stack([across, np.cross(normal, across)])  # the centre of mass is at the origin
    centre = flat.mean(axis=0)
    flat = flat[np.argsort(np.arctan2(flat[:, 1] - centre[1], flat[:, 0] - centre[0]))]
    sides = np.roll(flat, -1, axis=0) - flat
    lengths = np.linalg.norm(sides, axis=1)
    keep = lengths > tolerance
    inside = (sides[:, 1] * flat[:, 0] - sides[:, 0] * flat[:, 1])[keep] / lengths[keep]
    return float(np.arctan2(inside.min(), height))


def _turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the smallest rotation that takes unit vector ``start`` to unit vector ``end``."""
    axis = np.cross(start, end)
    cosine = float(start @ end)
    if cosine < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0]) if abs(start[0]) < 0.5 else np.diag([-1.0, 1.0, -1.0])
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)


def _sharp_edges(
    vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray, topology: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return end points [m] of the edges whose faces turn outwards by more than `SHARP`, shape (n, 2, 3)."""
    edge_of, neighbours = topology
    position = np.empty(edge_of.max() + 1, dtype=np.int64)
    position[edge_of.reshape(-1)] = np.arange(edge_of.size)
    here, side = np.divmod(position, 3)
    there = neighbours[here, side]
    sharp = np.flatnonzero(np.einsum("ij,ij->i", normals[here], normals[there]) < np.cos(SHARP))
    here, side, there = here[sharp], side[sharp], there[sharp]
    towards = vertices[triangles[there]].mean(axis=1) - vertices[triangles[here]].mean(axis=1)
    convex = np.einsum("ij,ij->i", normals[there] - normals[here], towards) > 0.0
    edges = np.stack([triangles[here, side], triangles[here, (side + 1) % 3]], axis=1)
    return vertices[edges[convex]]


def _sharp_vertices(vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the vertices that are tips: their faces leave more than `SHARP` of the full angle open, all edges drop."""
    angles = corner_angles(vertices, triangles)
    around = np.bincount(triangles.reshape(-1), weights=angles.reshape(-1), minlength=len(vertices))
    tip = (around > 0.0) & (2.0 * np.pi - around > SHARP)
    outward = np.zeros((len(vertices), 3))
    for corner in range(3):
        rows = np.flatnonzero(tip[triangles[:, corner]])
        np.add.at(outward, triangles[rows, corner], angles[rows, corner, None] * normals[rows])
    for start, end in ((0, 1), (1, 2), (2, 0)):  # each edge runs both ways in its two triangles
        rows = np.flatnonzero(tip[triangles[:, start]])
        a, b = triangles[rows, start], triangles[rows, end]
        rises = np.einsum("ij,ij->i", vertices[b] - vertices[a], outward[a]) > 0.0
        tip[a[rises]] = False
    return np.flatnonzero(tip)


def _sample_edges(ends: np.ndarray, lengths: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return midpoints and lengths of pieces of edges no longer than ``spacing``; much shorter pieces are merged."""
    counts = np.maximum(1, np.ceil(lengths / spacing - 1e-9).astype(np.int64))
    edge = np.repeat(np.arange(len(ends)), counts)
    piece = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (piece + 0.5) / counts[edge]
    points = ends[edge, 0] + share[:, None] * (ends[edge, 1] - ends[edge, 0])
    pieces = lengths[edge] / counts[edge]
    short = pieces < spacing / 2.0
    cells = np.floor(points[short] / (spacing / 2.0)).astype(np.int64)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    merged = np.bincount(cell.reshape(-1), weights=pieces[short], minlength=len(first))
    return np.concatenate([points[~short], points[short][first]]), np.concatenate([pieces[~short], merged])


def _extremes(vertices: np.ndarray, n_directions: int = 1000) -> np.ndarray:
    """Return the vertices farthest in directions spread over the sphere (a Fibonacci lattice)."""
    i = np.arange(n_directions) + 0.5
    z, angle = 1.0 - 2.0 * i / n_directions, np.pi * (1.0 + 5.0**0.5) * i
    radius = np.sqrt(1.0 - z**2)
    directions = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
    directions = np.concatenate([directions, np.eye(3), -np.eye(3)])
    farthest = [int(np.argmax(vertices @ direction)) for direction in directions]
    return vertices[np.unique(farthest)]
