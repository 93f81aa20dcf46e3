"""Stepper ``implicit_euler``: Newton's method with line search on the incremental potential."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Gt, Le

from finqd.mechanics.incremental import Increment, euler_past
from finqd.mechanics.local_error import euler_error, judge
from finqd.mechanics.newton import Newton, NewtonOptions
from finqd.mechanics.state import State, StepReport
from finqd.mechanics.system import System
from finqd.units import MM


@dataclass(frozen=True, kw_only=True)
class ImplicitEuler(NewtonOptions):
    """First order implicit Euler: every step minimises inertia, elasticity, contact and friction by Newton's method.

    error_tolerance_mm: local error of a step, above which it is shortened; None: steps are as long as they converge
    All other options: see `finqd.mechanics.newton.NewtonOptions`.
    """

    error_tolerance_mm: Annotated[float, Gt(0), Le(100)] | None = None

    def step(self, system: System, state: State, dt: float) -> tuple[State, StepReport]:
        """Return the state after ``dt`` [s], or ``state`` itself and the reason."""
        report = StepReport(residuals=[])
        system.contact.begin_step(state)
        increment = Increment(system, state, dt, euler_past(system, state, dt))
        newton = Newton(system=system, increment=increment, options=self, report=report)
        trial = newton.minimise(increment.predicted())
        tolerance = None if self.error_tolerance_mm is None else self.error_tolerance_mm * MM
        if not report.converged:
            report.next_dt = None if tolerance is None else 0.5 * dt
            return state, report
        end = increment.finished(trial)
        error = euler_error(system, state, end)
        if not judge(report, error, tolerance=tolerance, order=1, dt=dt, shortest=system.shortest_step):
            return state, report
        system.contact.commit(end)
        return end, report
