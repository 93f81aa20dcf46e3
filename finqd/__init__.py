"""finqd: design, simulate and search soft grippers. The way the data goes, in ten lines:

A design names a finger type, a mesher and more, each a plugin with options; units are in the keys of its file.

>>> import finqd
>>> from finqd.data import designs_folder
>>> design = finqd.Design.from_json(designs_folder() / "benchmark.json")
>>> design.fingers[0]["length_mm"], design.finger_si(0)["length"]
(94.5, 0.0945)

The geometry plugin builds a finger's solid, the mesher fills it with elements; inside, everything is SI.

>>> solid = design.plugin("geometry").build(design.finger_si(0))
>>> mesh = design.plugin("mesher").mesh(solid)
>>> f"three fingers have {3e9 * solid.volume:.0f} mm^3", abs(mesh.volume / solid.volume - 1) < 1e-9
('three fingers have 45427 mm^3', True)

A scene holds soft bodies, rigid bodies and planes; a simulation leaves a trajectory behind. Here a finger, clamped at
its base and pushed at its tip with 1 N along x:

>>> from finqd.simulate import simulate
>>> scene = finqd.Scene(gravity=(0, 0, 0))
>>> finger = scene.add_soft(mesh, design.material)
>>> finger.fix("base")
>>> tip = mesh.vertices[:, 1] > 0.094
>>> finger.load(tip, (1, 0, 0))
>>> trajectory = simulate(scene, duration=0.2, time_step=0.02, record=True)
>>> trajectory.status, bool(trajectory.soft_positions[-1][tip, 0].mean() > mesh.vertices[tip, 0].mean())
('ok', True)

All of that for every object, and the score, is one call (`finqd.evaluate`), and one command, ``finqd evaluate``::

    from finqd.evaluate import evaluate
    print(evaluate(design, objects=["sphere", "cube"], preset="draft").fitness)

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
