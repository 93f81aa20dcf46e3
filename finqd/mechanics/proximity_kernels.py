"""Kernels of what is near what: closest points, which faces may touch, and how far bodies deviate from rigid motion.

A face is a row of vertex ids, -1 pads. It lies within the convex hull of its vertices, since its points are weighted
by shares. ``pieces`` cut it into triangles between *local points*: its vertices, and `CENTRE`, the mean of the last
four of them, in the middle of a quadrilateral.
"""

import math

import numpy as np

from finqd.mechanics.compiled import njit
from finqd.mechanics.contact_kernels import face_box, face_point

CENTRE = 8  # local number of a quadrilateral's middle
LOCALS = 9  # local points of a face at most
PIECES = 8  # triangles of a face at most
ROUNDED = 1.0 - 1e-9  # of a distance from a plane that counts, for rounding


@njit(cache=True)
def dot3(u, v):
    """Return the product of two vectors (3,)."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(cache=True)
def closest_on_triangle(p, a, b, c, share):
    """Write the barycentric ``share`` (3,) of the point of the triangle abc that is closest to p; exact zeros on rims.

    Source: Ericson, Real-Time Collision Detection, 2005, 5.1.5.
    """
    ab0, ab1, ab2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    ac0, ac1, ac2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    d1 = ab0 * (p[0] - a[0]) + ab1 * (p[1] - a[1]) + ab2 * (p[2] - a[2])
    d2 = ac0 * (p[0] - a[0]) + ac1 * (p[1] - a[1]) + ac2 * (p[2] - a[2])
    share[0], share[1], share[2] = 1.0, 0.0, 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        return
    d3 = ab0 * (p[0] - b[0]) + ab1 * (p[1] - b[1]) + ab2 * (p[2] - b[2])
    d4 = ac0 * (p[0] - b[0]) + ac1 * (p[1] - b[1]) + ac2 * (p[2] - b[2])
    if d3 >= 0.0 and d4 <= d3:
        share[0], share[1] = 0.0, 1.0
        return
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and d1 - d3 > 0.0:
        share[1] = d1 / (d1 - d3)
        share[0] = 1.0 - share[1]
        return
    d5 = ab0 * (p[0] - c[0]) + ab1 * (p[1] - c[1]) + ab2 * (p[2] - c[2])
    d6 = ac0 * (p[0] - c[0]) + ac1 * (p[1] - c[1]) + ac2 * (p[2] - c[2])
    if d6 >= 0.0 and d5 <= d6:
        share[0], share[2] = 0.0, 1.0
        return
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0 and d2 - d6 > 0.0:
        share[2] = d2 / (d2 - d6)
        share[0] = 1.0 - share[2]
        return
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0 and (d4 - d3) + (d5 - d6) > 0.0:
        share[2] = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        share[0], share[1] = 0.0, 1.0 - share[2]
        return
    whole = va + vb + vc
    if whole > 0.0:
        share[1], share[2] = vb / whole, vc / whole
        share[0] = 1.0 - share[1] - share[2]


@njit(cache=True)
def local_points(values, nodes, found):
    """Write ``values`` (n_vertices, 3) at the local points of a face to ``found`` (LOCALS, 3)."""
    n = 0
    while n < nodes.shape[0] and nodes[n] >= 0:
        for i in range(3):
            found[n, i] = values[nodes[n], i]
        n += 1
    if n == 4 or n == 8:
        for i in range(3):
            found[CENTRE, i] = 0.25 * (found[n - 4, i] + found[n - 3, i] + found[n - 2, i] + found[n - 1, i])


@njit(cache=True)
def local_weights(nodes, corners, share, weight):
    """Write the weights (k,) of a face's vertices at ``share`` (3,) of its piece between local ``corners`` (3,)."""
    n = 0
    while n < nodes.shape[0] and nodes[n] >= 0:
        n += 1
    weight[:] = 0.0
    for i in range(3):
        if corners[i] == CENTRE:
            for a in range(n - 4, n):
                weight[a] += 0.25 * share[i]
        else:
            weight[corners[i]] += share[i]


