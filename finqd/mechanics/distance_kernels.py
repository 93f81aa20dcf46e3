"""Signed distance and its gradient for rigid shapes: a sphere, a solid of revolution, a triangle surface.

All shapes share one `DistanceField` type, so that every kernel that takes one compiles once. Fields are made in
`finqd.mechanics.distance`; what a shape does not use is an empty array there.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from finqd.mechanics.compiled import njit

SPHERE, REVOLUTION, SURFACE = 0, 1, 2
SAME = 1e-9  # normals that differ by less are one
ALIKE = 1e-9  # relative difference of squared distances that may be rounding, and
ALIKE_M2 = 1e-18  # [m^2] the same near the surface
TOUCHING = 1e-12  # below this distance [m] the direction to the closest point is rounding noise

#: kind: SPHERE, REVOLUTION or SURFACE
#: leaf_size: triangles a leaf of the tree
#: radius: of the sphere; of the others, how far outside the rows' surface the body's own surface lies [m]
#: rows: of a solid of revolution, shape (n, 12), one profile segment each: start r, z, edge r, z [m], 1 / length^2
#:     [1/m^2], outward normal r, z, unit pseudonormals r, z at its start and at its end, 1 / radius [1/m] if it is an
#:     arc with its centre on the outer side (at most half a circle), 0 if it is straight;
#:     of a surface, shape (n_slots, 12), one triangle each, in the order of the tree's leaves: corners a, b, c [m],
#:     unit outward normal
#: features: shape (n_slots, 6), rows of `pseudonormals` for edges ab, bc, ca and for corners a, b, c
#: pseudonormals: shape (n, 3), unit, angle-weighted normals of edges and vertices
#: boxes: shape (2 n_leaves, 12), low and high corner of node i's box [m], and the axis of its disc, the ends along it
#:     and its radius [m] (`outside_disc`); its children are nodes 2 i and 2 i + 1, the root is node 1, and leaf j (node
#:     n_leaves + j) holds slots j leaf_size to (j + 1) leaf_size
#:
#: Few arrays, and kernels that take arrays rather than the tuple: each array of a tuple costs two atomic operations of
#: reference counting wherever the tuple is passed on, which came to half the time of a query.
DistanceField = namedtuple("DistanceField", "kind leaf_size radius rows features pseudonormals boxes")


@njit(cache=True, error_model="numpy")
def _box_distance2(boxes, node, x, y, z):
    """Squared distance [m^2] from a point to box ``node``; 0 inside."""
    dx = max(boxes[node, 0] - x, 0.0, x - boxes[node, 3])
    dy = max(boxes[node, 1] - y, 0.0, y - boxes[node, 4])
    dz = max(boxes[node, 2] - z, 0.0, z - boxes[node, 5])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, error_model="numpy")
def outside_disc(boxes, node, x, y, z, best):
    """Tell whether a node's disc is at least as far from a point as ``best``, the square of a distance [m^2].

    The disc is a cylinder about the middle of the node's box, along the mean normal of its triangles: of a fine surface
    it is as thin as that is bent, while boxes are as deep as it leans. By boxes alone a point at a distance d from
    triangles of a size h has to look at some d / h of them; with discs, at a few.
    """
    n0, n1, n2 = boxes[node, 6], boxes[node, 7], boxes[node, 8]
    along = n0 * x + n1 * y + n2 * z
    a = max(boxes[node, 9] - along, 0.0, along - boxes[node, 10])
    left = best + ALIKE * best + ALIKE_M2 - a * a
    if left <= 0.0:
        return True
    x -= 0.5 * (boxes[node, 0] + boxes[node, 3])
    y -= 0.5 * (boxes[node, 1] + boxes[node, 4])
    z -= 0.5 * (boxes[node, 2] + boxes[node, 5])
    along = n0 * x + n1 * y + n2 * z
    beside2 = x * x + y * y + z * z - along * along
    return beside2 > left and np.sqrt(beside2) - boxes[node, 11] >= np.sqrt(left)


@njit(cache=True, error_model="numpy")
def _closest_parameters(rows, slot, x, y, z):
    """Closest point a + v ab + w ac of triangle ``slot`` to a point, and the feature it lies on.

    Returns (v, w, feature); feature 0: the face, 1 to 3: edges ab, bc, ca, 4 to 6: corners a, b, c. Region tests by
    the signs of barycentric coordinates as in C. Ericson, Real-Time Collision Detection (2005), section 5.1.5.
    """
    ax, ay, az = rows[slot, 0], rows[slot, 1], rows[slot, 2]
    abx, aby, abz = rows[slot, 3] - ax, rows[slot, 4] - ay, rows[slot, 5] - az
    acx, acy, acz = rows[slot, 6] - ax, rows[slot, 7] - ay, rows[slot, 8] - az
    apx, apy, apz = x - ax, y - ay, z - az
    bb = abx * abx + aby * aby + abz * abz
    bc = abx * acx + aby * acy + abz * acz
    cc = acx * acx + acy * acy + acz * acz
    d1 = abx * apx + aby * apy + abz * apz
    d2 = acx * apx + acy * apy + acz * apz
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0, 4
    d3, d4 = d1 - bb, d2 - bc  # the same products with the point seen from b
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0, 5
    d5, d6 = d1 - bc, d2 - cc  # and from c
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0, 6
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return d1 / (d1 - d3), 0.0, 1
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, d2 / (d2 - d6), 3
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - w, w, 2
    total = va + vb + vc
    return vb / total, vc / total, 0


@njit(cache=True, error_model="numpy")
def _offset(rows, slot, v, w, x, y, z):
    """Vector [m] from the point a + v ab + w ac of triangle ``slot`` to (x, y, z)."""
    u = 1.0 - v - w
    return (
        x - (u * rows[slot, 0] + v * rows[slot, 3] + w * rows[slot, 6]),
        y - (u * rows[slot, 1] + v * rows[slot, 4] + w * rows[slot, 7]),
        z - (u * rows[slot, 2] + v * rows[slot, 5] + w * rows[slot, 8]),
    )


@njit(cache=True, error_model="numpy")
def closest_in_leaf(rows, leaf_size, leaf, x, y, z, best, best_slot):
    """Return (squared distance [m^2], slot) of the closest triangle of a leaf, or the given ones if none is closer."""
    for slot in range(leaf * leaf_size, (leaf + 1) * leaf_size):
        v, w, feature = _closest_parameters(rows, slot, x, y, z)
        if feature == 0:
            # along the stored unit normal: exact where slivers make barycentric coordinates inaccurate
            d = (
                (x - rows[slot, 0]) * rows[slot, 9]
                + (y - rows[slot, 1]) * rows[slot, 10]
                + (z - rows[slot, 2]) * rows[slot, 11]
            )
            distance2 = d * d
        else:
            dx, dy, dz = _offset(rows, slot, v, w, x, y, z)
            distance2 = dx * dx + dy * dy + dz * dz
        if distance2 < best:
            best, best_slot = distance2, slot
    return best, best_slot


@njit(cache=True, error_model="numpy")
def _closest_slot(rows, boxes, leaf_size, x, y, z):
    """Slot of the triangle closest to a point: nearest child first, without a stack.

    The tree is complete, so a node's number tells its parent and its sibling; bit k of ``trail`` says whether the
    sibling of the ancestor k levels up is still to be visited. Boxes alone say in which order: discs only leave out.
    """
    n_leaves = boxes.shape[0] // 2
    best, best_slot = np.inf, 0
    node, trail = 1, 0
    while True:
        if node >= n_leaves:
            best, best_slot = closest_in_leaf(rows, leaf_size, node - n_leaves, x, y, z, best, best_slot)
        else:
            near, far = 2 * node, 2 * node + 1
            near2, far2 = _box_distance2(boxes, near, x, y, z), _box_distance2(boxes, far, x, y, z)
            if far2 < near2:
                near, far, near2, far2 = far, near, far2, near2
            if near2 < best and not outside_disc(boxes, near, x, y, z, best):
                node = near
                trail = (trail << 1) | (1 if far2 < best else 0)
                continue
            if far2 < best and not outside_disc(boxes, far, x, y, z, best):
                node = far
                trail <<= 1
                continue
        while True:
            if trail == 0:
                return best_slot
            while trail & 1 == 0:
                trail >>= 1
                node >>= 1
            trail ^= 1
            node ^= 1
            if _box_distance2(boxes, node, x, y, z) < best and not outside_disc(boxes, node, x, y, z, best):
                break


@njit(cache=True, error_model="numpy")
def _surface_distance(rows, features, pseudonormals, boxes, leaf_size, x, y, z):
    r"""Signed distance [m] to a closed triangle surface and its gradient.

    The sign is that of the offset from the closest point times the angle-weighted pseudonormal there, which is right
    everywhere on a watertight surface: J. A. Baerentzen, H. Aanaes, Signed distance computation using the angle
    weighted pseudonormal (IEEE TVCG 11, 2005).
    """
    slot = _closest_slot(rows, boxes, leaf_size, x, y, z)
    v, w, feature = _closest_parameters(rows, slot, x, y, z)
    dx, dy, dz = _offset(rows, slot, v, w, x, y, z)
    if feature == 0:
        nx, ny, nz = rows[slot, 9], rows[slot, 10], rows[slot, 11]
        return dx * nx + dy * ny + dz * nz, nx, ny, nz
    row = features[slot, feature - 1]
    nx, ny, nz = pseudonormals[row, 0], pseudonormals[row, 1], pseudonormals[row, 2]
    side = dx * nx + dy * ny + dz * nz
    d = np.sqrt(dx * dx + dy * dy + dz * dz)
    if d < TOUCHING:
        return side, nx, ny, nz
    if side < 0.0:
        d = -d
    return d, dx / d, dy / d, dz / d


@njit(cache=True, error_model="numpy")
def _arc_centre(rows, i):
    """Centre r, z and radius [m] of the arc i of a profile, and the height of its centre over its chord."""
    radius = 1.0 / rows[i, 11]
    height = np.sqrt(max(radius * radius - 0.25 / rows[i, 4], 0.0))
    return (
        rows[i, 0] + 0.5 * rows[i, 2] + height * rows[i, 5],
        rows[i, 1] + 0.5 * rows[i, 3] + height * rows[i, 6],
        radius,
        height,
    )


@njit(cache=True, error_model="numpy")
def _closest_segment(rows, r, z):
    """Return the profile segment closest to (r, z) [m] and the parameter of its closest point: 0 and 1 are its ends.

    Between the ends of an arc the parameter is 0.5, whatever the point.
    """
    best, best_segment, best_t = np.inf, 0, 0.0
    for i in range(rows.shape[0]):
        dr, dz = r - rows[i, 0], z - rows[i, 1]
        er, ez = rows[i, 2], rows[i, 3]
        t = (dr * er + dz * ez) * rows[i, 4]
        if rows[i, 11] > 0.0:
            cr, cz, radius, height = _arc_centre(rows, i)
            ur, uz = r - cr, z - cz
            length = np.sqrt(ur * ur + uz * uz)
            if -(ur * rows[i, 5] + uz * rows[i, 6]) * radius >= length * height:  # it lies in the arc's sector
                if (length - radius) ** 2 < best:
                    best, best_segment, best_t = (length - radius) ** 2, i, 0.5
                continue
            t = 0.0 if t < 0.5 else 1.0
        t = min(max(t, 0.0), 1.0)
        dr -= t * er
        dz -= t * ez
        distance2 = dr * dr + dz * dz
        if distance2 < best:
            best, best_segment, best_t = distance2, i, t
    return best_segment, best_t


@njit(cache=True, error_model="numpy")
def _profile_distance(rows, r, z):
    """Signed distance [m] from a point (r, z) of the half plane to the profile, and its gradient r, z."""
    i, t = _closest_segment(rows, r, z)
    if rows[i, 11] > 0.0 and t == 0.5:
        cr, cz, radius, _ = _arc_centre(rows, i)
        ur, uz = cr - r, cz - z
        length = np.sqrt(ur * ur + uz * uz)
        if length < TOUCHING:  # in the centre all of the arc is equally near
            return radius, rows[i, 5], rows[i, 6]
        return radius - length, ur / length, uz / length
    dr, dz = r - rows[i, 0] - t * rows[i, 2], z - rows[i, 1] - t * rows[i, 3]
    if 0.0 < t < 1.0:
        nr, nz = rows[i, 5], rows[i, 6]
        return dr * nr + dz * nz, nr, nz
    end = 7 if t == 0.0 else 9
    nr, nz = rows[i, end], rows[i, end + 1]
    d = dr * nr + dz * nz
    length = np.sqrt(dr * dr + dz * dz)
    if length < TOUCHING:
        return d, nr, nz
    d = -length if d < 0.0 else length
    return d, dr / d, dz / d


@njit(cache=True, error_model="numpy")
def _revolution_distance(rows, x, y, z):
    r"""Signed distance [m] to a solid of revolution about z and its gradient.

    .. math:: d(x, y, z) = d_{2D}(\sqrt{x^2 + y^2}, z)

    with the exact distance to the profile in the half plane r >= 0, signed by the pseudonormal of the closest segment
    or vertex. On the axis the radial direction is taken as x.
    """
    r = np.sqrt(x * x + y * y)
    d, nr, nz = _profile_distance(rows, r, z)
    if r > 0.0:
        return d, nr * (x / r), nr * (y / r), nz
    return d, nr, 0.0, nz


@njit(cache=True, error_model="numpy")
def _profile_curvature(rows, r, z, e, nr, nz):
    """Second derivative [1/m] of the distance across its gradient nr, nz, in the half plane; e: the distance [m].

    1/e over a corner, 0 over a straight side, and -1/(R - e) over an arc of radius R that is bent inwards.
    """
    i, t = _closest_segment(rows, r, z)
    if rows[i, 11] > 0.0:
        cr, cz, radius, _ = _arc_centre(rows, i)
        length = np.sqrt((r - cr) ** 2 + (z - cz) ** 2)
        smooth = abs(nr * length - cr + r) + abs(nz * length - cz + z) < SAME * radius
        if t == 0.5 or smooth:
            return -1.0 / max(length, TOUCHING)
    elif abs(nr - rows[i, 5]) + abs(nz - rows[i, 6]) < SAME:
        return 0.0  # where two sides of the profile go straight on, and on the axis
    return 1.0 / e if (t == 0.0 or t == 1.0) and e > TOUCHING else 0.0


@njit(cache=True, error_model="numpy")
def signed_distance(field, x, y, z):
    """Return ``(d, nx, ny, nz)``: signed distance [m], negative inside, and its gradient, a unit vector outwards.

    field: `DistanceField`; x, y, z: a point in the field's frame [m]. The gradient is continuous through d = 0 on
    faces; where the closest point is not unique (the medial axis) it belongs to one of them. Of a body with rounded
    edges (``radius`` > 0) it is continuous down to that depth.
    """
    if field.kind == SPHERE:
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0.0:
            return length - field.radius, x / length, y / length, z / length
        return -field.radius, 0.0, 0.0, 1.0
    if field.kind == REVOLUTION:
        d, n0, n1, n2 = _revolution_distance(field.rows, x, y, z)
    else:
        d, n0, n1, n2 = _surface_distance(
            field.rows, field.features, field.pseudonormals, field.boxes, field.leaf_size, x, y, z
        )
    return d - field.radius, n0, n1, n2


@njit(cache=True, error_model="numpy")
def signed_distances(field, points, distances, normals):
    """Fill ``distances`` [m], shape (n,), and ``normals``, shape (n, 3), for ``points`` [m], shape (n, 3)."""
    for i in range(points.shape[0]):
        d, nx, ny, nz = signed_distance(field, points[i, 0], points[i, 1], points[i, 2])
        distances[i] = d
        normals[i, 0] = nx
        normals[i, 1] = ny
        normals[i, 2] = nz


@njit(cache=True, error_model="numpy")
def distance_curvature(field, d, x, y, z, n, out):
    r"""Write the second derivative [1/m] of the distance at a point outside the rows' surface, shape (3, 3).

    d: the distance there [m]; n: its gradient, shape (3,). With e = d + ``radius``, the distance from the rows: 0 over
    faces, (I - n n^T - t t^T)/e over an edge along t, (I - n n^T)/e over a corner and a ball's centre; of a solid of
    revolution, with t along the circumference, t t^T n_r/r, and `_profile_curvature` (t x n)(t x n)^T too.
    """
    out[:] = 0.0
    e = d + field.radius
    if field.kind == REVOLUTION:
        r = np.sqrt(x * x + y * y)
        t0, t1, bend = 0.0, 1.0, 0.0
        if r > TOUCHING:
            t0, t1, bend = -y / r, x / r, (n[0] * x + n[1] * y) / (r * r)
        outwards = (n[0] * x + n[1] * y) / r if r > TOUCHING else 0.0
        corner = _profile_curvature(field.rows, r, z, e, outwards, n[2])
        s = (t1 * n[2], -t0 * n[2], t0 * n[1] - t1 * n[0])
        t = (t0, t1, 0.0)
        for i in range(3):
            for j in range(3):
                out[i, j] = bend * t[i] * t[j] + corner * s[i] * s[j]
        return
    if e <= TOUCHING:
        return
    feature, slot = 4, 0
    if field.kind == SURFACE:
        slot = _closest_slot(field.rows, field.boxes, field.leaf_size, x, y, z)
        _, _, feature = _closest_parameters(field.rows, slot, x, y, z)
        turn = abs(n[0] - field.rows[slot, 9]) + abs(n[1] - field.rows[slot, 10]) + abs(n[2] - field.rows[slot, 11])
        if feature == 0 or turn < SAME:  # over a face, or an edge between triangles of one plane
            return
    for i in range(3):
        for j in range(3):
            out[i, j] = ((1.0 if i == j else 0.0) - n[i] * n[j]) / e
    if feature <= 3:
        a, b = 3 * (feature - 1), 3 * (feature % 3)
        length2 = 0.0
        for i in range(3):
            length2 += (field.rows[slot, b + i] - field.rows[slot, a + i]) ** 2
        for i in range(3):
            for j in range(3):
                side = (field.rows[slot, b + i] - field.rows[slot, a + i]) * (
                    field.rows[slot, b + j] - field.rows[slot, a + j]
                )
                out[i, j] -= side / (length2 * e)
