"""Kernels of contact between soft faces: the distance of sample points of one to the triangles of another.

A *row* is a sample point of the face ``face`` (shape weights ``weight`` (k,)) and the closest point of a part
(triangle, edge or vertex) of another face: on ``piece`` of the face ``other``, with barycentric ``share`` (3,).
``distance`` is theirs [m], ``normal`` the unit vector from the other face to the sample, ``stiffness`` the sample's
[N/m], times how often the part counts; that may be less than 0, in a valley. A row acts where distance < ``gap``. A
sample may have several.
What faces, local points and pieces are, `finqd.mechanics.proximity_kernels` says.

The Hessian of a pair of faces is written by ``slots`` (2 k, 2 k): of the vertices of the face with the lower id, then
of the other one.
"""

import math

import numpy as np

from finqd.mechanics.compiled import njit
from finqd.mechanics.contact_kernels import face_box, face_point
from finqd.mechanics.proximity_kernels import (
    LOCALS,
    box_distance2,
    closest_on_face,
    closest_on_triangle,
    faces_gap,
    local_points,
    local_weights,
    relative_way,
)

CLOSEST = 0.1  # share of a distance that is left at least by a move
FLAT = 1e-6  # cosine at which a line counts as square to an edge
LOOKS = 8  # at two faces on their way, before their samples are followed
MARCH = 200  # steps after which a sample that slides along a face is not followed any farther


@njit(cache=True)
def barrier(distance, gap, stiffness):
    r"""Return energy [J], its slope [N] (<= 0) and second derivative [N/m] of a row at ``distance`` [m].

    k/4 times -(d - g)^2 ln(d / g) below the gap g: twice continuously differentiable, infinite at d = 0. Source: Li et
    al., ACM Trans. Graph. 39 (2020) 49, equation 6. Both sides of a contact have samples, hence a fourth of k.
    """
    if distance >= gap:
        return 0.0, 0.0, 0.0
    if not distance > 0.0:
        return np.inf, -np.inf, np.inf
    k, short, log = 0.25 * stiffness, distance - gap, math.log(distance / gap)
    ratio = short / distance
    return -k * short * short * log, -k * short * (2.0 * log + ratio), k * (ratio * ratio - 4.0 * ratio - 2.0 * log)


@njit(cache=True)
def find_rows(
    positions, faces, face_area, face_lattice, lattice_first, lattice_weight, lattice_share, first_sample, pressure,
    pieces, corners, piece_edges, piece_vertices, valence, groups, group_first, others, gap, out_key, out_face,
    out_weight, out_other, out_piece, out_share, out_distance, out_normal, out_stiffness,
):
    """Write the rows of samples of faces ``groups`` nearer than ``gap`` to any of their ``others``; return how many.

    others: faces near groups[g] are others[group_first[g] : group_first[g + 1]]; pieces (n_faces + 1,): of face f,
    pieces[f] to pieces[f + 1]; piece_edges, piece_vertices (n, 3) and valence: see `near_faces.Triangulation`;
    pressure: stiffness of an area [N/m^3]. Rows beyond the arrays' end are counted, not written. What rows a sample
    has, `_parts` says.
    """
    count = 0
    x, local = np.empty(3), np.empty((LOCALS, 3))
    for g in range(groups.shape[0]):
        f, near = groups[g], 0
        ids = np.empty(group_first[g + 1] - group_first[g], np.int64)
        for o in range(group_first[g], group_first[g + 1]):
            if faces_gap(positions, faces[f], faces[others[o]], gap) < gap:
                ids[near] = others[o]
                near += 1
        if near == 0:
            continue
        points, boxes, most = np.empty((near, LOCALS, 3)), np.empty((near, 2, 3)), 0
        for o in range(near):
            local_points(positions, faces[ids[o]], points[o])
            face_box(positions, faces[ids[o]], boxes[o, 0], boxes[o, 1])
            most += pieces[ids[o] + 1] - pieces[ids[o]]
        who, piece, share = np.empty(5 * most, np.int64), np.empty(5 * most, np.int64), np.empty((5 * most, 3))
        part, times = np.empty(5 * most, np.int64), np.empty(5 * most, np.int64)
        first, end = lattice_first[face_lattice[f]], lattice_first[face_lattice[f] + 1]
        for s in range(first, end):
            face_point(positions, faces[f], lattice_weight[s], x)
            found = _triangles_near(x, ids, near, points, boxes, pieces, corners, gap, who, piece, share)
            if found == 0:
                continue
            parts = _parts(
                x, points, corners, piece_edges, piece_vertices, valence, gap, found, who, piece, share, part, times
            )
            for p in range(parts):
                if times[p] == 0:
                    continue
                if count < out_key.shape[0]:
                    other = ids[who[p]]
                    out_key[count] = first_sample[f] + s - first
                    out_face[count], out_weight[count] = f, lattice_weight[s]
                    out_other[count], out_piece[count], out_share[count] = other, piece[p], share[p]
                    out_stiffness[count] = times[p] * pressure * face_area[f] * lattice_share[s]
                    _difference(positions, faces, x, other, corners[piece[p]], share[p], local, out_normal[count])
                    size = math.sqrt(_dot(out_normal[count], out_normal[count]))
                    out_distance[count] = size
                    if size > 0.0:
                        out_normal[count] /= size
                count += 1
    return count


