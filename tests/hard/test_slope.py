"""A body on a slope, one per cent below and above the friction limit."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.scene import Scene

from .scenes import CONTACTS, CREEP, block, thing
from .sound import STEPS_MS, sound

FRICTION, G = 0.5, 9.81


def slope(angle: float, *, soft: bool) -> Scene:
    """Return a body on a floor under gravity that leans by ``angle`` [rad]: the same as a slope."""
    scene = Scene(gravity=(G * np.sin(angle), 0.0, -G * np.cos(angle)), friction=FRICTION)
    scene.add_plane()
    if soft:
        block(scene, height=1e-5)
    else:
        scene.add_rigid(thing("box", size_mm=[20, 20, 10], mass_g=20.0), position=(0.0, 0.0, 0.005))
    return scene


def way(course, *, soft: bool, since: float = 0.0) -> float:
    """Return how far the body has gone down the slope since a time [m]."""
    states = [state for state in course.states if state.time >= since * (1 - 1e-9)]
    places = [s.positions[:, 0].mean() if soft else s.rigid_positions[0, 0] for s in (states[0], states[-1])]
    return float(places[1] - places[0])


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("soft", [False, True])
def test_just_below_the_limit_it_stays(soft, step, contact):
    """What settles at the start may shift it a little; then it does not creep, but for what `ipc` owns up to."""
    share = 0.99
    scene = slope(np.arctan(share * FRICTION), soft=soft)
    _, course = sound(scene, duration=1.0, time_step_ms=step, contact=contact)
    creep = CREEP[contact] * (1.0 - np.sqrt(1.0 - share))
    steps = sum(state.time > 0.5 for state in course.states)
    assert abs(way(course, soft=soft)) < 2e-4 + creep * len(course.states)
    assert abs(way(course, soft=soft, since=0.5)) < 1e-6 + 1.01 * creep * steps


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("soft", [False, True])
def test_just_above_the_limit_it_slides(soft, step, contact):
    angle = np.arctan(1.01 * FRICTION)
    scene = slope(angle, soft=soft)
    _, course = sound(scene, duration=1.0, time_step_ms=step, contact=contact)
    expected = 0.5 * G * (np.sin(angle) - FRICTION * np.cos(angle))  # in one second from rest
    assert way(course, soft=soft) == pytest.approx(expected, rel=0.1)
