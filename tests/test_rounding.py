"""Bodies with rounded edges: against closed forms, and derivatives of their distance against differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from shapely.geometry import Point, Polygon

from finqd.mechanics.distance import revolution_field
from finqd.mechanics.distance_kernels import distance_curvature, signed_distance
from finqd.mechanics.rounding import rounded_field
from finqd.object_shapes import solid_in_surface
from finqd.objects import load_object, object_names
from finqd.units import MM

RADIUS = 0.5 * MM
NOTCHED = {  # a bar with an L for its section: one inner edge
    "kind": "polyhedron",
    "vertices_mm": [[x, y, z] for z in (-10, 10) for x, y in ((0, 0), (20, 0), (20, 8), (8, 8), (8, 20), (0, 20))],
    "faces": [[0, 2, 1], [0, 3, 2], [0, 5, 3], [5, 4, 3], [6, 7, 8], [6, 8, 9], [6, 9, 11], [11, 9, 10]]
    + [[i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6] for i in range(6)],
}
SPOOL = {"kind": "revolution", "profile_mm": [[0, -9], [12, -9], [12, -5], [5, 0], [12, 5], [12, 9], [0, 9]]}


def made(shape: Any) -> Any:
    return load_object(shape if isinstance(shape, str) else {"shape": shape, "mass_g": 10})


def near_surface(item: Any, field: Any, count: int, depth: float) -> list[np.ndarray]:
    """Return random points within ``depth`` of a field's surface."""
    rng, found = np.random.default_rng(11), []
    while len(found) < count:
        point = rng.uniform(-1.1, 1.1, 3) * item.bounding_radius
        d, *n = signed_distance(field, *point)
        point = point - (d - depth * rng.uniform(-1, 1)) * np.array(n)
        if abs(signed_distance(field, *point)[0]) <= depth:
            found.append(point)
    return found


def test_a_rounded_box_is_the_closed_form() -> None:
    item = made({"kind": "box", "size_mm": [20, 16, 12]})
    field = rounded_field(item, RADIUS)
    assert field.radius == RADIUS
    core = np.array([10, 8, 6]) * MM - RADIUS
    for point in near_surface(item, field, 300, 0.99 * RADIUS):
        over = np.maximum(np.abs(point) - core, 0.0)
        assert signed_distance(field, *point)[0] == pytest.approx(np.linalg.norm(over) - RADIUS, abs=1e-12)


def test_a_rounded_lathe_is_its_profile_opened_and_closed() -> None:
    item = made(SPOOL)
    field = rounded_field(item, RADIUS)
    profile = Polygon(np.concatenate([item.profile, (item.profile * [-1, 1])[::-1]])).buffer(0)
    smooth = profile.buffer(RADIUS, quad_segs=256).buffer(-2 * RADIUS, quad_segs=256).buffer(RADIUS, quad_segs=256)
    for point in near_surface(item, field, 300, 0.9 * RADIUS):
        d, *_ = signed_distance(field, *point)
        flat = Point(np.hypot(*point[:2]), point[2])
        sign = -1.0 if smooth.contains(flat) else 1.0
        assert d == pytest.approx(sign * smooth.exterior.distance(flat), abs=1e-4 * MM)


