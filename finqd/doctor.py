"""Whether this machine can run finqd, and what is missing if not."""

from __future__ import annotations

import os
import platform
import sys
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Literal

from finqd.errors import MissingLibraryError

#: what gmsh's wheel links to and a bare Debian lacks (found by installing it there)
GMSH_DEBIAN_PACKAGES = "libglu1-mesa libgl1 libxcursor1 libxft2 libxinerama1 libxrender1 libgomp1"

#: module -> distribution; each is needed, and each says so itself when it is first used
LIBRARIES = {
    "numpy": "numpy", "scipy": "scipy", "numba": "numba", "gmsh": "gmsh", "trimesh": "trimesh", "fcl": "python-fcl",
    "networkx": "networkx", "ribs": "ribs", "qdldl": "qdldl", "shapely": "shapely",
    "meshio": "meshio", "pydantic": "pydantic", "typing_extensions": "typing-extensions", "rich": "rich",
    "matplotlib": "matplotlib", "click": "click",
    "annotated_types": "annotated-types", "threadpoolctl": "threadpoolctl", "ipctk": "ipctk",
}

#: linear solvers: module (or library, without a module) -> (distribution, what it is, how to get it)
SOLVERS = {
    "scipy": ("scipy", "SuperLU, always there", ""),
    "qdldl": ("qdldl", "sparse LDL, the default", "pip install qdldl"),
    "mkl": ("mkl", "MKL's Pardiso, the fastest", "pip install 'finqd[fast]'"),
}


@dataclass(frozen=True)
class Finding:
    """One line of the report. Only ``missing`` makes the machine unfit."""

    subject: str
    status: Literal["ok", "optional", "missing"]
    detail: str


def require_gmsh() -> Any:
    """Return the module ``gmsh``. Raises ``MissingLibraryError`` naming what to install where it does not load."""
    try:
        return import_module("gmsh")
    except ImportError as error:
        raise MissingLibraryError(
            "the Python package gmsh is not installed; install it with: pip install gmsh"
        ) from error
    except OSError as error:  # the wheel is there, but the dynamic linker does not find what it links to
        raise MissingLibraryError(
            f"gmsh does not load ({' '.join(str(error).split())}); on Debian or Ubuntu install what it links to with: "
            f"apt-get install {GMSH_DEBIAN_PACKAGES}"
        ) from error


def examine() -> list[Finding]:
    """Return every finding about this machine: Python, libraries, linear solvers, processor, memory, disk."""
    return [
        _python(sys.version_info[:3]),
        *(_library(module, distribution) for module, distribution in LIBRARIES.items()),
        *(_solver(module) for module in SOLVERS),
        Finding("processor", "ok", f"{_cores()} cores to use, {platform.machine()}"),
        _memory(),
        _kernel_cache(),
        _cache(),
        _bundled_files(),
    ]


def fit(findings: list[Finding]) -> bool:
    """Return whether nothing is missing."""
    return all(finding.status != "missing" for finding in findings)


def _python(running: tuple[int, ...]) -> Finding:
    text = ".".join(map(str, running))
    if running < (3, 11):
        return Finding("Python", "missing", f"{text}; finqd needs 3.11 or later")
    return Finding("Python", "ok", text)


def _library(module: str, distribution: str) -> Finding:
    try:
        require_gmsh() if module == "gmsh" else import_module(module)
    except MissingLibraryError as error:
        return Finding(module, "missing", str(error))
    except (ImportError, OSError) as error:
        line = " ".join(str(error).split())
        return Finding(module, "missing", f"does not import ({line}); install it with: pip install {distribution}")
    return Finding(module, "ok", _version(distribution))


def _solver(module: str) -> Finding:
    distribution, what, how = SOLVERS[module]
    subject = f"solver {module}"
    try:
        if module != "mkl":
            import_module(module)
        elif "pardiso" not in import_module("finqd.mechanics.linear_backends").available_backends():
            raise ImportError("no MKL library here")
    except (ImportError, OSError):
        return Finding(subject, "optional", f"{what}; not here, {how}" if how else f"{what}; not here")
    return Finding(subject, "ok", f"{what}; {_version(distribution)}")


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "version unknown"


def _cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _memory() -> Finding:
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    except (AttributeError, ValueError, OSError):
        return Finding("memory", "optional", "this system does not say; an evaluation needs about 1 GiB a job")
    status: Literal["ok", "optional"] = "ok" if total >= 2.0 else "optional"
    return Finding("memory", status, f"{total:.1f} GiB; an evaluation needs about 1 GiB a job")


def _kernel_cache() -> Finding:
    """Look for a folder in which compiled kernels can stay."""
    from finqd.mechanics.compiled import kernel_folder, kernel_places

    folder = kernel_folder()
    if folder is not None:
        return Finding("kernel cache", "ok", f"{folder.parent} is writable: kernels compile once")
    return Finding("kernel cache", "missing", f"{kernel_places()[-1]} is not writable, so kernels would compile in "
                   "every process; set NUMBA_CACHE_DIR")


def _cache() -> Finding:
    """Look for the folder in which meshes, distance fields and resting poses are kept."""
    from finqd.cache import cache_folder, usable

    folder = cache_folder()
    if folder is None:
        return Finding("cache", "optional", "switched off (FINQD_CACHE_DIR): meshes and fields are made in each run")
    if usable(folder):
        return Finding("cache", "ok", f"{folder}: meshes, distance fields and resting poses are made once")
    return Finding("cache", "optional", f"{folder} is not writable: meshes and distance fields are made in each run; "
                   "FINQD_CACHE_DIR names another folder")


def _bundled_files() -> Finding:
    from finqd.data import bundled_names, designs_folder, objects_folder
    from finqd.errors import FinqdError

    try:
        objects, designs = bundled_names(objects_folder()), bundled_names(designs_folder())
    except FinqdError as error:
        return Finding("bundled files", "missing", str(error))
    status: Literal["ok", "missing"] = "ok" if objects and designs else "missing"
    return Finding("bundled files", status, f"{len(objects)} objects, {len(designs)} designs")