@njit(cache=True)
def _triangles_near(x, ids, near, points, boxes, pieces, corners, gap, who, piece, share):
    """Write the triangles nearer than ``gap`` to x (3,), with the closest point's share; return how many."""
    found, one = 0, np.empty(3)
    for o in range(near):
        if box_distance2(x, boxes[o, 0], boxes[o, 1]) >= gap * gap:
            continue
        for t in range(pieces[ids[o]], pieces[ids[o] + 1]):
            a, b, c = points[o, corners[t, 0]], points[o, corners[t, 1]], points[o, corners[t, 2]]
            closest_on_triangle(x, a, b, c, one)
            if _distance2(x, a, b, c, one) < gap * gap:
                who[found], piece[found] = o, t
                share[found] = one
                found += 1
    return found


@njit(cache=True)
def _distance2(x, a, b, c, share):
    d2 = 0.0
    for i in range(3):
        d2 += (x[i] - share[0] * a[i] - share[1] * b[i] - share[2] * c[i]) ** 2
    return d2


@njit(cache=True)
def _parts(
    x, points, corners, piece_edges, piece_vertices, valence, gap, found, who, piece, share, part, times
):
    """Turn the triangles near a sample into parts of the surface, each with how often it counts; return how many.

    The sum of all triangles' energies, less that of the edges between them, plus that of the vertices all round which
    they lie: one and the same energy wherever the surface is flat, and one without kinks where it is not, as that of
    the closest triangle alone would have in a valley. Source: Li et al., Convergent incremental potential contact,
    arXiv 2307.15908 (2023), section 4. Terms with the same closest point are joined: a point above the inside of a
    triangle has that one term.
    """
    many = found
    for t in range(found):
        part[t], times[t] = _part_of(share[t], piece[t], piece_edges, piece_vertices), 1
    one = np.empty(3)
    for t in range(found):
        local = points[who[t]]
        for k in range(3):
            m = (k + 1) % 3
            shared, round_corner, earlier = False, 0, False
            for u in range(found):
                for n in range(3):
                    shared = shared or (u > t and piece_edges[piece[u], n] == piece_edges[piece[t], k])
                    if piece_vertices[piece[u], n] == piece_vertices[piece[t], k]:
                        round_corner += 1
                        earlier = earlier or u < t
            a, b, c = local[corners[piece[t], 0]], local[corners[piece[t], 1]], local[corners[piece[t], 2]]
            if shared:
                _closest_on_edge(x, local[corners[piece[t], k]], local[corners[piece[t], m]], k, m, one)
                if _distance2(x, a, b, c, one) < gap * gap:
                    who[many], piece[many], times[many] = who[t], piece[t], -1
                    share[many] = one
                    part[many] = _part_of(one, piece[t], piece_edges, piece_vertices)
                    many += 1
            if not earlier and round_corner == valence[piece_vertices[piece[t], k]]:
                one[0] = one[1] = one[2] = 0.0
                one[k] = 1.0
                if _distance2(x, a, b, c, one) < gap * gap:
                    who[many], piece[many], times[many] = who[t], piece[t], 1
                    share[many] = one
                    part[many] = _part_of(one, piece[t], piece_edges, piece_vertices)
                    many += 1
    for p in range(many):
        for q in range(p):
            if part[q] == part[p]:
                times[q] += times[p]
                times[p] = 0
                break
    return many


