"""The corotated potential: laws, derivatives, patch tests, rates; and faulty twins that the same checks reject."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse.linalg as sla
from scipy.spatial.transform import Rotation

from finqd.errors import InputError
from finqd.mechanics import element_stiffness
from finqd.mechanics.loads import face_tractions
from finqd.mechanics.material import Material
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.polar_kernels import closest_rotation, symmetric_eigen
from finqd.mesh import Mesh
from finqd.mesh_shapes import box_mesh
from finqd.plugins.elasticity_corotated import Corotated, CorotatedPotential

TYPES = ("hex8", "wedge6", "tet4", "tet10", "hex20")
RUBBER = Material(youngs_modulus=11.6e6, poisson_ratio=0.49, density=1150.0)
SIZE = (0.008, 0.006, 0.005)
TURN = Rotation.from_rotvec([1.1, -2.0, 0.7])


def small_mesh(name: str) -> Mesh:
    return box_mesh(SIZE, (2, 1, 1), name)


def dense_hessian(potential, positions: np.ndarray, *, projected: bool = False) -> np.ndarray:
    pattern = BlockPattern.from_cliques(len(positions), potential.cliques)
    blocks = pattern.new_blocks()
    slots = tuple(pattern.slots(nodes) for nodes in potential.cliques)
    potential.add_hessian(positions, slots, blocks, projected=projected)
    return pattern.matrix(blocks).toarray()


def gradient_of(potential, positions: np.ndarray) -> np.ndarray:
    gradient = np.zeros_like(positions)
    potential.add_gradient(positions, gradient)
    return gradient


def strained(vertices: np.ndarray, amount: float, *, seed: int = 0, noise: float = 0.3) -> np.ndarray:
    """Positions after a random uniform strain of size ``amount``, random moves of a share of it, and a large turn."""
    rng = np.random.default_rng(seed)
    strain = amount * rng.standard_normal((3, 3))
    moved = vertices @ (np.eye(3) + strain).T + noise * amount * 1e-3 * rng.standard_normal(vertices.shape)
    return TURN.apply(moved) + [0.3, -0.2, 0.1]


def check_derivatives(potential, positions: np.ndarray, *, directions: int = 6, h: float = 2e-8) -> None:
    """Assert that gradient and Hessian are the derivatives of the energy along random directions, and not zero."""
    rng = np.random.default_rng(7)
    gradient, hessian = gradient_of(potential, positions), dense_hessian(potential, positions)
    assert np.abs(gradient).max() > 1e-3
    assert np.abs(hessian).max() > 1.0
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12 * np.abs(hessian).max())
    for _ in range(directions):
        d = rng.standard_normal(positions.shape)
        ahead, behind = positions + h * d, positions - h * d
        slope = (potential.energy(ahead) - potential.energy(behind)) / (2 * h)
        assert np.sum(gradient * d) == pytest.approx(slope, abs=2e-6 * np.linalg.norm(gradient) * np.linalg.norm(d))
        change = (gradient_of(potential, ahead) - gradient_of(potential, behind)).ravel() / (2 * h)
        np.testing.assert_allclose(hessian @ d.ravel(), change, atol=1e-6 * np.abs(change).max())


# --- kernels


@pytest.mark.kernel
def test_closest_rotation_agrees_with_the_singular_value_decomposition():
    rng = np.random.default_rng(0)
    rotation = np.empty((3, 3))
    for case in range(60):
        left, right = Rotation.random(rng=rng).as_matrix(), Rotation.random(rng=rng).as_matrix()
        values = np.sort(rng.uniform(0.2, 2.0, 3))[::-1]
        if case % 3 == 1:
            values[2] *= -0.9  # inverted
        elif case % 3 == 2:
            values[2] = 10.0 ** -rng.uniform(2, 14)  # flat
        closest_rotation(left @ np.diag(values) @ right.T, rotation)
        np.testing.assert_allclose(rotation, left @ right.T, atol=1e-12 if case % 3 == 0 else 1e-11)
        assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.kernel
@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), -np.eye(3), np.diag([1.0, 0, 0]), np.diag([1.0, -1, 0]),
                                    np.diag([1e-150, 1e-150, 1e-150]), 1e100 * np.eye(3), np.diag([1.0, -1, -1])])
def test_closest_rotation_is_a_rotation_for_degenerate_matrices(matrix):
    rotation = np.empty((3, 3))
    closest_rotation(matrix, rotation)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-12)
    best = np.linalg.svd(matrix, compute_uv=False) * [1, 1, np.sign(np.linalg.det(matrix)) or 1]
    assert np.trace(rotation.T @ matrix) == pytest.approx(best.sum(), rel=1e-12)


@pytest.mark.kernel
def test_symmetric_eigen_diagonalises():
    rng = np.random.default_rng(5)
    for n in (3, 4):
        matrix, vectors = rng.standard_normal((n, n)), np.empty((n, n))
        matrix += matrix.T
        values = matrix.copy()
        symmetric_eigen(values, vectors)
        np.testing.assert_allclose((vectors * np.diag(values)) @ vectors.T, matrix, atol=1e-14)
        np.testing.assert_allclose(np.sort(np.diag(values)), np.linalg.eigvalsh(matrix), atol=1e-14)


# --- derivatives


@pytest.mark.kernel
@pytest.mark.parametrize("amount", [0.02, 0.2])
@pytest.mark.parametrize("name", TYPES)
def test_gradient_and_hessian_are_exact(name, amount):
    mesh = small_mesh(name)
    if name == "hex20":
        mesh = box_mesh(SIZE, (1, 1, 1), name)
    check_derivatives(Corotated().potential(mesh, RUBBER), strained(mesh.vertices, amount), directions=2)


@dataclass
class WithoutRotationDerivative:
    """A twin with the usual shortcut: gradient R K u, Hessian R K R^T."""

    exact: CorotatedPotential
    wrong_gradient: bool = False
    wrong_hessian: bool = False

    @property
    def cliques(self):
        return self.exact.cliques

    def energy(self, positions):
        return self.exact.energy(positions)

    def add_gradient(self, positions, gradient):
        if not self.wrong_gradient:
            return self.exact.add_gradient(positions, gradient)
        block = self.exact.blocks[0]
        per_element = block.stiffness[block.kinds]
        for nodes, rest, g, stiffness in zip(block.nodes, block.rest, block.gradients, per_element):
            x = positions[nodes] - positions[nodes].mean(axis=0)
            rotation = self._rotation(x, g)
            gradient[nodes] += (stiffness @ (x @ rotation - rest).ravel()).reshape(-1, 3) @ rotation.T
        return self.energy(positions)

    def add_hessian(self, positions, slots, blocks, *, projected=False):
        if not self.wrong_hessian:
            return self.exact.add_hessian(positions, slots, blocks, projected=projected)
        block = self.exact.blocks[0]
        for nodes, g, stiffness, slot in zip(block.nodes, block.gradients, block.stiffness[block.kinds], slots[0]):
            rotation = self._rotation(positions[nodes], g)
            k = len(nodes)
            turned = np.einsum("pi,aibj,qj->abpq", rotation, stiffness.reshape(k, 3, k, 3), rotation)
            np.add.at(blocks, slot.ravel(), turned.reshape(-1, 3, 3))

    @staticmethod
    def _rotation(x, g):
        u, _, vt = np.linalg.svd(x.T @ g)
        return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


@pytest.mark.parametrize("fault", ["gradient", "hessian"])
@pytest.mark.parametrize("name", ["hex8", "tet10"])
def test_a_twin_that_forgets_how_the_rotation_turns_is_rejected(name, fault):
    mesh = small_mesh(name)
    exact, positions = Corotated().potential(mesh, RUBBER), strained(mesh.vertices, 0.05)
    check_derivatives(WithoutRotationDerivative(exact), positions, directions=2)
    twin = WithoutRotationDerivative(exact, wrong_gradient=fault == "gradient", wrong_hessian=fault == "hessian")
    with pytest.raises(AssertionError):
        check_derivatives(twin, positions, directions=2)


@pytest.mark.parametrize("amount", [1e-4, 1e-2, 0.1, 0.4])
@pytest.mark.parametrize("name", TYPES)
def test_the_projected_hessian_is_semidefinite_and_near_the_exact_one(name, amount):
    mesh = box_mesh(SIZE, (1, 1, 1), name)
    mesh = Mesh(mesh.vertices, {name: mesh.blocks[name][:1]})
    used = np.unique(mesh.blocks[name])
    rows = (3 * used[:, None] + np.arange(3)).ravel()
    potential, negative = Corotated().potential(mesh, RUBBER), 0
    plain = WithoutRotationDerivative(potential, wrong_hessian=True)
    for seed in range(20):
        positions = strained(mesh.vertices, amount, seed=seed)
        exact = dense_hessian(potential, positions)[np.ix_(rows, rows)]
        projected = dense_hessian(potential, positions, projected=True)[np.ix_(rows, rows)]
        values, vectors = np.linalg.eigh(exact)
        scale = values[-1]
        assert np.linalg.eigvalsh(projected)[0] > -1e-13 * scale
        moved = np.linalg.norm(projected - exact, 2)
        if values[0] < -1e-12 * scale:
            negative += 1
            geometric = np.linalg.norm(exact - dense_hessian(plain, positions)[np.ix_(rows, rows)], 2)
            assert moved < 2.0 * geometric or amount > 0.3  # never more than the stress put there, unless folded
        else:  # already semidefinite: nothing to do
            assert moved < 1e-13 * scale
    assert negative > 0


# --- laws


@pytest.mark.parametrize("name", TYPES)
def test_rigid_motion_costs_no_energy(name):
    mesh = small_mesh(name)
    potential = Corotated().potential(mesh, RUBBER)
    scale = RUBBER.youngs_modulus * np.prod(SIZE)
    axis = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    for angle in np.linspace(0, 2 * np.pi, 25):
        positions = Rotation.from_rotvec(angle * axis).apply(mesh.vertices) + [0.1, 0.2, -0.3]
        assert 0 <= potential.energy(positions) < 1e-12 * scale
        assert np.abs(gradient_of(potential, positions)).max() < 1e-9 * RUBBER.youngs_modulus * SIZE[0] ** 2


@pytest.mark.parametrize("name", TYPES)
def test_energy_is_invariant_and_forces_balance(name):
    mesh = small_mesh(name)
    potential, positions = Corotated().potential(mesh, RUBBER), strained(mesh.vertices, 0.1)
    value, gradient = potential.energy(positions), gradient_of(potential, positions)
    assert value > 1e-6
    assert potential.add_gradient(positions, np.zeros_like(positions)) == pytest.approx(value, rel=1e-14)
    for rotvec in np.random.default_rng(2).uniform(-3, 3, (5, 3)):
        moved = Rotation.from_rotvec(rotvec).apply(positions) + [0.3, 0.1, 0.2]
        assert potential.energy(moved) == pytest.approx(value, rel=1e-11)
    scale = np.abs(gradient).max()
    assert np.abs(gradient.sum(axis=0)).max() < 1e-12 * scale
    lever = positions - positions.mean(axis=0)
    assert np.abs(np.cross(lever, gradient).sum(axis=0)).max() < 1e-12 * scale * SIZE[0]


def test_blocks_add_up_and_shifted_bodies_share_rest_data():
    mesh = box_mesh(SIZE, (2, 1, 1))
    bricks = mesh.blocks["hex8"]
    wedges = np.array([bricks[1][[0, 1, 2, 4, 5, 6]], bricks[1][[0, 2, 3, 4, 6, 7]]])
    mixed = Mesh(mesh.vertices, {"hex8": bricks[:1], "wedge6": wedges, "tet4": np.zeros((0, 4), int)})
    potential = Corotated().potential(mixed, RUBBER, first_vertex=5)
    assert [len(nodes) for nodes in potential.cliques] == [1, 2]
    positions = strained(mesh.vertices, 0.1)
    scene = np.vstack([np.full((5, 3), 7.0), positions])
    parts = [Corotated().potential(Mesh(mesh.vertices, {k: v}), RUBBER) for k, v in
             (("hex8", bricks[:1]), ("wedge6", wedges))]
    assert potential.energy(scene) == pytest.approx(sum(p.energy(positions) for p in parts), rel=1e-13)
    gradient = gradient_of(potential, scene)
    assert not np.any(gradient[:5])
    np.testing.assert_allclose(gradient[5:], sum(gradient_of(p, positions) for p in parts), atol=1e-12)
    check_derivatives(potential, scene, directions=2)
    moved = potential.shifted(3)
    assert moved.blocks[0].stiffness is potential.blocks[0].stiffness
    assert moved.cliques[0].min() == potential.cliques[0].min() + 3


def test_materials_outside_the_theory_are_refused():
    for changed in ({"poisson_ratio": 0.5}, {"youngs_modulus": 0.0}):
        values = {"youngs_modulus": 1e6, "poisson_ratio": 0.3, "density": 1.0, **changed}
        with pytest.raises(InputError, match="poisson_ratio"):
            Corotated().potential(small_mesh("hex8"), Material(**values))


# --- patch tests and rates


def stiffness_at_rest(mesh: Mesh, material: Material):
    potential = Corotated().potential(mesh, material)
    pattern = BlockPattern.from_cliques(mesh.n_vertices, potential.cliques)
    blocks = pattern.new_blocks()
    potential.add_hessian(mesh.vertices, tuple(pattern.slots(nodes) for nodes in potential.cliques), blocks)
    return pattern.matrix(blocks).tocsc()


def displacements(mesh: Mesh, material: Material, forces, fixed: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Linear solution (n, 3) under nodal ``forces`` with vertices ``fixed`` moved by ``values``."""
    matrix = stiffness_at_rest(mesh, material)
    solution = np.zeros((mesh.n_vertices, 3))
    solution[fixed] = values
    free = (3 * np.setdiff1d(np.arange(mesh.n_vertices), fixed)[:, None] + np.arange(3)).ravel()
    load = (np.asarray(forces) - (matrix @ solution.ravel()).reshape(-1, 3)).ravel()[free]
    solution.ravel()[free] = sla.spsolve(matrix[free][:, free], load, permc_spec="MMD_AT_PLUS_A")
    return solution


