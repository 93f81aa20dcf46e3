"""finqd: design, simulate and search soft grippers.

Public names load on first use, so that ``import finqd`` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

#: public name -> module that defines it
_HOMES = {
    "Design": "finqd.design",
    "Evaluation": "finqd.evaluate",
    "FinqdError": "finqd.errors",
    "GraspObject": "finqd.objects",
    "InputError": "finqd.errors",
    "Material": "finqd.mechanics.material",
    "Mesh": "finqd.mesh",
    "MeshError": "finqd.errors",
    "MissingLibraryError": "finqd.errors",
    "Parameter": "finqd.contracts",
    "PluginError": "finqd.errors",
    "Prism": "finqd.solid",
    "Scene": "finqd.scene",
    "SurfaceSolid": "finqd.solid",
    "Trajectory": "finqd.trajectory",
}

__version__ = "0.1.0"
__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'finqd' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
