"""Meshers that misbehave, importable by name as the meshing process needs them."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

from finqd.mesh import Mesh
from finqd.mesh_shapes import box_mesh
from finqd.solid import Solid


@dataclass(frozen=True)
class Hanging:
    """Never returns."""

    def mesh(self, solid: Solid) -> Mesh:
        while True:
            time.sleep(1.0)


@dataclass(frozen=True)
class Crashing:
    """Takes the process with it."""

    def mesh(self, solid: Solid) -> Mesh:
        os._exit(7)


@dataclass(frozen=True)
class Confused:
    """Raises what no mesher should raise."""

    def mesh(self, solid: Solid) -> Mesh:
        print("a mesher may print")
        raise ZeroDivisionError("of no use\nto anyone")


@dataclass(frozen=True)
class Box:
    """Prints, and returns a box that tells which process made it."""

    size: float = 1.0

    def mesh(self, solid: Solid) -> Mesh:
        print("a mesher may print", flush=True)
        mesh = box_mesh((self.size,) * 3, (1, 1, 1))
        return mesh.with_sets({"made_by": [os.getpid()]}, {})
