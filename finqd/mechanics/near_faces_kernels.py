"""Kernels of how far bodies have moved since their near faces were listed, and which lists that calls for."""

import math

import numpy as np

from finqd.mechanics.compiled import njit
from finqd.mechanics.polar_kernels import closest_rotation
from finqd.mechanics.proximity_kernels import mean_move

LONGEST = 1e3  # [m] sum of ways beside which short ones would be lost


@njit(cache=True)
def same_numbers(one, other):
    """Return whether two arrays (n, 3) are of one size and hold the same numbers."""
    if one.shape[0] != other.shape[0]:
        return False
    for v in range(one.shape[0]):
        for i in range(3):
            if one[v, i] != other[v, i]:
                return False
    return True


@njit(cache=True)
def body_box(positions, first, end, low, high):
    """Write the box of the vertices from ``first`` to ``end`` [m]."""
    for i in range(3):
        low[i], high[i] = np.inf, -np.inf
    for v in range(first, end):
        for i in range(3):
            low[i], high[i] = min(low[i], positions[v, i]), max(high[i], positions[v, i])


@njit(cache=True)
def longest_move(moves, first, end):
    """Return the longest of ``moves`` (n_vertices, 3) [m] from ``first`` to ``end``."""
    most = 0.0
    for v in range(first, end):
        way2 = moves[v, 0] ** 2 + moves[v, 1] ** 2 + moves[v, 2] ** 2
        if not way2 <= most:  # takes a NaN too
            most = way2
    return math.sqrt(most)


@njit(cache=True)
def add_drift(positions, last, spans, drift):
    """Add to ``drift`` (n_bodies,) [m] how far a vertex of each body has gone at most from ``last``, the new last.

    Returns whether all that is finite, and no more than `LONGEST`; if it is not, ``drift`` is not changed.
    """
    moves = np.empty(spans.shape[0])
    for b in range(spans.shape[0]):
        most = 0.0
        for v in range(spans[b, 0], spans[b, 1]):
            x, y, z = positions[v, 0], positions[v, 1], positions[v, 2]
            way2 = (x - last[v, 0]) ** 2 + (y - last[v, 1]) ** 2 + (z - last[v, 2]) ** 2
            last[v, 0], last[v, 1], last[v, 2] = x, y, z
            if not way2 <= most:  # takes a NaN too
                most = way2
        moves[b] = math.sqrt(most)
    for b in range(spans.shape[0]):
        if not drift[b] + moves[b] <= LONGEST:
            return False
    for b in range(spans.shape[0]):
        drift[b] += moves[b]
    return True


@njit(cache=True)
def called_watches(positions, moved, direction, moving, spans, last, drift, bodies, slack, mark, out):
    """Write the numbers of the pairs of bodies (n, 2) whose faces may meet; return how many, -1 if all may (too far).

    moved: whether ``positions`` (n_vertices, 3) [m] may differ from ``last``; moving: whether they may meet anywhere on
    the way along ``direction``, of the same shape, instead of at ``positions`` alone
    drift (n_bodies,) [m]: ways gone in sum, brought up to date; mark (n, 2) [m]: those when each pair had its ``slack``
    (n,) [m]
    """
    if moved and not add_drift(positions, last, spans, drift):
        return -1
    way = drift.copy()
    if moving:
        for b in range(spans.shape[0]):
            way[b] += longest_move(direction, spans[b, 0], spans[b, 1])
    count = 0
    for k in range(bodies.shape[0]):
        left = slack[k] - (way[bodies[k, 0]] - mark[k, 0]) - (way[bodies[k, 1]] - mark[k, 1])
        if not left > 0.0:  # takes a NaN too
            out[count] = k
            count += 1
    return count


@njit(cache=True)
def _mean(positions, first, end):
    """Return the mean of the vertices from ``first`` to ``end``, three numbers."""
    x = y = z = 0.0
    for v in range(first, end):
        x, y, z = x + positions[v, 0], y + positions[v, 1], z + positions[v, 2]
    n = end - first
    return x / n, y / n, z / n


@njit(cache=True)
def relative_moves(positions, reference, first, end, rigid, moves):
    """Write how vertices from ``first`` to ``end`` have moved from ``reference``; return the longest way, all in m.

    rigid: after the best rigid motion in the mean square has been taken away, in the frame of the reference (Kabsch,
    Acta Cryst. A32 (1976) 922)
    """
    here0 = here1 = here2 = there0 = there1 = there2 = 0.0
    turn = np.eye(3)
    if rigid:
        here0, here1, here2 = _mean(positions, first, end)
        there0, there1, there2 = _mean(reference, first, end)
        xx = xy = xz = yx = yy = yz = zx = zy = zz = 0.0
        for v in range(first, end):
            x, y, z = positions[v, 0] - here0, positions[v, 1] - here1, positions[v, 2] - here2
            u, w, t = reference[v, 0] - there0, reference[v, 1] - there1, reference[v, 2] - there2
            xx, xy, xz = xx + x * u, xy + x * w, xz + x * t
            yx, yy, yz = yx + y * u, yy + y * w, yz + y * t
            zx, zy, zz = zx + z * u, zy + z * w, zz + z * t
        closest_rotation(np.array([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]]), turn)
    largest = 0.0
    for v in range(first, end):
        x, y, z = positions[v, 0] - here0, positions[v, 1] - here1, positions[v, 2] - here2
        u = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z - (reference[v, 0] - there0)
        w = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z - (reference[v, 1] - there1)
        t = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z - (reference[v, 2] - there2)
        moves[v, 0], moves[v, 1], moves[v, 2] = u, w, t
        way2 = u * u + w * w + t * t
        if not way2 <= largest:  # takes a NaN too
            largest = way2
    return math.sqrt(largest)


@njit(cache=True)
def remaining_gaps(moves, way, enough, faces, listed, gaps, out):
    """Write a lower bound of the distance [m] of each pair ``listed`` (n, 2); ``gaps`` (n,): one before ``moves``.

    The bound is that of `relative_way`; or ``way`` [m], by which any two points have come nearer at most, is taken off
    where that leaves ``enough`` [m]: most listed faces are far, or have a wall between them.
    """
    mean, spread = np.empty((faces.shape[0], 3)), np.full(faces.shape[0], -1.0)
    for p in range(listed.shape[0]):
        if gaps[p] - way >= enough:
            out[p] = gaps[p] - way
            continue
        a, b = listed[p, 0], listed[p, 1]
        for f in (a, b):
            if spread[f] == -1.0:
                mean[f, 0], mean[f, 1], mean[f, 2], spread[f] = mean_move(moves, faces[f])
        way2 = 0.0
        for i in range(3):
            way2 += (mean[a, i] - mean[b, i]) ** 2
        out[p] = gaps[p] - math.sqrt(way2) - spread[a] - spread[b]


@njit(cache=True)
def gaps_left(positions, reference, spans, one, other, moves, enough, faces, listed, gaps, out):
    """Write the `remaining_gaps` of the faces of two bodies, or of one; return how much nearer any may have come [m].

    The arguments are those of `relative_moves`, with the vertices of bodies from ``spans`` (n_bodies, 2), and of
    `remaining_gaps`; ``moves`` (n_vertices, 3) is room to work.
    """
    alone = one == other
    way = relative_moves(positions, reference, spans[one, 0], spans[one, 1], alone, moves)
    if alone:
        way = 2.0 * way
    else:
        way += relative_moves(positions, reference, spans[other, 0], spans[other, 1], alone, moves)
    remaining_gaps(moves, way, enough, faces, listed, gaps, out)
    return way
