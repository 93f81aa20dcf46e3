"""The incremental potential of one implicit Euler step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from finqd.mechanics.assembly_kernels import add_diagonal
from finqd.mechanics.rotation_kernels import inverse_left_jacobian, rotation_vector
from finqd.mechanics.state import Direction, State
from finqd.mechanics.system import System


class EulerIncrement:
    r"""Inertia plus all potentials, whose minimum is the implicit Euler step (Ortiz and Stainier 1999).

    Soft: m |x - x0 - dt v0|^2 / (2 dt^2) a vertex. Rigid: the same of the centre of mass, and
    (t - dt w0)^T J (t - dt w0) / (2 dt^2) with the rotation vector t of the step, J the inertia at its start
    and w0 = J^-1 L0; the new angular momentum is J t / dt, so that a free body keeps its own exactly.
    """

    def __init__(self, system: System, state: State, dt: float) -> None:
        self.system, self.start, self.dt = system, state, dt
        self.time = state.time + dt
        self.progress = system.advanced_progress(state, dt)
        self.inertias = system.world_inertias(state.rigid_rotations)
        self.inertial = state.positions + dt * state.velocities
        self.rigid_inertial = state.rigid_positions + dt * state.rigid_velocities
        self.spins = (
            np.linalg.solve(self.inertias, state.angular_momenta[:, :, None])[:, :, 0] * dt if system.n_rigid else
            np.zeros((0, 3))
        )
        self.vertex_weight = np.where(system.fixed, 0.0, (system.masses / dt**2)[:, None])
        #: a typical energy [J], for the rounding of differences of energies
        self.scale = abs(system.energy(state))

    def predicted(self) -> State:
        """Return where to start: driven vertices at their targets, the rest moving on, or staying if that is lower."""
        candidates = [self._start(1.0), self._start(0.0)]
        energies = [self.energy(candidate) for candidate in candidates]
        return candidates[1] if energies[1] < energies[0] else candidates[0]

    def _start(self, share: float) -> State:
        direction = Direction(
            soft=self.dt * self.start.velocities,
            rigid=np.concatenate([self.dt * self.start.rigid_velocities, self.spins], axis=1),
        )
        if share > 0.0:
            share = min(share, self.system.contact.step_limit(self.start, direction))
        moved = self.start.moved(direction, share)
        positions = np.where(self.system.fixed, self.start.positions, moved.positions)
        self.system.prescribe(positions, self.progress, self.time)
        return replace(moved, positions=positions)

    def _turns(self, state: State) -> np.ndarray:
        turns = np.zeros((self.system.n_rigid, 3))
        for b in range(self.system.n_rigid):
            turns[b] = rotation_vector(state.rigid_rotations[b] @ self.start.rigid_rotations[b].T)
        return turns

    def _inertia_energy(self, state: State, turns: np.ndarray) -> float:
        soft = np.vdot(self.vertex_weight, (state.positions - self.inertial) ** 2)
        shift = state.rigid_positions - self.rigid_inertial
        off = turns - self.spins
        rigid = np.vdot(self.system.rigid_masses, np.sum(shift**2, axis=1))
        rigid += np.einsum("bi,bij,bj", off, self.inertias, off)
        return 0.5 * soft + 0.5 * rigid / self.dt**2

    def energy(self, state: State) -> float:
        """Return the incremental potential [J]."""
        return self._inertia_energy(state, self._turns(state)) + self.system.energy(state)

    def gradient(self, state: State) -> float:
        """Fill the gradient in the system's derivatives, zero where held; return the energy [J]."""
        system, d = self.system, self.system.derivatives
        d.clear_gradient()
        turns = self._turns(state)
        energy = system.add_gradient(state) + self._inertia_energy(state, turns)
        d.soft += self.vertex_weight * (state.positions - self.inertial)
        d.rigid[:, :3] += (system.rigid_masses / self.dt**2)[:, None] * (state.rigid_positions - self.rigid_inertial)
        for b, turn in enumerate(turns):
            d.rigid[b, 3:] += inverse_left_jacobian(turn).T @ self.inertias[b] @ (turn - self.spins[b]) / self.dt**2
        system.clear_held()
        return energy

    def hessian(self, state: State, *, projected: bool = False) -> None:
        """Fill the Hessian in the system's derivatives, the identity where held."""
        system, d, dt = self.system, self.system.derivatives, self.dt
        d.clear_hessian()
        system.add_hessian(state, projected=projected)
        add_diagonal(system.pattern.indptr, system.pattern.indices, system.masses / dt**2, d.blocks)
        for b, turn in enumerate(self._turns(state)):
            jacobian = inverse_left_jacobian(turn)
            body = slice(6 * b, 6 * b + 6)
            d.rigid_matrix[body, body][:3, :3] += np.eye(3) * system.rigid_masses[b] / dt**2
            d.rigid_matrix[body, body][3:, 3:] += jacobian.T @ self.inertias[b] @ jacobian / dt**2
        system.hold_fixed()

    def finished(self, trial: State) -> State:
        """Return ``trial`` as the end of the step, with its velocities."""
        dt, start = self.dt, self.start
        return replace(
            trial, time=self.time, progress=self.progress,
            velocities=(trial.positions - start.positions) / dt,
            rigid_velocities=(trial.rigid_positions - start.rigid_positions) / dt,
            angular_momenta=np.einsum("bij,bj->bi", self.inertias, self._turns(trial)) / dt,
        )
