"""Compiles kernels, and keeps the compiled ones in a folder of their own for each state of all their sources.

Numba puts the kernels that a kernel calls into its machine code, but looks for changes only in the file of that kernel
itself. So after an update, a pull or an edit it would go on running what other files said before. Here a change in any
file of kernels makes all of them compile again. And where several processes want a kernel that nobody has, one of them
compiles it and the others wait for that, then load it.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO, Any

LOCK_WAIT_S = 300.0  # for another process to compile a kernel; the largest takes half a minute on a slow core
LOCK_POLL_S = 0.02

_kernels: list[Any] = []  # that have been decorated
_locked: set[Path] = set()  # by this process; Numba's compiler lock guards it


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return ``numba.njit(**options)`` with its cache in `kernel_folder`; without a cache if there is none."""
    import numba

    def compiled(function: Callable[..., Any]) -> Any:
        folder = kernel_folder()
        before = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(folder or before)  # looked at in decorating only, and nobody else's business
        try:
            kept = bool(options.get("cache")) and folder is not None
            kernel = numba.njit(**{**options, "cache": kept})(function)
        finally:
            numba.config.CACHE_DIR = before
        if not numba.config.DISABLE_JIT:
            _kernels.append(kernel)
            if folder is not None and kept:
                _compile_alone(kernel, folder)
        return kernel

    return compiled


def kernels() -> tuple[Any, ...]:
    """Return the kernels that this process knows, Numba's dispatchers, compiled or not."""
    return tuple(_kernels)


def kernel_counts() -> tuple[int, int]:
    """Return how many kernels this process has compiled, and how many it has loaded; one a signature."""
    compiled = sum(sum(kernel.stats.cache_misses.values()) for kernel in _kernels)
    return compiled, sum(sum(kernel.stats.cache_hits.values()) for kernel in _kernels)


def kernel_folder() -> Path | None:
    """Return the folder of the present kernels, made if need be; None if no place for it is writable."""
    return _first_writable(tuple(kernel_places()))


@cache
def _first_writable(places: tuple[Path, ...]) -> Path | None:
    for place in places:
        folder = place / f"kernels-{_digest(Path(__file__).parent)}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    return None


def kernel_places() -> list[Path]:
    """Return where compiled kernels may be kept: in ``NUMBA_CACHE_DIR``, or beside their sources, or at the user's."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    users = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return [Path(chosen)] if chosen else [Path(__file__).parent / "__pycache__", users / "finqd"]


def _digest(folder: Path) -> str:
    """Return a digest of all sources of kernels in ``folder``."""
    sources = sorted(folder.glob("*_kernels.py"))
    return hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in sources)).hexdigest()[:16]


# one process at a time ------------------------------------------------------------------------------------------------


def _compile_alone(kernel: Any, folder: Path) -> None:
    """Let one process at a time compile ``kernel``: whoever waited then finds it in the cache, where Numba looks first.

    A lock a kernel: a process that compiles one holds up nobody who wants another. Numba's own lock comes first, else
    two threads of one process could each hold one and wait for the other.
    """
    from numba.core.compiler_lock import global_compiler_lock

    plain, function = kernel.compile, kernel.py_func
    path = folder / f"{function.__module__}.{function.__name__}-{function.__code__.co_firstlineno}.lock"

    def compile_alone(signature: Any) -> Any:
        with global_compiler_lock, _lock(path):
            return plain(signature)

    kernel.compile = compile_alone


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Hold the lock file ``path`` for a while. The system frees it when its holder ends, however that may come.

    Who holds it already, by a kernel that calls itself, goes on. Where files cannot be locked, everybody does, and so
    does who has waited for `LOCK_WAIT_S`, behind a process that was suspended: kernels are compiled twice then.
    """
    if path in _locked:
        yield
        return
    try:
        file = open(path, "a")
    except OSError:
        yield
        return
    _locked.add(path)
    try:
        with file:  # closing it frees it
            _wait_for(file)
            yield
    finally:
        _locked.remove(path)


def _wait_for(file: IO[str]) -> None:
    try:
        import fcntl
    except ImportError:  # Windows: each process compiles for itself
        return
    give_up = time.monotonic() + LOCK_WAIT_S
    while time.monotonic() < give_up:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            time.sleep(LOCK_POLL_S)
        except OSError:  # a file system without locks
            return