def patch(name: str) -> tuple[Mesh, np.ndarray]:
    mesh = box_mesh((0.04, 0.03, 0.03), (3, 3, 3), name, distort=0.25, seed=1)
    return mesh, np.unique(np.concatenate([f.ravel() for f in mesh.faces.values()]))


@pytest.mark.parametrize("name", TYPES)
def test_a_distorted_patch_takes_a_linear_field_exactly(name):
    mesh, boundary = patch(name)
    inner = np.setdiff1d(np.arange(mesh.n_vertices), boundary)
    assert len(inner) >= 8
    exact = mesh.vertices @ np.random.default_rng(1).standard_normal((3, 3)) * 1e-3
    found = displacements(mesh, RUBBER, np.zeros_like(exact), boundary, exact[boundary])
    assert np.abs(found - exact)[inner].max() < 1e-10 * np.abs(exact).max()


def crooked_patch_error(name: str) -> float:
    """Relative error of a linear field in a patch whose inner edges are curved too."""
    mesh, boundary = patch(name)
    inner = np.setdiff1d(np.arange(mesh.n_vertices), boundary)
    vertices = mesh.vertices.copy()
    vertices[inner] += 6e-4 * np.random.default_rng(3).uniform(-1, 1, (len(inner), 3))
    mesh = Mesh(vertices, mesh.blocks)
    exact = vertices @ np.random.default_rng(1).standard_normal((3, 3)) * 1e-3
    found = displacements(mesh, RUBBER, np.zeros_like(exact), boundary, exact[boundary])
    return float(np.abs(found - exact)[inner].max() / np.abs(exact).max())


