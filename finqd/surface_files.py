"""Reads surface files (STL, OBJ, PLY, OFF) as objects, and refuses in one sentence what encloses no solid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from finqd.cache import remembered
from finqd.errors import InputError, MissingLibraryError
from finqd.mechanics.distance import edge_table, surface_field, triangle_neighbours
from finqd.mechanics.distance_kernels import signed_distance
from finqd.mechanics.mass_properties import surface_moments

SUFFIXES = (".stl", ".obj", ".ply", ".off")
TRIANGLE_LIMIT = 5_000_000
FILE_LIMIT = 1_000_000_000  # [bytes]
LARGE = 100_000  # [bytes] from which on what a file holds is kept on disk: smaller ones are read in 50 ms


def read_surface(path: Path, *, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the watertight, outward surface in a file: vertices (n, 3) [m] and triangles (m, 3).

    factor: metres a unit of the file. Raises ``InputError``: no such file, another format, nothing in it, leaks, more
    than one body, more than `TRIANGLE_LIMIT` triangles.
    """
    _refuse_path(path)
    if path.stat().st_size < LARGE:
        return _read(path, factor)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", str(path)) from error
    vertices, triangles = remembered(
        "surface", [content, path.suffix.lower(), float(factor)], lambda: _read(path, factor),
        pack=lambda made: {"vertices": made[0], "triangles": made[1]},
        unpack=lambda arrays: (arrays["vertices"], arrays["triangles"]),
    )
    return vertices, triangles


def _read(path: Path, factor: float) -> tuple[np.ndarray, np.ndarray]:
    where = str(path)
    mesh = _load(path)
    vertices, triangles = np.asarray(mesh.vertices, dtype=float) * factor, np.asarray(mesh.faces, dtype=np.int64)
    if len(triangles) == 0:
        raise InputError("holds no triangles", where)
    if len(triangles) > TRIANGLE_LIMIT:
        raise InputError(f"has {len(triangles)} triangles, more than the {TRIANGLE_LIMIT} that are taken", where)
    if not np.all(np.isfinite(vertices)):
        raise InputError("has coordinates that are not finite numbers", where)
    return checked_surface(*_merged(vertices, triangles), where)


