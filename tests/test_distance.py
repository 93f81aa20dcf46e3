"""Signed distance: laws (eikonal, gradient, sign), closed forms, and independent implementations."""

from __future__ import annotations

import numpy as np
import pytest
from numba import config

from finqd.mechanics.distance import (
    revolution_field,
    sphere_field,
    surface_field,
    triangle_neighbours,
    triangle_normals,
)
from finqd.mechanics.distance_kernels import closest_in_leaf, outside_disc, signed_distance, signed_distances
from finqd.object_shapes import convex_hull, turned_surface

N = 200 if config.DISABLE_JIT else 10_000

CYLINDER = np.array([[0.0, -0.02], [0.018, -0.02], [0.018, 0.02], [0.0, 0.02]])
TUBE = np.array([[0.010, -0.02], [0.015, -0.02], [0.015, 0.02], [0.010, 0.02]])
CONE = np.array([[0.0, 0.0], [0.02, 0.0], [0.0, 0.03]])
DIMPLED = np.array([[0.0, -0.01], [0.02, -0.02], [0.02, 0.02], [0.0, 0.005]])  # cones sunk into both ends
DIABLO = np.array([[0.0, -0.025], [0.022, -0.025], [0.008, 0.0], [0.022, 0.025], [0.0, 0.025]])
PROFILES = {"cylinder": CYLINDER, "tube": TUBE, "cone": CONE, "dimpled": DIMPLED, "diablo": DIABLO}
DISHED = np.array([[0.0, -0.02], [0.02, -0.02], [0.02, 0.02], [0.016, 0.02], [0.0, 0.012]])  # a bowl on top
DISH = np.array([0.0, 0.0, 0.0, 0.02, 0.0])  # radius of the bowl


def evaluate(field, points):
    distances, normals = np.empty(len(points)), np.empty((len(points), 3))
    signed_distances(field, points, distances, normals)
    return distances, normals


def cloud(n=N, *, reach=0.035, seed=1):
    return np.random.default_rng(seed).uniform(-reach, reach, (n, 3))


def cube_surface(size=0.04):
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    return convex_hull(corners, "cube")


def tetrahedron_surface():
    return convex_hull(0.02 * np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]), "tetrahedron")


def notched_surface():
    """A block with a slot: both convex and concave edges, and saddle vertices."""
    ring = 0.001 * np.array([[-15, -10], [15, -10], [15, 10], [3, 10], [1, -4], [-6, 10], [-15, 10]])
    n = len(ring)
    vertices = np.concatenate([np.column_stack([ring, np.full(n, z)]) for z in (-0.01, 0.01)])
    caps = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (4, 5, 6), (0, 4, 6)]
    sides = [t for i in range(n) for t in ((i, (i + 1) % n, i + n), ((i + 1) % n, (i + 1) % n + n, i + n))]
    triangles = [(c, b, a) for a, b, c in caps] + [(a + n, b + n, c + n) for a, b, c in caps] + sides
    return vertices, np.array(triangles)


SURFACES = {"cube": cube_surface(), "tetrahedron": tetrahedron_surface(), "notched": notched_surface()}
FIELDS = {
    "sphere": sphere_field(0.02),
    **{name: revolution_field(profile) for name, profile in PROFILES.items()},
    "dished": revolution_field(DISHED, DISH),
    **{f"surface {name}": surface_field(*surface) for name, surface in SURFACES.items()},
    "surface of dimpled": surface_field(*turned_surface(DIMPLED, n_around=24)),
}


def cylinder_distance(points, radius=0.018, half=0.02):
    across = np.column_stack([np.hypot(points[:, 0], points[:, 1]) - radius, np.abs(points[:, 2]) - half])
    return np.linalg.norm(np.maximum(across, 0), axis=1) + np.minimum(across.max(axis=1), 0)


def cube_distance(points, half=0.02):
    across = np.abs(points) - half
    return np.linalg.norm(np.maximum(across, 0), axis=1) + np.minimum(across.max(axis=1), 0)


@pytest.mark.kernel
def test_closed_forms():
    points = cloud()
    distances, normals = evaluate(FIELDS["sphere"], points)
    np.testing.assert_allclose(distances, np.linalg.norm(points, axis=1) - 0.02, atol=1e-16)
    np.testing.assert_allclose(normals, points / np.linalg.norm(points, axis=1)[:, None], atol=1e-15)
    np.testing.assert_allclose(evaluate(FIELDS["cylinder"], points)[0], cylinder_distance(points), atol=1e-16)
    np.testing.assert_allclose(evaluate(FIELDS["surface cube"], points)[0], cube_distance(points), atol=1e-16)


