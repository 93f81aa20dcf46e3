"""Stiffness of elements at rest (linear elasticity), vectorised over the elements of a block.

Strain in Voigt order xx, yy, zz, yz, xz, xy with engineering shears; dof = 3 * node + axis within an element.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from finqd.errors import MeshError
from finqd.mechanics.elements import Element, element, element_rule

CHUNK = 1000  # elements handled at once: keeps the strain matrices of a large mesh out of memory

HEX20_SHARE = 1e-3  # of the 3 x 3 x 3 rule: takes the six hourglass modes of the reduced one off zero

#: pair of axes of each Voigt component
VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


@dataclass(frozen=True, eq=False)
class RestElements:
    """What a block of elements is at rest.

    stiffness: K [N/m], shape (n_elements, 3k, 3k), symmetric; K annihilates translations and small rotations
    gradients: volume averages of dN_a/dX [1/m], shape (n_elements, k, 3)
    volumes: [m^3], shape (n_elements,)
    """

    stiffness: np.ndarray
    gradients: np.ndarray
    volumes: np.ndarray


def isotropic(lam: float, mu: float) -> np.ndarray:
    """Return the elasticity matrix C [Pa] in Voigt order, shape (6, 6), from Lame's constants [Pa]."""
    c = np.diag([2 * mu] * 3 + [mu] * 3)
    c[:3, :3] += lam
    return c


def rest_elements(name: str, vertices: np.ndarray, lame: tuple[float, float]) -> RestElements:
    """Return stiffness, mean gradients and volumes of elements of type ``name`` with rest nodes (n, k, 3) [m].

    hex8: 2 x 2 x 2 points, nine incompatible modes 1 - xi_i^2 condensed. wedge6: mean dilatation in its triangles and
    the three modes 1 - t^2. tet4: one point. tet10: four points. hex20: 2 x 2 x 2 points, and `HEX20_SHARE` of the
    full rule.
    Raises MeshError for an inverted element, InputError for an unknown type.
    """
    kind = element(name)
    material = isotropic(*lame)
    parts = []
    for start in range(0, len(vertices), CHUNK):
        parts.append(_rest_chunk(kind, np.asarray(vertices[start:start + CHUNK], dtype=float), material, start))
    if not parts:
        k = kind.n_nodes
        return RestElements(np.zeros((0, 3 * k, 3 * k)), np.zeros((0, k, 3)), np.zeros(0))
    return RestElements(*(np.concatenate(arrays) for arrays in zip(*parts)))


