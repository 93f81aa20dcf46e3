"""Kernels that find what the sharp features of rigid bodies, points on their edges and corners, meet on soft faces.

A contact's row is the same as in `finqd.mechanics.contact_kernels`; the planes are held over a Newton solve.
"""

import math

import numpy as np
from numba import njit

from finqd.mechanics.contact_kernels import face_point, opposition

KEEP = 1.25  # a dent's side that has had a plane in this step keeps it up to this multiple of the distance
RIDGE = 1e-6  # [m] how much deeper a point may lie under the side of a dent than under the surface
RISE = 0.01  # slope over the first plane from which a neighbouring triangle makes a dent


@njit(cache=True)
def closest_on_triangle(p, a, b, c, bary):
    """Write barycentric coordinates of the point of triangle abc closest to p.

    Source: Ericson, Real-Time Collision Detection, 2005, section 5.1.5.
    """
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = np.dot(ab, ap), np.dot(ac, ap)
    bary[0], bary[1], bary[2] = 1.0, 0.0, 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        return
    bp = p - b
    d3, d4 = np.dot(ab, bp), np.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        bary[0], bary[1] = 0.0, 1.0
        return
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        bary[1] = d1 / (d1 - d3)
        bary[0] = 1.0 - bary[1]
        return
    cp = p - c
    d5, d6 = np.dot(ab, cp), np.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        bary[0], bary[2] = 0.0, 1.0
        return
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        bary[2] = d2 / (d2 - d6)
        bary[0] = 1.0 - bary[2]
        return
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        bary[0] = 0.0
        bary[2] = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        bary[1] = 1.0 - bary[2]
        return
    total = va + vb + vc
    bary[1], bary[2] = vb / total, vc / total
    bary[0] = 1.0 - bary[1] - bary[2]


@njit(cache=True)
def near_triangles(positions, faces, triangle_face, points, reach, low, high, pairs):
    """Write the (point, triangle) pairs whose face box, grown by ``reach`` [m], holds the point; return their number.

    low, high: scratch for the face boxes, shape (n_faces, 3). pairs: shape (n, 2); if it is too small, the number
    returned is larger than n. A sweep over the points sorted along x keeps it near linear.
    """
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    for q in range(points.shape[0]):
        for i in range(3):
            lower[i] = min(lower[i], points[q, i] - reach)
            upper[i] = max(upper[i], points[q, i] + reach)
    order = np.argsort(points[:, 0])
    sorted_x = points[order, 0]
    count = 0
    for f in range(faces.shape[0]):
        for i in range(3):
            low[f, i], high[f, i] = np.inf, -np.inf
        for a in range(faces.shape[1]):
            n = faces[f, a]
            if n >= 0:
                for i in range(3):
                    low[f, i] = min(low[f, i], positions[n, i] - reach)
                    high[f, i] = max(high[f, i], positions[n, i] + reach)
    for t in range(triangle_face.shape[0]):
        f = triangle_face[t]
        apart = False
        for i in range(3):
            if low[f, i] > upper[i] or high[f, i] < lower[i]:
                apart = True
        if apart:
            continue
        k = np.searchsorted(sorted_x, low[f, 0])
        while k < points.shape[0] and sorted_x[k] <= high[f, 0]:
            q = order[k]
            k += 1
            if low[f, 1] <= points[q, 1] <= high[f, 1] and low[f, 2] <= points[q, 2] <= high[f, 2]:
                if count < pairs.shape[0]:
                    pairs[count, 0], pairs[count, 1] = q, t
                count += 1
    return count


@njit(cache=True)
def _triangle(positions, faces, triangle_face, triangle_weight, t, corner, normal):
    """Write the corners [m] and the unit normal of triangle ``t``."""
    nodes = faces[triangle_face[t]]
    for v in range(3):
        face_point(positions, nodes, triangle_weight[t, v], corner[v])
    n = np.cross(corner[1] - corner[0], corner[2] - corner[0])
    normal[:] = n / max(math.sqrt(np.dot(n, n)), 1e-300)


@njit(cache=True)
def _write_plane(row, q, t, bary, normal, triangle_face, triangle_weight, out_point, out_face, out_weight, out_normal):
    """Write the plane through the point ``bary`` of triangle ``t`` for feature ``q``, the normal reversed."""
    out_point[row] = q
    out_face[row] = triangle_face[t]
    for a in range(out_weight.shape[1]):
        out_weight[row, a] = (
            bary[0] * triangle_weight[t, 0, a] + bary[1] * triangle_weight[t, 1, a] + bary[2] * triangle_weight[t, 2, a]
        )
    for i in range(3):
        out_normal[row, i] = -normal[i]


@njit(cache=True)
def _nearest_triangle(p, positions, faces, triangle_face, triangle_weight, pairs, i0, i1, distance):
    """Return the triangle of pairs i0 to i1 nearest to ``p``, and the signed distance [m].

    Fills ``distance`` for each pair [m]. Where several are equally near (an edge), the one that faces the point most is
    taken.
    """
    corner, n, bary = np.empty((3, 3)), np.empty(3), np.empty(3)
    best, best_facing, best_pair, gap = np.inf, -1.0, i0, 0.0
    for c in range(i0, i1):
        _triangle(positions, faces, triangle_face, triangle_weight, pairs[c, 1], corner, n)
        closest_on_triangle(p, corner[0], corner[1], corner[2], bary)
        delta = p - bary[0] * corner[0] - bary[1] * corner[1] - bary[2] * corner[2]
        d = math.sqrt(np.dot(delta, delta))
        height = np.dot(delta, n)
        facing = abs(height) / d if d > 1e-9 else 1.0
        distance[c] = d
        if d < best - 1e-9 or (d < best + 1e-9 and facing > best_facing):
            best, best_facing, best_pair = d, facing, c
            gap = d if height > 0.0 else -d
    return best_pair, gap


