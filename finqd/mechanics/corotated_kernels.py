"""Kernels of the corotated potential: energy, exact gradient and exact Hessian, one rotation an element.

E = 1/2 u^T K u with u_a = R^T (x_a - c) - (X_a - C), R the rotation closest to F = sum_a x_a (x) g_a, K the stiffness
at rest [N/m] and g_a the mean gradients of the shape functions [1/m]. In the element's frame (b_a = R^T dx_a):

    y_a = R^T (x_a - c)    f = K u    S = R^T F    G = tr(S) 1 - S    t = sum_a y_a x f_a    h = G^-1 t
    d omega = G^-1 sum_a g_a x b_a = Omega b      dR = R [d omega]_x      du = b + Y Omega b,  Y_a = [y_a]_x
    gradient_a = q_a = f_a - h x g_a              Q_a = -[q_a]_x
    Hessian = K + (K Y + Q) Omega + Omega^T (K Y + Q)^T + Omega^T (W + Y^T K Y) Omega
    W = sym([h]_x G) + sym(T) - tr(T) 1,  T = sum_a y_a f_a^T

Source: rotation derivative as in Barbic, Exact corotational linear FEM stiffness matrix (USC technical report, 2012),
here for any K and any number of nodes; the rank-six form and W are our own algebra, tested against differences.

Arrays of a block: nodes (n, k) scene vertex ids; rest (n, k, 3) centred rest positions X_a - C [m]; gradients
(n, k, 3) [1/m]; kinds (n,): elements of one shape share a stiffness (n_kinds, 3k, 3k) [N/m], as reading it is what
energies and gradients wait for; positions (n_vertices, 3) [m].
"""

from __future__ import annotations

import math

import numpy as np

from finqd.mechanics.compiled import njit
from finqd.mechanics.polar_kernels import closest_rotation, symmetric_eigen

SINGULAR = 1e-6  # smallest s_i + s_j [-] of an element's stretch at which its rotation still has a derivative
COUPLING = 0.5  # largest W2 - W3 over W2 that a projected Hessian keeps [-] (`_clamp_spin`)


@njit(cache=True)
def strained(e, nodes, rest, gradients, positions, r, s, y, u):
    """Write R (3, 3), S (3, 3), y (3k,) and u (3k,) [m] of element e."""
    k = nodes.shape[1]
    cx, cy, cz = 0.0, 0.0, 0.0
    for a in range(k):
        v = nodes[e, a]
        cx += positions[v, 0]
        cy += positions[v, 1]
        cz += positions[v, 2]
    cx, cy, cz = cx / k, cy / k, cz / k
    f00, f01, f02, f10, f11, f12, f20, f21, f22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(k):
        v = nodes[e, a]
        px, py, pz = positions[v, 0] - cx, positions[v, 1] - cy, positions[v, 2] - cz
        gx, gy, gz = gradients[e, a, 0], gradients[e, a, 1], gradients[e, a, 2]
        f00 += px * gx
        f01 += px * gy
        f02 += px * gz
        f10 += py * gx
        f11 += py * gy
        f12 += py * gz
        f20 += pz * gx
        f21 += pz * gy
        f22 += pz * gz
    s[0, 0], s[0, 1], s[0, 2] = f00, f01, f02
    s[1, 0], s[1, 1], s[1, 2] = f10, f11, f12
    s[2, 0], s[2, 1], s[2, 2] = f20, f21, f22
    closest_rotation(s, r)
    r00, r01, r02, r10, r11, r12 = r[0, 0], r[0, 1], r[0, 2], r[1, 0], r[1, 1], r[1, 2]
    r20, r21, r22 = r[2, 0], r[2, 1], r[2, 2]
    for j in range(3):
        fx, fy, fz = s[0, j], s[1, j], s[2, j]
        s[0, j] = r00 * fx + r10 * fy + r20 * fz
        s[1, j] = r01 * fx + r11 * fy + r21 * fz
        s[2, j] = r02 * fx + r12 * fy + r22 * fz
    for a in range(k):
        v = nodes[e, a]
        px, py, pz = positions[v, 0] - cx, positions[v, 1] - cy, positions[v, 2] - cz
        y[3 * a] = r00 * px + r10 * py + r20 * pz
        y[3 * a + 1] = r01 * px + r11 * py + r21 * pz
        y[3 * a + 2] = r02 * px + r12 * py + r22 * pz
        u[3 * a] = y[3 * a] - rest[e, a, 0]
        u[3 * a + 1] = y[3 * a + 1] - rest[e, a, 1]
        u[3 * a + 2] = y[3 * a + 2] - rest[e, a, 2]


