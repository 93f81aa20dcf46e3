"""Kernels of penalty contact with Coulomb friction between soft faces, rigid bodies and planes.

A *contact* is a row: a point of a soft face (``face``, shape weights ``weight``; face = -1 if no soft body takes
part) against a rigid body (``rigid``; -1 if a fixed plane) with signed ``gap`` [m], unit ``normal`` from the rigid
towards the soft side (from the plane's side away from the body for a body on a plane), ``arm`` = contact point minus
centre of mass [m], and ``stiffness`` [N/m]. ``turns`` says what happens to the normal when the rigid body turns: 1, it
turns along (it belongs to the rigid body's surface); -1, it stays, and the contact point turns about it; 0, neither
matters (nothing rigid, or a ball on a plane). ``curve`` is the second derivative of the gap [1/m], shape (3, 3).

Relative displacement of a contact: w = sum_a weight_a dx_a - dc - dphi x arm, so dgap = normal . w.
"""

import math

import numpy as np

from finqd.mechanics.compiled import njit
from finqd.mechanics.distance_kernels import distance_curvature, signed_distance
from finqd.mechanics.rotation_kernels import rotation_matrix

CLEAR = 1.0 - 1e-9  # of a distance that counts as free way, for rounding
ROUNDING = 1e-9  # [m] of a distance that does not, where ways are added up
LONGEST = 1e3  # [m] sum of ways from which on it is begun anew: small ways would be lost in it
MARCH = 20.0  # allowances of a move after which points that slide along a body are not followed any farther


@njit(cache=True)
def face_point(positions, nodes, weight, point):
    """Write sum_a weight_a positions[nodes_a] to ``point``; nodes of -1 are skipped."""
    point[0] = point[1] = point[2] = 0.0
    for a in range(nodes.shape[0]):
        n = nodes[a]
        if n >= 0:
            for i in range(3):
                point[i] += weight[a] * positions[n, i]


@njit(cache=True)
def face_box(positions, nodes, low, high):
    """Write the box of a face's vertices [m]; it holds all points of the face, whose weights are shares."""
    for i in range(3):
        low[i], high[i] = np.inf, -np.inf
        for a in range(nodes.shape[0]):
            n = nodes[a]
            if n >= 0:
                low[i] = min(low[i], positions[n, i])
                high[i] = max(high[i], positions[n, i])


@njit(cache=True)
def add_travel(positions, faces, centre, rotation, local, travel):
    """Add to ``travel`` (n_faces,) [m] the most that a vertex of each face has moved against a body since last time.

    local: where the vertices were in the body's frame, (n_vertices, 3) [m]; where they are now is written there. No
    point of a face moves farther than its vertices do: its weights are shares.
    """
    y, moved = np.empty(3), np.empty(positions.shape[0])
    for v in range(positions.shape[0]):
        _into_body(positions[v], centre, rotation, y)
        moved[v] = math.sqrt((y[0] - local[v, 0]) ** 2 + (y[1] - local[v, 1]) ** 2 + (y[2] - local[v, 2]) ** 2)
        local[v] = y
    for f in range(faces.shape[0]):
        most = 0.0
        for a in range(faces.shape[1]):
            if faces[f, a] >= 0:
                most = max(most, moved[faces[f, a]])
        travel[f] += most


@njit(cache=True)
def _face_away(positions, nodes, centre, rotation, field, radius, low, high, x):
    """Return a lower bound of a face's distance from a body, and the distance of its box's middle, x (3,) [m].

    Of a face beside the box of the body's bounding ball the second is infinite; low, high: scratch (3,)
    """
    face_box(positions, nodes, low, high)
    beside, size2, y = 0.0, 0.0, np.empty(3)
    for i in range(3):
        beside = max(beside, low[i] - centre[i] - radius, centre[i] - radius - high[i])
        x[i] = 0.5 * (low[i] + high[i])
        size2 += (high[i] - low[i]) ** 2
    if beside > 0.0:
        return beside, np.inf
    _into_body(x, centre, rotation, y)
    d, _, _, _ = signed_distance(field, y[0], y[1], y[2])
    return d - 0.5 * math.sqrt(size2), d


