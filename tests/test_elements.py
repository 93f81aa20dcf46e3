"""Reference elements, rest stiffness, lumped masses and traction loads."""

from __future__ import annotations

from itertools import product
from math import factorial

import numpy as np
import pytest

from finqd.errors import InputError, MeshError
from finqd.mechanics.element_stiffness import (
    consistent_gradients,
    hourglass_matrix,
    isotropic,
    physical_gradients,
    rest_elements,
    strain_matrix,
)
from finqd.mechanics.elements import ELEMENTS, FACES, element, element_rule, face_shape, face_shape_gradients
from finqd.mechanics.loads import face_tractions
from finqd.mechanics.mass import lumped_masses
from finqd.mesh import Mesh
from finqd.mesh_shapes import box_mesh

ALL = {**ELEMENTS, **FACES}
LAME = (3.7e6, 1.3e6)


def inner_points(name: str, n: int = 7) -> np.ndarray:
    """Random points of the reference domain, away from its corners."""
    nodes = ALL[name].nodes
    weights = np.random.default_rng(1).dirichlet(np.ones(len(nodes)), n)
    return weights @ nodes


@pytest.mark.parametrize("name", ALL)
def test_shape_functions_are_one_at_their_node_and_sum_to_one(name):
    kind, points = ALL[name], inner_points(name)
    np.testing.assert_allclose(kind.shape(kind.nodes), np.eye(kind.n_nodes), atol=1e-13)
    np.testing.assert_allclose(kind.shape(points).sum(axis=1), 1.0, atol=1e-13)
    np.testing.assert_allclose(kind.shape(points) @ kind.nodes, points, atol=1e-13)  # linear fields are represented


@pytest.mark.parametrize("name", ALL)
def test_shape_gradients_agree_with_differences(name):
    kind, points, h = ALL[name], inner_points(name), 1e-5
    gradients = kind.shape_gradients(points)
    assert np.abs(gradients).max() > 0.1
    for axis in range(points.shape[1]):
        step = h * np.eye(points.shape[1])[axis]
        difference = (kind.shape(points + step) - kind.shape(points - step)) / (2 * h)
        np.testing.assert_allclose(gradients[..., axis], difference, atol=1e-9)


def exact_integral(name: str, powers: tuple[int, ...]) -> float:
    """Integral of a monomial over the reference domain."""
    def line(p: int) -> float:
        return 0.0 if p % 2 else 2 / (p + 1)

    def simplex(p: tuple[int, ...]) -> float:
        return float(np.prod([factorial(e) for e in p])) / factorial(sum(p) + len(p))

    if name.startswith(("hex", "quad")):
        return float(np.prod([line(p) for p in powers]))
    if name.startswith("wedge"):
        return simplex(powers[:2]) * line(powers[2])
    return simplex(powers)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("name", ALL)
def test_rules_integrate_monomials_exactly(name, n):
    points, weights = element_rule(name, n)
    assert np.all(weights > 0)
    for powers in product(range(2 * n), repeat=points.shape[1]):
        if sum(powers) <= 2 * n - 1:
            value = weights @ np.prod(points ** np.array(powers), axis=1)
            assert value == pytest.approx(exact_integral(name, powers), abs=1e-13), powers


@pytest.mark.parametrize(("name", "degree"), [("hex8", 3), ("wedge6", 3), ("tet4", 1), ("tet10", 2), ("hex20", 3),
                                              ("quad4", 3), ("tri3", 2), ("tri6", 5), ("quad8", 5)])
def test_stiffness_rules_have_their_degree_and_no_more(name, degree):
    kind = ALL[name]

    def error(total: int) -> float:
        return max(abs(kind.weights @ np.prod(kind.points ** np.array(p), axis=1) - exact_integral(name, p))
                   for p in product(range(total + 1), repeat=kind.points.shape[1]) if sum(p) == total)

    assert max(error(total) for total in range(degree + 1)) < 1e-13
    assert error(degree + 1) > 1e-4


@pytest.mark.parametrize("name", ELEMENTS)
def test_faces_carry_the_elements_own_shape_functions_and_face_outwards(name):
    kind, flux = ELEMENTS[name], 0.0
    for face_type, local in kind.faces:
        points, weights = element_rule(face_type, 3)
        on_face = face_shape(face_type, points)
        position = on_face @ kind.nodes[list(local)]
        np.testing.assert_allclose(kind.shape(position)[:, list(local)], on_face, atol=1e-12)
        tangents = np.einsum("ak,qai->iqk", kind.nodes[list(local)], face_shape_gradients(face_type, points))
        flux += weights @ np.sum(position * np.cross(tangents[0], tangents[1]), axis=1)
    assert flux == pytest.approx(3 * kind.weights.sum(), rel=1e-12)  # divergence theorem for the field x


