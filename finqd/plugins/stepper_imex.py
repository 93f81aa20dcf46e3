"""Stepper ``imex``: elasticity linearly implicit, contact and friction explicit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Gt, Lt

from finqd.mechanics.assembly_kernels import add_diagonal, hold
from finqd.mechanics.explicit import Motion, SubstepOptions, substeps
from finqd.mechanics.linear import LinearSolver, make_solver
from finqd.mechanics.state import State, StepReport
from finqd.mechanics.system import System


@dataclass(frozen=True, kw_only=True)
class Imex(SubstepOptions):
    """Elasticity linearly implicit, contact and friction explicit: one linear solve a substep, no iteration.

    A step without contact is one substep; contact asks for substeps that resolve its stiffness with the masses that it
    acts on. Elasticity is linearised at the start of the step.

    linear_solver, preconditioner, backend: see `finqd.mechanics.linear`; linear_tolerance: of the solves
    All other options: see `finqd.mechanics.explicit.SubstepOptions`.
    """

    linear_solver: Literal["cg", "direct"] = "cg"
    preconditioner: Literal["factorisation", "block_jacobi", "jacobi"] = "factorisation"
    backend: Literal["auto", "pardiso", "cholmod", "qdldl", "superlu"] = "auto"
    linear_tolerance: Annotated[float, Gt(0), Lt(1)] = 1e-6

    def step(self, system: System, state: State, dt: float) -> tuple[State, StepReport]:
        """Return the state after ``dt`` [s], or ``state`` itself and the reason."""
        key = ("imex", self.linear_solver, self.preconditioner, self.backend, self.linear_tolerance)
        solver = system.solver(key, lambda: make_solver(
            system.pattern, method=self.linear_solver, preconditioner=self.preconditioner, backend=self.backend,
            tolerance=self.linear_tolerance,
        ))
        system.contact.begin_step(state)
        method = LinearlyImplicit(system, state, solver, self.damping_per_s)
        end, report = substeps(Motion(system, state, dt), method, self)
        report.cg_iterations, report.factorisations = method.cg_iterations, method.factorisations
        return end, report


class LinearlyImplicit:
    """(M + h D + h^2 K) dv = h (f(x) - (D + h K) v), x + h (v + dv): linearly implicit Euler (Baraff and Witkin 1998,
    eq. 6).

    K: stiffness of the elasticity at the start of the step, made positive semidefinite, and D its damping, where the
    material has one; f: all forces at the start of the substep, so that contact and rigid bodies are stepped by
    symplectic Euler. Damping by the mass is a decay of the velocities after it.
    """

    rate, binary = 0.0, True

    def __init__(self, system: System, state: State, solver: LinearSolver, damping: float) -> None:
        self.system, self.solver, self.damping = system, solver, damping
        self.pattern = system.pattern  # contact may make the system's grow
        self.stiffness = np.zeros_like(system.derivatives.blocks)
        for potential, slots in zip(system.potentials, system.slots, strict=True):
            potential.add_hessian(state.positions, slots, self.stiffness, projected=True)
        self.product = self.pattern.matrix(self.stiffness)
        self.viscosity, self.resistance = None, None
        if system.damping is not None and system.damping.viscous:
            self.viscosity = np.zeros_like(self.stiffness)
            system.damping.add_viscosity(state.positions, self.viscosity)
            self.resistance = self.pattern.matrix(self.viscosity)
        self.blocks, self.h = self.stiffness, 0.0
        self.cg_iterations = self.factorisations = 0

    def advance(self, motion: Motion, h: float, time: float) -> None:
        """Take ``motion`` on by ``h`` [s], to ``time`` [s]."""
        system, ids = self.system, motion.course.ids
        decay = math.exp(-self.damping * h)
        if system.n_vertices:
            self._prepare(h)
            velocities = motion.velocities.copy()
            velocities[ids] = (motion.course.positions(time) - motion.state.positions[ids]) / h
            strained = (self.product @ velocities.ravel()).reshape(-1, 3)
            impulse = -h * (system.derivatives.soft + h * strained)
            if self.resistance is not None:
                impulse -= h * (self.resistance @ velocities.ravel()).reshape(-1, 3)
            impulse[system.fixed] = 0.0
            none = np.zeros((impulse.size, 0)), np.zeros((0, 0))
            solution = self.solver.solve(self.blocks, *none, impulse, np.zeros(0))
            self.cg_iterations += solution.iterations
            self.factorisations += int(solution.factorised)
            soft_decay = decay if system.damping is None else decay * system.damping.decay(h)
            motion.velocities = soft_decay * np.where(system.fixed, 0.0, velocities + solution.soft)
        motion.kick(h, decay)
        motion.drift(h, time)

    def _prepare(self, h: float) -> None:
        """Make the matrix of substeps of ``h`` [s]."""
        if h == self.h:
            return
        system = self.system
        self.blocks, self.h = h * h * self.stiffness, h
        if self.viscosity is not None:
            self.blocks += h * self.viscosity
        add_diagonal(self.pattern.indptr, system.masses, self.blocks)
        hold(self.pattern.indptr, self.pattern.indices, system.fixed, self.blocks, np.zeros((0, 0)))