@njit(cache=True)
def find_soft_rigid(
    positions, faces, face_area, face_lattice, lattice_first, lattice_weight, lattice_share, first_sample, pressure,
    centre, rotation, field, radius, local, travel, face_clear, clear, rigid, first_key, out_key, out_face, out_weight,
    out_gap, out_normal, out_arm, out_stiffness, out_rigid, out_turns, count,
):
    """Append the samples of soft faces that lie inside a rigid body; return the new count.

    pressure: stiffness of an area [N/m^3]; radius: of the body's bounding ball [m]. Rows beyond the arrays' end are
    counted, not written. The distance is 1-Lipschitz: a sample nearer to the last one looked at than that was to the
    body is outside; and so is one whose face has not travelled as far yet as it was away when it was looked at:
    local, travel: see `add_travel`; face_clear (n_faces,), clear (n_samples,): what ``travel`` has to reach [m].
    """
    add_travel(positions, faces, centre, rotation, local, travel)
    x, y, last = np.empty(3), np.empty(3), np.empty(3)
    low, high = np.empty(3), np.empty(3)
    for f in range(faces.shape[0]):
        if not travel[f] < LONGEST:
            travel[f], face_clear[f] = 0.0, -1.0
            clear[first_sample[f] : first_sample[f + 1]] = -1.0
        if travel[f] < face_clear[f]:
            continue
        away, d = _face_away(positions, faces[f], centre, rotation, field, radius, low, high, x)
        if away > 0.0:
            face_clear[f] = travel[f] + away - ROUNDING
            continue
        last[:] = x
        first, end = lattice_first[face_lattice[f]], lattice_first[face_lattice[f] + 1]
        stiffness = pressure * face_area[f]
        for s in range(first, end):
            sample = first_sample[f] + s - first
            if travel[f] < clear[sample]:
                continue
            face_point(positions, faces[f], lattice_weight[s], x)
            apart2 = (x[0] - last[0]) ** 2 + (x[1] - last[1]) ** 2 + (x[2] - last[2]) ** 2
            if d > 0.0 and apart2 < d * d:
                clear[sample] = travel[f] + d - math.sqrt(apart2) - ROUNDING
                continue
            last[:] = x
            _into_body(x, centre, rotation, y)
            d, n0, n1, n2 = signed_distance(field, y[0], y[1], y[2])
            if d >= 0.0:
                clear[sample] = travel[f] + d - ROUNDING
                continue
            if count < out_key.shape[0]:
                out_key[count] = first_key + sample
                out_face[count] = f
                out_weight[count] = lattice_weight[s]
                out_gap[count] = d
                for i in range(3):
                    out_normal[count, i] = rotation[i, 0] * n0 + rotation[i, 1] * n1 + rotation[i, 2] * n2
                    out_arm[count, i] = x[i] - centre[i]
                out_stiffness[count] = stiffness * lattice_share[s]
                out_rigid[count] = rigid
                out_turns[count] = 1
            count += 1
    return count


@njit(cache=True)
def _into_body(x, centre, rotation, y):
    """Write a point's coordinates in the frame of a body, y = R^T (x - c)."""
    for i in range(3):
        y[i] = 0.0
        for j in range(3):
            y[i] += rotation[j, i] * (x[j] - centre[j])


@njit(cache=True)
def find_soft_plane(
    positions, faces, face_area, face_lattice, lattice_first, lattice_weight, lattice_share, first_sample, pressure,
    point, normal, first_key, out_key, out_face, out_weight, out_gap, out_normal, out_arm, out_stiffness, out_rigid,
    out_turns, count,
):
    """Append the samples of soft faces below a plane, as `find_soft_rigid` does; return the new count."""
    x, low, high = np.empty(3), np.empty(3), np.empty(3)
    for f in range(faces.shape[0]):
        face_box(positions, faces[f], low, high)
        lowest = 0.0
        for i in range(3):
            lowest += normal[i] * ((low[i] if normal[i] > 0.0 else high[i]) - point[i])
        if lowest >= 0.0:
            continue
        first, end = lattice_first[face_lattice[f]], lattice_first[face_lattice[f] + 1]
        stiffness = pressure * face_area[f]
        for s in range(first, end):
            face_point(positions, faces[f], lattice_weight[s], x)
            d = 0.0
            for i in range(3):
                d += normal[i] * (x[i] - point[i])
            if d >= 0.0:
                continue
            if count < out_key.shape[0]:
                out_key[count] = first_key + first_sample[f] + s - first
                out_face[count] = f
                out_weight[count] = lattice_weight[s]
                out_gap[count] = d
                out_normal[count] = normal
                out_arm[count] = 0.0
                out_stiffness[count] = stiffness * lattice_share[s]
                out_rigid[count] = -1
                out_turns[count] = 0
            count += 1
    return count


