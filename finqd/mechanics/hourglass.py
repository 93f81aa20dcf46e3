"""What keeps quadratic hexahedra from folding where their reduced rule does not look; nothing at ordinary strains."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from finqd.mechanics import hourglass_kernels as kernels
from finqd.mechanics.element_stiffness import CHUNK, HEX20_SHARE, consistent_gradients, hourglass_matrix, kinds_of
from finqd.mechanics.elements import element

#: g0 [-]: on `draft`, forces of presses stay within 0.5 % (with 0.01: 6 %); elements fold from 0.06 on
CALM = 0.03
SOFT = 0.03  # w [-]: the stiffness sets in without a jump
STEEP = 0.2  # d1 [-]: no element that is not tangled comes as far
HARDENING = 150.0  # c [-]: at g = 0.06 the stress is about the shear modulus

_NONE = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class FoldingLimit:
    """Energy that hardens the hourglass modes of a block of hex20 (see `finqd.mechanics.hourglass_kernels`).

    stiffness: c mu [Pa]; other shapes as named there
    """

    nodes: np.ndarray
    kinds: np.ndarray
    laplacians: np.ndarray
    volumes: np.ndarray
    stiffness: float

    @property
    def _arguments(self) -> tuple:
        return self.nodes, self.kinds, self.laplacians, self.volumes, self.stiffness, (CALM, SOFT, STEEP)

    def shifted(self, first_vertex: int) -> FoldingLimit:
        """Return the same with vertex ids raised by ``first_vertex``."""
        return replace(self, nodes=self.nodes + first_vertex)

    def energy(self, positions: np.ndarray) -> float:
        """Return the energy [J] at ``positions`` (n_vertices, 3) [m]."""
        return kernels.add_gradient(*self._arguments, positions, _NONE)

    def add_gradient(self, positions: np.ndarray, gradient: np.ndarray) -> float:
        """Add dE/dpositions [N] to ``gradient`` (n_vertices, 3), unless that is empty; return the energy [J]."""
        return kernels.add_gradient(*self._arguments, positions, gradient)

    def add_hessian(self, positions: np.ndarray, slots: np.ndarray, blocks: np.ndarray) -> None:
        """Add the Hessian [N/m], which is positive semidefinite, to ``blocks`` (n_blocks + 1, 3, 3)."""
        kernels.add_hessian(*self._arguments, positions, slots, blocks)


def folding_limit(name: str, nodes: np.ndarray, vertices: np.ndarray, shear_modulus: float) -> FoldingLimit | None:
    """Return the limit of a block of elements of type ``name``, None for types whose rule sees every mode.

    ``vertices``: rest positions [m]; ``shear_modulus`` [Pa]. Raises MeshError for an inverted element.
    """
    if name != "hex20" or not len(nodes):
        return None
    rest = vertices[nodes]
    first, kinds = kinds_of(rest - rest.mean(axis=1, keepdims=True))
    laplacians, volumes = [], []
    for start in range(0, len(first), CHUNK):
        points = rest[first[start : start + CHUNK]]
        gradients, weights = consistent_gradients(element(name), points, start=start)
        laplacians.append(hourglass_matrix(element(name), points, gradients, weights) / HEX20_SHARE)
        volumes.append(weights.sum(axis=1))
    return FoldingLimit(
        nodes=nodes, kinds=kinds, laplacians=np.ascontiguousarray(np.concatenate(laplacians)),
        volumes=np.concatenate(volumes), stiffness=HARDENING * shear_modulus,
    )
