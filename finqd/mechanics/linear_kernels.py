"""Compiled loops of the linear solvers: products of block matrices, dot products, copies.

All run serially in a fixed order, so that the same input gives the same bits whatever the number of threads of BLAS.
"""

from __future__ import annotations

from finqd.mechanics.compiled import njit


@njit(cache=True)
def coupled_product(indptr, indices, blocks, coupling, rigid, x, product):
    r"""Write ``[[A, B], [B^T, C]] x`` to ``product``.

    indptr (n + 1,), indices (n_blocks,), blocks: A, the upper triangle in block compressed rows, diagonal block first
    coupling: B, shape (3 n, m); rigid: C, shape (m, m); x, product: shape (3 n + m,)
    Units: those of the caller, [N/m] times [m] for a Newton system.
    """
    n = len(indptr) - 1
    m = rigid.shape[0]
    size = 3 * n
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += rigid[i, j] * x[size + j]
        product[size + i] = total
    for i in range(size):
        product[i] = 0.0
    for row in range(n):
        a0, a1, a2 = 0.0, 0.0, 0.0
        r0, r1, r2 = x[3 * row], x[3 * row + 1], x[3 * row + 2]
        for slot in range(indptr[row], indptr[row + 1]):
            column = 3 * indices[slot]
            x0, x1, x2 = x[column], x[column + 1], x[column + 2]
            b00, b01, b02 = blocks[slot, 0, 0], blocks[slot, 0, 1], blocks[slot, 0, 2]
            b10, b11, b12 = blocks[slot, 1, 0], blocks[slot, 1, 1], blocks[slot, 1, 2]
            b20, b21, b22 = blocks[slot, 2, 0], blocks[slot, 2, 1], blocks[slot, 2, 2]
            a0 += b00 * x0 + b01 * x1 + b02 * x2
            a1 += b10 * x0 + b11 * x1 + b12 * x2
            a2 += b20 * x0 + b21 * x1 + b22 * x2
            if slot > indptr[row]:
                product[column] += b00 * r0 + b10 * r1 + b20 * r2
                product[column + 1] += b01 * r0 + b11 * r1 + b21 * r2
                product[column + 2] += b02 * r0 + b12 * r1 + b22 * r2
        product[3 * row] += a0
        product[3 * row + 1] += a1
        product[3 * row + 2] += a2
    if m > 0:
        for i in range(size):
            total = 0.0
            for j in range(m):
                total += coupling[i, j] * x[size + j]
                product[size + j] += coupling[i, j] * x[i]
            product[i] += total


@njit(cache=True)
def dot(x, y):
    """Return the sum of ``x * y``, both of shape (n,), added in order."""
    total = 0.0
    for i in range(len(x)):
        total += x[i] * y[i]
    return total


@njit(cache=True)
def advance(x, residual, direction, product, step):
    """Conjugate gradients' update: ``x += step direction``, ``residual -= step product``; all of shape (n,)."""
    for i in range(len(x)):
        x[i] += step * direction[i]
        residual[i] -= step * product[i]


@njit(cache=True)
def block_diagonal_product(inverses, x, product):
    """Write the product of 3 x 3 ``inverses`` (n, 3, 3) and ``x`` (3 n,) to ``product`` (3 n,)."""
    for b in range(len(inverses)):
        for i in range(3):
            total = 0.0
            for j in range(3):
                total += inverses[b, i, j] * x[3 * b + j]
            product[3 * b + i] = total


@njit(cache=True)
def gather(values, source, taken):
    """Write ``values[source]`` to ``taken``; all flat. Copies the blocks into the order that a library wants."""
    for i in range(len(source)):
        taken[i] = values[source[i]]


@njit(cache=True)
def transposed_product(matrix, x, product):
    """Write ``matrix^T x`` to ``product``: shapes (n, m), (n,), (m,)."""
    n, m = matrix.shape
    for j in range(m):
        product[j] = 0.0
    for i in range(n):
        for j in range(m):
            product[j] += matrix[i, j] * x[i]


@njit(cache=True)
def subtract_product(matrix, y, x):
    """Do ``x -= matrix y``: shapes (n, m), (m,), (n,)."""
    n, m = matrix.shape
    for i in range(n):
        total = 0.0
        for j in range(m):
            total += matrix[i, j] * y[j]
        x[i] -= total