@pytest.mark.parametrize("shape", [*object_names(), NOTCHED, SPOOL], ids=str)
def test_flat_sides_stay_and_edges_go_back(shape: Any) -> None:
    item = made(shape)
    field = rounded_field(item, RADIUS)
    middles = item.vertices[item.triangles].mean(axis=1)
    for point in middles[:: max(len(middles) // 50, 1)]:
        sharp = signed_distance(item.distance, *point)[0]
        back = signed_distance(field, *point)[0] - sharp
        assert -0.15 * RADIUS < back < 5.0 * RADIUS  # an inner edge of a lathe is filled a little
    if item.ball_radius:
        assert field is item.distance
    else:
        assert max(signed_distance(field, *corner)[0] for corner in item.vertices) > 0.1 * RADIUS


@pytest.mark.parametrize("shape", [*object_names(), SPOOL], ids=str)
def test_gradient_and_curvature_are_those_of_the_distance(shape: Any) -> None:
    item = made(shape)
    field, h, off = rounded_field(item, RADIUS), 1e-8, []
    for point in near_surface(item, field, 120, 0.8 * RADIUS):
        d, *n = signed_distance(field, *point)
        found = np.empty((3, 3))
        distance_curvature(field, d, *point, np.array(n), found)
        both = [[np.array(signed_distance(field, *(point + s * h * e))) for s in (1, -1)] for e in np.eye(3)]
        change = np.array([(plus - minus) / (2 * h) for plus, minus in both])
        np.testing.assert_allclose(change[:, 0], n, atol=1e-5)
        off.append(np.abs(change[:, 1:] - found).max() * RADIUS)
    assert np.sort(off)[-3] < 1e-3  # all but where a face of the smaller body ends


def largest_turn(field: Any, start: np.ndarray, *, depth: float, step: float, count: int) -> float:
    """Return by how much the normal turns at most [rad] from step to step, on a way ``depth`` under the surface."""
    point, last, largest = start, None, 0.0
    for _ in range(count):
        d, nx, _, nz = signed_distance(field, point[0], 0.0, point[1])
        point = point - (d + depth) * np.array([nx, nz])
        normal = np.array(signed_distance(field, point[0], 0.0, point[1]))[[1, 3]]
        if point[0] < 2 * step:  # the axis
            break
        if last is not None:
            largest = max(largest, abs(last[0] * normal[1] - last[1] * normal[0]))
        last, point = normal, point + step * np.array([-normal[1], normal[0]])
    return largest


@pytest.mark.parametrize("shape", ["diablo", "hourglass", SPOOL], ids=str)
def test_the_normal_turns_steadily_along_a_lathe(shape: Any) -> None:
    """Where inner arcs had flat sides, it jumped: between two of them a contact point found no equilibrium."""
    item, depth, step = made(shape), 0.01 * MM, 0.002 * MM
    field = rounded_field(item, RADIUS)
    corner = item.profile[np.argmin(item.profile[:, 1] - 1e-3 * item.profile[:, 0])]
    count = int(2.0 * np.ptp(item.profile, axis=0).sum() / step)
    tightest = step / (RADIUS - depth)
    assert 0.9 * tightest < largest_turn(field, corner, depth=depth, step=step, count=count) < 1.1 * tightest
    angle = np.linspace(0.0, np.pi / 2, 65)
    flat_sides = 0.01 * np.column_stack([1.0 - np.sin(angle), 1.0 - np.cos(angle)])
    twin = revolution_field(np.concatenate([[[0.0, -0.01], [0.02, -0.01], [0.02, 0.0]], flat_sides]))
    assert largest_turn(twin, np.array([0.011, 0.0]), depth=-depth, step=step, count=5000) > 5 * tightest


def test_inside_an_edge_the_rounded_normal_turns_where_the_sharp_one_jumps() -> None:
    item = made({"kind": "box", "size_mm": [20, 16, 12]})
    edge = np.array([10, 8, 0]) * MM
    for depth in (0.35, 0.6):
        middle = edge - depth * MM * np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
        across = 1e-3 * MM * np.array([1.0, -1.0, 0.0])
        turns = []
        for field in (item.distance, rounded_field(item, RADIUS)):
            one, other = (np.array(signed_distance(field, *(middle + s * across))[1:]) for s in (1, -1))
            turns.append(np.linalg.norm(one - other))
        assert turns[0] > 1.4 and turns[1] < 0.03


def test_a_body_too_fine_for_the_radius_is_rounded_by_less() -> None:
    thin = made({"kind": "box", "size_mm": [20, 16, 0.8]})
    assert rounded_field(thin, RADIUS).radius == RADIUS / 2
    disk = made({"kind": "revolution", "profile_mm": [[0, -0.2], [10, -0.2], [10, 0.2], [0, 0.2]]})
    assert rounded_field(disk, RADIUS).radius == RADIUS / 4
    assert rounded_field(thin, 0.0) is thin.distance
    hair = made({"kind": "box", "size_mm": [20, 0.1, 0.1]})
    assert 0.0 < rounded_field(hair, RADIUS).radius <= RADIUS / 16


def test_an_inner_edge_of_a_polyhedron_stays_where_it_is() -> None:
    item = made(NOTCHED)
    field = rounded_field(item, RADIUS)
    inner = np.array([8.0, 8.0, 0.0]) * MM + item.vertices[0] - np.array([0.0, 0.0, -10.0]) * MM
    assert field.radius == RADIUS
    assert abs(signed_distance(field, *inner)[0]) < 1e-9


def test_sharp_tips_are_rounded_by_less_rather_than_not_at_all() -> None:
    corners = [[x, y, z] for y in (-10, 10) for x, z in ((0, 0), (20, 2), (20, -2))]
    wedge = made({"kind": "polyhedron", "vertices_mm": corners})
    knife = made({"kind": "revolution", "profile_mm": [[0, -1], [15, 0], [0, 1]]})
    for item in (wedge, knife):
        field = rounded_field(item, RADIUS)
        assert 0.0 < field.radius < RADIUS
        assert max(signed_distance(field, *corner)[0] for corner in item.vertices) < 5 * RADIUS


def test_a_triangle_without_area_changes_nothing() -> None:
    corners = np.array([[x, y, z] for x in (-10, 10) for y in (-8, 8) for z in (-6, 6)]) * MM
    hull = trimesh.convex.convex_hull(corners)
    a, b = next(
        (i, j) for i, j in hull.edges_unique
        if np.count_nonzero(np.abs(hull.vertices[i] - hull.vertices[j]) > 1e-9) == 1
    )
    vertices = np.vstack([hull.vertices, hull.vertices[[a, b]].mean(axis=0)])
    triangles, middle, cut = [], len(hull.vertices), False
    for face in hull.faces.tolist():
        k = next((k for k in range(3) if {face[k], face[(k + 1) % 3]} == {a, b}), None)
        if k is None or cut:
            triangles.append(face)
            continue
        one, two, third = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
        triangles += [[one, middle, third], [middle, two, third], [one, two, middle]]
        cut = True
    item = solid_in_surface(vertices, np.array(triangles))
    field = rounded_field(item, RADIUS)
    assert field.radius == RADIUS
    plain = rounded_field(made({"kind": "box", "size_mm": [20, 16, 12]}), RADIUS)
    for point in near_surface(made({"kind": "box", "size_mm": [20, 16, 12]}), plain, 100, 0.8 * RADIUS):
        assert signed_distance(field, *point)[0] == pytest.approx(signed_distance(plain, *point)[0], abs=1e-9)


def test_a_smaller_surface_that_would_cross_itself_is_refused() -> None:
    """Two V-shaped cavities, whose ridges pass each other crosswise 0.4 mm apart; no vertex is near."""
    def cavity(along: int, tip: float, back: float) -> trimesh.Trimesh:
        points = np.zeros((6, 3))
        for k, end in enumerate((-7.0, 7.0)):
            points[3 * k : 3 * k + 3, along] = end
            points[3 * k : 3 * k + 3, 2] = (tip, back, back)
            points[3 * k : 3 * k + 3, 1 - along] = (0.0, 2.0, -2.0)
        mesh = trimesh.convex.convex_hull(points)
        mesh.invert()
        return mesh

    body = trimesh.util.concatenate([trimesh.creation.box((20, 20, 20)), cavity(0, -0.2, -4), cavity(1, 0.2, 4)])
    item = solid_in_surface(body.vertices * MM, body.faces)
    field = rounded_field(item, RADIUS)
    assert 0.0 < field.radius < RADIUS
    rng = np.random.default_rng(3)
    for point in rng.uniform(-9, 9, (3000, 3)) * MM:
        sharp = signed_distance(item.distance, *point)[0]
        assert signed_distance(field, *point)[0] >= sharp - 0.5 * field.radius


def test_a_groove_is_not_filled() -> None:
    grooved = made({
        "kind": "revolution",
        "profile_mm": [[0, -9], [12, -9], [12, -0.4], [5, -0.4], [5, 0.4], [12, 0.4], [12, 9], [0, 9]],
    })
    field = rounded_field(grooved, RADIUS)
    assert signed_distance(field, 9 * MM, 0.0, 0.0)[0] == pytest.approx(0.4 * MM, rel=1e-6)
    assert signed_distance(field, 5.1 * MM, 0.0, 0.0)[0] > 0.0


def test_an_edge_between_triangles_of_one_plane_bends_nothing() -> None:
    box, found = made({"kind": "box", "size_mm": [20, 20, 12]}), np.empty((3, 3))
    rod = made({"kind": "revolution", "profile_mm": [[0, -6], [10, -6], [10, 6], [0, 6]]})
    for item in (box, rod):
        field = rounded_field(item, RADIUS)
        for point in ((0.0, 0.0, 5.9 * MM), (3 * MM, 3 * MM, 5.9 * MM), (3 * MM, -3 * MM, 5.9 * MM)):
            d, *n = signed_distance(field, *point)
            distance_curvature(field, d, *point, np.array(n), found)
            assert np.array_equal(found, np.zeros((3, 3)))
