"""The linear law: exact where rotations are small, carried along by the base, and wrong where bending is large."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_corotated import RUBBER, SIZE, TYPES, check_derivatives, dense_hessian, gradient_of, patch, strained
from test_neo_hookean import equilibrium

from finqd.errors import InputError
from finqd.mechanics.loads import face_tractions
from finqd.mechanics.material import Material
from finqd.mesh import Mesh
from finqd.mesh_shapes import box_mesh
from finqd.plugins.elasticity_corotated import Corotated
from finqd.plugins.elasticity_linear import Linear

TURN = Rotation.from_rotvec([1.1, -2.0, 0.7])


def based_mesh(name: str = "hex8") -> Mesh:
    mesh = box_mesh(SIZE, (2, 2, 1), name)
    return mesh.with_sets({"base": mesh.node_sets["xmin"]}, {})


@pytest.mark.parametrize("name", TYPES)
def test_its_stiffness_is_the_corotated_one_at_rest_and_its_derivatives_are_exact_anywhere(name):
    mesh = box_mesh(SIZE, (2, 1, 1), name)
    potential = Linear().potential(mesh, RUBBER)
    expected = dense_hessian(Corotated().potential(mesh, RUBBER), mesh.vertices)
    for where in (mesh.vertices, strained(mesh.vertices, 0.2)):
        np.testing.assert_allclose(dense_hessian(potential, where), expected, atol=1e-13 * np.abs(expected).max())
    check_derivatives(potential, strained(mesh.vertices, 0.05), directions=2, h=1e-7)


@pytest.mark.parametrize("name", TYPES)
def test_a_distorted_patch_takes_a_linear_field_exactly(name):
    mesh, boundary = patch(name)
    free = np.ones(mesh.vertices.shape, dtype=bool)
    free[boundary] = False
    exact = mesh.vertices @ (np.eye(3) + 1e-2 * np.random.default_rng(1).standard_normal((3, 3)))
    start = np.where(free, mesh.vertices, exact)
    found = equilibrium(Linear().potential(mesh, RUBBER), start, np.zeros_like(start), free, tolerance=1e-12)
    assert np.abs(found - exact).max() < 1e-10 * np.abs(exact - mesh.vertices).max()


def test_it_follows_its_base():
    mesh = based_mesh()
    potential = Linear().potential(mesh, RUBBER, first_vertex=3)
    free = Linear().potential(box_mesh(SIZE, (2, 2, 1)), RUBBER)
    scale = RUBBER.youngs_modulus * np.prod(SIZE)

    def scene(positions):
        return np.vstack([np.full((3, 3), 9.0), positions])

    moved = TURN.apply(mesh.vertices) + [0.3, -0.2, 0.1]
    assert abs(potential.energy(scene(moved))) < 1e-12 * scale
    assert np.abs(gradient_of(potential, scene(moved))).max() < 1e-9 * scale / SIZE[0]
    assert free.energy(moved) > scale  # what a turn costs without a base
    bent = mesh.vertices + 1e-4 * np.random.default_rng(0).standard_normal(mesh.vertices.shape)
    bent[mesh.node_sets["base"]] = mesh.vertices[mesh.node_sets["base"]]
    value, gradient = free.energy(bent), gradient_of(free, bent)
    there = scene(TURN.apply(bent) + [0.3, -0.2, 0.1])
    assert potential.energy(there) == pytest.approx(value, rel=1e-10)
    found = gradient_of(potential, there)
    assert not np.any(found[:3])
    np.testing.assert_allclose(found[3:], TURN.apply(gradient), atol=1e-9 * np.abs(gradient).max())
    turned = np.kron(np.eye(len(bent)), TURN.as_matrix())
    expected = turned @ dense_hessian(free, bent) @ turned.T
    np.testing.assert_allclose(dense_hessian(potential, there)[9:, 9:], expected, atol=1e-11 * np.abs(expected).max())


def test_all_but_the_base_have_exact_forces_and_the_base_is_documented_not_to():
    mesh = based_mesh()
    potential, positions = Linear().potential(mesh, RUBBER), strained(based_mesh().vertices, 0.05)
    gradient, rng, h = gradient_of(potential, positions), np.random.default_rng(0), 1e-7
    base = np.zeros(len(positions), dtype=bool)
    base[mesh.node_sets["base"]] = True
    for moving, exact in ((~base, True), (base, False)):
        d = rng.standard_normal(positions.shape) * moving[:, None]
        slope = (potential.energy(positions + h * d) - potential.energy(positions - h * d)) / (2 * h)
        off = abs(np.sum(gradient * d) - slope) / np.abs(gradient * d).sum()
        assert (off < 1e-7) if exact else (off > 1e-3)


def test_a_base_that_defines_no_rotation_is_refused():
    mesh = box_mesh(SIZE, (2, 2, 1))
    edge = np.flatnonzero((mesh.vertices[:, :2] == 0).all(axis=1))
    for nodes in (edge, edge[:1]):
        with pytest.raises(InputError, match="lie on a line"):
            Linear().potential(mesh.with_sets({"base": nodes}, {}), RUBBER)
    with pytest.raises(InputError, match="poisson_ratio"):
        Linear().potential(mesh, Material(youngs_modulus=1e6, poisson_ratio=0.5, density=1.0))


def test_it_is_right_for_small_bending_and_wrong_for_large():
    """Cantilever under P L^2/EI: tip deflection over length; the elastica gives 0.30172 at 1 and 0.66996 at 4."""
    length, depth, modulus = 0.1, 0.004, 1e7
    mesh = box_mesh((length, depth, depth), (20, 1, 1))
    material = Material(youngs_modulus=modulus, poisson_ratio=0.0, density=1.0)
    free = np.ones(mesh.vertices.shape, dtype=bool)
    free[mesh.node_sets["xmin"]] = False

    def deflection(law, share: float, steps: int = 4) -> float:
        potential, x = law.potential(mesh, material), mesh.vertices.copy()
        for part in np.linspace(0, share, steps + 1)[1:]:
            pull = part * modulus * depth**4 / 12 / length**2 / depth**2
            x = equilibrium(potential, x, face_tractions(mesh, "xmax", (0.0, -pull, 0.0)), free)
        return -float((x - mesh.vertices)[mesh.node_sets["xmax"], 1].mean()) / length

    small = deflection(Linear(), 0.05, 1)
    assert small == pytest.approx(deflection(Corotated(), 0.05, 1), rel=2e-3)
    assert small == pytest.approx(0.05 / 3, rel=5e-3)
    assert deflection(Corotated(), 4.0, 8) == pytest.approx(0.66996, rel=1e-2)
    assert deflection(Linear(), 4.0) == pytest.approx(4 / 3, rel=1e-2)  # twice the truth, and longer than the beam
