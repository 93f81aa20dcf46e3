"""Kernels of explicit steps."""

import numpy as np
from numba import njit


@njit(cache=True)
def row_bound(indptr, indices, blocks, scale):
    r"""Return the largest row sum of |s_i A_ij s_j|, an upper bound of that matrix's eigenvalues (Gershgorin).

    indptr, indices: of `finqd.mechanics.pattern`; blocks: A [N/m], shape (n_blocks, 3, 3)
    scale: s, one over the root of a vertex's mass [kg^-1/2], 0 where it is held, shape (n_vertices, 3)
    """
    largest = 0.0
    row = np.zeros(3)
    for i in range(scale.shape[0]):
        row[:] = 0.0
        for s in range(indptr[i], indptr[i + 1]):
            j = indices[s]
            for a in range(3):
                for b in range(3):
                    row[a] += abs(blocks[s, a, b]) * scale[j, b]
        for a in range(3):
            largest = max(largest, row[a] * scale[i, a])
    return largest
