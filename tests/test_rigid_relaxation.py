"""Rigid bodies alone: the same motion for fewer matrices, and hands off what a soft body touches."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.mechanics import newton
from finqd.mechanics.incremental import Increment, euler_past
from finqd.mechanics.material import Material
from finqd.mechanics.rigid_relaxation import rigid_move, untouched
from finqd.mechanics.rotation_kernels import rotation_matrix
from finqd.mechanics.state import Direction
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.plugins.contact_penalty import Penalty
from finqd.scene import Scene
from finqd.simulate import simulate

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.45, density=1000.0)
ASIDE = np.array([[1.0, 0.0, 0.0, 0.2], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.05], [0.0, 0.0, 0.0, 1.0]])


def tumbling(friction: float) -> Scene:
    """Return a tetrahedron that falls on a floor, tips and comes to rest, beside a soft beam that sags."""
    scene = Scene(friction=friction)
    scene.add_plane()
    beam = scene.add_soft(box_mesh((0.06, 0.02, 0.02), (6, 2, 2), "hex8").transformed(ASIDE), RUBBER)
    beam.fix("xmin")
    scene.add_rigid(
        load_object("triangle"), position=(0.0, 0.0, 0.05), rotation=rotation_matrix(np.array([0.7, 0.4, 0.0])),
        angular_velocity=(3.0, -2.0, 1.0),
    )
    return scene


@pytest.mark.parametrize("friction, share", [(0.0, 1e-4), (0.6, 1e-2)])  # bounds of friction lag, and so differently
def test_a_body_that_tumbles_costs_soft_ones_no_matrices(
    friction: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = simulate(tumbling(friction), duration=0.3, time_step=0.01)
    monkeypatch.setattr(newton, "RELAXATIONS", 0)
    together = simulate(tumbling(friction), duration=0.3, time_step=0.01)
    assert alone.status == together.status == "ok"
    assert together.counters["rigid_iterations"] == 0 < alone.counters["rigid_iterations"]
    assert alone.counters["factorisations"] < 0.5 * together.counters["factorisations"]
    fall = abs(np.ptp(together.rigid_positions[:, 0, 2]))
    assert np.abs(alone.rigid_positions - together.rigid_positions).max() < share * fall
    assert np.abs(alone.rigid_rotations - together.rigid_rotations).max() < 2.0 * share


@pytest.mark.parametrize("height, touches", [(0.0, True), (0.01, False)])
def test_a_body_on_a_soft_one_is_left_alone(height: float, touches: bool) -> None:
    scene = Scene()
    pad = scene.add_soft(box_mesh((0.06, 0.06, 0.01), (6, 6, 1), "hex8"), RUBBER)
    pad.fix("zmin")
    brick = load_object({"name": "brick", "shape": {"kind": "box", "size_mm": [30, 30, 20]}, "mass_g": 50})
    scene.add_rigid(brick, position=(0.03, 0.03, 0.01 + 0.00999 + height))
    system = System(scene, contact=Penalty())
    state = system.initial_state()
    system.contact.begin_step(state)
    increment = Increment(system, state, 0.01, euler_past(system, state, 0.01))
    increment.gradient(state)
    free = untouched(increment, state)
    move = rigid_move(system, free, least=1e-6)
    assert free[0] == (not touches) and (move is None) == touches
    if move is not None:  # it falls: one move ends it, as inertia is all there is
        energy = increment.gradient(state)
        moved = state.moved(Direction(soft=np.zeros_like(state.positions), rigid=move))
        assert moved.positions is state.positions and increment.gradient(moved) < energy
        assert system.rigid_residual() < 1e-9 and move[0, 2] == pytest.approx(-9.81 * 0.01**2, rel=1e-2)
