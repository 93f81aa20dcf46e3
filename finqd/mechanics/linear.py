"""Linear solvers for the Newton systems of a step: soft vertices and a few rigid unknowns.

The system is

    [[A, B], [B^T, C]] [x; y] = [r; s]

with A symmetric and block sparse (soft, 3 n unknowns), C dense (rigid bodies, m = 6 a body) and B dense (contact
couples them). Near buckling the matrix can be indefinite: a solver says so.

Methods: ``cg`` (default), conjugate gradients preconditioned by the exact inverse of the system of an earlier
iteration, kept until it serves badly; ``direct``; and ``cg`` with the preconditioners ``block_jacobi`` and ``jacobi``,
which show what those cost at this conditioning. Decisions depend on counts, never on a clock: same input, same bits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from finqd.errors import InputError
from finqd.mechanics.linear_backends import Factorisation, create_factorisation
from finqd.mechanics.linear_kernels import advance, dot
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.preconditioners import BlockJacobi, CoupledInverse, CoupledMatrix, Jacobi, Preconditioner

METHODS = ("cg", "direct")
PRECONDITIONERS = ("factorisation", "block_jacobi", "jacobi")

#: a direct solution counts as converged if this share of the right-hand side is left at most
_DIRECT_TOLERANCE = 1e-6
#: iterations that a lagged inverse is always granted, and one in single precision when it is new
_FEWEST = 4


@dataclass(frozen=True, kw_only=True)
class LinearSolution:
    """What a solver returns.

    soft, rigid: x and y, in the shapes of the right-hand sides
    iterations: products with the matrix; factorised: whether A was factorised in this solve
    definite: False if the matrix was found to be indefinite (or singular). x and y are then the solution of the
        indefinite system if ``converged``, otherwise the last iterate before the negative curvature (zero if none)
    converged: whether the residual is within the tolerance
    """

    soft: np.ndarray
    rigid: np.ndarray
    iterations: int
    factorised: bool
    definite: bool
    converged: bool


@dataclass
class _Iterate:
    """Where conjugate gradients stand: x, the iterations spent, and how it ended."""

    x: np.ndarray
    iterations: int = 0
    converged: bool = False
    definite: bool = True


def conjugate_gradients(
    matrix: CoupledMatrix,
    preconditioner: Preconditioner,
    rhs: np.ndarray,
    *,
    tolerance: float,
    max_iterations: int,
) -> _Iterate:
    """Solve ``matrix x = rhs`` by preconditioned conjugate gradients (Hestenes and Stiefel 1952; Shewchuk 1994, B3).

    Stops when sqrt(r^T P r) <= tolerance sqrt(rhs^T P rhs), P the preconditioner: with a good one that is the error in
    the energy norm, which mixes no newtons with newton metres. Stops as well at a direction without positive curvature,
    before taking it: ``definite`` is then False.
    """
    state = _Iterate(np.zeros(len(rhs)))
    residual = rhs.copy()
    preconditioned = preconditioner.apply(residual)
    size = dot(residual, preconditioned)
    target = tolerance * tolerance * size
    direction = preconditioned.copy()
    while size > target and state.iterations < max_iterations:
        product = matrix.product(direction)
        state.iterations += 1
        curvature = dot(direction, product)
        if not curvature > 0.0:
            state.definite = False
            return state
        advance(state.x, residual, direction, product, size / curvature)
        preconditioned = preconditioner.apply(residual)
        previous, size = size, dot(residual, preconditioned)
        direction *= size / previous
        direction += preconditioned
    state.converged = size <= target
    return state


class LinearSolver:
    """Solves one Newton system after the other; what it keeps between them is the preconditioner of an earlier one.

    Made by `make_solver`. ``solve`` raises for no matrix: a singular or indefinite one is reported as such.
    """

    def __init__(
        self,
        pattern: BlockPattern,
        *,
        method: str,
        preconditioner: str,
        backend: str,
        tolerance: float,
        max_iterations: int,
        refactor_cost: float | None,
    ) -> None:
        self.pattern = pattern
        self.method, self.preconditioner = method, preconditioner
        self.tolerance, self.max_iterations, self.refactor_cost = tolerance, max_iterations, refactor_cost
        self._factorisation: Factorisation | None = None
        if method == "direct" or preconditioner == "factorisation":
            self._factorisation = create_factorisation(backend, pattern, single=method == "cg")
        self._backend, self._served = backend, False  # whether the last factor in single precision was of use
        self._lagged: CoupledInverse | None = None
        self._refactor_cost, self._spent, self._solved = 0.0, 0, 0  # since the lagged inverse was made, in iterations

    def solve(
        self,
        blocks: np.ndarray,
        coupling: np.ndarray,
        rigid: np.ndarray,
        rhs_soft: np.ndarray,
        rhs_rigid: np.ndarray,
        *,
        tolerance: float | None = None,
    ) -> LinearSolution:
        """Solve [[A, B], [B^T, C]] [x; y] = [r; s].

        blocks: A (n_blocks + 1, 3, 3), see `BlockPattern`; coupling: B (3 n, m); rigid: C (m, m)
        rhs_soft: r, 3 n numbers of any shape; rhs_rigid: s, m numbers of any shape
        tolerance: see `conjugate_gradients`, the solver's own if None
        """
        m = rhs_rigid.size
        matrix = CoupledMatrix(
            self.pattern,
            np.ascontiguousarray(blocks, dtype=float),
            np.ascontiguousarray(coupling, dtype=float).reshape(rhs_soft.size, m),
            np.ascontiguousarray(rigid, dtype=float).reshape(m, m),
        )
        rhs = np.concatenate([np.reshape(rhs_soft, -1), np.reshape(rhs_rigid, -1)]).astype(float)
        tolerance = self.tolerance if tolerance is None else tolerance
        if self.method == "direct":
            state, factorised = self._direct(matrix, rhs)
        elif self.preconditioner == "factorisation":
            state, factorised = self._lagged_cg(matrix, rhs, tolerance)
        else:
            state, factorised = self._jacobi_cg(matrix, rhs, tolerance), False
        finite = bool(np.all(np.isfinite(state.x)))
        x = state.x if finite else np.zeros(len(rhs))
        return LinearSolution(
            soft=x[: rhs_soft.size].reshape(rhs_soft.shape),
            rigid=x[rhs_soft.size :].reshape(rhs_rigid.shape),
            iterations=state.iterations,
            factorised=factorised,
            definite=state.definite,
            converged=state.converged and finite,
        )

    @property
    def lagged(self) -> Preconditioner | None:
        """The exact inverse of an earlier system, which was positive definite, if one is kept."""
        return self._lagged

    def forget(self) -> None:
        """Drop the lagged preconditioner: the next system is known to be a different one."""
        self._lagged = None

    def history(self) -> dict[str, np.ndarray]:
        """Return what later solutions depend on, for `restore`: the lagged inverse, and what it has served for."""
        counts = np.array([self._refactor_cost, self._spent, self._solved, self._served], dtype=float)
        single = self._factorisation is not None and self._factorisation.single
        kept = self._lagged.parts if self._lagged is not None else {}
        return {"counts": counts, "single": np.array(single), **kept}

    def restore(self, history: dict[str, np.ndarray]) -> None:
        """Go on where the solver was whose `history` this is: the same bits follow."""
        cost, spent, solved, served = history["counts"].tolist()
        self._refactor_cost, self._spent, self._solved, self._served = cost, int(spent), int(solved), bool(served)
        if self._factorisation is None:
            return
        if self._factorisation.single and not history["single"]:
            self._factorisation = create_factorisation(self._backend, self.pattern)
        if "values" in history:
            if len(history["eliminated"]):
                self._factorisation.values[:] = history["values"]
                self._factorisation.factorise(None)
            self._lagged = CoupledInverse.restored(
                self._factorisation, history["eliminated"], history["schur_inverse"]
            )

    def _jacobi_cg(self, matrix: CoupledMatrix, rhs: np.ndarray, tolerance: float) -> _Iterate:
        preconditioner = (Jacobi if self.preconditioner == "jacobi" else BlockJacobi)(matrix)
        if not preconditioner.positive:
            return _Iterate(np.zeros(len(rhs)), definite=False)
        return conjugate_gradients(
            matrix, preconditioner, rhs, tolerance=tolerance, max_iterations=self.max_iterations
        )

    def _direct(self, matrix: CoupledMatrix, rhs: np.ndarray) -> tuple[_Iterate, bool]:
        assert self._factorisation is not None
        inverse = _inverse_of(self._factorisation, matrix)
        if inverse is None:
            self._lagged = None
            return _Iterate(np.zeros(len(rhs)), definite=False), True
        self._lagged = inverse if inverse.positive else None  # for quasi-Newton steps
        return _solve_directly(matrix, inverse, rhs), True

    def _lagged_cg(self, matrix: CoupledMatrix, rhs: np.ndarray, tolerance: float) -> tuple[_Iterate, bool]:
        """Iterate with the inverse of an earlier matrix; make a new one when that is cheaper in the long run.

        A lagged inverse serves worse and worse. It is best replaced when the next system would cost more than the
        average since it was made, its own cost included (the replacement problem: Barlow and Hunter 1960, minimal
        repair); at once, if one system alone has cost as much as a new inverse.
        """
        state = _Iterate(np.zeros(len(rhs)))
        if self._lagged is not None and self._lagged.fits(matrix):
            limit = max(_FEWEST, math.ceil(self._refactor_cost))
            state = conjugate_gradients(matrix, self._lagged, rhs, tolerance=tolerance, max_iterations=limit)
            self._spent += state.iterations
            self._solved += 1
            if not state.definite or state.iterations * self._solved > self._refactor_cost + self._spent:
                self._lagged = None
            if not state.definite or state.converged:
                return state, False
        self._lagged, wasted = None, state.iterations
        state = self._renewed_cg(matrix, rhs, tolerance)
        state.iterations += wasted
        return state, True

    def _renewed_cg(self, matrix: CoupledMatrix, rhs: np.ndarray, tolerance: float) -> _Iterate:
        """Solve with a new inverse, which is kept; in single precision while that serves.

        A preconditioner need not be exact. But rounding can make a matrix seem indefinite: if that happens to the first
        one or twice in a row, or iterations do not get on, the matrices are too ill conditioned, and from then on all
        are factorised in double precision.
        """
        assert self._factorisation is not None
        single = self._factorisation.single
        inverse = _inverse_of(self._factorisation, matrix)
        positive = inverse is not None and inverse.positive
        served, self._served = self._served, positive
        if inverse is None or not positive:
            if single and not served:
                return self._precise_cg(matrix, rhs, tolerance)
            if inverse is None:
                return _Iterate(np.zeros(len(rhs)), definite=False)
            return _solve_directly(matrix, inverse, rhs)
        self._lagged, self._spent, self._solved = inverse, 1, 1
        self._refactor_cost = self._cost_of(matrix)
        if single:
            state = conjugate_gradients(matrix, inverse, rhs, tolerance=tolerance, max_iterations=_FEWEST)
            return state if state.converged else self._precise_cg(matrix, rhs, tolerance)
        state = _solve_directly(matrix, inverse, rhs)
        if state.converged:
            return state
        return conjugate_gradients(matrix, inverse, rhs, tolerance=tolerance, max_iterations=self.max_iterations)

    def _precise_cg(self, matrix: CoupledMatrix, rhs: np.ndarray, tolerance: float) -> _Iterate:
        """Go over to double precision for good."""
        self._lagged = None
        self._factorisation = create_factorisation(self._backend, self.pattern)
        return self._renewed_cg(matrix, rhs, tolerance)

    def _cost_of(self, matrix: CoupledMatrix) -> float:
        """Return what a new inverse costs, in iterations."""
        if self.refactor_cost is not None:
            return self.refactor_cost
        assert self._factorisation is not None
        column = self._factorisation.factor_entries / max(len(matrix.coupling), 1)
        return self._factorisation.factor_cost * column + self._factorisation.column_cost * len(matrix.rigid)


def _inverse_of(factorisation: Factorisation, matrix: CoupledMatrix) -> CoupledInverse | None:
    """Return the inverse of ``matrix``, None if it is singular or indefinite and the library stops there."""
    try:
        return CoupledInverse(factorisation, matrix)
    except np.linalg.LinAlgError:
        return None


def _solve_directly(matrix: CoupledMatrix, inverse: CoupledInverse, rhs: np.ndarray) -> _Iterate:
    """Apply the inverse of ``matrix`` itself, and check what is left, each row weighed by its diagonal."""
    x = inverse.apply(rhs)
    residual = rhs - matrix.product(x)
    soft, rigid = matrix.diagonal_blocks()
    diagonal = np.concatenate([np.einsum("nii->ni", soft).reshape(-1), *(np.diag(block) for block in rigid)])
    weight = 1.0 / np.where(diagonal == 0.0, 1.0, np.abs(diagonal))
    left, given = dot(weight * residual, residual), dot(weight * rhs, rhs)
    return _Iterate(x, 1, left <= _DIRECT_TOLERANCE**2 * given, inverse.positive)


def make_solver(
    pattern: BlockPattern,
    *,
    method: str = "cg",
    preconditioner: str = "factorisation",
    backend: str = "auto",
    tolerance: float = 1e-6,
    max_iterations: int = 10_000,
    refactor_cost: float | None = None,
) -> LinearSolver:
    """Return a solver for systems whose soft matrix has the sparsity ``pattern``.

    method: "cg" or "direct"; preconditioner (of cg): "factorisation", "block_jacobi" or "jacobi"
    backend: library of the factorisation, "auto" for the first that is installed of `linear_backends.BACKENDS`
    tolerance: see `conjugate_gradients`; max_iterations: of one solve
    refactor_cost: what a new lagged inverse costs, in iterations of CG; None for what the backend is known to take
    Raises InputError for an unknown method, preconditioner or backend.
    """
    for what, value, known in (("method", method, METHODS), ("preconditioner", preconditioner, PRECONDITIONERS)):
        if value not in known:
            raise InputError(f"{value!r} is not a {what} of a linear solver; known are {', '.join(known)}", what)
    return LinearSolver(
        pattern,
        method=method,
        preconditioner=preconditioner,
        backend=backend,
        tolerance=tolerance,
        max_iterations=max_iterations,
        refactor_cost=refactor_cost,
    )
