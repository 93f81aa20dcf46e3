"""The exported gripper: one closed part, with the volume of its pieces, in STL and STEP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from finqd.data import designs_folder
from finqd.design import Design
from finqd.errors import InputError
from finqd.export import FINGERS, export_gripper, mount_plate, pad
from finqd.placement import placement
from finqd.solid import Prism, Solid, SurfaceSolid

gmsh = pytest.importorskip("gmsh", exc_type=ImportError)


@pytest.fixture(scope="module")
def design() -> Design:
    return Design.from_json(designs_folder() / "benchmark.json")


@pytest.fixture(scope="module")
def folder(design: Design, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("export")
    assert export_gripper(design, target) == [target / "gripper.stl", target / "gripper.step"]
    return target


def expected_volume_mm3(design: Design) -> float:
    """Fingers, and the union of plate and pads in the plane (shapely) times the plate's thickness."""
    from shapely import Polygon, box, union_all
    from shapely.affinity import affine_transform

    geometry, shapes, fingers = design.plugin("geometry"), [Polygon(mount_plate(design.spacing))], 0.0
    for i in range(FINGERS):
        solid = geometry.build(design.finger_si(i))
        fingers += solid.volume
        low, high = pad(solid, design.spacing)
        m = placement(i, FINGERS, design.spacing)
        shapes.append(affine_transform(box(*low, *high), [m[0, 0], m[0, 2], m[1, 0], m[1, 2], m[0, 3], m[1, 3]]))
    return (fingers + 2.75e-3 * union_all(shapes).area) * 1e9


def step_volumes(path: Path) -> list[float]:
    from finqd.gmsh_session import gmsh_session

    with gmsh_session() as session:
        session.model.occ.importShapes(str(path))
        session.model.occ.synchronize()
        return [session.model.occ.getMass(3, tag) for _, tag in session.model.getEntities(3)]


def test_stl_is_one_closed_part_of_the_right_volume(design: Design, folder: Path) -> None:
    import trimesh

    part = trimesh.load(folder / "gripper.stl")
    assert part.is_watertight and part.is_winding_consistent and part.body_count == 1
    assert part.volume == pytest.approx(expected_volume_mm3(design), rel=1e-6)
    assert part.bounds[0][2] == pytest.approx(-94.5, abs=1e-4)
    assert part.bounds[1] == pytest.approx([77.5, part.bounds[1][1], 2.75], abs=1e-4)


def test_step_read_again_is_one_solid_of_the_same_volume(design: Design, folder: Path) -> None:
    volumes = step_volumes(folder / "gripper.step")
    assert volumes == [pytest.approx(expected_volume_mm3(design), rel=1e-9)]


def test_three_different_fingers_and_a_single_file(tmp_path: Path) -> None:
    design = Design.from_unit_vector(np.random.default_rng(5).random(28))
    assert export_gripper(design, tmp_path / "deep" / "one.stp") == [tmp_path / "deep" / "one.stp"]
    assert step_volumes(tmp_path / "deep" / "one.stp") == [pytest.approx(expected_volume_mm3(design), rel=1e-9)]
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["one.stp"]


def test_nothing_is_printed_while_writing(design: Design, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    export_gripper(design, tmp_path / "quiet.step")
    assert capfd.readouterr().out == ""


def test_other_suffixes_are_refused(design: Design, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--out: must end in .stl, .step, .stp, or be a folder, not 'gripper.obj'"):
        export_gripper(design, tmp_path / "gripper.obj")


class _Facets:
    """A finger type whose solid is a bare surface."""

    def build(self, finger: dict[str, float]) -> Solid:
        ring = np.array([(0.0, 0.0), (0.03, 0.0), (0.01, 0.09)])
        return SurfaceSolid(*Prism(ring, (), 0.02).surface())


def test_a_surface_solid_is_exported_too(design: Design, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plugin = Design.plugin
    monkeypatch.setattr(Design, "plugin", lambda self, kind: _Facets() if kind == "geometry" else plugin(self, kind))
    export_gripper(design, tmp_path / "facets.step")
    assert step_volumes(tmp_path / "facets.step") == [pytest.approx(expected_volume_mm3(design), rel=1e-9)]


@pytest.mark.parametrize("index", range(FINGERS))
def test_placement_is_a_rotation_that_points_the_finger_down_and_out(index: int) -> None:
    matrix = placement(index, FINGERS, 0.04, 0.1)
    rotation = matrix[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) == pytest.approx(1.0)
    assert np.allclose(rotation[:, 1], [0, 0, -1])
    assert matrix[2, 3] == 0.1 and np.hypot(*matrix[:2, 3]) == pytest.approx(0.04)
    assert rotation[:, 0] @ matrix[:3, 3] == pytest.approx(0.04)