@njit(cache=True)
def _times(stiffness, u, f):
    """Write f = K u [N], as sums of rows (K, ``stiffness``, is symmetric), which vectorise."""
    m = u.shape[0]
    for i in range(m):
        f[i] = 0.0
    for j in range(m):
        uj = u[j]
        for i in range(m):
            f[i] += stiffness[j, i] * uj


@njit(cache=True)
def _half_dot(u, f):
    """Return u . f / 2 [J]."""
    total = 0.0
    for i in range(u.shape[0]):
        total += u[i] * f[i]
    return 0.5 * total


@njit(cache=True)
def _inverse_spin(s, g, gi):
    """Write G = tr(S) 1 - S and its inverse; return whether G was regular.

    Its eigenvalues are s_i + s_j >= 0. Where one falls below `SINGULAR` (an element folded so far that the closest
    rotation jumps) G is shifted by it, which keeps everything finite; gradient and Hessian are approximate there.
    """
    trace = s[0, 0] + s[1, 1] + s[2, 2]
    for i in range(3):
        for j in range(3):
            g[i, j] = -0.5 * (s[i, j] + s[j, i])
        g[i, i] += trace
    det = _invert(g, gi)
    half = max(trace, SINGULAR)  # half the sum of the eigenvalues: bounds the product of the two larger ones
    if det > SINGULAR * half * half:
        return True
    for i in range(3):
        g[i, i] += 2.0 * SINGULAR
    _invert(g, gi)
    return False


@njit(cache=True)
def _invert(g, gi):
    """Write the inverse of the symmetric (3, 3) matrix g to gi and return its determinant."""
    a, b, c, d, e, f = g[0, 0], g[0, 1], g[0, 2], g[1, 1], g[1, 2], g[2, 2]
    ca, cb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * ca + b * cb + c * cc
    w = 1.0 / det if det != 0.0 else 0.0
    gi[0, 0] = ca * w
    gi[0, 1] = gi[1, 0] = cb * w
    gi[0, 2] = gi[2, 0] = cc * w
    gi[1, 1] = (a * f - c * c) * w
    gi[1, 2] = gi[2, 1] = (b * c - a * e) * w
    gi[2, 2] = (a * d - b * b) * w
    return det


@njit(cache=True)
def _force(e, gradients, y, f, gi, h, q):
    """Write h = G^-1 t [N] and q_a = f_a - h x g_a [N], the gradient in the element's frame, shape (3k,)."""
    k = gradients.shape[1]
    tx, ty, tz = 0.0, 0.0, 0.0
    for a in range(0, 3 * k, 3):
        tx += y[a + 1] * f[a + 2] - y[a + 2] * f[a + 1]
        ty += y[a + 2] * f[a] - y[a] * f[a + 2]
        tz += y[a] * f[a + 1] - y[a + 1] * f[a]
    hx = gi[0, 0] * tx + gi[0, 1] * ty + gi[0, 2] * tz
    hy = gi[1, 0] * tx + gi[1, 1] * ty + gi[1, 2] * tz
    hz = gi[2, 0] * tx + gi[2, 1] * ty + gi[2, 2] * tz
    h[0], h[1], h[2] = hx, hy, hz
    for a in range(k):
        gx, gy, gz = gradients[e, a, 0], gradients[e, a, 1], gradients[e, a, 2]
        q[3 * a] = f[3 * a] - (hy * gz - hz * gy)
        q[3 * a + 1] = f[3 * a + 1] - (hz * gx - hx * gz)
        q[3 * a + 2] = f[3 * a + 2] - (hx * gy - hy * gx)


@njit(cache=True)
def energy(nodes, rest, gradients, kinds, stiffness, positions):
    """Return the energy [J] of a block: sum over elements of 1/2 u^T K u."""
    m = 3 * nodes.shape[1]
    r, s, y, u, f = np.empty((3, 3)), np.empty((3, 3)), np.empty(m), np.empty(m), np.empty(m)
    total = 0.0
    for e in range(nodes.shape[0]):
        strained(e, nodes, rest, gradients, positions, r, s, y, u)
        _times(stiffness[kinds[e]], u, f)
        total += _half_dot(u, f)
    return total


