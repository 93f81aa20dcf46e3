"""Light and heavy bodies, slippery and rough ones, small and large scenes."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.objects import load_object
from finqd.plugins.contact_penalty import Penalty
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
@pytest.mark.parametrize(("mass_g", "modulus", "deep"), [(1.0, 1e6, 2e-5), (50.0, 1e6, 1e-4), (5e4, 1e9, 1.5e-4)])
def test_one_gram_and_fifty_kilograms(mass_g, modulus, deep, step, stepper, contact):
    scene = cube_on_block(mass_g=mass_g, youngs_modulus=modulus)
    _, course = sound(scene, duration=0.4, time_step_ms=step, stepper=stepper, contact=contact)
    end = course.states[-1]
    # it starts 10 um above; a stiff punch on an elastic half space sinks by m g (1 - nu^2) / (E a) or so: 1, 40, 40 um
    # bodies under ipc keep apart by up to its gap, and sink as far into the floor
    apart = 1e-4 if contact == "ipc" else 0.0
    assert -apart < 0.015 - end.rigid_positions[0, 2] < deep + apart
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


def test_contact_points_are_as_many_whatever_the_scale():
    """Their number does not grow with the size of everything; the option counts at every size; wires count as thin."""

    def samples(scale: float, spacing_mm: float, shape: dict) -> int:
        scene = Scene()
        block(scene, height=0.0, scale=scale)
        scene.add_rigid(load_object({"name": "thing", "shape": shape, "mass_g": 20}), position=(0.0, 0.0, 1.0))
        return Penalty(sample_spacing_mm=spacing_mm).potential(scene).surface.n_samples

    small, large = ({"kind": "box", "size_mm": [edge] * 3} for edge in (40, 400))
    wire = {"kind": "box", "size_mm": [1, 1, 450]}
    assert samples(1.0, 0.3, small) == samples(1.0, 0.3, wire) > 10_000
    assert samples(10.0, 0.3, large) < 3 * samples(1.0, 0.3, small)
    assert samples(10.0, 0.15, large) > 3 * samples(10.0, 0.3, large)
    assert samples(10.0, 0.3, wire) > 50 * samples(1.0, 0.3, wire)
