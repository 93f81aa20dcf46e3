"""Rayleigh damping: decay rates, what it must leave alone, derivatives, and masses that hang on a body."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from finqd import registry
from finqd.data import designs_folder
from finqd.design import Design
from finqd.effects import effects_of
from finqd.errors import InputError
from finqd.mechanics import damping as damping_module
from finqd.mechanics.damping import StepDamping, ViscousBlock
from finqd.mechanics.incremental import Past, bdf2_past, euler_past
from finqd.mechanics.material import Material
from finqd.mechanics.rotation_kernels import rotation_matrix
from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.scene import Scene
from finqd.simulate import simulate

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.3, density=1000.0)
EXACT = {"tolerance_N": 1e-11, "linear_tolerance": 1e-12, "max_iterations": 100}
ELASTICITIES = ("corotated", "neo_hookean", "linear")


def made(name: str, **options: Any) -> Any:
    """Return a stepper that converges to round-off, if it iterates at all."""
    exact = EXACT if name in ("implicit_euler", "bdf2") else {}
    return registry.create("stepper", {"name": name, **exact, **options})


def bound(scene: Scene) -> System:
    return System(scene, contact=registry.create("contact", "penalty"))


def beam(*, material: Material = RUBBER, elasticity: str = "corotated") -> tuple[Scene, Any]:
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    body = scene.add_soft(box_mesh((0.06, 0.01, 0.01), (6, 1, 1)), material, elasticity=elasticity)
    body.fix("xmin")
    return scene, body


@lru_cache
def lowest_mode() -> tuple[float, np.ndarray]:
    """Return angular frequency [1/s] and shape (n_vertices, 3), largest entry 1, of the clamped beam's first mode."""
    scene, _ = beam()
    system = bound(scene)
    state = system.initial_state()
    system.contact.begin_step(state)
    system.add_hessian(state)
    free = ~system.fixed.ravel()
    root = 1.0 / np.sqrt(np.repeat(system.masses, 3)[free])
    matrix = system.pattern.matrix(system.derivatives.blocks).toarray()[np.ix_(free, free)]
    squares, vectors = np.linalg.eigh(root[:, None] * matrix * root[None, :])
    shape = np.zeros(len(free))
    shape[free] = root * vectors[:, 0]
    return math.sqrt(squares[0]), (shape / np.abs(shape).max()).reshape(-1, 3)


FREQUENCY, _ = lowest_mode()
#: damping ratio 0.1 of the lowest mode: by the mass, by the stiffness, and half by each
RATIO = 0.1
CONSTANTS = {
    "mass": {"rayleigh_mass": 2 * RATIO * FREQUENCY}, "stiffness": {"rayleigh_stiffness": 2 * RATIO / FREQUENCY},
    "both": {"rayleigh_mass": RATIO * FREQUENCY, "rayleigh_stiffness": RATIO / FREQUENCY},
}


def decay_error(stepper: Any, steps: int, constants: dict[str, float], elasticity: str = "corotated") -> float:
    """Return the largest error of the damped first mode's course over one period, as a share of its amplitude.

    x(t) = exp(-zeta w t) (cos(v t) + zeta w / v sin(v t)), v = w root(1 - zeta^2), from an amplitude of 1 um.
    """
    omega, shape = lowest_mode()
    scene, body = beam(material=replace(RUBBER, **constants), elasticity=elasticity)
    body.start_positions += 1e-6 * shape
    period = 2 * math.pi / omega
    found = simulate(scene, duration=period, time_step=period / steps, stepper=stepper, record=True)
    assert found.status == "ok", found.reason
    moves = found.soft_positions - body.mesh.vertices
    course = np.einsum("tni,ni->t", moves, shape) / np.vdot(shape, shape) / 1e-6
    zeta, t = RATIO, found.times
    v = omega * math.sqrt(1 - zeta**2)
    exact = np.exp(-zeta * omega * t) * (np.cos(v * t) + zeta * omega / v * np.sin(v * t))
    return float(np.abs(course - exact).max())


# -- decay -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("by", CONSTANTS)
def test_a_vibration_decays_at_the_rate_of_its_constants_in_second_order(by: str) -> None:
    errors = [decay_error(made("bdf2"), n, CONSTANTS[by]) for n in (100, 200, 400)]
    assert math.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.2)
    assert errors[2] < 1e-3
    wrong = {key: 1.1 * value for key, value in CONSTANTS[by].items()}
    assert decay_error(made("bdf2"), 400, wrong) > 5 * errors[2], "a tenth more damping must be seen"


