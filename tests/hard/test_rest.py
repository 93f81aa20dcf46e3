"""What rests stays at rest."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.evaluate import evaluate
from finqd.scene import Scene

from .grippers import design
from .scenes import CONTACTS, CREEP, block, thing
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


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", [50, *(pytest.param(step, marks=pytest.mark.slow) for step in (5, 20))])
def test_a_weight_on_a_block_for_a_minute(step, contact):
    """After a second it has settled; then nothing creeps (but for what `ipc` owns up to), drifts or wins energy."""
    friction, down, across = 0.5, 2.0, 9.6  # a slope of 12 degrees
    scene = Scene(friction=friction, gravity=(down, 0.0, -across))
    scene.add_plane()
    block(scene, height=1e-5)
    scene.add_rigid(thing("box", size_mm=[10, 10, 10], mass_g=50.0), position=(0.01, 0.01, 0.0151))
    _, course = sound(scene, duration=60.0, time_step_ms=step, contact=contact)
    settled = next(i for i, state in enumerate(course.states) if state.time >= 1.0)
    then, end = course.states[settled], course.states[-1]
    creep = CREEP[contact] * (1.0 - np.sqrt(1.0 - down / (friction * across))) * (len(course.states) - settled)
    assert np.abs(end.rigid_positions - then.rigid_positions).max() < 1e-7 + 1.02 * 2.0 * creep  # of both contacts
    assert np.abs(end.positions - then.positions).max() < 1e-7 + 1.02 * creep
    assert max(course.energies[settled:]) - course.energies[settled] < 1e-9
    assert max(course.kinetic[settled:]) < 1e-9


@pytest.mark.parametrize("contact", ["penalty", pytest.param("ipc", marks=pytest.mark.slow)])
def test_a_grasp_held_for_a_minute(contact):
    """Between the first and the last second of a minute's hold the object drifts by less than 0.01 mm."""
    drops = []
    for hold in (1.0, 60.0):
        overrides = {"protocol.hold_s": hold, "protocol.time_step_ms": 50.0, "contact.name": contact}
        result = evaluate(design(), objects=["sphere"], preset="draft", overrides=overrides).to_dict()
        row = result["objects"]["sphere"]
        assert row["status"] == "ok" and row["held"], row["reason"]
        drops.append(row["drop_mm"])
    assert abs(drops[1] - drops[0]) < 0.01
