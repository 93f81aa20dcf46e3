r"""Kernels of the neo-Hookean potential: one loop over quadrature points for every element type.

    F(q) = sum_a x_a (x) g_a(q) + sum_m alpha_m (x) G_m(q)        J = det F,  C = cof F = J F^-T
    W = mu/2 (J^(-2/3) tr F^T F - 3)  at each point,   V_g kappa/4 (Jm^2 - 1 - 2 ln Jm)  for each group of points,
    Jm = sum_{q in g} w_q J(q) / V_g: the point's own J, or the mean dilatation of several points

and mu/2 sum_ab S_ab x_a . x_b (hex20's hourglass modes). With f_a = F g_a, c_a = C g_a, I = tr F^T F, s = mu J^(-2/3):

    gradient_a = sum_q w (s f_a + p c_a)         p = kappa/2 (Jm - 1/Jm) - s I / (3 J)
    Hessian_ab = sum_q w (s (g_a . g_b) 1 - 2 s/(3 J) (f_a c_b^T + c_a f_b^T) + (5 s I/(9 J^2) + p/J) c_a c_b^T
                 - p/J c_b c_a^T) + sum_g kappa/2 (1 + 1/Jm^2) / V_g d_a d_b^T,    d_a = sum_{q in g} w c_a

(g_a x g_b goes to F (g_a x g_b) = c_a x c_b / J.) The enhanced modes alpha are inner unknowns: the energy of an element
is its minimum over them, found by Newton's method with a line search from alpha = 0, a pure function of the positions;
at the minimum the gradient needs no derivative of alpha, and the Hessian is condensed.
Sources: Simo, Taylor and Pister, Comput. Methods Appl. Mech. Eng. 51 (1985) 177 (decoupled W, mean dilatation);
Hartmann and Neff, Int. J. Solids Struct. 40 (2003) 2767 (both terms are polyconvex; the second grows without bound
as J -> 0); Simo and Armero, Int. J. Numer. Methods Eng. 33 (1992) 1413 (enhanced modes at large strain).

Arrays of a block: nodes (n, k) scene vertex ids; shapes (n, q, 3, k + m): columns g_a, then G_m [1/m]; weights (n, q)
[m^3]; group (q,): group of each point, 0, 1, ...; hourglass S (n or 0, k, k) [m]; positions (n_vertices, 3) [m].
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

INNER_ITERATIONS = 50  # of Newton's method for the modes
CONVERGED = 1e-18  # squared Newton decrement [mu V] after which one more step is exact to rounding
SURE = 1e-11  # squared Newton decrement [mu V] below which rounding makes a comparison of energies useless


@njit(cache=True)
def _place(e, nodes, shapes, positions, x, base):
    """Write the element's nodes about its first one to x (3, k + m), zero for the modes, and their F to base."""
    k = nodes.shape[1]
    v0 = nodes[e, 0]
    x[:] = 0.0
    for a in range(k):
        v = nodes[e, a]
        for i in range(3):
            x[i, a] = positions[v, i] - positions[v0, i]
    base[:] = 0.0
    _deform(e, shapes, x, 0, k, base)


@njit(cache=True)
def _deform(e, shapes, x, first, last, f):
    """Add sum x_a (x) g_a over the columns first to last to F (q, 3, 3) of all points."""
    for q in range(shapes.shape[1]):
        for i in range(3):
            for j in range(3):
                total = 0.0
                for a in range(first, last):
                    total += x[i, a] * shapes[e, q, j, a]
                f[q, i, j] += total


