"""Share held: verdicts on made-up trajectories."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from finqd import registry
from finqd.contracts import Verdict
from finqd.errors import InputError
from finqd.plugins.fitness_share_held import ShareHeld
from finqd.protocol import GraspProtocol
from finqd.trajectory import Trajectory


def flown(drop: float, status: str = "ok", protocol: GraspProtocol | None = GraspProtocol()) -> Trajectory:  # noqa: B008
    return Trajectory(status=status, object_drop=drop, protocol=protocol)


def verdict(drop: float, status: str = "ok", **options: float):
    return ShareHeld(**options).score({"it": flown(drop, status)}).verdicts["it"]


def test_share_margin_and_order():
    result = ShareHeld().score({"b": flown(0.0), "a": flown(0.005), "d": flown(0.2), "c": flown(0.0, "diverged")})
    assert result.fitness == 0.5
    assert result.margin == pytest.approx((1 + 0.5 - 1 - 1) / 4, rel=1e-15)
    assert list(result.verdicts) == ["b", "a", "d", "c"]
    assert [v.held for v in result.verdicts.values()] == [True, True, False, False]


def test_margin_changes_sign_on_the_threshold():
    assert verdict(math.nextafter(0.01, 0)).held and not verdict(0.01).held
    assert verdict(0.01).margin == pytest.approx(0, abs=1e-15)
    assert verdict(-0.003).margin == 1.0, "an object that was drawn in is not better than one that stayed"
    assert verdict(1.0).margin == -1.0


@given(st.floats(-1, 1), st.floats(-1, 1))
def test_a_smaller_drop_is_never_worse(a, b):
    low, high = verdict(min(a, b)), verdict(max(a, b))
    assert low.margin >= high.margin and low.held >= high.held
    assert -1 <= high.margin <= low.margin <= 1
    assert low.held == (min(a, b) < 0.01) and low.drop == min(a, b)


@pytest.mark.parametrize("status", ["diverged", "timeout", "mesh_failed"])
def test_a_failed_simulation_is_not_held_however_little_it_dropped(status):
    assert verdict(0.0, status) == Verdict(held=False, drop=0.0, margin=-1.0)


@pytest.mark.parametrize("drop", [math.nan, math.inf, -math.inf])
def test_a_drop_that_is_no_number_is_not_held(drop):
    assert (verdict(drop).held, verdict(drop).margin) == (False, -1.0)


def test_threshold_is_the_protocols_unless_the_option_says_otherwise():
    strict = GraspProtocol(drop_threshold_mm=4)
    assert not ShareHeld().score({"it": flown(0.005, protocol=strict)}).verdicts["it"].held
    held = registry.create("fitness", {"name": "share_held", "drop_threshold_mm": 6})
    assert held.score({"it": flown(0.005, protocol=strict)}).verdicts["it"].held


def test_no_object_is_refused():
    with pytest.raises(InputError, match="no object to score"):
        ShareHeld().score({})


def test_a_trajectory_that_is_no_grasp_is_refused():
    with pytest.raises(InputError, match=r"^fitness: it: this trajectory is no grasp"):
        ShareHeld().score({"it": flown(0.0, protocol=None)})
    assert ShareHeld(drop_threshold_mm=5).score({"it": flown(0.0, protocol=None)}).fitness == 1.0
