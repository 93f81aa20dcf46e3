"""Kernels of explicit steps."""

import numpy as np

from finqd.mechanics.compiled import njit


@njit(cache=True)
def row_bound(indptr, indices, blocks, scale):
    r"""Return the largest row sum of |s_i A_ij s_j|, an upper bound of that matrix's eigenvalues (Gershgorin).

    indptr, indices, blocks: A [N/m], of `finqd.mechanics.pattern`
    scale: s, one over the root of a vertex's mass [kg^-1/2], 0 where it is held, shape (n_vertices, 3)
    """
    sums = np.zeros(scale.shape)
    for i in range(scale.shape[0]):
        for s in range(indptr[i], indptr[i + 1]):
            j = indices[s]
            for a in range(3):
                for b in range(3):
                    sums[i, a] += abs(blocks[s, a, b]) * scale[j, b]
                    if j > i:
                        sums[j, b] += abs(blocks[s, a, b]) * scale[i, a]
    largest = 0.0
    for i in range(scale.shape[0]):
        for a in range(3):
            largest = max(largest, sums[i, a] * scale[i, a])
    return largest
