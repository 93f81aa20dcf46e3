"""Neo-Hookean elasticity: large strains, near-incompressible (see `finqd.mechanics.neo_hookean_kernels`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from finqd.errors import InputError
from finqd.mechanics import neo_hookean_kernels as kernels
from finqd.mechanics.element_stiffness import CHUNK, consistent_gradients, hourglass_matrix, mode_gradients
from finqd.mechanics.elements import element

if TYPE_CHECKING:
    from finqd.mechanics.material import Material
    from finqd.mesh import Mesh


@dataclass(frozen=True, kw_only=True)
class NeoHookean:
    """Compressible neo-Hookean rubber, no locking up to incompressibility: large rotations, large strains.

    W = mu/2 (J^(-2/3) tr F^T F - 3) + kappa/4 (J^2 - 1 - 2 ln J) with mu and kappa = lambda + 2 mu/3 of the material;
    in the limit of small strains every element is exactly that of ``corotated``. hex8 bends and stays isochoric by nine
    inner modes, wedge6 by three and a mean dilatation, hex20 by its reduced rule, tet10 by four points;
    tet4 has no remedy and locks. An inverted element costs infinite energy.
    """

    def potential(self, mesh: Mesh, material: Material, *, first_vertex: int = 0) -> NeoHookeanPotential:
        """Return the elastic potential of ``mesh``; raises InputError or MeshError (unknown or inverted elements)."""
        if not material.youngs_modulus > 0 or not -1 < material.poisson_ratio < 0.5:
            raise InputError(
                "youngs_modulus must be positive and poisson_ratio lie between -1 and 0.5 (exclusive), got "
                f"{material.youngs_modulus} Pa and {material.poisson_ratio}", where="material",
            )
        lam, mu = material.lame
        vertices = np.asarray(mesh.vertices, dtype=float)
        blocks = [
            _rest_block(name, np.asarray(nodes, dtype=np.int64), vertices)
            for name, nodes in mesh.blocks.items() if len(nodes)
        ]
        return NeoHookeanPotential(tuple(blocks), mu, lam + 2 * mu / 3).shifted(first_vertex)


@dataclass(frozen=True, eq=False)
class RestBlock:
    """Rest data of the elements of one type, with the shapes that `finqd.mechanics.neo_hookean_kernels` names."""

    nodes: np.ndarray
    shapes: np.ndarray
    weights: np.ndarray
    group: np.ndarray
    hourglass: np.ndarray


@dataclass(frozen=True, eq=False)
class NeoHookeanPotential:
    """Elastic energy of one soft body; satisfies `finqd.contracts.ElasticPotential`. mu, kappa [Pa]."""

    blocks: tuple[RestBlock, ...]
    mu: float
    kappa: float

    @property
    def cliques(self) -> tuple[np.ndarray, ...]:
        return tuple(block.nodes for block in self.blocks)

    def shifted(self, first_vertex: int) -> NeoHookeanPotential:
        """Return the same body with its vertex ids raised by ``first_vertex``; rest data is shared, not copied."""
        return replace(self, blocks=tuple(replace(block, nodes=block.nodes + first_vertex) for block in self.blocks))

    def _arguments(self, b: RestBlock) -> tuple:
        return b.nodes, b.shapes, b.weights, b.group, b.hourglass, self.mu, self.kappa

    def energy(self, positions: np.ndarray) -> float:
        """Return the elastic energy [J] at ``positions`` (n_vertices, 3) [m]; inf if an element is inverted."""
        return sum((kernels.energy(*self._arguments(b), positions) for b in self.blocks), 0.0)

    def add_gradient(self, positions: np.ndarray, gradient: np.ndarray) -> float:
        """Add dE/dpositions [N] to ``gradient`` (n_vertices, 3); return the energy [J], inf if one is inverted."""
        return sum((kernels.add_gradient(*self._arguments(b), positions, gradient) for b in self.blocks), 0.0)

    def add_hessian(
        self, positions: np.ndarray, slots: tuple[np.ndarray, ...], blocks: np.ndarray, *, projected: bool = False
    ) -> None:
        """Add the Hessian [N/m] to ``blocks`` (n_blocks, 3, 3).

        ``projected``: negative eigenvalues of each element's matrix, its modes condensed, are set to zero.
        """
        for b, slot in zip(self.blocks, slots, strict=True):
            kernels.add_hessian(*self._arguments(b), positions, slot, blocks, projected)


def _rest_block(name: str, nodes: np.ndarray, vertices: np.ndarray) -> RestBlock:
    kind = element(name)
    shapes, weights, hourglass = [], [], []
    for start in range(0, len(nodes), CHUNK):
        points = vertices[nodes[start : start + CHUNK]]
        gradients, volumes = consistent_gradients(kind, points, start=start)
        modes = mode_gradients(kind, points, volumes)
        shapes.append(np.swapaxes(np.concatenate([gradients, modes], axis=2), 2, 3))
        weights.append(volumes)
        if name == "hex20":
            hourglass.append(hourglass_matrix(kind, points, gradients, volumes))
    count = len(kind.points)
    return RestBlock(
        nodes=nodes, shapes=np.ascontiguousarray(np.concatenate(shapes)),
        weights=np.ascontiguousarray(np.concatenate(weights)),
        group=np.arange(count) % 2 if name == "wedge6" else np.arange(count),  # `wedge_rule`: levels run fastest
        hourglass=np.ascontiguousarray(np.concatenate(hourglass)) if hourglass else np.zeros((0, 0, 0)),
    )
