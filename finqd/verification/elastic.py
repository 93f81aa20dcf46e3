"""Elements and elasticities alone: patch test, rigid rotation, Cook's membrane, order of convergence in the mesh.

All go through the energy, gradient and Hessian that a grasp is made of (`finqd.contracts.ElasticPotential`).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from finqd import registry
from finqd.errors import InputError
from finqd.mechanics.assembly_kernels import hold
from finqd.mechanics.elements import element as reference_element
from finqd.mechanics.elements import element_rule
from finqd.mechanics.linear_backends import create_factorisation
from finqd.mechanics.loads import face_tractions
from finqd.mechanics.material import Material
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.rotation_kernels import rotation_matrix
from finqd.mesh import Mesh
from finqd.mesh_shapes import box_mesh
from finqd.units import MM, MPA
from finqd.verification.cases import Failed
from finqd.verification.meshes import cook_mesh

ELEMENTS = ("hex8", "hex20", "wedge6", "tet4", "tet10")
QUADRATIC = ("hex20", "tet10")
RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.45, density=1000.0)
STEELLIKE = Material(youngs_modulus=1e6, poisson_ratio=0.3, density=1000.0)


# -- tools -------------------------------------------------------------------------------------------------------------


def potential_of(mesh: Mesh, material: Material, elasticity: Any) -> Any:
    """Return the elastic potential of a mesh; ``elasticity`` is a plugin or its name."""
    if isinstance(elasticity, str):
        elasticity = registry.create("elasticity", elasticity)
    return elasticity.potential(mesh, material)


def stiffness(mesh: Mesh, potential: Any, positions: np.ndarray) -> tuple[BlockPattern, np.ndarray]:
    """Return the Hessian at ``positions`` [N/m]: its pattern and its blocks (n_blocks + 1, 3, 3)."""
    pattern = BlockPattern.from_cliques(mesh.n_vertices, potential.cliques)
    blocks = pattern.new_blocks()
    potential.add_hessian(positions, tuple(pattern.slots(nodes) for nodes in potential.cliques), blocks)
    return pattern, blocks


def solve(
    hessian: tuple[BlockPattern, np.ndarray], right: np.ndarray, fixed: np.ndarray, values: np.ndarray
) -> np.ndarray:
    """Solve hessian u = right (n, 3) where the dofs ``fixed`` (n, 3) bool have the ``values`` (n, 3); return u."""
    pattern, blocks = hessian
    matrix, free = pattern.matrix(blocks), ~fixed.ravel()
    found = np.where(fixed, values, 0.0).ravel()
    load = np.where(free, right.ravel() - matrix @ found, 0.0)
    held = blocks.copy()
    hold(pattern.indptr, pattern.indices, fixed, held, np.zeros((fixed.size, 0)))
    factors = create_factorisation("auto", pattern)
    if not factors.factorise(held):
        raise Failed("the stiffness is not positive definite")
    step = np.zeros_like(load)
    for _ in range(2):  # the second time refines, for nearly incompressible materials
        step += np.where(free, factors.solve((load - np.where(free, matrix @ step, 0.0))[:, None])[:, 0], 0.0)
    left = np.linalg.norm((matrix @ step - load)[free])
    backward = left / (np.abs(blocks).max() * np.linalg.norm(step) + np.linalg.norm(load) + 1e-300)
    if not backward < 1e-12:
        raise Failed(f"the direct solver left a backward error of {backward:.1e}")
    return (found + step).reshape(-1, 3)


def supported(elasticity: str, element: str) -> bool:
    """Say whether an elasticity knows an element type."""
    try:
        potential_of(box_mesh((1.0, 1.0, 1.0), (1, 1, 1), element), RUBBER, elasticity)
    except InputError:
        return False
    return True


def small_rotation(elasticity: str) -> bool:
    """Say whether an elasticity declares that it is good for small rotations only."""
    return bool(getattr(registry.load("elasticity", elasticity), "small_rotation", False))


# -- patch test --------------------------------------------------------------------------------------------------------


def patch_error(element: str, elasticity: Any = "corotated", *, seed: int = 1) -> float:
    """Return by how much the inner nodes of a distorted patch leave a large uniform deformation that its boundary has.

    The displacement of inner nodes that the out-of-balance forces at the exact field ask for, H^-1 g, over the largest
    displacement (Irons and Razzaque 1972). The field turns by half a radian and strains by 10 %.
    """
    mesh = box_mesh((0.04, 0.03, 0.03), (3, 3, 3), element, distort=0.25, seed=seed)
    boundary = np.unique(np.concatenate([faces.ravel() for faces in mesh.faces.values()]))
    stretch = np.eye(3) + 0.1 * np.array([[1.0, 0.3, -0.2], [0.3, -0.6, 0.4], [-0.2, 0.4, 0.5]])
    exact = mesh.vertices @ (rotation_matrix(np.array([0.3, -0.2, 0.35])) @ stretch).T
    potential = potential_of(mesh, RUBBER, elasticity)
    gradient = np.zeros_like(exact)
    potential.add_gradient(exact, gradient)
    if not np.abs(gradient[boundary]).max() > 1.0:
        raise Failed("the deformed patch carries no stress")
    fixed = np.zeros(exact.shape, dtype=bool)
    fixed[boundary] = True
    if int(np.sum(~fixed)) < 24:
        raise Failed("the patch has too few inner nodes")
    off = solve(stiffness(mesh, potential, exact), -gradient, fixed, np.zeros_like(exact))
    return float(np.abs(off).max() / np.abs(exact - mesh.vertices).max())


def rotation_energy(element: str, elasticity: Any = "corotated") -> float:
    """Return the largest energy of a distorted body that is turned through 360 degrees, over modulus times volume."""
    mesh = box_mesh((0.04, 0.03, 0.03), (2, 2, 2), element, distort=0.2, seed=2)
    potential = potential_of(mesh, RUBBER, elasticity)
    axis = np.array([1.0, 2.0, -2.0]) / 3.0
    energies = [
        abs(potential.energy(mesh.vertices @ rotation_matrix(angle * axis).T + (0.1, -0.2, 0.3)))
        for angle in np.linspace(0.0, 2.0 * np.pi, 25)
    ]
    return float(np.max(energies) / (RUBBER.youngs_modulus * mesh.volume))


# -- Cook's membrane ---------------------------------------------------------------------------------------------------

COOK_MODULUS, COOK_SHEAR = 70 * MPA, 6.25 * MPA


@cache
def cook(element: str, n: int, poisson_ratio: float, elasticity: str = "corotated") -> float:
    """Return the vertical displacement [m] at the top right of Cook's membrane, linear, u_z = 0 on both faces."""
    mesh = cook_mesh(n, element)
    material = Material(youngs_modulus=COOK_MODULUS, poisson_ratio=poisson_ratio, density=1000.0)
    potential = potential_of(mesh, material, elasticity)
    fixed = np.zeros(mesh.vertices.shape, dtype=bool)
    fixed[mesh.node_sets["xmin"]] = True
    fixed[np.union1d(mesh.node_sets["zmin"], mesh.node_sets["zmax"]), 2] = True
    load = face_tractions(mesh, "xmax", (0.0, COOK_SHEAR, 0.0))
    found = solve(stiffness(mesh, potential, mesh.vertices), load, fixed, np.zeros(fixed.shape))
    corner = np.linalg.norm(mesh.vertices[:, :2] - (48 * MM, 60 * MM), axis=1) < 1e-9
    return float(found[corner, 1].mean())


