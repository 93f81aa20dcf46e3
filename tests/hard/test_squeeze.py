"""A gripper shut to 45 degrees without a force limit, whatever is between its fingers, and if nothing is."""

from __future__ import annotations

import pytest

from .grippers import SHUT, THINGS, gripper
from .scenes import CONTACTS
from .sound import sound

pytestmark = pytest.mark.slow  # each takes a minute or more
STEPS_MS = [1, 2, 5, 10, 20, 50]


def shut(what, **options):
    scene = gripper(what, **{key.replace(".", "__"): value for key, value in SHUT.items()})
    return sound(scene, duration=1.1, driven=True, **options)


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("what", THINGS)
def test_shut_on_something(what, step, contact):
    found, _ = shut(THINGS[what], time_step_ms=step, contact=contact)
    assert found.contact_forces.max() > 0.1


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", STEPS_MS)
def test_shut_on_nothing(step, contact):
    found, course = shut(None, time_step_ms=step, contact=contact)
    fingers = course.system.scene.soft_bodies
    assert found.contact_forces[-1].min() > 0.1, "the tips do not feel each other"
    assert len(fingers) == 3
