"""Laws of meshes: volume, closed boundary, outward faces, quality, for every element type."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.mesh import Mesh
from finqd.mesh_reference import FACES, reference
from finqd.mesh_shapes import box_mesh

KINDS = ("hex8", "hex20", "wedge6", "tet4", "tet10")
SIZE, DIVISIONS = (0.3, 0.2, 0.1), (3, 2, 4)


def linear_triangles(mesh: Mesh) -> np.ndarray:
    """Split the corner polygons of all boundary faces into triangles."""
    found = []
    for kind, faces in mesh.faces.items():
        found.append(faces[:, :3])
        if kind.startswith("quad"):
            found.append(faces[:, [0, 2, 3]])
    return np.concatenate(found)


@pytest.mark.parametrize("kind", KINDS)
def test_box_has_its_volume_and_good_elements(kind: str) -> None:
    mesh = box_mesh(SIZE, DIVISIONS, kind)
    assert mesh.volume == pytest.approx(0.006, rel=1e-13)
    quality = mesh.quality()
    assert quality.inverted == 0
    assert quality.scaled_jacobian_min > (0.99 if kind.startswith("hex") else 0.15)
    assert list(quality.elements) == [kind]
    assert mesh.n_elements == 24 * {"hex": 1, "wed": 2, "tet": 6}[kind[:3]]


@pytest.mark.parametrize("kind", KINDS)
def test_distortion_keeps_volume_and_moves_inner_nodes_only(kind: str) -> None:
    plain, mesh = box_mesh(SIZE, (3, 3, 3), kind), box_mesh(SIZE, (3, 3, 3), kind, distort=0.2, seed=3)
    assert mesh.volume == pytest.approx(0.006, rel=1e-12)
    assert mesh.quality().inverted == 0
    boundary = np.unique(np.concatenate([faces.ravel() for faces in mesh.faces.values()]))
    assert np.array_equal(mesh.vertices[boundary], plain.vertices[boundary])
    assert np.abs(mesh.vertices - plain.vertices).max() > 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_boundary_is_closed_and_points_outwards(kind: str) -> None:
    mesh = box_mesh(SIZE, DIVISIONS, kind)
    a, b, c = np.moveaxis(mesh.vertices[linear_triangles(mesh)], 1, 0)
    areas = 0.5 * np.cross(b - a, c - a)
    assert np.abs(areas.sum(axis=0)).max() < 1e-15
    assert np.sum(areas * (a + b + c) / 3) / 3 == pytest.approx(0.006, rel=1e-12)
    assert np.linalg.norm(areas, axis=1).sum() == pytest.approx(2 * (0.06 + 0.02 + 0.03), rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_plane_sets_hold_their_faces_and_nodes(kind: str) -> None:
    mesh = box_mesh(SIZE, DIVISIONS, kind)
    for name, (axis, value) in {"xmin": (0, 0.0), "ymax": (1, 0.2), "zmax": (2, 0.1)}.items():
        assert np.allclose(mesh.vertices[mesh.node_sets[name], axis], value)
        nodes = np.unique(np.concatenate([mesh.faces[k][i].ravel() for k, i in mesh.face_sets[name].items()]))
        assert np.array_equal(nodes, mesh.node_sets[name])


@pytest.mark.parametrize("kind", KINDS)
def test_rigid_motion_keeps_volume_quality_and_sets(kind: str) -> None:
    mesh = box_mesh(SIZE, DIVISIONS, kind, distort=0.1)
    matrix = np.array([[0, -1, 0, 0.3], [0, 0, -1, -2.0], [1, 0, 0, 0.1], [0, 0, 0, 1.0]])
    moved = mesh.transformed(matrix)
    assert moved.volume == pytest.approx(mesh.volume, rel=1e-12)
    assert moved.quality().scaled_jacobian_min == pytest.approx(mesh.quality().scaled_jacobian_min, rel=1e-9)
    assert np.allclose(moved.vertices[:, 1], -mesh.vertices[:, 2] - 2.0)
    assert np.array_equal(moved.node_sets["xmin"], mesh.node_sets["xmin"])


@pytest.mark.parametrize("kind", KINDS)
def test_shape_functions_sum_to_one_and_quadrature_has_the_reference_volume(kind: str) -> None:
    ref = reference(kind)
    assert np.abs(ref.gradients.sum(axis=1)).max() < 1e-12
    assert ref.weights.sum() == pytest.approx({"hex": 8.0, "wed": 1.0, "tet": 1 / 6}[kind[:3]])
    assert len(FACES[kind]) == {"hex": 6, "wed": 5, "tet": 4}[kind[:3]]


@pytest.mark.parametrize("kind", KINDS)
def test_a_mirrored_mesh_is_found_inverted(kind: str) -> None:
    mesh = box_mesh(SIZE, DIVISIONS, kind)
    mirrored = Mesh(mesh.vertices * [1, 1, -1], mesh.blocks)
    assert mirrored.volume == pytest.approx(-0.006)
    assert mirrored.quality().inverted == mesh.n_elements
    assert mirrored.quality().scaled_jacobian_min < 0


def test_mixed_types_share_their_inner_faces() -> None:
    box = box_mesh((1.0, 1.0, 1.0), (2, 1, 1))
    left, right = box.blocks["hex8"]
    wedges = np.array([right[[0, 1, 2, 4, 5, 6]], right[[0, 2, 3, 4, 6, 7]]])
    mesh = Mesh(box.vertices, {"hex8": left[None], "wedge6": wedges})
    assert mesh.volume == pytest.approx(1.0)
    assert {kind: len(faces) for kind, faces in mesh.faces.items()} == {"quad4": 8, "tri3": 4}
    assert mesh.quality().wedge_share == pytest.approx(2 / 3)


def test_meshio_round_trip_keeps_nodes_and_order(tmp_path) -> None:
    meshio = pytest.importorskip("meshio")
    mesh = box_mesh(SIZE, DIVISIONS, "tet10")
    meshio.write(tmp_path / "box.vtu", mesh.to_meshio())
    back = meshio.read(tmp_path / "box.vtu")
    assert np.array_equal(back.cells_dict["tetra10"], mesh.blocks["tet10"])
    assert np.allclose(back.points, mesh.vertices)


def test_unknown_element_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown element type 'hex9'"):
        box_mesh(SIZE, DIVISIONS, "hex9")
