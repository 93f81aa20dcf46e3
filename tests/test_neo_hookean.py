"""The neo-Hookean potential: derivatives, closed forms, its limit of small strain, and where it ends."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.sparse.linalg as sla
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from test_corotated import (
    RUBBER,
    SIZE,
    TYPES,
    check_derivatives,
    dense_hessian,
    gradient_of,
    patch,
    strained,
)

from finqd.errors import InputError
from finqd.mechanics import neo_hookean_kernels as kernels
from finqd.mechanics.loads import face_tractions
from finqd.mechanics.material import Material
from finqd.mechanics.pattern import BlockPattern
from finqd.mesh import Mesh
from finqd.mesh_shapes import box_mesh
from finqd.plugins.elasticity_corotated import Corotated
from finqd.plugins.elasticity_neo_hookean import NeoHookean

MU = RUBBER.lame[1]
KAPPA = RUBBER.lame[0] + 2 * MU / 3
BULK = ("hex8", "wedge6", "tet10", "hex20")


def one_brick(name: str) -> Mesh:
    mesh = box_mesh(SIZE, (1, 1, 1), name)
    return Mesh(mesh.vertices, {name: mesh.blocks[name][:1]})


def equilibrium(potential, start: np.ndarray, forces, free: np.ndarray, *, tolerance: float = 1e-8) -> np.ndarray:
    """Newton's method with a line search; a projected Hessian where the exact one is no use."""
    pattern = BlockPattern.from_cliques(len(start), potential.cliques)
    slots = tuple(pattern.slots(nodes) for nodes in potential.cliques)
    x, rows = start.copy(), np.flatnonzero(free.ravel())
    for _ in range(80):
        gradient = gradient_of(potential, x) - forces
        residual, scale = gradient.ravel()[rows], np.abs(gradient - np.where(free, gradient, 0)).max()
        if np.abs(residual).max() < tolerance * max(scale, np.abs(forces).max()):
            return x
        for projected in (False, True):
            blocks = pattern.new_blocks()
            potential.add_hessian(x, slots, blocks, projected=projected)
            matrix = pattern.matrix(blocks).tocsc()[rows][:, rows]
            step = np.zeros(x.size)
            step[rows] = -sla.spsolve(matrix, residual, permc_spec="MMD_AT_PLUS_A")
            slope = float(step[rows] @ residual)
            if slope < 0:
                break
        share, before = 1.0, potential.energy(x) - np.sum(forces * x)
        while share > 1e-9:
            trial = x + share * step.reshape(-1, 3)
            if potential.energy(trial) - np.sum(forces * trial) <= before + 1e-4 * share * slope + 1e-13 * abs(before):
                break
            share /= 2
        x = trial
    raise AssertionError("no equilibrium")


# --- derivatives


@pytest.mark.kernel
@pytest.mark.parametrize("amount", [0.02, 0.2])
@pytest.mark.parametrize("name", TYPES)
def test_gradient_and_hessian_are_exact(name, amount):
    mesh = one_brick(name)
    check_derivatives(NeoHookean().potential(mesh, RUBBER), strained(mesh.vertices, amount), directions=2, h=5e-9)


@pytest.mark.parametrize("name", TYPES)
def test_derivatives_are_exact_in_distorted_meshes(name):
    mesh = box_mesh(SIZE, (3, 3, 3) if name != "hex20" else (2, 2, 1), name, distort=0.2)
    check_derivatives(NeoHookean().potential(mesh, RUBBER), strained(mesh.vertices, 0.1), directions=2, h=5e-9)


class WithoutRelaxation:
    """A twin whose gradient takes the inner modes as they are at rest."""

    def __init__(self, exact) -> None:
        self.exact, self.cliques = exact, exact.cliques

    def energy(self, positions):
        return self.exact.energy(positions)

    def add_gradient(self, positions, gradient):
        for b in self.exact.blocks:
            rigid = np.zeros((len(b.nodes), 3, b.shapes.shape[1] - b.nodes.shape[1]))
            kernels.add_gradient(*self.exact._arguments(b), positions, rigid, True, gradient)

    def add_hessian(self, *arguments, **options):
        self.exact.add_hessian(*arguments, **options)


@pytest.mark.parametrize("name", ["hex8", "wedge6"])
def test_a_twin_that_forgets_its_inner_modes_is_rejected(name):
    mesh = one_brick(name)
    exact, positions = NeoHookean().potential(mesh, RUBBER), strained(mesh.vertices, 0.05)
    check_derivatives(exact, positions, directions=1, h=5e-9)
    with pytest.raises(AssertionError):
        check_derivatives(WithoutRelaxation(exact), positions, directions=1, h=5e-9)


