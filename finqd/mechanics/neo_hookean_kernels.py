r"""Kernels of the neo-Hookean potential: one loop over quadrature points for every element type.

    F(q) = sum_a x_a (x) g_a(q) + sum_m alpha_m (x) G_m(q)        J = det F,  C = cof F = J F^-T
    W = mu/2 (J^(-2/3) tr F^T F - 3)  at each point,   V_g kappa/4 (Jm^2 - 1 - 2 ln Jm)  for each group of points,
    Jm = sum_{q in g} w_q J(q) / V_g: the point's own J, or the mean dilatation of several points

and mu/2 sum_ab S_ab x_a . x_b (hex20's hourglass modes). With f_a = F g_a, c_a = C g_a, I = tr F^T F, s = mu J^(-2/3):

    gradient_a = sum_q w (s f_a + p c_a)         p = kappa/2 (Jm - 1/Jm) - s I / (3 J)
    Hessian_ab = sum_q w (s (g_a . g_b) 1 - 2 s/(3 J) (f_a c_b^T + c_a f_b^T) + (5 s I/(9 J^2) + p/J) c_a c_b^T
                 - p/J c_b c_a^T) + sum_g kappa/2 (1 + 1/Jm^2) / V_g d_a d_b^T,    d_a = sum_{q in g} w c_a

(g_a x g_b goes to F (g_a x g_b) = c_a x c_b / J.) The enhanced modes alpha are inner unknowns: the energy of an element
is its minimum over them, found by Newton's method with a line search from what small strain theory gives, a pure
function of the positions; at the minimum the gradient needs no derivative of alpha, and the Hessian is condensed.
Sources: Simo, Taylor and Pister, Comput. Methods Appl. Mech. Eng. 51 (1985) 177 (decoupled W, mean dilatation);
Hartmann and Neff, Int. J. Solids Struct. 40 (2003) 2767 (both terms are polyconvex; the second grows without bound
as J -> 0); Simo and Armero, Int. J. Numer. Methods Eng. 33 (1992) 1413 (enhanced modes at large strain).

Arrays of a block: nodes (n, k) scene vertex ids; shapes (n, k + m, 3 Q): rows g_a, then G_m [1/m], column Q j + q for
axis j and point q; weights (n, Q) [m^3]; group (Q,): group of each point, 0, 1, ...; start (n, 3 m, 3 k + 1): see
`_guess`; hourglass S (n or 0, k, k) [m]; positions
(n_vertices, 3) [m]. F and C of an element: (3, 3 Q), columns as in shapes.
"""

from __future__ import annotations

import math

import numpy as np

from finqd.mechanics.compiled import njit
from finqd.mechanics.condensation_kernels import condense, make_semidefinite, newton_step
from finqd.mechanics.polar_kernels import closest_rotation

INNER_ITERATIONS = 50  # of Newton's method for the modes
CONVERGED = 1e-12  # squared Newton decrement [mu V] after which one more step is exact to rounding
SURE = 1e-11  # squared Newton decrement [mu V] below which rounding makes a comparison of energies useless

JACOBIAN, TRACE, SHEAR, PRESSURE, MIXED, OWN, TURN = 0, 1, 2, 3, 4, 5, 6  # rows of an element's ``scalars`` (7, Q)