@pytest.mark.parametrize("name", ["hex20", "tet10"])
def test_curved_edges_pass_the_patch_test_by_corrected_gradients_only(name, monkeypatch):
    """With straight edges the reduced rules are exact; with curved ones the plain rule is the twin that fails."""
    def plain(kind, vertices, *, start=0):
        return element_stiffness.physical_gradients(kind, vertices, kind.points, kind.weights)

    assert crooked_patch_error(name) < 1e-10
    monkeypatch.setattr(element_stiffness, "consistent_gradients", plain)
    assert crooked_patch_error(name) > 1e-6


@pytest.mark.parametrize("name", TYPES)
def test_a_distorted_patch_is_in_equilibrium_after_a_large_uniform_deformation(name):
    mesh, boundary = patch(name)
    inner = np.setdiff1d(np.arange(mesh.n_vertices), boundary)
    gradient = gradient_of(Corotated().potential(mesh, RUBBER), strained(mesh.vertices, 0.15, noise=0.0))
    assert np.abs(gradient[boundary]).max() > 1.0
    assert np.abs(gradient[inner]).max() < 1e-10 * np.abs(gradient[boundary]).max()


def beam_errors(name: str, level: int) -> tuple[float, float]:
    """Errors of a cantilever (nu = 0) against the exact plane solution: root mean square of u, and of f . u.

    Timoshenko and Goodier, Theory of elasticity, section 21; parabolic shear at the tip, the exact root motion.
    """
    length, depth, width, modulus, force = 0.08, 0.02, 0.02, 1e6, 1e-3
    inertia = width * depth**3 / 12
    mesh = box_mesh((length, depth, width), (4 * level, 2 * level, level), name)
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1] - depth / 2
    exact = np.zeros_like(mesh.vertices)
    exact[:, 0] = force * y / (6 * modulus * inertia) * ((6 * length - 3 * x) * x + 2 * (y**2 - depth**2 / 4))
    exact[:, 1] = -force / (6 * modulus * inertia) * (depth**2 * x + (3 * length - x) * x**2)

    def shear(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        value = -force / (2 * inertia) * (depth**2 / 4 - (points[:, 1] - depth / 2) ** 2)
        return value[:, None] * [0.0, 1.0, 0.0]

    load, root = face_tractions(mesh, "xmax", shear), mesh.node_sets["xmin"]
    found = displacements(
        mesh, Material(youngs_modulus=modulus, poisson_ratio=0.0, density=1.0), load, root, exact[root]
    )
    work = np.sum(load * exact)
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact)), abs(np.sum(load * found) / work - 1)


