"""The incremental potential of one implicit step, for any formula that makes velocities of positions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from finqd.mechanics.assembly_kernels import add_diagonal
from finqd.mechanics.rotation_kernels import inverse_left_jacobian, rotation_matrix, rotation_vector
from finqd.mechanics.state import Direction, State
from finqd.mechanics.system import System


@dataclass(frozen=True, kw_only=True)
class Past:
    """What a step knows of the motion so far: in a backward formula, x = origin + h v and v = base + h a at its end.

    h: effective step [s]; earlier: share b of the state before in all origins, (1 + b) x0 - b x_before
    origin, inertial: where each soft vertex was, and would be without forces, origin + h base [m], (n_vertices, 3)
    rigid_origin, rigid_inertial: the same of the rigid centres of mass [m], (n_rigid, 3)
    turns: rotation vector since the step's start of each rigid body without torques [rad], (n_rigid, 3)
    inertias: that weigh a rotation vector's distance from ``turns``, (n_rigid, 3, 3) [kg m^2]
    momenta: base of the angular momenta [kg m^2/s], (n_rigid, 3); None: those at the end are ``inertias`` turn / h
    """

    h: float
    earlier: float = 0.0
    origin: np.ndarray
    inertial: np.ndarray
    rigid_origin: np.ndarray
    rigid_inertial: np.ndarray
    turns: np.ndarray
    inertias: np.ndarray
    momenta: np.ndarray | None = None


def euler_past(system: System, state: State, dt: float) -> Past:
    r"""Return the past as implicit Euler sees it: x = x0 + dt v, v = v0 + dt a.

    Rigid bodies: J at the step's start, turns = dt J^-1 L0; the new angular momentum is J t / dt of the step's
    rotation vector t, so that a free body keeps its own exactly.
    """
    inertias = system.world_inertias(state.rigid_rotations)
    return Past(
        h=dt, origin=state.positions, inertial=state.positions + dt * state.velocities,
        rigid_origin=state.rigid_positions, rigid_inertial=state.rigid_positions + dt * state.rigid_velocities,
        turns=system.spins(state.rigid_rotations, state.angular_momenta) * dt, inertias=inertias,
    )


def bdf2_coefficients(ratio: float) -> tuple[float, float, float]:
    r"""Return (a, b, beta) of y1 = a y0 - b y_before + beta dt y1' with ratio = dt / dt_before.

    a = (1 + w)^2 / (1 + 2 w), b = w^2 / (1 + 2 w), beta = (1 + w) / (1 + 2 w): 4/3, 1/3 and 2/3 for equal steps.
    Source: Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, III.5 (zero-stable for
    w < 1 + sqrt 2); Celaya, Aguirrezabala and Chatzipantelidis, Procedia Computer Science 29 (2014) 1014.
    """
    w = ratio
    return (1 + w) ** 2 / (1 + 2 * w), w * w / (1 + 2 * w), (1 + w) / (1 + 2 * w)


def bdf2_past(system: System, state: State, dt: float) -> Past:
    r"""Return the past as the variable-step BDF2 formula sees it, from ``state`` and ``state.previous``.

    Rigid bodies: rotation vectors relative to the step's start, so that the body before has t_ = log(R_ R0^T). The
    formula gives the rate (t + b t_) / h, h = beta dt, and the angular momentum I(t) T(t) times that rate, with T the
    left Jacobian and I(t) the turned inertia. Both are taken at the rotation s = dt I0^-1 L0 that the body is about to
    do, which is off by O(dt^2) and so costs O(dt^3) a step: with A = I(s) T(s) and the base L = a L0 - b L_, the
    body without torques has t^ = h A^-1 L - b t_, and its energy is (t - t^)^T T(s)^T A (t - t^) / (2 h^2), whose
    matrix is symmetric. Momenta grow by h times the torque exactly.
    """
    before = state.previous
    ratio = dt / (state.time - before.time)
    a, b, beta = bdf2_coefficients(ratio)
    h = beta * dt
    origin, rigid_origin = (a * now - b * then for now, then in (
        (state.positions, before.positions), (state.rigid_positions, before.rigid_positions)))
    base, rigid_base, momenta = (a * now - b * then for now, then in (
        (state.velocities, before.velocities), (state.rigid_velocities, before.rigid_velocities),
        (state.angular_momenta, before.angular_momenta)))
    turns, inertias = np.zeros((system.n_rigid, 3)), np.zeros((system.n_rigid, 3, 3))
    spins = dt * system.spins(state.rigid_rotations, state.angular_momenta)
    for r, (spin, now, then) in enumerate(zip(spins, state.rigid_rotations, before.rigid_rotations, strict=True)):
        left = np.linalg.inv(inverse_left_jacobian(spin))
        turned = rotation_matrix(spin) @ now
        a_matrix = turned @ system.rigid_inertias[r] @ turned.T @ left
        turns[r] = h * np.linalg.solve(a_matrix, momenta[r]) - b * rotation_vector(then @ now.T)
        inertias[r] = left.T @ a_matrix
    return Past(
        h=h, earlier=b, origin=origin, inertial=origin + h * base, rigid_origin=rigid_origin,
        rigid_inertial=rigid_origin + h * rigid_base, turns=turns, inertias=inertias, momenta=momenta,
    )


def _between(*poses: np.ndarray) -> list[np.ndarray]:
    """Return the (4, 4) motions from each pose to the next."""
    return [end @ np.linalg.inv(pose) for pose, end in zip(poses, poses[1:])]


def _unforeseen(poses: list[np.ndarray], times: tuple[float, ...], points: np.ndarray) -> np.ndarray:
    """Return how far ``points`` (n, 3) [m] are carried by the last of three motions beyond what the others foretell.

    poses: (4, 4) at four ``times`` [s]: velocities v_ and v between the first ones foretell dt (v + dt (v - v_) / dt_).
    """
    ways = [points @ (m[:3, :3] - np.eye(3)).T + m[:3, 3] for m in _between(*poses)]
    spans = [end - begin for begin, end in zip(times, times[1:])]
    earlier, last = (way / span if span > 0.0 else np.zeros_like(way) for way, span in zip(ways, spans[:2]))
    return ways[2] - spans[2] * (last + spans[2] / spans[1] * (last - earlier))


class Increment:
    r"""Inertia plus all potentials, whose minimum is the implicit step (Ortiz and Stainier 1999).

    Soft: m |x - x^|^2 / (2 h^2) a vertex, x^ where it would be without forces and h the formula's effective step
    (see `Past`), and the dissipation of damped materials (`finqd.mechanics.damping`). Rigid: the same of the centre of
    mass, and (t - t^)^T J (t - t^) / (2 h^2) with the rotation vector t of the step. All forces are those at the end of
    the step, so contact and friction do not know which formula it is.
    """

    def __init__(
        self, system: System, state: State, dt: float, past: Past, *, soft_inertia: bool = True, load_share: float = 1.0
    ) -> None:
        """soft_inertia: off, soft bodies are in equilibrium; load_share: of gravity and dead loads on soft bodies."""
        self.system, self.start, self.dt, self.past = system, state, dt, past
        self.time = state.time + dt
        self.progress = system.advanced_progress(state, dt)
        self.masses = system.masses if soft_inertia else np.zeros_like(system.masses)
        self.vertex_weight = np.where(system.fixed, 0.0, (self.masses / past.h**2)[:, None])
        #: of the materials over this step, None where there is none: it resists motion, as inertia does
        self.damping = system.damping.over(state, past) if system.damping is not None and soft_inertia else None
        #: loads that do not act yet [N], (n_vertices, 3); None: all do
        self.withheld = None if load_share == 1.0 else (1.0 - load_share) * system.forces
        #: a typical energy [J], for the rounding of differences of energies
        self.scale = abs(system.energy(state))

    def predicted(self) -> State:
        """Return where to start: carried by the drives, or going on with the last acceleration or velocity, or staying.

        Driven vertices are at their targets in all of them. Bodies that are driven mostly move along with that, so the
        first is the nearest; without drives it is the second, by one order of the step, where motion is smooth. After
        an impact the last acceleration means nothing, and where its energy is not below that of
        the second, the lower one of the others is taken. As long as there is no last acceleration, gravity's is taken:
        what falls freely then is where it belongs, whatever the tolerances.
        """
        start = self.start
        moving = self._start(start.velocities, start.rigid_velocities, start.angular_momenta)
        energy = self.energy(moving)
        gained = self.dt * self.system.scene.gravity
        ends = [start.velocities + gained, start.rigid_velocities + gained, start.angular_momenta]
        if start.previous is not None:
            before, ratio = start.previous, self.dt / (start.time - start.previous.time)
            ends = [
                start.velocities + ratio * (start.velocities - before.velocities),
                start.rigid_velocities + ratio * (start.rigid_velocities - before.rigid_velocities),
                start.angular_momenta + ratio * (start.angular_momenta - before.angular_momenta),
            ]
        bent = self._carried(*ends) or self._start(*ends)
        if self.gradient(bent) < energy:  # no dearer than the energy, as the minimisation begins with it
            return bent
        still = self._driven(start)
        return still if self.energy(still) < energy else moving

    def _carried(self, soft: np.ndarray, rigid: np.ndarray, momenta: np.ndarray) -> State | None:
        """Return where bodies end that are carried by what drives them; None if nothing does.

        soft, rigid, momenta: velocities and angular momenta that bodies would have without. With P the rigid motion of
        a drive over this step, P_ over the last one and r the ratio of their lengths, a vertex of a body that touches
        nothing ends at P (x0 + r (x0 - P_ x_)): nothing changes as seen from the drive. Bodies in touch hold each
        other; they are carried by what the drives are mounted on, beyond what their velocities say of it.
        """
        system, start, before, h = self.system, self.start, self.start.previous, self.past.h
        if before is None or not system.scene.motions:
            return None
        dt = start.time - before.time
        times = (before.time - before.step, before.time, start.time, self.time)
        ends, shifts = self.past.origin + h * soft, self.past.rigid_origin + h * rigid - start.rigid_positions
        touched = system.contact.soft_forces > 0.0
        for i, (body, _, motion) in enumerate(system.scene.motions):
            span = slice(body.first_vertex, body.first_vertex + body.mesh.n_vertices)
            here = start.positions[span]
            if touched[system.scene.soft_bodies.index(body)]:
                mounts = [motion.mount(time) for time in times]
                ends[span] += _unforeseen(mounts, times, here)
                if i == 0:
                    shifts += _unforeseen(mounts, times, start.rigid_positions)
                continue
            then, now = _between(*(motion.pose(float(progress[i]), time) for progress, time in zip(
                (before.progress, start.progress, self.progress), times[1:])))
            own = here - before.positions[span] @ then[:3, :3].T - then[:3, 3]
            ends[span] = (here + self.dt / dt * own) @ now[:3, :3].T + now[:3, 3]
        spins = system.spins(start.rigid_rotations, momenta)
        return self._towards(ends, shifts, spins)

    def _start(self, velocities: np.ndarray, rigid_velocities: np.ndarray, momenta: np.ndarray) -> State:
        """Return where the formula ends with these velocities, or as far on the way as contact lets it go."""
        start, system, past = self.start, self.system, self.past
        spins = system.spins(start.rigid_rotations, momenta)
        shifts = past.rigid_origin + past.h * rigid_velocities - start.rigid_positions
        return self._towards(past.origin + past.h * velocities, shifts, spins)

    def _towards(self, ends: np.ndarray, shifts: np.ndarray, spins: np.ndarray) -> State:
        """Return the state with soft vertices at ``ends`` [m], and rigid bodies shifted [m] and turned [rad/s].

        As far on the way as contact lets it go.
        """
        start, system = self.start, self.system
        direction = Direction(
            soft=ends - start.positions,
            rigid=np.where(system.rigid_held[:, None], 0.0, np.concatenate([shifts, self.dt * spins], axis=1)),
        )
        return self._driven(start.moved(direction, min(1.0, system.contact.step_limit(start, direction))))

    def _driven(self, state: State) -> State:
        """Return ``state`` with held vertices where the step started and driven ones at their targets."""
        positions = np.where(self.system.fixed, self.start.positions, state.positions)
        self.system.prescribe(positions, self.progress, self.time)
        return replace(state, positions=positions)

    def _turns(self, state: State) -> np.ndarray:
        turns = np.zeros((self.system.n_rigid, 3))
        for b in range(self.system.n_rigid):
            turns[b] = rotation_vector(state.rigid_rotations[b] @ self.start.rigid_rotations[b].T)
        return turns

    def _inertia_energy(self, state: State, turns: np.ndarray) -> float:
        past = self.past
        soft = np.vdot(self.vertex_weight, (state.positions - past.inertial) ** 2)
        shift = state.rigid_positions - past.rigid_inertial
        off = turns - past.turns
        rigid = np.vdot(self.system.rigid_masses, np.sum(shift**2, axis=1))
        rigid += np.einsum("bi,bij,bj", off, past.inertias, off)
        return 0.5 * soft + 0.5 * rigid / past.h**2

    def _withheld_energy(self, state: State) -> float:
        return 0.0 if self.withheld is None else float(np.vdot(self.withheld, state.positions))

    def energy(self, state: State) -> float:
        """Return the incremental potential [J]."""
        energy = self._inertia_energy(state, self._turns(state)) + self.system.energy(state)
        if self.damping is not None:
            energy += self.damping.energy(state.positions)
        return energy + self._withheld_energy(state)

    def gradient(self, state: State) -> float:
        """Fill the gradient in the system's derivatives, zero where held; return the energy [J]."""
        system, d, past = self.system, self.system.derivatives, self.past
        d.clear_gradient()
        turns = self._turns(state)
        energy = system.add_gradient(state) + self._inertia_energy(state, turns)
        d.soft += self.vertex_weight * (state.positions - past.inertial)
        if self.damping is not None:
            energy += self.damping.add_gradient(state.positions, d.soft)
        if self.withheld is not None:
            d.soft += self.withheld
        d.rigid[:, :3] += (system.rigid_masses / past.h**2)[:, None] * (state.rigid_positions - past.rigid_inertial)
        for b, turn in enumerate(turns):
            d.rigid[b, 3:] += inverse_left_jacobian(turn).T @ past.inertias[b] @ (turn - past.turns[b]) / past.h**2
        system.clear_held()
        return energy + self._withheld_energy(state)

    def hessian(self, state: State, *, projected: bool = False, contact_projected: bool = False) -> None:
        """Fill the Hessian in the system's derivatives, the identity where held; options: see `System.add_hessian`."""
        system, d, h = self.system, self.system.derivatives, self.past.h
        d.clear_hessian()
        system.add_hessian(state, projected=projected, contact_projected=contact_projected)
        add_diagonal(system.pattern.indptr, self.masses / h**2, d.blocks)
        if self.damping is not None:
            self.damping.add_hessian(state.positions, d.blocks, projected=projected)
        self._add_rigid_inertia(state)
        system.hold_fixed()

    def rigid_hessian(self, state: State) -> None:
        """Fill the rigid bodies' part of the Hessian alone, and what couples them to soft vertices; spoil the rest."""
        system, d = self.system, self.system.derivatives
        system.find_couplings(state)
        d.coupling[:] = 0.0
        d.rigid_matrix[:] = 0.0
        system.contact.add_hessian(state, d)
        self._add_rigid_inertia(state)
        system.hold_rigid()

    def _add_rigid_inertia(self, state: State) -> None:
        matrix, h = self.system.derivatives.rigid_matrix, self.past.h
        for b, turn in enumerate(self._turns(state)):
            jacobian = inverse_left_jacobian(turn)
            body = slice(6 * b, 6 * b + 6)
            matrix[body, body][:3, :3] += np.eye(3) * self.system.rigid_masses[b] / h**2
            matrix[body, body][3:, 3:] += jacobian.T @ self.past.inertias[b] @ jacobian / h**2

    def finished(self, trial: State) -> State:
        """Return ``trial`` as the end of the step, with its velocities and the start as its ``previous``."""
        past, held = self.past, self.system.rigid_held[:, None]
        return replace(
            trial, time=self.time, progress=self.progress, step=self.dt,
            velocities=(trial.positions - past.origin) / past.h,
            # a held body must not inherit the rounding of its velocity
            rigid_velocities=np.where(held, 0.0, (trial.rigid_positions - past.rigid_origin) / past.h),
            angular_momenta=self._momenta(self._turns(trial)),
            previous=replace(self.start, previous=None),
        )

    def _momenta(self, turns: np.ndarray) -> np.ndarray:
        past = self.past
        if past.momenta is None:
            return np.einsum("bij,bj->bi", past.inertias, turns) / past.h
        momenta = past.momenta.copy()
        for b, turn in enumerate(turns):
            momenta[b] += inverse_left_jacobian(turn).T @ past.inertias[b] @ (turn - past.turns[b]) / past.h
        return momenta
