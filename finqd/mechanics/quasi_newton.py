"""Steps that need no new matrix: limited-memory BFGS about the inverse of an earlier one.

Where motion is smooth, the matrix of an earlier step is nearly right, and each change of the gradient tells where it is
not. Such a step costs a gradient and one backward substitution, a small share of what Newton's costs.
Source: Nocedal and Wright, Numerical Optimization (2006), algorithm 7.4.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from finqd.mechanics.linear_kernels import dot
from finqd.mechanics.preconditioners import Preconditioner
from finqd.mechanics.state import Direction
from finqd.mechanics.system import Derivatives

MEMORY = 12  # changes of the gradient that are remembered
SLOW = 1.5  # a step that leaves more than this multiple of the residual is followed by one of Newton's: it costs eight
NOTHING = 1e-6  # curvature that teaches nothing, as a share of the expected one
MOST = 15  # of these in a row, however well they do
QUICK = 0.3  # one of Newton's that leaves less than this share is followed by one of these


@dataclass
class QuasiNewton:
    """The search directions of one minimisation, and whether they are worth a try.

    inverse: of an earlier matrix, None if there is none; changes: of the unknowns, of the gradient, and one over their
    product, the latest last; before: the residual before the last step [N], None if anything may be tried;
    share: of it that may be left; row: how many such steps have been done in a row
    """

    inverse: Preconditioner | None
    changes: list[tuple[np.ndarray, np.ndarray, float]] = field(default_factory=list)
    before: float | None = None
    share: float = SLOW
    row: int = 0

    def promises(self, residual: float) -> bool:
        """Tell whether the next step may be one of these, given the ``residual`` that the last one left."""
        gets_on = self.before is None or residual <= self.share * self.before
        return self.inverse is not None and self.row < MOST and gets_on

    def direction(self, gradient: np.ndarray) -> np.ndarray:
        """Return minus the inverse, corrected by what has been learnt, times ``gradient`` (3 n + m,)."""
        assert self.inverse is not None
        found, products = gradient.copy(), []
        for step, turn, weight in reversed(self.changes):
            products.append(weight * dot(step, found))
            found -= products[-1] * turn
        found = self.inverse.apply(found)
        for step, turn, weight in self.changes:
            found += (products.pop() - weight * dot(turn, found)) * step
        return -found

    def learn(self, step: np.ndarray, turn: np.ndarray, *, least: float = 0.0) -> None:
        """Remember that the gradient changed by ``turn`` over ``step``, where that is clearly a positive curvature.

        least: what the step was to gain [J]; a product that is nothing beside it is rounding
        """
        product = dot(step, turn)
        if product > NOTHING * least:
            self.changes = [*self.changes[1 - MEMORY :], (step, turn, 1.0 / product)]

    def forget(self) -> None:
        """Drop what was learnt: it has led astray."""
        self.changes = []

    def stepped(self, residual: float) -> None:
        """Note a step of this kind from a state with ``residual`` [N]."""
        self.before, self.share, self.row = residual, SLOW, self.row + 1

    def replaced(self, inverse: Preconditioner | None, residual: float) -> None:
        """Note a step of Newton's from a state with ``residual`` [N], which may have brought a better ``inverse``."""
        if inverse is not self.inverse:
            self.changes = []
        self.inverse, self.before, self.share, self.row = inverse, residual, QUICK, 0

    def renewed(self) -> None:
        """Note that contact was renewed: another problem, though a similar one."""
        self.before, self.row = None, 0


def as_vector(derivatives: Derivatives) -> np.ndarray:
    """Return the gradient, soft and rigid, as one vector (3 n + m,), a copy."""
    return np.concatenate([derivatives.soft.reshape(-1), derivatives.rigid.reshape(-1)])


def as_direction(vector: np.ndarray, derivatives: Derivatives) -> Direction:
    """Return a vector (3 n + m,) as a direction."""
    size = derivatives.soft.size
    return Direction(
        soft=vector[:size].reshape(derivatives.soft.shape), rigid=vector[size:].reshape(derivatives.rigid.shape)
    )
