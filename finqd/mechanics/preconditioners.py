"""Coupled matrices of soft vertices and rigid bodies, and approximate inverses of them.

See `finqd.mechanics.linear` for the blocks A, B and C of such a matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from finqd.mechanics.linear_backends import Factorisation
from finqd.mechanics.linear_kernels import (
    block_diagonal_product,
    coupled_product,
    subtract_product,
    transposed_product,
)
from finqd.mechanics.pattern import BlockPattern

#: smallest eigenvalue of a scaled Schur complement, as a share of the largest, that is told from zero
_SINGULAR = 1e-14


@dataclass(frozen=True)
class CoupledMatrix:
    """[[A, B], [B^T, C]]: ``blocks`` of A's upper triangle, ``coupling`` B (3 n, m), ``rigid`` C (m, m)."""

    pattern: BlockPattern
    blocks: np.ndarray
    coupling: np.ndarray
    rigid: np.ndarray

    @property
    def size(self) -> int:
        return len(self.coupling) + len(self.rigid)

    def product(self, x: np.ndarray) -> np.ndarray:
        """Return the matrix times ``x`` (3 n + m,)."""
        result = np.empty(len(x))
        pattern = self.pattern
        coupled_product(pattern.indptr, pattern.indices, self.blocks, self.coupling, self.rigid, x, result)
        return result

    def diagonal_blocks(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the 3 x 3 diagonal blocks of A (n, 3, 3) and the 6 x 6 ones of C, one a rigid body."""
        m = len(self.rigid)
        bodies = [self.rigid[i : min(i + 6, m), i : min(i + 6, m)] for i in range(0, m, 6)]
        return self.blocks[self.pattern.indptr[:-1]], bodies


class Preconditioner(Protocol):
    """An approximate inverse; ``positive`` tells whether it is positive definite, which CG needs."""

    positive: bool

    def apply(self, residual: np.ndarray) -> np.ndarray:
        """Return the approximate inverse times ``residual`` (3 n + m,)."""


class CoupledInverse:
    """The exact inverse of a coupled matrix, by elimination of the soft unknowns.

    With W = A^-1 B and the Schur complement S = C - B^T W: y = S^-1 (s - W^T r), x = A^-1 r - W y. The inertias
    of A and of S add up to that of the whole matrix (Haynsworth 1968), so both tell whether it is positive definite.
    """

    def __init__(self, factorisation: Factorisation, matrix: CoupledMatrix) -> None:
        """Factorise ``matrix``; raises ``numpy.linalg.LinAlgError`` if it is singular."""
        self._factorisation = factorisation
        # a scene without soft bodies has nothing to factorise
        self.positive = factorisation.factorise(matrix.blocks) if len(matrix.coupling) else True
        self._size = len(matrix.coupling)
        self._eliminated = np.zeros(matrix.coupling.shape)
        self._schur_inverse = np.zeros((0, 0))
        if matrix.coupling.shape[1]:
            if len(matrix.coupling):
                self._eliminated = np.ascontiguousarray(factorisation.solve(matrix.coupling))
            schur = matrix.rigid - matrix.coupling.T @ self._eliminated
            self._schur_inverse, definite = _symmetric_inverse(0.5 * (schur + schur.T))
            self.positive = self.positive and definite

    @classmethod
    def restored(
        cls, factorisation: Factorisation, eliminated: np.ndarray, schur_inverse: np.ndarray
    ) -> CoupledInverse:
        """Return an inverse from its parts; the matrix of ``factorisation`` has been factorised."""
        inverse = cls.__new__(cls)
        inverse._factorisation, inverse.positive, inverse._size = factorisation, True, len(eliminated)
        inverse._eliminated, inverse._schur_inverse = eliminated, schur_inverse
        return inverse

    @property
    def parts(self) -> dict[str, np.ndarray]:
        """What `restored` takes, and the ``values`` of the factorised matrix."""
        values = self._factorisation.values if self._size else np.zeros(0)
        return {"values": values, "eliminated": self._eliminated, "schur_inverse": self._schur_inverse}

    def fits(self, matrix: CoupledMatrix) -> bool:
        """Tell whether ``matrix`` has the same number of unknowns as the one that was inverted."""
        return self._eliminated.shape == matrix.coupling.shape

    def apply(self, residual: np.ndarray) -> np.ndarray:
        """See `Preconditioner`."""
        soft, rigid = residual[: self._size], residual[self._size :]
        result = np.empty(len(residual))
        if len(soft):
            result[: self._size] = self._factorisation.solve(soft)
        if len(rigid):
            carried = np.empty(len(rigid))
            transposed_product(self._eliminated, soft, carried)
            y = self._schur_inverse @ (rigid - carried)
            subtract_product(self._eliminated, y, result[: self._size])
            result[self._size :] = y
        return result


def _symmetric_inverse(matrix: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the inverse of a small symmetric matrix and whether it is positive definite.

    Rows are scaled by the diagonal first: metres and radians differ by orders of magnitude. Raises
    ``numpy.linalg.LinAlgError`` if it is singular.
    """
    diagonal = np.abs(np.diag(matrix))
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale[None, :])
    if not np.all(np.abs(values) > _SINGULAR * np.max(np.abs(values))):
        raise np.linalg.LinAlgError("the Schur complement of the rigid bodies is singular")
    vectors = scale[:, None] * vectors
    return (vectors / values) @ vectors.T, bool(np.all(values > 0.0))


class Jacobi:
    """The inverse of the diagonal."""

    def __init__(self, matrix: CoupledMatrix) -> None:
        soft, rigid = matrix.diagonal_blocks()
        diagonal = np.concatenate([np.einsum("nii->ni", soft).reshape(-1), *(np.diag(block) for block in rigid)])
        self.positive = bool(np.all(diagonal > 0.0))
        self._inverse = 1.0 / np.where(diagonal > 0.0, diagonal, 1.0)

    def apply(self, residual: np.ndarray) -> np.ndarray:
        """See `Preconditioner`."""
        return self._inverse * residual


class BlockJacobi:
    """The inverses of the 3 x 3 blocks of the vertices and of the 6 x 6 blocks of the rigid bodies."""

    def __init__(self, matrix: CoupledMatrix) -> None:
        soft, rigid = matrix.diagonal_blocks()
        self.positive = True
        try:
            np.linalg.cholesky(soft)
            self._soft = np.linalg.inv(soft)
            self._rigid = [cho_factor(block) for block in rigid]
        except np.linalg.LinAlgError:
            self.positive = False

    def apply(self, residual: np.ndarray) -> np.ndarray:
        """See `Preconditioner`."""
        result = np.empty(len(residual))
        size = 3 * len(self._soft)
        block_diagonal_product(self._soft, residual[:size], result[:size])
        for i, factor in enumerate(self._rigid):
            body = slice(size + 6 * i, size + 6 * i + len(factor[0]))
            result[body] = cho_solve(factor, residual[body])
        return result
