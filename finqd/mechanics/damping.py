r"""Rayleigh damping of soft bodies (rayleighMass and rayleighStiffness in SOFA), made only for materials that have it.

By the mass (alpha): the force -alpha m v on every vertex, m the material's own mass. By the stiffness (beta):
Kelvin-Voigt, the stress beta C : (rate of strain), with the strain rate of each element in its own rotating frame: with
y_a = R^T (x_a - c), the element's nodes without its translation and rotation (`finqd.mechanics.corotated_kernels`), the
power lost is (dy/dt)^T beta K dy/dt. Rigid motion costs nothing, momenta are kept, and whatever the elasticity, small
vibrations of angular frequency w are damped by the ratio

.. math:: \zeta = \alpha / (2 \omega) + \beta \omega / 2

In a backward formula (`finqd.mechanics.incremental.Past`: x' = (x - origin) / h) both are terms of the incremental
potential,

.. math:: \alpha m |x - x_0|^2 / (2 h), \qquad \beta (y - y_0)^T K (y - y_0) / (2 h)

with x0 the origin and y0 the same combination of the shapes y before. So the second is the energy of corotated elements
of the stiffness beta K / h and the rest shape y0, and takes their kernels.
Source of the ratio: Bathe, Finite Element Procedures, 9.3.3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from finqd.errors import InputError
from finqd.mechanics import corotated_kernels as kernels
from finqd.mechanics.assembly_kernels import add_diagonal
from finqd.mechanics.damping_kernels import write_local_shapes
from finqd.mechanics.element_stiffness import kinds_of, rest_elements

if TYPE_CHECKING:
    from finqd.mechanics.incremental import Past
    from finqd.mechanics.material import Material
    from finqd.mechanics.pattern import BlockPattern
    from finqd.mechanics.state import State
    from finqd.scene import SoftBody

_NONE = np.zeros((1, 1, 1))


@dataclass(frozen=True, eq=False)
class ViscousBlock:
    """Elements of one type: nodes (n, k), gradients (n, k, 3) [1/m], kinds (n,), their viscosity beta K [N s/m]."""

    nodes: np.ndarray
    gradients: np.ndarray
    kinds: np.ndarray
    viscosity: np.ndarray

    def arrays(self, shapes: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return what the elastic kernels take first, with ``shapes`` (n, k, 3) [m] for the rest positions."""
        return self.nodes, shapes, self.gradients, self.kinds

    def shapes(self, positions: np.ndarray) -> np.ndarray:
        """Return y [m], (n, k, 3), of all elements at ``positions`` (n_vertices, 3) [m]."""
        shapes = np.zeros(self.gradients.shape)
        write_local_shapes(self.nodes, self.gradients, positions, shapes)
        return shapes


def damping_of(
    bodies: Sequence[SoftBody], own_masses: Sequence[np.ndarray], masses: np.ndarray
) -> Damping | None:
    """Return the damping of a scene's soft bodies, None if no material has any.

    own_masses: of the material, an array a body [kg]; masses: of all vertices, with what hangs on them [kg]
    Raises InputError for a constant that is negative or not finite.
    """
    for body in bodies:
        _check(body.material)
    if not any(b.material.rayleigh_mass or b.material.rayleigh_stiffness for b in bodies):
        return None
    drag = np.concatenate([b.material.rayleigh_mass * own for b, own in zip(bodies, own_masses, strict=True)])
    return Damping(drag, masses, tuple(block for b in bodies if b.material.rayleigh_stiffness for block in _viscous(b)))


def _check(material: Material) -> None:
    for name in ("rayleigh_mass", "rayleigh_stiffness"):
        value = getattr(material, name)
        if not 0.0 <= value < math.inf:
            raise InputError(f"must be at least 0, not {value}", f"material.{name}")


def _viscous(body: SoftBody) -> list[ViscousBlock]:
    vertices, material = np.asarray(body.mesh.vertices, dtype=float), body.material
    blocks = []
    for name, nodes in body.mesh.blocks.items():
        if len(nodes):
            nodes = np.asarray(nodes, dtype=np.int64)
            elements = rest_elements(name, vertices[nodes], material.lame)
            first, kinds = kinds_of(vertices[nodes] - vertices[nodes].mean(axis=1, keepdims=True))
            blocks.append(ViscousBlock(
                nodes + body.first_vertex, np.ascontiguousarray(elements.gradients),
                kinds, np.ascontiguousarray(material.rayleigh_stiffness * elements.stiffness[first]),
            ))
    return blocks