@njit(cache=True)
def add_gradient(nodes, rest, gradients, kinds, stiffness, positions, gradient):
    """Add R q_a [N] to gradient (n_vertices, 3) and return the energy [J] of a block."""
    k = nodes.shape[1]
    r, s, g, gi = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    y, u, f, q, h = np.empty(3 * k), np.empty(3 * k), np.empty(3 * k), np.empty(3 * k), np.empty(3)
    total = 0.0
    for e in range(nodes.shape[0]):
        strained(e, nodes, rest, gradients, positions, r, s, y, u)
        _times(stiffness[kinds[e]], u, f)
        total += _half_dot(u, f)
        _inverse_spin(s, g, gi)
        _force(e, gradients, y, f, gi, h, q)
        for a in range(k):
            v = nodes[e, a]
            for i in range(3):
                gradient[v, i] += r[i, 0] * q[3 * a] + r[i, 1] * q[3 * a + 1] + r[i, 2] * q[3 * a + 2]
    return total


@njit(cache=True)
def _spin_columns(e, gradients, gi, omega):
    """Write Omega (3, 3k): columns of node a are G^-1 [g_a]_x [1/m]."""
    for a in range(gradients.shape[1]):
        gx, gy, gz = gradients[e, a, 0], gradients[e, a, 1], gradients[e, a, 2]
        for i in range(3):
            omega[i, 3 * a] = gi[i, 1] * gz - gi[i, 2] * gy
            omega[i, 3 * a + 1] = gi[i, 2] * gx - gi[i, 0] * gz
            omega[i, 3 * a + 2] = gi[i, 0] * gy - gi[i, 1] * gx


@njit(cache=True)
def _spin_stiffness(y, f, h, g, w):
    """Write W = sym([h]_x G) + sym(T) - tr(T) 1 [J], T = sum_a y_a f_a^T."""
    for i in range(3):
        for j in range(3):
            w[i, j] = 0.0
    for a in range(0, y.shape[0], 3):
        for i in range(3):
            for j in range(3):
                w[i, j] += y[a + i] * f[a + j]
    trace = w[0, 0] + w[1, 1] + w[2, 2]
    for j in range(3):
        w[0, j] += h[1] * g[2, j] - h[2] * g[1, j]
        w[1, j] += h[2] * g[0, j] - h[0] * g[2, j]
        w[2, j] += h[0] * g[1, j] - h[1] * g[0, j]
    for i in range(3):
        for j in range(i):
            w[i, j] = w[j, i] = 0.5 * (w[i, j] + w[j, i])
        w[i, i] -= trace


@njit(cache=True)
def _cross_columns(y, sign, c):
    """Write to the rows of c (3, 3k) the columns of the stacked [y_a]_x, times sign."""
    for a in range(0, y.shape[0], 3):
        c[0, a], c[0, a + 1], c[0, a + 2] = 0.0, sign * y[a + 2], -sign * y[a + 1]
        c[1, a], c[1, a + 1], c[1, a + 2] = -sign * y[a + 2], 0.0, sign * y[a]
        c[2, a], c[2, a + 1], c[2, a + 2] = sign * y[a + 1], -sign * y[a], 0.0


@njit(cache=True)
def _times_three(stiffness, c, kc):
    """Write kc = c K for three rows c (3, 3k) (K, ``stiffness``, is symmetric)."""
    m = c.shape[1]
    for i in range(m):
        kc[0, i] = 0.0
        kc[1, i] = 0.0
        kc[2, i] = 0.0
    for j in range(m):
        c0, c1, c2 = c[0, j], c[1, j], c[2, j]
        for i in range(m):
            v = stiffness[j, i]
            kc[0, i] += c0 * v
            kc[1, i] += c1 * v
            kc[2, i] += c2 * v