@njit(cache=True)
def _strain_energy(weights, group, f, c, scalars, dilated, mu, kappa):
    """Write C, J, I, s and p of all points and (Jm, V) of all groups; return the energy [J], inf if a J <= 0.

    tr F^T F - 3 and J^2 - 1 come from the strain E = (F^T F - 1)/2, so that a small strain's energy is not lost in the
    rounding of 3 and 1. weights: (Q,)
    """
    count = weights.shape[0]
    dilated[:] = 0.0
    total = 0.0
    for q in range(count):
        y, z = q + count, q + 2 * count
        f00, f01, f02, f10, f11, f12 = f[0, q], f[0, y], f[0, z], f[1, q], f[1, y], f[1, z]
        f20, f21, f22 = f[2, q], f[2, y], f[2, z]
        c00, c01, c02 = f11 * f22 - f12 * f21, f12 * f20 - f10 * f22, f10 * f21 - f11 * f20
        jacobian = f00 * c00 + f01 * c01 + f02 * c02
        if not jacobian > 0.0:
            return math.inf
        c[0, q], c[0, y], c[0, z] = c00, c01, c02
        c[1, q], c[1, y], c[1, z] = f02 * f21 - f01 * f22, f00 * f22 - f02 * f20, f01 * f20 - f00 * f21
        c[2, q], c[2, y], c[2, z] = f01 * f12 - f02 * f11, f02 * f10 - f00 * f12, f00 * f11 - f01 * f10
        a = f00 * f00 + f10 * f10 + f20 * f20 - 1.0
        b = f01 * f01 + f11 * f11 + f21 * f21 - 1.0
        d = f02 * f02 + f12 * f12 + f22 * f22 - 1.0
        g = f01 * f02 + f11 * f12 + f21 * f22
        h = f00 * f02 + f10 * f12 + f20 * f22
        o = f00 * f01 + f10 * f11 + f20 * f21
        trace = a + b + d
        square = trace + (a * b + b * d + a * d - g * g - h * h - o * o) + (
            a * b * d + 2.0 * g * h * o - a * g * g - b * h * h - d * o * o)
        root = 1.0 / np.cbrt(jacobian * jacobian)
        less = -square / (jacobian * jacobian * (root * root + root + 1.0))  # root - 1: both of root^3 = 1/J^2
        w = weights[q]
        total += 0.5 * mu * w * (3.0 * less + trace * root)
        dilated[group[q], 0] += w * square / (1.0 + jacobian)
        dilated[group[q], 1] += w
        scalars[JACOBIAN, q], scalars[TRACE, q], scalars[SHEAR, q] = jacobian, trace + 3.0, mu * root
    for n in range(dilated.shape[0]):
        change = dilated[n, 0] / dilated[n, 1]
        total += dilated[n, 1] * 0.25 * kappa * (change * (2.0 + change) - 2.0 * math.log1p(change))
        dilated[n, 0] = 1.0 + change
    for q in range(count):
        jm = dilated[group[q], 0]
        scalars[PRESSURE, q] = 0.5 * kappa * (jm - 1.0 / jm) - (
            scalars[SHEAR, q] * scalars[TRACE, q] / (3.0 * scalars[JACOBIAN, q]))
    return total


@njit(cache=True)
def _gradient(weights, shapes, f, c, scalars, stress, out):
    """Write the gradient [N] for some rows of shapes to out (3, rows); stress (3, 3 Q): scratch."""
    count = weights.shape[0]
    for i in range(3):
        for j in range(3):
            for q in range(count):
                stress[i, j * count + q] = weights[q] * (
                    scalars[SHEAR, q] * f[i, j * count + q] + scalars[PRESSURE, q] * c[i, j * count + q])
    np.dot(stress, shapes.T, out)


@njit(cache=True)
def _factors(weights, group, scalars, dilated, kappa):
    """Write what the Hessian multiplies: rows MIXED, OWN and TURN of scalars."""
    for q in range(weights.shape[0]):
        w, jacobian, s = weights[q], scalars[JACOBIAN, q], scalars[SHEAR, q]
        scalars[MIXED, q] = -2.0 * w * s / (3.0 * jacobian)
        scalars[OWN, q] = 5.0 * w * s * scalars[TRACE, q] / (18.0 * jacobian * jacobian)
        scalars[TURN, q] = w * scalars[PRESSURE, q] / jacobian
        if dilated.shape[0] == weights.shape[0]:  # each point its own group
            jm = dilated[group[q], 0]
            scalars[OWN, q] += 0.25 * kappa * (1.0 + 1.0 / (jm * jm)) * w