@pytest.mark.parametrize(("name", "levels", "rate", "error"), [
    ("hex8", (1, 2, 4), 1.9, 1.2e-3), ("wedge6", (2, 4, 8), 1.5, 0.035), ("tet4", (2, 4, 8), 1.5, 0.035),
    ("tet10", (1, 2, 4), 3.3, 4e-5), ("hex20", (1, 2), 3.2, 1.2e-6),
])
def test_a_cantilever_converges_at_the_elements_rate(name, levels, rate, error):
    errors = np.array([beam_errors(name, level) for level in levels])
    rates = np.log2(errors[:-1] / errors[1:])
    assert np.all(rates[-1] > rate), rates
    assert errors[-1].max() < error, errors


def bending_ratio(name: str, layers: int, poisson: float, *, across: int = 1) -> float:
    """Tip displacement of a slender cantilever, thin along axis ``across``, over beam theory (Timoshenko's)."""
    length, depth, width, modulus = 0.08, 0.008, 0.02, 1e6
    size, divisions = (length, width, depth), (8 * layers, 2 * layers, layers)
    if across == 1:
        size, divisions = (length, depth, width), (8 * layers, layers, layers)
    mesh = box_mesh(size, divisions, name)
    load = face_tractions(mesh, "xmax", -np.eye(3)[across] / (depth * width))
    root = mesh.node_sets["xmin"]
    material = Material(youngs_modulus=modulus, poisson_ratio=poisson, density=1.0)
    found = displacements(mesh, material, load, root, np.zeros((len(root), 3)))
    shear = length * 2 * (1 + poisson) / (5 / 6 * modulus * depth * width)
    return float(np.sum(load * found)) / (length**3 / (3 * modulus * width * depth**3 / 12) + shear)


