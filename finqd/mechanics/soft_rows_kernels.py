"""Kernels that find the rows of contact between soft faces; what a row is, `soft_contact_kernels` says."""

import math

import numpy as np

from finqd.mechanics.compiled import njit
from finqd.mechanics.contact_kernels import face_box, face_point
from finqd.mechanics.proximity_kernels import (
    LOCALS,
    PIECES,
    box_distance2,
    closest_on_triangle,
    dot3,
    faces_gap,
    local_points,
    off_plane,
    piece_planes,
)


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
        planes = np.empty((near, PIECES, 4))
        for o in range(near):
            local_points(positions, faces[ids[o]], points[o])
            piece_planes(points[o], corners, pieces[ids[o]], pieces[ids[o] + 1], planes[o])
            face_box(positions, faces[ids[o]], boxes[o, 0], boxes[o, 1])
            most += pieces[ids[o] + 1] - pieces[ids[o]]
        who, piece, share = np.empty(5 * most, np.int64), np.empty(5 * most, np.int64), np.empty((5 * most, 3))
        part, times = np.empty(5 * most, np.int64), np.empty(5 * most, np.int64)
        first, end = lattice_first[face_lattice[f]], lattice_first[face_lattice[f] + 1]
        for s in range(first, end):
            face_point(positions, faces[f], lattice_weight[s], x)
            found = _triangles_near(x, ids, near, points, planes, boxes, pieces, corners, gap, who, piece, share)
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
                    size = math.sqrt(dot3(out_normal[count], out_normal[count]))
                    out_distance[count] = size
                    if size > 0.0:
                        out_normal[count] /= size
                count += 1
    return count


@njit(cache=True)
def _triangles_near(x, ids, near, points, planes, boxes, pieces, corners, gap, who, piece, share):
    """Write the triangles nearer than ``gap`` to x (3,), with the closest point's share; return how many."""
    found, one = 0, np.empty(3)
    for o in range(near):
        if box_distance2(x, boxes[o, 0], boxes[o, 1]) >= gap * gap:
            continue
        for t in range(pieces[ids[o]], pieces[ids[o] + 1]):
            if off_plane(planes[o, t - pieces[ids[o]]], x) >= gap:
                continue
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
