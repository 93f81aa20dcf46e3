"""Lumped masses of a mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from finqd.mechanics.element_stiffness import physical_gradients
from finqd.mechanics.elements import element, element_rule

if TYPE_CHECKING:
    from finqd.mesh import Mesh


def lumped_masses(mesh: Mesh, density: float) -> np.ndarray:
    """Return the mass of every vertex [kg], shape (n_vertices,), positive where an element has the vertex.

    Their sum is ``density`` [kg/m^3] times the mesh's volume. Linear elements: row sums, m_a = rho int N_a dV, which
    keep the centre of mass too. Quadratic ones, whose row sums are negative at corners: m_a in proportion to the
    diagonal int N_a^2 dV (Hinton, Rock and Zienkiewicz, Earthquake Eng. Struct. Dyn. 4 (1976) 245). Raises InputError
    for unknown types.
    """
    masses = np.zeros(len(mesh.vertices))
    for name, nodes in mesh.blocks.items():
        kind = element(name)
        points, weights = element_rule(name, 3 if kind.quadratic else 2)
        _, volumes = physical_gradients(kind, np.asarray(mesh.vertices)[nodes], points, weights)
        shape = kind.shape(points)
        if kind.quadratic:
            share = volumes @ shape**2
            share *= (volumes.sum(axis=1) / share.sum(axis=1))[:, None]
        else:
            share = volumes @ shape
        masses += np.bincount(np.ravel(nodes), weights=np.ravel(share), minlength=len(masses))
    return density * masses
