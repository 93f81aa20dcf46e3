"""Mechanics through the public Scene: conservation laws, drives, and how runs end.

Cases with closed forms or published values are in `finqd.verification`; `test_verification.py` runs them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from finqd import registry
from finqd.errors import InputError
from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.plugins.stepper_implicit_euler import ImplicitEuler
from finqd.scene import Motion, Scene, Shift, Timed, Turn, eased
from finqd.simulate import simulate
from finqd.step_control import HALVINGS
from finqd.units import MM
from finqd.verification import dynamics, friction
from finqd.verification.cases import checked
from finqd.verification.elastic import RUBBER

# -- laws --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("time_step", [0.01, 0.002])
def test_free_fall_is_what_implicit_euler_makes_of_it(time_step: float) -> None:
    assert dynamics.free_fall(time_step) < 1e-11


def test_free_flight_keeps_linear_momentum_and_never_gains_spin_or_energy() -> None:
    losses = []
    for time_step in (0.002, 0.001):
        found = dynamics.spinning_bar(time_step)
        assert np.linalg.norm(found.linear[0]) > 0.0
        assert found.linear_drift < 1e-8
        assert np.diff(np.linalg.norm(found.angular, axis=1)).max() <= 0.0
        assert np.diff(found.energy).max() <= 0.0
        losses.append(found.angular_loss)
    assert 0.0 < losses[1] < losses[0] < 0.05
    assert losses[0] / losses[1] == pytest.approx(2.0, rel=0.1)  # implicit Euler damps in first order


def test_a_falling_cube_comes_to_rest_and_never_gains_energy() -> None:
    energy, found = dynamics.landing(0.004)
    assert np.diff(energy).max() <= 1e-12 * energy[0]
    assert energy[-1] < 0.7 * energy[0]
    assert found.contact_forces[-1, 0] == pytest.approx(0.027 * dynamics.GRAVITY, rel=1e-3)
    assert found.penetrations.max() < 0.01 * MM


def test_a_ball_spins_about_a_fixed_axis_at_its_rate() -> None:
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_rigid(load_object("sphere"), position=(0.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 2.0))
    found = checked(simulate(scene, duration=0.5, time_step=0.01))
    turned = found.rigid_rotations[-1, 0]
    assert np.allclose(turned, Turn(point=(0, 0, 0), axis=(0, 0, 1), angle=1.0).pose(1.0)[:3, :3], atol=1e-10)


# -- friction ----------------------------------------------------------------------------------------------------------


def test_without_friction_nothing_holds_a_block() -> None:
    angle = math.radians(10)
    scene = Scene(gravity=(dynamics.GRAVITY * math.sin(angle), 0.0, -dynamics.GRAVITY * math.cos(angle)), friction=0.0)
    scene.add_soft(box_mesh((0.03, 0.03, 0.01), (2, 2, 1)), RUBBER)
    scene.add_plane()
    found = checked(simulate(scene, duration=0.3, time_step=0.01, record=True))
    along = found.soft_positions[:, :, 0].mean(axis=1)
    assert friction.mean_acceleration(found.times, along) == pytest.approx(dynamics.GRAVITY * math.sin(angle), rel=1e-4)


# -- drives ------------------------------------------------------------------------------------------------------------


def test_driven_vertices_follow_their_path_and_its_carriers() -> None:
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    box = scene.add_soft(box_mesh((0.02, 0.02, 0.02), (1, 1, 2)), RUBBER)
    turn = Turn(point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), angle=0.3)
    lift = Timed(path=Shift(vector=(0.0, 0.0, 0.01)), start=0.1, duration=0.1)
    box.drive("zmax", Motion(path=turn, duration=0.1, carriers=(lift,)))
    found = checked(simulate(scene, duration=0.2, time_step=0.01, record=True))
    nodes = box.vertices("zmax")
    for frame in (0, 5, 10, 15, 20):
        time = found.times[frame]
        pose = turn.pose(eased(time / 0.1))
        expected = box.mesh.vertices[nodes] @ pose[:3, :3].T + (0.0, 0.0, 0.01 * eased((time - 0.1) / 0.1))
        assert np.abs(found.soft_positions[frame, nodes] - expected).max() < 1e-12
    assert found.stroke[0, 0] == 0.0 and found.stroke[-1, 0] == 1.0


@pytest.mark.parametrize(("time_step", "overshoot"), [(0.02, 0.1), (0.005, 1e-6)])
def test_a_drive_stalls_at_its_force_limit(time_step: float, overshoot: float) -> None:
    """A pad is driven into a plane far deeper than its limit allows; one step may overshoot, since it starts below."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    pad = scene.add_soft(box_mesh((0.02, 0.02, 0.01), (2, 2, 1)), RUBBER)
    scene.add_plane()
    pad.drive("zmax", Motion(path=Shift(vector=(0.0, 0.0, -3 * MM)), duration=1.0, force_limit=5.0))
    found = checked(simulate(scene, duration=1.0, time_step=time_step))
    assert 5.0 * 0.99 < found.contact_forces[-1, 0]
    assert found.contact_forces.max() < 5.0 * (1 + overshoot)
    assert found.stroke[-1, 0] < 0.2
    assert np.all(np.diff(found.stroke[:, 0]) >= 0.0)