def test_unknown_names_list_the_known_ones():
    with pytest.raises(InputError, match="tet4"):
        element("tet5")
    with pytest.raises(InputError, match="quad4"):
        face_shape("quad5", np.zeros((1, 2)))


@pytest.mark.parametrize("name", ELEMENTS)
def test_stiffness_at_rest_is_symmetric_with_six_rigid_motions(name):
    rng = np.random.default_rng(3)
    vertices = ELEMENTS[name].nodes + 0.05 * rng.standard_normal(ELEMENTS[name].nodes.shape)
    elements = rest_elements(name, vertices[None], LAME)
    stiffness = elements.stiffness[0]
    scale = np.abs(stiffness).max()
    np.testing.assert_allclose(stiffness, stiffness.T, atol=1e-14 * scale)
    values = np.linalg.eigvalsh(stiffness)
    assert np.all(np.abs(values[:6]) < 1e-12 * scale)
    assert values[6] > 1e-7 * scale
    for axis in range(3):
        for motion in (np.tile(np.eye(3)[axis], (len(vertices), 1)), np.cross(np.eye(3)[axis], vertices)):
            assert np.abs(stiffness @ motion.ravel()).max() < 1e-12 * scale


@pytest.mark.parametrize("name", ELEMENTS)
def test_stiffness_has_the_energy_of_a_uniform_strain(name):
    rng = np.random.default_rng(4)
    vertices = ELEMENTS[name].nodes * [1.0, 1.3, 0.8]
    elements, strain = rest_elements(name, vertices[None], LAME), rng.standard_normal((3, 3))
    field = (vertices @ strain.T).ravel()
    voigt = strain_matrix(elements.gradients[0]) @ field
    exact = 0.5 * elements.volumes[0] * voigt @ isotropic(*LAME) @ voigt
    assert 0.5 * field @ elements.stiffness[0] @ field == pytest.approx(exact, rel=1e-12)
    np.testing.assert_allclose(np.einsum("ai,aj->ij", vertices, elements.gradients[0]), np.eye(3), atol=1e-12)


def curved(name: str) -> np.ndarray:
    """Rest nodes (1, k, 3) of an element with crooked edges."""
    nodes = ELEMENTS[name].nodes
    return (nodes + 0.08 * np.random.default_rng(5).standard_normal(nodes.shape))[None]


@pytest.mark.parametrize("name", ["hex20", "tet10"])
def test_gradients_have_the_exact_mean_and_keep_linear_fields(name):
    kind, vertices = ELEMENTS[name], curved(name)
    fine, volumes = physical_gradients(kind, vertices, *element_rule(name, 5))
    exact = np.einsum("nq,nqak->nak", volumes, fine)
    gradients, weights = consistent_gradients(kind, vertices)
    assert weights.sum() == pytest.approx(volumes.sum(), rel=1e-13)
    np.testing.assert_allclose(np.einsum("nq,nqak->nak", weights, gradients), exact, atol=1e-13)
    fields = np.einsum("nai,nqak->nqik", vertices, gradients)
    np.testing.assert_allclose(fields, np.broadcast_to(np.eye(3), fields.shape), atol=1e-12)
    plain, raw = physical_gradients(kind, vertices, kind.points, kind.weights)  # the twin without the correction
    assert np.abs(np.einsum("nq,nqak->nak", raw, plain) - exact).max() > 1e-4


@pytest.mark.parametrize("shape", ["brick", "crooked"])
def test_hourglasses_of_hex20_cost_energy_and_linear_fields_none(shape):
    kind = ELEMENTS["hex20"]
    vertices = kind.nodes[None] if shape == "brick" else curved("hex20")
    gradients, weights = consistent_gradients(kind, vertices)
    matrix = hourglass_matrix(kind, vertices, gradients, weights)[0]
    assert np.linalg.eigvalsh(matrix)[0] > -1e-14
    assert np.abs(matrix @ np.column_stack([np.ones(20), vertices[0]])).max() < 1e-14
    if shape == "brick":
        assert np.abs(matrix @ (kind.nodes[:, :1] * kind.nodes)).max() < 1e-14  # nor quadratic ones
    x, y = kind.nodes[:, 0], kind.nodes[:, 1]
    mode = np.stack([x * (3 * y**2 - 1), -y * (3 * x**2 - 1), 0 * x], axis=1)  # strains vanish at the four points
    field = mode.ravel()
    stiffness = rest_elements("hex20", vertices, LAME).stiffness[0]
    resistance = field @ stiffness @ field
    assert resistance > 1e-4 * LAME[1] * np.sum(field**2)
    if shape == "brick":
        assert resistance == pytest.approx(LAME[1] * np.einsum("ai,ab,bi", mode, matrix, mode), rel=1e-9)


