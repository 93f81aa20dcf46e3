"""Fast bodies: nothing may pass through anything, however long the step."""

from __future__ import annotations

import pytest

from finqd.mesh_shapes import box_mesh
from finqd.scene import Scene

from .scenes import CONTACTS, STEPPERS, block, rubber, thing
from .sound import STEPS_MS, sound


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("stepper", STEPPERS)
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("elasticity", ["corotated", "neo_hookean"])
def test_a_drop_from_a_metre(elasticity, step, stepper, contact):
    scene = Scene()
    scene.add_plane()
    block(scene, height=1.0, elasticity=elasticity)
    found, course = sound(scene, duration=0.6, time_step_ms=step, stepper=stepper, contact=contact)
    assert course.states[-1].positions[:, 2].min() > -2e-4


# ipc takes minutes for a ball of 9,000 triangles: its share is the drop above
@pytest.mark.parametrize("contact", ["penalty", pytest.param("ipc", marks=pytest.mark.slow)])
@pytest.mark.parametrize("stepper", STEPPERS)
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("diameter_mm", [2, 10])
def test_a_ball_thrown_at_a_soft_wall_at_10_m_per_s(diameter_mm, step, stepper, contact):
    """The wall is 3 mm thick, held at two rims; a step of 1 ms is three times that."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    wall = scene.add_soft(box_mesh((0.003, 0.04, 0.04), (1, 8, 8)), rubber())
    wall.fix("ymin")
    wall.fix("ymax")
    ball = thing("sphere", diameter_mm=diameter_mm, mass_g=0.5 if diameter_mm == 2 else 5.0)
    scene.add_rigid(ball, position=(-0.02, 0.02, 0.02), velocity=(10.0, 0.0, 0.0))
    found, course = sound(scene, duration=0.05, time_step_ms=step, stepper=stepper, contact=contact)
    for state in course.states:
        middle = state.positions[wall.vertices("xmax")][:, 0].max()
        assert state.rigid_positions[0, 0] < middle, "it went through"
    assert course.states[-1].rigid_velocities[0, 0] < 5.0, "the wall hardly slows it"
