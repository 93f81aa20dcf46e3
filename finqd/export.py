"""The gripper as one printable part: three fingers and their mount, as STL (triangles) or STEP (CAD), in mm.

The mount is the plate of the volume feature, over the triangle between the finger bases, and three pads. The plate
alone would touch each finger in one point, the middle of its base's inner edge; a pad of the plate's thickness covers
each base and reaches inwards to where the plate is as wide as the finger. The pads are in the part, but in no feature.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.errors import FinqdError, InputError
from finqd.gmsh_session import gmsh_session
from finqd.placement import placement
from finqd.solid import Prism, Solid, ring_area
from finqd.units import MM, si_factor

if TYPE_CHECKING:
    from finqd.design import Design

FINGERS = 3
_SUFFIXES = (".stl", ".step", ".stp")
_PLATE_MM = 2.75  # where the design measures no volume, and so names no plate


def export_gripper(design: Design, out: str | os.PathLike[str]) -> list[Path]:
    """Write the gripper and return the paths written: ``out`` is a .stl or .step file, or a folder to hold both.

    The gripper's axis is z, the fingers hang below z = 0. Raises ``InputError`` (unknown suffix, inconsistent values)
    and ``FinqdError`` if the parts cannot be joined.
    """
    paths = _targets(Path(out))
    geometry = design.plugin("geometry")
    solids = [geometry.build(design.finger_si(i)) for i in range(FINGERS)]
    with gmsh_session() as gmsh:
        try:
            _join(gmsh, _parts(gmsh, solids, design.spacing, _plate(design)))
            for path in paths:
                _write(gmsh, path)
        except FinqdError:
            raise
        except Exception as error:  # gmsh raises bare exceptions
            raise FinqdError(f"the gripper could not be exported: {' '.join(str(error).split())}") from error
    return paths


def gripper_parts(design: Design) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return the closed surfaces that the export joins, as name, vertices (n, 3) [m] and outward triangles (m, 3).

    They touch along whole faces, and pads and plate overlap. Raises ``InputError`` for inconsistent values.
    """
    geometry, plate = design.plugin("geometry"), _plate(design)
    solids = [geometry.build(design.finger_si(i)) for i in range(FINGERS)]
    ring = mount_plate(design.spacing)
    parts = [("mount", *_raised(Prism(ring, (), plate).surface(), 0.5 * plate))]
    for i, solid in enumerate(solids):
        matrix, surface = placement(i, FINGERS, design.spacing), solid.surface()
        low, high = _pad(surface[0], design.spacing)
        cushion = _box(np.array([low[0], -plate, low[1]]), np.array([high[0], 0.0, high[1]]))
        for name, (vertices, triangles) in (("finger", surface), ("mount", cushion)):
            parts.append((name, vertices @ matrix[:3, :3].T + matrix[:3, 3], triangles))
    return parts


def _box(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of a box; bit k of a vertex's number says whether it lies high along axis k."""
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    sides = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))
    return np.where(bits, high, low), np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])


def _raised(surface: tuple[np.ndarray, np.ndarray], height: float) -> tuple[np.ndarray, np.ndarray]:
    return surface[0] + np.array([0.0, 0.0, height]), surface[1]


def _plate(design: Design) -> float:
    """Return the thickness of the mount's plate [m]."""
    plate = next((f.plate_mm for f in design.plugin("features") if hasattr(f, "plate_mm")), _PLATE_MM)
    return plate * si_factor("plate_mm")


def mount_plate(spacing: float) -> np.ndarray:
    """Return the corners of the plate over the finger bases, shape (3, 2) [m]: circumradius ``spacing``."""
    azimuths = 2.0 * np.pi * np.arange(FINGERS) / FINGERS
    return spacing * np.column_stack([np.cos(azimuths), np.sin(azimuths)])


def pad(solid: Solid, spacing: float) -> np.ndarray:
    """Return the outline in the finger's x-z plane, (min, max) x (x, z) [m], of the pad on a finger's base."""
    return _pad(solid.surface()[0], spacing)


def _pad(vertices: np.ndarray, spacing: float) -> np.ndarray:
    base = vertices[np.abs(vertices[:, 1]) < 1e-8]
    low, high = base[:, [0, 2]].min(axis=0), base[:, [0, 2]].max(axis=0)
    low[0] -= min(0.5 * np.sqrt(3.0) * (high[1] - low[1]), spacing)
    return np.array([low, high])


