"""Kernels of contact between soft faces: energies, forces and Hessians of sample points near the triangles of others.

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
from finqd.mechanics.contact_kernels import face_point
from finqd.mechanics.proximity_kernels import LOCALS, dot3, local_points, local_weights

FLAT = 1e-6  # cosine at which a line counts as square to an edge


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
        if i != still and (share[i] > 0.0 or abs(dot3(edge, normal)) <= FLAT * math.sqrt(dot3(edge, edge))):
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
        inverse[0, 0] = 1.0 / dot3(edges[0], edges[0])
    elif m == 2:
        s00, s01, s11 = dot3(edges[0], edges[0]), dot3(edges[0], edges[1]), dot3(edges[1], edges[1])
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
        s = math.sqrt(dot3(slips[c], slips[c]))
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
        s = math.sqrt(dot3(slips[c], slips[c]))
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
