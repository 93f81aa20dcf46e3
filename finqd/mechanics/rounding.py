"""Rounds the convex edges of rigid bodies, so that contact with them is smooth.

A rounded body is the smaller body that a ball's centre can reach inside the sharp one, grown by the ball (its
morphological opening; J. Serra, Image Analysis and Mathematical Morphology, 1982, ch. 2). Faces stay where they are.
Its distance is that from the smaller body less the radius, whose gradient is continuous down to a depth of the radius:
the distance from the sharp body jumps there from one face of an edge to the other. The inner edges of a solid of
revolution are rounded alike where that fills little; steeper ones, and those of a polyhedron, stay sharp.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from finqd.cache import remembered
from finqd.mechanics.distance import (
    corner_angles,
    edge_table,
    field_arrays,
    field_of,
    revolution_field,
    surface_field,
    triangle_neighbours,
    triangle_normals,
)
from finqd.mechanics.distance_kernels import REVOLUTION, SPHERE, DistanceField, signed_distances

HALVINGS = 5  # a body too fine for the radius asked for is rounded by a half, a quarter, ... of it, or not at all
RECESS = 4.0  # a tip may lie back by this multiple of the radius asked for
FILL = 1.0  # and an inner edge of a lathe be filled by this multiple of the radius; beyond, it stays sharp
MITRE = 20.0  # length of a sharp corner of a profile, in multiples of the radius, before it is cut
ARC = 64  # pieces of a quarter circle
ON_ARC = 1e-9  # how far a point of an arc may lie off its circle, as a share of the radius
SHORTEST = 1e-7  # shorter sides of a profile are rounding noise [m]
OFF = 0.05  # how far a point of the smaller body may miss its depth, as a share of the radius
MANY = 1000  # triangles of a surface from which on its rounded field is kept on disk: fewer are done in 30 ms
FLAT = 0.02  # share of the largest below which a direction is not held by the faces at a vertex


class RigidShape(Protocol):
    """What rounding looks at: a `GraspObject` has it."""

    distance: DistanceField
    vertices: np.ndarray
    triangles: np.ndarray
    profile: np.ndarray | None


def rounded_field(solid: RigidShape, radius: float) -> DistanceField:
    """Return the distance field of ``solid`` with convex edges rounded by ``radius`` [m], or by less where it is fine.

    The field's ``radius`` says by how much: half, a quarter, ... down to a 16th, or 0 for a body finer than that (a
    noisy scan). 0, and balls, leave the field as it is.
    """
    if solid.distance.kind == SPHERE or radius <= 0.0:
        return solid.distance
    if len(solid.distance.features) < MANY:
        return _rounded(solid, radius)
    parts = [solid.vertices, solid.triangles, *field_arrays(solid.distance).values(), float(radius)]
    return remembered("rounded", parts, lambda: _rounded(solid, radius), pack=field_arrays, unpack=field_of)


def _rounded(solid: RigidShape, radius: float) -> DistanceField:
    """Return what `rounded_field` does of a body that is no ball."""
    smaller = _smaller_lathes(solid, radius) if solid.distance.kind == REVOLUTION else _smaller_surfaces(solid, radius)
    for tried, found in smaller:
        if found is not None:
            return found._replace(radius=tried)
    return solid.distance


def _radii(radius: float) -> list[float]:
    return [radius * 0.5**halving for halving in range(HALVINGS)]


def _smaller_lathes(solid: RigidShape, asked: float) -> Iterator[tuple[float, DistanceField | None]]:
    """Yield each radius to try and the field of the lathe whose profile lies that far inside, None if too fine."""
    from shapely import MultiPoint, Polygon, box, union
    from shapely.geometry.polygon import orient

    profile = solid.profile
    whole, corners = Polygon(profile), MultiPoint(profile).geoms
    if np.any(profile[:, 0] == 0.0):  # the axis is no side of the solid
        whole = union(whole, Polygon(profile * [-1.0, 1.0]))
    far = 2.0 * float(np.abs(profile).max())
    for radius in _radii(asked):
        closed = whole.buffer(radius, quad_segs=ARC)
        inside, hollow = closed.buffer(-2.0 * radius, quad_segs=ARC), 2.0 * radius
        filled = closed.exterior.distance
        if any(filled(corner) - radius > FILL * radius and closed.contains(corner) for corner in corners):
            inside, hollow = whole.buffer(-radius, join_style="mitre", mitre_limit=MITRE), 0.0
        half = inside.intersection(box(0.0, -far, far, far))
        found = None
        simple = half.geom_type == "Polygon" and not half.is_empty and not half.interiors
        if simple and all(half.distance(corner) <= radius + RECESS * asked for corner in corners):
            points = np.array(orient(half, 1.0).exterior.coords)[:-1]
            points[np.abs(points[:, 0]) < 1e-12, 0] = 0.0
            centres = np.concatenate([np.array(ring.coords)[:-1] for ring in (closed.exterior, *closed.interiors)])
            found = revolution_field(*_with_arcs(points, centres, hollow))
        yield radius, found


def _with_arcs(points: np.ndarray, centres: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a profile in which runs of sides on circles about ``centres`` are one side each, and the sides' radii [m].

    Between the flat sides of an inner arc the normal would jump: a sample that lies there has no equilibrium that
    Newton's method finds. ``radius`` [m]: of the circles; 0, which the sides' radii are if they are straight: no arcs.
    """
    n = len(points)
    arc = np.full(n, -1)
    if radius > 0.0:
        on = np.abs(np.linalg.norm(points[:, None] - centres, axis=2) - radius) <= ON_ARC * radius
        side = on & np.roll(on, -1, axis=0)
        arc = np.where(side.any(axis=1), side.argmax(axis=1), -1)
    starts = (arc < 0) | (arc != np.roll(arc, 1))
    points, arc = points[starts], arc[starts]
    long = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1) > SHORTEST
    return points[long], np.where(arc[long] >= 0, radius, 0.0)


