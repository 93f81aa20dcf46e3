"""Kernels of contact, rotations and assembly, each alone, and the sparsity pattern that they write to."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.mechanics import contact_force_kernels as force_kernels
from finqd.mechanics import contact_kernels as kernels
from finqd.mechanics.assembly_kernels import add_diagonal, hold, largest_force
from finqd.mechanics.contact_rows import KeyedValues, Rows
from finqd.mechanics.contact_surface import Sight, closed_lattice, contact_shape, contact_surface, lattice
from finqd.mechanics.distance_kernels import signed_distance
from finqd.mechanics.elements import face_shape
from finqd.mechanics.material import Material
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.rotation_kernels import inverse_left_jacobian, rotation_matrix, rotation_vector, skew
from finqd.mechanics.rounding import rounded_field
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.scene import Scene

pytestmark = pytest.mark.kernel

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.45, density=1000.0)
STIFFNESS, SMOOTHING = 2e5, 1e-5  # [N/m], [m]


# -- the normal penalty ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("penetration", [0.2e-5, 0.9e-5, 1.1e-5, 5e-5])
def test_normal_force_is_the_slope_of_its_energy(penetration: float) -> None:
    h = 1e-9
    force, slope = force_kernels.normal_force(-penetration, STIFFNESS, SMOOTHING)
    energies = [force_kernels.normal_energy(-(penetration + s * h), STIFFNESS, SMOOTHING) for s in (-1, 1)]
    forces = [force_kernels.normal_force(-(penetration + s * h), STIFFNESS, SMOOTHING)[0] for s in (-1, 1)]
    assert force > 0.0
    assert (energies[1] - energies[0]) / (2 * h) == pytest.approx(force, rel=1e-6)
    assert (forces[1] - forces[0]) / (2 * h) == pytest.approx(slope, rel=1e-6)


def test_normal_penalty_is_smooth_where_its_pieces_meet() -> None:
    for edge in (0.0, SMOOTHING):
        below, above = edge - 1e-15, edge + 1e-15
        values = [
            (
                force_kernels.normal_energy(-p, STIFFNESS, SMOOTHING),
                *force_kernels.normal_force(-p, STIFFNESS, SMOOTHING),
            )
            for p in (below, above)
        ]
        scale = (STIFFNESS * SMOOTHING**2, STIFFNESS * SMOOTHING, STIFFNESS)
        assert np.all(np.abs(np.subtract(*values)) < 1e-8 * np.array(scale))
    assert force_kernels.normal_energy(1e-9, STIFFNESS, SMOOTHING) == 0.0
    deep = 1e-3
    force, _ = force_kernels.normal_force(-deep, STIFFNESS, SMOOTHING)
    assert force == pytest.approx(STIFFNESS * (deep - SMOOTHING / 2), rel=1e-12)


# -- friction ----------------------------------------------------------------------------------------------------------


def friction_gradient(slip: np.ndarray, bound: float, stiffness: float) -> np.ndarray:
    """Return the friction force on one soft vertex [N] through `add_friction`; its normal is z."""
    gradient, rigid = np.zeros((1, 3)), np.zeros((0, 6))
    force_kernels.add_friction(
        np.array([[0]]), np.array([[[0]]]), np.array([0]), np.ones((1, 1)), slip[None], np.array([bound]),
        np.array([stiffness]), np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3)), np.array([-1]), np.zeros((0, 3, 3)), 1,
        gradient, rigid, np.zeros((1, 3, 3)), np.zeros((3, 0)), np.zeros((0, 0)), True, False,
    )
    return gradient[0]


@pytest.mark.parametrize("length", [0.3e-5, 0.95e-5, 1.05e-5, 8e-5])  # the cone is reached at 1e-5 m
def test_friction_force_is_the_slope_of_its_energy(length: float) -> None:
    stiffness, bound, h = 1e5, 1.0, 1e-9
    slip = length * np.array([0.6, -0.8, 0.0])
    force = friction_gradient(slip, bound, stiffness)
    for i in range(2):
        step = h * np.eye(3)[i]
        bounds, springs = np.array([bound]), np.array([stiffness])
        energies = [force_kernels.friction_energy((slip + s * step)[None], bounds, springs, 1) for s in (-1, 1)]
        assert (energies[1] - energies[0]) / (2 * h) == pytest.approx(force[i], rel=1e-5)
    assert np.linalg.norm(force) == pytest.approx(min(stiffness * length, bound), rel=1e-12)


def test_return_mapping_shortens_to_the_cone_and_no_further() -> None:
    slips = np.array([[3e-5, 4e-5, 0.0], [1e-6, 0.0, 0.0], [0.0, 0.0, 0.0]])
    before = slips.copy()
    force_kernels.return_mapping(slips, np.array([1.0, 1.0, 0.0]), np.array([1e5, 1e5, 1e5]), 3)
    assert np.allclose(slips[0], [0.6e-5, 0.8e-5, 0.0], rtol=1e-12)
    assert np.array_equal(slips[1:], before[1:])
    # what is left pulls with the force that the energy's slope gave before
    assert np.allclose(1e5 * slips[0], friction_gradient(before[0], 1.0, 1e5), rtol=1e-12)


def test_a_ball_that_rolls_does_not_slip() -> None:
    radius, turn = 0.02, np.array([[0.0, 1e-3, 0.0]])
    slips = np.empty((1, 3))
    shift = np.array([[radius * turn[0, 1], 0.0, 0.0]])
    force_kernels.elastic_slips(
        np.zeros((0, 3)), shift, turn, np.zeros((0, 4), dtype=np.int64), np.array([-1]), np.zeros((1, 4)),
        np.zeros((1, 3)), np.array([[0.0, 0.0, -radius]]), np.zeros((1, 3)), np.array([[0.0, 0.0, -1.0]]),
        np.array([0]), 1, slips,
    )
    assert np.abs(slips).max() < 1e-18


# -- geometry ----------------------------------------------------------------------------------------------------------


def test_plane_step_limit_stops_at_the_allowance() -> None:
    heights, approach = np.array([1e-3, 5e-3, -1e-4]), np.array([2e-3, 1e-3, -1.0])
    limit = kernels.plane_step_limit(heights, approach, 5e-4)
    assert limit == pytest.approx(0.75)
    assert np.all(heights[:2] - limit * approach[:2] >= -5e-4 - 1e-15)
    assert kernels.plane_step_limit(heights, -np.abs(approach), 5e-4) == 1.0


@pytest.mark.parametrize("kind", ["quad4", "quad8", "tri3", "tri6"])
@pytest.mark.parametrize("cells", [(1, 1), (3, 2), (4, 5)])
def test_lattice_covers_a_face_evenly(kind: str, cells: tuple[int, int]) -> None:
    points, shares = lattice(kind, *cells)
    assert np.ptp(shares) == 0.0 and shares.sum() == pytest.approx(1.0)
    if kind.startswith("quad"):
        n, m = cells
        assert len(points) == n * m and np.all(np.abs(points) < 1.0)
        assert np.ptp(points, axis=0) == pytest.approx((2 - 2 / n, 2 - 2 / m))
        centroid = (0.0, 0.0)
    else:
        assert len(points) == cells[0] ** 2 and points.min() > 0.0 and points.sum(axis=1).max() < 1.0
        centroid = (1 / 3, 1 / 3)
    assert np.allclose(points.mean(axis=0), centroid, atol=1e-14)  # linear pressures are integrated exactly


@pytest.mark.parametrize("kind", ["quad4", "quad8", "tri3", "tri6"])
@pytest.mark.parametrize("cells", [(1, 1), (3, 2), (4, 5)])
def test_closed_lattice_has_the_rim_and_covers_a_face_evenly(kind: str, cells: tuple[int, int]) -> None:
    points, shares = closed_lattice(kind, *cells)
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)] if kind.startswith("quad") else [(0, 0), (1, 0), (0, 1)]
    assert all((np.abs(points - corner).max(axis=1) < 1e-14).any() for corner in corners)
    assert shares.min() > 0.0 and shares.sum() == pytest.approx(1.0)
    assert np.allclose(shares @ points, np.mean(corners, axis=0), atol=1e-14)


def test_samples_stand_for_the_whole_surface_once() -> None:
    for element in ("hex8", "wedge6", "tet4", "tet10"):
        scene = Scene()
        body = scene.add_soft(box_mesh((0.02, 0.03, 0.01), (2, 3, 1), element), RUBBER)
        body.fix("xmin")
        surface = contact_surface(scene.soft_bodies, spacing=1.5e-3)
        area = 2 * (0.02 * 0.03 + 0.02 * 0.01 + 0.03 * 0.01) - 0.03 * 0.01  # without the face that is held
        lattices = [slice(*ends) for ends in zip(surface.lattice_first, surface.lattice_first[1:])]
        assert surface.face_area.sum() == pytest.approx(area, rel=1e-12)
        assert np.allclose(surface.lattice_weight.sum(axis=1), 1.0)
        counts = [lattices[k].stop - lattices[k].start for k in surface.face_lattice]
        assert np.array_equal(np.diff(surface.first_sample), counts) and surface.n_samples == sum(counts)


def test_only_samples_inside_a_body_are_found_and_all_of_them() -> None:
    scene = Scene()
    body = scene.add_soft(box_mesh((0.02, 0.03, 0.01), (3, 4, 2), "hex8"), RUBBER)
    surface = contact_surface(scene.soft_bodies, spacing=0.4e-3)
    positions = body.mesh.vertices + 2e-4 * np.random.default_rng(8).normal(size=body.mesh.vertices.shape)
    brick = load_object({"shape": {"kind": "box", "size_mm": [9, 7, 5]}, "mass_g": 5})
    field = rounded_field(brick, 0.5e-3)
    centre, rotation = np.array([0.009, 0.014, 0.0125]), rotation_matrix(np.array([0.3, -0.2, 0.5]))

    def find(room: int, sight: Sight | None = None) -> tuple[int, Rows]:
        rows = Rows(room, surface.faces.shape[1])
        sight = Sight(surface, len(positions)) if sight is None else sight
        count = kernels.find_soft_rigid(
            positions, *surface.arrays, 1e9, centre, rotation, field, brick.bounding_radius, *sight.arrays, 0, 7,
            *rows.arrays, 0
        )
        return count, rows

    expected = {}
    for f, face in enumerate(surface.faces):
        first, last = surface.lattice_first[surface.face_lattice[f] :][:2]
        for s in range(first, last):
            x = surface.lattice_weight[s] @ positions[face]
            d, *_ = signed_distance(field, *(rotation.T @ (x - centre)))
            if d < 0.0:
                expected[7 + surface.first_sample[f] + s - first] = d
    count, rows = find(5000)
    assert len(expected) == count > 50 and count < surface.n_samples / 4
    assert dict(zip(rows.key[:count], rows.gap[:count])) == pytest.approx(expected, rel=1e-9, abs=1e-15)
    face = rows.face[:count]
    cells = np.diff(surface.first_sample)[face]
    np.testing.assert_allclose(rows.stiffness[:count], 1e9 * surface.face_area[face] / cells, rtol=1e-12)
    few, rows = find(20)  # what there is no room for is counted
    assert few == count and len(rows.key) == 20
    # what is remembered of the way changes nothing, wherever the body and the faces go
    generator, sight = np.random.default_rng(9), Sight(surface, len(positions))
    for _ in range(30):
        positions += 2e-4 * generator.normal(size=positions.shape)
        centre, rotation = centre + 1e-3 * generator.normal(size=3), rotation_matrix(0.1 * generator.normal(size=3))
        (afresh, rows), (again, others) = find(5000), find(5000, sight)
        assert afresh == again
        for one, other in zip(rows.arrays, others.arrays, strict=True):
            np.testing.assert_array_equal(one[:afresh], other[:afresh])


def test_soft_step_limit_lets_no_point_pass_the_allowance() -> None:
    mesh = box_mesh((0.02, 0.02, 0.005), (3, 3, 1), "hex8")
    ball = load_object({"shape": {"kind": "sphere", "diameter_mm": 10}, "mass_g": 5})
    scene = Scene()
    scene.add_soft(mesh, RUBBER)
    surface = contact_surface(scene.soft_bodies, spacing=0.4e-3)
    centre, up = np.array([0.009, 0.011, 0.0115]), np.tile([0.0, 0.0, 0.02], (len(mesh.vertices), 1))
    nothing, limits = np.zeros(3), []
    for direction, shift in ((up, nothing), (np.zeros_like(up), -up[0])):
        limits.append(kernels.soft_step_limit(
            mesh.vertices, direction, *surface.lattices, centre, np.eye(3), ball.distance, 0.005, shift, nothing, 5e-4
        ))
    assert limits[0] == pytest.approx(limits[1], rel=1e-12) and 0.0 < limits[0] < 1.0
    moved = mesh.vertices + limits[0] * up
    depths = [
        -signed_distance(ball.distance, *(surface.lattice_weight[s] @ moved[face] - centre))[0]
        for f, face in enumerate(surface.faces)
        for s in range(*surface.lattice_first[surface.face_lattice[f] :][:2])
    ]
    assert max(depths) <= 5e-4 + 1e-12
    small = kernels.soft_step_limit(
        mesh.vertices, 0.02 * up, *surface.lattices, centre, np.eye(3), ball.distance, 0.005, nothing, nothing, 5e-4
    )
    assert small == 1.0


@pytest.mark.parametrize("move, spin, share", [
    ([0.006, 0.0, 0.0], [0.0, 0.0, 0.0], 1.0),  # along the face
    ([0.006, 0.0, 1e-4], [0.0, 0.0, 0.0], 1.0),  # and in by much less than the allowance
    ([0.0, 0.0, 0.006], [0.0, 0.0, 0.0], 1 / 12),  # straight in
    ([0.0, 0.0, -0.006], [0.0, 0.0, 0.0], 1.0),  # off
    ([0.0, 0.0, 0.0], [0.0, 0.0, 0.5], 1.0),  # spinning on the face
])
def test_a_body_that_slides_along_a_face_is_free_to(move, spin, share) -> None:
    mesh = box_mesh((0.02, 0.02, 0.005), (3, 3, 1), "hex8")
    brick = load_object({"shape": {"kind": "box", "size_mm": [6, 6, 5]}, "mass_g": 5})
    scene = Scene()
    scene.add_soft(mesh, RUBBER)
    surface = contact_surface(scene.soft_bodies, spacing=0.4e-3)
    centre = np.array([0.006, 0.01, 0.005 + 0.0025 - 1e-5])  # lies on the upper face, 10 um deep
    limit = kernels.soft_step_limit(
        mesh.vertices, np.zeros_like(mesh.vertices), *surface.lattices, centre, np.eye(3), brick.distance,
        brick.bounding_radius, np.array([*move[:2], -move[2]]), np.array(spin), 5e-4,
    )
    assert share <= limit <= min(1.0, 1.5 * share)


def test_a_body_far_away_may_come_as_near_as_it_is() -> None:
    mesh = box_mesh((0.02, 0.02, 0.005), (3, 3, 1), "hex8")
    brick = load_object({"shape": {"kind": "box", "size_mm": [6, 6, 5]}, "mass_g": 5})
    scene = Scene()
    scene.add_soft(mesh, RUBBER)
    surface = contact_surface(scene.soft_bodies, spacing=0.4e-3)
    gap, fall = 0.05, 0.2
    centre = np.array([0.01, 0.01, 0.005 + 0.0025 + gap])
    limit = kernels.soft_step_limit(
        mesh.vertices, np.zeros_like(mesh.vertices), *surface.lattices, centre, np.eye(3), brick.distance,
        brick.bounding_radius, np.array([0.0, 0.0, -fall]), np.zeros(3), 5e-4,
    )
    assert 0.9 * gap <= fall * limit <= gap + 1.5 * 5e-4


@pytest.mark.parametrize("thickness", [1.0, 2.0])
def test_a_thin_wire_is_not_let_through_a_face(thickness) -> None:
    mesh = box_mesh((0.02, 0.02, 0.005), (3, 3, 1), "hex8")
    wire = load_object({"shape": {"kind": "box", "size_mm": [30, thickness, thickness]}, "mass_g": 1})
    scene = Scene()
    scene.add_soft(mesh, RUBBER)
    surface = contact_surface(scene.soft_bodies, spacing=0.4e-3)
    centre, fall = np.array([0.0101, 0.0093, 0.005 + 0.5e-3 * thickness + 1e-4]), np.array([0.0, 0.0, -0.004])
    limit = kernels.soft_step_limit(
        mesh.vertices, np.zeros_like(mesh.vertices), *surface.lattices, centre, np.eye(3), wire.distance,
        wire.bounding_radius, fall, np.zeros(3), 5e-4,
    )
    assert 4.99e-4 <= 0.004 * limit <= 1e-4 + 1.5 * 5e-4  # the gap, the allowance, and what lies between two looks


def test_values_are_found_again_by_their_keys() -> None:
    values = KeyedValues.of(np.array([7, 2, 9]), np.array([0.7, 0.2, 0.9]))
    assert values.at(np.array([9, 3, 2, 10])).tolist() == [0.9, 0.0, 0.2, 0.0]
    empty = KeyedValues(keys=np.zeros(0, dtype=np.int64), values=np.zeros((0, 3)))
    assert np.array_equal(empty.at(np.array([1, 2])), np.zeros((2, 3)))


# -- rotations ---------------------------------------------------------------------------------------------------------


def vectors() -> list[np.ndarray]:
    rng = np.random.default_rng(5)
    axes = [a / np.linalg.norm(a) for a in rng.normal(size=(6, 3))] + [*np.eye(3), *-np.eye(3)]
    angles = [1e-12, 1e-6, 0.99e-4, 1.01e-4, 0.1, 1.0, np.pi / 2, 3.0, np.pi - 1e-6, np.pi - 1e-9]
    return [angle * axis for axis in axes for angle in angles]


def test_rotation_vector_inverts_rotation_matrix() -> None:
    for v in vectors():
        r = rotation_matrix(v)
        assert np.abs(r @ r.T - np.eye(3)).max() < 1e-14
        assert np.linalg.det(r) == pytest.approx(1.0, abs=1e-14)
        assert np.abs(rotation_vector(r) - v).max() < max(1e-14, 1e-12 * np.linalg.norm(v))
    assert np.array_equal(rotation_vector(np.eye(3)), np.zeros(3))


def test_half_turns_have_a_rotation_vector() -> None:
    for axis in np.eye(3):
        half = 2.0 * np.outer(axis, axis) - np.eye(3)
        v = rotation_vector(half)
        assert np.linalg.norm(v) == pytest.approx(np.pi, rel=1e-14)
        assert np.abs(np.cross(v, axis)).max() < 1e-14


def test_rotation_matrix_turns_by_the_right_hand() -> None:
    turned = rotation_matrix(np.array([0.0, 0.0, np.pi / 2])) @ np.array([1.0, 0.0, 0.0])
    assert np.allclose(turned, [0.0, 1.0, 0.0], atol=1e-15)
    k, v, w = np.empty((3, 3)), np.array([1.0, 2.0, 3.0]), np.array([-0.3, 0.5, 0.2])
    skew(v, k)
    assert np.allclose(k @ w, np.cross(v, w), atol=1e-15)


def test_inverse_left_jacobian_is_the_change_of_the_vector() -> None:
    h = 1e-6
    for v in [u for u in vectors() if np.linalg.norm(u) < 3.1] + [np.array([0.9e-3, 0, 0]), np.array([0, 1.1e-3, 0])]:
        r, found = rotation_matrix(v), np.empty((3, 3))
        for i in range(3):
            step = h * np.eye(3)[i]
            plus, minus = (rotation_vector(rotation_matrix(s * step) @ r) for s in (1, -1))
            found[:, i] = (plus - minus) / (2 * h)
        scale = 1.0 / (np.pi - np.linalg.norm(v)) ** 2  # differences lose digits near a half turn
        assert np.abs(inverse_left_jacobian(v) - found).max() < 1e-8 * max(scale, 1.0)


# -- assembly ----------------------------------------------------------------------------------------------------------


CLIQUES = np.array([[0, 1, 2, -1], [2, 3, 4, 5], [5, 6, -1, -1]])


def test_pattern_holds_exactly_the_pairs_of_its_cliques() -> None:
    pattern = BlockPattern.from_cliques(8, [CLIQUES])
    expected = np.eye(8, dtype=bool)  # vertex 7 belongs to nothing, and still has its diagonal
    for clique in CLIQUES:
        nodes = clique[clique >= 0]
        expected[np.ix_(nodes, nodes)] = True
    dense = pattern.matrix(np.ones((pattern.n_blocks, 3, 3))).toarray()[::3, ::3] > 0
    assert np.array_equal(dense, expected)
    assert pattern.n_blocks == np.triu(expected).sum()
    assert np.array_equal(pattern.indices[pattern.indptr[:-1]], np.arange(8))


def test_slots_scatter_to_rows_and_columns_of_their_vertices() -> None:
    pattern = BlockPattern.from_cliques(8, [CLIQUES])
    slots = pattern.slots(CLIQUES[:, ::-1])
    blocks, expected = pattern.new_blocks(), np.zeros((24, 24))
    rng = np.random.default_rng(6)
    for e, clique in enumerate(CLIQUES[:, ::-1]):  # falling vertex numbers: both triangles must find their places
        element = rng.normal(size=(12, 12))
        element += element.T
        for i, a in enumerate(clique):
            for j, b in enumerate(clique):
                if a < 0 or b < 0:
                    assert slots[e, i, j] == -1
                    continue
                block = element[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
                assert (slots[e, i, j] == pattern.n_blocks) == (b < a)
                blocks[slots[e, i, j]] += block
                expected[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] += block
    assert np.allclose(pattern.matrix(blocks).toarray(), expected, atol=1e-15)
    with pytest.raises(KeyError):
        pattern.slots(np.array([[0, 6]]))


def test_held_unknowns_become_rows_of_the_identity() -> None:
    pattern = BlockPattern.from_cliques(8, [CLIQUES])
    rng = np.random.default_rng(7)
    blocks, coupling = rng.normal(size=(pattern.n_blocks + 1, 3, 3)), rng.normal(size=(24, 6))
    fixed = np.zeros((8, 3), dtype=bool)
    fixed[2], fixed[5, 1], fixed[7, 0] = True, True, True
    expected, expected_coupling = pattern.matrix(blocks.copy()).toarray(), coupling.copy()
    held = fixed.ravel()
    expected[held], expected[:, held] = 0.0, 0.0
    expected[held, held] = 1.0
    expected_coupling[held] = 0.0
    hold(pattern.indptr, pattern.indices, fixed, blocks, coupling)
    assert np.array_equal(pattern.matrix(blocks).toarray(), expected)
    assert np.array_equal(coupling, expected_coupling)


def test_diagonal_and_largest_force() -> None:
    pattern = BlockPattern.from_cliques(8, [CLIQUES])
    blocks = pattern.new_blocks()
    add_diagonal(pattern.indptr, np.arange(8.0), blocks)
    assert np.array_equal(pattern.matrix(blocks).toarray(), np.diag(np.repeat(np.arange(8.0), 3)))
    forces, fixed = np.zeros((4, 3)), np.zeros((4, 3), dtype=bool)
    forces[1], forces[2] = (3.0, 4.0, 0.0), (100.0, 0.0, 1.0)
    fixed[2, 0] = True
    assert largest_force(forces, fixed) == (5.0, 1)
    forces[3, 2] = np.nan
    size, where = largest_force(forces, fixed)
    assert np.isnan(size) and where == 3
    assert largest_force(np.zeros((0, 3)), np.zeros((0, 3), dtype=bool))[1] == -1


# -- faces as contact sees them ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("face", "nodes"), [
    ("quad8", [(-1, -1), (1, -1), (1, 1), (-1, 1), (0, -1), (1, 0), (0, 1), (-1, 0)]),
    ("tri6", [(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)]),
])  # fmt: skip
def test_no_node_of_a_quadratic_face_is_pulled_back_by_a_push(face: str, nodes: list[tuple[float, float]]) -> None:
    points = np.random.default_rng(3).uniform(-1.0 if face == "quad8" else 0.0, 1.0, (400, 2))
    if face == "tri6":
        points = points[points.sum(axis=1) < 1.0]
    weights = contact_shape(face, points)
    assert weights.min() >= 0.0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(weights @ np.array(nodes), points, atol=1e-15)
    np.testing.assert_allclose(contact_shape(face, np.array(nodes, dtype=float)), np.eye(len(nodes)), atol=1e-15)
    assert face_shape(face, points).min() < -0.1  # the quadratic functions do pull
    steps = contact_shape(face, points + 1e-7) - weights
    assert np.abs(steps).max() < 1e-6  # continuous