@pytest.mark.parametrize("name", TYPES)
def test_the_projected_hessian_is_semidefinite_and_exact_where_it_can_be(name):
    mesh, potential = one_brick(name), NeoHookean().potential(one_brick(name), RUBBER)
    rows = (3 * np.unique(mesh.blocks[name])[:, None] + np.arange(3)).ravel()
    negative = 0
    for seed, amount in enumerate((1e-4, 1e-2, 0.1, 0.2, 0.2, 0.25)):
        positions = strained(mesh.vertices, amount, seed=seed)
        exact, projected = (
            dense_hessian(potential, positions, projected=flag)[np.ix_(rows, rows)] for flag in (False, True)
        )
        values, vectors = np.linalg.eigh(exact)
        clamped = (vectors * np.maximum(values, 0)) @ vectors.T
        assert np.abs(projected - clamped).max() < 1e-11 * values[-1]
        negative += bool(values[0] < -1e-9 * values[-1])
    assert negative > 0


# --- laws


@pytest.mark.parametrize("name", TYPES)
def test_at_rest_every_element_has_the_stiffness_of_the_corotated_law(name):
    mesh = box_mesh(SIZE, (3, 3, 3) if name != "hex20" else (2, 2, 2), name, distort=0.25)
    expected = dense_hessian(Corotated().potential(mesh, RUBBER), mesh.vertices)
    found = dense_hessian(NeoHookean().potential(mesh, RUBBER), mesh.vertices)
    np.testing.assert_allclose(found, expected, atol=1e-13 * np.abs(expected).max())


@pytest.mark.parametrize("name", TYPES)
def test_a_turn_costs_no_energy_at_any_angle(name):
    mesh = box_mesh(SIZE, (2, 1, 1), name)
    potential, scale = NeoHookean().potential(mesh, RUBBER), RUBBER.youngs_modulus * np.prod(SIZE)
    bent = strained(mesh.vertices, 0.1)
    value = potential.energy(bent)
    assert value > 1e-4 * scale
    for angle in np.linspace(0, 2 * np.pi, 13):
        turn = Rotation.from_rotvec(angle * np.array([0.6, 0.0, 0.8]))
        assert abs(potential.energy(turn.apply(mesh.vertices) + [0.1, 0.2, -0.3])) < 1e-12 * scale
        assert np.abs(gradient_of(potential, turn.apply(mesh.vertices))).max() < 1e-9 * scale / SIZE[0]
        assert potential.energy(turn.apply(bent)) == pytest.approx(value, rel=1e-10)


def first_stress(f: np.ndarray) -> np.ndarray:
    """The first Piola-Kirchhoff stress of W, written out anew [Pa]."""
    j, inverse = np.linalg.det(f), np.linalg.inv(f).T
    return MU * j ** (-2 / 3) * (f - np.sum(f * f) / 3 * inverse) + KAPPA / 2 * (j * j - 1) * inverse


def uniaxial(stretch: float) -> tuple[np.ndarray, float]:
    """F and the nominal stress of a bar pulled to ``stretch``, from W as a function of the principal stretches."""
    def lateral(t: float) -> float:
        j = stretch * t * t
        return MU * j ** (-2 / 3) * (t - (stretch**2 + 2 * t * t) / (3 * t)) + KAPPA / 2 * (j - 1 / j) * stretch * t

    t = brentq(lateral, 0.3, 3.0, xtol=1e-14)
    j = stretch * t * t
    pull = MU * j ** (-2 / 3) * (stretch - (stretch**2 + 2 * t * t) / (3 * stretch)) + KAPPA / 2 * (j - 1 / j) * t * t
    return np.diag([stretch, t, t]), pull


@pytest.mark.parametrize("name", TYPES)
def test_uniform_deformations_of_a_distorted_patch_have_the_closed_forms_forces(name):
    mesh, boundary = patch(name)
    potential = NeoHookean().potential(mesh, RUBBER)
    inner = np.setdiff1d(np.arange(mesh.n_vertices), boundary)
    cases = [uniaxial(stretch) for stretch in (0.6, 1.5, 2.5)]
    shear = np.eye(3) + 0.8 * np.outer([1, 0, 0], [0, 1, 0])
    assert first_stress(shear)[:2, 1] == pytest.approx([0.8 * MU, -0.64 * MU / 3])
    for f, pull in [*cases, (shear, None)]:
        gradient = gradient_of(potential, Rotation.from_rotvec([1, 2, 0.5]).apply(mesh.vertices @ f.T))
        gradient = Rotation.from_rotvec([1, 2, 0.5]).inv().apply(gradient)
        assert np.abs(gradient[inner]).max() < 1e-10 * np.abs(gradient).max()
        stress = first_stress(f)
        expected = face_tractions(mesh, {k: np.arange(len(v)) for k, v in mesh.faces.items()},
                                  lambda points, normals, p=stress: normals @ p.T)
        np.testing.assert_allclose(gradient, expected, atol=1e-9 * np.abs(expected).max())
        if pull is not None:
            np.testing.assert_allclose(stress, np.diag([pull, 0, 0]), atol=1e-9 * KAPPA)
            exact = 0.03 * 0.03 * pull
            assert expected[mesh.node_sets["xmax"], 0].sum() == pytest.approx(exact, rel=1e-9)


