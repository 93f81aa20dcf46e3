"""One use of gmsh: quiet, one thread, fixed seeds, and nothing left behind."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from finqd.doctor import require_gmsh

_OPTIONS = {
    "General.Terminal": 0,
    "General.NumThreads": 1,
    "General.AbortOnError": 2,
    "Mesh.RandomSeed": 1,
    "Mesh.RandomFactor": 1e-9,
    "Mesh.MaxNumThreads1D": 1,
    "Mesh.MaxNumThreads2D": 1,
    "Mesh.MaxNumThreads3D": 1,
    "Mesh.MeshSizeExtendFromBoundary": 1,
}


@contextmanager
def gmsh_session() -> Iterator[Any]:
    """Yield the module ``gmsh`` with an empty model, whose options and entities are gone afterwards.

    The user's own gmsh settings are not read, and Ctrl-C stays Python's. Raises ``MissingLibraryError``, and
    ``RuntimeError`` inside another session: gmsh has one state per process.
    """
    gmsh = require_gmsh()
    if gmsh.isInitialized():
        raise RuntimeError("gmsh is in use in this process already")
    gmsh.initialize(["finqd"], readConfigFiles=False, interruptible=False)
    try:
        for name, value in _OPTIONS.items():
            gmsh.option.setNumber(name, value)
        gmsh.model.add("finqd")
        yield gmsh
    finally:
        gmsh.finalize()
