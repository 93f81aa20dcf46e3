"""Steps that are parted into shorter ones, as long as contact (and, without a matrix, elasticity) stays stable."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Protocol

import numpy as np
from annotated_types import Ge, Gt, Le

from finqd.mechanics.explicit_kernels import row_bound
from finqd.mechanics.rotation_kernels import rotation_matrix
from finqd.mechanics.state import Direction, State, StepReport
from finqd.mechanics.system import System

GROUP = 8  # substeps after which the stable step is looked up again
GAIN = 0.5  # energy out of nothing, as a share of kinetic and stored energy, that is a blow-up
FLOOR_SPEED = 0.01  # [m/s] and the speed of everything that is too slow to call it one
AHEAD = 2.0  # how much farther than those substeps go contact is looked for
ONSET = 4.0  # contact's squared frequencies count this much more: where it sets in, stable is not yet accurate
LOOKS = 60  # how often the stable step is shortened until contact that lies ahead agrees with it
DENSE = 60  # unknowns up to which eigenvalues are found by a dense solver
DRIVE_LOOK = 1e-4  # share of a step over which the speed of a drive at its end is measured


@dataclass(frozen=True, kw_only=True)
class SubstepOptions:
    """Options of every stepper that takes substeps.

    safety: share of the largest stable substep that is used
    damping_per_s: rate at which all velocities decay; it also brakes what falls or slides
    max_substeps: substeps in one step, above which it is given up (and halved)
    """

    safety: Annotated[float, Gt(0), Le(1)] = 0.8
    damping_per_s: Annotated[float, Ge(0), Le(1e5)] = 0.0
    max_substeps: Annotated[int, Ge(1), Le(100_000_000)] = 20_000


class Course:
    """The driven vertices within a step: a cubic from where and how fast they were to where and how fast they go.

    ids: vertices, (n,); progress: of the drives at the end
    """

    def __init__(self, system: System, state: State, dt: float) -> None:
        nodes = [nodes + body.first_vertex for body, nodes, _ in system.scene.motions]
        self.ids = np.unique(np.concatenate(nodes)) if nodes else np.zeros(0, dtype=np.int64)
        self.progress = system.advanced_progress(state, dt)
        self._start, self._dt = state.time, dt
        self._x0, self._v0 = state.positions[self.ids], dt * state.velocities[self.ids]
        places = state.positions.copy()
        late = state.progress + (1.0 - DRIVE_LOOK) * (self.progress - state.progress)
        system.prescribe(places, late, state.time + (1.0 - DRIVE_LOOK) * dt)
        before = places[self.ids]
        system.prescribe(places, self.progress, state.time + dt)
        self._x1, self._v1 = places[self.ids], (places[self.ids] - before) / DRIVE_LOOK

    def positions(self, time: float) -> np.ndarray:
        """Return where the driven vertices are [m], shape (n, 3)."""
        s = min((time - self._start) / self._dt, 1.0)
        if s > 1.0 - 1e-12:
            return self._x1
        s2, s3 = s * s, s * s * s
        ahead = 3 * s2 - 2 * s3
        return (1 - ahead) * self._x0 + ahead * self._x1 + (s3 - 2 * s2 + s) * self._v0 + (s3 - s2) * self._v1

    @property
    def end_velocities(self) -> np.ndarray:
        """How fast they are at the end [m/s], shape (n, 3)."""
        return self._v1 / self._dt


class Motion:
    """What moves in a substepped step: positions as a `State`, velocities beside it, forces in the system's gradient.

    state: its velocities are those at the start of the step; velocities: zero where held, (n_vertices, 3) [m/s]
    rigid_velocities [m/s], momenta [kg m^2/s]: (n_rigid, 3)
    inverse_masses: 0 where held, (n_vertices, 3) [1/kg]; rigid_free: 1 or 0, (n_rigid, 1)
    substep: length of the last one [s]; touching: whether any contact can come up in the next few
    potential: energy at ``state`` [J]; work: that the drives have done [J]
    """

    def __init__(self, system: System, state: State, dt: float) -> None:
        self.system, self.start, self.state, self.dt = system, state, state, dt
        self.course = Course(system, state, dt)
        held = system.fixed | (system.masses <= 0.0)[:, None]
        self.inverse_masses = np.where(held, 0.0, 1.0 / np.where(system.masses > 0.0, system.masses, 1.0)[:, None])
        self.velocities = np.where(held, 0.0, state.velocities)
        self.rigid_free = np.where(system.rigid_held, 0.0, 1.0)[:, None]
        self.rigid_velocities = self.rigid_free * state.rigid_velocities
        self.momenta = self.rigid_free * state.angular_momenta
        self.substep, self.touching = dt, True
        self.work, self.potential = 0.0, self._forces()
        self.start_energy = self.kinetic() + self.potential

    def _forces(self) -> float:
        self.system.derivatives.clear_gradient()
        return float(self.system.add_gradient(self.state))

    def kick(self, h: float, decay: float) -> None:
        """Let the rigid bodies' forces at ``state`` act for ``h`` [s]."""
        d, system = self.system.derivatives, self.system
        if system.n_rigid:
            rates = d.rigid[:, :3] / system.rigid_masses[:, None]
            self.rigid_velocities = decay * (self.rigid_velocities - h * self.rigid_free * rates)
            self.momenta = decay * (self.momenta - h * self.rigid_free * d.rigid[:, 3:])

    def drift(self, h: float, time: float) -> None:
        """Move everything on by ``h`` [s], to ``time``, and look up the forces there."""
        old, ids, d = self.state, self.course.ids, self.system.derivatives
        positions = old.positions + h * self.velocities
        if len(ids):
            positions[ids] = self.course.positions(time)
        rigid_positions = old.rigid_positions + h * self.rigid_velocities
        rotations = old.rigid_rotations
        if len(rotations):
            rotations = np.stack([self._turned(b, h) for b in range(len(rotations))])
        pushed = d.soft[ids]
        self.state = State(
            time=time, positions=positions, velocities=old.velocities, rigid_positions=rigid_positions,
            rigid_rotations=rotations, rigid_velocities=old.rigid_velocities, angular_momenta=old.angular_momenta,
            progress=old.progress,
        )
        if self.touching:
            # bounds from before, out of phase with a vibration, would feed it
            self.system.contact.relag(self.state, whole=True)
        self.potential = self._forces()
        if len(ids):
            self.work += 0.5 * float(np.vdot(pushed + d.soft[ids], positions[ids] - old.positions[ids]))

    def spin(self, b: int, rotation: np.ndarray) -> np.ndarray:
        """Return the angular velocity [rad/s] of rigid body ``b`` at an orientation."""
        body = rotation.T @ self.momenta[b]
        return rotation @ np.linalg.solve(self.system.rigid_inertias[b], body)

    def _turned(self, b: int, h: float) -> np.ndarray:
        """Return the orientation after ``h`` [s] at the momentum of now: the midpoint rule on rotations."""
        rotation = self.state.rigid_rotations[b]
        middle = rotation_matrix(0.5 * h * self.spin(b, rotation)) @ rotation
        return rotation_matrix(h * self.spin(b, middle)) @ rotation

    def direction(self, h: float, time: float) -> Direction:
        """Return where everything goes in ``h`` [s] at the velocities of now under gravity and dead loads alone, drives
        to where they are at ``time``.
        """
        system, fall = self.system, 0.5 * h * h
        soft = h * self.velocities + fall * self.inverse_masses * system.forces
        soft[self.course.ids] = self.course.positions(time) - self.state.positions[self.course.ids]
        spins = [self.spin(b, r) for b, r in enumerate(self.state.rigid_rotations)]
        moves = h * self.rigid_velocities + fall * self.rigid_free * system.rigid_forces / system.rigid_masses[:, None]
        rigid = np.concatenate([moves, h * np.reshape(spins, (-1, 3))], axis=1)
        return Direction(soft=soft, rigid=rigid)

    def kinetic(self) -> float:
        """Return the kinetic energy of all that is free [J]."""
        system = self.system
        energy = 0.5 * float(np.vdot(system.masses, np.sum(self.velocities**2, axis=1)))
        energy += 0.5 * float(np.vdot(system.rigid_masses, np.sum(self.rigid_velocities**2, axis=1)))
        for b, rotation in enumerate(self.state.rigid_rotations):
            energy += 0.5 * float(self.momenta[b] @ self.spin(b, rotation))
        return energy

    def trouble(self) -> str:
        """Return a sentence if the motion is no longer finite or has won energy out of nothing."""
        system, state, kinetic = self.system, self.state, self.kinetic()
        if not (math.isfinite(kinetic) and math.isfinite(self.potential)):
            return f"the motion is no longer finite ({system.residual()[1]})"
        gain = kinetic + self.potential - self.start_energy - self.work
        mass = float(system.masses.sum() + system.rigid_masses.sum())
        dead = np.vdot(system.forces, state.positions) + np.vdot(system.rigid_forces, state.rigid_positions)
        stored = self.potential + float(dead)
        if gain > GAIN * (kinetic + stored) + 0.5 * mass * FLOOR_SPEED**2:
            return f"unstable: {gain:.3g} J out of nothing"
        return ""

    def finished(self) -> State:
        """Return the end of the step."""
        velocities = self.velocities.copy()
        velocities[self.course.ids] = self.course.end_velocities
        return replace(
            self.state, time=self.start.time + self.dt, velocities=velocities, rigid_velocities=self.rigid_velocities,
            angular_momenta=self.momenta, progress=self.course.progress,
        )


