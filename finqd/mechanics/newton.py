"""Newton's method with line search on an incremental potential, renewing what contact lags: shared by the steppers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

from finqd.mechanics.incremental import Increment
from finqd.mechanics.linear import LinearSolution, LinearSolver, make_solver
from finqd.mechanics.quasi_newton import QuasiNewton, as_direction, as_vector
from finqd.mechanics.rigid_relaxation import rigid_move, untouched
from finqd.mechanics.state import Direction, State, StepReport
from finqd.mechanics.system import System

ARMIJO = 1e-4  # share of the linear decrease that a step must reach (Nocedal and Wright, Numerical Optimization, 3.1)
LAG_FORCE = 0.1  # [N] what renewed contact may leave unbalanced at the end of a step,
LAG_SHARE = 0.1  # or this share of the largest normal force on a body
LAG_PROGRESS = 0.7  # renewing goes on while it leaves less than this share of what it left the last time
LAG_CHANGE = 0.5  # share of the friction bounds, in sum, that may miss Coulomb's law at the end of a step
PATIENCE = 2  # times as many renewals are granted before what they leave makes the step fail
EARLY = 0.05  # [N] residual at which friction bounds are renewed for the first time, before the minimum is found,
EARLY_SHARE = 0.03  # or this share of the largest normal force on a body
INNER = 0.1  # share of what a renewal unbalanced that Newton leaves before the next one: it will unbalance more
RELAXATIONS = 60  # iterations of rigid bodies alone in a step, and as many more for each renewal
LIGHT = 0.1  # [N] weight below which forces count as relative to that of the lightest free body
FIRST = 1e-3  # share of the tolerance that ends a step without an iteration
HALVINGS = 31  # of the Newton step, before the line search gives up
ENOUGH = 12  # halvings after which it is content with the lowest energy so far
WORTHWHILE = 0.5  # share of the lowest residual so far that counts as progress
NEARER = 0.3  # share of the residual by which an iteration must get on for the exact matrix to be tried again
PROJECTED = 3  # iterations after which it is in any case: by projected ones Newton converges linearly
ROUNDING = 1e-12  # relative accuracy of an energy, below which the line search must not ask for a decrease
SHORT = 2  # halvings of a line search that tell that the matrix lacks curvature there
BLURRED = 1e-6  # relative rise of an energy that may be rounding, if the slope along the step falls to
FLATTER = 0.5  # this share at least: slopes are good to more digits (Hager and Zhang, SIAM J. Optim. 16 (2005) 170).


@dataclass(frozen=True, kw_only=True)
class NewtonOptions:
    """Options of every stepper that minimises an incremental potential; such a plugin's own come after these.

    tolerance_N: largest unbalanced force on any vertex or rigid body at the end of a step, at the friction bounds that
        it was solved with; the bounds of its end may leave more, by `LAG_FORCE` and `LAG_SHARE`. All that is less, in
        proportion, where a free body weighs less than `LIGHT`
    tolerance_share: or this share of the largest normal force on a soft body, if that is more
    quasi_newton: whether directions that need no new matrix are tried first (see `finqd.mechanics.quasi_newton`)
    max_iterations: Newton iterations after which a step is given up (and halved); as many more for each renewal.
        Quasi-Newton steps are not counted
    stall_iterations: iterations that do not halve the residual after which a step is given up as well; None: none
    contact_curvature: whether the matrix always has what contact adds by its curvature. That jumps where points come to
        edges: where bodies slide over edges there are a fifth fewer iterations without; then only the iteration after a
        line search of `SHORT` halvings has it, as where edges of fingers rest on each other Newton crawls without
    max_friction_updates: how often the friction bounds are renewed within a step
    friction_tolerance: share of the friction bounds that may change without a renewal
    linear_solver, preconditioner, backend: see `finqd.mechanics.linear`
    linear_tolerance: relative residual of the linear solves
    linear_iterations: cap on CG iterations
    """

    tolerance_N: Annotated[float, Gt(0), Le(1)] = 5e-5
    tolerance_share: Annotated[float, Ge(0), Le(0.01)] = 0.0
    quasi_newton: bool = True
    max_iterations: Annotated[int, Ge(1), Le(1000)] = 25
    stall_iterations: Annotated[int, Ge(2), Le(1000)] | None = None
    contact_curvature: bool = True
    max_friction_updates: Annotated[int, Ge(0), Le(100)] = 3
    friction_tolerance: Annotated[float, Gt(0), Le(1)] = 0.02
    linear_solver: Literal["cg", "direct"] = "cg"
    preconditioner: Literal["factorisation", "block_jacobi", "jacobi"] = "factorisation"
    backend: Literal["auto", "pardiso", "cholmod", "qdldl", "superlu"] = "auto"
    linear_tolerance: Annotated[float, Gt(0), Lt(1)] = 1e-3
    linear_iterations: Annotated[int, Ge(1), Le(1_000_000)] = 1000

    def solver(self, system: System) -> LinearSolver:
        """Return the linear solver of these options for ``system``, which keeps it from step to step."""
        key = (self.linear_solver, self.preconditioner, self.backend, self.linear_iterations)
        return system.solver(key, lambda: make_solver(
            system.pattern, method=self.linear_solver, preconditioner=self.preconditioner, backend=self.backend,
            max_iterations=self.linear_iterations, tolerance=self.linear_tolerance,
        ))


@dataclass
class _Renewals:
    """What the renewals of contact in one step have left.

    early: whether one is due before the minimum; added: what the last one unbalanced [N]
    best: minimum that a renewal disturbed least, best_jump: by how much [N]
    idle: whether there has been no rigid body to relax since the last one
    """

    early: bool = True
    added: float = 0.0
    idle: bool = False
    best: State | None = None
    best_jump: float = np.inf


@dataclass
class _Progress:
    """Whether iterations between two renewals get on.

    patience: iterations of Newton's that may lead nowhere
    lowest: residual that the last progress led to [N]; since: iterations that had been done then
    """

    patience: int | None
    lowest: float = np.inf
    since: int = 0

    def stalls(self, residual: float, iterations: int) -> bool:
        """Take the ``residual`` [N] after so many ``iterations``; tell whether they have led nowhere for long."""
        if residual <= WORTHWHILE * self.lowest:
            self.lowest, self.since = residual, iterations
        return self.patience is not None and iterations - self.since >= self.patience


@dataclass
class _Convexity:
    """Which matrix an iteration begins with: the exact one, unless the one before found no descent by that.

    lost: whether it did not; residual: before it [N]; row: how many have begun with the projected one since
    short: whether the last line search was (see `SHORT`)
    """

    lost: bool = False
    residual: float = np.inf
    row: int = 0
    short: bool = False

    def tries(self, residual: float) -> tuple[bool, bool]:
        """Return in which order matrices are tried from a state with ``residual`` [N]: whether projected."""
        self.lost = self.lost and residual > NEARER * self.residual and self.row < PROJECTED
        self.residual, self.row = residual, self.row + 1 if self.lost else 0
        return self.lost, not self.lost


@dataclass(frozen=True, kw_only=True)
class Newton:
    """The minimisation of one ``increment``; ``report`` says how it went."""

    system: System
    increment: Increment
    options: NewtonOptions
    report: StepReport
    convexity: _Convexity = field(default_factory=_Convexity)

    @property
    def scale(self) -> float:
        """Share of the usual forces that may be unbalanced, 1 unless a free body is very light."""
        return min(1.0, self.system.lightest_weight / LIGHT)

    @property
    def tolerance(self) -> float:
        """Force that may be unbalanced at a minimum [N]."""
        return max(self.scale * self.options.tolerance_N, self.options.tolerance_share * self._pressed)

    @property
    def _pressed(self) -> float:
        """The largest normal force on a soft body when contact was renewed last [N]."""
        return float(np.max(self.system.contact.relagged_forces, initial=0.0))

    def minimise(self, trial: State) -> State:
        """Return the minimum that is found from ``trial``; it is one only if ``report.converged``."""
        report, options, renewals = self.report, self.options, _Renewals()
        progress = _Progress(options.stall_iterations)
        quasi = QuasiNewton(options.solver(self.system).lagged if options.quasi_newton else None)
        energy = self.increment.gradient(trial)
        report.residual, report.where = self.system.residual()
        while True:
            report.residuals.append(report.residual)
            if not (np.isfinite(report.residual) and np.isfinite(energy)):
                report.reason = f"the forces are no longer finite ({report.where})"
                break
            # a first iteration is always due: many small forces, each below the tolerance, must not stop the motion
            begun = report.iterations + report.quasi_iterations > 0
            done = report.residual <= (1.0 if begun else FIRST) * self.tolerance
            if done or (begun and self._renewal_is_due(renewals)):
                energy, ended = self._renew(trial, renewals, done=done)
                quasi.renewed()
                progress = _Progress(options.stall_iterations, since=report.iterations)
                if ended:
                    break
                continue
            tired = report.iterations >= options.max_iterations * (1 + report.friction_updates)
            if progress.stalls(report.residual, report.iterations) or tired:
                left = f"{report.residual:.3g} N left on {report.where}"
                report.reason = f"no equilibrium after {report.iterations} iterations: {left}"
                break
            moved = self._relax(trial, energy, renewals) or self._step(trial, energy, quasi)
            if moved is None:
                if renewals.best is None and report.residual <= self.tolerance:  # at rest, to the last digit
                    renewals.best, renewals.best_jump, report.reason = trial, report.residual, ""
                break
            trial, energy = moved
            report.residual, report.where = self.system.residual()
        if renewals.best is None:
            left = f"{report.residual:.3g} N left on {report.where}"
            report.reason = report.reason or f"friction did not come to rest: {left}"
            return trial
        return self._accept(renewals.best, renewals.best_jump)

    def _renewal_is_due(self, renewals: _Renewals) -> bool:
        """Tell whether friction bounds are better renewed now, though this is no minimum yet: it will move."""
        report = self.report
        if renewals.early:
            return report.residual <= max(self.scale * EARLY, EARLY_SHARE * self._pressed)
        return report.friction_updates < self.options.max_friction_updates and report.residual <= INNER * renewals.added

    def _renew(self, trial: State, renewals: _Renewals, *, done: bool) -> tuple[float, bool]:
        """Renew what contact lags at ``trial``, a minimum if ``done``; return its energy, and whether the step ends."""
        report, options, contact = self.report, self.options, self.system.contact
        renewals.early = renewals.idle = False
        change, before = contact.relag(trial), report.residual
        report.friction_updates += 1
        energy = self.increment.gradient(trial)
        report.residual, report.where = self.system.residual()
        renewals.added = max(report.residual - before, 0.0)
        progress = report.residual < LAG_PROGRESS * renewals.best_jump
        light = float(np.sum(contact.relagged_forces)) <= self.scale * LAG_FORCE
        if done and report.residual < renewals.best_jump and (light or change <= LAG_CHANGE):
            renewals.best, renewals.best_jump = trial, report.residual
        steady = change <= options.friction_tolerance and report.residual <= self.scale * LAG_FORCE
        still = report.residual <= self.tolerance or steady
        tired = not progress or report.friction_updates > options.max_friction_updates
        lasting = report.friction_updates > PATIENCE * options.max_friction_updates
        return energy, done and (still or (tired and (lasting or renewals.best_jump <= self._bound())))

    def _accept(self, best: State, jump: float) -> State:
        """End the step with the state that renewed friction disturbed least, by ``jump`` [N], if that is little.

        Friction bounds lag; what they leave must be small beside the contact forces, else the step was too long.
        """
        report = self.report
        self.system.contact.relag(best)
        report.converged, report.residual = jump <= self._bound(), jump
        if not report.converged:
            report.reason = f"contact moved on too fast: {jump:.3g} N left on {report.where}"
        return best

    def _bound(self) -> float:
        """Return what renewed contact may leave unbalanced at the end of a step [N]."""
        return max(self.scale * LAG_FORCE, LAG_SHARE * self._pressed)

    def _relax(self, trial: State, energy: float, renewals: _Renewals) -> tuple[State, float] | None:
        """Bring rigid bodies that touch nothing soft to rest while all else stays; None if that leads nowhere."""
        report, system, least = self.report, self.system, self.tolerance
        origin, found, before, free = trial, None, None, None
        while not renewals.idle and report.rigid_iterations < RELAXATIONS * (1 + report.friction_updates):
            if system.rigid_residual() <= least:
                break
            now = untouched(self.increment, trial)
            if free is not None and np.any(free & ~now):  # where it meets something soft, all have a say
                found = before
                self.increment.gradient(origin if found is None else found[0])
                break
            before, free = found, now
            move = rigid_move(system, free, least=least)
            if move is None:
                break
            report.rigid_iterations += 1
            direction = Direction(soft=np.zeros_like(trial.positions), rigid=move)
            moved = self._search(trial, energy, direction, self._slope(direction))
            if moved is None:
                self.increment.gradient(trial)
                break
            found = trial, energy = moved
        renewals.idle = found is None
        return found

    def _step(self, trial: State, energy: float, quasi: QuasiNewton) -> tuple[State, float] | None:
        """Do one iteration, of the cheap kind while those get on; return as `_iterate` does."""
        before = self.report.residual
        if quasi.promises(before):
            moved = self._try(trial, energy, quasi)
            if moved is not None:
                quasi.stepped(before)
                return moved
        self.report.iterations += 1
        found = self._iterate(trial, energy)
        if self.options.quasi_newton:
            quasi.replaced(self.options.solver(self.system).lagged, before)
        return found

    def _try(self, trial: State, energy: float, quasi: QuasiNewton) -> tuple[State, float] | None:
        """Go the whole way of a quasi-Newton step; None if that is not downhill enough."""
        d = self.system.derivatives
        gradient = as_vector(d)
        vector = quasi.direction(gradient)
        direction = as_direction(vector, d)
        slope = float(np.vdot(vector, gradient))
        if not slope < 0.0 or self.system.contact.step_limit(trial, direction) < 1.0:
            quasi.forget()
            return None
        self.report.quasi_iterations += 1
        moved = trial.moved(direction)
        found = self.increment.gradient(moved)
        size = abs(energy) + self.increment.scale
        if not found <= energy + ARMIJO * slope + ROUNDING * size:
            self.increment.gradient(trial)
            quasi.forget()
            return None
        quasi.learn(vector, as_vector(d) - gradient, least=-slope)
        return moved, found

    def _iterate(self, trial: State, energy: float) -> tuple[State, float] | None:
        """Do one Newton iteration; return where it led, as `_search` does, or None if no direction leads downhill."""
        report, convexity = self.report, self.convexity
        for second, projected in enumerate(convexity.tries(report.residual)):
            if second:  # the first search has left the gradient of another state
                self.increment.gradient(trial)
            convexity.lost = projected
            report.projections += int(projected)
            plain = not (self.options.contact_curvature or convexity.short)
            self.increment.hessian(trial, projected=projected, contact_projected=plain)
            solution = self._solve()
            direction = Direction(soft=solution.soft, rigid=solution.rigid)
            slope = self._slope(direction)
            if solution.definite and slope < 0.0:
                halvings = report.line_searches
                moved = self._search(trial, energy, direction, slope)
                convexity.short = report.line_searches >= halvings + SHORT
                if moved is not None:
                    return moved
        report.reason = f"the line search found no descent: {report.residual:.3g} N left on {report.where}"
        return None

    def _solve(self) -> LinearSolution:
        d, solver = self.system.derivatives, self.options.solver(self.system)
        if self.options.quasi_newton:  # what it kept has just been found to be too old
            solver.forget()
        solution = solver.solve(
            d.blocks, d.coupling, d.rigid_matrix, -d.soft, -d.rigid, tolerance=self.options.linear_tolerance
        )
        self.report.cg_iterations += solution.iterations
        self.report.factorisations += int(solution.factorised)
        return solution

    def _slope(self, direction: Direction) -> float:
        """Return the derivative of the energy along ``direction`` [J] where the gradient was taken last."""
        d = self.system.derivatives
        return float(np.vdot(d.soft, direction.soft) + np.vdot(d.rigid, direction.rigid))

    def _search(
        self, trial: State, energy: float, direction: Direction, slope: float
    ) -> tuple[State, float] | None:
        """Return where the step ends and its energy [J], with its gradient in the system's derivatives; None: nowhere.

        The whole step, if Armijo's condition holds there. Else the interval is halved to where the slope has fallen as
        well: most steps that fail run across the kink of a friction that is to stick again, where parabolas tell lies,
        and a sloppy end in front of it makes the next step fail as well. Gradients cost little beside a direction.
        """
        increment, size = self.increment, abs(energy) + self.increment.scale
        low, high = 0.0, 2.0 * self.system.contact.step_limit(trial, direction)
        best: tuple[State, float] | None = None
        for tries in range(HALVINGS):
            share = 0.5 * (low + high)
            moved = trial.moved(direction, share)
            found = increment.gradient(moved)
            steep = self._slope(direction) / -slope
            sinks = found <= energy + ARMIJO * share * slope + ROUNDING * size
            if sinks and (tries == 0 or abs(steep) <= FLATTER):
                return moved, found
            if tries == 0 and found <= energy + BLURRED * size and abs(steep) <= FLATTER:
                return moved, found
            self.report.line_searches += 1
            if sinks and (best is None or found < best[1]):
                best = moved, found
            if best is not None and tries >= ENOUGH:
                break
            if sinks and steep < 0.0:
                low = share
            else:
                high = share if np.isfinite(found) else low + 0.2 * (share - low)
        return None if best is None else (best[0], increment.gradient(best[0]))
