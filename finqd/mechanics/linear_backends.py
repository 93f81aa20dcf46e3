"""Sparse factorisations of libraries behind one small contract, and which of them this machine has.

A backend is built for one sparsity, then factorises values again and again:

    factorisation = create_factorisation("auto", pattern)
    positive = factorisation.factorise(blocks)      # is the matrix positive definite?
    x = factorisation.solve(rhs)                    # shape (3 n, k)

``qdldl`` is a permissively licensed wheel for every platform and always there; ``pardiso`` (extra ``fast``) is faster
and picked up when it is installed. All run on one thread and give the same bits for the same input.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.metadata
import importlib.util
import sys
import weakref
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
import scipy.sparse as sp

from finqd.errors import InputError
from finqd.mechanics.linear_kernels import gather
from finqd.mechanics.pattern import BlockPattern

#: what "auto" takes is the first one that is installed. CHOLMOD is as fast as the BLAS it was built with (with the
#: reference one slower than QDLDL: measured), so it is used on request only
BACKENDS = ("pardiso", "qdldl", "cholmod", "superlu")


class Factorisation(Protocol):
    """A sparse factorisation of a symmetric matrix whose sparsity stays."""

    #: what a factorisation costs for each entry in a mean column of L, and a right-hand side more, in iterations of CG:
    #: measured by benchmarks/linear_solvers.py, written down so that decisions never hang on a clock
    factor_cost: ClassVar[float]
    column_cost: ClassVar[float]
    #: non-zeros of the triangular factor, after the first `factorise`
    factor_entries: int
    #: whether it computes in single precision
    single: bool

    @property
    def values(self) -> np.ndarray:
        """Entries of the matrix that was factorised last, as the library holds them, (n_entries,)."""

    def factorise(self, blocks: np.ndarray | None) -> bool:
        """Factorise the matrix with these ``blocks`` (of `BlockPattern`); return whether it is positive definite.

        None: the one whose entries have been written to `values`; it gives the same bits as from blocks.

        Raises ``numpy.linalg.LinAlgError`` if it is singular, or indefinite and the library stops there.
        """

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Return the solution for right-hand sides of shape (3 n, k), or (3 n,)."""


def available_backends() -> tuple[str, ...]:
    """Return the names of the backends that this machine has, the one for "auto" first."""
    have = {
        "pardiso": _mkl_path() is not None,
        "cholmod": _version("scikit-sparse").startswith("0.4."),  # 0.5 has another interface
        "qdldl": importlib.util.find_spec("qdldl") is not None,
        "superlu": True,
    }
    return tuple(name for name in BACKENDS if have[name])


def create_factorisation(backend: str, pattern: BlockPattern, *, single: bool = False) -> Factorisation:
    """Return an empty factorisation for ``pattern`` by ``backend`` ("auto": see `BACKENDS`).

    single: in single precision, if the library has that (``pardiso`` does): two thirds of the time, half of the memory
    Raises InputError for a backend that is unknown or not installed.
    """
    available = available_backends()
    name = available[0] if backend == "auto" else backend
    if name not in available:
        why = "is not installed" if name in BACKENDS else "is unknown"
        raise InputError(f"the linear solver backend {name!r} {why}; this machine has {', '.join(available)}")
    if name == "pardiso":
        return PardisoFactorisation(pattern, single=single)
    classes: dict[str, Any] = {
        "cholmod": CholmodFactorisation,
        "qdldl": QdldlFactorisation,
        "superlu": SuperluFactorisation,
    }
    return classes[name](pattern)


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return ""


class Rows:
    """The rows of one triangle (or all) of a block matrix, entry by entry, and where each entry is in the blocks.

    By symmetry the rows of the lower triangle are also the columns of the upper one: what a library that wants
    compressed columns of the upper triangle takes. ``indptr`` (3 n + 1,), ``indices`` (n_entries,), both 32 bit.
    """

    def __init__(self, pattern: BlockPattern, part: str, dtype: type = np.float64) -> None:
        """``part``: "lower", "upper" (both with the diagonal) or "full"; ``dtype``: of the values."""
        counts = np.diff(pattern.indptr)
        row_of_block = np.repeat(np.arange(pattern.n_vertices), counts)
        rows = 3 * row_of_block[:, None, None] + np.arange(3)[None, :, None]
        columns = 3 * pattern.indices[:, None, None] + np.arange(3)[None, None, :]
        rows, columns = (np.broadcast_to(a, (pattern.n_blocks, 3, 3)).reshape(-1) for a in (rows, columns))
        source = np.flatnonzero(columns >= rows)
        rows, columns = rows[source], columns[source]
        if part == "lower":
            rows, columns = columns, rows
        elif part == "full":
            off = columns > rows
            rows, columns = np.concatenate([rows, columns[off]]), np.concatenate([columns, rows[off]])
            source = np.concatenate([source, source[off]])
        order = np.lexsort((columns, rows))
        self.size = 3 * pattern.n_vertices
        self.indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=self.size))]).astype(np.int32)
        self.indices = columns[order].astype(np.int32)
        self.values: np.ndarray = np.empty(len(source), dtype)
        self._source = source[order].astype(np.uint32)

    def fill(self, blocks: np.ndarray | None) -> np.ndarray:
        """Copy ``blocks``, if there are any, into ``values``, in the order of ``indices``, and return it."""
        if blocks is not None:
            gather(blocks.reshape(-1), self._source, self.values)
        return self.values

    def as_columns(self) -> sp.csc_matrix:
        """Return the transposed matrix; it shares its values with this object."""
        return sp.csc_matrix((self.values, self.indices, self.indptr), shape=(self.size, self.size))