@njit(cache=True)
def find_rigid_plane(
    points, ball_radius, centre, rotation, point, normal, stiffness, rigid, first_key, out_key, out_face, out_weight,
    out_gap, out_normal, out_arm, out_stiffness, out_rigid, out_turns, count,
):
    """Append the support points of a rigid body below a plane; return the new count.

    points: in the body frame [m], shape (n, 3); a ball (``ball_radius`` > 0) touches with its lowest point instead.
    The reported normal is minus the plane's, since the body is on the rigid side of the row.
    """
    arm = np.empty(3)
    n = 1 if ball_radius > 0.0 else points.shape[0]
    for s in range(n):
        d = 0.0
        for i in range(3):
            if ball_radius > 0.0:
                arm[i] = -ball_radius * normal[i]
            else:
                arm[i] = rotation[i, 0] * points[s, 0] + rotation[i, 1] * points[s, 1] + rotation[i, 2] * points[s, 2]
            d += normal[i] * (centre[i] + arm[i] - point[i])
        if d >= 0.0:
            continue
        if count < out_key.shape[0]:
            out_key[count] = first_key + s
            out_face[count] = -1
            out_weight[count] = 0.0
            out_gap[count] = d
            out_normal[count] = -normal
            out_arm[count] = arm
            out_stiffness[count] = stiffness
            out_rigid[count] = rigid
            out_turns[count] = 0 if ball_radius > 0.0 else -1
        count += 1
    return count


@njit(cache=True)
def find_curvatures(field, rotation, rigid, row_rigid, turns, gap, normal, arm, curve, count):
    """Write the second derivative of the gap of each row of one rigid body with soft faces, world frame [1/m]."""
    y, n, local = np.empty(3), np.empty(3), np.empty((3, 3))
    for c in range(count):
        if row_rigid[c] != rigid or turns[c] != 1:
            continue
        for i in range(3):
            y[i] = n[i] = 0.0
            for j in range(3):
                y[i] += rotation[j, i] * arm[c, j]
                n[i] += rotation[j, i] * normal[c, j]
        distance_curvature(field, gap[c], y[0], y[1], y[2], n, local)
        curve[c] = rotation @ local @ rotation.T


@njit(cache=True)
def soft_step_limit(
    positions, direction, faces, face_lattice, lattice_first, lattice_weight, centre, rotation, field, radius, shift,
    spin, allowance,
):
    """Return the share of a move in which no point of a soft face can go more than ``allowance`` [m] into a body.

    direction: of the soft vertices, shift and spin: of the body. The distance is 1-Lipschitz, and no point of a face
    moves farther against the body than its vertices do: the face's weights are shares. A face is safe while that stays
    below the distance of its box from the body, plus the allowance; the samples of one that is not are followed, since
    most of them slide (`_way_inside`).
    """
    x, y, low, high = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    limit = 1.0
    for f in range(faces.shape[0]):
        farthest, straight = 0.0, 0.0
        for a in range(faces.shape[1]):
            n = faces[f, a]
            if n < 0:
                continue
            r0, r1, r2 = positions[n, 0] - centre[0], positions[n, 1] - centre[1], positions[n, 2] - centre[2]
            u0 = direction[n, 0] - shift[0] - spin[1] * r2 + spin[2] * r1
            u1 = direction[n, 1] - shift[1] - spin[2] * r0 + spin[0] * r2
            u2 = direction[n, 2] - shift[2] - spin[0] * r1 + spin[1] * r0
            v0, v1, v2 = direction[n, 0] - shift[0], direction[n, 1] - shift[1], direction[n, 2] - shift[2]
            straight = max(straight, math.sqrt(v0 * v0 + v1 * v1 + v2 * v2))
            farthest = max(farthest, math.sqrt(u0 * u0 + u1 * u1 + u2 * u2))
        if farthest * limit <= allowance:
            continue
        face_box(positions, faces[f], low, high)
        size2, away2 = 0.0, 0.0
        for i in range(3):
            x[i] = 0.5 * (low[i] + high[i])
            size2 += (high[i] - low[i]) ** 2
            away2 += (x[i] - centre[i]) ** 2
        half = 0.5 * math.sqrt(size2)
        free = max(math.sqrt(away2) - radius - half, 0.0) + allowance
        if farthest * limit <= free:
            continue
        _into_body(x, centre, rotation, y)
        d, _, _, _ = signed_distance(field, y[0], y[1], y[2])
        free = max(d - half, 0.0) + allowance
        if farthest * limit > free:
            lattice = face_lattice[f]
            weights = lattice_weight[lattice_first[lattice] : lattice_first[lattice + 1]]
            begin = (free - allowance) / farthest
            fastest = farthest + math.sqrt(spin[0] ** 2 + spin[1] ** 2 + spin[2] ** 2) * limit * straight
            limit = _way_inside(
                positions, direction, faces[f], weights, centre, rotation, field, shift, spin, allowance,
                begin, limit, allowance / farthest, fastest,
            )
    return limit


