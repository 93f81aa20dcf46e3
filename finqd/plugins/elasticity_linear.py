"""Linear elasticity about the rest shape: the cheapest law, for small rotations only."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from finqd.errors import InputError
from finqd.mechanics.element_stiffness import rest_elements
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.polar_kernels import closest_rotation

if TYPE_CHECKING:
    import scipy.sparse as sp

    from finqd.mechanics.material import Material
    from finqd.mesh import Mesh

BASE = "base"  # the node set whose motion the rest shape follows


@dataclass(frozen=True, kw_only=True)
class Linear:
    """Linear elasticity about the rest shape, carried along by the base: the cheapest, wrong at large bending.

    E = 1/2 u^T K u with u = R^T (x - c) - (X - C); R and c are rotation and centre of the mesh's node set ``base``, so
    that a finger does not feel how its base is driven (R = 1, c = C without such a set). The element stiffnesses
    are those of ``corotated``. Base vertices are taken as prescribed: their gradient leaves out that R and c follow
    them, which a base that is clamped or driven as a rigid body never needs; a body whose base is free must not
    use this law. Parts that turn by more than about 10 degrees against the base swell and stiffen.
    """

    small_rotation: ClassVar[bool] = True

    def potential(self, mesh: Mesh, material: Material, *, first_vertex: int = 0) -> LinearPotential:
        """Return the elastic potential of ``mesh``.

        Raises InputError or MeshError (unknown or inverted elements, a base whose vertices lie on a line).
        """
        if not material.youngs_modulus > 0 or not -1 < material.poisson_ratio < 0.5:
            raise InputError(
                "youngs_modulus must be positive and poisson_ratio lie between -1 and 0.5 (exclusive), got "
                f"{material.youngs_modulus} Pa and {material.poisson_ratio}", where="material",
            )
        vertices = np.asarray(mesh.vertices, dtype=float)
        cliques = tuple(np.asarray(nodes, dtype=np.int64) for nodes in mesh.blocks.values() if len(nodes))
        names = [name for name, nodes in mesh.blocks.items() if len(nodes)]
        pattern = BlockPattern.from_cliques(len(vertices), cliques)
        blocks = pattern.new_blocks()
        for name, nodes in zip(names, cliques, strict=True):
            stiffness = rest_elements(name, vertices[nodes], material.lame).stiffness
            n, k = nodes.shape
            pairs = np.moveaxis(stiffness.reshape(n, k, 3, k, 3), 2, 3).reshape(-1, 3, 3)
            np.add.at(blocks, pattern.slots(nodes).ravel(), pairs)
        return LinearPotential(
            rest=vertices, base=_base(mesh, vertices), pattern=pattern, stiffness=blocks,
            matrix=pattern.matrix(blocks), cliques=tuple(nodes + first_vertex for nodes in cliques),
            first_vertex=first_vertex,
        )


def _base(mesh: Mesh, vertices: np.ndarray) -> np.ndarray:
    """Return the vertex ids of the mesh's base, none if it has none; raises InputError if they define no rotation."""
    base = np.asarray(mesh.node_sets.get(BASE, ()), dtype=np.int64)
    if len(base):
        spread = np.linalg.svd(vertices[base] - vertices[base].mean(axis=0), compute_uv=False)
        if len(spread) < 2 or spread[1] < 1e-6 * np.ptp(vertices, axis=0).max():
            raise InputError(f"the vertices of node set {BASE!r} lie on a line, which defines no rotation to follow")
    return base


@dataclass(frozen=True, eq=False)
class LinearPotential:
    """Elastic energy of one soft body; satisfies `finqd.contracts.ElasticPotential`.

    rest: X [m], (n, 3); base: vertex ids; stiffness: blocks of K [N/m] in ``pattern``; matrix: the same, sparse
    """

    rest: np.ndarray
    base: np.ndarray
    pattern: BlockPattern
    stiffness: np.ndarray
    matrix: sp.bsr_array
    cliques: tuple[np.ndarray, ...]
    first_vertex: int
    places: dict[str, tuple] = field(default_factory=dict, repr=False)  # where K goes in the scene's blocks

    def frame(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the base's rotation R (3, 3) and its centres now, c, and at rest, C [m].

        Without a base R is 1, and the centres are the body's: a shift costs nothing, not even the rounding of K u.
        """
        if not len(self.base):
            own = positions[self.first_vertex : self.first_vertex + len(self.rest)]
            return np.eye(3), own.mean(axis=0), self.rest.mean(axis=0)
        now, rest = positions[self.base + self.first_vertex], self.rest[self.base]
        centre, rest_centre = now.mean(axis=0), rest.mean(axis=0)
        rotation = np.empty((3, 3))
        moment = (now - centre).T @ (rest - rest_centre)  # of rank two for a flat base, which is enough
        closest_rotation(moment / np.linalg.norm(moment), rotation)
        return rotation, centre, rest_centre

    def _displaced(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return R and u (n, 3) [m]."""
        rotation, centre, rest_centre = self.frame(positions)
        own = positions[self.first_vertex : self.first_vertex + len(self.rest)]
        return rotation, (own - centre) @ rotation - (self.rest - rest_centre)

    def energy(self, positions: np.ndarray) -> float:
        """Return the elastic energy [J] at ``positions`` (n_vertices, 3) [m]."""
        _, u = self._displaced(positions)
        return float(0.5 * u.ravel() @ (self.matrix @ u.ravel()))

    def add_gradient(self, positions: np.ndarray, gradient: np.ndarray) -> float:
        """Add dE/dpositions [N] at a given frame to ``gradient`` (n_vertices, 3); return the energy [J]."""
        rotation, u = self._displaced(positions)
        force = self.matrix @ u.ravel()
        gradient[self.first_vertex : self.first_vertex + len(u)] += force.reshape(-1, 3) @ rotation.T
        return float(0.5 * u.ravel() @ force)

    def add_hessian(
        self, positions: np.ndarray, slots: tuple[np.ndarray, ...], blocks: np.ndarray, *, projected: bool = False
    ) -> None:
        """Add the Hessian R K R^T [N/m] to ``blocks`` (n_blocks + 1, 3, 3); it is positive semidefinite in any case."""
        where, stiffness = self._places(slots)
        if len(self.base):
            rotation, _, _ = self.frame(positions)
            stiffness = (stiffness.reshape(-1, 9) @ np.kron(rotation, rotation).T).reshape(-1, 3, 3)
        blocks[where] += stiffness

    def _places(self, slots: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Return K's blocks (m, 3, 3) and which of the scene's blocks each goes to; looked up once for ``slots``."""
        known = self.places.get("slots")
        if known is None or len(known) != len(slots) or any(a is not b for a, b in zip(known, slots)):
            where = np.full(len(self.stiffness), -1)
            for nodes, scene in zip(self.cliques, slots, strict=True):
                where[self.pattern.slots(nodes - self.first_vertex).ravel()] = scene.ravel()
            used = where >= 0  # a vertex without elements has a block in the pattern, but no stiffness
            self.places.update(slots=slots, found=(where[used], self.stiffness[used]))
        return self.places["found"]
