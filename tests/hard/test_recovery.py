"""Bodies that are let go far from any equilibrium."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.mesh_shapes import box_mesh
from finqd.scene import Scene

from .scenes import STEPPERS, rubber
from .sound import STEPS_MS, sound


def twisted_bar(turns: float, elasticity: str) -> Scene:
    """Return a bar of 100 x 10 x 10 mm that is held at one end and wound up evenly."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    mesh = box_mesh((0.1, 0.01, 0.01), (20, 2, 2))
    bar = scene.add_soft(mesh, rubber(), elasticity=elasticity)
    bar.fix("xmin")
    x, y, z = (mesh.vertices - (0.0, 0.005, 0.005)).T
    angle = 2.0 * np.pi * turns * x / 0.1
    wound = (x, np.cos(angle) * y - np.sin(angle) * z + 0.005, np.sin(angle) * y + np.cos(angle) * z + 0.005)
    bar.start_positions[:] = np.column_stack(wound)
    return scene


@pytest.mark.parametrize("stepper", STEPPERS)
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("elasticity", ["corotated", pytest.param("neo_hookean", marks=pytest.mark.slow)])
def test_a_bar_twisted_by_720_degrees_and_let_go(elasticity, step, stepper):
    scene = twisted_bar(2.0, elasticity)
    _, course = sound(scene, duration=0.5, time_step_ms=step, stepper=stepper)
    assert max(course.kinetic) > 0.0
    if stepper == "implicit_euler" and step >= 20:  # which damps: it has come to rest
        rest = scene.soft_bodies[0].mesh.vertices
        assert np.abs(course.states[-1].positions - rest).max() < 1e-3
