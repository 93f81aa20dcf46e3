"""Kernels of damping; what resists strain rates is done by `finqd.mechanics.corotated_kernels`."""

import numpy as np

from finqd.mechanics.compiled import njit
from finqd.mechanics.corotated_kernels import strained


@njit(cache=True)
def write_local_shapes(nodes, gradients, positions, shapes):
    """Write y_a = R^T (x_a - c) [m] to shapes (n, k, 3), zero before: elements without translation and rotation.

    R: the rotation closest to the element's mean deformation gradient, c: its centre; nodes (n, k), gradients
    (n, k, 3) [1/m] and positions (n_vertices, 3) [m] as in `finqd.mechanics.corotated_kernels`.
    """
    k = nodes.shape[1]
    r, s, y, u = np.empty((3, 3)), np.empty((3, 3)), np.empty(3 * k), np.empty(3 * k)
    for e in range(nodes.shape[0]):
        strained(e, nodes, shapes, gradients, positions, r, s, y, u)
        for a in range(k):
            for i in range(3):
                shapes[e, a, i] = y[3 * a + i]