# -- order in the mesh -------------------------------------------------------------------------------------------------


def _smooth_field(points: np.ndarray, material: Material, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a smooth displacement (n, 3) and the body force (n, 3) [N/m^3] that causes it in linear elasticity.

    u_i = A sin(k_i . x + i) with wave vectors k_i; -f = mu lap u + (lambda + mu) grad div u.
    """
    lam, mu = material.lame
    waves = np.array([[1.0, 0.7, -0.4], [-0.6, 0.9, 0.8], [0.5, -0.8, 1.0]]) * 2.0 / size
    phase = points @ waves.T + np.arange(3)
    amplitude = 1e-4 * size
    field = amplitude * np.sin(phase)
    force = mu * field * np.sum(waves**2, axis=1)
    for i in range(3):  # d/dx_j of du_i/dx_i, for all j
        force += (lam + mu) * field[:, i : i + 1] * waves[i, i] * waves[i]
    return field, force


def field_error(element: str, n: int, elasticity: Any = "corotated") -> float:
    """Return the L2 norm of the error of a manufactured smooth field in a cube of n^3 bricks, over that of the field.

    The boundary is prescribed, body forces are consistent; both norms are integrals over the elements.
    """
    size = 0.02
    mesh = box_mesh((size, size, size), (n, n, n), element)
    kind = reference_element(element)
    points, weights = element_rule(element, 4)
    nodes = mesh.blocks[element]
    shape = kind.shape(points)
    where = np.einsum("qa,ead->eqd", shape, mesh.vertices[nodes])
    jacobians = np.einsum("eai,qaj->eqij", mesh.vertices[nodes], kind.shape_gradients(points))
    volume = np.linalg.det(jacobians) * weights
    field, force = (a.reshape(where.shape) for a in _smooth_field(where.reshape(-1, 3), STEELLIKE, size))
    right = np.zeros(mesh.vertices.shape)
    np.add.at(right, nodes, np.einsum("qa,eq,eqd->ead", shape, volume, force))
    exact, _ = _smooth_field(mesh.vertices, STEELLIKE, size)
    fixed = np.zeros(exact.shape, dtype=bool)
    fixed[np.unique(np.concatenate([faces.ravel() for faces in mesh.faces.values()]))] = True
    matrix = stiffness(mesh, potential_of(mesh, STEELLIKE, elasticity), mesh.vertices)
    found = solve(matrix, right, fixed, exact)
    off = np.einsum("qa,ead->eqd", shape, found[nodes]) - field
    return float(np.sqrt(np.sum(volume * np.sum(off**2, axis=2)) / np.sum(volume * np.sum(field**2, axis=2))))