def test_small_strain_energies_are_not_lost_in_rounding():
    mesh = one_brick("hex8")
    stretched = mesh.vertices * [1 + 1e-8, 1, 1]
    exact = 0.5 * (KAPPA + 4 * MU / 3) * 1e-16 * np.prod(SIZE)
    assert NeoHookean().potential(mesh, RUBBER).energy(stretched) == pytest.approx(exact, rel=1e-6)


@pytest.mark.kernel
@pytest.mark.parametrize("name", TYPES)
def test_an_inverted_element_costs_infinite_energy(name):
    mesh = one_brick(name)
    potential = NeoHookean().potential(mesh, RUBBER)
    for flipped in (mesh.vertices * [1, 1, -1], mesh.vertices * [1, 1, 0], np.full_like(mesh.vertices, math.nan)):
        gradient = np.zeros_like(flipped)
        assert potential.energy(flipped) == math.inf
        assert potential.add_gradient(flipped, gradient) == math.inf
        assert np.all(np.isfinite(dense_hessian(potential, flipped, projected=True)))
    assert math.isfinite(potential.energy(mesh.vertices * [1, 1, 0.05]))


def test_what_was_asked_before_changes_no_bit():
    mesh = box_mesh(SIZE, (2, 2, 1), "hex8", distort=0.2)
    here, there = strained(mesh.vertices, 0.1), strained(mesh.vertices, 0.15, seed=4)
    fresh = NeoHookean().potential(mesh, RUBBER)
    expected = fresh.energy(here), gradient_of(fresh, here), dense_hessian(NeoHookean().potential(mesh, RUBBER), here)
    used = NeoHookean().potential(mesh, RUBBER)
    for other in (there, mesh.vertices * [1, 1, -1], mesh.vertices):
        used.energy(other)
        assert used.energy(here) == expected[0]
        assert np.array_equal(gradient_of(used, here), expected[1])
        assert np.array_equal(dense_hessian(used, here), expected[2])
    moving = here.copy()
    used.energy(moving)
    moving += 1e-4 * there  # the caller may write to its array
    assert used.energy(moving) == NeoHookean().potential(mesh, RUBBER).energy(moving)


def test_mixed_blocks_and_shifted_bodies_add_up():
    mesh = box_mesh(SIZE, (2, 1, 1))
    bricks = mesh.blocks["hex8"]
    wedges = np.array([bricks[1][[0, 1, 2, 4, 5, 6]], bricks[1][[0, 2, 3, 4, 6, 7]]])
    mixed = Mesh(mesh.vertices, {"hex8": bricks[:1], "wedge6": wedges, "tet4": np.zeros((0, 4), int)})
    positions = strained(mesh.vertices, 0.1)
    scene = np.vstack([np.full((5, 3), 7.0), positions])
    parts = [NeoHookean().potential(Mesh(mesh.vertices, {k: v}), RUBBER)
             for k, v in (("hex8", bricks[:1]), ("wedge6", wedges))]
    potential = NeoHookean().potential(mixed, RUBBER, first_vertex=5)
    assert potential.energy(scene) == pytest.approx(sum(p.energy(positions) for p in parts), rel=1e-13)
    check_derivatives(potential, scene, directions=2, h=5e-9)
    with pytest.raises(InputError, match="poisson_ratio"):
        NeoHookean().potential(mesh, Material(youngs_modulus=1e6, poisson_ratio=0.5, density=1.0))


# --- boundary value problems


def cook(name: str, n: int, poisson: float, potential_of) -> float:
    """Cook's membrane, linear, by the potential's rest stiffness: rise [mm] of the top right corner."""
    box = box_mesh((1, 1, 1), (n, n, 1), name)
    x, y, z = box.vertices.T
    vertices = 1e-3 * np.stack([48 * x, 44 * x * (1 - y) + (44 + 16 * x) * y, 5 * z], axis=1)
    mesh = Mesh(vertices, box.blocks, box.node_sets, box.face_sets)
    potential = potential_of(mesh, Material(youngs_modulus=70e6, poisson_ratio=poisson, density=1.0))
    pattern = BlockPattern.from_cliques(mesh.n_vertices, potential.cliques)
    blocks = pattern.new_blocks()
    potential.add_hessian(vertices, tuple(pattern.slots(nodes) for nodes in potential.cliques), blocks)
    free = np.ones(vertices.shape, dtype=bool)
    free[:, 2] = (z > 1e-9) & (z < 1 - 1e-9)
    free[mesh.node_sets["xmin"]] = False
    rows = np.flatnonzero(free.ravel())
    load = face_tractions(mesh, "xmax", (0.0, 6.25e6, 0.0)).ravel()[rows]
    found = np.zeros(vertices.size)
    found[rows] = sla.spsolve(pattern.matrix(blocks).tocsc()[rows][:, rows], load, permc_spec="MMD_AT_PLUS_A")
    return 1e3 * float(found.reshape(-1, 3)[(x > 1 - 1e-9) & (y > 1 - 1e-9), 1].mean())


