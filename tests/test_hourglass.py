"""The energy that keeps quadratic hexahedra from folding: derivatives, what it leaves alone, and what it prevents."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.mechanics.hourglass import CALM, SOFT, STEEP, folding_limit
from finqd.mechanics.material import Material
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.rotation_kernels import rotation_matrix
from finqd.mesh_shapes import box_mesh, quadratic
from finqd.plugins.elasticity_corotated import Corotated
from finqd.plugins.elasticity_neo_hookean import NeoHookean

pytestmark = pytest.mark.kernel
SHEAR = 4e5
MESH = quadratic(box_mesh((0.02, 0.004, 0.003), (1, 1, 1)))


def limit():
    return folding_limit("hex20", MESH.blocks["hex20"], MESH.vertices, SHEAR)


def folded(size: float) -> np.ndarray:
    """Return positions of the element with random noise of about ``size`` [m]."""
    return MESH.vertices + size * np.random.default_rng(3).normal(size=MESH.vertices.shape)


def share(positions: np.ndarray) -> float:
    """Return g of the element at ``positions``."""
    found = limit()
    x = positions[MESH.blocks["hex20"][0]]
    return float(np.einsum("ab,ai,bi->", found.laplacians[0], x, x) / found.volumes[0])


def hessian(positions: np.ndarray) -> np.ndarray:
    """Return the Hessian as a full matrix [N/m]."""
    found = limit()
    pattern = BlockPattern.from_cliques(MESH.n_vertices, [found.nodes])
    blocks = pattern.new_blocks()
    found.add_hessian(positions, pattern.slots(found.nodes), blocks)
    return pattern.matrix(blocks).toarray()


@pytest.mark.parametrize(("size", "least", "most"), [(5e-4, 0.0, SOFT), (1e-3, SOFT, STEEP), (2e-3, STEEP, np.inf)])
def test_gradient_and_hessian_are_derivatives(size, least, most):
    positions, found, h = folded(size), limit(), 1e-9
    assert least < share(positions) - CALM < most, "each branch is looked at"
    gradient = np.zeros_like(positions)
    energy = found.add_gradient(positions, gradient)
    assert energy == found.energy(positions) > 0.0
    direction = np.random.default_rng(5).normal(size=positions.shape)
    slope = (found.energy(positions + h * direction) - found.energy(positions - h * direction)) / (2 * h)
    assert slope == pytest.approx(np.vdot(gradient, direction), rel=1e-6)
    forward, backward = np.zeros_like(positions), np.zeros_like(positions)
    found.add_gradient(positions + h * direction, forward)
    found.add_gradient(positions - h * direction, backward)
    change = ((forward - backward) / (2 * h)).ravel()
    matrix = hessian(positions)
    np.testing.assert_allclose(matrix @ direction.ravel(), change, rtol=1e-5, atol=1e-6 * np.abs(change).max())
    assert np.linalg.eigvalsh(matrix).min() > -1e-9 * np.abs(matrix).max()


def test_affine_motions_and_ordinary_strains_cost_nothing():
    found = limit()
    stretch = rotation_matrix(np.array([0.4, -1.0, 2.0])) @ (np.eye(3) + np.diag([0.3, -0.4, 0.2]) + 0.1)
    assert share(MESH.vertices @ stretch.T + 0.7) < 1e-10
    bent = MESH.vertices.copy()
    bent[:, 2] += 2.0 * bent[:, 0] ** 2  # by 4.6 degrees over its length
    for positions in (MESH.vertices, bent, folded(1e-4)):
        gradient = np.zeros_like(positions)
        assert found.add_gradient(positions, gradient) == 0.0 and not gradient.any() and not hessian(positions).any()


@pytest.mark.parametrize("plugin", [Corotated(), NeoHookean()])
def test_both_laws_have_it_and_other_types_do_not(plugin, monkeypatch):
    material = Material(youngs_modulus=1e6, poisson_ratio=0.3, density=1000.0)
    positions = folded(7e-4)
    whole = plugin.potential(MESH, material).energy(positions)
    shear = material.lame[1]
    own = folding_limit("hex20", MESH.blocks["hex20"], MESH.vertices, shear).energy(positions)
    monkeypatch.setattr("finqd.mechanics.hourglass.HARDENING", 0.0)
    without = plugin.potential(MESH, material).energy(positions)
    assert np.isfinite(whole) and whole - without == pytest.approx(own, rel=1e-9)
    plain = box_mesh((0.02, 0.004, 0.003), (1, 1, 1))
    assert folding_limit("hex8", plain.blocks["hex8"], plain.vertices, SHEAR) is None