@njit(cache=True)
def all_local_weights(faces, other, corners, piece, share, weights):
    """Write the `local_weights` (n, k) of n rows with faces ``other`` (n,), ``piece`` (n,) and ``share`` (n, 3)."""
    for c in range(other.shape[0]):
        local_weights(faces[other[c]], corners[piece[c]], share[c], weights[c])


@njit(cache=True)
def piece_planes(points, corners, first, end, planes):
    """Write the planes of a face's pieces first to end: unit normal and offset, zeros for a flat one, (n, 4).

    A point that is off a piece's plane by a distance is off the piece by as much at least: most are ruled out so.
    """
    for piece in range(first, end):
        a, b, c = points[corners[piece, 0]], points[corners[piece, 1]], points[corners[piece, 2]]
        u0, u1, u2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        v0, v1, v2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        size = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        size = ROUNDED / size if size > 0.0 else 0.0
        row = planes[piece - first]
        row[0], row[1], row[2] = size * n0, size * n1, size * n2
        row[3] = row[0] * a[0] + row[1] * a[1] + row[2] * a[2]


@njit(cache=True)
def off_plane(plane, x):
    """Return a lower bound of how far a point is off a piece with this plane [m]."""
    return abs(plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] - plane[3])


@njit(cache=True)
def closest_on_face(p, points, corners, first, end, limit2, best):
    """Return (squared distance, piece) of the closest point of a face; piece -1 if none is nearer than the limit.

    points: local ones of the face; corners (n, 3): of all pieces, of which the face has first to end; limit2: squared
    distance that is too far [m^2]; best (3,): the share there, written if a piece is found
    """
    share, found = np.empty(3), -1
    for piece in range(first, end):
        a, b, c = points[corners[piece, 0]], points[corners[piece, 1]], points[corners[piece, 2]]
        closest_on_triangle(p, a, b, c, share)
        d2 = 0.0
        for i in range(3):
            d2 += (p[i] - share[0] * a[i] - share[1] * b[i] - share[2] * c[i]) ** 2
        if d2 < limit2:
            limit2, found = d2, piece
            for i in range(3):
                best[i] = share[i]
    return limit2, found


@njit(cache=True)
def faces_gap(positions, a, b, enough):
    """Return a lower bound of the distance [m] of two faces, by what separates them along some axes.

    ``enough``: a bound that is as good as any larger one; the axes are those of the world, both normals and the line
    between the middles.
    """
    best, middle = -np.inf, (0.0, 0.0, 0.0)
    for i in range(3):
        low_a, high_a, mid_a = _span(positions, a, i)
        low_b, high_b, mid_b = _span(positions, b, i)
        best = max(best, low_b - high_a, low_a - high_b)
        middle = (middle[1], middle[2], mid_b - mid_a)
    if best >= enough:
        return best
    return _gap_along(positions, a, b, _normal(positions, a), _normal(positions, b), middle, best, enough)


@njit(cache=True)
def _gap_along(positions, a, b, normal_a, normal_b, middle, best, enough):
    """Return ``best`` [m], or what separates two faces along one of three axes (three numbers), if that is more."""
    for axis in (normal_a, normal_b, middle):
        length = math.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
        if length == 0.0:
            continue
        low_a, high_a = _span_along(positions, a, axis)
        low_b, high_b = _span_along(positions, b, axis)
        best = max(best, (low_b - high_a) / length, (low_a - high_b) / length)
        if best >= enough:
            return best
    return best


@njit(cache=True)
def _span(positions, nodes, i):
    """Return the least, the largest and the mean coordinate i of a face's vertices [m]."""
    low, high, mid, n = np.inf, -np.inf, 0.0, 0
    for v in nodes:
        if v < 0:
            break
        x = positions[v, i]
        low, high, mid, n = min(low, x), max(high, x), mid + x, n + 1
    return low, high, mid / n


@njit(cache=True)
def _span_along(positions, nodes, axis):
    """Return the least and the largest product of a face's vertices with ``axis`` (three numbers)."""
    low, high = np.inf, -np.inf
    for v in nodes:
        if v < 0:
            break
        x = positions[v, 0] * axis[0] + positions[v, 1] * axis[1] + positions[v, 2] * axis[2]
        low, high = min(low, x), max(high, x)
    return low, high