class QdldlFactorisation:
    """L D L^T of the library QDLDL (Apache licence), with approximate minimum degree ordering."""

    factor_cost: ClassVar[float] = 0.23
    column_cost: ClassVar[float] = 0.7
    single = False

    def __init__(self, pattern: BlockPattern) -> None:
        self._rows = Rows(pattern, "lower")
        self._solver: Any = None
        self.factor_entries = 0

    @property
    def values(self) -> np.ndarray:
        """See `Factorisation`."""
        return self._rows.values

    def factorise(self, blocks: np.ndarray | None) -> bool:
        """See `Factorisation`."""
        import qdldl

        self._rows.fill(blocks)
        matrix = self._rows.as_columns()
        try:
            if self._solver is None:
                self._solver = qdldl.Solver(matrix, upper=True)
            else:
                self._solver.update(matrix, upper=True)
        except (RuntimeError, ValueError) as error:
            self._solver = None
            raise np.linalg.LinAlgError("the matrix is singular") from error
        lower, diagonal, _ = self._solver.factors()
        self.factor_entries = lower.nnz + self._rows.size
        if not np.all(np.isfinite(diagonal)):
            raise np.linalg.LinAlgError("the matrix is singular")
        return bool(np.all(diagonal > 0.0))

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """See `Factorisation`."""
        if rhs.ndim == 1:
            return self._solver.solve(rhs)
        solution = np.empty(rhs.shape, order="F")
        for column in range(rhs.shape[1]):
            solution[:, column] = self._solver.solve(np.ascontiguousarray(rhs[:, column]))
        return solution