def test_thin_walls_bend_with_one_hexahedron_through_them_and_lock_with_one_tetrahedron():
    assert bending_ratio("hex8", 1, 0.0) == pytest.approx(1.0, abs=0.01)
    assert bending_ratio("hex8", 1, 0.49) == pytest.approx(0.90, abs=0.02)  # the clamped root stiffens: not locking
    assert bending_ratio("hex20", 2, 0.49) == pytest.approx(0.91, abs=0.03)
    assert bending_ratio("tet10", 2, 0.49) > 0.85
    assert bending_ratio("tet4", 1, 0.49) < 0.05
    assert bending_ratio("wedge6", 1, 0.49) > 3 * bending_ratio("tet4", 1, 0.49)


def test_wedges_bend_out_of_their_triangles_plane_and_are_never_too_soft():
    ratios = [bending_ratio("wedge6", layers, 0.49, across=2) for layers in (1, 2, 4)]
    assert 0.55 < ratios[0] < ratios[1] < ratios[2] < 1.0
    assert ratios[2] > 0.85


@pytest.mark.parametrize("name", ["hex8", "tet4", "tet10"])
def test_an_inverted_element_finds_back_to_its_rest_shape(name):
    mesh = box_mesh((0.01, 0.01, 0.01), (1, 1, 1), name)
    mesh = Mesh(mesh.vertices, {name: mesh.blocks[name][:1]})
    used = np.unique(mesh.blocks[name])
    potential = Corotated().potential(mesh, RUBBER)
    positions = mesh.vertices * [1.0, 1.0, -0.8]
    positions[used] += 3e-4 * np.random.default_rng(0).standard_normal((len(used), 3))
    rows = (3 * used[:, None] + np.arange(3)).ravel()
    start = value = potential.energy(positions)
    for _ in range(60):
        gradient = gradient_of(potential, positions).ravel()[rows]
        hessian = dense_hessian(potential, positions, projected=True)[np.ix_(rows, rows)]
        hessian += 1e-4 * np.trace(hessian) / len(rows) * np.eye(len(rows))
        step, share = np.linalg.solve(hessian, -gradient), 1.0
        while share > 1e-6:
            trial = positions.copy()
            trial.ravel()[rows] += share * step
            if potential.energy(trial) <= value + 1e-4 * share * gradient @ step:
                positions, value = trial, potential.energy(trial)
                break
            share /= 2
    assert np.isfinite(start)
    assert start > 1e-3
    assert value < 1e-12 * start
