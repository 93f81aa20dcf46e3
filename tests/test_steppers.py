"""Steppers: order of convergence, conservation, rest, friction, substeps and steps chosen by their error."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from finqd import registry
from finqd.errors import PluginError
from finqd.mechanics import incremental
from finqd.mechanics.explicit import Motion as Moving
from finqd.mechanics.explicit import SubstepOptions, contact_rate, elastic_rate, substeps
from finqd.mechanics.material import Material
from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.plugins import stepper_bdf2
from finqd.plugins.stepper_explicit import Verlet
from finqd.scene import Motion, Scene, Shift, eased
from finqd.simulate import simulate
from finqd.trajectory import Trajectory
from finqd.units import MM

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.3, density=1000.0)
GRAVITY = 9.81
#: soft enough that explicit steps are not too short for a test; 9 g then sink 1.4 um in
SOFT_CONTACT = {"name": "penalty", "stiffness_N_mm3": 1.0}
EXACT = {"tolerance_N": 1e-11, "linear_tolerance": 1e-12}
ALL = ("implicit_euler", "bdf2", "quasi_static", "imex", "explicit")


def made(name: str, **options: Any) -> Any:
    """Return a stepper; an implicit one converges to round-off unless told otherwise."""
    if name in ("implicit_euler", "bdf2"):
        options = {**EXACT, **options}
    return registry.create("stepper", {"name": name, **options})


def checked(found: Trajectory) -> Trajectory:
    assert found.status == "ok", found.reason
    return found


def run(scene: Scene, stepper: Any, steps: Sequence[float], contact: Any = "penalty") -> tuple[System, list[State]]:
    """Take the given steps [s] and nothing else; return the states."""
    system = System(scene, contact=registry.create("contact", contact))
    states = [system.initial_state()]
    for dt in steps:
        state, report = stepper.step(system, states[-1], dt)
        assert report.converged, report.reason
        states.append(state)
    return system, states


def orders(errors: Sequence[float]) -> np.ndarray:
    """Return the observed orders of convergence; each error belongs to half the step of the one before."""
    return np.log2(np.asarray(errors[:-1]) / np.asarray(errors[1:]))


# -- free vibration, against the mode's own sine -----------------------------------------------------------------------


def beam() -> tuple[Scene, Any]:
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    body = scene.add_soft(box_mesh((0.06, 0.01, 0.01), (6, 1, 1)), RUBBER)
    body.fix("xmin")
    return scene, body


@lru_cache
def modes() -> tuple[np.ndarray, np.ndarray]:
    """Return angular frequencies [1/s] and mass-normalised modes (n_vertices, 3, n) of the clamped beam."""
    scene, body = beam()
    system = System(scene, contact=registry.create("contact", "penalty"))
    d = system.derivatives
    state = system.initial_state()
    system.contact.begin_step(state)
    system.add_hessian(state)
    free = ~system.fixed.ravel()
    root = 1.0 / np.sqrt(np.repeat(system.masses, 3)[free])
    matrix = system.pattern.matrix(d.blocks).toarray()[np.ix_(free, free)]
    squares, vectors = np.linalg.eigh(root[:, None] * matrix * root[None, :])
    shapes = np.zeros((len(free), len(squares)))
    shapes[free] = root[:, None] * vectors
    return np.sqrt(squares), shapes.reshape(-1, 3, len(squares))


def vibration_error(stepper: Any, steps: Sequence[float], mode: int) -> float:
    """Return the largest error of a mode's course over ``steps`` [s], as a share of its amplitude of 1 um."""
    frequencies, shapes = modes()
    scene, body = beam()
    shape = 1e-6 * shapes[:, :, mode] / np.abs(shapes[:, :, mode]).max()
    body.velocities[:] = frequencies[mode] * shape
    _, states = run(scene, stepper, steps)
    moves = np.array([np.vdot(s.positions - states[0].positions, shape) / np.vdot(shape, shape) for s in states])
    return float(np.abs(moves - np.sin(frequencies[mode] * np.array([s.time for s in states]))).max())