@njit(cache=True)
def _strain_energy(e, weights, group, f, c, scalars, dilated, mu, kappa):
    """Write C, (J, I, s, -) of all points and (Jm, V) of all groups; return the energy [J], inf if a J <= 0.

    tr F^T F - 3 and J^2 - 1 come from the strain E = (F^T F - 1)/2, so that a small strain's energy is not lost in the
    rounding of 3 and 1.
    """
    dilated[:] = 0.0
    total = 0.0
    for q in range(f.shape[0]):
        f00, f01, f02, f10, f11, f12 = f[q, 0, 0], f[q, 0, 1], f[q, 0, 2], f[q, 1, 0], f[q, 1, 1], f[q, 1, 2]
        f20, f21, f22 = f[q, 2, 0], f[q, 2, 1], f[q, 2, 2]
        c00, c01, c02 = f11 * f22 - f12 * f21, f12 * f20 - f10 * f22, f10 * f21 - f11 * f20
        jacobian = f00 * c00 + f01 * c01 + f02 * c02
        if not jacobian > 0.0:
            return math.inf
        c[q, 0, 0], c[q, 0, 1], c[q, 0, 2] = c00, c01, c02
        c[q, 1, 0], c[q, 1, 1], c[q, 1, 2] = f02 * f21 - f01 * f22, f00 * f22 - f02 * f20, f01 * f20 - f00 * f21
        c[q, 2, 0], c[q, 2, 1], c[q, 2, 2] = f01 * f12 - f02 * f11, f02 * f10 - f00 * f12, f00 * f11 - f01 * f10
        a = f00 * f00 + f10 * f10 + f20 * f20 - 1.0
        b = f01 * f01 + f11 * f11 + f21 * f21 - 1.0
        d = f02 * f02 + f12 * f12 + f22 * f22 - 1.0
        g = f01 * f02 + f11 * f12 + f21 * f22
        h = f00 * f02 + f10 * f12 + f20 * f22
        o = f00 * f01 + f10 * f11 + f20 * f21
        trace = a + b + d
        square = trace + (a * b + b * d + a * d - g * g - h * h - o * o) + (
            a * b * d + 2.0 * g * h * o - a * g * g - b * h * h - d * o * o)
        log = math.log1p(square) if square > -0.5 else 2.0 * math.log(jacobian)
        root = math.exp(-log / 3.0)
        w = weights[e, q]
        total += 0.5 * mu * w * (3.0 * math.expm1(-log / 3.0) + trace * root)
        dilated[group[q], 0] += w * math.expm1(0.5 * log)
        dilated[group[q], 1] += w
        scalars[q, 0], scalars[q, 1], scalars[q, 2] = jacobian, trace + 3.0, mu * root
    for n in range(dilated.shape[0]):
        change = dilated[n, 0] / dilated[n, 1]
        total += dilated[n, 1] * 0.25 * kappa * (change * (2.0 + change) - 2.0 * math.log1p(change))
        dilated[n, 0] = 1.0 + change
    for q in range(f.shape[0]):
        jm = dilated[group[q], 0]
        scalars[q, 3] = 0.5 * kappa * (jm - 1.0 / jm) - scalars[q, 2] * scalars[q, 1] / (3.0 * scalars[q, 0])
    return total


@njit(cache=True)
def _element_gradient(e, shapes, weights, f, c, scalars, first, last, out):
    """Write the gradient [N] for the columns first to last of x to out (3, last - first)."""
    out[:] = 0.0
    for q in range(f.shape[0]):
        s, p = weights[e, q] * scalars[q, 2], weights[e, q] * scalars[q, 3]
        for i in range(3):
            k0 = s * f[q, i, 0] + p * c[q, i, 0]
            k1 = s * f[q, i, 1] + p * c[q, i, 1]
            k2 = s * f[q, i, 2] + p * c[q, i, 2]
            for a in range(first, last):
                out[i, a - first] += k0 * shapes[e, q, 0, a] + k1 * shapes[e, q, 1, a] + k2 * shapes[e, q, 2, a]


@njit(cache=True)
def _vectors(e, q, shapes, f, c, first, last, fv, cv):
    """Write f_a and c_a of point q, for the columns first to last, to fv and cv (3, last - first)."""
    for i in range(3):
        f0, f1, f2, c0, c1, c2 = f[q, i, 0], f[q, i, 1], f[q, i, 2], c[q, i, 0], c[q, i, 1], c[q, i, 2]
        for a in range(first, last):
            g0, g1, g2 = shapes[e, q, 0, a], shapes[e, q, 1, a], shapes[e, q, 2, a]
            fv[i, a - first] = f0 * g0 + f1 * g1 + f2 * g2
            cv[i, a - first] = c0 * g0 + c1 * g1 + c2 * g2


