"""Long steps where nothing happens: how long they are, what takes them back, and that they change nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from finqd.errors import InputError
from finqd.mechanics.material import Material
from finqd.mechanics.state import StepReport
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.plugins.contact_penalty import Penalty, PenaltyContact
from finqd.scene import Motion, Scene, Shift, Timed, Turn
from finqd.simulate import simulate
from finqd.step_control import (
    BUSY,
    CALM_STEPS,
    NEWTON,
    SMOOTH,
    STEADY,
    StepControl,
    Timetable,
    force_change,
    hasty,
    unrest,
)
from finqd.trajectory import Trajectory

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.4, density=1000.0)
CUBE = {"name": "cube", "shape": {"kind": "box", "size_mm": [20, 20, 20]}, "mass_g": 20}
FRAME = 0.02


def calm(**changed) -> StepReport:
    return StepReport(**{"converged": True, "quasi_iterations": 2, **changed})


def after(*looks: tuple[StepReport, float], longest: int = 8) -> StepControl:
    control = StepControl(frame=FRAME, longest=longest)
    for report, change in looks:
        control.look(report, change)
    return control


def test_steps_span_twice_as_many_frames_after_calm_ones_up_to_the_longest():
    spans = [after(*[(calm(), 0.0)] * n, longest=6).span for n in range(0, 5 * CALM_STEPS, CALM_STEPS)]
    assert spans == [1, 2, 4, 6, 6]
    assert after(*[(calm(), 0.0)] * 20, longest=1).span == 1


@pytest.mark.parametrize(
    ("report", "change", "span"),
    [
        (calm(), 1.01 * STEADY, 1), (calm(converged=False), 0.0, 1), (calm(quasi_iterations=BUSY + 1), 0.0, 1),
        (calm(iterations=BUSY // NEWTON + 1), 0.0, 1), (calm(quasi_iterations=SMOOTH + 1), 0.0, 2), (calm(), 0.0, 4),
    ],
)
def test_what_happens_begins_anew_and_what_is_hard_stays_as_it_is(report, change, span):
    quiet = [(calm(), 0.0)] * (2 * CALM_STEPS - 1)
    assert after(*quiet, (report, change)).span == span


def test_halved_steps_come_before_long_ones():
    control = StepControl(frame=FRAME, longest=8, halvings=1)
    for _ in range(4):
        control.look(calm(), 0.0)
    assert control.span == 1


def test_a_body_that_is_touched_anew_or_let_go_is_a_change_whatever_the_force():
    assert force_change(np.array([0.0, 2.0]), np.array([1e-9, 2.0])) == 1.0
    assert force_change(np.array([1e-9, 2.0]), np.array([0.0, 2.0])) == 1.0
    assert force_change(np.array([1.0, 2.0]), np.array([1.1, 2.0])) == pytest.approx(0.05)
    assert force_change(np.zeros(2), np.zeros(2)) == 0.0


def test_what_falls_beside_a_resting_body_gets_single_steps():
    """Implicit Euler is off by g dt t / 2 in a fall: in long steps things would fall faster, though nothing touches."""
    scene = Scene()
    scene.add_plane()
    far = np.eye(4)
    far[0, 3], far[2, 3] = 1.0, 0.05
    scene.add_soft(box_mesh((0.01, 0.01, 0.01), (1, 1, 1)).transformed(far), RUBBER).fix("xmin")
    scene.add_rigid(load_object(CUBE), position=(0.0, 0.0, 0.2))
    seen = []
    simulate(scene, duration=0.6, time_step=0.01, longest_step=8, watch=lambda _, state: seen.append(state))
    falls = [b.time - a.time for a, b in zip(seen, seen[1:]) if b.rigid_positions[0, 2] > 0.0105]
    rests = [b.time - a.time for a, b in zip(seen, seen[1:]) if b.time > 0.45]
    assert len(falls) > 15 and max(falls) < 0.0101 and max(rests) > 0.04


def test_what_is_carried_evenly_by_its_mount_is_at_rest():
    """Seen from the lift that a drive is mounted on, an object that is lifted with it leaves no uniform motion."""
    lift = Timed(path=Shift(vector=(0.0, 0.0, 0.1)), duration=1.0)
    scene = Scene()
    body = scene.add_soft(box_mesh((0.01, 0.01, 0.01), (1, 1, 1)), RUBBER)
    body.drive("xmin", Motion(path=Shift(vector=(0.0, 0.0, 0.0)), duration=1.0, carriers=(lift,)))
    scene.add_rigid(load_object(CUBE), position=(0.0, 0.05, 0.0))
    system = System(scene, contact=Penalty())
    states = [replace(system.initial_state(), time=t) for t in (0.2, 0.24, 0.28)]
    heights = [lift.pose(state.time)[2, 3] for state in states]
    speeds = [(heights[1] - heights[0]) / 0.04, (heights[2] - heights[1]) / 0.04]
    start = replace(states[1], rigid_velocities=np.array([[0.0, 0.0, speeds[0]]]), previous=states[0])
    end = replace(states[2], rigid_velocities=np.array([[0.0, 0.0, speeds[1]]]))
    assert abs(speeds[1] - speeds[0]) * 0.04 > 1e-4, "or this says nothing"
    assert unrest(system, start, end) < 1e-12
    assert unrest(system, start, replace(end, rigid_velocities=start.rigid_velocities)) > 1e-4


def test_no_long_step_passes_over_the_begin_or_end_of_a_drive_nor_follows_right_after():
    table = Timetable((0.0, 1.0, 1.5))
    assert table.frames(0.0, 0.1, 4) == 1 and table.frames(0.2, 0.1, 4) == 4
    assert table.frames(0.8, 0.1, 4) == 2 and table.frames(0.97, 0.1, 4) == 1 and table.frames(1.05, 0.1, 4) == 1
    assert table.frames(1.7, 0.1, 4) == 4


def test_the_timetable_holds_drives_and_what_carries_them():
    lift = Timed(path=Shift(vector=(0, 0, 1)), start=2.0, duration=0.5)
    scene = Scene()
    body = scene.add_soft(box_mesh((0.01, 0.01, 0.01), (1, 1, 1)), RUBBER)
    body.drive("xmin", Motion(path=Shift(vector=(1, 0, 0)), start=0.5, duration=1.0, carriers=(lift,)))
    assert Timetable.of(scene).times == (0.5, 1.5, 2.0, 2.5)


def test_a_long_step_is_given_up_soon():
    from finqd.plugins.stepper_implicit_euler import ImplicitEuler

    assert hasty(ImplicitEuler()).max_iterations < ImplicitEuler().max_iterations
    assert hasty(ImplicitEuler(max_iterations=1)).max_iterations == 1
    assert hasty(plain := object()) is plain


def swing_at_a_cube() -> Scene:
    """A bar turns through the air for most of the time, touches a cube and pushes it over the floor."""
    scene = Scene()
    scene.add_plane()
    scene.add_rigid(load_object(CUBE), position=(0.0, 0.02, 0.01))
    pose = np.eye(4)
    pose[:3, 3] = (-0.03, -0.02, 0.007)
    bar = scene.add_soft(box_mesh((0.04, 0.01, 0.006), (6, 2, 1)).transformed(pose), RUBBER, name="bar")
    bar.drive("xmin", Motion(path=Turn(point=(-0.03, -0.015, 0.01), axis=(0.0, 0.0, 1.0), angle=0.9), duration=1.0))
    return scene


def run(longest: int, **options) -> Trajectory:
    return simulate(swing_at_a_cube(), duration=1.4, time_step=FRAME, longest_step=longest, **options)


@pytest.fixture(scope="module")
def both() -> tuple[Trajectory, Trajectory]:
    return run(1), run(4)


def test_long_steps_change_nothing_that_matters(both):
    single, long = both
    assert single.status == long.status == "ok"
    pushed = np.linalg.norm(single.rigid_positions[-1, 0] - single.rigid_positions[0, 0])
    assert pushed > 2e-3, "or this says nothing"
    assert np.abs(long.rigid_positions[-1] - single.rigid_positions[-1]).max() < 0.01 * pushed
    assert long.contact_forces[-1, 0] == pytest.approx(single.contact_forces[-1, 0], rel=0.02)
    assert long.counters["steps"] < 0.65 * single.counters["steps"]


def test_the_first_touch_is_gone_through_in_single_steps(both):
    _, long = both
    touch = int(np.argmax(long.contact_forces[:, 0] > 0.0))
    steps = np.diff(long.times)
    assert steps[touch - 1] < 1.01 * FRAME, "the step in which the bar touches the cube is a short one"
    assert steps[: touch - 1].max() > 3.9 * FRAME, "before there are long ones"
    single, _ = both
    first = single.times[int(np.argmax(single.contact_forces[:, 0] > 0.0))]
    assert abs(long.times[touch] - first) < 1.5 * FRAME


def test_contact_that_cannot_be_taken_back_gets_no_long_steps(monkeypatch):
    monkeypatch.delattr(PenaltyContact, "history")
    assert run(4).counters["steps"] >= 1.4 / FRAME


def test_long_steps_stop_and_go_on_with_the_same_bits(tmp_path):
    whole = run(4, record=True)
    stop = run(4, record=True, checkpoint=tmp_path / "run.npz", checkpoint_every=0.0, wall_clock_limit=1e-9)
    stops = 0
    while stop.status == "timeout":
        stop = run(4, record=True, checkpoint=tmp_path / "run.npz", checkpoint_every=0.0, wall_clock_limit=1e-9)
        stops += 1
    assert stops > 10
    assert stop.soft_positions.tobytes() == whole.soft_positions.tobytes()
    assert stop.times.tobytes() == whole.times.tobytes() and stop.counters == whole.counters
    with pytest.raises(InputError, match="another simulation"):
        run(2, record=True, checkpoint=tmp_path / "run.npz")


def test_fewer_than_one_is_refused():
    with pytest.raises(InputError, match="longest_step must be 1 or more"):
        run(0)