@njit(cache=True)
def _way_inside(
    positions, direction, nodes, weights, centre, rotation, field, shift, spin, allowance, begin, limit, unit, fastest
):
    """Return the share (up to ``limit``) of a move up to which no sample of a face goes ``allowance`` [m] deep.

    Counted is the way along the normal that a sample goes inside the body, inwards and outwards, so that nothing goes
    right through a thin one either. begin: share up to which the face touches nothing; unit: share in which it moves
    by the allowance. At least one unit is granted, at most `MARCH` of them; there are two looks in each, at samples
    that can have come to the body since they were looked at last; fastest: how far a share of 1 takes them [m].
    """
    stride, least, limit = 0.5 * unit, begin + unit, min(limit, begin + MARCH * unit)
    x, y, u, way = np.empty(3), np.empty(3), np.empty(3), np.zeros(weights.shape[0])
    c, w, last = np.empty(3), np.empty(3), np.zeros(3)  # last: read before it is first set
    clear = np.zeros(weights.shape[0])  # share up to which a sample is outside
    share = begin + 0.5 * stride
    while share < limit:
        turned = rotation_matrix(share * spin) @ rotation
        for i in range(3):
            c[i] = centre[i] + share * shift[i]
        d = 0.0
        for s in range(weights.shape[0]):
            if share < clear[s]:
                continue
            face_point(positions, nodes, weights[s], x)
            face_point(direction, nodes, weights[s], u)
            apart2 = 0.0
            for i in range(3):
                x[i] += share * u[i]
                apart2 += (x[i] - last[i]) ** 2
            if d > 0.0 and apart2 < d * d:  # the distance is 1-Lipschitz: outside as well
                clear[s] = share + CLEAR * (d - math.sqrt(apart2)) / fastest
                continue
            for i in range(3):
                last[i] = x[i]
            _into_body(x, c, turned, y)
            d, n0, n1, n2 = signed_distance(field, y[0], y[1], y[2])
            if d >= 0.0:
                clear[s] = share + CLEAR * d / fastest
                continue
            for i in range(3):
                w[i] = x[i] - c[i]
            u[0] -= shift[0] + spin[1] * w[2] - spin[2] * w[1]
            u[1] -= shift[1] + spin[2] * w[0] - spin[0] * w[2]
            u[2] -= shift[2] + spin[0] * w[1] - spin[1] * w[0]
            rate = 0.0
            for i in range(3):
                rate += u[i] * (turned[i, 0] * n0 + turned[i, 1] * n1 + turned[i, 2] * n2)
            way[s] += abs(rate) * stride
            if way[s] > allowance:
                return max(least, share - 0.5 * stride)
        share += stride
    return limit


@njit(cache=True)
def plane_step_limit(heights, approach, allowance):
    """Return the share of a move in which no point sinks more than ``allowance`` [m] below a plane.

    heights: above the plane [m]; approach: how far the full move lowers each point [m]; both shape (n,).
    """
    limit = 1.0
    for i in range(heights.shape[0]):
        if approach[i] > 0.0:
            free = max(heights[i], 0.0) + allowance
            if approach[i] * limit > free:
                limit = free / approach[i]
    return limit