def _smaller_surfaces(solid: RigidShape, asked: float) -> Iterator[tuple[float, DistanceField | None]]:
    """Yield each radius to try and the field of the surface that far inside; None if the body is too fine for it.

    Each vertex goes to where its faces, moved inwards by the radius, meet (in the sense of least squares if they are
    more than three): v - r m with n_i . m = 1. The surface must not have come too near to the body's own anywhere.
    """
    vertices, triangles = solid.vertices, solid.triangles
    topology = triangle_neighbours(triangles)
    normals, flat = triangle_normals(vertices, triangles, topology[1])
    weight = corner_angles(vertices, triangles)
    matrix, right = np.zeros((len(vertices), 3, 3)), np.zeros((len(vertices), 3))
    outer = normals[:, :, None] * normals[:, None, :]
    for corner in range(3):
        np.add.at(matrix, triangles[:, corner], weight[:, corner, None, None] * outer)
        np.add.at(right, triangles[:, corner], weight[:, corner, None] * normals)
    move = np.einsum("nij,nj->ni", np.linalg.pinv(matrix, rcond=FLAT**2, hermitian=True), right)
    back = float(np.linalg.norm(move[np.unique(triangles)], axis=1).max())
    edges = edge_table(triangles)[0]
    for radius in _radii(asked):
        found = None
        if back * radius <= radius + RECESS * asked:
            inner = vertices - radius * move
            turned, _ = triangle_normals(inner, triangles, topology[1])
            straight = np.all(np.einsum("ij,ij->i", turned, normals)[~flat] >= 0.9)
            if straight and _depth(solid.distance, inner, edges, 0.5 * radius) >= (1.0 - OFF) * radius:
                found = surface_field(inner, triangles, topology=topology)
        yield radius, found


def _depth(distance: DistanceField, inner: np.ndarray, edges: np.ndarray, spacing: float) -> float:
    """Return the least depth [m] of points at most ``spacing`` [m] apart on the edges of the smaller surface."""
    ends = inner[edges]
    pieces = np.maximum(np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / spacing).astype(int), 1)
    first = np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = ((np.arange(len(first)) - first) / np.repeat(pieces, pieces))[:, None]
    points = np.repeat(ends[:, 0], pieces, axis=0) * (1.0 - share) + np.repeat(ends[:, 1], pieces, axis=0) * share
    points = np.concatenate([points, inner[np.unique(edges)]])
    distances = np.empty(len(points))
    signed_distances(distance, points, distances, np.empty_like(points))
    return float(-distances.max())