def test_cooks_membrane_does_not_lock():
    values = [cook("hex8", n, 0.4999, NeoHookean().potential) for n in (8, 16, 32)]
    assert values[0] < values[1] < values[2] < 28.0
    assert values[2] == pytest.approx(28.0, rel=0.02)
    assert cook("hex20", 16, 0.4999, NeoHookean().potential) == pytest.approx(28.0, rel=0.03)
    assert cook("hex8", 16, 1 / 3, NeoHookean().potential) == pytest.approx(32.0, rel=0.015)
    assert cook("tet4", 8, 0.4999, NeoHookean().potential) < 12.0  # the one that locks, in the same harness


@pytest.mark.slow
def test_cooks_membrane_on_a_fine_mesh():
    assert cook("hex8", 64, 0.4999, NeoHookean().potential) == pytest.approx(28.0, rel=0.015)


def test_a_beam_bends_as_the_elastica():
    length, depth, modulus = 0.1, 0.002, 1e7
    mesh = box_mesh((length, depth, depth), (40, 1, 1))
    potential = NeoHookean().potential(mesh, Material(youngs_modulus=modulus, poisson_ratio=0.0, density=1.0))
    free, x = np.ones(mesh.vertices.shape, dtype=bool), mesh.vertices.copy()
    free[mesh.node_sets["xmin"]] = False
    for share, along, down in ((0.5, None, None), (1, 0.05643, 0.30172), (2, 0.16064, 0.49346), (4, 0.32894, 0.66996)):
        pull = share * modulus * depth**4 / 12 / length**2 / depth**2
        x = equilibrium(potential, x, face_tractions(mesh, "xmax", (0.0, -pull, 0.0)), free)
        moved = (x - mesh.vertices)[mesh.node_sets["xmax"]].mean(axis=0) / length
        if down is not None:
            assert -moved[:2] == pytest.approx([along, down], rel=5e-3)


def squeezed(name: str, share: float, *, bonded: bool, cells: int) -> tuple[float, float]:
    """A cube of rubber pressed to ``share`` of its height: force [N], and the lowest eigenvalue over the median."""
    mesh = box_mesh((0.01, 0.01, 0.01), (cells, cells, cells), name)
    potential, free = NeoHookean().potential(mesh, RUBBER), np.ones(mesh.vertices.shape, dtype=bool)
    ends = [mesh.node_sets["zmin"], mesh.node_sets["zmax"]]
    for nodes in ends:
        free[nodes, 2] = False
        free[nodes, :2] = not bonded
    if not bonded:
        free[mesh.node_sets["xmin"], 0] = free[mesh.node_sets["ymin"], 1] = False
    x, at = mesh.vertices.copy(), 1.0
    for height in np.linspace(1, share, 1 + math.ceil((1 - share) / 0.1))[1:]:
        x[:, 2] *= height / at
        if not bonded:
            x[:, :2] *= (at / height) ** 0.5
        x, at = equilibrium(potential, x, np.zeros_like(x), free), height
    rows = np.flatnonzero(free.ravel())
    values = np.linalg.eigvalsh(dense_hessian(potential, x)[np.ix_(rows, rows)])
    return -float(gradient_of(potential, x)[ends[1], 2].sum()), values[0] / np.median(values)


@pytest.mark.parametrize("name", BULK)
def test_a_block_between_smooth_plates_is_pressed_as_the_closed_form_says_and_is_stable(name):
    force, lowest = squeezed(name, 0.7, bonded=False, cells=2)
    assert force == pytest.approx(-1e-4 * uniaxial(0.7)[1], rel=1e-8)
    assert lowest > 1e-3


def test_strong_compression_is_for_quadratic_elements():
    """A known limit of enhanced modes: pressed to 60 %, hexahedra with eight nodes fold into hourglasses."""
    assert squeezed("hex8", 0.6, bonded=False, cells=3)[1] < 0.0
    assert squeezed("hex20", 0.6, bonded=False, cells=2)[1] > 1e-3
    fine, coarse = squeezed("hex20", 0.8, bonded=True, cells=2)[0], squeezed("hex8", 0.8, bonded=True, cells=4)[0]
    assert coarse == pytest.approx(fine, rel=0.05)
