"""Newton's method for rigid bodies alone: what rolls or tips on a floor needs no matrix of the soft bodies.

Such a body changes its points of support many times in a step, and each change takes an iteration. As long as nothing
soft touches it, these are six equations, and an iteration costs what finding its contacts costs.
"""

from __future__ import annotations

import numpy as np

from finqd.mechanics.incremental import Increment
from finqd.mechanics.state import State
from finqd.mechanics.system import System

FLAT = 1e-9  # smallest curvature that is believed, as a share of the largest


def untouched(increment: Increment, state: State) -> np.ndarray:
    """Return which rigid bodies no soft one touches, shape (n_rigid,); fill the rigid part of the Hessian."""
    increment.rigid_hessian(state)
    d = increment.system.derivatives
    return ~d.coupling.reshape(len(d.coupling), increment.system.n_rigid, 6).any(axis=(0, 2))


def rigid_move(system: System, free: np.ndarray, *, least: float) -> np.ndarray | None:
    """Return a move (n_rigid, 6) of the bodies that are ``free``, downhill; None if they all are at rest.

    None as well where a curvature is not finite: the step then fails as data.

    Taken from gradient and rigid Hessian in the system's derivatives; least: force at which a body counts as at rest
    [N]. Curvatures are taken without their sign, so that the move leads down from saddles too: Nocedal and Wright,
    Numerical Optimization (2006), section 3.4.
    """
    d = system.derivatives
    force = np.where(free[:, None], d.rigid, 0.0)
    lengths = np.where(np.arange(6) < 3, 1.0, 1.0 / system.rigid_sizes[:, None])
    if np.linalg.norm((lengths * force).reshape(-1, 3), axis=1).max(initial=0.0) <= least:
        return None
    if not np.all(np.isfinite(d.rigid_matrix)):
        return None
    scale = lengths.reshape(-1)
    values, vectors = np.linalg.eigh(scale[:, None] * d.rigid_matrix * scale)
    curvatures = np.maximum(np.abs(values), FLAT * np.abs(values).max())
    move = -scale * (vectors @ ((vectors.T @ (scale * force.reshape(-1))) / curvatures))
    return np.where(free[:, None], move.reshape(-1, 6), 0.0)