class Damping:
    """What the materials of a scene resist motion with.

    drag: alpha m of each vertex [kg/s], (n_vertices,); viscous: the elements that resist strain rates, by type and body
    """

    def __init__(self, drag: np.ndarray, masses: np.ndarray, viscous: tuple[ViscousBlock, ...]) -> None:
        self.drag, self.viscous = drag, viscous
        self._rates = drag / np.where(masses > 0.0, masses, 1.0)
        self._scaled: tuple[float, tuple[np.ndarray, ...]] = (0.0, ())

    @property
    def cliques(self) -> tuple[np.ndarray, ...]:
        """Vertex ids that each element couples."""
        return tuple(block.nodes for block in self.viscous)

    def bind(self, pattern: BlockPattern) -> None:
        """Look up where in the Hessian's blocks the elements go."""
        self.pattern = pattern
        self.slots = tuple(pattern.slots(nodes) for nodes in self.cliques)

    def over(self, state: State, past: Past) -> StepDamping:
        """Return the damping over a step from ``state`` by the formula of ``past``."""
        return StepDamping(self, state, past)

    def decay(self, time: float) -> np.ndarray:
        """Return by what drag alone scales velocities in ``time`` [s], (n_vertices, 1)."""
        return np.exp(-time * self._rates)[:, None]

    def add_viscosity(self, positions: np.ndarray, blocks: np.ndarray) -> None:
        """Add to ``blocks`` (n_blocks + 1, 3, 3) the matrix D [N s/m] of the viscous forces -D v at ``positions``.

        D = (dy/dx)^T beta K dy/dx: positive semidefinite, zero for rigid motions. The exact Hessian of corotated
        elements that are at rest in their present shape is just that.
        """
        for block, slots in zip(self.viscous, self.slots, strict=True):
            shapes = block.shapes(positions)
            kernels.add_hessian(*block.arrays(shapes), block.viscosity, _NONE, positions, slots, blocks, False)

    def stiffnesses(self, h: float) -> tuple[np.ndarray, ...]:
        """Return beta K / h [N/m] of each block, kept from step to step."""
        known, scaled = self._scaled
        if h != known:
            scaled = tuple(block.viscosity / h for block in self.viscous)
            self._scaled = h, scaled
        return scaled


class StepDamping:
    """The dissipation potential of one implicit step; ``positions`` (n_vertices, 3) [m] are those at its end."""

    def __init__(self, damping: Damping, state: State, past: Past) -> None:
        self.damping, self.origin = damping, past.origin
        self.weight = (damping.drag / past.h)[:, None]
        self.stiffnesses = damping.stiffnesses(past.h)
        self.shapes = [block.shapes(state.positions) for block in damping.viscous]
        if past.earlier:
            for block, shapes in zip(damping.viscous, self.shapes, strict=True):
                shapes += past.earlier * (shapes - block.shapes(state.previous.positions))

    def _drag_energy(self, positions: np.ndarray) -> float:
        return 0.5 * float(np.vdot(self.weight, np.sum((positions - self.origin) ** 2, axis=1)))

    def energy(self, positions: np.ndarray) -> float:
        """Return the dissipation potential [J]."""
        energy = self._drag_energy(positions)
        for block, shapes, stiffness in zip(self.damping.viscous, self.shapes, self.stiffnesses, strict=True):
            energy += kernels.energy(*block.arrays(shapes), stiffness, positions)
        return energy

    def add_gradient(self, positions: np.ndarray, gradient: np.ndarray) -> float:
        """Add its gradient [N] to ``gradient`` (n_vertices, 3); return the potential [J]."""
        gradient += self.weight * (positions - self.origin)
        energy = self._drag_energy(positions)
        for block, shapes, stiffness in zip(self.damping.viscous, self.shapes, self.stiffnesses, strict=True):
            energy += kernels.add_gradient(*block.arrays(shapes), stiffness, positions, gradient)
        return energy

    def add_hessian(self, positions: np.ndarray, blocks: np.ndarray, *, projected: bool = False) -> None:
        """Add its Hessian [N/m] to ``blocks`` (n_blocks + 1, 3, 3); ``projected``: the positive semidefinite part of it
        that `Damping.add_viscosity` describes.
        """
        damping = self.damping
        add_diagonal(damping.pattern.indptr, self.weight[:, 0], blocks)
        for b, (block, stiffness) in enumerate(zip(damping.viscous, self.stiffnesses, strict=True)):
            shapes = block.shapes(positions) if projected else self.shapes[b]
            kernels.add_hessian(*block.arrays(shapes), stiffness, _NONE, positions, damping.slots[b], blocks, False)