class SuperluFactorisation:
    """L U of SciPy's SuperLU in symmetric mode: the slowest, but always there."""

    factor_cost: ClassVar[float] = 0.5
    column_cost: ClassVar[float] = 0.4
    single = False

    def __init__(self, pattern: BlockPattern) -> None:
        self._rows = Rows(pattern, "full")
        self._factors: Any = None
        self.factor_entries = 0

    @property
    def values(self) -> np.ndarray:
        """See `Factorisation`."""
        return self._rows.values

    def factorise(self, blocks: np.ndarray | None) -> bool:
        """See `Factorisation`. Without off-diagonal pivots L U is L D L^T: U's diagonal shows the inertia."""
        from scipy.sparse.linalg import splu

        self._rows.fill(blocks)
        try:
            self._factors = splu(
                self._rows.as_columns(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise np.linalg.LinAlgError("the matrix is singular") from error
        upper = self._factors.U
        self.factor_entries = upper.nnz
        return bool(np.array_equal(self._factors.perm_r, self._factors.perm_c) and np.all(upper.diagonal() > 0.0))

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """See `Factorisation`."""
        return self._factors.solve(rhs)


class CholmodFactorisation:
    """Supernodal Cholesky of SuiteSparse through scikit-sparse 0.4; stops at an indefinite matrix."""

    factor_cost: ClassVar[float] = 0.4
    column_cost: ClassVar[float] = 0.6
    single = False

    def __init__(self, pattern: BlockPattern) -> None:
        self._rows = Rows(pattern, "full")
        self._factor: Any = None
        self.factor_entries = 0

    @property
    def values(self) -> np.ndarray:
        """See `Factorisation`."""
        return self._rows.values

    def factorise(self, blocks: np.ndarray | None) -> bool:
        """See `Factorisation`."""
        from sksparse.cholmod import CholmodError, analyze

        self._rows.fill(blocks)
        matrix = self._rows.as_columns()
        try:
            if self._factor is None:
                self._factor = analyze(matrix)
            self._factor.cholesky_inplace(matrix)
            self.factor_entries = self._factor.L().nnz if self.factor_entries == 0 else self.factor_entries
        except CholmodError as error:
            raise np.linalg.LinAlgError("the matrix is not positive definite") from error
        return True

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """See `Factorisation`."""
        return self._factor(rhs)


class PardisoFactorisation:
    """MKL's Pardiso: supernodal Cholesky, in single precision if asked to; stops at an indefinite matrix."""

    factor_cost: ClassVar[float] = 0.05
    column_cost: ClassVar[float] = 0.25

    def __init__(self, pattern: BlockPattern, *, single: bool = False) -> None:
        self.single = single
        self._rows = Rows(pattern, "upper", np.float32 if single else np.float64)
        self._pardiso = _Pardiso(self._rows)
        self.factor_entries = 0

    @property
    def values(self) -> np.ndarray:
        """See `Factorisation`."""
        return self._rows.values

    def factorise(self, blocks: np.ndarray | None) -> bool:
        """See `Factorisation`."""
        self._rows.fill(blocks)
        if not self._pardiso.factorise():
            raise np.linalg.LinAlgError("the matrix is not positive definite")
        self.factor_entries = int(self._pardiso.parameters[17])
        return True

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """See `Factorisation`."""
        return self._pardiso.solve(rhs)


_POSITIVE = 2  # the manual's type of a real symmetric positive definite matrix


class _Pardiso:
    """One matrix of MKL's ``pardiso``: analysed once, factorised many times, freed with the object.

    The parameters are those of the manual, counted from zero here ("Intel oneMKL developer reference, pardiso iparm").
    """

    def __init__(self, rows: Rows) -> None:
        self._handle = np.zeros(64, np.int64)
        self.parameters = np.zeros(64, np.int32)
        self.parameters[0] = 1  # take the values below, no defaults
        self.parameters[1] = 0  # minimum degree: less fill than METIS on chains of thin walls (measured)
        self.parameters[17] = -1  # report the entries of the factor
        self.parameters[27] = int(rows.values.dtype == np.float32)  # single precision
        self.parameters[34] = 1  # indices from zero
        self._call = _Call(self._handle, self.parameters, rows)
        self._release: weakref.finalize | None = None

    def factorise(self) -> bool:
        """Factorise the current values of the rows; False if a pivot has the wrong sign or is zero."""
        if self._release is None:
            self._release = weakref.finalize(self, self._call, -1)
            _check(self._call(11))
        error = self._call(22)
        if error == -4:
            return False
        _check(error)
        return True

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        given = np.asfortranarray(rhs, dtype=self._call.dtype)
        solution = np.empty_like(given, order="F")
        _check(self._call(33, given, solution))
        return solution.astype(float, copy=False)


def _check(error: int) -> None:
    if error != 0:
        raise np.linalg.LinAlgError(f"Pardiso failed with error {error}")


class _Call:
    """A call of MKL's ``pardiso`` with one matrix: what all its phases are given is made ready once."""

    def __init__(self, handle: np.ndarray, parameters: np.ndarray, rows: Rows) -> None:
        self.dtype = rows.values.dtype
        self._arrays = (handle, parameters, rows.values, rows.indptr, rows.indices)  # what is pointed to must stay
        self._pointers = tuple(_pointer(array) for array in self._arrays)
        self._numbers = {value: _integer(value) for value in (0, 1, _POSITIVE, rows.size)}
        self._size = rows.size

    def __call__(self, phase: int, rhs: np.ndarray | None = None, solution: np.ndarray | None = None) -> int:
        """Run one phase and return its error code."""
        handle, parameters, values, indptr, indices = self._pointers
        number, error = self._numbers, ctypes.c_int32(0)
        columns = number[1] if rhs is None or rhs.ndim == 1 else _integer(rhs.shape[1])
        _mkl().pardiso(
            handle, number[1], number[1], number[_POSITIVE], _integer(phase), number[self._size], values, indptr,
            indices, None, columns, parameters, number[0], _pointer(rhs), _pointer(solution), ctypes.byref(error),
        )
        return error.value


def _pointer(array: np.ndarray | None) -> ctypes.c_void_p | None:
    return None if array is None else ctypes.c_void_p(array.ctypes.data)


def _integer(value: int) -> Any:
    return ctypes.byref(ctypes.c_int32(value))


@functools.cache
def _mkl_path() -> Path | None:
    """Return MKL's run-time library as the distribution ``mkl`` (or a conda environment) holds it, or None."""
    try:
        found = [Path(str(f.locate())) for f in importlib.metadata.files("mkl") or () if "mkl_rt" in f.name]
    except importlib.metadata.PackageNotFoundError:
        prefix = Path(sys.prefix)
        found = [*prefix.glob("lib/libmkl_rt*"), *prefix.glob("Library/bin/mkl_rt*.dll")]
    found = [path for path in found if path.exists() and path.suffix != ".lib"]
    return found[0] if found else None


@functools.cache
def _mkl() -> ctypes.CDLL:
    """Load MKL: one thread, 32-bit indices, and the same bits whatever the alignment of the arrays."""
    library = ctypes.CDLL(str(_mkl_path()))
    library.MKL_Set_Threading_Layer(1)  # sequential
    library.MKL_Set_Interface_Layer(0)  # LP64
    library.MKL_CBWR_Set(2)  # conditional numerical reproducibility: the best branch of this machine, always
    return library