@pytest.mark.kernel
@pytest.mark.parametrize("name", ["cylinder", "cone", "tube"])
def test_polygonal_profiles_inside_a_tube_and_a_cone(name):
    """Signs by an independent membership test."""
    points = cloud(seed=2)
    r, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    inside = {
        "cylinder": (r < 0.018) & (np.abs(z) < 0.02),
        "cone": (z > 0) & (r < 0.02 * (1 - z / 0.03)),
        "tube": (r < 0.015) & (r > 0.010) & (np.abs(z) < 0.02),
    }[name]
    assert 0.01 * len(points) < inside.sum()
    np.testing.assert_array_equal(evaluate(FIELDS[name], points)[0] < 0, inside)


@pytest.mark.kernel
@pytest.mark.parametrize("name", FIELDS)
def test_gradient_has_unit_length_and_leads_to_the_surface(name):
    """|grad d| = 1, and x - d grad d lies on the surface: the two laws that contact relies on."""
    points = cloud(seed=3)
    distances, normals = evaluate(FIELDS[name], points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-14)
    feet = points - distances[:, None] * normals
    np.testing.assert_allclose(evaluate(FIELDS[name], feet)[0], 0.0, atol=1e-14)


@pytest.mark.kernel
@pytest.mark.parametrize("name", FIELDS)
def test_gradient_is_the_derivative(name):
    """Central differences, except next to the medial axis, where d has a kink (a small share of points)."""
    points, step = cloud(min(N, 2000), seed=4), 1e-7
    _, normals = evaluate(FIELDS[name], points)
    numeric = np.empty_like(normals)
    for axis in range(3):
        offset = step * np.eye(3)[axis]
        numeric[:, axis] = evaluate(FIELDS[name], points + offset)[0] - evaluate(FIELDS[name], points - offset)[0]
    error = np.abs(numeric / (2 * step) - normals).max(axis=1)
    assert np.mean(error > 1e-4) < 0.005
    assert np.median(error) < 1e-8


@pytest.mark.kernel
@pytest.mark.parametrize("name", FIELDS)
def test_distance_is_one_lipschitz(name):
    a, b = cloud(seed=5), cloud(seed=6)
    change = np.abs(evaluate(FIELDS[name], a)[0] - evaluate(FIELDS[name], b)[0])
    assert np.all(change <= np.linalg.norm(a - b, axis=1) * (1 + 1e-12))


@pytest.mark.kernel
def test_a_side_bent_inwards_is_an_arc():
    """A bowl of 20 mm: against the circle, and against the same bowl of 4,000 straight sides."""
    (r0, z0), (r1, z1) = DISHED[3], DISHED[4]
    chord = np.hypot(r1 - r0, z1 - z0)
    normal, height = np.array([z1 - z0, r0 - r1]) / chord, np.sqrt(0.02**2 - chord**2 / 4)
    centre = np.array([r0 + r1, z0 + z1]) / 2 + height * normal
    begin, end = (np.arctan2(z - centre[1], r - centre[0]) for r, z in ((r0, z0), (r1, z1)))
    angles = np.linspace(begin, end, 4000)
    arc = centre + 0.02 * np.column_stack([np.cos(angles), np.sin(angles)])
    arc[-1] = DISHED[4]
    straight = revolution_field(np.concatenate([DISHED[:3], arc]))
    points = cloud(min(N, 1000), seed=7)
    distances, normals = evaluate(FIELDS["dished"], points)
    other, turned = evaluate(straight, points)
    np.testing.assert_allclose(distances, other, atol=1e-9)
    assert np.mean(np.abs(normals - turned).max(axis=1) > 1e-3) < 0.01  # all but next to the medial axis
    for share in (0.1, 0.5, 0.9):
        towards = np.array([np.cos(begin + share * (end - begin)), np.sin(begin + share * (end - begin))])
        for depth in (-0.001, 0.002):
            found = signed_distance(FIELDS["dished"], *(centre + (0.02 - depth) * towards)[[0]], 0.0,
                                    *(centre + (0.02 - depth) * towards)[[1]])
            np.testing.assert_allclose(found, [depth, -towards[0], 0.0, -towards[1]], atol=1e-12)


