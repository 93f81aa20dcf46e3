"""A gripper shut to 45 degrees without a force limit, whatever is between its fingers, and if nothing is."""

from __future__ import annotations

import pytest

from finqd.evaluate import evaluate
from finqd.objects import load_object

from .grippers import SHUT, THINGS, design, gripper
from .scenes import CONTACTS
from .sound import sound

STEPS_MS = [1, 2, 5, 10, 20, 50]
FAST = {("apex", 50, "penalty"), (None, 50, "penalty")}  # others: half a minute or more
SLOW = pytest.mark.slow


def cases(things):
    """Return all combinations of things, steps and contact models."""
    every = [(what, step, contact) for what in things for step in STEPS_MS for contact in CONTACTS]
    return [pytest.param(*case, marks=() if case in FAST else SLOW) for case in every]


def shut(what, **options):
    scene = gripper(what, **{key.replace(".", "__"): value for key, value in SHUT.items()})
    return sound(scene, duration=1.1, driven=True, **options)


@pytest.mark.parametrize(("what", "step", "contact"), cases(THINGS))
def test_shut_on_something(what, step, contact):
    found, _ = shut(THINGS[what], time_step_ms=step, contact=contact)
    assert found.contact_forces.max() > 0.1


@pytest.mark.slow  # three minutes; an apex between the tips is the fast twin
@pytest.mark.parametrize(("what", "step", "contact"), cases([None]))
def test_shut_on_nothing(what, step, contact):
    found, course = shut(what, time_step_ms=step, contact=contact)
    fingers = course.system.scene.soft_bodies
    assert found.contact_forces[-1].min() > 0.1, "the tips do not feel each other"
    assert len(fingers) == 3


def test_a_cube_five_times_too_big_does_not_fit():
    """It is where the fingers are: that is a result of its own, not a simulation."""
    cube = load_object({"name": "big", "shape": {"kind": "box", "size_mm": [175, 175, 175]}, "mass_g": 900})
    row = evaluate(design(), objects=[cube], preset="draft").to_dict()["objects"]["big"]
    assert row["status"] == "no_room" and "does not fit between" in row["reason"] and not row["held"]
