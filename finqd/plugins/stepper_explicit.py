"""Stepper ``explicit``: central differences with lumped masses, in substeps as long as they are stable."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from finqd.errors import InputError
from finqd.mechanics.explicit import Motion, SubstepOptions, elastic_rate, substeps
from finqd.mechanics.state import State, StepReport
from finqd.mechanics.system import System


@dataclass(frozen=True, kw_only=True)
class Explicit(SubstepOptions):
    """Central differences, no matrix: accurate in time, conserves energy, and takes microseconds a substep.

    Contact is the penalty's spring and nothing else: what falls on a plane rebounds. For what rests, give a
    ``damping_per_s``, or start in equilibrium. Damping of a material by its stiffness would make stable substeps
    thousands of times shorter, and is refused. Options: see `finqd.mechanics.explicit.SubstepOptions`.
    """

    stiffness_damping: ClassVar[bool] = False

    def step(self, system: System, state: State, dt: float) -> tuple[State, StepReport]:
        """Return the state after ``dt`` [s], or ``state`` itself and the reason.

        Raises InputError for a material with damping by the stiffness.
        """
        if system.damping is not None and system.damping.viscous:
            raise InputError("must be 0 with the stepper explicit, which has no damping by the stiffness",
                             "material.rayleigh_stiffness")
        system.contact.begin_step(state)
        verlet = Verlet(rate=elastic_rate(system, state), damping=self.damping_per_s)
        return substeps(Motion(system, state, dt), verlet, self)


@dataclass(frozen=True, kw_only=True)
class Verlet:
    """Kick, drift, kick: central differences with velocities at the positions' times (Hairer, Lubich and Wanner, Acta
    Numerica 12 (2003) 399), symplectic and of second order; velocities decay by exp(-damping h/2) in each kick.

    rate: largest squared frequency of the elasticity [1/s^2]; stable below 2 / root(rate)
    """

    rate: float
    damping: float
    binary: bool = False

    def advance(self, motion: Motion, h: float, time: float) -> None:
        """Take ``motion`` on by ``h`` [s], to ``time`` [s]."""
        half, decay = 0.5 * h, math.exp(-0.5 * self.damping * h)
        gradient, damping = motion.system.derivatives.soft, motion.system.damping
        drag = 1.0 if damping is None else damping.decay(half)  # before the first kick, after the last: symmetric
        motion.velocities = decay * (drag * motion.velocities - half * motion.inverse_masses * gradient)
        motion.kick(half, decay)
        motion.drift(h, time)
        motion.velocities = drag * decay * (motion.velocities - half * motion.inverse_masses * gradient)
        motion.kick(half, decay)
