"""Contact and friction: derivatives against finite differences, balance of forces, Coulomb's cone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from finqd.mechanics.contact_rows import FrictionBounds
from finqd.mechanics.distance_kernels import signed_distance
from finqd.mechanics.material import Material
from finqd.mechanics.rotation_kernels import rotation_matrix
from finqd.mechanics.rounding import rounded_field
from finqd.mechanics.state import Direction, State
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.plugins.contact_penalty import Penalty
from finqd.scene import Scene
from finqd.simulate import simulate
from finqd.units import MM

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.45, density=1000.0)
SIZE = np.array([20.0, 20.0, 10.0]) * MM
DEPTH = 0.3 * MM  # how deep bodies overlap

SPHERE = {"kind": "sphere", "diameter_mm": 40}
CYLINDER = {"kind": "revolution", "profile_mm": [[0, -20], [18, -20], [18, 20], [0, 20]]}
BRICK = {"kind": "box", "size_mm": [20, 16, 12]}
TETRAHEDRON = {
    "kind": "polyhedron", "vertices_mm": [[0, 0, -8], [20, 0, 8], [-10, 17, 8], [-10, -17, 8]],
    "faces": [[1, 2, 3], [0, 2, 1], [0, 3, 2], [0, 1, 3]],
}  # fmt: skip

#: shape, rotation vector [rad], element of the soft box (None: a plane instead)
CASES: dict[str, tuple[dict[str, Any], tuple[float, float, float], str | None]] = {
    "ball on soft": (SPHERE, (0.3, 0.2, 0.1), "hex8"),
    "ball on quadratic soft": (SPHERE, (0.3, 0.2, 0.1), "tet10"),
    "lying cylinder on soft": (CYLINDER, (np.pi / 2, 0.0, 0.0), "hex8"),
    "rim of a cylinder on soft": (CYLINDER, (0.6, 0.1, 0.0), "tet4"),
    "corner of a tetrahedron on soft": (TETRAHEDRON, (0.05, -0.08, 0.2), "hex8"),
    "edge of a brick on soft": (BRICK, (0.7, 0.0, 0.3), "wedge6"),
    "corner of a brick on quadratic soft": (BRICK, (0.7, 0.6, 0.3), "tet10"),
    "ball on a plane": (SPHERE, (0.3, 0.2, 0.1), None),
    "brick on a plane": (BRICK, (0.002, -0.003, 0.1), None),
}


def make(case: str, *, friction: float = 0.6) -> System:
    """Return a rigid body that sinks DEPTH into the top of a soft box, or into a plane."""
    shape, turn, element = CASES[case]
    scene = Scene(friction=friction)
    top = 0.0
    if element is None:
        scene.add_plane()
    else:
        top = SIZE[2]
        scene.add_soft(box_mesh(SIZE, (3, 3, 2), element), RUBBER)
    rigid = load_object({"name": "body", "shape": shape, "mass_g": 50})
    rotation = rotation_matrix(np.array(turn))
    lowest = -rigid.ball_radius or float((rigid.vertices @ rotation.T)[:, 2].min())
    middle = SIZE / 2 + (0.7 * MM, 0.4 * MM, 0.0)
    if case.startswith(("rim", "corner", "edge")):
        tip = rigid.vertices[np.argmin((rigid.vertices @ rotation.T)[:, 2])]
        middle = middle - np.array([1.0, 1.0, 0.0]) * (rotation @ tip)
        lowest += signed_distance(rounded_field(rigid, Penalty().edge_radius_mm * MM), *tip)[0]
    scene.add_rigid(rigid, position=(middle[0], middle[1], top - lowest - DEPTH), rotation=rotation)
    return System(scene, contact=Penalty())


def direction(system: System, seed: int, *, shift: float, turn: float) -> Direction:
    """Return a random change of all unknowns, of about ``shift`` [m] and ``turn`` [rad]."""
    rng = np.random.default_rng(seed)
    rigid = rng.normal(size=(system.n_rigid, 6)) * np.array([shift] * 3 + [turn] * 3)
    return Direction(soft=shift * rng.normal(size=(system.n_vertices, 3)), rigid=rigid)


def contacting(system: System) -> State:
    """Return a dented state, sheared a little since contact history began, so that some contacts stick, some slip."""
    start = system.initial_state().moved(direction(system, 1, shift=1e-5, turn=2e-4))
    system.contact.begin_step(start)
    shear = np.array([[4e-5, 2e-5, -1e-5, 1e-3, -1e-3, 2e-3]])
    away = direction(system, 2, shift=4e-6, turn=1e-4)
    return start.moved(Direction(soft=away.soft, rigid=away.rigid + shear))


def gradient(system: System, state: State) -> tuple[np.ndarray, np.ndarray]:
    system.derivatives.clear_gradient()
    energy = system.contact.add_gradient(state, system.derivatives)
    assert np.isclose(energy, system.contact.energy(replace(state)), rtol=1e-12)
    return system.derivatives.soft.copy(), system.derivatives.rigid.copy()


def hessian(system: System, state: State, *, projected: bool = False) -> np.ndarray:
    """Return the contact Hessian as one dense matrix, soft unknowns first."""
    d = system.derivatives
    d.clear_hessian()
    system.contact.add_hessian(state, d, projected=projected)
    soft = system.pattern.matrix(d.blocks).toarray() if system.n_vertices else np.zeros((0, 0))
    return np.block([[soft, d.coupling], [d.coupling.T, d.rigid_matrix]])


def flat(soft: np.ndarray, rigid: np.ndarray) -> np.ndarray:
    return np.concatenate([soft.ravel(), rigid.ravel()])


def hessian_error(system: System, state: State, matrix: np.ndarray) -> float:
    """Return how far ``matrix`` is from differences of the gradient, relative to their largest, soft and rigid apart.

    The gradient of a turned body is one with respect to spins of the turned body; that adds v x torque / 2.
    """
    worst, n = 0.0, 3 * system.n_vertices
    torque = gradient(system, state)[1][:, 3:]
    for seed in (5, 6, 7):
        move, h = direction(system, seed, shift=1e-4, turn=1e-2), 5e-5
        plus, minus = gradient(system, state.moved(move, h)), gradient(system, state.moved(move, -h))
        found = (flat(*plus) - flat(*minus)) / (2 * h)
        extra = np.zeros((system.n_rigid, 6))
        extra[:, 3:] = 0.5 * np.cross(move.rigid[:, 3:], torque)
        expected = matrix @ flat(move.soft, move.rigid) + flat(np.zeros((system.n_vertices, 3)), extra)
        parts = [slice(0, n)] * bool(n) + [slice(n, n + 3), slice(n + 3, n + 6)]
        for part in parts:
            size = np.abs(found[part]).max()
            assert size > 0.0
            worst = max(worst, float(np.abs(found[part] - expected[part]).max() / size))
    return worst


@pytest.fixture(params=list(CASES))
def case(request: pytest.FixtureRequest) -> str:
    return request.param


def test_gradient_is_that_of_the_energy(case: str) -> None:
    system = make(case)
    state = contacting(system)
    soft, rigid = gradient(system, state)
    assert np.abs(rigid).max() > 0.0
    assert not system.n_vertices or np.abs(soft).max() > 0.0
    for seed in (3, 4):
        move, h = direction(system, seed, shift=1e-4, turn=1e-2), 1e-4
        change = system.contact.energy(state.moved(move, h)) - system.contact.energy(state.moved(move, -h))
        slope = np.vdot(soft, move.soft) + np.vdot(rigid, move.rigid)
        assert abs(slope) > 0.0
        assert change / (2 * h) == pytest.approx(slope, rel=1e-5)


def test_hessian_is_that_of_the_gradient(case: str) -> None:
    system = make(case)
    state = contacting(system)
    system.contact.rows.curve[:] = np.nan  # what other contacts left there must not matter
    assert hessian_error(system, state, hessian(system, state)) < 2e-5


@pytest.mark.parametrize("turning", ["lying cylinder on soft", "corner of a tetrahedron on soft", "brick on a plane"])
def test_hessian_without_what_turning_does_is_found_out(turning: str) -> None:
    system = make(turning)
    state = contacting(system)
    assert hessian_error(system, state, hessian(system, state, projected=True)) > 2e-4


def test_projected_hessian_is_positive_semidefinite(case: str) -> None:
    system = make(case)
    matrix = hessian(system, contacting(system), projected=True)
    assert np.allclose(matrix, matrix.T, rtol=1e-12, atol=1e-9 * np.abs(matrix).max())
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))  # metres and radians
    scale[np.diag(matrix) == 0.0] = 0.0
    values = np.linalg.eigvalsh(scale[:, None] * matrix * scale)
    assert values[-1] > 0.1
    assert values[0] > -1e-9 * values[-1]


def test_contacts_stick_and_slip_in_these_states() -> None:
    """The states above exercise both branches of friction."""
    system = make("ball on soft")
    state = contacting(system)
    friction = system.contact.friction
    pull = friction.stiffness * np.linalg.norm(system.contact._trial_slips(state), axis=1)
    assert np.any(pull > friction.bound) and np.any(pull < friction.bound)


@pytest.mark.parametrize("pair", [name for name, (_, _, element) in CASES.items() if element])
def test_action_is_reaction(pair: str) -> None:
    system = make(pair)
    soft, rigid = gradient(system, contacting(system))
    total = soft.sum(axis=0) + rigid[:, :3].sum(axis=0)
    assert np.abs(rigid[:, :3]).max() > 0.01  # [N]
    assert np.abs(total).max() < 1e-12 * np.abs(soft).sum()


def test_moments_balance_without_friction() -> None:
    system = make("ball on soft", friction=0.0)
    state = contacting(system)
    soft, rigid = gradient(system, state)
    moments = np.cross(state.positions, soft)
    torque = moments.sum(axis=0) + rigid[0, 3:] + np.cross(state.rigid_positions[0], rigid[0, :3])
    assert np.abs(torque).max() < 1e-12 * np.abs(moments).sum()


def test_friction_never_leaves_coulombs_cone() -> None:
    """A soft block that is thrown over a plane, and a ball on it: sliding, sticking, and never more than mu N."""
    scene = Scene(friction=0.5)
    block = scene.add_soft(box_mesh(SIZE, (3, 3, 2)), RUBBER, velocity=(0.3, 0.1, 0.0))
    block.start_positions[:, 2] -= 0.005 * MM
    scene.add_plane()
    ball = load_object({"name": "ball", "shape": {"kind": "sphere", "diameter_mm": 10}, "mass_g": 5})
    scene.add_rigid(ball, position=(*SIZE[:2] / 2, SIZE[2] + 5 * MM), velocity=(0.3, 0.1, 0.0))
    on_cone, inside = [], []

    def watch(system: System, state: State) -> None:
        friction, contact = system.contact.friction, system.contact
        slips = contact.slips.at(friction.key)
        pull = friction.stiffness * np.linalg.norm(slips, axis=1)
        assert np.all(pull <= friction.bound * (1 + 1e-12))
        turned = np.where(
            (friction.rigid >= 0)[:, None], slips @ state.rigid_rotations[0].T, slips
        )  # stored in the frame of the rigid body
        assert np.all(np.abs(np.sum(turned * friction.normal, axis=1)) <= 1e-3 * np.linalg.norm(turned, axis=1) + 1e-15)
        on_cone.append(np.sum(pull > 0.999 * friction.bound))
        inside.append(np.sum(pull < 0.9 * friction.bound))

    trajectory = simulate(scene, duration=0.15, time_step=0.005, watch=watch)
    assert trajectory.status == "ok", trajectory.reason
    assert max(on_cone) > 10 and max(inside) > 10


def test_renewing_friction_bounds_comes_to_rest_where_full_renewals_swing() -> None:
    """A wedge in which friction carries as much as it takes from the normal force: bounds = c - A bounds."""
    bounds = FrictionBounds()
    generator, size = np.random.default_rng(5), 200
    rate, target = generator.uniform(0.9, 1.1, size), generator.uniform(0.5, 1.0, size)
    fixed, keys = target / (1.0 + rate), np.arange(size)

    def renew(count: int) -> float:
        bounds.begin()
        bounds.renew(keys, np.zeros(size), whole=True)
        for _ in range(count):
            bounds.renew(keys, target - rate * bounds.values.at(keys), whole=False)
            assert bounds.values.values.min() >= 0.0
        return float(np.max(np.abs(bounds.values.at(keys) - fixed)))

    assert renew(1) > 0.4 and renew(6) < 0.01
    plain = np.zeros(size)
    for _ in range(6):
        plain = target - rate * plain
    assert np.max(np.abs(plain - fixed)) > 0.2  # what full renewals leave
