"""When a step may end although what contact lags, friction bounds and geometry, has moved on: scripted renewals."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from finqd.mechanics import newton
from finqd.mechanics.newton import Newton, NewtonOptions, _Convexity
from finqd.mechanics.state import Direction, StepReport

HEAVY, LIGHT = 5.0, 0.5 * newton.LAG_FORCE  # [N] contact force


class Scripted(Newton):
    """Newton's method on a problem that one iteration solves, until the next renewal leaves what a script says."""

    def _relax(self, trial: Any, energy: float, renewals: Any) -> None:
        """Nothing rigid plays a part."""

    def _iterate(self, trial: Any, energy: float) -> Any:
        self.system.left = 0.0
        return trial, energy


def run(left: Sequence[float], changes: Sequence[float], *, force: float = HEAVY) -> StepReport:
    """Return the report of a step whose k-th renewal leaves ``left[k]`` [N], and ``changes[k]`` of the bounds off.

    Beyond the scripts' ends the last entries go on.
    """
    renewals = 0

    def relag(trial: Any) -> float:
        nonlocal renewals
        k = renewals
        renewals += 1
        system.left = left[min(k, len(left) - 1)]
        return changes[min(k, len(changes) - 1)]

    contact = SimpleNamespace(relag=relag, relagged_forces=np.array([force]))
    system = SimpleNamespace(
        left=1.0, lightest_weight=np.inf, contact=contact, residual=lambda: (system.left, "the script")
    )
    increment = SimpleNamespace(gradient=lambda trial: 0.0)
    report = StepReport(residuals=[])
    options = NewtonOptions(quasi_newton=False)
    Scripted(system=system, increment=increment, options=options, report=report).minimise(object())
    return report


def test_a_step_ends_where_renewing_leaves_nothing() -> None:
    report = run([1.0, 0.1, 0.0], [0.5, 0.1, 0.0])
    assert report.converged and report.residual == 0.0 and report.friction_updates == 3


def test_bounds_far_from_coulombs_law_end_no_step() -> None:
    """They swing by more than `LAG_CHANGE` for ever, though little is left unbalanced."""
    little = 0.5 * newton.LAG_FORCE
    report = run([little], [1.2 * newton.LAG_CHANGE])
    assert not report.converged and "friction did not come to rest" in report.reason
    assert run([little], [0.8 * newton.LAG_CHANGE]).converged


def test_where_contact_is_light_the_bounds_do_not_matter() -> None:
    assert run([0.5 * LIGHT], [1.0], force=LIGHT).converged
    assert not run([0.5 * LIGHT], [1.0], force=HEAVY).converged


def test_renewals_that_still_converge_are_granted_more() -> None:
    options, bound = NewtonOptions(), newton.LAG_SHARE * HEAVY
    rate = 0.8
    needed = 2 * options.max_friction_updates
    slowly = [bound * rate ** (k - needed) for k in range(needed + 3)]
    report = run([*slowly[: needed + 2], 0.0], [0.1])
    assert report.converged and report.friction_updates >= needed


def test_patience_ends() -> None:
    most = NewtonOptions().max_friction_updates * newton.PATIENCE
    report = run([10.0 * 0.99**k for k in range(10 * most)], [0.1])
    assert not report.converged and "contact moved on too fast" in report.reason
    assert most <= report.friction_updates <= most + 2


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_what_may_stay_unbalanced_is_a_share_of_the_contact_force(share: float) -> None:
    assert run([share * newton.LAG_SHARE * HEAVY], [0.1]).converged == (share < 1.0)


def test_a_search_across_a_kink_ends_at_the_kink() -> None:
    """The energy falls to 0.26 of the step and rises steeply behind: an end in front of it would be a crawl."""
    kink, width, rise = 0.26, 0.004, 100.0
    derivatives = SimpleNamespace(soft=np.zeros(1), rigid=np.zeros(0))

    def gradient(at: SimpleNamespace) -> float:
        past = np.clip(at.x - kink, 0.0, width)
        derivatives.soft = np.array([-1.0 + rise * past / width])
        return float(-at.x + 0.5 * rise * past**2 / width + rise * max(at.x - kink - width, 0.0))

    def state(x: float) -> SimpleNamespace:
        return SimpleNamespace(x=x, moved=lambda direction, share=1.0: state(x + share * direction.soft[0]))

    contact = SimpleNamespace(step_limit=lambda *_: 1.0)
    system = SimpleNamespace(lightest_weight=np.inf, derivatives=derivatives, contact=contact)
    increment, report = SimpleNamespace(gradient=gradient, scale=1.0), StepReport(residuals=[])
    search = Newton(system=system, increment=increment, options=NewtonOptions(), report=report)._search
    energy = gradient(state(0.0))
    moved, found = search(state(0.0), energy, Direction(soft=np.ones(1), rigid=np.zeros(0)), -1.0)
    assert kink - width < moved.x < kink + width and found == gradient(moved) < energy
    assert report.line_searches <= newton.ENOUGH + 1


