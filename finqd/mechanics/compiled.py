"""Compiles kernels, and keeps the compiled ones in a folder of their own for each state of all their sources.

Numba puts the kernels that a kernel calls into its machine code, but looks for changes only in the file of that kernel
itself. So after an update, a pull or an edit it would go on running what other files said before. Here a change in any
file of kernels makes all of them compile again.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return ``numba.njit(**options)`` with its cache in `kernel_folder`; without a cache if there is none."""
    import numba

    def compiled(function: Callable[..., Any]) -> Any:
        folder = kernel_folder()
        if folder is None:
            return numba.njit(**{**options, "cache": False})(function)
        before = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(folder)  # looked at while a function is decorated, and nobody else's business
        try:
            return numba.njit(**options)(function)
        finally:
            numba.config.CACHE_DIR = before

    return compiled


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
