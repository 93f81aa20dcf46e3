"""Estimates of the error that one step makes by itself, and what they say about the length of the next one."""

from __future__ import annotations

import math

import numpy as np

from finqd.mechanics.state import State, StepReport
from finqd.mechanics.system import System

SAFETY = 0.9  # share of the step that the estimate would allow
SHORTER, LONGER = 0.2, 2.0  # a step changes at most by these factors: BDF2 is stable below 2.41


def euler_error(system: System, start: State, end: State) -> float:
    """Return the local error of an implicit Euler step, dt/2 |v1 - v0| [m], the largest of free bodies and vertices.

    The leading term dt^2/2 x'' of the Taylor series (Hairer, Norsett and Wanner I, III.2), with x'' = (v1 - v0)/dt.
    """
    dt = end.time - start.time
    return 0.5 * dt * _largest(
        system, end.velocities - start.velocities, end.rigid_velocities - start.rigid_velocities
    )


def bdf2_error(system: System, start: State, end: State) -> float:
    """Return the local error of a BDF2 step [m], the largest of all free bodies and vertices.

    The leading term is C dt^3 x''' with C = (1 + w)^2 / (6 w (1 + 2 w)), 2/9 for equal steps, found by putting t^3
    into the formula (Hairer, Norsett and Wanner I, III.2, error constant of a linear multistep method). x''' comes from
    the second divided difference of the velocities: dt (1 + w) / (3 (1 + 2 w)) |v1 - v0 - w (v0 - v_before)|.
    """
    before = start.previous
    dt = end.time - start.time
    w = dt / (start.time - before.time)
    soft = end.velocities - start.velocities - w * (start.velocities - before.velocities)
    rigid = end.rigid_velocities - start.rigid_velocities - w * (start.rigid_velocities - before.rigid_velocities)
    return dt * (1 + w) / (3 * (1 + 2 * w)) * _largest(system, soft, rigid)


def _largest(system: System, soft: np.ndarray, rigid: np.ndarray) -> float:
    """Return the largest length of a row, without what is held or driven."""
    free = np.where(system.fixed, 0.0, soft)
    held = np.where(system.rigid_held[:, None], 0.0, rigid)
    squares = (np.max(np.sum(rows**2, axis=1), initial=0.0) for rows in (free, held))
    return math.sqrt(max(squares))


def judge(report: StepReport, error: float, *, tolerance: float | None, order: int, dt: float, shortest: float) -> bool:
    """Tell whether a converged step of ``dt`` [s] stands, and write into ``report`` what follows from its error [m].

    The next step is dt (tolerance / error)^(1 / (order + 1)), with a margin and within a factor of the last. A step
    that is ``shortest`` [s] already stands whatever its error: contact that begins has no derivative to be resolved.
    """
    report.error = error
    if tolerance is None:
        return True
    factor = SAFETY * (tolerance / error) ** (1.0 / (order + 1)) if error > 0.0 else LONGER
    report.next_dt = dt * min(max(factor, SHORTER), LONGER)
    if error <= tolerance:
        return True
    if dt <= shortest * (1 + 1e-9):
        report.error_overruns = 1
        return True
    report.converged, report.error_rejections = False, 1
    report.reason = f"local error {1e3 * error:.3g} mm, more than {1e3 * tolerance:.3g} mm"
    return False
