"""What an object stands on: points of its hull, and its pose at rest."""

from __future__ import annotations

import numpy as np

SUPPORT_LIMIT = 400  # points; on a ball of 20 mm in radius the floor then reaches up to 0.2 mm between them
STABLE = np.deg2rad(1.0)  # tilt that a resting pose must survive


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


def _extremes(vertices: np.ndarray, n_directions: int = 1000) -> np.ndarray:
    """Return the vertices farthest in directions spread over the sphere (a Fibonacci lattice)."""
    i = np.arange(n_directions) + 0.5
    z, angle = 1.0 - 2.0 * i / n_directions, np.pi * (1.0 + 5.0**0.5) * i
    radius = np.sqrt(1.0 - z**2)
    directions = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
    directions = np.concatenate([directions, np.eye(3), -np.eye(3)])
    farthest = [int(np.argmax(vertices @ direction)) for direction in directions]
    return vertices[np.unique(farthest)]
