"""Files for ParaView, read back with meshio."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest

from finqd.errors import InputError
from finqd.mechanics.rotation_kernels import rotation_matrix
from finqd.mesh import Mesh
from finqd.mesh_shapes import box_mesh
from finqd.record import write_paraview
from finqd.trajectory import Trajectory

TETRAHEDRON = (
    np.array([(0, 0, 0), (0.01, 0, 0), (0, 0.01, 0), (0, 0, 0.01)], dtype=float),
    np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]),
)
KINDS = ("hex8", "wedge6", "tet4", "tet10", "hex20")


def scene(frames: int = 3) -> tuple[Trajectory, list[Mesh]]:
    """A body of each element type, all sheared and stretched in time, and a tetrahedron that turns and falls."""
    meshes = [box_mesh((0.02, 0.01, 0.01), (2, 1, 1), kind) for kind in KINDS]
    meshes = [Mesh(mesh.vertices + (0, 0.02 * i, 0), mesh.blocks) for i, mesh in enumerate(meshes)]
    rest = np.concatenate([mesh.vertices for mesh in meshes])
    times = 0.1 * np.arange(frames)
    shear = np.array([[1.0, 0.0, 0.3], [0.0, 1.0, 0.0], [0.0, 0.2, 1.0]]) - np.eye(3)
    return Trajectory(
        status="ok",
        times=times,
        recorded_times=times,
        soft_positions=np.stack([rest + t * rest @ shear.T for t in times]),
        rigid_positions=np.stack([[(0.0, 0.0, -t)] for t in times]),
        rigid_rotations=np.stack([[rotation_matrix(np.array([0.0, 0.0, t]))] for t in times]),
    ), meshes


def listed(path: Path) -> list[dict[str, str]]:
    return [entry.attrib for entry in ElementTree.parse(path).getroot().iter("DataSet")]


def test_every_frame_is_listed_with_its_time_and_a_relative_name(tmp_path):
    trajectory, meshes = scene()
    path = write_paraview(tmp_path / "out" / "run", trajectory, meshes, [TETRAHEDRON])
    entries = listed(path)
    assert [float(e["timestep"]) for e in entries] == [t for t in trajectory.recorded_times for _ in range(2)]
    for entry in entries:
        assert not Path(entry["file"]).is_absolute() and (path.parent / entry["file"]).is_file()
    assert not list(tmp_path.rglob("*.part*"))
    moved = path.parent.rename(tmp_path / "elsewhere")
    assert all((moved / entry["file"]).is_file() for entry in listed(moved / path.name))


def test_soft_bodies_come_back_with_all_element_types(tmp_path):
    trajectory, meshes = scene()
    path = write_paraview(tmp_path, trajectory, meshes, [TETRAHEDRON])
    names = [e["file"] for e in listed(path) if e["part"] == "0"]
    rest = np.concatenate([mesh.vertices for mesh in meshes])
    for frame, name in enumerate(names):
        back = meshio.read(tmp_path / name)
        np.testing.assert_array_equal(back.points, trajectory.soft_positions[frame])
        np.testing.assert_allclose(back.point_data["displacement"], back.points - rest, rtol=1e-6, atol=1e-10)
        assert [block.type for block in back.cells] == ["hexahedron", "wedge", "tetra", "tetra10", "hexahedron20"]
        assert [set(body) for body in back.cell_data["body"]] == [{0}, {1}, {2}, {3}, {4}]
        first = np.cumsum([0, *(mesh.n_vertices for mesh in meshes)])
        for block, mesh, start in zip(back.cells, meshes, first[:-1], strict=True):
            (nodes,) = mesh.blocks.values()
            np.testing.assert_array_equal(np.sort(block.data, axis=1), np.sort(nodes + start, axis=1))
    speed = back.point_data["velocity"]
    expected = (trajectory.soft_positions[2] - trajectory.soft_positions[1]) / 0.1
    np.testing.assert_allclose(speed, expected, rtol=1e-6, atol=1e-9)
    assert np.abs(speed).max() > 1e-3


def test_wedges_have_the_orientation_of_vtk(tmp_path):
    """VTK: the first triangle's right-hand normal points away from the second; gmsh and `Mesh` the other way."""
    trajectory, meshes = scene()
    write_paraview(tmp_path, trajectory, meshes, [TETRAHEDRON])
    back = meshio.read(tmp_path / "frames" / "soft_00000.vtu")
    corners = back.points[back.cells_dict["wedge"]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(np.einsum("ei,ei->e", normal, corners[:, 3] - corners[:, 0]) < 0.0)


def test_rigid_surfaces_are_where_their_pose_says(tmp_path):
    trajectory, meshes = scene()
    write_paraview(tmp_path, trajectory, meshes, [TETRAHEDRON])
    back = meshio.read(tmp_path / "frames" / "rigid_00002.vtu")
    turn = np.array([[np.cos(0.2), -np.sin(0.2), 0], [np.sin(0.2), np.cos(0.2), 0], [0, 0, 1]])
    np.testing.assert_allclose(back.points, TETRAHEDRON[0] @ turn.T + (0, 0, -0.2), atol=1e-15)
    np.testing.assert_array_equal(back.cells_dict["triangle"], TETRAHEDRON[1])


def test_a_scene_of_rigid_bodies_alone_has_no_soft_files(tmp_path):
    trajectory, _ = scene()
    alone = Trajectory(
        status="ok",
        times=trajectory.times,
        recorded_times=trajectory.times,
        soft_positions=np.zeros((3, 0, 3)),
        rigid_positions=trajectory.rigid_positions,
        rigid_rotations=trajectory.rigid_rotations,
    )
    path = write_paraview(tmp_path, alone, [], [TETRAHEDRON])
    assert [e["part"] for e in listed(path)] == ["1", "1", "1"]


def test_what_does_not_fit_is_refused(tmp_path):
    trajectory, meshes = scene()
    with pytest.raises(InputError, match="record=True"):
        write_paraview(tmp_path, Trajectory(status="ok"), [], [])
    with pytest.raises(InputError, match="vertices"):
        write_paraview(tmp_path, trajectory, meshes[:-1], [TETRAHEDRON])
    with pytest.raises(InputError, match="0 surfaces do not fit 1 rigid"):
        write_paraview(tmp_path, trajectory, meshes, [])
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="cannot be written"):
        write_paraview(tmp_path / "file", trajectory, meshes, [TETRAHEDRON])