@njit(cache=True)
def _element_hessian(e, shapes, weights, group, f, c, scalars, dilated, kappa, first, last, vectors, dots, h):
    """Write the Hessian [N/m] for the columns first to last of x to h (3n, 3n), row i n + a for axis i and column a.

    Only blocks with j >= i are computed, the others mirrored.
    vectors: scratch (3 + groups, 3, n): f_a, c_a, the halves h_a of c_a's factor, d_a of each group; dots: (n, n)
    """
    n = last - first
    h[:] = 0.0
    dots[:] = 0.0
    vectors[3:] = 0.0
    for q in range(f.shape[0]):
        _vectors(e, q, shapes, f, c, first, last, vectors[0], vectors[1])
        w, jacobian, s = weights[e, q], scalars[q, 0], scalars[q, 2]
        turn = w * scalars[q, 3] / jacobian
        mixed = -2.0 * w * s / (3.0 * jacobian)
        own = 0.5 * (5.0 * w * s * scalars[q, 1] / (9.0 * jacobian * jacobian) + turn)
        d = 3 + group[q]
        for i in range(3):
            for a in range(n):
                vectors[2, i, a] = mixed * vectors[0, i, a] + own * vectors[1, i, a]
                vectors[d, i, a] += w * vectors[1, i, a]
        for a in range(n):
            g0, g1, g2 = shapes[e, q, 0, first + a], shapes[e, q, 1, first + a], shapes[e, q, 2, first + a]
            for b in range(n):
                dots[a, b] += w * s * (g0 * shapes[e, q, 0, first + b] + g1 * shapes[e, q, 1, first + b]
                                       + g2 * shapes[e, q, 2, first + b])
        for i in range(3):
            for j in range(i, 3):
                for a in range(n):
                    u, v, t = vectors[2, i, a], vectors[1, i, a], turn * vectors[1, j, a]
                    row, column = i * n + a, j * n
                    for b in range(n):
                        h[row, column + b] += u * vectors[1, j, b] + v * vectors[2, j, b] - t * vectors[1, i, b]
    for g in range(dilated.shape[0]):
        jm = dilated[g, 0]
        stiff = 0.5 * kappa * (1.0 + 1.0 / (jm * jm)) / dilated[g, 1]
        for i in range(3):
            for j in range(i, 3):
                for a in range(n):
                    u = stiff * vectors[3 + g, i, a]
                    for b in range(n):
                        h[i * n + a, j * n + b] += u * vectors[3 + g, j, b]
    for i in range(3):
        for a in range(n):
            for b in range(n):
                h[i * n + a, i * n + b] += dots[a, b]
            for j in range(i):
                for b in range(n):
                    h[i * n + a, j * n + b] = h[j * n + b, i * n + a]


@njit(cache=True)
def _factor(a, shift):
    """Overwrite the lower triangle of a (n, n) with the Cholesky factor of a + shift 1; return whether there is one."""
    n = a.shape[0]
    for i in range(n):
        for j in range(i):
            total = a[i, j]
            for p in range(j):
                total -= a[i, p] * a[j, p]
            a[i, j] = total / a[j, j]
        total = a[i, i] + shift
        for p in range(i):
            total -= a[i, p] * a[i, p]
        if not total > 0.0:
            return False
        a[i, i] = math.sqrt(total)
    return True