def physical_gradients(
    kind: Element, vertices: np.ndarray, points: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return dN_a/dX (n, q, k, 3) [1/m] and w det J (n, q) [m^3] at local ``points``."""
    local = kind.shape_gradients(points)
    jacobian = np.einsum("nai,qaj->nqij", vertices, local, optimize=True)
    inverse, determinant = _inverse(jacobian)
    return np.matmul(local[None], inverse), determinant * weights


def _inverse(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return inverse and determinant of (..., 3, 3) by cofactors (several times faster than LAPACK on small ones)."""
    rows = np.cross(matrix[..., [1, 2, 0], :], matrix[..., [2, 0, 1], :])
    determinant = np.sum(matrix[..., 0, :] * rows[..., 0, :], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.swapaxes(rows, -1, -2) / determinant[..., None, None], determinant


def strain_matrix(gradients: np.ndarray) -> np.ndarray:
    """Return B with strain = B u from dN_a/dX (..., k, 3), shape (..., 6, 3k)."""
    k = gradients.shape[-2]
    b = np.zeros((*gradients.shape[:-2], 6, k, 3))
    for row, (i, j) in enumerate(VOIGT):
        b[..., row, :, i] = gradients[..., j]
        b[..., row, :, j] = gradients[..., i]
    return b.reshape(*gradients.shape[:-2], 6, 3 * k)


def _rest_chunk(
    kind: Element, vertices: np.ndarray, material: np.ndarray, start: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    gradients, weights = physical_gradients(kind, vertices, kind.points, kind.weights)
    if not np.all(weights > 0):
        bad = start + int(np.argmax(~np.all(weights > 0, axis=1)))
        raise MeshError(f"element {bad} of block {kind.name} is inverted or flat")
    volumes = weights.sum(axis=1)
    mean = np.einsum("nq,nqak->nak", weights, gradients) / volumes[:, None, None]
    b = strain_matrix(gradients)
    if kind.name == "hex8":
        stiffness = _condensed(b, _mode_strains(kind, vertices, weights, (0, 1, 2)), material, weights)
    elif kind.name == "wedge6":
        modes = _mode_strains(kind, vertices, weights, (2,))
        stiffness = _condensed(
            _level_dilatation(b, weights), _level_dilatation(modes, weights), material, weights
        )
    elif kind.name == "hex20":
        stiffness = (1 - HEX20_SHARE) * _integral(b, b, material, weights)
        stiffness += HEX20_SHARE * _full_hex20(kind, vertices, material)
    else:
        stiffness = _integral(b, b, material, weights)
    return (stiffness + np.swapaxes(stiffness, 1, 2)) / 2, mean, volumes


def _full_hex20(kind: Element, vertices: np.ndarray, material: np.ndarray) -> np.ndarray:
    gradients, weights = physical_gradients(kind, vertices, *element_rule("hex20", 3))
    b = strain_matrix(gradients)
    return _integral(b, b, material, weights)


def _integral(left: np.ndarray, right: np.ndarray, material: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return sum_q w_q left_q^T C right_q, shape (n, columns of left, columns of right)."""
    n, q, _, columns = right.shape
    stress = np.matmul(material, right) * weights[:, :, None, None]
    flat = left.reshape(n, q * 6, left.shape[-1])
    return np.matmul(np.swapaxes(flat, 1, 2), stress.reshape(n, q * 6, columns))


def _mode_strains(kind: Element, vertices: np.ndarray, weights: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """Return B (n, q, 6, 3 * len(axes)) of the incompatible modes 1 - xi_i^2, i in ``axes``, in each displacement.

    d/dX = (j0 / j) J0^-T d/dxi with the Jacobian at the centre, so that each mode's strain has no mean and the patch
    test passes. Source: Taylor, Beresford and Wilson, Int. J. Numer. Methods Eng. 10 (1976) 1211.
    """
    centre = kind.nodes.mean(axis=0)
    jacobian = np.einsum("nai,aj->nij", vertices, kind.shape_gradients(centre[None])[0])
    inverse, determinant = _inverse(jacobian)
    local = np.zeros((len(kind.points), len(axes), 3))
    for column, axis in enumerate(axes):
        local[:, column, axis] = -2 * kind.points[:, axis]
    ratio = determinant[:, None] * kind.weights / weights  # j0 / j, as weights hold w j
    return strain_matrix(np.matmul(local[None], inverse[:, None]) * ratio[:, :, None, None])


def _level_dilatation(b: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return B-bar of a wedge: the volumetric part of ``b`` replaced by its mean over each triangle of points.

    The part linear in t stays, which the modes 1 - t^2 relieve: a mean over the whole wedge would leave bending out of
    the triangle's plane three to four times too soft. Source: Hughes, Int. J. Numer. Methods Eng. 15 (1980) 1413.
    """
    n, q, _, columns = b.shape
    dilatation = b[:, :, :3].sum(axis=2).reshape(n, -1, 2, columns)  # `wedge_rule`: two levels, which run fastest
    levels = weights.reshape(n, -1, 2)
    share = levels / levels.sum(axis=1, keepdims=True)
    change = ((share[..., None] * dilatation).sum(axis=1, keepdims=True) - dilatation) / 3
    result = b.copy()
    result[:, :, :3] += change.reshape(n, q, 1, columns)
    return result


def _condensed(b: np.ndarray, modes: np.ndarray, material: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return K_uu - K_um K_mm^-1 K_mu: the modes take the amplitudes that leave them without force."""
    coupling = _integral(modes, b, material, weights)
    own = _integral(modes, modes, material, weights)
    return _integral(b, b, material, weights) - np.matmul(np.swapaxes(coupling, 1, 2), np.linalg.solve(own, coupling))
