"""A soft block that falls on the floor, from nearly fluid to nearly rigid, from foam to incompressible."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.scene import Scene

from .scenes import CONTACTS, STEPPERS, block, rubber
from .sound import STEPS_MS, sound


def falls(*, duration: float, drop: float, elasticity: str = "corotated", **material):
    scene = Scene()
    scene.add_plane()
    body = block(scene, height=drop, elasticity=elasticity, material=rubber(**material))
    return scene, body, duration


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("stepper", STEPPERS)
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49, 0.4999])
def test_any_poisson_ratio(nu, step, stepper, contact):
    scene, body, duration = falls(duration=0.15, drop=0.02, poisson_ratio=nu)
    _, course = sound(scene, duration=duration, time_step_ms=step, stepper=stepper, contact=contact)
    heights = course.states[-1].positions[:, 2]
    assert -1e-4 < heights.min() < 0.02, "it fell through, or rebounds higher than it was"


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("elasticity", ["corotated", "neo_hookean"])
@pytest.mark.parametrize(("modulus", "sinks"), [(1e3, 1e-4), (1e9, 1e-4)])
def test_a_thousandth_and_a_thousandfold_of_the_stiffness(modulus, sinks, elasticity, step, contact):
    scene, body, duration = falls(duration=0.1, drop=0.005, youngs_modulus=modulus, elasticity=elasticity)
    _, course = sound(scene, duration=duration, time_step_ms=step, contact=contact)
    assert course.states[-1].positions[:, 2].min() > -sinks
    assert np.ptp(course.states[-1].positions[:, 2]) < 0.011, "it swells"
