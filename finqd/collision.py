"""Overlap and distance between surfaces at the set-up of a scene, by the Flexible Collision Library (python-fcl).

Which start poses are free of overlap, and which pairs of bodies can touch at all. A surface is a tuple (vertices (n, 3)
[m], triangles (m, 3), pose (4, 4): its frame to the world's). Nothing here runs inside a time step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from finqd.errors import MissingLibraryError

Surface = tuple[np.ndarray, np.ndarray, np.ndarray]


def overlaps(a: Surface, b: Surface) -> bool:
    """Return whether two closed surfaces intersect, or one lies inside the other."""
    if _box_gap(_bounds(a), _bounds(b)) > 0.0:
        return False
    return _intersect(_fcl_object(a), _fcl_object(b)) or _starts_inside(a, b) or _starts_inside(b, a)


def distance(a: Surface, b: Surface) -> float:
    """Return the distance [m] between the solids in two closed surfaces, exact to rounding; 0 if they overlap."""
    return 0.0 if overlaps(a, b) else _apart(_fcl_object(a), _fcl_object(b))


def may_touch_pairs(surfaces: Sequence[Surface], reaches: float | Sequence[float]) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of surfaces that can come to touch.

    reaches [m]: how far any point of each surface can get from its place, one number for all or one each. A pair
    is left out only if its distance exceeds the sum of both reaches.
    """
    reach = np.broadcast_to(np.asarray(reaches, dtype=float), (len(surfaces),))
    bounds = [_bounds(surface) for surface in surfaces]
    objects: dict[int, Any] = {}
    pairs = []
    for i in range(len(surfaces)):
        for j in range(i + 1, len(surfaces)):
            if _box_gap(bounds[i], bounds[j]) > reach[i] + reach[j]:
                continue
            for k in (i, j):
                if k not in objects:
                    objects[k] = _fcl_object(surfaces[k])
            near = _intersect(objects[i], objects[j]) or _apart(objects[i], objects[j]) <= reach[i] + reach[j]
            if near or _starts_inside(surfaces[i], surfaces[j]) or _starts_inside(surfaces[j], surfaces[i]):
                pairs.append((i, j))
    return pairs


def _fcl() -> Any:
    try:
        import fcl
    except ImportError as error:
        raise MissingLibraryError("checking start poses needs python-fcl: pip install python-fcl") from error
    return fcl


def _fcl_object(surface: Surface) -> Any:
    fcl = _fcl()
    vertices, triangles, pose = surface
    model = fcl.BVHModel()
    model.beginModel(len(triangles), len(vertices))
    model.addSubModel(np.ascontiguousarray(vertices, dtype=float), np.ascontiguousarray(triangles, dtype=np.int64))
    model.endModel()
    return fcl.CollisionObject(model, fcl.Transform(np.asarray(pose)[:3, :3], np.asarray(pose)[:3, 3]))


def _intersect(a: Any, b: Any) -> bool:
    """Return whether triangles of two fcl objects intersect."""
    fcl = _fcl()
    return fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()) > 0


def _apart(a: Any, b: Any) -> float:
    """Return the distance [m] between the triangles of two fcl objects that do not intersect."""
    fcl = _fcl()
    return max(0.0, float(fcl.distance(a, b, fcl.DistanceRequest(), fcl.DistanceResult())))


def _placed(surface: Surface) -> np.ndarray:
    vertices, _, pose = surface
    return vertices @ np.asarray(pose)[:3, :3].T + np.asarray(pose)[:3, 3]


def _bounds(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    points = _placed(surface)
    return points.min(axis=0), points.max(axis=0)


def _box_gap(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the distance [m] between two axis-aligned boxes (low, high); 0 if they overlap."""
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(a[0] - b[1], b[0] - a[1]))))


def _starts_inside(a: Surface, b: Surface) -> bool:
    """Return whether the first vertex of ``a`` is inside ``b``: where surfaces do not intersect, so is all of ``a``.

    By the solid angle that b fills around the point, 4 pi inside and 0 outside (A. van Oosterom, J. Strackee, The
    solid angle of a plane triangle, IEEE Trans. Biomed. Eng. 30, 1983).
    """
    corners = _placed(b)[b[1]] - _placed(a)[a[1][0, 0]]
    lengths = np.linalg.norm(corners, axis=2)
    p, q, r = corners[:, 0], corners[:, 1], corners[:, 2]
    n = lengths.prod(axis=1)
    n = n + np.einsum("ij,ij->i", p, q) * lengths[:, 2]
    n = n + np.einsum("ij,ij->i", q, r) * lengths[:, 0] + np.einsum("ij,ij->i", r, p) * lengths[:, 1]
    angle = 2.0 * np.arctan2(np.einsum("ij,ij->i", p, np.cross(q, r)), n)
    return bool(abs(angle.sum()) > 2.0 * np.pi)
