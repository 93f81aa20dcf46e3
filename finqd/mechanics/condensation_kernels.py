"""Kernels of small dense matrices: Newton's step for inner unknowns, their condensation, and a positive part."""

from __future__ import annotations

import math

import numpy as np

from finqd.mechanics.compiled import njit


@njit(cache=True)
def cholesky(a, shift):
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
def newton_step(h, factor, gradient, step):
    """Write the Newton step -(h + shift 1)^-1 gradient to step (n,), with a shift where h is not positive definite.

    Only the lower triangle of h is read. Return the squared Newton decrement [J].
    """
    n = h.shape[0]
    trace = 0.0
    for i in range(n):
        trace += abs(h[i, i])
    shift = 0.0
    while True:
        for i in range(n):
            for j in range(i + 1):
                factor[i, j] = h[i, j]
        if cholesky(factor, shift):
            break
        shift = max(10.0 * shift, 1e-4 * trace / n)
    for i in range(n):
        total = -gradient[i]
        for p in range(i):
            total -= factor[i, p] * step[p]
        step[i] = total / factor[i, i]
    decrement = 0.0
    for i in range(n - 1, -1, -1):
        decrement += step[i] * step[i]
        for p in range(i + 1, n):
            step[i] -= factor[p, i] * step[p]
        step[i] /= factor[i, i]
    return decrement


@njit(cache=True)
def condense(h, k, m, lower, rows, out):
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
        if cholesky(lower, shift):
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
            for b in range(a, 3 * k):
                out[a, b] -= w * rows[t, b]
    for a in range(3 * k):
        for b in range(a):
            out[a, b] = out[b, a]


@njit(cache=True)
def make_semidefinite(h, factor):
    """Set the negative eigenvalues of h (n, n) to zero, where it has any (the test is a Cholesky factor)."""
    n = h.shape[0]
    trace = 0.0
    for i in range(n):
        trace += h[i, i]
    factor[:] = h
    if cholesky(factor, 1e-13 * abs(trace)):
        return
    values, vectors = np.linalg.eigh(h)
    for p in range(n):
        if values[p] < 0.0:
            for i in range(n):
                w = values[p] * vectors[i, p]
                for j in range(n):
                    h[i, j] -= w * vectors[j, p]