def _targets(out: Path) -> list[Path]:
    if out.suffix.lower() in _SUFFIXES:
        out.parent.mkdir(parents=True, exist_ok=True)
        return [out]
    if out.suffix and not out.is_dir():
        raise InputError(f"must end in {', '.join(_SUFFIXES)}, or be a folder, not {out.name!r}", where="--out")
    out.mkdir(parents=True, exist_ok=True)
    return [out / "gripper.stl", out / "gripper.step"]


def _parts(gmsh: Any, solids: Sequence[Solid], spacing: float, plate: float) -> list[tuple[int, int]]:
    """Add fingers, plate and pads in mm; return their volumes."""
    occ = gmsh.model.occ
    parts = [_extruded(occ, [mount_plate(spacing)], 0.0, plate)]
    for i, solid in enumerate(solids):
        low, high = pad(solid, spacing)
        cushion = occ.addBox(*_mm([low[0], -plate, low[1], high[0] - low[0], plate, high[1] - low[1]]))
        finger = _prism(occ, solid) if isinstance(solid, Prism) else _facets(occ, *solid.surface())
        matrix = placement(i, FINGERS, spacing)
        matrix[:3, 3] /= MM
        occ.affineTransform([(3, finger), (3, cushion)], matrix.ravel().tolist())
        parts += [finger, cushion]
    return [(3, part) for part in parts]


def _mm(values: Any) -> list[float]:
    return (np.asarray(values, dtype=float) / MM).ravel().tolist()


def _prism(occ: Any, solid: Prism) -> int:
    outer = solid.outer if ring_area(solid.outer) > 0 else solid.outer[::-1]
    return _extruded(occ, [outer, *solid.holes], -0.5 * solid.thickness, solid.thickness)


def _extruded(occ: Any, rings: Sequence[np.ndarray], z: float, height: float) -> int:
    loops = []
    for ring in rings:
        points = [occ.addPoint(*_mm([x, y, z])) for x, y in np.asarray(ring)]
        loops.append(occ.addCurveLoop([occ.addLine(a, b) for a, b in zip(points, [*points[1:], points[0]])]))
    swept = occ.extrude([(2, occ.addPlaneSurface(loops))], 0.0, 0.0, *_mm([height]))
    return next(tag for dimension, tag in swept if dimension == 3)


def _facets(occ: Any, vertices: np.ndarray, triangles: np.ndarray) -> int:
    points = [occ.addPoint(*_mm(vertex)) for vertex in vertices]
    lines: dict[tuple[int, int], int] = {}
    faces = []
    for triangle in np.asarray(triangles).tolist():
        loop = []
        for a, b in zip(triangle, [*triangle[1:], triangle[0]]):
            if (b, a) not in lines and (a, b) not in lines:
                lines[a, b] = occ.addLine(points[a], points[b])
            loop.append(lines[a, b] if (a, b) in lines else -lines[b, a])
        faces.append(occ.addPlaneSurface([occ.addCurveLoop(loop)]))
    return occ.addVolume([occ.addSurfaceLoop(faces, sewing=True)])


def _join(gmsh: Any, parts: list[tuple[int, int]]) -> None:
    """Make one volume of all parts."""
    occ = gmsh.model.occ
    joined, _ = occ.fuse(parts[:1], parts[1:])
    occ.synchronize()
    if len([tag for dimension, tag in joined if dimension == 3]) != 1:
        raise FinqdError(f"the fingers and their mount do not join into one part but into {len(joined)}")


@contextmanager
def _silent() -> Iterator[None]:
    """Send what C++ libraries print to nowhere: Open CASCADE greets on the standard output."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def _write(gmsh: Any, path: Path) -> None:
    """Write the model, whole or not at all."""
    if path.suffix.lower() == ".stl":
        gmsh.option.setNumber("Mesh.Binary", 1)
        gmsh.option.setNumber("Mesh.MeshSizeMin", 1e6)  # as few triangles as the flat faces need
        gmsh.option.setNumber("Mesh.MeshSizeMax", 1e6)
        gmsh.model.mesh.generate(2)
    unfinished = path.with_name(f".{path.stem}.unfinished{path.suffix}")
    try:
        with _silent():
            gmsh.write(str(unfinished))
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
