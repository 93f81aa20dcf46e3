"""Kernels that keep quadratic hexahedra from folding into modes that their reduced rule does not see.

With L = (L_full - L_reduced)+ (see `finqd.mechanics.element_stiffness.hourglass_matrix`), the mean square of the
gradient that only the full rule sees is

    g = 1/V sum_ab L_ab x_a . x_b                        [-], 0 for any affine motion
    E = c mu V h(g - g0)                                 [J]
    gradient_a = 2 c mu h' (L x)_a                       [N]
    Hessian_ab = 2 c mu h' L_ab 1 + 4 c mu h''/V (L x)_a (L x)_b^T   [N/m], positive semidefinite
    h' = 0 for d <= 0,   d^2/(2 w) for d <= w,   d - w/2 for d <= d1,   d1 - w/2 beyond

Where no element is folded far (g <= g0) this is zero, and far beyond it is quadratic in the positions: bodies that
start tangled are no harder than others. A hardening of the hourglass stiffness; the idea of an artificial
stiffness is that of Flanagan and Belytschko, Int. J. Numer. Methods Eng. 17 (1981) 679; the law is our own.

Arrays of a block: nodes (n, k) scene vertex ids; kinds (n,): shape of each element; laplacians L (n_kinds, k, k) [m];
volumes V (n_kinds,) [m^3]; positions (n_vertices, 3) [m]; stiffness c mu [Pa]; bends = (g0, w, d1) [-].
"""

from __future__ import annotations

import numpy as np

from finqd.mechanics.compiled import njit


@njit(cache=True)
def _folded(e, nodes, laplacian, positions, x, lx):
    """Write L x (k, 3) [m^2] of element e and return sum_ab L_ab x_a . x_b [m^3]."""
    k = nodes.shape[1]
    first = nodes[e, 0]
    for a in range(k):
        for i in range(3):
            x[i, a] = positions[nodes[e, a], i] - positions[first, i]  # L annihilates constants, but for rounding
    total = 0.0
    for a in range(k):
        l0, l1, l2 = 0.0, 0.0, 0.0
        for b in range(k):
            value = laplacian[a, b]
            l0 += value * x[0, b]
            l1 += value * x[1, b]
            l2 += value * x[2, b]
        lx[a, 0], lx[a, 1], lx[a, 2] = l0, l1, l2
        total += l0 * x[0, a] + l1 * x[1, a] + l2 * x[2, a]
    return total


@njit(cache=True)
def _hardening(d, bends):
    """Return h, h' and h'' at d > 0."""
    _, w, steep = bends
    if d <= w:
        return d * d * d / (6.0 * w), d * d / (2.0 * w), d / w
    at_w = w * w / 6.0
    if d <= steep:
        return at_w + 0.5 * d * (d - w), d - 0.5 * w, 1.0
    return at_w + 0.5 * steep * (steep - w) + (steep - 0.5 * w) * (d - steep), steep - 0.5 * w, 0.0


@njit(cache=True)
def add_gradient(nodes, kinds, laplacians, volumes, stiffness, bends, positions, gradient):
    """Add s (L x)_a [N] to gradient (n_vertices, 3), unless that is empty; return the energy [J]."""
    k = nodes.shape[1]
    x, lx = np.empty((3, k)), np.empty((k, 3))
    total = 0.0
    for e in range(nodes.shape[0]):
        kind = kinds[e]
        over = _folded(e, nodes, laplacians[kind], positions, x, lx) / volumes[kind] - bends[0]
        if over > 0.0:
            hardening, rate, _ = _hardening(over, bends)
            total += stiffness * volumes[kind] * hardening
            if gradient.shape[0] > 0:
                for a in range(k):
                    for i in range(3):
                        gradient[nodes[e, a], i] += 2.0 * stiffness * rate * lx[a, i]
    return total


@njit(cache=True)
def add_hessian(nodes, kinds, laplacians, volumes, stiffness, bends, positions, slots, blocks):
    """Add the Hessian [N/m] to blocks (n_blocks + 1, 3, 3); slots (n, k, k)."""
    k = nodes.shape[1]
    x, lx = np.empty((3, k)), np.empty((k, 3))
    for e in range(nodes.shape[0]):
        kind = kinds[e]
        over = _folded(e, nodes, laplacians[kind], positions, x, lx) / volumes[kind] - bends[0]
        if over > 0.0:
            _, rate, bend = _hardening(over, bends)
            outer = 4.0 * stiffness * bend / volumes[kind]
            for a in range(k):
                for b in range(k):
                    slot = slots[e, a, b]
                    same = 2.0 * stiffness * rate * laplacians[kind, a, b]
                    for i in range(3):
                        blocks[slot, i, i] += same
                        for j in range(3):
                            blocks[slot, i, j] += outer * lx[a, i] * lx[b, j]
