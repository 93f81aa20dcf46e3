"""The ten objects against closed forms, resting poses, sharp features, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from finqd.errors import InputError
from finqd.mechanics.distance_kernels import signed_distance, signed_distances
from finqd.mechanics.mass_properties import surface_moments
from finqd.object_rest import rest_pose, support_facets
from finqd.objects import load_object, object_names

MM3 = 1e-9
DENSITY = 1170.0


def frustum(r1, r2, h):
    """Volume, and height of the centroid above the r1 end."""
    volume = np.pi * h / 3 * (r1**2 + r1 * r2 + r2**2)
    return volume, h / 4 * (r1**2 + 2 * r1 * r2 + 3 * r2**2) / (r1**2 + r1 * r2 + r2**2)


FLAN_CENTRE = frustum(25, 17, 28)[1]
DIAMOND_CENTRE = (14 * 14 / 4 - 26 * 26 / 4) / 40  # above the equator
#: volume [mm^3] and height of the centre of mass at rest [mm], by hand
CLOSED_FORMS = {
    "sphere": (4 / 3 * np.pi * 20**3, 20.0),
    "cube": (35.0**3, 17.5),
    "cylinder": (np.pi * 18**2 * 45, 22.5),
    "disk": (np.pi * 25**2 * 12, 6.0),
    "triangle": (50**3 / (6 * 2**0.5), 50 * (2 / 3) ** 0.5 / 4),
    "flan": (frustum(25, 17, 28)[0], FLAN_CENTRE),
    "diablo": (2 * frustum(22, 8, 25)[0], 25.0),
    "hourglass": (np.pi * 40 * (13**2 + 7**2 / 2), 20.0),
    "diamond": (np.pi * 22**2 * 40 / 3, (22 * 26 + 22 * DIAMOND_CENTRE) / np.hypot(22, 26)),
    "pasta": (np.pi * (15**2 - 10**2) * 45, 15.0),
}


@pytest.fixture(scope="module")
def ten():
    return {name: load_object(name) for name in object_names()}


def write(folder, mesh, name):
    path = folder / name
    mesh.export(path)
    return path


def test_the_ten_are_there():
    assert set(object_names()) == set(CLOSED_FORMS)


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_mass_and_resting_height_match_closed_forms(ten, name):
    volume, height = CLOSED_FORMS[name]
    item = ten[name]
    assert item.mass == pytest.approx(DENSITY * volume * MM3, rel=5e-4)  # the hourglass is a polygon of revolution
    assert item.volume == pytest.approx(volume * MM3, rel=5e-4)
    assert item.rest_height == pytest.approx(height * 1e-3, rel=1e-3)  # rims that lie are polygons of 96 sides
    assert 0.017 <= item.mass <= 0.054


def test_inertia_matches_closed_forms(ten):
    m = {name: item.mass for name, item in ten.items()}
    expected = {
        "sphere": [0.4 * m["sphere"] * 0.02**2] * 3,
        "cube": [m["cube"] * 0.035**2 / 6] * 3,
        "triangle": [m["triangle"] * 0.05**2 / 20] * 3,
        "cylinder": [m["cylinder"] * (3 * 0.018**2 + 0.045**2) / 12] * 2 + [m["cylinder"] * 0.018**2 / 2],
        "disk": [m["disk"] * (3 * 0.025**2 + 0.012**2) / 12] * 2 + [m["disk"] * 0.025**2 / 2],
        "pasta": [m["pasta"] * (3 * 0.000325 + 0.045**2) / 12] * 2 + [m["pasta"] * 0.000325 / 2],
    }
    for name, diagonal in expected.items():
        np.testing.assert_allclose(ten[name].inertia, np.diag(diagonal), rtol=1e-9, atol=1e-9 * max(diagonal))


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_surface_volume_distance_and_mass_describe_the_same_solid(ten, name):
    """The tessellation within its chord error, the distance field by integration over random points."""
    item = ten[name]
    moments = surface_moments(item.vertices, item.triangles)
    assert moments.volume == pytest.approx(item.volume, rel=3e-3)
    assert np.abs(moments.centre).max() < 1e-6
    np.testing.assert_allclose(item.mass / moments.volume * moments.inertia, item.inertia, rtol=6e-3, atol=1e-9)
    points = np.random.default_rng(0).uniform(-1, 1, (200_000, 3)) * item.bounding_radius
    distances, normals = np.empty(len(points)), np.empty_like(points)
    signed_distances(item.distance, points, distances, normals)
    share = item.volume / (2 * item.bounding_radius) ** 3
    assert np.mean(distances < 0) == pytest.approx(share, abs=4 * np.sqrt(share / len(points)))
    signed_distances(item.distance, item.vertices, distances[: len(item.vertices)], normals[: len(item.vertices)])
    assert np.abs(distances[: len(item.vertices)]).max() < 1e-9


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_at_rest_nothing_is_below_the_floor_and_the_centre_is_over_the_base(ten, name):
    item = ten[name]
    np.testing.assert_allclose(item.rest_rotation @ item.rest_rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(item.rest_rotation) == pytest.approx(1.0)
    if item.ball_radius:
        assert item.rest_height == item.ball_radius == 0.02 and len(item.support_points) == 0
        return
    assert 4 <= len(item.support_points) <= 200
    world = item.support_points @ item.rest_rotation.T + [0, 0, item.rest_height]
    assert abs(world[:, 2].min()) < 1e-12
    surface = item.vertices @ item.rest_rotation.T + [0, 0, item.rest_height]
    assert surface[:, 2].min() > -2e-5  # between the samples of a rim that lies, less than 0.02 mm
    base = ConvexHull(world[world[:, 2] < 1e-7][:, :2])
    assert base.equations[:, 2].max() < -2e-4  # the centre of mass is above the base, 0.2 mm within it or more
    assert abs(signed_distance(item.distance, *item.support_points[0])[0]) < 1e-12


def test_the_ten_stand_or_lie_as_decided(ten):
    axis = {name: abs(item.rest_rotation[2, 2]) for name, item in ten.items()}
    for name in ("cylinder", "disk", "flan", "diablo", "hourglass", "cube", "triangle"):
        np.testing.assert_allclose(ten[name].rest_rotation, np.eye(3), atol=1e-9)
    assert axis["pasta"] == pytest.approx(0.0, abs=1e-9)
    # set down on its lower tip, the diamond topples by the slope of the lower cone
    assert axis["diamond"] == pytest.approx(np.cos(np.arctan2(26, 22)), abs=2e-3)
    assert "toppled by 49.8 degrees" in ten["diamond"].assumptions[0]


def test_toppling_takes_the_nearest_stable_face():
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [0.02, 0.01, 0.03]
    normals, heights, margins = support_facets(corners)
    assert len(normals) == 6 and sorted(np.round(heights, 12)) == [0.01, 0.01, 0.02, 0.02, 0.03, 0.03]
    np.testing.assert_allclose(sorted(margins)[:2], np.arctan2(0.01, 0.03))
    for degrees, height in ((3.0, 0.03), (-40.0, 0.03), (50.0, 0.01), (85.0, 0.01)):
        c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
        rotation, found, tilt = rest_pose(corners, np.array([[1, 0, 0], [0, c, -s], [0, s, c]]))
        assert found == pytest.approx(height)
        assert np.degrees(tilt) == pytest.approx(min(abs(degrees), 90 - abs(degrees)))
        assert (corners @ rotation.T)[:, 2].min() == pytest.approx(-height)


def test_a_pose_asked_for_must_rest():
    prism = {"kind": "revolution", "profile_mm": [[0, 0], [20, 0], [0, 30]]}
    upright = load_object({"shape": prism, "mass_g": 10, "rest_rotation_deg": [0, 0, 0]})
    assert upright.rest_height == pytest.approx(0.0075)
    with pytest.raises(InputError, match=r"rest_rotation_deg: does not rest in this pose, it topples by 56 degrees"):
        load_object({"shape": prism, "mass_g": 10, "rest_rotation_deg": [180, 0, 0]})


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off"])
def test_surface_files_are_the_solid_they_describe(tmp_path, suffix):
    import trimesh

    mesh = trimesh.creation.box([30, 20, 40])
    mesh.apply_translation([100, 50, -20])
    item = load_object(str(write(tmp_path, mesh, f"my part.{suffix}")), mass_g=40)
    assert item.name == "my_part"
    assert item.mass == pytest.approx(0.040)
    np.testing.assert_allclose(item.inertia, 0.04 / 12 * 1e-6 * np.diag([2000, 2500, 1300]), rtol=1e-5, atol=1e-14)
    assert item.rest_height == pytest.approx(0.020, rel=1e-6)
    assert "lengths are taken in mm" in item.assumptions[0]
    unweighed = load_object(tmp_path / f"my part.{suffix}")
    assert unweighed.mass == pytest.approx(DENSITY * 24e-6, rel=1e-6)
    assert "no mass given" in unweighed.assumptions[1]


def test_file_in_json_with_unit_and_scale(tmp_path):
    import trimesh

    write(tmp_path, trimesh.creation.box([0.03, 0.02, 0.04]), "block.stl")
    shape = {"kind": "file", "path": "block.stl", "unit": "m", "scale": 0.5}
    (tmp_path / "block.json").write_text(json.dumps({"shape": shape, "density_kg_m3": 1000}))
    item = load_object(tmp_path / "block.json")
    assert (item.name, item.mass) == ("block", pytest.approx(0.003, rel=1e-6))


def test_inverted_and_unevenly_wound_files_are_mended_and_a_cavity_stays_hollow(tmp_path):
    import trimesh

    box = trimesh.creation.box([30, 20, 40])
    inverted = box.copy()
    inverted.invert()
    assert load_object(write(tmp_path, inverted, "inverted.stl")).volume == pytest.approx(24e-6)
    faces = box.faces.copy()
    faces[3] = faces[3][::-1]
    uneven = trimesh.Trimesh(box.vertices, faces, process=False)
    item = load_object(write(tmp_path, uneven, "uneven.off"))
    assert item.volume == pytest.approx(24e-6)
    assert signed_distance(item.distance, 0.0, 0.0, 0.0)[0] == pytest.approx(-0.01)
    void = box.copy().apply_scale(0.5)
    void.invert()
    hollow = load_object(write(tmp_path, trimesh.util.concatenate([box, void]), "hollow.stl"))
    assert hollow.volume == pytest.approx(21e-6)
    assert signed_distance(hollow.distance, 0.0, 0.0, 0.0)[0] == pytest.approx(0.005)


def refused_meshes():
    import trimesh

    box = trimesh.creation.box([30, 20, 40])
    shifted = [box.copy().apply_translation(by) for by in ([50, 0, 0], [30, 20, 0], [30, 20, 40])]
    join = trimesh.util.concatenate
    return {
        "leaky": (trimesh.Trimesh(box.vertices, box.faces[1:]), "is not watertight: 3 edges"),
        "sheet": (trimesh.Trimesh([[0, 0, 0], [9, 0, 0], [0, 9, 0]], [[0, 1, 2]]), "needs at least 4"),
        "two": (join([box, shifted[0]]), "2 separate bodies"),
        "nested": (join([box, box.copy().apply_scale(0.5)]), "2 separate bodies"),
        "at_an_edge": (join([box, shifted[1]]), "is not manifold: 1 edges"),
        "at_a_vertex": (join([box, shifted[2]]), "touches itself in 1 vertices"),
        "flat": (box.copy().apply_scale([1, 1, 1e-7]), "next to no volume"),
        "metres": (box.copy().apply_scale(0.001), "must be 1 to 500 mm across, not 0.04 mm .*unit"),
        "huge": (box.copy().apply_scale(100), "must be 1 to 500 mm across, not 4000 mm"),
    }


@pytest.mark.parametrize("name", refused_meshes())
def test_surfaces_that_enclose_no_object_are_refused_in_one_sentence(tmp_path, name):
    mesh, words = refused_meshes()[name]
    path = write(tmp_path, mesh, f"{name}.ply")
    with pytest.raises(InputError, match=words) as caught:
        load_object(path, mass_g=10)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("empty.stl", b"", "is empty"),
        ("text.stl", b"solid a\nendsolid a\n", "holds no triangles|cannot be read as STL"),
        ("short.stl", b"\0" * 80 + b"\x0c\0\0\0" + b"\0" * 120, "cannot be read as STL|holds no triangles"),
        ("text.ply", b"hello", "cannot be read as PLY"),
        ("wrong.obj", b"v 1 2 3\nv 1 2 4\nf 1 2 9\n", "cannot be read as OBJ"),
        ("short.off", b"OFF\n3 1 0\n0 0 0\n1 0", "cannot be read as OFF"),
        ("part.step", b"ISO-10303-21;", "no object has this name"),
        ("bad.json", b"{", "is not valid JSON"),
    ],
)
def test_files_that_are_no_surface_are_refused_in_one_sentence(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        load_object(str(tmp_path / name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("spere", "did you mean sphere"),
        ("", "known: cube, cylinder"),
        ("none.stl", "there is no such file"),
        ("none.json", "there is no such file"),
        (7, "must be an object's name or file, not 7"),
        ({}, "shape: is missing"),
        ({"shape": {"kind": "sphere", "diameter_mm": 40}}, "give density_kg_m3 or mass_g, not neither"),
        ({"shape": {}, "mass_g": 1}, "kind: is missing"),
        ({"shape": {"kind": "cone"}, "mass_g": 1}, "must be one of sphere, box"),
        ({"shape": {"kind": "sphere"}, "mass_g": 1}, "diameter_mm: is missing"),
        ({"shape": {"kind": "sphere", "diameter_mm": "40"}, "mass_g": 1}, 'number from 0.1 to 500, not "40"'),
        ({"shape": {"kind": "sphere", "diameter_mm": 0.5}, "mass_g": 1}, "must be 1 to 500 mm across"),
        ({"shape": {"kind": "sphere", "diameter": 40}, "mass_g": 1}, "did you mean diameter_mm"),
        ({"shape": {"kind": "sphere", "diameter_mm": 40}, "mass_g": 1, "density_kg_m3": 1}, "not both"),
        ({"shape": {"kind": "sphere", "diameter_mm": 40}, "mass_g": -1}, "mass_g: must be a number from 0.01"),
        ({"shape": {"kind": "sphere", "diameter_mm": 40}, "mass_g": float("nan")}, "mass_g: must be a number"),
        ({"shape": {"kind": "sphere", "diameter_mm": 40}, "mass_g": 1, "name": "a/b"}, "name: must be a text"),
        ({"shape": {"kind": "sphere", "diameter_mm": 40}, "mass_g": 1, "mas_g": 1}, "did you mean mass_g"),
        ({"shape": {"kind": "box", "size_mm": [1, 2]}, "mass_g": 1}, "size_mm: must be a list of 3 numbers"),
        ({"shape": {"kind": "box", "size_mm": [1, 2, 900]}, "mass_g": 1}, r"size_mm\[2\]: must be a number from"),
        ({"shape": {"kind": "revolution", "profile_mm": [[0, 0], [1, 0]]}, "mass_g": 1}, "3 to 2000 points"),
        ({"shape": {"kind": "revolution", "profile_mm": [[0, 0], [-9, 0], [0, 9]]}, "mass_g": 1}, r"\[1\]\[0\]: must"),
        (
            {"shape": {"kind": "revolution", "profile_mm": [[0, 0], [9, 9], [9, 0], [0, 9]]}, "mass_g": 1},
            "does not cross itself",
        ),
        ({"shape": {"kind": "revolution", "profile_mm": [[0, 0], [9, -9], [9, 9]]}, "mass_g": 1}, "in a single point"),
        ({"shape": {"kind": "revolution", "profile_mm": [[0, 0], [9, 0], [9, 0], [0, 9]]}, "mass_g": 1}, "repeats"),
        (
            {"shape": {"kind": "polyhedron", "vertices_mm": [[0, 0, 0], [9, 0, 0], [0, 9, 0], [9, 9, 0]]}, "mass_g": 1},
            "in one plane",
        ),
        ({"shape": {"kind": "file", "path": "a.stl", "unit": "ft"}, "mass_g": 1}, 'unit: must be one of "mm", "cm"'),
        ({"shape": {"kind": "box", "size_mm": [9, 9, 9]}, "mass_g": 1, "rest_rotation_deg": [0, 0]}, "3 angles"),
    ],
)
def test_wrong_input_is_one_sentence_with_its_place(source, words):
    with pytest.raises(InputError, match=words) as caught:
        load_object(source)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_mass_can_be_given_from_outside():
    assert load_object("sphere", mass_g=50).mass == pytest.approx(0.05)
    with pytest.raises(InputError, match="mass_g"):
        load_object("sphere", mass_g=0)


def test_an_object_is_the_same_each_time():
    for name in ("diamond", "pasta"):
        a, b = load_object(name), load_object(name)
        np.testing.assert_array_equal(a.rest_rotation, b.rest_rotation)
        np.testing.assert_array_equal(a.support_points, b.support_points)


@pytest.mark.slow
def test_a_million_triangles(tmp_path):
    import trimesh

    mesh = trimesh.creation.icosphere(8, 20).apply_scale([1.0, 1.2, 0.7])
    item = load_object(write(tmp_path, mesh, "pebble.stl"), mass_g=30)
    assert len(item.triangles) == 1_310_720
    assert item.volume == pytest.approx(4 / 3 * np.pi * 20**3 * 1.2 * 0.7 * MM3, rel=1e-4)
    assert 4 <= len(item.support_points) <= 400
    assert signed_distance(item.distance, 0.03, 0.0, 0.0)[0] == pytest.approx(0.01, abs=1e-7)