def test_an_inverted_element_is_named():
    mesh = box_mesh((1.0, 1.0, 1.0), (2, 1, 1))
    nodes = mesh.vertices[mesh.blocks["hex8"]]
    nodes[1] = nodes[1][[4, 5, 6, 7, 0, 1, 2, 3]]
    with pytest.raises(MeshError, match="element 1 of block hex8"):
        rest_elements("hex8", nodes, LAME)


def distorted(name: str) -> Mesh:
    return box_mesh((0.04, 0.03, 0.02), (4, 3, 3), name, distort=0.25, seed=2)


@pytest.mark.parametrize("name", ELEMENTS)
def test_masses_are_positive_and_exact_in_total(name):
    mesh = distorted(name)
    masses = lumped_masses(mesh, 1150.0)
    assert masses.min() > 0
    assert masses.sum() == pytest.approx(1150.0 * 0.04 * 0.03 * 0.02, rel=1e-12)
    centre = masses @ mesh.vertices / masses.sum()
    exact = not ELEMENTS[name].quadratic  # row sums keep the centre of mass, scaled diagonals nearly
    np.testing.assert_allclose(centre, [0.02, 0.015, 0.01], atol=1e-15 if exact else 1e-4)


@pytest.mark.parametrize("name", ELEMENTS)
def test_tractions_have_exact_force_and_moment(name):
    mesh, traction = distorted(name), np.array([2e3, -1e3, 5e2])
    forces = face_tractions(mesh, "xmax", traction)
    assert not np.any(forces[mesh.vertices[:, 0] < 0.039])
    np.testing.assert_allclose(forces.sum(axis=0), traction * 0.03 * 0.02, rtol=1e-12)
    moment = np.cross(mesh.vertices, forces).sum(axis=0)
    np.testing.assert_allclose(moment, np.cross([0.04, 0.015, 0.01], traction * 6e-4), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", ["hex8", "tet4", "tet10"])
def test_a_pressure_on_the_whole_boundary_is_in_equilibrium(name):
    mesh = distorted(name)
    everything = {kind: np.arange(len(faces)) for kind, faces in mesh.faces.items()}
    forces = face_tractions(mesh, everything, lambda points, normals: -1e4 * normals)
    scale = 1e4 * 0.04 * 0.03
    assert np.abs(forces).max() > 1e-2 * scale
    np.testing.assert_allclose(forces.sum(axis=0), 0, atol=1e-13 * scale)
    np.testing.assert_allclose(np.cross(mesh.vertices, forces).sum(axis=0), 0, atol=1e-14 * scale)


@pytest.mark.parametrize("name", ["hex8", "tet4", "tet10", "hex20"])
def test_a_region_that_cuts_faces_converges_to_its_area(name):
    mesh, errors = distorted(name), []
    for cells in (4, 16, 64):
        forces = face_tractions(mesh, "ymax", (0.0, 1.0, 0.0), subdivisions=cells,
                                region=lambda points: points[:, 0] < 0.0137)
        errors.append(abs(forces[:, 1].sum() / (0.0137 * 0.02) - 1))
    assert errors[-1] < 5e-3
    assert all(error < 0.5 / cells for error, cells in zip(errors, (4, 16, 64)))


@pytest.mark.parametrize("below", ["plane", "sphere"])
@pytest.mark.parametrize("name", ["hex8", "hex20"])
def test_a_block_rests_with_its_weight_and_without_jitter(name, below):
    """Contact on eight-node faces, whose corner shape functions are negative in the middle."""
    from finqd.mechanics.material import Material
    from finqd.objects import load_object
    from finqd.scene import Scene
    from finqd.simulate import simulate

    scene, size = Scene(gravity=(0.0, 0.0, -9.81)), np.array([0.03, 0.02, 0.01])
    placed = np.eye(4)
    placed[:3, 3] = -size / 2 * [1, 1, 0]
    scene.add_soft(box_mesh(size, (3, 2, 1), name).transformed(placed),
                   Material(youngs_modulus=1e6, poisson_ratio=0.45, density=1000.0))
    if below == "plane":
        scene.add_plane()
    else:
        scene.add_rigid(load_object("sphere"), position=(0.0, 0.0, -0.02), held=True)
    seen = []

    def watch(system, state):
        force = system.contact.soft_forces[0] if below == "plane" else -system.contact_forces_on_rigid(state)[0, 2]
        seen.append((float(force), state.positions))

    trajectory = simulate(scene, duration=0.4, time_step=0.01, watch=watch)
    assert trajectory.status == "ok", trajectory.reason
    weight = 9.81 * 1000.0 * size.prod()
    assert [force for force, _ in seen[-5:]] == pytest.approx([weight] * 5, rel=1e-3)
    assert max(np.abs(positions - seen[-1][1]).max() for _, positions in seen[-10:]) < 1e-7


def test_an_unknown_face_set_lists_the_known_ones():
    with pytest.raises(InputError, match="xmax"):
        face_tractions(distorted("hex8"), "top", (0.0, 0.0, 1.0))