def test_the_exact_matrix_is_tried_again_once_the_residual_has_fallen() -> None:
    convexity = _Convexity()
    assert convexity.tries(1.0) == (False, True)
    convexity.lost = True  # what `_iterate` notes where only the projected matrix leads downhill
    assert convexity.tries(0.9) == (True, False)
    assert convexity.tries(0.8) == (True, False), "not near enough"
    assert convexity.tries(0.2) == (False, True)
    convexity.lost = True
    assert [convexity.tries(0.2)[0] for _ in range(newton.PROJECTED + 1)] == [True] * newton.PROJECTED + [False]


def test_an_iteration_begins_with_the_projected_matrix_after_one_that_needed_it() -> None:
    """A double well x^4/4 - x^2/2: concave about the start, convex about the minimum at 1."""
    derivatives = SimpleNamespace(soft=np.zeros(1), rigid=np.zeros(0))
    tried: list[bool] = []

    class Well(Newton):
        def _solve(self) -> Any:
            curvature = derivatives.curvature
            return SimpleNamespace(soft=-derivatives.soft / curvature, rigid=np.zeros(0), definite=curvature > 0.0)

    def gradient(at: SimpleNamespace) -> float:
        derivatives.soft = np.array([at.x**3 - at.x])
        return float(at.x**4 / 4 - at.x**2 / 2)

    def hessian(at: SimpleNamespace, *, projected: bool, contact_projected: bool) -> None:
        tried.append(projected)
        exact = 3.0 * at.x**2 - 1.0
        derivatives.curvature = abs(exact) if projected else exact

    def state(x: float) -> SimpleNamespace:
        return SimpleNamespace(x=x, moved=lambda direction, share=1.0: state(x + share * direction.soft[0]))

    contact = SimpleNamespace(step_limit=lambda *_: 1.0)
    system = SimpleNamespace(lightest_weight=np.inf, derivatives=derivatives, contact=contact)
    increment, report = SimpleNamespace(gradient=gradient, hessian=hessian, scale=1.0), StepReport(residuals=[])
    well = Well(system=system, increment=increment, options=NewtonOptions(), report=report)
    at, order = state(0.1), []
    for _ in range(12):
        report.residual = abs(at.x**3 - at.x)
        tried.clear()
        moved = well._iterate(at, gradient(at))
        assert moved is not None
        at = moved[0]
        order.append(list(tried))
        if abs(at.x - 1.0) < 1e-9:
            break
    assert order[0] == [False, True] and order[1] == [True], "only the projected one led downhill"
    assert order[-1] == [False] and abs(at.x - 1.0) < 1e-9, "exact again, and quadratic, at the end"
    assert report.projections == sum(sum(one) for one in order)


@pytest.mark.parametrize("adaptive", [True, False])
def test_a_matrix_that_lacks_the_contacts_curvature_is_not_used_again_where_it_led_too_far(
    adaptive: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A parabola of which the matrix has an eighth without the contact's curvature: then each search ends short."""
    if not adaptive:  # the wrong twin
        monkeypatch.setattr(newton, "SHORT", newton.HALVINGS + 1)
    derivatives = SimpleNamespace(soft=np.zeros(1), rigid=np.zeros(0))
    without: list[bool] = []

    class Bowl(Newton):
        def _solve(self) -> Any:
            return SimpleNamespace(soft=-derivatives.soft / derivatives.curvature, rigid=np.zeros(0), definite=True)

    def gradient(at: SimpleNamespace) -> float:
        derivatives.soft = np.array([at.x])
        return float(0.5 * at.x**2)

    def hessian(at: SimpleNamespace, *, projected: bool, contact_projected: bool) -> None:
        without.append(contact_projected)
        derivatives.curvature = 0.125 if contact_projected else 1.0

    def state(x: float) -> SimpleNamespace:
        return SimpleNamespace(x=x, moved=lambda direction, share=1.0: state(x + share * direction.soft[0]))

    contact = SimpleNamespace(step_limit=lambda *_: 0.7)
    system = SimpleNamespace(lightest_weight=np.inf, derivatives=derivatives, contact=contact)
    increment, report = SimpleNamespace(gradient=gradient, hessian=hessian, scale=1.0), StepReport(residuals=[])
    bowl = Bowl(system=system, increment=increment, options=NewtonOptions(contact_curvature=False), report=report)
    at = state(1.0)
    for _ in range(3):
        moved = bowl._iterate(at, gradient(at))
        assert moved is not None
        at = moved[0]
    assert without == ([True, False, True] if adaptive else [True, True, True])
