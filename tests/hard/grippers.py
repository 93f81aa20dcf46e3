"""Grippers that families of hard cases share: the benchmark one on a coarse mesh, and what it does to things."""

from __future__ import annotations

from functools import cache
from typing import Any

from finqd.data import designs_folder
from finqd.design import Design
from finqd.evaluate import finger_meshes
from finqd.grasp import GraspTask, grasp_scene
from finqd.mesh import Mesh
from finqd.meshing import mesh_solid
from finqd.objects import load_object
from finqd.presets import apply_preset
from finqd.scene import Scene

SHUT = {"actuation.angle_deg": 45.0, "actuation.force_limit_N": 1e6}  # as far as drives go, without a force limit
FAR = {"shape": {"kind": "sphere", "diameter_mm": 5}, "mass_g": 1}  # nothing that fingers would reach

_TETRAHEDRON = {
    "kind": "polyhedron", "vertices_mm": [[0, 0, 40], [30, 0, 0], [-15, 26, 0], [-15, -26, 0]],
    "faces": [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]],
}  # fmt: skip
#: what is squeezed between the fingers: shape, mass [g], and how it lies
THINGS: dict[str, dict[str, Any]] = {
    "sphere": {"shape": {"kind": "sphere", "diameter_mm": 40}, "mass_g": 39},
    "cube edge": {"shape": {"kind": "box", "size_mm": [35, 35, 35]}, "mass_g": 50},
    "apex": {"shape": _TETRAHEDRON, "mass_g": 20},
    "disk on edge": {
        "shape": {"kind": "revolution", "profile_mm": [[0, -20], [1.5, -20], [1.5, 20], [0, 20]]}, "mass_g": 6,
    },
    "thin disk": {"shape": {"kind": "revolution", "profile_mm": [[0, -1], [25, -1], [25, 1], [0, 1]]}, "mass_g": 5},
    "wire": {"shape": {"kind": "box", "size_mm": [1, 1, 60]}, "mass_g": 1},
    "cube, far too big": {"shape": {"kind": "box", "size_mm": [55, 55, 30]}, "mass_g": 100},
}  # fmt: skip


@cache
def design(**finger: float) -> Design:
    """Return the benchmark design, some parameters of its fingers replaced."""
    given = Design.from_json(designs_folder() / "benchmark.json")
    return given.with_overrides({f"finger.{key}": value for key, value in finger.items()})


def finger_mesh(chosen: Design) -> Mesh:
    """Return the mesh of a design's first finger, in the finger's frame."""
    solid = chosen.plugin("geometry").build(chosen.finger_si(0))
    return mesh_solid(chosen.plugin("mesher"), solid)


def gripper(what: dict[str, Any] | None, *, given: Design | None = None, **overrides: Any) -> Scene:
    """Return the scene of a grasp on a coarse mesh; overrides: by path, with ``__`` for a dot."""
    changed = {key.replace("__", "."): value for key, value in overrides.items()}
    chosen = apply_preset(given or design(), "draft", overrides=changed)
    solids = [chosen.plugin("geometry").build(chosen.finger_si(i)) for i in range(len(chosen.fingers))]
    thing = load_object({"name": "thing", **(FAR if what is None else what)})
    scene = grasp_scene(GraspTask(design=chosen, meshes=finger_meshes(chosen, solids), grasped=thing))
    if what is None:
        scene.rigid_bodies.clear()
    return scene
