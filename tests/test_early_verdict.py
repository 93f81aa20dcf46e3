"""A verdict that comes early: what is certain, what is not, and that a grasp ends with the same one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from finqd import registry
from finqd.data import designs_folder
from finqd.design import Design
from finqd.early_verdict import CLEAR, STILL, EarlyVerdict, fastest
from finqd.evaluate import evaluate
from finqd.mechanics.material import Material
from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.scene import Motion, Scene, Shift
from finqd.simulate import simulate

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.4, density=1000.0)
RISE, THRESHOLD = 0.03, 0.01
COARSE = {"mesher.size_mm": 12, "protocol.time_step_ms": 50, "protocol.hold_s": 2.0}


def verdict(**changed) -> EarlyVerdict:
    times = {"lift": 0.1, "hold": 0.5, "end": 1.5}
    return EarlyVerdict(**times, rise=RISE, threshold=THRESHOLD, stepper=registry.create("stepper", "implicit_euler"),
                        **changed)


def settled(kind: str, *, friction: float = 0.6, size: dict | None = None) -> tuple[System, State]:
    """Return a body of 20 mm that has come to rest on a soft block on the floor, and the state at 0.6 s."""
    scene = Scene(friction=friction)
    scene.add_plane()
    block = scene.add_soft(box_mesh((0.04, 0.04, 0.01), (4, 4, 2)), RUBBER, name="block")
    block.drive("zmin", Motion(path=Shift(vector=(0.0, 0.0, 0.001)), duration=0.1))
    shape = {"kind": kind, **(size or {"size_mm": [20, 20, 20]})}
    scene.add_rigid(load_object({"name": "thing", "shape": shape, "mass_g": 20}), position=(0.02, 0.02, 0.0201))
    seen = []
    found = simulate(scene, duration=0.6, time_step=0.02, watch=lambda system, state: seen.append((system, state)))
    assert found.status == "ok", found.reason
    return seen[-1]


def frames(system: System, state: State, *, drop: float) -> dict[str, list]:
    """Return what has been recorded if the object had dropped by ``drop`` [m] since the lift."""
    end = state.rigid_positions
    begin = end + np.array([0.0, 0.0, drop - RISE])
    return {"times": [0.1, state.time], "rigid_positions": [begin, end], "soft_centres": [np.zeros((1, 3))] * 2}


@pytest.fixture(scope="module")
def box() -> tuple[System, State]:
    return settled("box")


def test_what_rests_in_a_stable_equilibrium_is_decided_held_or_lost(box):
    system, state = box
    for drop in (0.0, 2 * THRESHOLD):
        assert "stable equilibrium" in verdict()(system, state, frames(system, state, drop=drop))


def test_near_the_threshold_during_the_lift_and_at_the_end_nothing_is_decided(box):
    system, state = box
    for drop in (THRESHOLD - 0.9 * CLEAR, THRESHOLD + 0.9 * CLEAR):
        assert not verdict()(system, state, frames(system, state, drop=drop))
    rest = frames(system, state, drop=0.0)
    early, late = (EarlyVerdict(lift=0.1, hold=hold, end=end, rise=RISE, threshold=THRESHOLD, stepper=verdict().stepper)
                   for hold, end in ((0.7, 1.5), (0.5, state.time)))
    assert not early(system, state, rest) and not late(system, state, rest)


def test_what_moves_or_is_still_driven_is_not_decided(box):
    system, state = box
    rest = frames(system, state, drop=0.0)
    speed = 1.1 * STILL / (1.5 - state.time)
    for name, shape in (("velocities", state.velocities.shape), ("rigid_velocities", (1, 3))):
        moving = np.zeros(shape)
        moving[0, 0] = speed
        assert not verdict()(system, replace(state, **{name: moving}), rest)
    spin = system.world_inertias(state.rigid_rotations)[0] @ np.array([0.0, 0.0, speed / system.rigid_sizes[0]])
    assert not verdict()(system, replace(state, angular_momenta=spin[None]), rest)
    driven = replace(state, progress=np.array([0.5]), previous=replace(state.previous, progress=np.array([0.4])))
    assert not verdict()(system, driven, rest)


def test_a_ball_that_may_roll_away_is_not_decided():
    """On a flat block, without friction, nothing holds it sideways; a box stands even so, but may slide."""
    system, state = settled("sphere", friction=0.0, size={"diameter_mm": 20})
    assert not verdict()(system, state, frames(system, state, drop=0.0))


def test_what_has_fallen_and_lies_free_is_decided_by_its_energy():
    scene = Scene()
    scene.add_plane()
    above = np.eye(4)
    above[2, 3] = 0.05
    scene.add_soft(box_mesh((0.01, 0.01, 0.01), (1, 1, 1)).transformed(above), RUBBER, name="far").fix("xmin")
    ball = load_object({"name": "ball", "shape": {"kind": "sphere", "diameter_mm": 20}, "mass_g": 20})
    scene.add_rigid(ball, position=(0.1, 0.0, 0.01), velocity=(0.05, 0.0, 0.0))
    seen = []
    simulate(scene, duration=0.6, time_step=0.02, watch=lambda system, state: seen.append((system, state)))
    system, state = seen[-1]
    assert fastest(system, state) * 0.9 > STILL, "it rolls, or this says nothing"
    assert "lies free" in verdict()(system, state, frames(system, state, drop=2.1 * THRESHOLD))
    assert not verdict()(system, state, frames(system, state, drop=1.9 * THRESHOLD))
    high = np.sqrt(2 * 9.81 * 1.2 * THRESHOLD)
    thrown = replace(state, rigid_velocities=np.array([[0.0, 0.0, high]]))
    assert system.kinetic_energy(thrown) == pytest.approx(0.02 * 9.81 * 1.2 * THRESHOLD, rel=1e-2)
    assert not verdict()(system, thrown, frames(system, state, drop=2.1 * THRESHOLD))


def test_a_grasp_ends_early_with_the_verdict_of_the_whole():
    design = Design.from_json(designs_folder() / "benchmark.json")
    rows, said = [], []
    for early in (True, False):
        changed = {**COARSE, "protocol.early_verdict": early}
        rows.append(evaluate(design, objects=["cylinder"], preset="draft", overrides=changed).to_dict())
        said.append(rows[-1]["reductions"]["early_verdict"][:3])
    assert said == ["on:", "off"]
    row, whole = (result["objects"]["cylinder"] for result in rows)
    assert row["ended"] and not whole["ended"]
    assert row["simulated_s"] < whole["simulated_s"] - 0.5
    assert row["held"] == whole["held"]
    assert row["drop_mm"] == pytest.approx(whole["drop_mm"], abs=0.01)
    assert sum(row["final_contact_force_N"]) == pytest.approx(sum(whole["final_contact_force_N"]), rel=1e-3)
