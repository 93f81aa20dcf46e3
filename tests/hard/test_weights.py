"""Light and heavy bodies, slippery and rough ones, small and large scenes."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.scene import Scene

from .scenes import CONTACTS, STEPPERS, block, rubber, thing
from .sound import STEPS_MS, sound


def cube_on_block(*, mass_g: float, friction: float = 0.6, youngs_modulus: float = 1e6) -> Scene:
    """Return a rigid cube of 10 mm on the middle of a soft block on the floor."""
    scene = Scene(friction=friction)
    scene.add_plane()
    block(scene, height=0.0, material=rubber(youngs_modulus=youngs_modulus))
    scene.add_rigid(thing("box", size_mm=[10, 10, 10], mass_g=mass_g), position=(0.01, 0.01, 0.015 + 1e-5))
    return scene


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("stepper", STEPPERS)
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize(("mass_g", "modulus", "deep"), [(1.0, 1e6, 1e-5), (50.0, 1e6, 2e-4), (5e4, 1e9, 2e-4)])
def test_one_gram_and_fifty_kilograms(mass_g, modulus, deep, step, stepper, contact):
    scene = cube_on_block(mass_g=mass_g, youngs_modulus=modulus)
    _, course = sound(scene, duration=0.4, time_step_ms=step, stepper=stepper, contact=contact)
    end = course.states[-1]
    assert 0.0 < 0.015 - end.rigid_positions[0, 2] < deep + 0.001
    assert np.abs(end.rigid_positions[0, :2] - 0.01).max() < 1e-5


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("friction", [0.0, 2.0])
def test_no_friction_and_much(friction, step, contact):
    scene = cube_on_block(mass_g=10.0, friction=friction)
    scene.rigid_bodies[0].velocity[:] = (0.05, 0.0, 0.0)
    _, course = sound(scene, duration=0.1, time_step_ms=step, contact=contact)
    end = course.states[-1]
    if friction == 0.0:
        assert end.rigid_velocities[0, 0] == pytest.approx(0.05, rel=0.02)
    else:
        assert abs(end.rigid_velocities[0, 0]) < 0.01
    assert end.rigid_positions[0, 2] > 0.0149


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_small_and_large_scenes(scale, step, contact):
    """A block falls by its height and comes to rest; all lengths times ``scale``."""
    scene = Scene()
    scene.add_plane()
    block(scene, height=0.01 * scale, scale=scale)
    _, course = sound(scene, duration=0.3, time_step_ms=step, contact=contact, penetration=2e-4 * max(scale, 1.0))
    assert course.states[-1].positions[:, 2].min() > -2e-4 * scale
