"""Bodies that are let go far from any equilibrium."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.mesh_shapes import box_mesh
from finqd.presets import apply_preset
from finqd.scene import Scene
from finqd.simulate import simulate

from .grippers import design, finger_mesh
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


TANGLED = {"name": "penalty", "soft_contact": False}  # what starts inside out goes through itself on the way back


def scattered(mesh, material, *, scatter: float, elasticity: str = "corotated") -> Scene:
    """Return a body held at its base whose other nodes start off their places by up to ``scatter`` [m] an axis."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    body = scene.add_soft(mesh, material, elasticity=elasticity)
    body.fix("base" if "base" in mesh.node_sets else "zmin")
    off = np.random.default_rng(1).uniform(-scatter, scatter, mesh.vertices.shape)
    body.start_positions[:] += np.where(body.fixed, 0.0, off)
    return scene


@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("order", [1, 2])
def test_every_node_of_a_finger_off_by_as_much_as_walls_are_thick(order, step):
    """Off by up to 2 mm each way, so that most elements start inside out; it finds its rest shape again."""
    chosen = apply_preset(design(), "draft", overrides={"mesher.order": order, "mesher.notch_nodes": "middle"})
    scene = scattered(finger_mesh(chosen), chosen.material, scatter=2e-3)
    body = scene.soft_bodies[0]
    found, course = sound(
        scene, duration=0.5, time_step_ms=step, contact=TANGLED,
        stepper={"name": "implicit_euler", "max_iterations": 200},
    )
    start = body.mesh.transformed(np.eye(4))
    start.vertices[:] = body.start_positions
    assert start.quality().inverted > 0.5 * body.mesh.n_elements
    assert np.abs(course.states[-1].positions - body.mesh.vertices).max() < (1e-6 if step >= 10 else 1e-3)


@pytest.mark.parametrize("step", STEPS_MS)
def test_every_node_of_a_finger_anywhere(step):
    """Of so wild a start not every turn is undone: a frame has equilibria that are wound up. But it gets to rest."""
    chosen = apply_preset(design(), "draft")
    mesh = finger_mesh(chosen)
    scene = scattered(mesh, chosen.material, scatter=0.0)
    body = scene.soft_bodies[0]
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    anywhere = np.random.default_rng(2).uniform(low, high, mesh.vertices.shape)
    body.start_positions[:] = np.where(body.fixed, mesh.vertices, anywhere)
    energies = []
    found = simulate(
        scene, duration=0.5, time_step=1e-3 * step, contact=TANGLED,
        stepper={"name": "implicit_euler", "max_iterations": 1000},
        watch=lambda system, state: energies.append(system.energy(state)),
    )
    assert found.status == "ok", found.reason
    assert np.all(np.isfinite(energies)) and energies[-1] <= energies[0]