# -- how a run ends ----------------------------------------------------------------------------------------------------


def falling() -> Scene:
    """Return a soft cube and a ball on it that are about to meet a plane."""
    scene = Scene()
    cube = scene.add_soft(box_mesh((0.03, 0.03, 0.03), (2, 2, 2)), RUBBER)
    cube.start_positions[:, 2] += 1 * MM
    scene.add_plane()
    scene.add_rigid(load_object("sphere"), position=(0.015, 0.016, 0.0515))
    return scene


def test_equal_runs_give_equal_bits() -> None:
    first, second = (simulate(falling(), duration=0.1, time_step=0.005, record=True) for _ in range(2))
    assert first.status == "ok", first.reason
    assert first.contact_forces.max() > 0.1
    for name in ("times", "rigid_positions", "rigid_rotations", "contact_forces", "penetrations", "soft_positions"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name
    assert first.counters == second.counters


def test_a_step_that_cannot_converge_ends_the_run_with_a_reason() -> None:
    stubborn = ImplicitEuler(max_iterations=1, max_friction_updates=0, tolerance_N=1e-15)
    found = simulate(falling(), duration=0.1, time_step=0.01, stepper=stubborn)
    assert found.status == "diverged"
    assert "t = " in found.reason and " N left on " in found.reason
    assert found.counters["rejected_steps"] > HALVINGS
    assert len(found.times) >= 1


@pytest.mark.parametrize(
    "alone",
    [True, False],
)
def test_forces_that_are_no_numbers_end_the_run_with_a_reason(alone: bool) -> None:
    scene = Scene()
    soft = scene.add_soft(box_mesh((0.03, 0.03, 0.03), (2, 2, 2)), RUBBER, name="cushion")
    soft.load("zmax", (math.nan, 0.0, 0.0))
    if not alone:
        scene.add_rigid(load_object("sphere"), position=(0.0, 0.0, 0.1))
    found = simulate(scene, duration=0.1, time_step=0.01)
    assert found.status == "diverged"
    assert "finite" in found.reason and "cushion" in found.reason


def test_a_run_that_takes_too_long_is_given_up() -> None:
    found = simulate(falling(), duration=0.1, time_step=0.01, wall_clock_limit=1e-9)
    assert found.status == "timeout"
    assert "computing" in found.reason
    assert found.counters["steps"] == 1


def test_numbers_that_make_no_sense_are_refused() -> None:
    for name in ("duration", "time_step"):
        for value in (0.0, -1.0, math.nan, math.inf):
            numbers = {"duration": 0.1, "time_step": 0.01, name: value}
            with pytest.raises(InputError, match=name):
                simulate(falling(), **numbers)
    with pytest.raises(InputError, match="stepper"):
        simulate(falling(), duration=0.1, time_step=0.01, stepper="nobody")
    with pytest.raises(InputError, match="contact"):
        simulate(falling(), duration=0.1, time_step=0.01, contact="nobody")


def test_scenes_refuse_what_they_cannot_hold() -> None:
    scene = falling()
    with pytest.raises(InputError, match="normal"):
        scene.add_plane(normal=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="two bodies"):
        scene.add_plane(name="sphere")
    with pytest.raises(InputError, match="no node set 'top'"):
        scene.soft_bodies[0].fix("top")
    with pytest.raises(InputError, match="nobody"):
        scene.set_friction("sphere", "nobody", 0.5)
    with pytest.raises(InputError, match="friction"):
        scene.set_friction("sphere", "soft 0", -0.1)
    scene.set_friction("sphere", "soft 0", 0.1)
    assert scene.friction_between("soft 0", "sphere") == 0.1
    assert scene.friction_between("soft 0", "plane 0") == scene.friction


@pytest.mark.parametrize("what", ["nothing", "a rigid body at rest", "a soft body at rest", "a body held all over"])
def test_where_nothing_happens_time_passes(what: str) -> None:
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    if what == "a rigid body at rest":
        scene.add_rigid(load_object("cube"), position=(0.0, 0.0, 0.0))
    elif what != "nothing":
        soft = scene.add_soft(box_mesh((0.03, 0.02, 0.01), (2, 2, 1), "tet4"), RUBBER)
        if what == "a body held all over":
            soft.fix(np.arange(soft.mesh.n_vertices))
    found = simulate(scene, duration=0.03, time_step=0.01, record=True)
    assert found.status == "ok"
    assert np.allclose(found.times, [0.0, 0.01, 0.02, 0.03])
    assert np.allclose(found.soft_positions[-1], found.soft_positions[0], atol=1e-12)


@pytest.mark.parametrize("stepper", ["implicit_euler", "bdf2", "quasi_static"])
def test_a_held_body_stays_and_bears_what_is_pressed_on_it(stepper: str) -> None:
    ball = load_object("sphere")
    scene = Scene(gravity=(0.0, 0.0, 0.0), friction=0.0)
    scene.add_rigid(ball, position=(0.0, 0.0, -ball.ball_radius), held=True)
    place = np.eye(4)
    place[:3, 3] = (-0.01, -0.01, 0.0)
    block = scene.add_soft(box_mesh((0.02, 0.02, 0.01), (4, 4, 2)).transformed(place), RUBBER)
    block.drive("zmax", Motion(path=Shift(vector=(0.0, 0.0, -1e-3)), duration=0.2))
    forces = []

    def watch(system: System, state: State) -> None:
        forces.append(system.contact_forces_on_rigid(state)[0])

    found = simulate(scene, duration=0.4, time_step=0.02, stepper=stepper, watch=watch)
    assert found.status == "ok", found.reason
    assert np.array_equal(found.rigid_positions, np.tile(found.rigid_positions[0], (len(found.times), 1, 1)))
    force = forces[-1]
    assert force[2] < -0.1 and np.abs(force[:2]).max() < 1e-3 * -force[2]  # pushed down, by a symmetric block
    assert found.contact_forces[-1, 0] >= -force[2]  # normal forces fan out around a ball: their sum is larger
    with pytest.raises(InputError, match="sphere 2: a rigid body that is held must not have a velocity"):
        scene.add_rigid(ball, position=(0.0, 0.0, 1.0), velocity=(0.0, 0.0, 1.0), name="sphere 2", held=True)


def test_forces_that_are_kept_are_those_of_the_state_that_is_asked_for() -> None:
    """Renewing contact asks again at one state; the elastic forces found there must not be used anywhere else."""
    def forces(system: System, state: State) -> tuple[float, np.ndarray, float]:
        system.derivatives.clear_gradient()
        energy = system.add_gradient(state)
        return energy, system.derivatives.soft.copy(), system.elastic_energy(state.positions)

    scene = Scene()
    scene.add_soft(box_mesh((0.03, 0.02, 0.01), (2, 2, 1)), RUBBER)
    system = System(scene, contact=registry.create("contact", "penalty"))
    start = system.initial_state()
    rng = np.random.default_rng(2)
    states = [replace(start, positions=start.positions + 1e-4 * rng.normal(size=start.positions.shape)) for _ in "ab"]
    for i in (0, 0, 1, 1, 0):
        fresh = System(scene, contact=registry.create("contact", "penalty"))
        for each in (system, fresh):
            each.contact.begin_step(start)
        for found, wanted in zip(forces(system, states[i]), forces(fresh, states[i]), strict=True):
            assert np.array_equal(found, wanted)
    assert forces(system, states[0])[2] != forces(system, states[1])[2]