@njit(cache=True)
def _normal(positions, nodes):
    """Return a normal of a face, of any length: the cross product of its diagonals, or of two sides of a triangle."""
    n = 0
    while n < nodes.shape[0] and nodes[n] >= 0:
        n += 1
    quad = n == 4 or n == 8
    i, j = (nodes[0], nodes[2]) if quad else (nodes[0], nodes[1])
    k, m = (nodes[1], nodes[3]) if quad else (nodes[0], nodes[2])
    u0, u1, u2 = positions[j, 0] - positions[i, 0], positions[j, 1] - positions[i, 1], positions[j, 2] - positions[i, 2]
    v0, v1, v2 = positions[m, 0] - positions[k, 0], positions[m, 1] - positions[k, 1], positions[m, 2] - positions[k, 2]
    return u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0


@njit(cache=True)
def relative_way(direction, a, b):
    """Return a bound of how far any point of one face moves relative to any of the other [m]."""
    a0, a1, a2, spread_a = mean_move(direction, a)
    b0, b1, b2, spread_b = mean_move(direction, b)
    return math.sqrt((a0 - b0) ** 2 + (a1 - b1) ** 2 + (a2 - b2) ** 2) + spread_a + spread_b


@njit(cache=True)
def mean_move(direction, nodes):
    """Return the mean move of a face's vertices (three numbers), and how far that of any is from it [m]."""
    x = y = z = 0.0
    n = 0
    while n < nodes.shape[0] and nodes[n] >= 0:
        x, y, z = x + direction[nodes[n], 0], y + direction[nodes[n], 1], z + direction[nodes[n], 2]
        n += 1
    x, y, z, spread2 = x / n, y / n, z / n, 0.0
    for k in range(n):
        v = nodes[k]
        off2 = (direction[v, 0] - x) ** 2 + (direction[v, 1] - y) ** 2 + (direction[v, 2] - z) ** 2
        if not off2 <= spread2:  # takes a NaN too
            spread2 = off2
    return x, y, z, math.sqrt(spread2)


@njit(cache=True)
def near_pairs(positions, direction, moving, faces, ids, side, reach, apart, out, out_gap):
    """Write the pairs (lower id, higher id) of faces that may be nearer than ``reach`` [m]; return how many there are.

    moving: whether all the way along ``direction`` counts, instead of ``positions`` alone, both (n_vertices, 3) [m]

    ids (n,): of the faces looked at; side (n,): only pairs of different sides count, or all if every side is 0
    apart: keys (lower id times n_faces plus higher id, ascending) of pairs that never count; pairs that share a vertex
    do not either. out (m, 2), out_gap (m,): lower bound of their distance now; pairs beyond the end are counted, not
    written. Sweep along the axis on which the faces are spread out most: Ericson 2005, 7.5.
    """
    n = ids.shape[0]
    low, high, middle, normal = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    mixed = False
    for i in range(n):
        nodes = faces[ids[i]]
        for axis in range(3):
            low[i, axis], high[i, axis], middle[i, axis] = _span(positions, nodes, axis)
        normal[i, 0], normal[i, 1], normal[i, 2] = _normal(positions, nodes)
        mixed = mixed or side[i] != 0
    still_low, still_high = low, high
    mean, spread = np.empty((n if moving else 0, 3)), np.empty(n if moving else 0)
    if moving:
        low, high = low.copy(), high.copy()
        for i in range(n):
            _sweep_box(direction, positions, faces[ids[i]], low[i], high[i])
            mean[i, 0], mean[i, 1], mean[i, 2], spread[i] = mean_move(direction, faces[ids[i]])
    along = _widest_axis(low)
    second, third = (along + 1) % 3, (along + 2) % 3
    order, count = np.argsort(low[:, along]), 0
    for k in range(n):
        i = order[k]
        for m in range(k + 1, n):
            j = order[m]
            if low[j, along] > high[i, along] + reach:
                break
            if mixed and side[i] == side[j]:
                continue
            if low[j, second] > high[i, second] + reach or low[i, second] > high[j, second] + reach:
                continue
            if low[j, third] > high[i, third] + reach or low[i, third] > high[j, third] + reach:
                continue
            a, b = min(ids[i], ids[j]), max(ids[i], ids[j])
            if not mixed and _share_vertex(faces[a], faces[b]):
                continue
            if apart.shape[0] > 0:  # a search is quicker than axes
                key = a * faces.shape[0] + b
                at = np.searchsorted(apart, key)
                if at < apart.shape[0] and apart[at] == key:
                    continue
            least = reach
            if moving:  # by a bound of how far any point of one face moves relative to any of the other
                off = mean[i, 0] - mean[j, 0], mean[i, 1] - mean[j, 1], mean[i, 2] - mean[j, 2]
                least += math.sqrt(off[0] ** 2 + off[1] ** 2 + off[2] ** 2) + spread[i] + spread[j]
            gap = -np.inf
            for x in range(3):
                gap = max(gap, still_low[j, x] - still_high[i, x], still_low[i, x] - still_high[j, x])
            if gap < least:
                between = middle[j, 0] - middle[i, 0], middle[j, 1] - middle[i, 1], middle[j, 2] - middle[i, 2]
                gap = _gap_along(positions, faces[ids[i]], faces[ids[j]], _row(normal, i), _row(normal, j), between,
                                 gap, least)
            if gap >= least:
                continue
            if count < out.shape[0]:
                out[count, 0], out[count, 1], out_gap[count] = a, b, gap
            count += 1
    return count