@njit(cache=True)
def _beside(p, foot, n, gap, corner, other, near, kept):
    """Tell whether a triangle near the point ``p`` is the other side of a dent, whose plane it meets as well.

    foot, n, gap: nearest point, normal and signed distance of the surface; corner, other: corners and normal of the
    triangle. It has to rise over the first plane, or, if it is ``kept``, not to fall away clearly.
    """
    middle = (corner[0] + corner[1] + corner[2]) / 3.0
    if np.dot(n, other) < 0.5 or np.dot(n, middle - foot) <= (-RISE if kept else RISE) * near:
        return False
    return np.dot(other, p - corner[0]) >= min(gap, 0.0) - RIDGE


@njit(cache=True)
def pair_features(
    positions, faces, triangle_face, triangle_weight, pairs, points, outward, centre, rotation, depth, reach, near,
    kept, out_point, out_face, out_weight, out_normal, out_share,
):
    """Write the planes that the features of a rigid body meet on a soft body; return how many.

    pairs: candidate (point, triangle) of one soft body, sorted by point, shape (n, 2); kept: bool, shape (n,), those
    that had a plane earlier in this step, to which are added those that get one now; outward: unit pseudonormals of
    the features, body frame, shape (n_points, 3). Each point within ``reach`` [m] outside and ``depth`` inside (deeper
    ones are nearer to the wall's other side) gets the plane of the nearest triangle, or, outside beyond a convex edge,
    the plane across the direction of the distance. In a dent it gets the planes of the other triangles within ``near``
    [m] as well, as far as they rise over the first: it cannot be in balance on one side of a crease alone. A plane that
    the point is deeper under than under the surface itself is none of a dent's, but a ridge's far side. A pair that is
    kept loses its plane only where the triangle clearly falls away: in a shallow dent the sides would come and go with
    each renewal, and no step however short would end.
    """
    p, towards, bary, n, other = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    corner, distance = np.empty((3, 3)), np.empty(pairs.shape[0])
    count, first, last = 0, 0, 0
    while last < pairs.shape[0]:
        first, last = last, last + 1
        q = pairs[first, 0]
        while last < pairs.shape[0] and pairs[last, 0] == q:
            last += 1
        p[:], towards[:] = centre + rotation @ points[q], rotation @ outward[q]
        nearest, gap = _nearest_triangle(
            p, positions, faces, triangle_face, triangle_weight, pairs, first, last, distance
        )
        if gap > reach or gap < -depth:
            continue
        _triangle(positions, faces, triangle_face, triangle_weight, pairs[nearest, 1], corner, n)
        closest_on_triangle(p, corner[0], corner[1], corner[2], bary)
        foot = bary[0] * corner[0] + bary[1] * corner[1] + bary[2] * corner[2]
        if gap > 1e-6:
            n[:] = (p - foot) / gap
        if count >= out_point.shape[0]:
            break
        kept[nearest] = True
        _write_plane(
            count, q, pairs[nearest, 1], bary, n, triangle_face, triangle_weight, out_point, out_face, out_weight,
            out_normal,
        )
        share = out_share[count] = opposition(-np.dot(n, towards))
        count += 1
        for c in range(first, last):
            if c == nearest or distance[c] > (KEEP if kept[c] else 1.0) * near or count >= out_point.shape[0]:
                continue
            _triangle(positions, faces, triangle_face, triangle_weight, pairs[c, 1], corner, other)
            if not _beside(p, foot, n, gap, corner, other, near, kept[c]):
                continue
            kept[c] = True
            closest_on_triangle(p, corner[0], corner[1], corner[2], bary)
            _write_plane(
                count, q, pairs[c, 1], bary, other, triangle_face, triangle_weight, out_point, out_face, out_weight,
                out_normal,
            )
            out_share[count] = share
            count += 1
    return count


@njit(cache=True)
def find_feature_plane(
    positions, faces, plane_point, plane_face, plane_weight, plane_normal, plane_stiffness, points, centre, rotation,
    rigid, first_key, out_key, out_face, out_weight, out_gap, out_normal, out_arm, out_stiffness, out_rigid, out_turns,
    out_curve, count,
):
    """Append the features of a rigid body below the planes that `pair_features` gave them; return the new count."""
    x, arm = np.empty(3), np.empty(3)
    for c in range(plane_point.shape[0]):
        q = plane_point[c]
        face_point(positions, faces[plane_face[c]], plane_weight[c], x)
        gap = 0.0
        for i in range(3):
            arm[i] = rotation[i, 0] * points[q, 0] + rotation[i, 1] * points[q, 1] + rotation[i, 2] * points[q, 2]
            gap -= plane_normal[c, i] * (centre[i] + arm[i] - x[i])
        if gap >= 0.0:
            continue
        out_key[count] = first_key + q
        out_face[count] = plane_face[c]
        out_weight[count] = plane_weight[c]
        out_gap[count] = gap
        out_normal[count] = plane_normal[c]
        out_arm[count] = arm
        out_stiffness[count] = plane_stiffness[c]
        out_rigid[count] = rigid
        out_turns[count] = -1
        out_curve[count] = 0.0
        count += 1
    return count