@njit(cache=True)
def _part_of(share, piece, piece_edges, piece_vertices):
    """Return a number of the triangle, edge or vertex that the point ``share`` (3,) of a piece lies inside of."""
    zeros, which = 0, 0
    for i in range(3):
        if share[i] == 0.0:
            zeros += 1
    if zeros == 0:
        return 3 * piece
    for i in range(3):
        if zeros == 1 and share[i] == 0.0:
            return 3 * piece_edges[piece, (i + 1) % 3] + 1
        if zeros == 2 and share[i] != 0.0:
            which = i
    return 3 * piece_vertices[piece, which] + 2


@njit(cache=True)
def _closest_on_edge(x, a, b, k, m, share):
    """Write the share (3,), of corners k and m alone, of the point of the edge ab closest to x; exact at its ends."""
    along, length2 = 0.0, 0.0
    for i in range(3):
        along += (x[i] - a[i]) * (b[i] - a[i])
        length2 += (b[i] - a[i]) ** 2
    s = min(max(along / length2, 0.0), 1.0)
    share[0] = share[1] = share[2] = 0.0
    share[m] = s
    share[k] = 1.0 - s


@njit(cache=True)
def _difference(values, faces, value, other, corners, share, local, found):
    """Write ``value`` (3,) minus that of ``values`` at a point of the face ``other``; spoils ``local``."""
    local_points(values, faces[other], local)
    for i in range(3):
        found[i] = value[i]
        for c in range(3):
            found[i] -= share[c] * local[corners[c], i]


@njit(cache=True)
def rows_energy(distance, gap, stiffness, count):
    """Return the summed energy [J] of the first ``count`` rows."""
    energy = 0.0
    for c in range(count):
        energy += barrier(distance[c], gap, stiffness[c])[0]
    return energy


@njit(cache=True)
def row_forces(distance, gap, stiffness, count, out):
    """Write the normal force [N] of each row, (count,)."""
    for c in range(count):
        out[c] = -barrier(distance[c], gap, stiffness[c])[1]


@njit(cache=True)
def add_gradient(faces, face, weight, other, corners, piece, share, distance, normal, stiffness, count, gap, gradient):
    """Add the gradient [N] of the rows' energy to ``gradient`` (n_vertices, 3); return the energy [J]."""
    k, energy = faces.shape[1], 0.0
    beside = np.empty(k)
    for c in range(count):
        value, slope, _ = barrier(distance[c], gap, stiffness[c])
        energy += value
        local_weights(faces[other[c]], corners[piece[c]], share[c], beside)
        _add_force(faces, face[c], weight[c], other[c], beside, slope * normal[c], gradient)
    return energy


@njit(cache=True)
def _add_force(faces, face, weight, other, beside, force, gradient):
    """Add dE/dw = ``force`` (3,) [N] of w = sum weight x - sum beside x to the gradient."""
    for a in range(faces.shape[1]):
        if weight[a] != 0.0:
            for i in range(3):
                gradient[faces[face, a], i] += weight[a] * force[i]
        if beside[a] != 0.0:
            for i in range(3):
                gradient[faces[other, a], i] -= beside[a] * force[i]


