"""Kernels on block matrices in the format of `finqd.mechanics.pattern`."""

import numpy as np

from finqd.mechanics.compiled import njit


@njit(cache=True)
def add_diagonal(indptr, values, blocks):
    """Add ``values`` (n_vertices,) times the 3 x 3 identity to the diagonal blocks, each the first of its row."""
    for i in range(values.shape[0]):
        for a in range(3):
            blocks[indptr[i], a, a] += values[i]


@njit(cache=True)
def hold(indptr, indices, fixed, blocks, coupling):
    """Turn rows and columns of fixed degrees of freedom into those of the identity (and of zero in ``coupling``).

    fixed: bool, shape (n_vertices, 3); coupling: shape (3 n_vertices, m).
    """
    for i in range(fixed.shape[0]):
        row_fixed = fixed[i, 0] or fixed[i, 1] or fixed[i, 2]
        for s in range(indptr[i], indptr[i + 1]):
            j = indices[s]
            if not (row_fixed or fixed[j, 0] or fixed[j, 1] or fixed[j, 2]):
                continue
            for a in range(3):
                for b in range(3):
                    if fixed[i, a] or fixed[j, b]:
                        blocks[s, a, b] = 1.0 if (i == j and a == b) else 0.0
        if row_fixed:
            for a in range(3):
                if fixed[i, a]:
                    for m in range(coupling.shape[1]):
                        coupling[3 * i + a, m] = 0.0


@njit(cache=True)
def largest_force(gradient, fixed):
    """Return the largest force [N] on a vertex, without fixed degrees of freedom, and that vertex (-1 if none)."""
    best, where = 0.0, -1
    for i in range(gradient.shape[0]):
        f = 0.0
        for a in range(3):
            if not fixed[i, a]:
                f += gradient[i, a] * gradient[i, a]
        if not f <= best:  # also takes a NaN
            best, where = f, i
            if f != f:
                break
    return np.sqrt(best), where
