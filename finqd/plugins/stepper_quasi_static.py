"""Stepper ``quasi_static``: soft bodies in equilibrium at every moment, rigid ones with their inertia."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Le

from finqd.mechanics.incremental import Increment, euler_past
from finqd.mechanics.newton import Newton, NewtonOptions
from finqd.mechanics.state import State, StepReport
from finqd.mechanics.system import System

#: stiffness against a rigid motion, as a share of the body's mean stiffness per vertex, that counts as none
SLACK = 1e-9


@dataclass(frozen=True, kw_only=True)
class QuasiStatic(NewtonOptions):
    """No inertia of soft bodies: they are in equilibrium at every moment; rigid bodies move on by implicit Euler.

    A soft body must be held: by what is fixed or driven, or by contact from the start; velocities at the start do
    not count. Loads act at once unless ``ramp_s`` is given; a step that fails is halved, which makes the
    motions in it smaller, and the growth of a load only if it is ramped.

    max_iterations: as for the others, but more, since a load that acts at once starts far from equilibrium
    ramp_s: time over which gravity and dead loads on soft bodies grow to their full size, from the start of the scene
    All other options: see `finqd.mechanics.newton.NewtonOptions`.
    """

    inertia: ClassVar[bool] = False

    max_iterations: Annotated[int, Ge(1), Le(1000)] = 200
    ramp_s: Annotated[float, Ge(0), Le(1000)] = 0.0

    def step(self, system: System, state: State, dt: float) -> tuple[State, StepReport]:
        """Return the state after ``dt`` [s], or ``state`` itself and the reason."""
        report = StepReport(residuals=[])
        system.contact.begin_step(state)
        share = min((state.time + dt) / self.ramp_s, 1.0) if self.ramp_s else 1.0
        past = euler_past(system, state, dt)
        increment = Increment(system, state, dt, past, soft_inertia=False, load_share=share)
        trial = increment.predicted()
        loose = _loose_bodies(system)
        report.reason = _freedom(system, increment, trial, loose)
        if report.reason:
            return state, report
        trial = Newton(system=system, increment=increment, options=self, report=report).minimise(trial)
        if not report.converged:
            free = _freedom(system, increment, trial, loose)
            report.reason = f"{free} ({report.reason})" if free else report.reason
            return state, report
        end = increment.finished(trial)
        system.contact.commit(end)
        return end, report


def _rigid_modes(system: System, body: int, positions: np.ndarray) -> np.ndarray:
    """Return the six rigid motions of a soft body, scaled to like size, shape (n_vertices of the body, 3, 6)."""
    soft = system.scene.soft_bodies[body]
    own = positions[soft.first_vertex : soft.first_vertex + soft.mesh.n_vertices]
    arms = own - own.mean(axis=0)
    modes = np.zeros((len(own), 3, 6))
    modes[:, [0, 1, 2], [0, 1, 2]] = 1.0
    for axis in range(3):
        modes[:, :, 3 + axis] = np.cross(np.eye(3)[axis], arms) / np.abs(arms).max()
    return modes


def _loose_bodies(system: System) -> list[int]:
    """Return the soft bodies whose fixed vertices leave them a rigid motion."""
    loose = []
    for i, soft in enumerate(system.scene.soft_bodies):
        fixed = system.fixed[soft.first_vertex : soft.first_vertex + soft.mesh.n_vertices]
        held = _rigid_modes(system, i, np.concatenate([b.start_positions for b in system.scene.soft_bodies]))[fixed]
        if np.linalg.matrix_rank(held) < 6:
            loose.append(i)
    return loose


def _freedom(system: System, increment: Increment, state: State, loose: list[int]) -> str:
    """Return a sentence if a loose body can move as a whole without any force against it at ``state``."""
    if not loose or not np.all(np.isfinite(state.positions)):
        return ""
    increment.hessian(state)
    matrix = system.pattern.matrix(system.derivatives.blocks)
    for i in loose:
        soft = system.scene.soft_bodies[i]
        own = slice(soft.first_vertex, soft.first_vertex + soft.mesh.n_vertices)
        modes = np.zeros((system.n_vertices, 3, 6))
        modes[own] = _rigid_modes(system, i, state.positions)
        modes[system.fixed] = 0.0
        modes = modes.reshape(-1, 6)
        stiffness = matrix.diagonal().reshape(-1, 3)[own][~system.fixed[own]].mean()
        if np.linalg.eigvalsh(modes.T @ (matrix @ modes))[0] < SLACK * stiffness:
            return f"{soft.name} is free to move as a whole, and without inertia nothing holds it"
    return ""
