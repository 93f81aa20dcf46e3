"""Rounds the convex edges of rigid bodies, so that contact with them is smooth.

A rounded body is the smaller body that a ball's centre can reach inside the sharp one, grown by the ball (its
morphological opening; J. Serra, Image Analysis and Mathematical Morphology, 1982, ch. 2). Faces stay where they are.
Its distance is that from the smaller body less the radius, whose gradient is continuous down to a depth of the radius:
the distance from the sharp body jumps there from one face of an edge to the other. The inner edges of a solid of
revolution are rounded alike; those of a polyhedron stay sharp.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from finqd.mechanics.distance import (
    corner_angles,
    revolution_field,
    surface_field,
    triangle_neighbours,
    triangle_normals,
)
from finqd.mechanics.distance_kernels import REVOLUTION, SPHERE, DistanceField, signed_distances

HALVINGS = 5  # a body too fine for the radius asked for is rounded by a half, a quarter, ... of it, or not at all
RECESS = 4.0  # a tip may lie back by this multiple of the radius
ARC = 64  # pieces of a quarter circle
SHORTEST = 1e-7  # shorter sides of a profile are rounding noise [m]
OFF = 0.05  # how far a point of the smaller body may miss its depth, as a share of the radius
FLAT = 0.02  # share of the largest below which a direction is not held by the faces at a vertex


class Solid(Protocol):
    """What rounding looks at: a `GraspObject` has it."""

    distance: DistanceField
    vertices: np.ndarray
    triangles: np.ndarray
    profile: np.ndarray | None


def rounded_field(solid: Solid, radius: float) -> DistanceField:
    """Return the distance field of ``solid`` with convex edges rounded by ``radius`` [m], or by less where it is fine.

    The field's ``radius`` says by how much. 0, and balls, leave it as it is.
    """
    if solid.distance.kind == SPHERE:
        return solid.distance
    smaller = _smaller_lathe if solid.distance.kind == REVOLUTION else _smaller_surface
    for halving in range(HALVINGS if radius > 0.0 else 0):
        found = smaller(solid, radius * 0.5**halving)
        if found is not None:
            return found._replace(radius=radius * 0.5**halving)
    return solid.distance


def _smaller_lathe(solid: Solid, radius: float) -> DistanceField | None:
    """Return the field of the solid of revolution whose profile lies ``radius`` inside; None if it is too fine."""
    from shapely import MultiPoint, Polygon, box, orient_polygons, remove_repeated_points, union

    profile = solid.profile
    whole = Polygon(profile)
    if np.any(profile[:, 0] == 0.0):  # the axis is no side of the solid
        whole = union(whole, Polygon(profile * [-1.0, 1.0]))
    inside = whole.buffer(radius, quad_segs=ARC).buffer(-2.0 * radius, quad_segs=ARC)
    far = 2.0 * float(np.abs(profile).max())
    half = remove_repeated_points(inside.intersection(box(0.0, -far, far, far)), SHORTEST)
    if half.geom_type != "Polygon" or half.is_empty or half.interiors:
        return None
    if any(half.distance(point) > (1.0 + RECESS) * radius for point in MultiPoint(profile).geoms):
        return None
    corners = np.array(orient_polygons(half).exterior.coords)[:-1]
    corners[np.abs(corners[:, 0]) < 1e-12, 0] = 0.0
    return revolution_field(corners)


def _smaller_surface(solid: Solid, radius: float) -> DistanceField | None:
    """Return the field of the surface ``radius`` inside another; None if that surface is too fine for it.

    Each vertex goes to where its faces, moved inwards by the radius, meet (in the sense of least squares if they are
    more than three): v - r m with n_i . m = 1.
    """
    vertices, triangles = solid.vertices, solid.triangles
    topology = triangle_neighbours(triangles)
    normals, flat = triangle_normals(vertices, triangles, topology[1])
    weight = np.where(flat[:, None], 0.0, corner_angles(vertices, triangles))
    matrix, right = np.zeros((len(vertices), 3, 3)), np.zeros((len(vertices), 3))
    outer = normals[:, :, None] * normals[:, None, :]
    for corner in range(3):
        np.add.at(matrix, triangles[:, corner], weight[:, corner, None, None] * outer)
        np.add.at(right, triangles[:, corner], weight[:, corner, None] * normals)
    move = np.einsum("nij,nj->ni", np.linalg.pinv(matrix, rcond=FLAT**2, hermitian=True), right)
    inner = vertices - radius * move
    length = np.linalg.norm(move, axis=1)
    distance = np.empty(len(inner))
    signed_distances(solid.distance, inner, distance, np.empty_like(inner))
    used = np.unique(triangles)
    if np.any(distance[used] > (OFF - 1.0) * radius) or np.any(length[used] > 1.0 + RECESS):
        return None
    turned, _ = triangle_normals(inner, triangles, topology[1])
    if np.any(np.einsum("ij,ij->i", turned, normals)[~flat] < 0.9):
        return None
    return surface_field(inner, triangles, topology=topology)
