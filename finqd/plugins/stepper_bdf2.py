"""Stepper ``bdf2``: second order backward differences with variable steps, as an incremental potential."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Gt, Le

from finqd.mechanics.incremental import Increment, Past, bdf2_past, euler_past
from finqd.mechanics.local_error import bdf2_error, euler_error, judge
from finqd.mechanics.newton import Newton, NewtonOptions
from finqd.mechanics.state import State, StepReport
from finqd.mechanics.system import System
from finqd.units import MM

LARGEST_RATIO = 2.4  # of a step to the one before; the formula is zero-stable below 1 + sqrt 2


@dataclass(frozen=True, kw_only=True)
class Bdf2(NewtonOptions):
    """Second order backward differences (BDF2): like implicit_euler, with far less numerical damping.

    The first step, and one that follows a far shorter one, is done by implicit Euler.

    error_tolerance_mm: local error of a step, above which it is shortened; None: steps are as long as they converge
    All other options: see `finqd.mechanics.newton.NewtonOptions`.
    """

    error_tolerance_mm: Annotated[float, Gt(0), Le(100)] | None = None

    def step(self, system: System, state: State, dt: float) -> tuple[State, StepReport]:
        """Return the state after ``dt`` [s], or ``state`` itself and the reason."""
        report = StepReport(residuals=[])
        system.contact.begin_step(state)
        past = self.past(system, state, dt)
        increment = Increment(system, state, dt, past)
        newton = Newton(system=system, increment=increment, options=self, report=report)
        trial = newton.minimise(increment.predicted())
        tolerance = None if self.error_tolerance_mm is None else self.error_tolerance_mm * MM
        if not report.converged:
            report.next_dt = None if tolerance is None else 0.5 * dt
            return state, report
        end = increment.finished(trial)
        error = (bdf2_error if past.ratio else euler_error)(system, state, end)
        order = 2 if past.ratio else 1
        if not judge(report, error, tolerance=tolerance, order=order, dt=dt, shortest=system.shortest_step):
            return state, report
        system.contact.commit(end)
        return end, report

    def past(self, system: System, state: State, dt: float) -> Past:
        """Return what the step knows of the motion so far: two states, or one where the other is of no use."""
        before = state.previous
        if before is None or dt > LARGEST_RATIO * (state.time - before.time):
            return euler_past(system, state, dt)
        return bdf2_past(system, state, dt)
