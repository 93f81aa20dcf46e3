"""Steps chosen by their own error: what a tolerance buys, where steps shorten, and what no tolerance may do."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from finqd import registry
from finqd.mechanics.material import Material
from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.scene import Motion, Scene, Shift
from finqd.simulate import simulate
from finqd.trajectory import Trajectory

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.3, density=1000.0)
GRAVITY = 9.81


def made(name: str, **options: Any) -> Any:
    """Return an implicit stepper that converges to round-off."""
    return registry.create("stepper", {"name": name, "tolerance_N": 1e-9, "linear_tolerance": 1e-10, **options})


def checked(found: Trajectory) -> Trajectory:
    assert found.status == "ok", found.reason
    return found


def swing(stepper: Any, time_step: float) -> tuple[float, Trajectory]:
    """Return where the tip of a soft beam is 0.1 s after it is let go [m], and the trajectory."""
    scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
    rod = scene.add_soft(
        box_mesh((0.08, 0.01, 0.01), (8, 1, 1)), Material(youngs_modulus=3e5, poisson_ratio=0.3, density=1000.0)
    )
    rod.fix("xmin")
    found = checked(simulate(scene, duration=0.1, time_step=time_step, stepper=stepper, record=True))
    return float(found.soft_positions[-1, rod.vertices("xmax"), 2].mean()), found


@lru_cache
def swung() -> float:
    return swing(made("bdf2"), 5e-5)[0]


@pytest.mark.parametrize(("name", "tolerances"), [("implicit_euler", (0.1, 0.01)), ("bdf2", (0.1, 0.005))])
def test_the_error_follows_the_tolerance(name: str, tolerances: tuple[float, float]) -> None:
    errors, steps = [], []
    for tolerance in tolerances:
        tip, found = swing(made(name, error_tolerance_mm=tolerance), 0.05)
        errors.append(abs(tip - swung()))
        steps.append(found.counters["steps"])
        assert found.counters["error_overruns"] == 0
        assert np.allclose(found.times, [0.0, 0.05, 0.1])
    order = 1 if name == "implicit_euler" else 2
    ratio = tolerances[0] / tolerances[1]
    # global error and steps of order p go with tolerance^(p/(p+1)) and tolerance^(-1/(p+1))
    assert math.log(errors[0] / errors[1]) / math.log(ratio) == pytest.approx(order / (order + 1), abs=0.25)
    assert math.log(steps[1] / steps[0]) / math.log(ratio) == pytest.approx(1 / (order + 1), abs=0.15)


def test_steps_shorten_where_something_hits_and_lengthen_after() -> None:
    scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
    cube = scene.add_soft(box_mesh((0.03, 0.03, 0.03), (2, 2, 2)), RUBBER)
    cube.start_positions[:, 2] += 0.02
    scene.add_plane()
    impact, times = math.sqrt(2 * 0.02 / GRAVITY), [0.0]
    stepper = registry.create("stepper", {"name": "bdf2", "error_tolerance_mm": 0.05})
    found = checked(
        simulate(
            scene, duration=0.4, time_step=0.05, stepper=stepper, watch=lambda system, state: times.append(state.time)
        )
    )
    steps, middles = np.diff(times), 0.5 * (np.array(times[1:]) + np.array(times[:-1]))
    around = np.abs(middles - impact) < 0.005
    before = (middles < impact - 0.02) & (middles > 0.01)
    assert steps[around].min() < 0.2 * steps[before].max()
    assert steps[-1] > 5 * steps[around].min()
    assert found.counters["error_rejections"] > 0
    assert found.counters["rejected_steps"] >= found.counters["error_rejections"]
    assert found.contact_forces[-1, 0] == pytest.approx(0.027 * GRAVITY, rel=0.01)


def test_an_error_that_no_step_meets_does_not_end_the_run() -> None:
    scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
    scene.add_rigid(load_object("cube"), position=(0.0, 0.0, 1.0))
    stepper = registry.create("stepper", {"name": "implicit_euler", "error_tolerance_mm": 1e-9})
    found = checked(simulate(scene, duration=0.02, time_step=0.02, stepper=stepper))
    assert found.counters["steps"] == 256
    assert found.counters["error_overruns"] == 256


def jerked(stepper: Any, time_step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times and heights of the tip of a soft beam whose root is moved by 5 mm in the last of ten tenths."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_soft(box_mesh((0.08, 0.01, 0.01), (8, 1, 1)), RUBBER)
    rod.drive("xmin", Motion(path=Shift(vector=(0.0, 0.0, 0.005)), start=0.8, duration=0.1))
    times, heights = [], []

    def watch(system: System, state: State) -> None:
        times.append(state.time)
        heights.append(state.positions[rod.vertices("xmax"), 2].mean())

    checked(simulate(scene, duration=1.0, time_step=time_step, stepper=stepper, watch=watch))
    return np.array(times), np.array(heights)


@pytest.mark.parametrize(("name", "gain"), [("implicit_euler", 2.0), ("bdf2", 4.0)])
def test_chosen_steps_err_less_than_as_many_equal_ones(name: str, gain: float) -> None:
    times, heights = jerked(made("bdf2"), 5e-4)
    errors = []
    chosen, course = jerked(made(name, error_tolerance_mm=0.02), 0.1)
    for found, tip in ((chosen, course), jerked(made(name), 1.0 / len(chosen))):
        errors.append(np.abs(tip - np.interp(found, times, heights)).max())
    assert gain * errors[0] < errors[1]