@njit(cache=True)
def _row(rows, i):
    return rows[i, 0], rows[i, 1], rows[i, 2]


@njit(cache=True)
def _widest_axis(low):
    """Return the axis along which the corners ``low`` (n, 3) of boxes are spread out most."""
    widest, most = 0, -1.0
    for axis in range(3):
        least, largest = np.inf, -np.inf
        for i in range(low.shape[0]):
            least, largest = min(least, low[i, axis]), max(largest, low[i, axis])
        if largest - least > most:
            widest, most = axis, largest - least
    return widest


@njit(cache=True)
def _sweep_box(direction, positions, nodes, low, high):
    """Widen the box of a face by where it moves to."""
    for n in nodes:
        if n >= 0:
            for i in range(3):
                x = positions[n, i] + direction[n, i]
                low[i], high[i] = min(low[i], x), max(high[i], x)


@njit(cache=True)
def refine_gaps(
    positions, faces, face_lattice, lattice_first, lattice_weight, pieces, corners, listed, gaps, close
):
    """Replace ``gaps`` (n,) below ``close`` [m] by the distance of the samples of either face of a pair to the other.

    Or by ``close``, if that is less: what separating axes say of faces that are bent, or stand at an angle, is too
    little.
    """
    local, x, share, low, high = np.empty((LOCALS, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for p in range(listed.shape[0]):
        if gaps[p] >= close:
            continue
        nearest2 = close * close
        for side in range(2):
            f, other = listed[p, side], listed[p, 1 - side]
            local_points(positions, faces[other], local)
            face_box(positions, faces[other], low, high)
            for s in range(lattice_first[face_lattice[f]], lattice_first[face_lattice[f] + 1]):
                face_point(positions, faces[f], lattice_weight[s], x)
                if box_distance2(x, low, high) < nearest2:
                    nearest2, _ = closest_on_face(
                        x, local, corners, pieces[other], pieces[other + 1], nearest2, share
                    )
        gaps[p] = math.sqrt(nearest2)


@njit(cache=True)
def box_distance2(x, low, high):
    """Return the squared distance of a point from a box [m^2]."""
    d2 = 0.0
    for i in range(3):
        off = max(low[i] - x[i], x[i] - high[i], 0.0)
        d2 += off * off
    return d2


@njit(cache=True)
def _share_vertex(a, b):
    for i in a:
        if i >= 0:
            for j in b:
                if i == j:
                    return True
    return False
