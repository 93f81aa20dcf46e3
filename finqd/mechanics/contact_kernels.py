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
from numba import njit

from finqd.mechanics.distance_kernels import REVOLUTION, SPHERE, signed_distance

OPPOSED, FULLY_OPPOSED = 0.05, 0.35  # cosines between which two surfaces that look at each other come to push fully


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
def distance_curvature(field, d, y, n0, n1, rotation, normal, out):
    """Write the second derivative [1/m] of a body's distance at a point, in the world frame, shape (3, 3).

    y: the point, body frame; n0, n1: gradient's x and y there; ``normal``: gradient in the world frame. A ball's is
    (I - n n^T)/|y|; a solid of revolution's n_r/r e e^T with e along the circumference (its profile has straight
    pieces); a polyhedron's is 0.
    """
    out[:] = 0.0
    if field.kind == SPHERE:
        r = d + field.radius
        for i in range(3):
            for j in range(3):
                out[i, j] = ((1.0 if i == j else 0.0) - normal[i] * normal[j]) / r
    elif field.kind == REVOLUTION:
        r2 = y[0] * y[0] + y[1] * y[1]
        if r2 > 1e-12:
            e = (rotation[:, 1] * y[0] - rotation[:, 0] * y[1]) / math.sqrt(r2)
            for i in range(3):
                for j in range(3):
                    out[i, j] = (n0 * y[0] + n1 * y[1]) / r2 * e[i] * e[j]


