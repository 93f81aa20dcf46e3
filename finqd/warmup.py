"""Compiles the kernels that evaluations use, ahead of time, by small scenes that go the same way as a grasp.

No list of signatures is kept anywhere: what a grasp would compile, a few steps of soft blocks that push a box over the
floor compile too, through mesher, elasticity, contact and stepper of a preset.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from finqd import registry
from finqd.data import designs_folder
from finqd.design import Design
from finqd.errors import InputError
from finqd.mechanics.compiled import kernel_counts, kernel_folder, kernel_places, kernels
from finqd.mesh import Mesh
from finqd.meshing import mesh_solid
from finqd.objects import load_object
from finqd.presets import DEFAULT, apply_preset
from finqd.scene import Motion, Scene, Shift
from finqd.simulate import simulate
from finqd.solid import Prism
from finqd.units import MM, MS

KINDS = ("elasticity", "contact", "stepper")  # of plugins that have kernels
BLOCK = np.array([8.0, 8.0, 8.0]) * MM
BOX_MM = 12.0
NEAR = 0.2 * MM  # between what is to touch: the first step goes through the air, as that of a grasp
STROKE = 0.4 * MM
STEP = 2.0 * MS
SHORT_STEP = 0.1 * STEP  # for other plugins than the preset's: explicit steppers divide it by hundreds
SMOOTH, ROUGH = 10, 2  # steps of the motion: as small as those of a grasp, and too large for single precision
LIMIT_S = 10.0  # for the scene with another plugin than the preset's, which may not be to its liking


@dataclass(frozen=True, kw_only=True)
class Warmed:
    """What became of a family of kernels: compiled and loaded ones, one a signature, and seconds; where they are."""

    family: str
    compiled: int
    loaded: int
    seconds: float
    folder: Path

    def __str__(self) -> str:
        return f"{self.family}: {self.compiled} compiled, {self.loaded} loaded, {self.seconds:.1f} s"


def warm_up(
    preset: str = DEFAULT, *, everything: bool = False, report: Callable[[str], object] = lambda line: None
) -> list[Warmed]:
    """Compile or load the kernels of evaluations with ``preset``, in this process, and return what they took.

    everything: those of all other plugins that are installed too. report: called with a line for every kernel that has
    been compiled, and for every family. Raises InputError for an unknown preset, and where nothing is compiled, or not
    to stay: then there is no use in it.
    """
    design = apply_preset(Design.from_json(designs_folder() / "benchmark.json"), preset)
    folder = _folder()
    done = []
    for family, chosen in _families(design, everything=everything):
        begun, before = clock.perf_counter(), kernel_counts()
        with _told(report):
            if chosen is design:
                _press(chosen, SMOOTH)
                _press(chosen, ROUGH)
            else:
                _press_often(chosen)
        compiled, loaded = np.subtract(kernel_counts(), before).tolist()
        seconds = clock.perf_counter() - begun
        done.append(Warmed(family=family, compiled=compiled, loaded=loaded, seconds=seconds, folder=folder))
        report(str(done[-1]))
    return done


def _folder() -> Path:
    import numba

    if numba.config.DISABLE_JIT:
        raise InputError("is set, so that no kernel is compiled", "NUMBA_DISABLE_JIT")
    folder = kernel_folder()
    if folder is None:
        raise InputError(
            "is not writable, so that every process compiles its kernels for itself; set NUMBA_CACHE_DIR to a folder "
            "that is", str(kernel_places()[-1]),
        )
    return folder


@contextmanager
def _told(report: Callable[[str], object]) -> Iterator[None]:
    """Report each kernel that is compiled meanwhile."""
    from numba.core import event

    class Listener(event.Listener):
        """Numba's events come in pairs; kernels that others call end before these."""

        def on_start(self, event: Any) -> None:
            began.append(clock.perf_counter())

        def on_end(self, event: Any) -> None:
            seconds, kernel = clock.perf_counter() - began.pop(), event.data["dispatcher"]
            if any(kernel is one for one in kernels()):
                module = kernel.py_func.__module__.rpartition(".")[2]
                report(f"compiled {module}.{kernel.py_func.__name__} in {seconds:.1f} s")

    began: list[float] = []
    with event.install_listener("numba:compile", Listener()):
        yield


def _families(design: Design, *, everything: bool) -> Iterator[tuple[str, Design]]:
    """Yield the names of families of kernels, each with a design that uses it."""
    chosen = {kind: design.spec(kind)["name"] for kind in KINDS}
    yield ", ".join(chosen.values()), design
    if not everything:
        return
    yield "damping", design.with_overrides({"material.rayleigh_stiffness_ms": 1.0, "material.rayleigh_mass_per_s": 1.0})
    for kind in KINDS:
        for name in registry.names(kind):
            if name != chosen[kind]:
                yield f"{kind} {name}", Design({**design.to_dict(), kind: name})


def _press_often(design: Design) -> None:
    """Go through the motion again and again, each time as far as it gets, until no kernel is new."""
    known = None
    while known != kernel_counts():
        known = kernel_counts()
        _press(design, SMOOTH, step=SHORT_STEP, limit=LIMIT_S)


def _press(design: Design, steps: int, *, step: float = STEP, limit: float = math.inf) -> None:
    """Go through the motion of `_scene`, and a quarter as many steps after it; how that ends does not matter."""
    simulate(
        _scene(design, step * steps), duration=step * (steps + -(-steps // 4)), time_step=step,
        stepper=design.plugin("stepper"), contact=design.plugin("contact"),
        longest_step=design.protocol.calm_step_factor, wall_clock_limit=limit,
    )


def _scene(design: Design, duration: float) -> Scene:
    """Return a box on the floor, pressed from two sides by driven blocks, one of which rises to a third."""
    scene, block = Scene(), mesh_solid(design.plugin("mesher"), _block())
    reach = 0.5 * (BOX_MM * MM + BLOCK[0])
    for name, side in (("left", -1.0), ("right", 1.0)):
        mesh = _upright(block, (side * (reach + NEAR), 0.0, NEAR))
        body = scene.add_soft(mesh, design.material, elasticity=design.plugin("elasticity"), name=name)
        outside = side * mesh.vertices[:, 0] > reach + 0.4 * BLOCK[0]
        body.drive(outside, Motion(path=Shift(vector=(-side * STROKE, 0.0, STROKE)), duration=duration))
    above = _upright(block, (reach + NEAR, 0.0, BLOCK[2] + 2.0 * NEAR))
    held = scene.add_soft(above, design.material, elasticity=design.plugin("elasticity"), name="above")
    held.fix(above.vertices[:, 2] > 1.9 * BLOCK[2])
    box = load_object({"name": "box", "shape": {"kind": "box", "size_mm": [BOX_MM] * 3}, "mass_g": 5.0})
    scene.add_rigid(box, position=(0.0, 0.0, box.rest_height), rotation=box.rest_rotation)
    scene.add_plane(name="floor")
    return scene


def _block() -> Prism:
    """Return a block as if it were a finger: its base at y = 0, its contact face towards -x."""
    x, y = 0.5 * BLOCK[0], BLOCK[1]
    corners = np.array([[-x, 0.0], [x, 0.0], [x, y], [-x, y]])
    return Prism(outer=corners, holes=(), thickness=BLOCK[2], contact_line=corners[[0, 3]])


def _upright(mesh: Mesh, place: Sequence[float]) -> Mesh:
    """Return a block's mesh with its base at ``place`` [m], and its length along z."""
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    pose[:3, 3] = place
    return mesh.transformed(pose)
