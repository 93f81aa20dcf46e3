"""Stepper ``bdf2``: second order backward differences with variable steps, as an incremental potential."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Gt, Le

from finqd.mechanics.incremental import Increment, bdf2_past, euler_past
from finqd.mechanics.local_error import bdf2_error, euler_error, judge
from finqd.mechanics.newton import Newton, NewtonOptions
from finqd.mechanics.state import State, StepReport
from finqd.mechanics.system import System
from finqd.units import MM

LARGEST_RATIO = 2.4  # of a step to the one before; the formula is zero-stable below 1 + sqrt 2
KINK = 0.5  # change of the contact force on a body, as a share of that force, that is a kink in its motion
KINK_SPEED = 1e-3  # [m/s] if the change alters the body's speed by more than this


@dataclass(frozen=True, kw_only=True)
class Bdf2(NewtonOptions):
    """Second order backward differences (BDF2): like implicit_euler, with far less numerical damping.

    The formula extrapolates two states. Where a contact begins or ends there is a kink between them, out of which it
    makes a rebound that gains energy; such a step, the one after it, the first, and one that follows a far shorter one
    are done by implicit Euler.

    error_tolerance_mm: local error of a step, above which it is shortened; None: steps are as long as they converge
    All other options: see `finqd.mechanics.newton.NewtonOptions`.
    """

    error_tolerance_mm: Annotated[float, Gt(0), Le(100)] | None = None

    def step(self, system: System, state: State, dt: float) -> tuple[State, StepReport]:
        """Return the state after ``dt`` [s], or ``state`` itself and the reason."""
        tolerance = None if self.error_tolerance_mm is None else self.error_tolerance_mm * MM
        before, end, report, second = state.previous, state, StepReport(), False
        if before is not None and dt <= LARGEST_RATIO * (state.time - before.time):
            end, report, kinked = self._solve(system, state, dt, second_order=True)
            second = report.converged and not kinked
        if not second:
            wasted = report
            end, report, kinked = self._solve(system, state, dt, second_order=False)
            report.add_work(wasted)
            end = replace(end, previous=None) if kinked else end
        if not report.converged:
            report.next_dt = None if tolerance is None else 0.5 * dt
            return state, report
        error, order = (bdf2_error, 2) if second else (euler_error, 1)
        if not judge(
            report, error(system, state, end), tolerance=tolerance, order=order, dt=dt, shortest=system.shortest_step
        ):
            return state, report
        system.contact.commit(end)
        return end, report

    def _solve(
        self, system: System, state: State, dt: float, *, second_order: bool
    ) -> tuple[State, StepReport, bool]:
        """Return the end of a step by one of the formulas, and whether contact has put a kink into the motion."""
        system.contact.begin_step(state)
        then = _contact_forces(system, state)
        report = StepReport(residuals=[])
        past = (bdf2_past if second_order else euler_past)(system, state, dt)
        increment = Increment(system, state, dt, past)
        newton = Newton(system=system, increment=increment, options=self, report=report)
        end = increment.finished(newton.minimise(increment.predicted()))
        if not report.converged:
            return state, report, False
        now = _contact_forces(system, end)
        change = np.linalg.norm(now - then, axis=1)
        size = np.maximum(np.linalg.norm(now, axis=1), np.linalg.norm(then, axis=1))
        kinked = bool(np.any((change > KINK * size) & (change * dt > KINK_SPEED * _body_masses(system))))
        return end, report, kinked


def _contact_forces(system: System, state: State) -> np.ndarray:
    """Return the contact force on each body [N], first soft then rigid ones, shape (n_bodies, 3)."""
    rigid = system.contact_forces_on_rigid(state)[:, :3]
    soft = [
        -system.derivatives.soft[b.first_vertex : b.first_vertex + b.mesh.n_vertices].sum(axis=0)
        for b in system.scene.soft_bodies
    ]
    return np.concatenate([np.reshape(soft, (-1, 3)), rigid])


def _body_masses(system: System) -> np.ndarray:
    soft = [
        system.masses[b.first_vertex : b.first_vertex + b.mesh.n_vertices].sum() for b in system.scene.soft_bodies
    ]
    return np.concatenate([soft, system.rigid_masses])