@njit(cache=True)
def _hessian(weights, group, shapes, f, c, scalars, dilated, kappa, vectors, scaled, sums, dots, h):
    """Write the Hessian [N/m] for n rows of shapes to h (3 n, 3 n), row i n + a for axis i and row a; `_factors` first.

    scratch: vectors (3, 3 n, Q): c_a, half of what multiplies c_a, p/J c_a; scaled (n, 3 Q); sums (3 n, 3 n);
    dots (n, n)
    """
    n, count = shapes.shape[0], weights.shape[0]
    cv, hv, tv = vectors[0], vectors[1], vectors[2]
    for i in range(3):
        for a in range(n):
            r = i * n + a
            for q in range(count):
                g0, g1, g2 = shapes[a, q], shapes[a, count + q], shapes[a, 2 * count + q]
                here = c[i, q] * g0 + c[i, count + q] * g1 + c[i, 2 * count + q] * g2
                cv[r, q] = here
                hv[r, q] = scalars[OWN, q] * here + scalars[MIXED, q] * (
                    f[i, q] * g0 + f[i, count + q] * g1 + f[i, 2 * count + q] * g2)
                tv[r, q] = scalars[TURN, q] * here
    for a in range(n):
        for j in range(3):
            for q in range(count):
                scaled[a, j * count + q] = weights[q] * scalars[SHEAR, q] * shapes[a, j * count + q]
    np.dot(scaled, shapes.T, dots)
    np.dot(tv, cv.T, sums)
    np.dot(hv, cv.T, h)
    for i in range(3):
        for a in range(n):
            r = i * n + a
            for b in range(a, n):
                t = i * n + b
                h[r, t] = h[t, r] = h[r, t] + h[t, r] + dots[a, b]
            for j in range(i + 1, 3):
                for b in range(n):
                    t = j * n + b
                    h[r, t] = h[t, r] = h[r, t] + h[t, r] + sums[r, t] - sums[i * n + b, j * n + a]
    if dilated.shape[0] < count:
        for g in range(dilated.shape[0]):
            stiff = 0.5 * kappa * (1.0 + 1.0 / (dilated[g, 0] * dilated[g, 0])) / dilated[g, 1]
            mean = sums[0]
            mean[:] = 0.0
            for q in range(count):
                if group[q] == g:
                    for r in range(3 * n):
                        mean[r] += weights[q] * cv[r, q]
            for r in range(3 * n):
                for t in range(3 * n):
                    h[r, t] += stiff * mean[r] * mean[t]


@njit(cache=True)
def _mode_derivatives(weights, group, modes, f, c, scalars, dilated, kappa, gradient, h, vectors, mean):
    """Write gradient [N] (3 m,) and the lower triangle of the Hessian [N/m] (3 m, 3 m) for the modes, 3 mode + axis.

    `_gradient` and `_hessian` in one, for few rows. scratch: vectors (2, 3 m), mean (groups, 3 m)
    """
    count, m = weights.shape[0], modes.shape[0]
    own_groups = dilated.shape[0] == count
    gradient[:] = 0.0
    h[:] = 0.0
    mean[:] = 0.0
    _factors(weights, group, scalars, dilated, kappa)
    for q in range(count):
        s, p = weights[q] * scalars[SHEAR, q], weights[q] * scalars[PRESSURE, q]
        mixed, own, turn = scalars[MIXED, q], scalars[OWN, q], scalars[TURN, q]
        for a in range(m):
            g0, g1, g2 = modes[a, q], modes[a, count + q], modes[a, 2 * count + q]
            for i in range(3):
                fa = f[i, q] * g0 + f[i, count + q] * g1 + f[i, 2 * count + q] * g2
                ca = c[i, q] * g0 + c[i, count + q] * g1 + c[i, 2 * count + q] * g2
                gradient[3 * a + i] += s * fa + p * ca
                vectors[0, 3 * a + i] = ca
                vectors[1, 3 * a + i] = mixed * fa + own * ca
            for b in range(a + 1):
                dot = s * (g0 * modes[b, q] + g1 * modes[b, count + q] + g2 * modes[b, 2 * count + q])
                for i in range(3):
                    h[3 * a + i, 3 * b + i] += dot
        for r in range(3 * m):
            u, v = vectors[1, r], vectors[0, r]
            for t in range(r + 1):
                h[r, t] += u * vectors[0, t] + v * vectors[1, t]
        if not own_groups:
            for r in range(3 * m):
                mean[group[q], r] += weights[q] * vectors[0, r]
        for a in range(3, 3 * m, 3):
            for b in range(0, a, 3):
                x = turn * (vectors[0, a + 1] * vectors[0, b + 2] - vectors[0, a + 2] * vectors[0, b + 1])
                y = turn * (vectors[0, a + 2] * vectors[0, b] - vectors[0, a] * vectors[0, b + 2])
                z = turn * (vectors[0, a] * vectors[0, b + 1] - vectors[0, a + 1] * vectors[0, b])
                h[a, b + 1] += z
                h[a + 1, b] -= z
                h[a + 1, b + 2] += x
                h[a + 2, b + 1] -= x
                h[a + 2, b] += y
                h[a, b + 2] -= y
    if not own_groups:
        for g in range(dilated.shape[0]):
            stiff = 0.5 * kappa * (1.0 + 1.0 / (dilated[g, 0] * dilated[g, 0])) / dilated[g, 1]
            for r in range(3 * m):
                for t in range(r + 1):
                    h[r, t] += stiff * mean[g, r] * mean[g, t]