class Method(Protocol):
    """How a substep is done; ``rate`` [1/s^2]: largest squared frequency beside contact's that it must resolve.

    binary: substeps are the step's length over a power of two, so that matrices can be kept
    """

    rate: float
    binary: bool

    def advance(self, motion: Motion, h: float, time: float) -> None:
        """Take ``motion`` on by ``h`` [s], to ``time`` [s]."""


def contact_rate(system: System, state: State) -> float:
    """Return an upper bound of the largest squared frequency [1/s^2] of contact and friction at ``state``.

    The mass-scaled stiffness is positive semidefinite, [[A, B], [B^T, C]], so its largest eigenvalue is at most that of
    A (soft; bounded by row sums) plus that of C (rigid; six unknowns a body).
    """
    d = system.derivatives
    system.find_couplings(state)
    d.clear_hessian()
    system.contact.add_hessian(state, d, projected=True)
    scale = np.where(system.fixed | (system.masses <= 0.0)[:, None], 0.0, system.masses[:, None])
    scale = np.where(scale > 0.0, 1.0 / np.sqrt(np.where(scale > 0.0, scale, 1.0)), 0.0)
    bound = row_bound(system.pattern.indptr, system.pattern.indices, d.blocks, scale)
    free = ~system.rigid_held
    rates = [0.0]
    for b, inertia in enumerate(system.world_inertias(state.rigid_rotations)):
        if free[b]:
            body, root = slice(6 * b, 6 * b + 6), np.zeros((6, 6))
            root[:3, :3] = np.eye(3) / math.sqrt(system.rigid_masses[b])
            root[3:, 3:] = np.linalg.inv(np.linalg.cholesky(inertia))
            rates.append(float(np.linalg.eigvalsh(root @ d.rigid_matrix[body, body] @ root.T)[-1]))
    return bound + max(rates)


