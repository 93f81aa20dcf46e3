"""Quasi-Newton steps: the secant equation, convergence on a quadratic, and the same motion for fewer matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from finqd import registry
from finqd.mechanics.material import Material
from finqd.mechanics.newton import Newton
from finqd.mechanics.quasi_newton import MOST, QUICK, SLOW, QuasiNewton
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.scene import Scene
from finqd.simulate import simulate

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.45, density=1000.0)
SIZE = 24


class Diagonal:
    """A rough inverse: one over the diagonal of a matrix."""

    positive = True

    def __init__(self, matrix: np.ndarray) -> None:
        self.inverse = 1.0 / np.diag(matrix)

    def apply(self, residual: np.ndarray) -> np.ndarray:
        return self.inverse * residual


@pytest.fixture
def matrix() -> np.ndarray:
    factor = np.random.default_rng(3).normal(size=(SIZE, SIZE))
    return factor @ factor.T + SIZE * np.eye(SIZE)


def test_the_latest_change_is_reproduced_exactly(matrix: np.ndarray) -> None:
    rng, quasi = np.random.default_rng(4), QuasiNewton(Diagonal(matrix))
    for _ in range(5):
        step = rng.normal(size=SIZE)
        quasi.learn(step, matrix @ step)
        assert np.allclose(quasi.direction(matrix @ step), -step, rtol=1e-10)


def test_what_it_learns_makes_it_converge(matrix: np.ndarray) -> None:
    def left(learns: bool) -> float:
        quasi, x = QuasiNewton(Diagonal(matrix)), np.ones(SIZE)
        for _ in range(20):
            step = quasi.direction(matrix @ x)
            step *= min(1.0, -(step @ matrix @ x) / (step @ matrix @ step))
            if learns:
                quasi.learn(step, matrix @ step)
            x = x + step
        return float(np.linalg.norm(matrix @ x) / np.linalg.norm(matrix @ np.ones(SIZE)))

    assert left(True) < 0.05 * left(False)


def test_negative_curvature_teaches_nothing(matrix: np.ndarray) -> None:
    quasi = QuasiNewton(Diagonal(matrix))
    quasi.learn(np.ones(SIZE), -matrix @ np.ones(SIZE))
    assert not quasi.changes and np.array_equal(quasi.direction(np.ones(SIZE)), -1.0 / np.diag(matrix))


def test_newton_takes_over_where_the_cheap_steps_stop_to_help(matrix: np.ndarray) -> None:
    quasi = QuasiNewton(Diagonal(matrix))
    assert quasi.promises(1.0) and not QuasiNewton(None).promises(1.0)
    quasi.stepped(1.0)
    assert quasi.promises(0.99 * SLOW) and not quasi.promises(1.01 * SLOW)
    quasi.replaced(quasi.inverse, 1.0)
    assert quasi.promises(0.99 * QUICK) and not quasi.promises(1.01 * QUICK)
    quasi.renewed()
    assert quasi.promises(100.0)
    for _ in range(MOST):
        quasi.stepped(1.0)
    assert not quasi.promises(0.0)


def cantilever(**options: Any) -> Any:
    """Return the run of a cantilever on which a cube falls."""
    scene = Scene(friction=0.3)
    beam = scene.add_soft(box_mesh((0.06, 0.02, 0.01), (8, 2, 2), "hex8"), RUBBER)
    beam.fix("xmin")
    scene.add_rigid(load_object("cube"), position=(0.045, 0.0, 0.041), velocity=(0.0, 0.0, -0.3))
    stepper = registry.create("stepper", {"name": "implicit_euler", "tolerance_N": 1e-6, **options})
    contact = registry.create("contact", "penalty")
    return simulate(scene, duration=0.3, time_step=0.005, stepper=stepper, contact=contact, record=True)


def test_the_motion_is_the_same_for_fewer_matrices() -> None:
    cheap, plain = cantilever(), cantilever(quasi_newton=False)
    assert cheap.status == plain.status == "ok"
    assert plain.counters["quasi_iterations"] == 0 < cheap.counters["quasi_iterations"]
    assert cheap.counters["newton_iterations"] < 0.8 * plain.counters["newton_iterations"]
    ends, starts = plain.soft_positions[-1], plain.soft_positions[0]
    moved = np.abs(ends - starts).max()
    assert moved > 1e-3
    assert np.abs(cheap.soft_positions[-1] - ends).max() < 1e-3 * moved


@pytest.mark.parametrize("quasi", [True, False])
def test_a_step_ends_only_within_the_tolerance_of_the_friction_bounds_it_was_solved_with(
    quasi: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Renewals may come before a minimum, ends may not."""
    original, left = Newton._renew, []

    def watched(self: Newton, *arguments: Any, **options: Any) -> tuple[float, bool]:
        before = self.report.residual
        energy, ended = original(self, *arguments, **options)
        left.append((before, ended))
        return energy, ended

    monkeypatch.setattr(Newton, "_renew", watched)
    assert cantilever(quasi_newton=quasi).status == "ok"
    assert max(before for before, ended in left if ended) <= 1e-6
    assert any(before > 1e-6 for before, _ in left), "or this test says nothing"


def test_without_a_factorisation_there_is_nothing_to_start_from() -> None:
    found = cantilever(preconditioner="jacobi")
    assert found.status == "ok" and found.counters["quasi_iterations"] == 0


def test_a_trial_of_infinite_energy_does_not_switch_the_line_search_off() -> None:
    """An inverted element costs infinite energy in `neo_hookean`; a load that overshoots must still find its rest."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    body = scene.add_soft(box_mesh((0.01, 0.01, 0.02), (2, 2, 4)), RUBBER, elasticity="neo_hookean")
    body.fix("zmin")
    body.load("zmax", (18.0, 0.0, 60.0))
    stepper = registry.create("stepper", "implicit_euler")
    found = simulate(scene, duration=0.02, time_step=0.02, stepper=stepper, contact="penalty")
    assert found.status == "ok" and found.counters["rejected_steps"] == 0, found.reason