@njit(cache=True)
def distance_hessian(point, a, b, c, share, normal, distance, out):
    r"""Write the second derivative (12, 12) [1/m] of the distance of a point to a triangle abc, by point, a, b and c.

    The distance is the minimum over the closest point's place s on the triangle (m = 2 numbers inside, 1 on an edge, 0
    at a corner) of |w|, w = x_p - sum_i share_i x_i. With q = |w|^2 / 2 and y = (p, a, b, c): q_yy - q_ys q_ss^-1 q_sy
    is the second derivative of the minimum of q (implicit function theorem), and that of d = sqrt(2 q) is
    (it - grad d grad d^T) / d.
    """
    corner = np.empty((3, 3))
    corner[0], corner[1], corner[2] = a, b, c
    still = 0 if share[0] > 0.0 else (1 if share[1] > 0.0 else 2)
    moving, m = np.zeros(2, np.int64), 0
    for i in range(3):
        # a rim that the line to the point is square to is none: the next triangle goes on in the same plane
        edge = corner[i] - corner[still]
        if i != still and (share[i] > 0.0 or abs(_dot(edge, normal)) <= FLAT * math.sqrt(_dot(edge, edge))):
            moving[m] = i
            m += 1
    factor = np.array([1.0, -share[0], -share[1], -share[2]])
    edges = np.empty((2, 3))
    mixed = np.zeros((2, 12))  # q_sy: s_j moves the closest point along the edge from ``still`` to corner moving[j]
    for j in range(m):
        edges[j] = corner[moving[j]] - corner[still]
        for v in range(4):
            for i in range(3):
                mixed[j, 3 * v + i] = -factor[v] * edges[j, i]
        for i in range(3):
            mixed[j, 3 * (1 + moving[j]) + i] -= distance * normal[i]
            mixed[j, 3 * (1 + still) + i] += distance * normal[i]
    inverse = np.zeros((2, 2))
    if m == 1:
        inverse[0, 0] = 1.0 / _dot(edges[0], edges[0])
    elif m == 2:
        s00, s01, s11 = _dot(edges[0], edges[0]), _dot(edges[0], edges[1]), _dot(edges[1], edges[1])
        det = s00 * s11 - s01 * s01
        inverse[0, 0], inverse[1, 1], inverse[0, 1], inverse[1, 0] = s11 / det, s00 / det, -s01 / det, -s01 / det
    for p in range(12):
        for q in range(12):
            value = factor[p // 3] * factor[q // 3] * ((1.0 if p % 3 == q % 3 else 0.0) - normal[p % 3] * normal[q % 3])
            for j in range(m):
                for n in range(m):
                    value -= mixed[j, p] * inverse[j, n] * mixed[n, q]
            out[p, q] = value / distance


@njit(cache=True)
def _dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(cache=True)
def add_hessian(
    positions, faces, pair, pair_slots, face, weight, other, corners, piece, share, distance, normal, stiffness, count,
    gap, blocks, exact,
):
    """Add the Hessian [N/m] of the rows' energy to ``blocks``; not ``exact``: Gauss-Newton's, positive semidefinite.

    pair (count,): which of ``pair_slots`` (n, 2 k, 2 k) a row's faces have.
    """
    k = faces.shape[1]
    local, curve, matrix = np.empty((LOCALS, 3)), np.zeros((12, 12)), np.zeros((12, 12))
    point, spread = np.empty(3), np.zeros((4, 2 * k))
    beside, one = np.empty(k), np.empty(3)
    for c in range(count):
        _, slope, second = barrier(distance[c], gap, stiffness[c])
        if not exact and second < 0.0:
            continue
        if exact:
            face_point(positions, faces[face[c]], weight[c], point)
            local_points(positions, faces[other[c]], local)
            at = corners[piece[c]]
            distance_hessian(point, local[at[0]], local[at[1]], local[at[2]], share[c], normal[c], distance[c], curve)
        for p in range(12):
            fp = 1.0 if p < 3 else -share[c, p // 3 - 1]
            for q in range(12):
                fq = 1.0 if q < 3 else -share[c, q // 3 - 1]
                matrix[p, q] = second * fp * fq * normal[c, p % 3] * normal[c, q % 3]
                if exact:
                    matrix[p, q] += slope * curve[p, q]
        near, far = (0, k) if face[c] < other[c] else (k, 0)
        spread[:] = 0.0
        spread[0, near : near + k] = weight[c]
        for i in range(3):
            one[:] = 0.0
            one[i] = 1.0
            local_weights(faces[other[c]], corners[piece[c]], one, beside)
            spread[1 + i, far : far + k] = beside
        _scatter(spread, matrix, pair_slots[pair[c]], blocks)


@njit(cache=True)
def _scatter(spread, matrix, slots, blocks):
    """Add sum_pq spread_pu spread_qv matrix_pq, 3 x 3 each, to the block of every pair of vertices u, v."""
    n = spread.shape[1]
    used, many = np.empty(n, np.int64), 0
    for u in range(n):
        for p in range(4):
            if spread[p, u] != 0.0:
                used[many] = u
                many += 1
                break
    for i in range(many):
        u = used[i]
        for j in range(many):
            v = used[j]
            slot = slots[u, v]
            if slot < 0:
                continue
            for p in range(4):
                for q in range(4):
                    f = spread[p, u] * spread[q, v]
                    if f != 0.0:
                        for x in range(3):
                            for y in range(3):
                                blocks[slot, x, y] += f * matrix[3 * p + x, 3 * q + y]


@njit(cache=True)
def relative_positions(positions, faces, face, weight, other, beside, count, out):
    """Write sum weight x - sum beside x of each frictional row to ``out`` (count, 3) [m]."""
    x, y = np.empty(3), np.empty(3)
    for c in range(count):
        face_point(positions, faces[face[c]], weight[c], x)
        face_point(positions, faces[other[c]], beside[c], y)
        for i in range(3):
            out[c, i] = x[i] - y[i]


@njit(cache=True)
def add_friction_gradient(faces, face, weight, other, beside, slips, bound, stiffness, count, gradient):
    """Add the gradient of `contact_force_kernels.friction_energy` at the rows' trial ``slips`` (count, 3) [m]."""
    for c in range(count):
        s = math.sqrt(_dot(slips[c], slips[c]))
        h = stiffness[c] if stiffness[c] * s <= bound[c] else bound[c] / s
        _add_force(faces, face[c], weight[c], other[c], beside[c], h * slips[c], gradient)


@njit(cache=True)
def add_friction_hessian(
    faces, pair, pair_slots, face, weight, other, beside, slips, bound, stiffness, normal, count, blocks
):
    """Add the Hessian of the same, exact for lagged normals and bounds, and positive semidefinite."""
    k = faces.shape[1]
    spread, matrix = np.zeros((4, 2 * k)), np.zeros((12, 12))
    for c in range(count):
        s = math.sqrt(_dot(slips[c], slips[c]))
        sticks = stiffness[c] * s <= bound[c]
        h = stiffness[c] if sticks else bound[c] / s
        for i in range(3):
            for j in range(3):
                matrix[i, j] = -h * normal[c, i] * normal[c, j]
                if not sticks:
                    matrix[i, j] -= h * slips[c, i] * slips[c, j] / (s * s)
            matrix[i, i] += h
        near, far = (0, k) if face[c] < other[c] else (k, 0)
        spread[0, near : near + k] = weight[c]
        spread[0, far : far + k] = -beside[c]
        _scatter(spread, matrix, pair_slots[pair[c]], blocks)


@njit(cache=True)
def pairs_step_limit(
    positions, direction, faces, face_lattice, lattice_first, lattice_weight, pieces, corners, pairs, limit
):
    """Return the share, up to ``limit``, of a move on which no sample of one face of ``pairs`` (n, 2) meets the other.

    A sample may go so far that `CLOSEST` of its distance is left. Both faces of a pair have samples. Additive
    continuous collision detection: Li, Kaufman and Jiang, ACM Trans. Graph. 40 (2021) 170, algorithm 1.
    """
    local, moves, near = np.empty((LOCALS, 3)), np.empty((LOCALS, 3)), np.empty((LOCALS, 3))
    x, u, low, high = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
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
            for s in range(lattice_first[lattice], lattice_first[lattice + 1]):
                face_point(positions, faces[f], lattice_weight[s], x)
                if box_distance2(x, low, high) > way * way:
                    continue
                face_point(direction, faces[f], lattice_weight[s], u)
                limit = _sample_limit(x, u, local, moves, near, faces[other], corners, first, end, limit)
    return limit


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
        rate = max(rate, math.sqrt(_dot(off, off)))
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
