"""What a result was made with: versions of libraries, and the state of finqd's own source."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

LIBRARIES = ("finqd", "numpy", "scipy", "numba", "gmsh", "qdldl", "mkl")


@cache
def versions() -> Mapping[str, str]:
    """Return the versions of finqd and of the libraries that can change a result, and ``source``: `source_digest`."""
    return {**installed(LIBRARIES), "source": source_digest()}


def installed(names: Iterable[str]) -> dict[str, str]:
    """Return the versions of those distributions that are installed."""
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def source_digest() -> str:
    """Return the first digits of a digest of finqd's own source, which changes more often than its version."""
    package = Path(__file__).parent
    text = b"".join(path.read_bytes() for path in sorted(package.rglob("*.py")))
    return hashlib.sha256(text).hexdigest()[:12]
