"""Stiffness of elements at rest (linear elasticity), vectorised over the elements of a block.

Strain in Voigt order xx, yy, zz, yz, xz, xy with engineering shears; dof = 3 * node + axis within an element.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from finqd.errors import MeshError
from finqd.mechanics.elements import Element, Rule, element, element_rule

SAME = 1e-12  # relative difference of two elements that count as one
CHUNK = 1000  # elements handled at once: keeps the strain matrices of a large mesh out of memory

HEX20_SHARE = 3e-3  # of the shear modulus: takes the six hourglass modes of the reduced rule off zero

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
    the three modes 1 - t^2. tet4: one point. tet10: four points. hex20: 2 x 2 x 2 points with `consistent_gradients`,
    and `hourglass_matrix`.
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


def kinds_of(rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first element of each shape, and the shape of each element (n,), from rest nodes (n, k, 3).

    The nodes are relative to their centre; two elements have one shape if they agree to `SAME` of the largest.
    """
    flat = rest.reshape(len(rest), -1)
    digits = np.round(flat / (SAME * np.abs(flat).max(initial=np.finfo(float).tiny)))
    _, first, kinds = np.unique(digits, axis=0, return_index=True, return_inverse=True)
    return first, kinds.reshape(-1)


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
    gradients, weights = consistent_gradients(kind, vertices, start=start)
    volumes = weights.sum(axis=1)
    mean = np.einsum("nq,nqak->nak", weights, gradients) / volumes[:, None, None]
    b = strain_matrix(gradients)
    if kind.name == "hex8":
        stiffness = _condensed(b, strain_matrix(mode_gradients(kind, vertices, weights)), material, weights)
    elif kind.name == "wedge6":
        modes = strain_matrix(mode_gradients(kind, vertices, weights))
        stiffness = _condensed(
            _level_dilatation(b, weights), _level_dilatation(modes, weights), material, weights
        )
    else:
        stiffness = _integral(b, b, material, weights)
    if kind.name == "hex20":
        n, k = vertices.shape[:2]
        scalar = material[3, 3] * hourglass_matrix(kind, vertices, gradients, weights)
        stiffness += np.einsum("nab,ij->naibj", scalar, np.eye(3)).reshape(n, 3 * k, 3 * k)
    return (stiffness + np.swapaxes(stiffness, 1, 2)) / 2, mean, volumes