@pytest.mark.parametrize(("name", "order"), [("implicit_euler", 1), ("imex", 1), ("bdf2", 2)])
def test_a_vibration_converges_at_the_order_of_the_stepper(name: str, order: int) -> None:
    period = 2 * math.pi / modes()[0][0]
    errors = [vibration_error(made(name), [period / n] * (n // 2), 0) for n in (80, 160, 320)]
    assert orders(errors)[-1] == pytest.approx(order, abs=0.15)
    assert errors[-1] < (0.04 if order == 1 else 0.001)


def test_central_differences_converge_in_second_order_where_one_substep_is_a_step() -> None:
    frequency = modes()[0][-1]
    errors = [vibration_error(made("explicit"), [0.4 / n / frequency] * (10 * n), -1) for n in (1, 2, 4)]
    assert orders(errors) == pytest.approx(2.0, abs=0.15)
    assert errors[-1] < 0.005


UNEVEN = (1.0, 0.5, 1.0, 2.0, 0.7, 1.3, 0.6, 0.9)  # of steps, repeated; ratios from 0.46 to 2


def changing_orders() -> np.ndarray:
    """Return the orders where every step differs from the one before."""
    period = 2 * math.pi / modes()[0][0]
    errors = [vibration_error(made("bdf2"), [period / n * share for share in UNEVEN * (n // 16)], 0) for n in
              (64, 128, 256)]
    return orders(errors)


def test_bdf2_keeps_its_order_where_steps_change() -> None:
    assert changing_orders()[-1] == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda ratio: (4 / 3, 1 / 3, 2 / 3),  # the formula of equal steps
        lambda ratio: ((1 + ratio) ** 2 / (1 + 2 * ratio), ratio**2 / (1 + 2 * ratio), 0.7),
    ],
)
def test_a_wrong_coefficient_is_told_from_bdf2(wrong: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(incremental, "bdf2_coefficients", wrong)
    assert not changing_orders()[-1] == pytest.approx(2.0, abs=0.15)


def energies(name: str, periods: int, per_period: int) -> np.ndarray:
    """Return the energy after each step of the beam in its first mode, as a share of that at the start."""
    frequencies, shapes = modes()
    scene, body = beam()
    body.velocities[:] = 1e-3 * shapes[:, :, 0] / np.abs(shapes[:, :, 0]).max()
    dt = 2 * math.pi / frequencies[0] / per_period
    stepper = made(name) if name == "explicit" else made(name, tolerance_N=1e-9)
    system, states = run(scene, stepper, [dt] * (periods * per_period))
    values = [0.5 * np.vdot(system.masses, np.sum(s.velocities**2, axis=1)) + system.energy(s) for s in states]
    return np.array(values) / values[0]


def test_bdf2_damps_far_less_than_euler_and_neither_gains() -> None:
    euler, bdf2 = (energies(name, 2, 40) for name in ("implicit_euler", "bdf2"))
    assert np.diff(euler).max() <= 1e-9
    assert np.diff(bdf2).max() <= 1e-6  # BDF2's own norm falls, not exactly the energy
    assert 1.0 - euler[-1] > 0.8
    assert 0.0 < 1.0 - bdf2[-1] < 0.1


def test_central_differences_keep_the_energy_without_drift() -> None:
    energy = energies("explicit", 4, 20)
    assert np.abs(energy - 1.0).max() < 1e-3
    assert abs(energy[-20:].mean() - energy[1:21].mean()) < 1e-4


# -- free flight -------------------------------------------------------------------------------------------------------


def test_bdf2_falls_in_second_order_and_central_differences_fall_exactly() -> None:
    def error(name: str, dt: float) -> float:
        scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
        scene.add_soft(box_mesh((0.03, 0.02, 0.01), (1, 1, 1)), RUBBER)
        scene.add_rigid(load_object("cube"), position=(0.0, 0.0, 1.0))
        _, states = run(scene, made(name), [dt] * round(0.2 / dt))
        falls = [states[0].positions[0, 2] - states[-1].positions[0, 2], 1.0 - states[-1].rigid_positions[0, 2]]
        assert falls[0] == pytest.approx(falls[1], abs=1e-9)
        return abs(falls[0] - 0.5 * GRAVITY * 0.2**2)

    errors = [error("bdf2", dt) for dt in (0.02, 0.01, 0.005)]
    assert orders(errors) == pytest.approx(2.0, abs=0.15)
    assert error("explicit", 0.02) < 1e-12


def angular_loss(name: str, dt: float) -> float:
    """Return the share of its angular momentum that a soft bar loses in 0.1 s of free flight."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    mesh = box_mesh((0.06, 0.01, 0.01), (4, 1, 1))
    bar = scene.add_soft(mesh, RUBBER, velocity=(0.1, -0.2, 0.3))
    bar.velocities += np.cross((3.0, 0.0, 10.0), mesh.vertices - mesh.vertices.mean(axis=0))
    system, states = run(scene, made(name), [dt] * round(0.1 / dt))
    momenta = [system.masses[:, None] * s.velocities for s in states]
    whole = np.sum(momenta, axis=1)
    assert np.abs(whole - whole[0]).max() < 1e-7 * np.linalg.norm(whole[0])
    spins = [np.cross(s.positions, p).sum(axis=0) for s, p in zip(states, momenta, strict=True)]
    return float(np.linalg.norm(spins[-1] - spins[0]) / np.linalg.norm(spins[0]))


def test_a_spinning_bar_keeps_its_momenta_at_the_order_of_the_stepper() -> None:
    euler = [angular_loss("implicit_euler", dt) for dt in (0.002, 0.001, 0.0005)]
    bdf2 = [angular_loss("bdf2", dt) for dt in (0.002, 0.001, 0.0005)]
    assert orders(euler)[-1] == pytest.approx(1.0, abs=0.15)
    assert orders(bdf2)[-1] > 1.85
    assert bdf2[-1] < 0.05 * euler[-1]
    assert angular_loss("explicit", 0.01) < 1e-9


@pytest.mark.parametrize("name", ["bdf2", "imex", "explicit"])
def test_a_tumbling_brick_turns_in_second_order_and_keeps_its_momentum(name: str) -> None:
    def ends(dt: float) -> np.ndarray:
        scene = Scene(gravity=(0.0, 0.0, 0.0))
        brick = load_object({"name": "brick", "shape": {"kind": "box", "size_mm": [40, 25, 10]}, "mass_g": 50})
        scene.add_rigid(brick, position=(0.0, 0.0, 0.0), angular_velocity=(0.5, 10.0, 0.3))
        stepper = made(name, tolerance_N=1e-12) if name == "bdf2" else made(name)
        _, states = run(scene, stepper, [dt] * round(0.4 / dt))
        momenta = np.array([s.angular_momenta[0] for s in states])
        assert np.abs(momenta - momenta[0]).max() < 1e-9 * np.linalg.norm(momenta[0])
        return states[-1].rigid_rotations[0]

    turned = [ends(0.008 / n) for n in (1, 2, 4, 8)]
    errors = [float(np.linalg.norm(a - b)) for a, b in zip(turned, turned[1:])]
    assert orders(errors)[-1] == pytest.approx(2.0, abs=0.15)


def test_a_state_knows_the_one_before_and_no_more_and_a_shorter_try_starts_from_it() -> None:
    scene, body = beam()
    body.velocities[:, 2] = 0.01
    system, states = run(scene, made("bdf2"), [0.002] * 3)
    assert states[3].previous.time == states[2].time and states[3].previous.previous is None
    stubborn = made("bdf2", max_iterations=1, tolerance_N=1e-16, max_friction_updates=0)
    kept, report = stubborn.step(system, states[3], 0.004)
    assert not report.converged and kept is states[3]
    after, _ = made("bdf2").step(system, states[3], 0.001)
    fresh, others = run(scene, made("bdf2"), [0.002] * 3 + [0.001])
    assert np.array_equal(after.positions, others[-1].positions)


# -- contact -----------------------------------------------------------------------------------------------------------


def block(contact_force: float, *, slope: float = 0.0, friction: float = 0.6) -> Scene:
    """Return a soft block on a plane, 1.41 um in it: there `SOFT_CONTACT` carries it."""
    scene = Scene(gravity=(GRAVITY * math.sin(slope), 0.0, -GRAVITY * math.cos(slope)), friction=friction)
    body = scene.add_soft(box_mesh((0.03, 0.03, 0.01), (1, 1, 1)), RUBBER)
    depth = math.sqrt(contact_force * math.cos(slope) / (0.03 * 0.03) * 2 * 0.01 * MM / 1e9)
    body.start_positions[:, 2] -= depth
    scene.add_plane()
    return scene


WEIGHT = 0.009 * GRAVITY  # of the block [N]


@pytest.mark.parametrize("name", ALL)
def test_a_block_at_rest_presses_with_its_weight_whatever_the_stepper(name: str) -> None:
    stepper = made(name, damping_per_s=100.0) if name in ("imex", "explicit") else made(name)
    scene = block(1.2 * WEIGHT)
    found = checked(simulate(scene, duration=0.15, time_step=0.01, stepper=stepper, contact=SOFT_CONTACT, record=True))
    assert found.contact_forces[-1, 0] == pytest.approx(WEIGHT, rel=2e-3)
    assert found.penetrations[-1] == pytest.approx(0.00140 * MM, rel=0.05)
    assert np.ptp(found.soft_positions[-3:, :, 2], axis=0).max() < 0.05e-6


@pytest.mark.parametrize(("name", "damping"), [("imex", 0.0), ("explicit", 100.0), ("bdf2", 0.0)])
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_a_block_on_a_slope_sticks_or_slides_by_coulombs_law(name: str, damping: float, share: float) -> None:
    """Explicit steps damp nothing, and a block that shivers creeps: it sticks only once it is at rest."""
    stepper = made(name, damping_per_s=damping) if damping and share < 1.0 else made(name)
    angle = math.atan(share * 0.6)
    scene = block(WEIGHT, slope=angle)
    found = checked(
        simulate(scene, duration=0.2, time_step=0.01, stepper=stepper, contact=SOFT_CONTACT, record=True)
    )
    along = found.soft_positions[:, :, 0].mean(axis=1) - found.soft_positions[0, :, 0].mean()
    if share < 1.0:
        assert np.abs(along).max() < 0.03 * MM
        assert np.ptp(along[14:]) < 0.002 * MM
    else:
        expected = GRAVITY * (math.sin(angle) - 0.6 * math.cos(angle))
        speeds = np.diff(along) / np.diff(found.times)
        bar = 0.1 if name == "explicit" else 0.05
        assert (speeds[-1] - speeds[9]) / (found.times[-1] - found.times[10]) == pytest.approx(expected, rel=bar)


@pytest.mark.parametrize("name", ["bdf2", "quasi_static"])
def test_a_ball_rolls_down_a_slope(name: str) -> None:
    angle = math.radians(15.0)
    scene = Scene(gravity=(GRAVITY * math.sin(angle), 0.0, -GRAVITY * math.cos(angle)))
    scene.add_plane()
    ball = load_object("sphere")
    scene.add_rigid(ball, position=(0.0, 0.0, ball.ball_radius))
    found = checked(simulate(scene, duration=0.5, time_step=0.01, stepper=name))
    speeds = np.diff(found.rigid_positions[:, 0, 0]) / 0.01
    assert (speeds[-1] - speeds[16]) / (33 * 0.01) == pytest.approx(5 / 7 * GRAVITY * math.sin(angle), rel=1e-3)


def landing_gain(time_step: float) -> tuple[float, float]:
    """Return by how much the energy [J] of a soft cube that lands by BDF2 rises at most, and what it was at first."""
    scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
    cube = scene.add_soft(box_mesh((0.03, 0.03, 0.03), (2, 2, 2)), RUBBER)
    cube.start_positions[:, 2] += 0.02
    scene.add_plane()
    energy: list[float] = []

    def watch(system: System, state: State) -> None:
        kinetic = 0.5 * float(np.vdot(system.masses, np.sum(state.velocities**2, axis=1)))
        energy.append(kinetic + system.energy(state))

    checked(simulate(scene, duration=0.3, time_step=time_step, stepper="bdf2", watch=watch))
    return float(np.diff(energy).max()), energy[0]


def test_bdf2_makes_no_rebound_out_of_a_kink(monkeypatch: pytest.MonkeyPatch) -> None:
    gain, start = landing_gain(0.004)
    assert gain < 2e-3 * start
    monkeypatch.setattr(stepper_bdf2, "KINK", 10.0)
    gain, start = landing_gain(0.004)
    assert gain > 0.05 * start, "without the detection of kinks this test would find nothing"


# -- drives ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_driven_vertices_follow_their_path(name: str) -> None:
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    box = scene.add_soft(box_mesh((0.02, 0.02, 0.02), (1, 1, 2)), RUBBER)
    box.drive("zmax", Motion(path=Shift(vector=(0.0, 0.0, 0.01)), duration=0.1))
    found = checked(simulate(scene, duration=0.12, time_step=0.01, stepper=name, record=True))
    driven, free = box.vertices("zmax"), box.vertices("zmin")
    moves = found.soft_positions[:, :, 2] - box.mesh.vertices[:, 2]
    expected = [0.01 * eased(time / 0.1) for time in found.times]
    assert np.abs(moves[:, driven] - np.array(expected)[:, None]).max() < 1e-12
    assert np.abs(moves[-1, free] - 0.01).max() < (1e-7 if name == "quasi_static" else 0.5 * MM)


# -- quasi-static ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ramp", [0.0, 0.3])
def test_a_large_dead_load_finds_its_equilibrium_in_a_few_steps(ramp: float) -> None:
    """P L^2 / EI = 4: the tip sinks 0.66996 L and draws in 0.32894 L (elastica)."""
    length, side = 0.1, 0.005
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_soft(
        box_mesh((length, side, side), (40, 2, 2)), Material(youngs_modulus=1e6, poisson_ratio=0.0, density=1000.0)
    )
    rod.fix("xmin")
    rod.load("xmax", (0.0, 0.0, -4 * 1e6 * side**4 / 12 / length**2))
    stepper = made("quasi_static", ramp_s=ramp)
    found = checked(simulate(scene, duration=0.4, time_step=0.1, stepper=stepper, record=True))
    tip = found.soft_positions[:, rod.vertices("xmax")].mean(axis=1)
    assert (tip[0, 2] - tip[-1, 2]) / length == pytest.approx(0.66996, rel=5e-3)
    assert 1.0 - tip[-1, 0] / length == pytest.approx(0.32894, rel=5e-3)
    assert found.counters["rejected_steps"] == 0
    assert (tip[1, 2] - tip[-1, 2] > 0.2 * length) == (ramp > 0.0)


def test_what_nothing_holds_has_no_equilibrium_and_that_is_said() -> None:
    for height in (1 * MM, 0.0):
        scene = Scene()
        body = scene.add_soft(box_mesh((0.03, 0.02, 0.01), (2, 2, 1)), RUBBER, name="cushion")
        body.start_positions[:, 2] += height
        scene.add_plane()
        found = simulate(scene, duration=0.1, time_step=0.01, stepper="quasi_static")
        assert found.status == "diverged"
        assert "cushion is free to move as a whole" in found.reason


# -- substeps ----------------------------------------------------------------------------------------------------------


def pressed() -> tuple[System, State]:
    """Return a soft block with a heavy ball in it."""
    scene = block(WEIGHT)
    ball = load_object("sphere")
    scene.add_rigid(ball, position=(0.015, 0.015, 0.01 + ball.ball_radius - 0.1 * MM))
    system = System(scene, contact=registry.create("contact", SOFT_CONTACT))
    state = system.initial_state()
    system.contact.begin_step(state)
    return system, state


def test_stable_substeps_come_from_bounds_of_the_true_frequencies() -> None:
    system, state = pressed()
    bound = contact_rate(system, state)
    d = system.derivatives
    full = np.block([[system.pattern.matrix(d.blocks).toarray(), d.coupling], [d.coupling.T, d.rigid_matrix]])
    mass = np.diag(np.concatenate([np.repeat(system.masses, 3), np.repeat(system.rigid_masses, 3), np.zeros(3)]))
    mass[-3:, -3:] = system.world_inertias(state.rigid_rotations)[0]
    inverse = np.linalg.inv(np.linalg.cholesky(mass))
    true = np.linalg.eigvalsh(inverse @ full @ inverse.T)[-1]
    assert true <= bound < 6 * true
    scene, _ = beam()
    system = System(scene, contact=registry.create("contact", "penalty"))
    assert math.sqrt(elastic_rate(system, system.initial_state())) == pytest.approx(modes()[0][-1], rel=0.01)


@dataclass(frozen=True)
class Unstable:
    """Central differences that believe in a frequency ten times too low."""

    def step(self, system: System, state: State, dt: float) -> Any:
        system.contact.begin_step(state)
        method = Verlet(rate=0.01 * elastic_rate(system, state), damping=0.0)
        return substeps(Moving(system, state, dt), method, SubstepOptions())


def test_substeps_that_blow_up_or_are_too_many_fail_with_a_reason() -> None:
    scene, body = beam()
    body.velocities[:, 2] = 0.1
    found = simulate(scene, duration=0.05, time_step=0.025, stepper=Unstable())
    assert found.status == "ok" or "out of nothing" in found.reason or "finite" in found.reason
    assert found.counters["rejected_steps"] > 0
    found = simulate(scene, duration=0.05, time_step=0.05, stepper=made("explicit", max_substeps=1))
    assert found.status == "diverged" and "max_substeps" in found.reason


@pytest.mark.parametrize("name", ["imex", "explicit"])
def test_substeps_are_counted_and_a_step_without_contact_is_one_to_imex(name: str) -> None:
    scene, body = beam()
    body.velocities[:, 2] = 0.01
    found = checked(simulate(scene, duration=0.03, time_step=0.01, stepper=name))
    least = 3 if name == "imex" else 0.03 * modes()[0][-1] / 2
    assert found.counters["steps"] == 3 and found.counters["substeps"] >= least
    if name == "imex":
        assert found.counters["substeps"] == 3
    else:
        assert found.counters["substeps"] < 1.5 * least / 0.8


def test_options_out_of_range_are_refused() -> None:
    for name, option, value in (
        ("implicit_euler", "error_tolerance_mm", 0.0), ("bdf2", "error_tolerance_mm", -1.0),
        ("explicit", "safety", 1.5), ("imex", "damping_per_s", -1.0), ("quasi_static", "ramp_s", -1.0),
    ):
        with pytest.raises(PluginError, match=option):
            registry.create("stepper", {"name": name, option: value})