@njit(cache=True)
def opposition(cosine):
    """Return the share of its stiffness with which a contact acts whose sides look at each other with ``cosine``.

    0 below OPPOSED, 1 above FULLY_OPPOSED, the cubic 3 t^2 - 2 t^3 between. Where two edges cross, it switches off what
    pushes from the wrong side; gradually, since Newton's method stalls at a jump. It is held fixed in derivatives.
    """
    t = min(max((cosine - OPPOSED) / (FULLY_OPPOSED - OPPOSED), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@njit(cache=True)
def face_box(positions, nodes, low, high):
    """Write a box that holds all points of a face: its vertices' box, grown by an eighth for faces that bulge [m]."""
    for i in range(3):
        low[i], high[i] = np.inf, -np.inf
        for a in range(nodes.shape[0]):
            n = nodes[a]
            if n >= 0:
                low[i] = min(low[i], positions[n, i])
                high[i] = max(high[i], positions[n, i])
    grow = 0.125 * max(high[0] - low[0], high[1] - low[1], high[2] - low[2])
    for i in range(3):
        low[i] -= grow
        high[i] += grow


@njit(cache=True)
def face_normals(positions, faces, corners, normals):
    """Write the unit normals of faces with 3 or 4 ``corners``, shape (n_faces, 3)."""
    for f in range(faces.shape[0]):
        nodes = faces[f]
        a, b = positions[nodes[1]] - positions[nodes[0]], positions[nodes[2]] - positions[nodes[0]]
        if corners[f] == 4:
            a, b = positions[nodes[2]] - positions[nodes[0]], positions[nodes[3]] - positions[nodes[1]]
        n = np.cross(a, b)
        normals[f] = n / max(math.sqrt(np.dot(n, n)), 1e-300)


@njit(cache=True)
def find_soft_rigid(
    positions, faces, normals, first_sample, sample_weight, sample_stiffness, centre, rotation, field, low, high,
    radius, rigid, first_key, out_key, out_face, out_weight, out_gap, out_normal, out_arm, out_stiffness, out_rigid,
    out_turns, out_curve, count,
):
    """Append the samples of soft faces that lie inside a rigid body; return the new count.

    low, high: bounding box of the body in its own frame, shape (3,); radius: of its bounding ball [m]; normals: unit
    normals of the faces at the start of the step, in the body's frame then, shape (n_faces, 3). A sample acts as far
    as its face looks towards the body's surface (`opposition`), which so does not change while the body turns: the
    forces are the derivatives of the energy.
    """
    x, y, m = np.empty(3), np.empty(3), np.empty(3)
    face_low, face_high = np.empty(3), np.empty(3)
    for f in range(faces.shape[0]):
        face_box(positions, faces[f], face_low, face_high)
        apart = False
        for i in range(3):
            if face_low[i] > centre[i] + radius or face_high[i] < centre[i] - radius:
                apart = True
        if apart:
            continue
        for s in range(first_sample[f], first_sample[f + 1]):
            face_point(positions, faces[f], sample_weight[s], x)
            inside = True
            for i in range(3):
                y[i] = 0.0
                for j in range(3):
                    y[i] += rotation[j, i] * (x[j] - centre[j])
                if y[i] < low[i] or y[i] > high[i]:
                    inside = False
                    break
            if not inside:
                continue
            d, n0, n1, n2 = signed_distance(field, y[0], y[1], y[2])
            if d >= 0.0:
                continue
            share = opposition(-(n0 * normals[f, 0] + n1 * normals[f, 1] + n2 * normals[f, 2]))
            if share <= 0.0:
                continue
            for i in range(3):
                m[i] = rotation[i, 0] * n0 + rotation[i, 1] * n1 + rotation[i, 2] * n2
            out_key[count] = first_key + s
            out_face[count] = f
            out_weight[count] = sample_weight[s]
            out_gap[count] = d
            for i in range(3):
                out_normal[count, i] = m[i]
                out_arm[count, i] = x[i] - centre[i]
            out_stiffness[count] = share * sample_stiffness[s]
            out_rigid[count] = rigid
            out_turns[count] = 1
            distance_curvature(field, d, y, n0, n1, rotation, m, out_curve[count])
            count += 1
    return count


@njit(cache=True)
def find_soft_plane(
    positions, faces, normals, first_sample, sample_weight, sample_stiffness, point, normal, first_key,
    out_key, out_face, out_weight, out_gap, out_normal, out_arm, out_stiffness, out_rigid, out_turns, out_curve,
    count,
):
    """Append the samples of soft faces below a plane, as `find_soft_rigid` does; return the new count."""
    x, face_low, face_high = np.empty(3), np.empty(3), np.empty(3)
    for f in range(faces.shape[0]):
        face_box(positions, faces[f], face_low, face_high)
        lowest = 0.0
        for i in range(3):
            lowest += normal[i] * ((face_low[i] if normal[i] > 0.0 else face_high[i]) - point[i])
        if lowest >= 0.0:
            continue
        for s in range(first_sample[f], first_sample[f + 1]):
            face_point(positions, faces[f], sample_weight[s], x)
            d = 0.0
            for i in range(3):
                d += normal[i] * (x[i] - point[i])
            if d >= 0.0:
                continue
            share = opposition(-np.dot(normal, normals[f]))
            if share <= 0.0:
                continue
            out_key[count] = first_key + s
            out_face[count] = f
            out_weight[count] = sample_weight[s]
            out_gap[count] = d
            out_normal[count] = normal
            out_arm[count] = 0.0
            out_stiffness[count] = share * sample_stiffness[s]
            out_rigid[count] = -1
            out_turns[count] = 0
            out_curve[count] = 0.0
            count += 1
    return count


@njit(cache=True)
def find_rigid_plane(
    points, ball_radius, centre, rotation, point, normal, stiffness, rigid, first_key,
    out_key, out_face, out_weight, out_gap, out_normal, out_arm, out_stiffness, out_rigid, out_turns, out_curve,
    count,
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
        out_key[count] = first_key + s
        out_face[count] = -1
        out_weight[count] = 0.0
        out_gap[count] = d
        out_normal[count] = -normal
        out_arm[count] = arm
        out_stiffness[count] = stiffness
        out_rigid[count] = rigid
        out_turns[count] = 0 if ball_radius > 0.0 else -1
        out_curve[count] = 0.0
        count += 1
    return count


@njit(cache=True)
def soft_step_limit(
    positions, soft_direction, faces, sample_face, sample_weight, spacing, centre, rotation, field, low, high,
    shift, spin, allowance,
):
    """Return the share of a move in which no soft sample can pass more than ``allowance`` [m] into a rigid body.

    The distance is 1-Lipschitz, so a sample at distance d is safe while its motion relative to the body stays below
    max(d - spacing/2, 0) + allowance; outside the body's box the distance to the box bounds d from below.
    """
    x, u, y = np.empty(3), np.empty(3), np.empty(3)
    limit = 1.0
    for s in range(sample_face.shape[0]):
        nodes = faces[sample_face[s]]
        face_point(positions, nodes, sample_weight[s], x)
        face_point(soft_direction, nodes, sample_weight[s], u)
        r = x - centre
        u[0] -= shift[0] + spin[1] * r[2] - spin[2] * r[1]
        u[1] -= shift[1] + spin[2] * r[0] - spin[0] * r[2]
        u[2] -= shift[2] + spin[0] * r[1] - spin[1] * r[0]
        move = math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
        if move <= allowance:
            continue
        outside = 0.0
        for i in range(3):
            y[i] = rotation[0, i] * r[0] + rotation[1, i] * r[1] + rotation[2, i] * r[2]
            e = max(low[i] - y[i], y[i] - high[i], 0.0)
            outside += e * e
        d = math.sqrt(outside)
        if move > d - 0.5 * spacing + allowance:
            if d == 0.0:
                d, _, _, _ = signed_distance(field, y[0], y[1], y[2])
            free = max(d - 0.5 * spacing, 0.0) + allowance
            if move * limit > free:
                limit = free / move
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