def checked_surface(vertices: np.ndarray, triangles: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a surface as one that encloses a solid, turned outward; raise ``InputError`` if it cannot.

    vertices: [m], shape (n, 3), equal points merged; triangles: shape (m, 3). Inner surfaces are cavities.
    """
    _refuse_open(triangles, where)
    triangles = _consistently_wound(vertices, triangles, where)
    _, neighbours = triangle_neighbours(triangles)
    _refuse_pinched(triangles, neighbours, where)
    shells = _components(len(triangles), np.repeat(np.arange(len(triangles)), 3), neighbours.reshape(-1))
    volumes = np.array([surface_moments(vertices, triangles[shells == i]).volume for i in range(shells.max() + 1)])
    size = np.ptp(vertices, axis=0).max()
    outer = int(np.argmax(np.abs(volumes)))
    if abs(volumes[outer]) < 1e-6 * size**3:
        raise InputError("is degenerate: it encloses next to no volume", where)
    if volumes[outer] < 0.0:
        triangles, volumes = triangles[:, ::-1], -volumes
    for shell in np.flatnonzero(np.arange(len(volumes)) != outer):
        point = vertices[triangles[shells == shell][0, 0]]
        if not volumes[shell] < 0.0 or not _inside(point, vertices, triangles[shells == outer]):
            raise InputError(f"holds {len(volumes)} separate bodies; an object is one", where)
    return vertices, np.ascontiguousarray(triangles)


def _refuse_path(path: Path) -> None:
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"is no surface file: its name must end in {', '.join(SUFFIXES)}", str(path))
    if not path.exists():
        raise InputError("there is no such file", str(path))
    if not path.is_file():
        raise InputError("is not a regular file", str(path))
    if not 0 < path.stat().st_size <= FILE_LIMIT:
        raise InputError("is empty" if path.stat().st_size == 0 else "is larger than 1 GB", str(path))


def _load(path: Path) -> Any:
    """Return the file as trimesh reads it, untouched."""
    try:
        import trimesh
    except ImportError as error:
        raise MissingLibraryError("reading surface files needs trimesh: pip install trimesh") from error
    kind = path.suffix.lower()[1:]
    try:
        with path.open("rb") as stream:
            return trimesh.load(stream, file_type=kind, force="mesh", process=False, skip_materials=True)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", str(path)) from error
    except ImportError as error:  # trimesh guesses encodings of what looks like no such file with a further library
        raise InputError(f"cannot be read as {kind.upper()}: cut short, or another format", str(path)) from error
    except Exception as error:  # a parser of foreign files may raise anything
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise InputError(f"cannot be read as {kind.upper()}: {reason}", str(path)) from error


def _merged(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge equal points (STL repeats each for every triangle); drop triangles that lose a corner, and duplicates."""
    size = max(float(np.ptp(vertices[triangles.reshape(-1)], axis=0).max()), 1e-300)
    cells = np.round(vertices / (1e-8 * size)).astype(np.int64)
    order = np.lexsort(cells.T)
    new = np.any(np.diff(cells[order], axis=0) != 0, axis=1)
    label = np.empty(len(vertices), dtype=np.int64)
    label[order] = np.concatenate([[0], np.cumsum(new)])
    first = order[np.concatenate([[True], new])]
    triangles = label[triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    low, middle, high = np.sort(triangles, axis=1).T
    _, pair = np.unique(low * len(first) + middle, return_inverse=True)
    _, kept = np.unique(pair * len(first) + high, return_index=True)
    triangles = triangles[np.sort(kept)]
    used = np.bincount(triangles.reshape(-1), minlength=len(first)) > 0
    return vertices[first[used]], (np.cumsum(used) - 1)[triangles]


def _refuse_open(triangles: np.ndarray, where: str) -> None:
    if len(triangles) < 4:
        raise InputError(f"holds {len(triangles)} proper triangles; a solid needs at least 4", where)
    _, _, counts = edge_table(triangles)
    single, many = np.count_nonzero(counts == 1), np.count_nonzero(counts > 2)
    if single:
        raise InputError(f"is not watertight: {single} edges belong to one triangle only", where)
    if many:
        raise InputError(f"is not manifold: {many} edges belong to more than two triangles", where)


def _consistently_wound(vertices: np.ndarray, triangles: np.ndarray, where: str) -> np.ndarray:
    if _is_wound(triangles):
        return triangles
    import trimesh

    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    trimesh.repair.fix_winding(mesh)
    triangles = np.asarray(mesh.faces, dtype=np.int64)
    if not _is_wound(triangles):
        raise InputError("has no inside: its triangles cannot be turned to face the same side", where)
    return triangles


def _is_wound(triangles: np.ndarray) -> bool:
    """Return whether every edge is run through once in each direction."""
    start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
    keys = np.sort(start * (int(triangles.max()) + 1) + end)
    return not np.any(keys[1:] == keys[:-1])


def _refuse_pinched(triangles: np.ndarray, neighbours: np.ndarray, where: str) -> None:
    """Raise ``InputError`` if two fans of triangles meet in one vertex: distance has no sign there."""
    m = len(triangles)
    corner = np.arange(3 * m)
    triangle, side = np.divmod(corner, 3)
    other = neighbours[triangle, side]  # across the side that starts at this corner
    matches = np.argmax(triangles[other] == triangles[triangle, side][:, None], axis=1)
    fans = _components(3 * m, corner, 3 * other + matches)
    pinched = fans.max() + 1 - np.count_nonzero(np.bincount(triangles.reshape(-1)))
    if pinched:
        raise InputError(f"is not manifold: it touches itself in {pinched} vertices", where)


def _components(n: int, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return which connected part each of ``n`` nodes is in, shape (n,), given links from ``start`` to ``end``."""
    graph = sp.coo_array((np.ones(len(start), dtype=np.int8), (start, end)), shape=(n, n))
    return sp.csgraph.connected_components(graph.tocsr(), directed=False)[1]


def _inside(point: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> bool:
    return signed_distance(surface_field(vertices, triangles), *point)[0] < 0.0