def consistent_gradients(kind: Element, vertices: np.ndarray, *, start: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return dN_a/dX (n, q, k, 3) [1/m] and weights (n, q) [m^3] of the stiffness rule, right in their mean.

    The patch test asks for sum_q w_q dN_a/dX(q) = int dN_a/dX dV. A quadratic element's rule is exact there with
    straight edges, not with curved ones; then the gradients are shifted, all points alike, by what their mean lacks,
    and the weights scaled to the exact volume. Uniform strains stay exact, as sum_a X_a dN_a/dX has the exact mean at
    every point already.
    Source: Krongauz and Belytschko, Int. J. Numer. Methods Eng. 40 (1997) 4215 (corrected derivatives); the exact means
    come from a rule of degree 5 (hex20) or 3 (tet10), which is enough for curved edges too.
    ``start``: number of the first element. Raises MeshError for an inverted one.
    """
    gradients, weights = physical_gradients(kind, vertices, kind.points, kind.weights)
    right = weights > 0
    if kind.quadratic:
        exact, volumes = physical_gradients(kind, vertices, *exact_rule(kind))
        right = np.concatenate([right, volumes > 0], axis=1)
    if not np.all(right):
        bad = start + int(np.argmax(~np.all(right, axis=1)))
        raise MeshError(f"element {bad} of block {kind.name} is inverted or flat")
    if kind.quadratic:
        total = volumes.sum(axis=1)
        weights = weights * (total / weights.sum(axis=1))[:, None]
        lacking = _weighted(volumes, exact) - _weighted(weights, gradients)
        gradients = gradients + (lacking / total[:, None, None])[:, None]
    return gradients, weights


def exact_rule(kind: Element) -> Rule:
    """Return a rule that integrates dN_a/dX of a quadratic element exactly, curved or not."""
    return element_rule(kind.name, 3 if kind.name.startswith("hex") else 2)


def _weighted(weights: np.ndarray, gradients: np.ndarray) -> np.ndarray:
    """Return sum_q w_q g_a(q), shape (n, k, 3)."""
    return np.einsum("nq,nqak->nak", weights, gradients)


def hourglass_matrix(kind: Element, vertices: np.ndarray, gradients: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return S (n, k, k) [m]: the energy mu/2 sum_ab S_ab x_a . x_b stiffens what a hex20's reduced rule does not see.

    S = `HEX20_SHARE` (L_full - L_reduced)+, L the Laplacian's matrix int dN_a/dX . dN_b/dX by the full and the reduced
    rule, + the positive part. Both rules agree on linear fields (and, in a brick, on quadratic ones), so S annihilates
    them: no force on a patch, and, at any strain, none on a rotation. Constant, so that large strain laws share it.
    """
    full, volumes = physical_gradients(kind, vertices, *exact_rule(kind))

    def laplacian(g: np.ndarray, w: np.ndarray) -> np.ndarray:
        flat = np.moveaxis(g, 2, 1).reshape(len(g), kind.n_nodes, -1)
        return np.matmul(flat * np.repeat(w, 3, axis=1)[:, None], np.swapaxes(flat, 1, 2))

    values, vectors = np.linalg.eigh(laplacian(full, volumes) - laplacian(gradients, weights))
    positive = np.where(values > 1e-9 * values[:, -1:], values, 0.0)
    return HEX20_SHARE * np.matmul(vectors * positive[:, None], np.swapaxes(vectors, 1, 2))


def _integral(left: np.ndarray, right: np.ndarray, material: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return sum_q w_q left_q^T C right_q, shape (n, columns of left, columns of right)."""
    n, q, _, columns = right.shape
    stress = np.matmul(material, right) * weights[:, :, None, None]
    flat = left.reshape(n, q * 6, left.shape[-1])
    return np.matmul(np.swapaxes(flat, 1, 2), stress.reshape(n, q * 6, columns))


#: local axes i of the incompatible modes 1 - xi_i^2 of an element type
MODE_AXES = {"hex8": (0, 1, 2), "wedge6": (2,)}


def mode_gradients(kind: Element, vertices: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the gradients (n, q, m, 3) [1/m] of the incompatible modes 1 - xi_i^2, i in `MODE_AXES`, at the points.

    d/dX = (j0 / j) J0^-T d/dxi with the Jacobian at the centre, so that each mode's strain has no mean and the patch
    test passes. Source: Taylor, Beresford and Wilson, Int. J. Numer. Methods Eng. 10 (1976) 1211.
    weights: w det J at the element's own points [m^3], (n, q)
    """
    axes = MODE_AXES.get(kind.name, ())
    centre = kind.nodes.mean(axis=0)
    jacobian = np.einsum("nai,aj->nij", vertices, kind.shape_gradients(centre[None])[0])
    inverse, determinant = _inverse(jacobian)
    local = np.zeros((len(kind.points), len(axes), 3))
    for column, axis in enumerate(axes):
        local[:, column, axis] = -2 * kind.points[:, axis]
    ratio = determinant[:, None] * kind.weights / weights  # j0 / j, as weights hold w j
    return np.matmul(local[None], inverse[:, None]) * ratio[:, :, None, None]


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


def mode_amplitudes(
    kind: Element, gradients: np.ndarray, modes: np.ndarray, weights: np.ndarray, lame: tuple[float, float]
) -> np.ndarray:
    """Return -K_mm^-1 K_mu (n, 3m, 3k): the amplitudes of the modes for nodal displacements; dof = 3 * node + axis."""
    own, b, material = strain_matrix(modes), strain_matrix(gradients), isotropic(*lame)
    if kind.name == "wedge6":
        own, b = _level_dilatation(own, weights), _level_dilatation(b, weights)
    return -np.linalg.solve(_integral(own, own, material, weights), _integral(own, b, material, weights))


def _condensed(b: np.ndarray, modes: np.ndarray, material: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return K_uu - K_um K_mm^-1 K_mu: the modes take the amplitudes that leave them without force."""
    coupling = _integral(modes, b, material, weights)
    own = _integral(modes, modes, material, weights)
    return _integral(b, b, material, weights) - np.matmul(np.swapaxes(coupling, 1, 2), np.linalg.solve(own, coupling))