@njit(cache=True)
def _guess(x, base, start, alpha):
    """Write to alpha (3, m) the modes that the nodes' displacement in the element's own frame excites at small strain.

    The frame is that of the rotation closest to the mean of F over the points (base, without modes); x: (3, k) [m]
    start: (3 m, 3 k + 1), in its last column the modes that the rest positions would give
    """
    count, k, m = base.shape[1] // 3, x.shape[1], alpha.shape[1]
    mean, r = np.zeros((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            for q in range(count):
                mean[i, j] += base[i, j * count + q] / count
    closest_rotation(mean, r)
    local = np.zeros((3, m))
    for i in range(3):
        for a in range(m):
            local[i, a] = -start[i * m + a, 3 * k]
    for j in range(3):
        for b in range(k):
            y = r[0, j] * x[0, b] + r[1, j] * x[1, b] + r[2, j] * x[2, b]
            for i in range(3):
                for a in range(m):
                    local[i, a] += start[i * m + a, j * k + b] * y
    for i in range(3):
        for a in range(m):
            alpha[i, a] = r[i, 0] * local[0, a] + r[i, 1] * local[1, a] + r[i, 2] * local[2, a]


@njit(cache=True)
def _bend(base, alpha, modes, f):
    """Write F = base + sum alpha_m (x) G_m of all points."""
    for i in range(3):
        for n in range(base.shape[1]):
            f[i, n] = base[i, n]
        for a in range(alpha.shape[1]):
            for n in range(base.shape[1]):
                f[i, n] += alpha[i, a] * modes[a, n]


@njit(cache=True)
def _relax(weights, group, modes, start, mu, kappa, x, base, f, c, scalars, dilated, alpha, known, work):
    """Find the modes alpha (3, m) that minimise the energy; return it [J], with F, C, ... there.

    known: alpha is what this function found for the same positions. inf if a point is inverted at the start, or if
    Newton's method does not end.
    """
    if known or modes.shape[0] == 0:
        _bend(base, alpha, modes, f)
        return _strain_energy(weights, group, f, c, scalars, dilated, mu, kappa)
    trial, step, gradient, vectors, mean, h, factor = work
    _guess(x, base, start, alpha)
    _bend(base, alpha, modes, f)
    energy = _strain_energy(weights, group, f, c, scalars, dilated, mu, kappa)
    if energy == math.inf:
        alpha[:] = 0.0
        f[:] = base
        energy = _strain_energy(weights, group, f, c, scalars, dilated, mu, kappa)
        if energy == math.inf:
            return energy
    size = mu * weights.sum()
    for _ in range(INNER_ITERATIONS):
        _mode_derivatives(weights, group, modes, f, c, scalars, dilated, kappa, gradient, h, vectors, mean)
        decrement = newton_step(h, factor, gradient, step)
        share, before = 1.0, energy
        while True:
            for i in range(3):
                for a in range(alpha.shape[1]):
                    trial[i, a] = alpha[i, a] + share * step[3 * a + i]
            _bend(base, trial, modes, f)
            energy = _strain_energy(weights, group, f, c, scalars, dilated, mu, kappa)
            if energy <= before - 1e-4 * share * decrement or (decrement <= SURE * size and energy < math.inf):
                break
            share *= 0.5
            if share < 1e-9:
                return math.inf
        alpha[:] = trial
        if decrement <= CONVERGED * size:
            return energy
    return math.inf


@njit(cache=True)
def _work(m, groups):
    """Return the scratch arrays of `_relax` for m modes."""
    return (np.empty((3, m)), np.empty(3 * m), np.empty(3 * m), np.empty((2, 3 * m)), np.empty((groups, 3 * m)),
            np.empty((3 * m, 3 * m)), np.empty((3 * m, 3 * m)))


@njit(cache=True)
def _place(e, nodes, positions, x):
    """Write the element's nodes about its first one to x (3, k)."""
    v0 = nodes[e, 0]
    for a in range(nodes.shape[1]):
        v = nodes[e, a]
        for i in range(3):
            x[i, a] = positions[v, i] - positions[v0, i]


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
def add_gradient(nodes, shapes, weights, group, start, hourglass, mu, kappa, positions, modes, known, gradient):
    """Return the energy [J] of a block and add its gradient [N] to gradient (n_vertices, 3), unless that is empty.

    The energy is inf, and the gradient of no use, if a point of an element is inverted.
    modes: alpha of all elements (n, 3, m) [m]: read if they are known for these positions, else written
    """
    k, points, groups = nodes.shape[1], weights.shape[1], group.max() + 1
    x, own, work = np.empty((3, k)), np.empty((3, k)), _work(shapes.shape[1] - k, groups)
    base, f, c, stress = (np.empty((3, 3 * points)), np.empty((3, 3 * points)), np.empty((3, 3 * points)),
                          np.empty((3, 3 * points)))
    scalars, dilated = np.empty((7, points)), np.empty((groups, 2))
    total = 0.0
    for e in range(nodes.shape[0]):
        _place(e, nodes, positions, x)
        np.dot(x, shapes[e, :k], base)
        total += _relax(weights[e], group, shapes[e, k:], start[e], mu, kappa, x, base, f, c, scalars, dilated,
                        modes[e], known, work)
        if total == math.inf:
            return total
        if gradient.shape[0] > 0:
            _gradient(weights[e], shapes[e, :k], f, c, scalars, stress, own)
        total += _hourglass(e, hourglass, mu, x, own)
        if gradient.shape[0] > 0:
            for a in range(k):
                for i in range(3):
                    gradient[nodes[e, a], i] += own[i, a]
    return total


@njit(cache=True)
def add_hessian(nodes, shapes, weights, group, start, hourglass, mu, kappa, positions, modes, known, slots, blocks,
                projected):
    """Add the Hessian [N/m] of a block to blocks (n_blocks + 1, 3, 3); slots (n, k, k). Inverted elements add nothing.

    modes, known: as in `add_gradient`; projected: negative eigenvalues of each element's condensed matrix become zero
    """
    k, last, points, groups = nodes.shape[1], shapes.shape[1], weights.shape[1], group.max() + 1
    m = last - k
    x, work = np.empty((3, k)), _work(m, groups)
    base, f, c = np.empty((3, 3 * points)), np.empty((3, 3 * points)), np.empty((3, 3 * points))
    scalars, dilated = np.empty((7, points)), np.empty((groups, 2))
    vectors, scaled, dots = np.empty((3, 3 * last, points)), np.empty((last, 3 * points)), np.empty((last, last))
    sums, h, rows = np.empty((3 * last, 3 * last)), np.empty((3 * last, 3 * last)), np.empty((3 * m, 3 * k))
    lower, out, factor = np.empty((3 * m, 3 * m)), np.empty((3 * k, 3 * k)), np.empty((3 * k, 3 * k))
    for e in range(nodes.shape[0]):
        _place(e, nodes, positions, x)
        np.dot(x, shapes[e, :k], base)
        energy = _relax(weights[e], group, shapes[e, k:], start[e], mu, kappa, x, base, f, c, scalars, dilated,
                        modes[e], known, work)
        if energy == math.inf:
            continue
        _factors(weights[e], group, scalars, dilated, kappa)
        _hessian(weights[e], group, shapes[e], f, c, scalars, dilated, kappa, vectors, scaled, sums, dots, h)
        condense(h, k, m, lower, rows, out)
        if hourglass.shape[0] > 0:
            for i in range(3):
                for a in range(k):
                    for b in range(k):
                        out[i * k + a, i * k + b] += mu * hourglass[e, a, b]
        if projected:
            make_semidefinite(out, factor)
        for a in range(k):
            for b in range(k):
                block = slots[e, a, b]
                for i in range(3):
                    for j in range(3):
                        blocks[block, i, j] += out[i * k + a, j * k + b]
