"""Sparsity of a block matrix whose 3 x 3 blocks are pairs of vertices, with precomputed scatter maps.

Format: block compressed rows (scipy's BSR) with sorted columns, of the upper triangle: the matrices are symmetric, and
memory is what their products wait for. One more block, the last, takes what elements add below the diagonal; nobody
reads it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp


@dataclass(frozen=True)
class BlockPattern:
    """Block rows: ``indptr`` (n_vertices + 1,), ``indices`` (n_blocks,): column vertex of a block, sorted in a row.

    The first block of every row is the diagonal one (all nine of its numbers are stored).
    """

    indptr: np.ndarray
    indices: np.ndarray

    @classmethod
    def from_cliques(cls, n_vertices: int, cliques: Sequence[np.ndarray]) -> BlockPattern:
        """Return the pattern in which all vertices of a clique couple; each array has shape (n, k), -1 pads."""
        keys = [np.arange(n_vertices, dtype=np.int64) * (n_vertices + 1)]
        for nodes in cliques:
            nodes = np.asarray(nodes, dtype=np.int64)
            pairs = nodes[:, :, None] * n_vertices + nodes[:, None, :]
            valid = (nodes[:, :, None] >= 0) & (nodes[:, None, :] >= nodes[:, :, None])
            keys.append(np.unique(pairs[valid]))
        key = np.unique(np.concatenate(keys))
        rows = key // n_vertices
        indptr = np.zeros(n_vertices + 1, dtype=np.int64)
        np.add.at(indptr, rows + 1, 1)
        return cls(np.cumsum(indptr), key % n_vertices)

    @property
    def n_vertices(self) -> int:
        return len(self.indptr) - 1

    @property
    def n_blocks(self) -> int:
        return len(self.indices)

    def new_blocks(self) -> np.ndarray:
        """Return a matrix of zeros: blocks of shape (n_blocks + 1, 3, 3), the last one of no meaning."""
        return np.zeros((self.n_blocks + 1, 3, 3))

    def slots(self, nodes: np.ndarray) -> np.ndarray:
        """Return the block index of every pair of a clique, shape (n, k, k); -1 where a node is -1.

        Pairs below the diagonal, whose column comes before their row, have the index ``n_blocks``.

        Raises KeyError if a pair is not in the pattern.
        """
        nodes = np.asarray(nodes, dtype=np.int64)
        if not nodes.size:
            return np.zeros((*nodes.shape, nodes.shape[-1]), dtype=np.int32)
        rows = np.repeat(np.arange(self.n_vertices, dtype=np.int64), np.diff(self.indptr))
        key = rows * self.n_vertices + self.indices
        one, other = nodes[:, :, None], nodes[:, None, :]
        wanted, valid = np.minimum(one, other) * self.n_vertices + np.maximum(one, other), np.minimum(one, other) >= 0
        found = np.searchsorted(key, np.where(valid, wanted, key[0]))
        if np.any(key[np.minimum(found, len(key) - 1)][valid] != wanted[valid]):
            raise KeyError("a pair of vertices is not in the sparsity pattern")
        upper = np.where(one <= other, found, self.n_blocks)
        return np.where(valid, upper, -1).astype(np.int32)

    def lacks(self, pairs: np.ndarray) -> np.ndarray:
        """Return which ``pairs`` of vertices, shape (n, 2), have no block, shape (n,)."""
        rows = np.repeat(np.arange(self.n_vertices, dtype=np.int64), np.diff(self.indptr))
        wanted = np.sort(np.asarray(pairs, dtype=np.int64), axis=1) @ np.array([self.n_vertices, 1])
        return ~np.isin(wanted, rows * self.n_vertices + self.indices)

    def matrix(self, blocks: np.ndarray) -> sp.bsr_array:
        """Return the symmetric matrix of ``blocks`` (n_blocks + 1, 3, 3), sparse, (3 n_vertices, 3 n_vertices)."""
        n, blocks = 3 * self.n_vertices, blocks[: self.n_blocks]
        upper = sp.bsr_array((blocks, self.indices, self.indptr), shape=(n, n))
        beside = blocks.copy()
        beside[self.indptr[:-1]] = 0.0
        return sp.bsr_array(upper + sp.bsr_array((beside, self.indices, self.indptr), shape=(n, n)).T)
