"""Corotated linear elasticity: one rotation an element, exact derivatives (see `finqd.mechanics.corotated_kernels`)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from finqd.errors import InputError
from finqd.mechanics import corotated_kernels as kernels
from finqd.mechanics.element_stiffness import kinds_of, rest_elements
from finqd.mechanics.hourglass import FoldingLimit, folding_limit

if TYPE_CHECKING:
    from finqd.mechanics.material import Material
    from finqd.mesh import Mesh


@dataclass(frozen=True, kw_only=True)
class Corotated:
    """Linear elasticity in each element's rotating frame: large rotations, small strains."""

    def potential(self, mesh: Mesh, material: Material, *, first_vertex: int = 0) -> CorotatedPotential:
        """Return the elastic potential of ``mesh``; raises InputError or MeshError (unknown or inverted elements)."""
        if not material.youngs_modulus > 0 or not -1 < material.poisson_ratio < 0.5:
            raise InputError(
                "youngs_modulus must be positive and poisson_ratio lie between -1 and 0.5 (exclusive), got "
                f"{material.youngs_modulus} Pa and {material.poisson_ratio}", where="material",
            )
        vertices = np.asarray(mesh.vertices, dtype=float)
        blocks = []
        for name, nodes in mesh.blocks.items():
            if len(nodes):
                blocks.append(_rest_block(name, np.asarray(nodes, dtype=np.int64), vertices, material.lame))
        return CorotatedPotential(tuple(blocks)).shifted(first_vertex)


@dataclass(frozen=True, eq=False)
class RestBlock:
    """Rest data of the elements of one type, with the shapes that `finqd.mechanics.corotated_kernels` names."""

    rest: np.ndarray
    gradients: np.ndarray
    kinds: np.ndarray
    stiffness: np.ndarray
    nodes: np.ndarray
    limit: FoldingLimit | None
    cache: dict[str, np.ndarray] = field(default_factory=dict, repr=False)  # shared by shifted copies

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """What all kernels take first."""
        return self.nodes, self.rest, self.gradients, self.kinds, self.stiffness

    def shifted(self, first_vertex: int) -> RestBlock:
        """Return the same with vertex ids raised by ``first_vertex``."""
        limit = None if self.limit is None else self.limit.shifted(first_vertex)
        return replace(self, nodes=self.nodes + first_vertex, limit=limit)

    @property
    def compliance(self) -> np.ndarray:
        """Pseudo-inverse of each kind's stiffness [m/N], made when a projected Hessian first asks for it."""
        if "compliance" not in self.cache:
            _, first = np.unique(self.kinds, return_index=True)
            self.cache["compliance"] = _pseudo_inverse(self.stiffness, self.rest[first])
        return self.cache["compliance"]


_NONE = np.zeros((1, 1, 1))


@dataclass(frozen=True, eq=False)
class CorotatedPotential:
    """Elastic energy of one soft body; satisfies `finqd.contracts.ElasticPotential`."""

    blocks: tuple[RestBlock, ...]

    @property
    def cliques(self) -> tuple[np.ndarray, ...]:
        return tuple(block.nodes for block in self.blocks)

    def shifted(self, first_vertex: int) -> CorotatedPotential:
        """Return the same body with its vertex ids raised by ``first_vertex``; rest data is shared, not copied."""
        return CorotatedPotential(tuple(block.shifted(first_vertex) for block in self.blocks))

    def energy(self, positions: np.ndarray) -> float:
        """Return the elastic energy [J] at ``positions`` (n_vertices, 3) [m]."""
        total = sum((kernels.energy(*b.arrays, positions) for b in self.blocks), 0.0)
        return total + sum((b.limit.energy(positions) for b in self.blocks if b.limit is not None), 0.0)

    def add_gradient(self, positions: np.ndarray, gradient: np.ndarray) -> float:
        """Add dE/dpositions [N] to ``gradient`` (n_vertices, 3); return the energy [J]."""
        total = 0.0
        for b in self.blocks:
            total += kernels.add_gradient(*b.arrays, positions, gradient)
            if b.limit is not None:
                total += b.limit.add_gradient(positions, gradient)
        return total

    def add_hessian(
        self, positions: np.ndarray, slots: tuple[np.ndarray, ...], blocks: np.ndarray, *, projected: bool = False
    ) -> None:
        """Add the Hessian [N/m] to ``blocks`` (n_blocks + 1, 3, 3).

        ``projected``: exact where an element's Hessian is positive semidefinite, else changed by what makes it so,
        which is of the order of the stress (``_clamp_spin`` in the kernels).
        """
        for b, slot in zip(self.blocks, slots, strict=True):
            compliance = b.compliance if projected else _NONE
            kernels.add_hessian(*b.arrays, compliance, positions, slot, blocks, projected)
            if b.limit is not None:
                b.limit.add_hessian(positions, slot, blocks)


def _rest_block(name: str, nodes: np.ndarray, vertices: np.ndarray, lame: tuple[float, float]) -> RestBlock:
    elements = rest_elements(name, vertices[nodes], lame)
    rest = vertices[nodes] - vertices[nodes].mean(axis=1, keepdims=True)
    first, kinds = kinds_of(rest)
    return RestBlock(
        rest=np.ascontiguousarray(rest), gradients=np.ascontiguousarray(elements.gradients), kinds=kinds,
        stiffness=np.ascontiguousarray(elements.stiffness[first]), nodes=nodes,
        limit=folding_limit(name, nodes, vertices, lame[1]),
    )


def _pseudo_inverse(stiffness: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return the inverse of K + s N N^T, N an orthonormal basis of rigid motions: K^+ for forces in equilibrium."""
    n, k, _ = rest.shape
    rigid = np.zeros((n, k, 3, 6))
    rigid[:, :, [0, 1, 2], [0, 1, 2]] = 1 / np.sqrt(k)
    for axis in range(3):
        rigid[:, :, :, 3 + axis] = np.cross(np.eye(3)[axis], rest)
    basis, _ = np.linalg.qr(rigid.reshape(n, 3 * k, 6))
    scale = np.trace(stiffness, axis1=1, axis2=2) / (3 * k)
    inverse = np.linalg.inv(stiffness + scale[:, None, None] * np.matmul(basis, np.swapaxes(basis, 1, 2)))
    return np.ascontiguousarray((inverse + np.swapaxes(inverse, 1, 2)) / 2)