def elastic_rate(system: System, state: State) -> float:
    """Return the largest squared frequency [1/s^2] of the soft bodies at ``state``, by Lanczos to about 1 %."""
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import ArpackNoConvergence, eigsh

    blocks = np.zeros_like(system.derivatives.blocks)
    for potential, slots in zip(system.potentials, system.slots, strict=True):
        potential.add_hessian(state.positions, slots, blocks)
    masses = np.where(system.masses > 0.0, system.masses, np.inf)[:, None]
    scale = np.where(system.fixed, 0.0, 1.0 / np.sqrt(masses))
    if not scale.any():
        return 0.0
    root = diags_array(scale.ravel())
    matrix = (root @ system.pattern.matrix(blocks).tocsr() @ root).tocsr()
    if matrix.shape[0] <= DENSE:
        return float(np.linalg.eigvalsh(matrix.toarray())[-1])
    start = np.random.default_rng(0).standard_normal(matrix.shape[0])
    try:
        return float(eigsh(matrix, k=1, which="LA", v0=start, tol=1e-2, return_eigenvectors=False)[0])
    except ArpackNoConvergence:
        return row_bound(system.pattern.indptr, system.pattern.indices, blocks, scale)


def substeps(motion: Motion, method: Method, options: SubstepOptions) -> tuple[State, StepReport]:
    """Return the end of the step, or its start and the reason, by as many substeps as it takes.

    Friction is renewed and committed in every substep in which something can touch. That cannot be taken back: a step
    that is tried again starts with elastic slips from within the failed one, which are below a micrometre.
    """
    system, report, dt = motion.system, StepReport(), motion.dt
    done = 0.0  # share of the step
    while done < 1.0 - 1e-12:
        count = _count(motion, method, options, 1.0 - done)
        if report.substeps + count > options.max_substeps:
            report.reason = f"{dt / count * (1.0 - done):.3g} s is the longest stable substep: more than max_substeps"
            return motion.start, report
        h = (1.0 - done) / count
        for _ in range(min(GROUP, count)):
            if report.substeps and motion.touching:
                system.contact.commit(motion.state)
                system.contact.begin_step(motion.state)
            done = min(done + h, 1.0)
            method.advance(motion, h * dt, motion.start.time + done * dt)
            report.substeps += 1
        report.reason = motion.trouble()
        if report.reason:
            return motion.start, report
    system.contact.commit(motion.state)
    report.converged = True
    return motion.finished(), report


