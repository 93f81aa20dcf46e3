"""A scene made ready for stepping: arrays, potentials, sparsity, and buffers for derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from finqd.mechanics.assembly_kernels import hold, largest_force
from finqd.mechanics.damping import damping_of
from finqd.mechanics.mass import lumped_masses
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.state import Direction, State

if TYPE_CHECKING:
    from finqd.contracts import Contact
    from finqd.mechanics.linear import LinearSolver
    from finqd.scene import Scene


@dataclass(kw_only=True)
class Derivatives:
    """Gradient and Hessian of all potentials; buffers that are filled anew at each evaluation.

    soft: dE/dpositions [N], (n_vertices, 3); rigid: force [N] and torque [N m], (n_rigid, 6)
    blocks: soft Hessian, (n_blocks + 1, 3, 3), see `BlockPattern`
    coupling: (3 n_vertices, 6 n_rigid); rigid_matrix: (6 n_rigid, 6 n_rigid)
    """

    soft: np.ndarray
    rigid: np.ndarray
    blocks: np.ndarray
    coupling: np.ndarray
    rigid_matrix: np.ndarray

    def clear_gradient(self) -> None:
        """Set the gradient to zero."""
        self.soft[:] = 0.0
        self.rigid[:] = 0.0

    def clear_hessian(self) -> None:
        """Set the Hessian to zero."""
        self.blocks[:] = 0.0
        self.coupling[:] = 0.0
        self.rigid_matrix[:] = 0.0


class System:
    """Everything of a `Scene` that steppers need.

    masses: lumped [kg], (n_vertices,); forces: gravity and dead loads [N], (n_vertices, 3)
    rigid_masses [kg], (n_rigid,); rigid_inertias: body frame [kg m^2], (n_rigid, 3, 3); rigid_forces [N], (n_rigid, 3)
    rigid_sizes: radius that turns a torque into a force for the residual [m], (n_rigid,)
    fixed: bool, (n_vertices, 3); rigid_held: bool, (n_rigid,)
    damping: of the materials, None where they have none
    shortest_step: [s] a step this short is not rejected for its error any more
    lightest_weight: of the bodies that nothing holds [N], at 1 g at least; inf if there is none
    """

    def __init__(self, scene: Scene, *, contact: Contact) -> None:
        self.scene = scene
        soft, rigid = scene.soft_bodies, scene.rigid_bodies
        n, m = scene.n_vertices, len(rigid)

        def stacked(rows: list[np.ndarray], *shape: int) -> np.ndarray:
            return np.concatenate(rows) if rows else np.zeros((0, *shape))

        own = [lumped_masses(b.mesh, b.material.density) for b in soft]
        self.masses = stacked([mass + b.extra_masses for mass, b in zip(own, soft, strict=True)])
        heavy = stacked([np.full(b.mesh.n_vertices, not b.weightless) for b in soft])
        self.forces = stacked([b.loads for b in soft], 3) + (self.masses * heavy)[:, None] * scene.gravity
        self.fixed = stacked([b.fixed for b in soft], 3).astype(bool)
        self.rigid_masses = np.array([b.shape.mass for b in rigid])
        self.rigid_inertias = np.array([b.shape.inertia for b in rigid]).reshape(m, 3, 3)
        self.rigid_forces = np.array([b.force + b.shape.mass * scene.gravity for b in rigid]).reshape(m, 3)
        self.rigid_held = np.array([b.held for b in rigid], dtype=bool)
        self.rigid_sizes = np.array([b.shape.bounding_radius for b in rigid])
        self.potentials = [b.elasticity.potential(b.mesh, b.material, first_vertex=b.first_vertex) for b in soft]
        self.damping = damping_of(soft, own, self.masses)
        viscous = () if self.damping is None else self.damping.cliques
        self._cliques = [*(c for p in self.potentials for c in p.cliques), *viscous]
        self._couplings = np.zeros((0, 2), dtype=np.int64)  # pairs of vertices that contact has coupled beside these
        self.contact = contact.potential(scene)
        self._lay_out()
        self.derivatives = Derivatives(
            soft=np.zeros((n, 3)), rigid=np.zeros((m, 6)), blocks=self.pattern.new_blocks(),
            coupling=np.zeros((3 * n, 6 * m)), rigid_matrix=np.zeros((6 * m, 6 * m)),
        )
        # where the elastic gradient was taken last, and what it was: contact is renewed without anything moving
        free = [own.sum() for own, b in zip(own, soft, strict=True) if not b.fixed.any()]
        free += [b.shape.mass for b in rigid if not b.held]
        self.lightest_weight = max(float(np.linalg.norm(scene.gravity)), 9.81) * min(free, default=np.inf)
        self._strained: np.ndarray | None = None
        self._elastic, self._elastic_energy = np.zeros((n, 3)), 0.0
        self.shortest_step = 0.0
        self._solvers: dict[str, LinearSolver] = {}  # of the steppers, by their settings
        self._histories: dict[str, dict[str, np.ndarray]] = {}  # of solvers that have not been asked for yet

    def _lay_out(self) -> None:
        """Find the sparsity of the soft Hessian, and tell everyone where their entries go."""
        self.pattern = BlockPattern.from_cliques(self.n_vertices, [*self._cliques, self._couplings])
        self.slots = [tuple(self.pattern.slots(c) for c in p.cliques) for p in self.potentials]
        self.contact.bind(self.pattern)
        if self.damping is not None:
            self.damping.bind(self.pattern)

    def _couple(self, pairs: np.ndarray) -> None:
        """Let ``pairs`` of vertices (n, 2) have entries in the soft Hessian from now on; solvers begin anew."""
        self._couplings = np.unique(np.concatenate([self._couplings, np.sort(pairs, axis=1)]), axis=0)
        self._lay_out()
        self.derivatives.blocks = self.pattern.new_blocks()
        self._solvers, self._histories = {}, {}

    def solver(self, settings: tuple, make: Callable[[], LinearSolver]) -> LinearSolver:
        """Return the solver with these ``settings``, made if there is none yet: what it lags goes from step to step."""
        key = repr(settings)
        if key not in self._solvers:
            self._solvers[key] = make()
            if key in self._histories:
                self._solvers[key].restore(self._histories.pop(key))
        return self._solvers[key]

    def history(self) -> dict[str, np.ndarray]:
        """Return by name what the next steps depend on beside the state: contact's history, and the solvers'."""
        solvers = {**{key: solver.history() for key, solver in self._solvers.items()}, **self._histories}
        parts = {"pattern": {"couplings": self._couplings}, "contact": self.contact.history()}
        parts |= {f"solver {key}": part for key, part in solvers.items()}
        return {f"{part}/{name}": value for part, values in parts.items() for name, value in values.items()}

    def restore(self, history: Mapping[str, np.ndarray]) -> None:
        """Go on with the `history` of a system like this one."""
        parts: dict[str, dict[str, np.ndarray]] = {}
        for path, value in history.items():
            part, _, name = path.rpartition("/")
            parts.setdefault(part, {})[name] = value
        couplings = parts.pop("pattern")["couplings"]
        if len(couplings):
            self._couple(couplings)
        self.contact.restore(parts.pop("contact"))
        self._histories = {part.removeprefix("solver "): values for part, values in parts.items()}
        self._solvers = {}

    @property
    def n_vertices(self) -> int:
        return len(self.masses)

    @property
    def n_rigid(self) -> int:
        return len(self.rigid_masses)

    def initial_state(self) -> State:
        """Return the scene's start: bodies at rest shape, with the velocities given."""
        soft, rigid = self.scene.soft_bodies, self.scene.rigid_bodies
        rotations = np.array([b.rotation for b in rigid]).reshape(-1, 3, 3)
        spins = np.array([b.angular_velocity for b in rigid]).reshape(-1, 3)
        inertias = rotations @ self.rigid_inertias @ rotations.transpose(0, 2, 1)
        return State(
            time=0.0,
            positions=np.concatenate([b.start_positions for b in soft]) if soft else np.zeros((0, 3)),
            velocities=np.concatenate([b.velocities for b in soft]) if soft else np.zeros((0, 3)),
            rigid_positions=np.array([b.position for b in rigid]).reshape(-1, 3),
            rigid_rotations=rotations,
            rigid_velocities=np.array([b.velocity for b in rigid]).reshape(-1, 3),
            angular_momenta=np.einsum("bij,bj->bi", inertias, spins),
            progress=np.zeros(len(self.scene.motions)),
        )

    def world_inertias(self, rotations: np.ndarray) -> np.ndarray:
        """Return the rigid bodies' inertias [kg m^2] in the world frame, shape (n_rigid, 3, 3)."""
        return rotations @ self.rigid_inertias @ rotations.transpose(0, 2, 1)

    def spins(self, rotations: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """Return the angular velocities [rad/s] of rigid bodies from their angular ``momenta`` (n_rigid, 3)."""
        if not self.n_rigid:
            return np.zeros((0, 3))
        return np.linalg.solve(self.world_inertias(rotations), momenta[:, :, None])[:, :, 0]

    def kinetic_energy(self, state: State) -> float:
        """Return the kinetic energy of all bodies [J]."""
        energy = float(np.vdot(self.masses, np.sum(state.velocities**2, axis=1)))
        energy += float(np.vdot(self.rigid_masses, np.sum(state.rigid_velocities**2, axis=1)))
        spins = self.spins(state.rigid_rotations, state.angular_momenta)
        return 0.5 * (energy + float(np.vdot(spins, state.angular_momenta)))

    def soft_centres(self, positions: np.ndarray) -> np.ndarray:
        """Return the centres of mass of the soft bodies [m], shape (n_soft, 3)."""
        spans = [slice(b.first_vertex, b.first_vertex + b.mesh.n_vertices) for b in self.scene.soft_bodies]
        found = [np.average(positions[span], axis=0, weights=self.masses[span]) for span in spans]
        return np.array(found).reshape(-1, 3)

    def advanced_progress(self, state: State, dt: float) -> np.ndarray:
        """Return how far each drive is after a step of ``dt``, given the contact forces at ``state``."""
        forces = self.contact.soft_forces
        return np.array(
            [
                motion.advanced(
                    state.progress[i], time=state.time, dt=dt, force=forces[self.scene.soft_bodies.index(body)]
                )
                for i, (body, _, motion) in enumerate(self.scene.motions)
            ]
        )

    def prescribe(self, positions: np.ndarray, progress: np.ndarray, time: float) -> None:
        """Write the positions of driven vertices at ``time`` into ``positions``."""
        for i, (body, nodes, motion) in enumerate(self.scene.motions):
            pose = motion.pose(float(progress[i]), time)
            positions[nodes + body.first_vertex] = body.start_positions[nodes] @ pose[:3, :3].T + pose[:3, 3]

    def elastic_energy(self, positions: np.ndarray) -> float:
        """Return the elastic energy of all soft bodies [J]."""
        if positions is self._strained:
            return self._elastic_energy
        return sum(p.energy(positions) for p in self.potentials)

    def _strain(self, positions: np.ndarray) -> None:
        """Find elastic energy and gradient, unless they are those of this very array (which is never written to)."""
        if positions is self._strained:
            return
        self._strained = None
        self._elastic[:] = 0.0
        self._elastic_energy = sum(p.add_gradient(positions, self._elastic) for p in self.potentials)
        self._strained = positions

    def energy(self, state: State) -> float:
        """Return elastic, contact, friction and dead-load energy [J]."""
        dead = np.vdot(self.forces, state.positions) + np.vdot(self.rigid_forces, state.rigid_positions)
        return self.elastic_energy(state.positions) + self.contact.energy(state) - dead

    def add_gradient(self, state: State) -> float:
        """Add the gradient of `energy` to `derivatives`, and return that energy [J]."""
        d = self.derivatives
        d.soft -= self.forces
        d.rigid[:, :3] -= self.rigid_forces
        energy = -np.vdot(self.forces, state.positions) - np.vdot(self.rigid_forces, state.rigid_positions)
        self._strain(state.positions)
        d.soft += self._elastic
        return energy + self._elastic_energy + self.contact.add_gradient(state, d)

    def add_hessian(self, state: State, *, projected: bool = False, contact_projected: bool = False) -> None:
        """Add the Hessian of `energy` to `derivatives`, cleared before; ``projected``: a positive semidefinite one.

        contact_projected: that of contact is, in any case.
        """
        d = self.derivatives
        self.find_couplings(state)
        for potential, slots in zip(self.potentials, self.slots, strict=True):
            potential.add_hessian(state.positions, slots, d.blocks, projected=projected)
        self.contact.add_hessian(state, d, projected=projected or contact_projected)

    def find_couplings(self, state: State) -> None:
        """Make room in the soft Hessian for all that contact couples at ``state``; an empty one takes its place."""
        if hasattr(self.contact, "couplings"):
            pairs = self.contact.couplings(state)
            if len(pairs):
                self._couple(pairs)

    def hold_fixed(self) -> None:
        """Make held degrees of freedom drop out of the Hessian."""
        d = self.derivatives
        hold(self.pattern.indptr, self.pattern.indices, self.fixed, d.blocks, d.coupling)
        self.hold_rigid()

    def hold_rigid(self) -> None:
        """Make held rigid bodies drop out of the Hessian."""
        d = self.derivatives
        for b in np.flatnonzero(self.rigid_held):
            body = slice(6 * b, 6 * b + 6)
            d.coupling[:, body] = 0.0
            d.rigid_matrix[body] = d.rigid_matrix[:, body] = 0.0
            d.rigid_matrix[body, body] = np.eye(6)

    def clear_held(self) -> None:
        """Make held degrees of freedom drop out of the gradient."""
        self.derivatives.soft[self.fixed] = 0.0
        self.derivatives.rigid[self.rigid_held] = 0.0

    def contact_forces_on_rigid(self, state: State) -> np.ndarray:
        """Return force [N] and torque [N m] of all contacts on each rigid body at ``state``, shape (n_rigid, 6)."""
        self.derivatives.clear_gradient()
        self.contact.add_gradient(state, self.derivatives)
        return -self.derivatives.rigid

    def residual(self) -> tuple[float, str]:
        """Return the largest unbalanced force in `derivatives` [N] and what it acts on.

        A torque counts as a force on a lever of the body's size.
        """
        d = self.derivatives
        best, vertex = largest_force(d.soft, self.fixed)
        where = self._vertex_name(vertex) if vertex >= 0 else ""
        for i, force in enumerate(self._rigid_forces() if np.isfinite(best) else ()):
            if not force <= best:
                best, where = float(force), self.scene.rigid_bodies[i].name
        return float(best), where

    def rigid_residual(self) -> float:
        """Return the largest unbalanced force on a rigid body [N], as `residual` counts torques."""
        return float(np.max(self._rigid_forces(), initial=0.0))

    def _rigid_forces(self) -> np.ndarray:
        forces, torques = np.linalg.norm(self.derivatives.rigid.reshape(-1, 2, 3), axis=2).T
        return np.maximum(forces, torques / self.rigid_sizes)

    def _vertex_name(self, vertex: int) -> str:
        for body in self.scene.soft_bodies:
            if vertex < body.first_vertex + body.mesh.n_vertices:
                return f"{body.name}, vertex {vertex - body.first_vertex}"
        return f"vertex {vertex}"

    def zero_direction(self) -> Direction:
        """Return a direction in which nothing moves."""
        return Direction(soft=np.zeros((self.n_vertices, 3)), rigid=np.zeros((self.n_rigid, 6)))