@pytest.mark.kernel
@pytest.mark.parametrize("name", PROFILES)
def test_gradient_is_continuous_through_a_face(name):
    """At -1e-15, 0 and 1e-15 m from the middle of each segment the gradient is the segment's normal."""
    profile = PROFILES[name]
    for start, end in zip(profile, np.roll(profile, -1, axis=0)):
        if start[0] == end[0] == 0.0:
            continue
        normal = np.array([end[1] - start[1], start[0] - end[0]]) / np.linalg.norm(end - start)
        for offset in (-1e-15, 0.0, 1e-15):
            r, z = (start + end) / 2 + offset * normal
            found = signed_distance(FIELDS[name], r * 0.6, r * 0.8, z)
            np.testing.assert_allclose(found[1:], [0.6 * normal[0], 0.8 * normal[0], normal[1]], atol=1e-12)
            assert abs(found[0] - offset) < 1e-17 + 1e-2 * abs(offset) + 4e-18


@pytest.mark.kernel
def test_gradient_on_edges_corners_and_tips_is_the_pseudonormal():
    half = 0.02
    edge = signed_distance(FIELDS["surface cube"], half, half, 0.003)
    np.testing.assert_allclose(edge, [0.0, 0.5**0.5, 0.5**0.5, 0.0], atol=1e-12)
    corner = signed_distance(FIELDS["surface cube"], half, half, half)
    np.testing.assert_allclose(corner, [0.0, *[3**-0.5] * 3], atol=1e-12)
    np.testing.assert_allclose(signed_distance(FIELDS["cone"], 0.0, 0.0, 0.03), [0, 0, 0, 1], atol=1e-12)


@pytest.mark.kernel
def test_points_on_the_axis_and_in_the_centre():
    for z in (-0.05, -0.02, 0.0, 0.013, 0.05):
        d, *normal = signed_distance(FIELDS["cylinder"], 0.0, 0.0, z)
        assert d == pytest.approx(max(abs(z) - 0.02, -0.018), abs=1e-16)
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-14)
    assert signed_distance(FIELDS["tube"], 0.0, 0.0, 0.0)[0] == pytest.approx(0.010, abs=1e-16)
    assert signed_distance(FIELDS["sphere"], 0.0, 0.0, 0.0)[0] == -0.02
    d, *normal = signed_distance(FIELDS["dimpled"], 0.0, 0.0, 0.012)  # outside, over the dimple
    assert d > 0 and np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-14)
    assert signed_distance(FIELDS["dimpled"], 0.0, 0.0, -0.009)[0] < 0