def _count(motion: Motion, method: Method, options: SubstepOptions, left: float) -> int:
    """Return in how many equal substeps the rest of the step, a share ``left``, can be done.

    Contact is looked at where it is now and, since it stiffens as it begins, where everything will be at the end of
    the next few substeps.
    """
    system, dt = motion.system, motion.dt
    now = contact_rate(system, motion.state)
    longest, count, ahead = min(left * dt, 2.0 * motion.substep), 1, now
    for _ in range(LOOKS):
        count = max(math.ceil(left * dt / longest * (1 - 1e-9)), 1)
        if method.binary:  # 1/left is a power of two over a whole number
            unit = 2.0 ** -math.ceil(-math.log2(longest / dt) - 1e-9)
            while abs(left / unit - round(left / unit)) > 1e-6:
                unit *= 0.5
            count = max(round(left / unit), 1)
        h = left * dt / count
        span = min(GROUP, count) * h
        time = motion.start.time + (1.0 - left) * dt + span
        direction = motion.direction(span, time)
        reach = system.contact.step_limit(motion.state, direction)
        ahead = contact_rate(system, motion.state.moved(direction, AHEAD * reach))
        rate = method.rate + ONSET * max(now, ahead)
        stable = 2.0 * options.safety / math.sqrt(rate) if rate > 0.0 else math.inf
        if h <= stable * (1 + 1e-9) and reach >= 1.0:
            break
        longest = min(max(stable, 0.5 * h), h if reach >= 1.0 else 0.5 * h)
    motion.substep, motion.touching = left * dt / count, max(now, ahead) > 0.0
    return count
