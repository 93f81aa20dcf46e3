"""Recorded trajectories as files for ParaView: one ``.pvd`` that lists a ``.vtu`` file a frame and kind of body."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from finqd.errors import InputError
from finqd.mesh import Mesh
from finqd.trajectory import Surface, Trajectory, replacing

#: VTK looks at a wedge's first triangle from the other side than `Mesh` does (VTK file formats, "VTK_WEDGE")
_VTK_ORDER = {"wedge6": [0, 2, 1, 3, 5, 4]}
_CELLS = {"hex8": "hexahedron", "hex20": "hexahedron20", "wedge6": "wedge", "tet4": "tetra", "tet10": "tetra10"}


def write_paraview(
    directory: str | os.PathLike[str], trajectory: Trajectory, meshes: Sequence[Mesh], surfaces: Sequence[Surface] = ()
) -> Path:
    """Write all recorded frames to ``directory`` and return the ``.pvd`` file to open.

    meshes: of the soft bodies, at rest, in the scene's order; surfaces: of the rigid bodies, in their body frames
    Soft bodies get the point data ``displacement`` [m] from rest and ``velocity`` [m/s], the mean since the frame
    before, which is what implicit Euler calls the velocity, and the cell data ``body``. Each file is whole or not
    there; the ``.pvd`` comes last and names the others relative to itself. Raises InputError if nothing was recorded,
    if ``meshes`` are not those of the trajectory, or if the directory cannot be written.
    """
    trajectory.recorded_at(0.0)
    if trajectory.soft_positions.shape[1] != sum(mesh.n_vertices for mesh in meshes):
        raise InputError("the meshes do not have as many vertices as the trajectory's soft bodies")
    if len(surfaces) != trajectory.rigid_positions.shape[1]:
        raise InputError(f"{len(surfaces)} surfaces do not fit {trajectory.rigid_positions.shape[1]} rigid bodies")
    directory = Path(directory)
    listed: list[tuple[float, int, str]] = []
    try:
        (directory / "frames").mkdir(parents=True, exist_ok=True)
        for frame, time in enumerate(trajectory.recorded_times):
            parts = {"soft": _soft_mesh(trajectory, meshes, frame), "rigid": _rigid_mesh(trajectory, surfaces, time)}
            for part, (kind, mesh) in enumerate(parts.items()):
                if mesh is not None:
                    name = f"frames/{kind}_{frame:05d}.vtu"
                    with replacing(directory / name) as temporary:
                        mesh.write(temporary, file_format="vtu")
                    listed.append((float(time), part, name))
        target = directory / "trajectory.pvd"
        with replacing(target) as temporary:
            temporary.write_text(_collection(listed), encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", str(directory)) from error
    return target


def _soft_mesh(trajectory: Trajectory, meshes: Sequence[Mesh], frame: int) -> Any:
    import meshio

    if not meshes:
        return None
    positions, times = trajectory.soft_positions, trajectory.recorded_times
    velocity = np.zeros_like(positions[frame])
    if frame:
        velocity = (positions[frame] - positions[frame - 1]) / (times[frame] - times[frame - 1])
    cells, bodies, first = [], [], 0
    for body, mesh in enumerate(meshes):
        for kind, nodes in mesh.blocks.items():
            order = _VTK_ORDER.get(kind, slice(None))
            cells.append((_CELLS[kind], (first + nodes[:, order]).astype(np.int32)))
            bodies.append(np.full(len(nodes), body, dtype=np.int32))
        first += mesh.n_vertices
    rest = np.concatenate([mesh.vertices for mesh in meshes])
    return meshio.Mesh(
        positions[frame],
        cells,
        point_data={
            "displacement": (positions[frame] - rest).astype(np.float32),
            "velocity": velocity.astype(np.float32),
        },
        cell_data={"body": bodies},
    )


def _rigid_mesh(trajectory: Trajectory, surfaces: Sequence[Surface], time: float) -> Any:
    import meshio

    if not surfaces:
        return None
    vertices = trajectory.placed(surfaces, time)
    starts = np.cumsum([0, *(len(points) for points in vertices[:-1])])
    cells = [("triangle", (start + triangles).astype(np.int32)) for start, (_, triangles) in zip(starts, surfaces)]
    bodies = [np.full(len(triangles), body, dtype=np.int32) for body, (_, triangles) in enumerate(surfaces)]
    return meshio.Mesh(np.concatenate(vertices), cells, cell_data={"body": bodies})


def _collection(listed: Sequence[tuple[float, int, str]]) -> str:
    """Return the text of a ``.pvd`` file for (time, part, file name)."""
    rows = "".join(
        f'    <DataSet timestep="{time!r}" part="{part}" file={quoteattr(name)}/>\n' for time, part, name in listed
    )
    return (
        '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">\n'
        f"  <Collection>\n{rows}  </Collection>\n</VTKFile>\n"
    )