@pytest.mark.kernel
def test_fine_surface_converges_to_the_solid_of_revolution():
    """Chord error of n sides is r (1 - cos(pi / n)): second order."""
    points = cloud(N // 4, seed=7)
    exact = evaluate(FIELDS["diablo"], points)[0]
    sides = (16, 32) if config.DISABLE_JIT else (24, 48, 96, 192)
    errors = [
        np.abs(evaluate(surface_field(*turned_surface(DIABLO, n_around=n)), points)[0] - exact).max() for n in sides
    ]
    assert np.all(errors <= 0.022 * (1 - np.cos(np.pi / np.array(sides))) * 1.0001)
    assert np.polyfit(np.log(sides), np.log(errors), 1)[0] == pytest.approx(-2.0, abs=0.15)


@pytest.mark.parametrize("name", SURFACES)
def test_against_trimesh(name):
    import trimesh

    vertices, triangles = SURFACES[name]
    points = cloud(2000, seed=8)
    distances, normals = evaluate(FIELDS[f"surface {name}"], points)
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    feet, expected, _ = trimesh.proximity.closest_point(mesh, points)
    excess = expected - np.abs(distances)  # trimesh takes any of several triangles that are about equally close
    assert np.all(excess > -1e-12)
    assert np.mean(excess > 1e-12) < 0.01 and excess.max() < 5e-5
    assert np.median(np.linalg.norm(points - distances[:, None] * normals - feet, axis=1)) < 1e-12
    clear = expected > 1e-6
    np.testing.assert_array_equal((distances < 0)[clear], mesh.contains(points)[clear])


def test_large_surface_agrees_with_brute_force_over_all_triangles():
    """The tree against its own leaves: one leaf of everything visits every triangle."""
    vertices, triangles = turned_surface(DIMPLED, n_around=300)
    rng = np.random.default_rng(9)
    vertices = vertices + rng.normal(scale=2e-5, size=vertices.shape)
    field = surface_field(vertices, triangles)
    boxes = np.array([12 * [0.0], [-1.0, -1, -1, 1, 1, 1, 0, 0, 0, -np.inf, np.inf, np.inf]])
    brute = field._replace(boxes=boxes, leaf_size=len(field.rows))
    points = cloud(300, seed=10)
    np.testing.assert_array_equal(evaluate(field, points)[0], evaluate(brute, points)[0])


@pytest.mark.kernel
def test_discs_leave_nothing_out_that_is_closest():
    """With and without them the same bits follow; discs that are too small by a fifth are noticed."""
    vertices, triangles = turned_surface(DIMPLED, n_around=48 if config.DISABLE_JIT else 300)
    field, points = surface_field(vertices, triangles), cloud(N // 4, seed=12)
    without, small = field.boxes.copy(), field.boxes.copy()
    without[:, 6:9], without[:, 9:] = 0.0, (-np.inf, np.inf, np.inf)
    small[:, 11] *= 0.8
    expected = evaluate(field._replace(boxes=without), points)
    for got, wanted in zip(evaluate(field, points), expected, strict=True):
        np.testing.assert_array_equal(got, wanted)
    assert np.any(evaluate(field._replace(boxes=small), points)[0] != expected[0])


@pytest.mark.kernel
def test_the_disc_of_a_node_holds_its_triangles():
    """Of no point a disc says that it is farther away than the nearest triangle of its leaf is."""
    field = surface_field(*turned_surface(DIABLO, n_around=24))
    n_leaves = len(field.boxes) // 2
    for x, y, z in cloud(20, seed=13):
        for leaf in range(n_leaves):
            nearest, _ = closest_in_leaf(field.rows, field.leaf_size, leaf, x, y, z, np.inf, 0)
            assert not outside_disc(field.boxes, n_leaves + leaf, x, y, z, 1.000001 * nearest)


@pytest.mark.kernel
def test_flat_triangle_on_a_sharp_edge_does_not_turn_the_sign():
    """An exporter's T-junction: one face meets an edge whole, the other in two pieces, a flat triangle between."""
    vertices, triangles = tetrahedron_surface()
    a, b, c = triangles[0]
    middle = len(vertices)
    split = np.concatenate([triangles[1:], [[a, middle, c], [middle, b, c], [a, b, middle]]])
    vertices = np.concatenate([vertices, [(vertices[a] + vertices[b]) / 2]])
    normals, flat = triangle_normals(vertices, split, triangle_neighbours(split)[1])
    assert flat.sum() == 1 and np.all(np.isfinite(normals))
    points = cloud(seed=11)
    whole, cut = evaluate(FIELDS["surface tetrahedron"], points), evaluate(surface_field(vertices, split), points)
    np.testing.assert_allclose(cut[0], whole[0], atol=1e-15)
    np.testing.assert_allclose(cut[1], whole[1], atol=1e-9)


@pytest.mark.kernel
def test_a_face_normal_for_a_sign_would_be_wrong():
    """The pseudonormal matters: a twin that signs by the closest triangle's own normal errs beyond sharp edges."""
    field = FIELDS["surface tetrahedron"]
    features = np.arange(len(field.rows))[:, None].repeat(6, axis=1)
    twin = field._replace(features=features.astype(np.int32), pseudonormals=np.ascontiguousarray(field.rows[:, 9:]))
    points = cloud(seed=12)
    right, wrong = evaluate(field, points)[0], evaluate(twin, points)[0]
    np.testing.assert_allclose(np.abs(right), np.abs(wrong), atol=1e-16)
    assert np.count_nonzero(np.sign(right) != np.sign(wrong)) > 0.01 * len(points)


def test_open_surface_is_refused():
    vertices, triangles = SURFACES["cube"]
    with pytest.raises(ValueError, match="3 edges are not shared by exactly two triangles"):
        surface_field(vertices, triangles[1:])


@pytest.mark.kernel
def test_all_shapes_share_one_type():
    """One Numba type: kernels that take a field compile once for every object."""
    from numba import typeof

    assert len({str(typeof(field)) for field in FIELDS.values()}) == 1