@pytest.mark.parametrize("name", ["implicit_euler", "imex"])
@pytest.mark.parametrize("by", ["mass", "stiffness"])
def test_first_order_steppers_converge_to_the_same_decay(name: str, by: str) -> None:
    errors = [decay_error(made(name), n, CONSTANTS[by]) for n in (100, 200, 400)]
    assert math.log2(errors[1] / errors[2]) == pytest.approx(1.0, abs=0.15)
    assert errors[2] < 0.03


def test_explicit_steps_decay_by_the_mass() -> None:
    assert decay_error(made("explicit"), 50, CONSTANTS["mass"]) < 1e-4


@pytest.mark.parametrize("elasticity", ELASTICITIES)
def test_every_elasticity_is_damped_alike_in_small_vibrations(elasticity: str) -> None:
    assert decay_error(made("bdf2"), 200, CONSTANTS["both"], elasticity) < 3e-3


# -- what it must leave alone ------------------------------------------------------------------------------------------


def tumbling(stepper: str, *, beta: float, spin: tuple[float, float, float] = (3.0, 0.0, 10.0), dt: float = 2e-3,
             start: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return linear and angular momentum (n, 3) and energy (n,) of a free bar; ``start``: stretched by that share."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    mesh = box_mesh((0.06, 0.01, 0.01), (6, 1, 1))
    bar = scene.add_soft(mesh, replace(RUBBER, rayleigh_stiffness=beta), velocity=(0.1, -0.2, 0.3))
    middle = mesh.vertices.mean(axis=0)
    bar.start_positions += start * (mesh.vertices - middle) * (1.0, 0.0, 0.0)
    bar.velocities += np.cross(spin, bar.start_positions - middle)
    rows: list[tuple[np.ndarray, np.ndarray, float]] = []

    def watch(system: System, state: State) -> None:
        momenta = system.masses[:, None] * state.velocities
        centre = system.masses @ state.positions / system.masses.sum()
        kinetic = 0.5 * float(np.vdot(momenta, state.velocities))
        rows.append((momenta.sum(axis=0), np.cross(state.positions - centre, momenta).sum(axis=0),
                     kinetic + system.energy(state)))

    found = simulate(scene, duration=0.1, time_step=dt, stepper=made(stepper), watch=watch)
    assert found.status == "ok", found.reason
    linear, angular, energy = zip(*rows)
    return np.array(linear), np.array(angular), np.array(energy)


@pytest.mark.parametrize("stepper", ["implicit_euler", "bdf2"])
def test_a_free_body_keeps_its_momentum_and_never_gains_energy(stepper: str) -> None:
    linear, _, energy = tumbling(stepper, beta=5e-3, start=0.1)
    assert np.abs(linear - linear[0]).max() < 1e-9 * np.linalg.norm(linear[0])
    assert np.diff(energy).max() < 1e-12 * energy[0]


@pytest.mark.parametrize("stepper", ["implicit_euler", "bdf2"])
def test_a_spin_loses_nothing_to_damping_that_the_stepper_does_not_lose_itself(stepper: str) -> None:
    _, still, still_energy = tumbling(stepper, beta=0.0)
    _, damped, damped_energy = tumbling(stepper, beta=5e-3)
    size = np.linalg.norm(still[0])
    assert np.linalg.norm(damped[-1] - still[-1]) < 2e-4 * size
    assert abs(damped_energy[-1] - still_energy[-1]) < 2e-3 * still_energy[0]


class Unturned(StepDamping):
    """The wrong twin: strain rates in the world's frame, beta/(2h) (x - x0)^T K (x - x0)."""

    def energy(self, positions: np.ndarray) -> float:
        moved = positions - self.origin
        return sum(0.5 * float(np.einsum("em,emn,en", u, k, u)) for u, k in self._local(moved))

    def add_gradient(self, positions: np.ndarray, gradient: np.ndarray) -> float:
        moved = positions - self.origin
        for block, (u, k) in zip(self.damping.viscous, self._local(moved), strict=True):
            np.add.at(gradient, block.nodes, np.einsum("emn,en->em", k, u).reshape(*block.nodes.shape, 3))
        return self.energy(positions)

    def add_hessian(self, positions: np.ndarray, blocks: np.ndarray, *, projected: bool = False) -> None:
        for block, slots, k in zip(self.damping.viscous, self.damping.slots, self.stiffnesses, strict=True):
            n, m = block.nodes.shape
            np.add.at(blocks, slots, np.moveaxis(k[block.kinds].reshape(n, m, 3, m, 3), 2, 3))

    def _local(self, moved: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(moved[b.nodes].reshape(len(b.nodes), -1), k[b.kinds])
                for b, k in zip(self.damping.viscous, self.stiffnesses, strict=True)]


def test_damping_without_the_rotating_frame_would_be_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    _, still, still_energy = tumbling("bdf2", beta=0.0)
    monkeypatch.setattr(damping_module, "StepDamping", Unturned)
    _, damped, damped_energy = tumbling("bdf2", beta=5e-3)
    size = np.linalg.norm(still[0])
    assert np.linalg.norm(damped[-1] - still[-1]) > 0.02 * size
    assert still_energy[-1] - damped_energy[-1] > 0.02 * still_energy[0]


def test_imex_brakes_no_rigid_motion() -> None:
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    mesh = box_mesh((0.06, 0.01, 0.01), (6, 1, 1))
    scene.add_soft(mesh, replace(RUBBER, rayleigh_stiffness=5e-3))
    system = bound(scene)
    turned = mesh.vertices @ rotation_matrix(np.array([0.4, -1.1, 0.7])).T
    blocks = np.zeros_like(system.derivatives.blocks)
    system.damping.add_viscosity(turned, blocks)
    matrix = system.pattern.matrix(blocks).toarray()
    stretching = turned.ravel() @ matrix @ turned.ravel()
    for spin in (*np.eye(3), np.array([1.0, -2.0, 0.5])):
        rigid = (np.cross(spin, turned) + (0.01, 0.02, -0.03)).ravel()
        assert np.abs(matrix @ rigid).max() < 1e-10 * np.abs(matrix).max() * np.abs(rigid).max()
    values = np.linalg.eigvalsh(matrix)
    assert stretching > 0 and values[0] > -1e-9 * values[-1]


@pytest.mark.parametrize("elasticity", ELASTICITIES)
@pytest.mark.parametrize("stepper", ["implicit_euler", "bdf2", "quasi_static"])
def test_what_comes_to_rest_is_the_same_with_and_without_damping(elasticity: str, stepper: str) -> None:
    found = {}
    for damped in (False, True):
        constants = {"rayleigh_mass": 20.0, "rayleigh_stiffness": 5e-3} if damped else {}
        scene, body = beam(material=replace(RUBBER, **constants), elasticity=elasticity)
        body.load("xmax", (0.0, 0.0, -0.01))
        options = {"tolerance_N": 1e-9} if stepper == "quasi_static" else {}
        run = simulate(scene, duration=4.0, time_step=0.2, stepper=made(stepper, **options), record=True)
        assert run.status == "ok", run.reason
        found[damped] = run.soft_positions[-1]
    assert np.abs(found[True] - found[False]).max() < (1e-15 if stepper == "quasi_static" else 2e-6) * 0.06
    assert np.abs(found[True] - body.mesh.vertices).max() > 5e-4, "it bends"


def test_without_constants_there_is_no_damping() -> None:
    scene, _ = beam()
    assert bound(scene).damping is None
    assert bound(beam(material=replace(RUBBER, rayleigh_mass=1.0))[0]).damping.viscous == ()


@pytest.mark.parametrize(
    ("name", "off"), [("implicit_euler", 1e-6), ("bdf2", 1e-6), ("imex", 0.05), ("explicit", 1e-5)]
)
def test_a_fall_against_drag_reaches_its_final_speed(name: str, off: float) -> None:
    scene = Scene(gravity=(0.0, 0.0, -9.81))
    scene.add_soft(box_mesh((0.02, 0.02, 0.02), (1, 1, 1)), replace(RUBBER, rayleigh_mass=40.0))
    speeds: list[float] = []
    found = simulate(scene, duration=0.4, time_step=2e-3, stepper=made(name),
                     watch=lambda system, state: speeds.append(float(state.velocities[:, 2].mean())))
    assert found.status == "ok", found.reason
    assert speeds[-1] == pytest.approx(-9.81 / 40.0, rel=off)


# -- derivatives -------------------------------------------------------------------------------------------------------


def strained(element: str, formula: Any) -> tuple[System, StepDamping, np.ndarray]:
    """Return a damped body, its damping over a step out of two strained and turned states, and a third one."""
    rng = np.random.default_rng(3)
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    mesh = box_mesh((0.02, 0.01, 0.015), (2, 1, 1), element)
    scene.add_soft(mesh, replace(RUBBER, rayleigh_mass=7.0, rayleigh_stiffness=3e-3))
    system = bound(scene)
    places = [
        (mesh.vertices + 4e-4 * rng.standard_normal(mesh.vertices.shape)) @ rotation_matrix(angle).T
        for angle in np.array([[0.1, -0.4, 0.2], [0.3, -0.5, 0.4], [0.6, -0.4, 0.7]])
    ]
    start = system.initial_state()
    before = replace(start, positions=places[0])
    state = replace(start, positions=places[1], time=3e-3, previous=before)
    past: Past = formula(system, state, 2e-3)
    return system, system.damping.over(state, past), places[2]


@pytest.mark.kernel
@pytest.mark.parametrize("element", ["hex8", "tet4", "wedge6", "hex20", "tet10"])
@pytest.mark.parametrize("formula", [euler_past, bdf2_past])
def test_gradient_and_hessian_are_those_of_the_energy(element: str, formula: Any) -> None:
    system, damping, x = strained(element, formula)
    gradient, blocks = np.zeros_like(x), np.zeros_like(system.derivatives.blocks)
    assert damping.add_gradient(x, gradient) == pytest.approx(damping.energy(x), rel=1e-12)
    damping.add_hessian(x, blocks)
    matrix, projected = system.pattern.matrix(blocks), np.zeros_like(blocks)
    rng = np.random.default_rng(5)
    for _ in range(4):
        way, eps = rng.standard_normal(x.shape), 1e-7
        ahead, behind = np.zeros_like(x), np.zeros_like(x)
        slope = (damping.add_gradient(x + eps * way, ahead) - damping.add_gradient(x - eps * way, behind)) / (2 * eps)
        assert slope == pytest.approx(np.vdot(gradient, way), rel=1e-6)
        bend = (ahead - behind) / (2 * eps)
        assert np.abs(bend.ravel() - matrix @ way.ravel()).max() < 1e-6 * np.abs(bend).max()
    damping.add_hessian(x, projected, projected=True)
    values = np.linalg.eigvalsh(system.pattern.matrix(projected).toarray())
    assert values[0] > -1e-9 * values[-1]
    off = np.linalg.norm((system.pattern.matrix(projected) - matrix).toarray()) / np.linalg.norm(matrix.toarray())
    assert 0 < off < 0.5, "the projected one differs by what is of the order of the viscous stress"


@pytest.mark.kernel
def test_local_shapes_do_not_feel_rigid_motion() -> None:
    mesh = box_mesh((0.02, 0.01, 0.015), (2, 1, 1), "hex8")
    nodes = np.asarray(mesh.blocks["hex8"])
    gradients = damping_module.rest_elements("hex8", mesh.vertices[nodes], RUBBER.lame).gradients
    bent = mesh.vertices + 1e-3 * np.sin(300.0 * mesh.vertices[:, ::-1])
    block = ViscousBlock(nodes, gradients, np.arange(len(nodes)), np.zeros((len(nodes), 24, 24)))
    here = block.shapes(bent)
    moved = block.shapes(bent @ rotation_matrix(np.array([2.0, -1.0, 0.3])).T + (0.1, 0.2, -0.3))
    assert np.abs(moved - here).max() < 1e-14
    centred = bent[nodes] - bent[nodes].mean(axis=1, keepdims=True)
    assert np.linalg.norm(here, axis=2) == pytest.approx(np.linalg.norm(centred, axis=2), rel=1e-12)


# -- what can be typed -------------------------------------------------------------------------------------------------


def design(**material: Any) -> Design:
    return Design.from_json(designs_folder() / "benchmark.json").with_overrides(
        {f"material.{key}": value for key, value in material.items()}
    )


def test_a_design_file_holds_the_constants_in_its_own_units() -> None:
    damped = design(rayleigh_mass_per_s=2, rayleigh_stiffness_ms=1.5)
    assert damped.material.rayleigh_mass == 2.0 and damped.material.rayleigh_stiffness == 1.5e-3
    assert damped.resolved()["material"]["rayleigh_stiffness_ms"] == 1.5
    assert design().material.rayleigh_mass == design().material.rayleigh_stiffness == 0.0
    schema = Design.json_schema()["properties"]["material"]["properties"]
    assert schema["rayleigh_mass_per_s"]["default"] == 0.0 and schema["rayleigh_stiffness_ms"]["minimum"] == 0
    assert damped.digest() != design().digest()


@pytest.mark.parametrize("value", [-1, "2", True, None, math.nan, 1e9])
@pytest.mark.parametrize("key", ["rayleigh_mass_per_s", "rayleigh_stiffness_ms"])
def test_a_bad_constant_is_refused_in_one_sentence(key: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"material.{key}: must be a number from 0 to ") as refused:
        design(**{key: value})
    assert "\n" not in str(refused.value)


def test_damping_by_the_stiffness_is_refused_where_the_stepper_has_none() -> None:
    message = "material.rayleigh_stiffness_ms: must be 0 with the stepper explicit, which has no damping by the stiff"
    with pytest.raises(InputError, match=message):
        design(rayleigh_stiffness_ms=1).with_overrides({"stepper": "explicit"})
    assert design(rayleigh_mass_per_s=1).with_overrides({"stepper": "explicit"}).material.rayleigh_mass == 1.0
    scene, _ = beam(material=replace(RUBBER, rayleigh_stiffness=1e-3))
    with pytest.raises(InputError, match="must be 0 with the stepper explicit"):
        simulate(scene, duration=0.01, time_step=0.01, stepper="explicit")


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["rayleigh_mass", "rayleigh_stiffness"])
def test_a_scene_refuses_constants_that_make_no_sense(name: str, value: float) -> None:
    scene, _ = beam(material=replace(RUBBER, **{name: value}))
    with pytest.raises(InputError, match=f"material.{name}: must be "):
        simulate(scene, duration=0.01, time_step=0.01)


