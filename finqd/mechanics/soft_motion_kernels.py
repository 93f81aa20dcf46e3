"""Kernels that say how far soft faces may move until they meet: additive continuous collision detection."""

import math

import numpy as np

from finqd.mechanics.compiled import njit
from finqd.mechanics.contact_kernels import face_box, face_point
from finqd.mechanics.proximity_kernels import (
    LOCALS,
    PIECES,
    box_distance2,
    closest_on_face,
    dot3,
    faces_gap,
    local_points,
    off_plane,
    piece_planes,
    relative_way,
)

CLOSEST = 0.1  # share of a distance that is left at least by a move
LOOKS = 8  # at two faces on their way, before their samples are followed
MARCH = 200  # steps after which a sample that slides along a face is not followed any farther


@njit(cache=True)
def pairs_step_limit(
    positions, direction, faces, face_lattice, lattice_first, lattice_weight, pieces, corners, pairs, limit
):
    """Return the share, up to ``limit``, of a move on which no sample of one face of ``pairs`` (n, 2) meets the other.

    A sample may go so far that `CLOSEST` of its distance is left. Both faces of a pair have samples. Additive
    continuous collision detection: Li, Kaufman and Jiang, ACM Trans. Graph. 40 (2021) 170, algorithm 1.
    """
    local, moves, near = np.empty((LOCALS, 3)), np.empty((LOCALS, 3)), np.empty((LOCALS, 3))
    x, u, low, high, planes = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((PIECES, 4))
    for p in range(pairs.shape[0]):
        way = limit * relative_way(direction, faces[pairs[p, 0]], faces[pairs[p, 1]]) / (1.0 - CLOSEST)
        if _faces_stay_apart(positions, direction, faces[pairs[p, 0]], faces[pairs[p, 1]], limit, way):
            continue
        for side in range(2):
            f, other = pairs[p, side], pairs[p, 1 - side]
            local_points(positions, faces[other], local)
            local_points(direction, faces[other], moves)
            face_box(positions, faces[other], low, high)
            lattice, first, end = face_lattice[f], pieces[other], pieces[other + 1]
            piece_planes(local, corners, first, end, planes)
            for s in range(lattice_first[lattice], lattice_first[lattice + 1]):
                face_point(positions, faces[f], lattice_weight[s], x)
                if box_distance2(x, low, high) > way * way or _off_planes(planes, end - first, x, way):
                    continue
                face_point(direction, faces[f], lattice_weight[s], u)
                limit = _sample_limit(x, u, local, moves, near, faces[other], corners, first, end, limit)
    return limit


@njit(cache=True)
def _off_planes(planes, n, x, way):
    """Tell whether a point is farther than ``way`` [m] off all pieces of a face, as far as their planes say so."""
    for k in range(n):
        if off_plane(planes[k], x) <= way:
            return False
    return True


@njit(cache=True)
def _faces_stay_apart(positions, direction, a, b, limit, way):
    """Tell whether two faces do not meet on a move: as long as a gap is left, they go on by it, a few times.

    way: bound of how far one moves relative to the other, up to ``limit`` and with a margin [m]
    """
    if not way > 0.0:
        return True
    k = a.shape[0]
    moved, one, other = np.empty((2 * k, 3)), np.full(k, -1), np.full(k, -1)
    at = 0.0
    for _ in range(LOOKS):
        for v in range(k):
            for i in range(3):
                if a[v] >= 0:
                    one[v] = v
                    moved[v, i] = positions[a[v], i] + at * direction[a[v], i]
                if b[v] >= 0:
                    other[v] = k + v
                    moved[k + v, i] = positions[b[v], i] + at * direction[b[v], i]
        gap = faces_gap(moved, one, other, way)
        if gap <= 0.0:
            return False
        at += gap * limit / way
        if at >= limit:
            return True
    return False


@njit(cache=True)
def _sample_limit(x, u, local, moves, near, nodes, corners, first, end, limit):
    """Return the share (up to ``limit``) that a sample at x (3,) that moves by u may go beside a moving face."""
    share, point = np.empty(3), np.empty(3)
    n = 0
    while n < nodes.shape[0] and nodes[n] >= 0:
        n += 1
    rate = 0.0
    for v in range(n):
        off = u - moves[v]
        rate = max(rate, math.sqrt(dot3(off, off)))
    if rate == 0.0:
        return limit
    d2, found = closest_on_face(x, local, corners, first, end, (limit * rate / (1.0 - CLOSEST)) ** 2, share)
    if found < 0:
        return limit
    distance = math.sqrt(d2)
    least, at = CLOSEST * distance, 0.0
    for _ in range(MARCH):
        ahead = (distance - least) / rate
        if at + ahead >= limit:
            return limit
        if distance <= 1.5 * least:
            return at
        at += ahead
        for i in range(3):
            point[i] = x[i] + at * u[i]
            for v in range(LOCALS):
                near[v, i] = local[v, i] + at * moves[v, i]
        d2, _ = closest_on_face(point, near, corners, first, end, np.inf, share)
        distance = math.sqrt(d2)
    return at