@njit(cache=True)
def _step(h, factor, gradient, step):
    """Write the Newton step -(h + shift 1)^-1 gradient to step (3, m), with a shift where h is not positive definite.

    Return the squared Newton decrement [J].
    """
    n, m = h.shape[0], gradient.shape[1]
    trace = 0.0
    for i in range(n):
        trace += abs(h[i, i])
    shift = 0.0
    factor[:] = h
    while not _factor(factor, shift):
        shift = max(10.0 * shift, 1e-4 * trace / n)
        factor[:] = h
    y = step.reshape(-1)
    for i in range(n):
        total = -gradient[i // m, i % m]
        for p in range(i):
            total -= factor[i, p] * y[p]
        y[i] = total / factor[i, i]
    decrement = 0.0
    for i in range(n - 1, -1, -1):
        decrement += y[i] * y[i]
        for p in range(i + 1, n):
            y[i] -= factor[p, i] * y[p]
        y[i] /= factor[i, i]
    return decrement


@njit(cache=True)
def _relax(e, shapes, weights, group, k, mu, kappa, x, base, f, c, scalars, dilated, gradient, vectors, dots, h, factor,
           step):
    """Find the modes (the last columns of x, from 0) that minimise the energy; return it [J], with F, C, ... there.

    inf if a point is inverted at the start, or if Newton's method does not end.
    """
    last = shapes.shape[3]
    f[:] = base
    energy = _strain_energy(e, weights, group, f, c, scalars, dilated, mu, kappa)
    if last == k or energy == math.inf:
        return energy
    size = 0.0
    for q in range(weights.shape[1]):
        size += mu * weights[e, q]
    for _ in range(INNER_ITERATIONS):
        _element_gradient(e, shapes, weights, f, c, scalars, k, last, gradient)
        _element_hessian(e, shapes, weights, group, f, c, scalars, dilated, kappa, k, last, vectors, dots, h)
        decrement = _step(h, factor, gradient, step)
        share, before = 1.0, energy
        while True:
            for i in range(3):
                for a in range(k, last):
                    x[i, a] += share * step[i, a - k]
            f[:] = base
            _deform(e, shapes, x, k, last, f)
            energy = _strain_energy(e, weights, group, f, c, scalars, dilated, mu, kappa)
            if energy <= before - 1e-4 * share * decrement or (decrement <= SURE * size and energy < math.inf):
                break
            for i in range(3):
                for a in range(k, last):
                    x[i, a] -= share * step[i, a - k]
            share *= 0.5
            if share < 1e-9:
                return math.inf
        if decrement <= CONVERGED * size:
            return energy
    return math.inf


@njit(cache=True)
def _condense(h, k, m, lower, rows, out):
    """Write H_uu - H_um H_mm^-1 H_mu of h (3(k+m), 3(k+m)) to out (3k, 3k); lower (3m, 3m), rows (3m, 3k): scratch."""
    n = k + m
    for i in range(3):
        for a in range(k):
            for j in range(3):
                for b in range(k):
                    out[i * k + a, j * k + b] = h[i * n + a, j * n + b]
    if m == 0:
        return
    trace = 0.0
    for i in range(3 * m):
        p = i // m * n + k + i % m
        trace += h[p, p]
    shift = 0.0
    while True:
        for i in range(3 * m):
            for j in range(i + 1):
                lower[i, j] = h[i // m * n + k + i % m, j // m * n + k + j % m]
        if _factor(lower, shift):
            break
        shift = max(10.0 * shift, 1e-9 * trace)
    for i in range(3 * m):
        p = i // m * n + k + i % m
        for j in range(3):
            for b in range(k):
                rows[i, j * k + b] = h[p, j * n + b]
        for t in range(i):
            w = lower[i, t]
            for b in range(3 * k):
                rows[i, b] -= w * rows[t, b]
        for b in range(3 * k):
            rows[i, b] /= lower[i, i]
    for t in range(3 * m):
        for a in range(3 * k):
            w = rows[t, a]
            for b in range(3 * k):
                out[a, b] -= w * rows[t, b]


@njit(cache=True)
def _project(h, factor):
    """Set the negative eigenvalues of h (n, n) to zero, where it has any (the test is a Cholesky factor)."""
    n = h.shape[0]
    trace = 0.0
    for i in range(n):
        trace += h[i, i]
    factor[:] = h
    if _factor(factor, 1e-13 * abs(trace)):
        return
    values, vectors = np.linalg.eigh(h)
    for p in range(n):
        if values[p] < 0.0:
            for i in range(n):
                w = values[p] * vectors[i, p]
                for j in range(n):
                    h[i, j] -= w * vectors[j, p]


@njit(cache=True)
def _hourglass(e, hourglass, mu, x, gradient):
    """Add mu S x of element e to gradient (3, k), if there is an S; return its energy [J]."""
    total = 0.0
    if hourglass.shape[0] == 0:
        return total
    for i in range(3):
        for a in range(gradient.shape[1]):
            force = 0.0
            for b in range(gradient.shape[1]):
                force += mu * hourglass[e, a, b] * x[i, b]
            gradient[i, a] += force
            total += 0.5 * force * x[i, a]
    return total


@njit(cache=True)
def _walk(nodes, shapes, weights, group, hourglass, mu, kappa, positions, gradient, slots, blocks, task, projected):
    """Do for each element: task 0 its energy; 1 the gradient too; 2 only its Hessian. Return the energy [J]."""
    k, last = nodes.shape[1], shapes.shape[3]
    m, points, groups = last - k, shapes.shape[1], 0
    for q in range(points):
        groups = max(groups, group[q] + 1)
    x, base, f, c = np.empty((3, last)), np.empty((points, 3, 3)), np.empty((points, 3, 3)), np.empty((points, 3, 3))
    scalars, dilated = np.empty((points, 4)), np.empty((groups, 2))
    mode_gradient, mode_vectors, mode_dots = np.empty((3, m)), np.empty((3 + groups, 3, m)), np.empty((m, m))
    mode_h, mode_factor, mode_step = np.empty((3 * m, 3 * m)), np.empty((3 * m, 3 * m)), np.empty((3, m))
    own = np.empty((3, k))
    size = last if task == 2 else 0
    vectors, dots, h = np.empty((3 + groups, 3, size)), np.empty((size, size)), np.empty((3 * size, 3 * size))
    size = 3 * k if task == 2 else 0
    rows, out, factor = np.empty((3 * m, size)), np.empty((size, size)), np.empty((size, size))
    total = 0.0
    for e in range(nodes.shape[0]):
        _place(e, nodes, shapes, positions, x, base)
        energy = _relax(e, shapes, weights, group, k, mu, kappa, x, base, f, c, scalars, dilated, mode_gradient,
                        mode_vectors, mode_dots, mode_h, mode_factor, mode_step)
        if energy == math.inf:
            if task < 2:
                return energy
            continue
        if task < 2:
            if task == 1:
                _element_gradient(e, shapes, weights, f, c, scalars, 0, k, own)
            energy += _hourglass(e, hourglass, mu, x, own)
            if task == 1:
                for a in range(k):
                    for i in range(3):
                        gradient[nodes[e, a], i] += own[i, a]
            total += energy
            continue
        _element_hessian(e, shapes, weights, group, f, c, scalars, dilated, kappa, 0, last, vectors, dots, h)
        _condense(h, k, m, mode_factor, rows, out)
        if hourglass.shape[0] > 0:
            for i in range(3):
                for a in range(k):
                    for b in range(k):
                        out[i * k + a, i * k + b] += mu * hourglass[e, a, b]
        if projected:
            _project(out, factor)
        for a in range(k):
            for b in range(k):
                block = slots[e, a, b]
                for i in range(3):
                    for j in range(3):
                        blocks[block, i, j] += out[i * k + a, j * k + b]
    return total


@njit(cache=True)
def energy(nodes, shapes, weights, group, hourglass, mu, kappa, positions):
    """Return the energy [J] of a block; inf if a point of an element is inverted."""
    return _walk(nodes, shapes, weights, group, hourglass, mu, kappa, positions, np.empty((0, 3)),
                 np.empty((0, 0, 0), np.int32), np.empty((0, 3, 3)), 0, False)


@njit(cache=True)
def add_gradient(nodes, shapes, weights, group, hourglass, mu, kappa, positions, gradient):
    """Add the gradient [N] to gradient (n_vertices, 3) and return the energy [J] of a block."""
    return _walk(nodes, shapes, weights, group, hourglass, mu, kappa, positions, gradient,
                 np.empty((0, 0, 0), np.int32), np.empty((0, 3, 3)), 1, False)


@njit(cache=True)
def add_hessian(nodes, shapes, weights, group, hourglass, mu, kappa, positions, slots, blocks, projected):
    """Add the Hessian [N/m] of a block to blocks (n_blocks, 3, 3); slots (n, k, k). Inverted elements add nothing."""
    _walk(nodes, shapes, weights, group, hourglass, mu, kappa, positions, np.empty((0, 3)), slots, blocks, 2, projected)
