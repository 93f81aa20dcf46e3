"""What rests stays at rest."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.scene import Scene

from .scenes import CONTACTS, block
from .sound import sound

STEPS_MS = [20, *(pytest.param(step, marks=pytest.mark.slow) for step in (1, 2, 5, 10, 50))]


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", STEPS_MS)
def test_a_stack_of_five_soft_blocks(step, contact):
    scene = Scene(friction=0.5)
    scene.add_plane()
    for i in range(5):
        block(scene, height=0.0101 * i)
    found, course = sound(scene, duration=0.4, time_step_ms=step, contact=contact)
    weight = 0.004 * 9.81
    above = weight * np.arange(4, -1, -1)
    np.testing.assert_allclose(found.contact_forces[-1], 2.0 * above + weight, rtol=0.02)
    sideways = course.states[-1].positions - course.states[0].positions
    assert np.abs(sideways[:, :2]).max() < 1e-5