def test_a_result_says_what_damps() -> None:
    assert effects_of(design())["damping"].startswith("off")
    on = effects_of(design(rayleigh_mass_per_s=2, rayleigh_stiffness_ms=1.5))["damping"]
    assert on.startswith("on") and "2 per s by the mass and 1.5 ms by the stiffness" in on and "implicit_euler" in on
    still = effects_of(design(rayleigh_stiffness_ms=1).with_overrides({"stepper": "quasi_static"}))["damping"]
    assert still.startswith("off") and "quasi_static" in still and "1 ms" in still
    assert json.loads(json.dumps(effects_of(design())))


# -- masses that hang on a body ----------------------------------------------------------------------------------------


def test_a_mass_that_hangs_on_a_body_slows_it_and_weighs_but_is_not_damped() -> None:
    scene, body = beam(material=replace(RUBBER, rayleigh_mass=5.0))
    scene.gravity = np.array([0.0, 0.0, -9.81])
    body.add_mass("xmax", 0.2)
    system, own = bound(scene), 1000.0 * 0.06 * 0.01**2
    assert system.masses.sum() == pytest.approx(own + 0.2, rel=1e-12)
    assert system.forces[:, 2].sum() == pytest.approx(-9.81 * (own + 0.2), rel=1e-12)
    assert system.damping.drag.sum() == pytest.approx(5.0 * own, rel=1e-12)
    for wrong in (-1.0, math.nan, math.inf):
        with pytest.raises(InputError, match="a mass must be at least 0 kg"):
            body.add_mass("xmax", wrong)


def test_a_heavy_tip_swings_as_slowly_as_its_stiffness_says() -> None:
    mass, length, side = 0.05, 0.06, 0.01
    stiffness = 3 * 1e6 * side**4 / 12 / length**3  # 3 EI / L^3
    effective = mass + 33 / 140 * 1000.0 * length * side**2  # Rayleigh's share of the bar's own mass
    quarter = 0.5 * math.pi * math.sqrt(effective / stiffness)
    scene, body = beam(elasticity="linear", material=replace(RUBBER, poisson_ratio=0.0))
    body.add_mass("xmax", mass)
    tip = body.vertices("xmax")
    body.loads[tip, 2] = 1e-5 / len(tip)
    found = simulate(scene, duration=3 * quarter, time_step=quarter / 100, stepper=made("bdf2"), record=True)
    moves = found.soft_positions[:, tip, 2].mean(axis=1)
    moves = moves - moves[0]
    top = int(np.argmax(moves))
    assert found.times[top] == pytest.approx(2 * quarter, rel=0.03)
    assert moves[top] == pytest.approx(2 * 1e-5 / stiffness, rel=0.05)
