"""Kernels: closest proper rotation of a 3 x 3 matrix, and eigenvalues of small symmetric matrices."""

from __future__ import annotations

import math

import numpy as np

from finqd.mechanics.compiled import njit


@njit(cache=True)
def symmetric_eigen(a, v):
    """Diagonalise a small symmetric matrix in place: a <- diag(eigenvalues), v <- eigenvectors (columns).

    a: symmetric matrix, shape (n, n), overwritten; v: shape (n, n), overwritten
    Source: Golub and Van Loan, Matrix computations, 8.5 (cyclic Jacobi).
    """
    n = a.shape[0]
    for i in range(n):
        for j in range(n):
            v[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off, size = 0.0, 0.0
        for i in range(n):
            size += a[i, i] * a[i, i]
            for j in range(i):
                off += a[i, j] * a[i, j]
        if off <= 1e-34 * size or off == 0.0:
            return
        for p in range(n - 1):
            for q in range(p + 1, n):
                _jacobi_rotation(a, v, p, q)


@njit(cache=True)
def _jacobi_rotation(a, v, p, q):
    """Annihilate a[p, q] by a plane rotation of rows and columns p and q; accumulate it in v."""
    if abs(a[p, q]) <= 1e-18 * (abs(a[p, p]) + abs(a[q, q])):  # below rounding; its square might overflow below
        a[p, q] = a[q, p] = 0.0
        return
    theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
    t = 1.0 / (abs(theta) + math.sqrt(1.0 + theta * theta))
    if theta < 0.0:
        t = -t
    c = 1.0 / math.sqrt(1.0 + t * t)
    s = t * c
    n = a.shape[0]
    for i in range(n):
        x, y = a[i, p], a[i, q]
        a[i, p], a[i, q] = c * x - s * y, s * x + c * y
    for i in range(n):
        x, y = a[p, i], a[q, i]
        a[p, i], a[q, i] = c * x - s * y, s * x + c * y
    for i in range(n):
        x, y = v[i, p], v[i, q]
        v[i, p], v[i, q] = c * x - s * y, s * x + c * y


@njit(cache=True)
def _rotation_by_quaternion(f, r):
    """Write to r the proper rotation that maximises tr(R^T F), for any F: top eigenvector of Horn's 4 x 4 matrix.

    Source: Horn, Closed-form solution of absolute orientation using unit quaternions, J. Opt. Soc. Am. A 4 (1987) 629.
    """
    a, v = np.empty((4, 4)), np.empty((4, 4))
    a[0, 0] = f[0, 0] + f[1, 1] + f[2, 2]
    a[1, 1] = f[0, 0] - f[1, 1] - f[2, 2]
    a[2, 2] = f[1, 1] - f[2, 2] - f[0, 0]
    a[3, 3] = f[2, 2] - f[0, 0] - f[1, 1]
    a[0, 1] = a[1, 0] = f[2, 1] - f[1, 2]
    a[0, 2] = a[2, 0] = f[0, 2] - f[2, 0]
    a[0, 3] = a[3, 0] = f[1, 0] - f[0, 1]
    a[1, 2] = a[2, 1] = f[0, 1] + f[1, 0]
    a[1, 3] = a[3, 1] = f[0, 2] + f[2, 0]
    a[2, 3] = a[3, 2] = f[1, 2] + f[2, 1]
    symmetric_eigen(a, v)
    top = 0
    for i in range(1, 4):
        if a[i, i] > a[top, top]:
            top = i
    w, x, y, z = v[0, top], v[1, top], v[2, top], v[3, top]
    r[0, 0], r[0, 1], r[0, 2] = w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)
    r[1, 0], r[1, 1], r[1, 2] = 2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)
    r[2, 0], r[2, 1], r[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z


@njit(cache=True)
def closest_rotation(f, r):
    """Write to r the proper rotation closest to F: argmax tr(R^T F) over det R = 1, for any F (det F <= 0 too).

    f: matrix [-], shape (3, 3); r: shape (3, 3), overwritten
    Scaled Newton iteration X <- (g X + X^-T / g) / 2 where det F is well above 0 and far from overflow (Higham, SIAM J.
    Sci. Stat. Comput. 7 (1986) 1160; Frobenius scaling g), Horn's quaternion otherwise. No warm start: a pure function.
    """
    a, b, c = f[0, 0], f[0, 1], f[0, 2]
    d, e, g = f[1, 0], f[1, 1], f[1, 2]
    h, k, m = f[2, 0], f[2, 1], f[2, 2]
    size = a * a + b * b + c * c + d * d + e * e + g * g + h * h + k * k + m * m
    det = a * (e * m - g * k) + b * (g * h - d * m) + c * (d * k - e * h)
    if not 1e-4 * size * math.sqrt(size) < det < 1e90:
        _rotation_by_quaternion(f, r)
        return
    scaled = True
    for _ in range(40):
        ca, cb, cc = e * m - g * k, g * h - d * m, d * k - e * h
        cd, ce, cg = c * k - b * m, a * m - c * h, b * h - a * k
        ch, ck, cm = b * g - c * e, c * d - a * g, a * e - b * d
        p, q = 0.5, 0.5 / (a * ca + b * cb + c * cc)
        if scaled:
            size = a * a + b * b + c * c + d * d + e * e + g * g + h * h + k * k + m * m
            other = ca * ca + cb * cb + cc * cc + cd * cd + ce * ce + cg * cg + ch * ch + ck * ck + cm * cm
            gamma = math.sqrt(2.0 * abs(q) * math.sqrt(other / size))
            p, q = 0.5 * gamma, q / gamma
        na, nb, nc = p * a + q * ca, p * b + q * cb, p * c + q * cc
        nd, ne, ng = p * d + q * cd, p * e + q * ce, p * g + q * cg
        nh, nk, nm = p * h + q * ch, p * k + q * ck, p * m + q * cm
        change = max(abs(na - a), abs(nb - b), abs(nc - c), abs(nd - d), abs(ne - e), abs(ng - g),
                     abs(nh - h), abs(nk - k), abs(nm - m))
        a, b, c, d, e, g, h, k, m = na, nb, nc, nd, ne, ng, nh, nk, nm
        scaled = change > 1e-2
        if change < 1e-8:  # converges quadratically: the next change would be below rounding
            break
    r[0, 0], r[0, 1], r[0, 2] = a, b, c
    r[1, 0], r[1, 1], r[1, 2] = d, e, g
    r[2, 0], r[2, 1], r[2, 2] = h, k, m
