"""Neo-Hookean elasticity: large strains, near-incompressible (see `finqd.mechanics.neo_hookean_kernels`)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.errors import InputError
from finqd.mechanics import neo_hookean_kernels as kernels
from finqd.mechanics.element_stiffness import (
    CHUNK,
    consistent_gradients,
    hourglass_matrix,
    mode_amplitudes,
    mode_gradients,
)
from finqd.mechanics.elements import Element, element
from finqd.mechanics.hourglass import FoldingLimit, folding_limit

if TYPE_CHECKING:
    from finqd.mechanics.material import Material
    from finqd.mesh import Mesh


@dataclass(frozen=True, kw_only=True)
class NeoHookean:
    """Compressible neo-Hookean rubber, no locking up to incompressibility: large rotations, large strains.

    W = mu/2 (J^(-2/3) tr F^T F - 3) + kappa/4 (J^2 - 1 - 2 ln J) with mu and kappa = lambda + 2 mu/3 of the material;
    in the limit of small strains every element is exactly that of ``corotated``. hex8 bends and stays isochoric by nine
    inner modes, hex20 by its reduced rule, tet10 by four points. wedge6 (three modes, a mean dilatation) bends along
    its axis, but locks in the plane of its triangles near nu = 0.5; tet4 has no remedy and locks. An inverted
    element costs infinite energy. Limit: enhanced modes fold into hourglasses in strong compression; hex8 is stable to
    65 % of its height under uniform pressure, and between bonded plates gets too soft before that (4 % at 80 %, 13 % at
    70 %). hex20 and tet10 go on to 55 %.
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
            _rest_block(name, np.asarray(nodes, dtype=np.int64), vertices, (lam, mu))
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
    start: np.ndarray
    hourglass: np.ndarray
    limit: FoldingLimit | None

    def shifted(self, first_vertex: int) -> RestBlock:
        """Return the same with vertex ids raised by ``first_vertex``."""
        limit = None if self.limit is None else self.limit.shifted(first_vertex)
        return replace(self, nodes=self.nodes + first_vertex, limit=limit)


_NONE = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class NeoHookeanPotential:
    """Elastic energy of one soft body; satisfies `finqd.contracts.ElasticPotential`.

    mu, kappa [Pa]; memory: the positions seen last and the inner modes found there, since a step asks for energy,
    gradient and Hessian of the same positions. It saves time and changes no result.
    """

    blocks: tuple[RestBlock, ...]
    mu: float
    kappa: float
    memory: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def cliques(self) -> tuple[np.ndarray, ...]:
        return tuple(block.nodes for block in self.blocks)

    def shifted(self, first_vertex: int) -> NeoHookeanPotential:
        """Return the same body with its vertex ids raised by ``first_vertex``; rest data is shared, not copied."""
        blocks = tuple(block.shifted(first_vertex) for block in self.blocks)
        return NeoHookeanPotential(blocks, self.mu, self.kappa)

    def _modes(self, positions: np.ndarray) -> tuple[bool, list[np.ndarray]]:
        """Return whether the inner modes of ``positions`` are known, and where they are or have to go, a block each."""
        if "modes" not in self.memory:
            self.memory["modes"] = [
                np.zeros((len(b.nodes), 3, b.shapes.shape[1] - b.nodes.shape[1])) for b in self.blocks
            ]
        seen = self.memory.get("positions")
        known = seen is not None and np.array_equal(seen, positions)
        if not known:
            self.memory["positions"] = None  # until all blocks are through: an energy of inf leaves some undone
        return known, self.memory["modes"]

    def _arguments(self, b: RestBlock) -> tuple:
        return b.nodes, b.shapes, b.weights, b.group, b.start, b.hourglass, self.mu, self.kappa

    def energy(self, positions: np.ndarray) -> float:
        """Return the elastic energy [J] at ``positions`` (n_vertices, 3) [m]; inf if an element is inverted."""
        return self.add_gradient(positions, _NONE)

    def add_gradient(self, positions: np.ndarray, gradient: np.ndarray) -> float:
        """Add dE/dpositions [N] to ``gradient`` (n_vertices, 3); return the energy [J], inf if one is inverted."""
        known, modes = self._modes(positions)
        total = 0.0
        for b, alpha in zip(self.blocks, modes, strict=True):
            total += kernels.add_gradient(*self._arguments(b), positions, alpha, known, gradient)
            if b.limit is not None:
                total += b.limit.add_gradient(positions, gradient)
        if not known and np.isfinite(total):
            self.memory["positions"] = positions.copy()
        return total

    def add_hessian(
        self, positions: np.ndarray, slots: tuple[np.ndarray, ...], blocks: np.ndarray, *, projected: bool = False
    ) -> None:
        """Add the Hessian [N/m] to ``blocks`` (n_blocks + 1, 3, 3).

        ``projected``: negative eigenvalues of each element's matrix, its modes condensed, are set to zero.
        """
        known, modes = self._modes(positions)
        for b, alpha, slot in zip(self.blocks, modes, slots, strict=True):
            kernels.add_hessian(*self._arguments(b), positions, alpha, known, slot, blocks, projected)
            if b.limit is not None:
                b.limit.add_hessian(positions, slot, blocks)


def _rest_block(name: str, nodes: np.ndarray, vertices: np.ndarray, lame: tuple[float, float]) -> RestBlock:
    kind = element(name)
    chunks = [
        _rest_chunk(kind, vertices[nodes[start : start + CHUNK]], lame, start) for start in range(0, len(nodes), CHUNK)
    ]
    shapes, weights, start, hourglass = (np.ascontiguousarray(np.concatenate(part)) for part in zip(*chunks))
    group = np.arange(len(kind.points))
    if name == "wedge6":
        group %= 2  # one dilatation a level; `wedge_rule`: levels run fastest
    limit = folding_limit(name, nodes, vertices, lame[1])
    return RestBlock(
        nodes=nodes, shapes=shapes, weights=weights, group=group, start=start, hourglass=hourglass, limit=limit
    )


def _rest_chunk(kind: Element, points: np.ndarray, lame: tuple[float, float], first: int) -> tuple[np.ndarray, ...]:
    """Return shapes, weights, start and hourglass of elements with rest nodes ``points`` (n, k, 3) [m]."""
    n, k, _ = points.shape
    gradients, weights = consistent_gradients(kind, points, start=first)
    modes = mode_gradients(kind, points, weights)
    shapes = np.moveaxis(np.concatenate([gradients, modes], axis=2), 1, 3).reshape(n, k + modes.shape[2], -1)
    start = np.zeros((n, 0, 3 * k + 1))
    if modes.shape[2]:
        amplitudes = mode_amplitudes(kind, gradients, modes, weights, lame)
        amplitudes = np.moveaxis(amplitudes.reshape(n, -1, 3, k, 3), (2, 4), (1, 3)).reshape(n, -1, 3 * k)
        rest = np.swapaxes(points - points[:, :1], 1, 2).reshape(n, 3 * k, 1)
        start = np.concatenate([amplitudes, np.matmul(amplitudes, rest)], axis=2)
    hourglass = np.zeros((0, k, k))
    if kind.name == "hex20":
        hourglass = hourglass_matrix(kind, points, gradients, weights)
    return shapes, weights, start, hourglass