@njit(cache=True)
def _products(a, b, out):
    """Write out_ij = a_i . b_j for the rows of a and b, shape (3, 3k) each."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for n in range(a.shape[1]):
                total += a[i, n] * b[j, n]
            out[i, j] = total


@njit(cache=True)
def _without_moment(e, rest, gradients, q_columns, out):
    """Write Q~ = Q - Omega^T lambda, the columns of Q without their moment about the rest shape, shape (3, 3k)."""
    k = gradients.shape[1]
    for i in range(3):
        zx, zy, zz = 0.0, 0.0, 0.0
        for a in range(k):
            x0, x1, x2 = rest[e, a, 0], rest[e, a, 1], rest[e, a, 2]
            q0, q1, q2 = q_columns[i, 3 * a], q_columns[i, 3 * a + 1], q_columns[i, 3 * a + 2]
            zx += 0.5 * (x1 * q2 - x2 * q1)
            zy += 0.5 * (x2 * q0 - x0 * q2)
            zz += 0.5 * (x0 * q1 - x1 * q0)
        for a in range(k):
            gx, gy, gz = gradients[e, a, 0], gradients[e, a, 1], gradients[e, a, 2]
            out[i, 3 * a] = q_columns[i, 3 * a] + gy * zz - gz * zy
            out[i, 3 * a + 1] = q_columns[i, 3 * a + 1] + gz * zx - gx * zz
            out[i, 3 * a + 2] = q_columns[i, 3 * a + 2] + gx * zy - gy * zx


@njit(cache=True)
def _clamp_spin(e, rest, gradients, compliance, y, q_columns, w, rigid, kq, small):
    """Change W (3, 3) [J] (and Q, rarely) so that the element's Hessian becomes positive semidefinite.

    With b = du - Y omega the Hessian's form is du^T K du + 2 du^T Q omega + omega^T W2 omega,
    W2 = W - Y^T Q - Q^T Y, for du without spin (Omega du = 0). K is positive there, so the form is semidefinite exactly
    if the Schur complement W3 = W2 - Q~^T K^+ Q~ is (Q~ = Q - Omega^T lambda: Q without its moment about the rest).
    Negative eigenvalues of W3 become zero. Where W3 is far below W2 (Q bends an element's soft modes) that would
    stiffen it too much, and Q is scaled down first: the Hessian then stays within the order of the stress.

    compliance: K^+ [m/N], (3k, 3k); q_columns: rows are the columns of Q, (3, 3k)
    rigid, kq: scratch (3, 3k); small: scratch (2, 3, 3)
    """
    _without_moment(e, rest, gradients, q_columns, rigid)
    _times_three(compliance, rigid, kq)
    w3, v = small[0], small[1]
    _products(rigid, kq, w3)
    _cross_columns(y, 1.0, kq)
    _products(kq, q_columns, v)
    for i in range(3):
        for j in range(i + 1):
            v[i, j] = v[j, i] = v[i, j] + v[j, i]
    size = 0.0
    for i in range(3):
        for j in range(3):
            w[i, j] -= v[i, j]
            size += w[i, j] * w[i, j]
    limit = max(w[0, 0] + w[1, 1] + w[2, 2], COUPLING * math.sqrt(size))
    trace = w3[0, 0] + w3[1, 1] + w3[2, 2]
    share = 1.0  # of the coupling Q that is kept
    if trace > limit:  # never so where the element is semidefinite already
        share = math.sqrt(limit / trace)
        for i in range(3):
            for n in range(q_columns.shape[1]):
                q_columns[i, n] *= share
    for i in range(3):
        for j in range(i + 1):
            coupled = share * share * 0.5 * (w3[i, j] + w3[j, i])
            w3[i, j] = w3[j, i] = w[i, j] - coupled
    for i in range(3):
        for j in range(3):
            w[i, j] += share * v[i, j]
    minor = w3[0, 0] * w3[1, 1] - w3[0, 1] * w3[1, 0]
    if w3[0, 0] > 0.0 and minor > 0.0 and _invert(w3, v) > 0.0:
        return
    symmetric_eigen(w3, v)
    for n in range(3):
        if w3[n, n] < 0.0:
            for i in range(3):
                for j in range(3):
                    w[i, j] -= w3[n, n] * v[i, n] * v[j, n]


@njit(cache=True)
def _spin_rows(y, kc, q_columns, omega, columns, w, ywy, b):
    """Write b (3, 3k) = (K Y + Q)^T + 1/2 (W + Y^T K Y) Omega, so that Hessian = K + b^T Omega + Omega^T b."""
    _cross_columns(y, 1.0, columns)
    _products(columns, kc, ywy)
    for i in range(3):
        for j in range(3):
            ywy[i, j] = 0.5 * (ywy[i, j] + w[i, j])
    for i in range(3):
        for n in range(b.shape[1]):
            b[i, n] = (kc[i, n] + q_columns[i, n] + ywy[0, i] * omega[0, n] + ywy[1, i] * omega[1, n]
                       + ywy[2, i] * omega[2, n])


@njit(cache=True)
def _scatter(stiffness, omega, b, r, rows, turned, slots, blocks):
    """Add R (K + b^T Omega + Omega^T b) R^T [N/m] of an element to blocks (n_blocks + 1, 3, 3), row of nodes by row."""
    m = omega.shape[1]
    k = m // 3
    r00, r01, r02, r10, r11, r12 = r[0, 0], r[0, 1], r[0, 2], r[1, 0], r[1, 1], r[1, 2]
    r20, r21, r22 = r[2, 0], r[2, 1], r[2, 2]
    for i in range(k):
        for p in range(3):
            n = 3 * i + p
            b0, b1, b2, o0, o1, o2 = b[0, n], b[1, n], b[2, n], omega[0, n], omega[1, n], omega[2, n]
            for j in range(3 * i, m):
                rows[p, j] = (stiffness[n, j] + b0 * omega[0, j] + b1 * omega[1, j] + b2 * omega[2, j]
                              + o0 * b[0, j] + o1 * b[1, j] + o2 * b[2, j])
        for j in range(3 * i, m):
            x, y, z = rows[0, j], rows[1, j], rows[2, j]
            turned[0, j] = r00 * x + r01 * y + r02 * z
            turned[1, j] = r10 * x + r11 * y + r12 * z
            turned[2, j] = r20 * x + r21 * y + r22 * z
        for j in range(i, k):
            there, back = slots[i, j], slots[j, i]
            for p in range(3):
                x, y, z = turned[p, 3 * j], turned[p, 3 * j + 1], turned[p, 3 * j + 2]
                x, y, z = r00 * x + r01 * y + r02 * z, r10 * x + r11 * y + r12 * z, r20 * x + r21 * y + r22 * z
                blocks[there, p, 0] += x
                blocks[there, p, 1] += y
                blocks[there, p, 2] += z
                if j > i:
                    blocks[back, 0, p] += x
                    blocks[back, 1, p] += y
                    blocks[back, 2, p] += z


@njit(cache=True)
def add_hessian(nodes, rest, gradients, kinds, stiffness, compliance, positions, slots, blocks, projected):
    """Add the Hessian [N/m] of a block of elements to blocks (n_blocks + 1, 3, 3); slots (n, k, k).

    projected: add each element's smallest spin stiffness that makes its matrix positive semidefinite (`_clamp_spin`);
    compliance, K^+ [m/N] of each kind, is read only then. A folded element (`_inverse_spin`) then counts with R K R^T
    alone.
    """
    k = nodes.shape[1]
    m = 3 * k
    r, s, g, gi = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    w, ywy, small = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 3, 3))
    y, u, f, q, h = np.empty(m), np.empty(m), np.empty(m), np.empty(m), np.empty(3)
    omega, columns, kc = np.empty((3, m)), np.empty((3, m)), np.empty((3, m))
    q_columns, b, rows, turned = np.empty((3, m)), np.empty((3, m)), np.empty((3, m)), np.empty((3, m))
    for e in range(nodes.shape[0]):
        strained(e, nodes, rest, gradients, positions, r, s, y, u)
        _times(stiffness[kinds[e]], u, f)
        regular = _inverse_spin(s, g, gi)
        _force(e, gradients, y, f, gi, h, q)
        _spin_columns(e, gradients, gi, omega)
        _spin_stiffness(y, f, h, g, w)
        _cross_columns(q, -1.0, q_columns)
        if projected:
            _clamp_spin(e, rest, gradients, compliance[kinds[e]], y, q_columns, w, columns, kc, small)
        _cross_columns(y, 1.0, columns)
        _times_three(stiffness[kinds[e]], columns, kc)
        _spin_rows(y, kc, q_columns, omega, columns, w, ywy, b)
        if projected and not regular:
            omega[:] = 0.0
        _scatter(stiffness[kinds[e]], omega, b, r, rows, turned, slots[e], blocks)
