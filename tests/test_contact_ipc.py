"""Contact model ipc: derivatives against finite differences, Coulomb's law, rest, and that nothing ever intersects."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from finqd.errors import InputError
from finqd.mechanics.ipc_barrier import HALF_GAP, barrier
from finqd.mechanics.ipc_points import Points
from finqd.mechanics.ipc_surface import toolkit
from finqd.mechanics.material import Material
from finqd.mechanics.rotation_kernels import rotation_matrix
from finqd.mechanics.state import Direction, State
from finqd.mechanics.system import System
from finqd.mesh import Mesh
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.plugins.contact_ipc import Ipc
from finqd.scene import Motion, Scene, Shift
from finqd.simulate import simulate
from finqd.units import MM

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.45, density=1000.0)
SIZE = np.array([20.0, 20.0, 10.0]) * MM
GAP = 0.05 * MM  # of bodies that touch in tests of derivatives: half of what the barrier reaches

BRICK = {"kind": "box", "size_mm": [10, 8, 6]}
BALL = {"kind": "sphere", "diameter_mm": 12}
CASES = ("soft on soft", "rigid on soft", "quadratic soft", "rigid on rigid", "rigid on plane", "ball on plane",
         "soft on plane")  # fmt: skip


def box(scene: Scene, place, *, element: str = "hex8", cells=(2, 2, 1), size=SIZE, turn: float = 0.0, **options):
    """Add a soft box whose lowest corner is at ``place`` [m], turned about its middle axis."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(np.array([0.0, 0.0, turn]))
    pose[:3, 3] = np.asarray(place) + 0.5 * size - pose[:3, :3] @ (0.5 * size)
    return scene.add_soft(box_mesh(size, cells, element).transformed(pose), RUBBER, **options)


def thing(shape: dict, mass_g: float = 20.0):
    return load_object({"name": "thing", "shape": shape, "mass_g": mass_g})


def touching(case: str, *, friction: float = 0.6) -> System:
    """Return two bodies, `GAP` apart and askew."""
    scene = Scene(friction=friction)
    tilt = rotation_matrix(np.array([0.003, -0.002, 0.4]))
    if case.endswith("plane"):
        scene.add_plane(normal=(0.001, 0.002, 1.0))
    elif case.endswith("rigid"):
        scene.add_rigid(thing(BRICK), position=(0.0, 0.0, -3.0 * MM), rotation=tilt, name="lower")
    else:
        element = "tet10" if case.startswith("quadratic") else "hex8"
        box(scene, (-10.0 * MM, -10.0 * MM, -10.0 * MM), element=element)
    if case.startswith("soft"):
        box(scene, (-8.0 * MM, -9.0 * MM, -GAP if case.endswith("plane") else GAP), turn=0.3)
    else:
        shape = thing(BALL if case.startswith("ball") else BRICK)
        lowest = -shape.ball_radius or (shape.vertices @ tilt.T)[:, 2].min()
        height = -GAP if case.endswith("plane") else GAP + 20e-6
        scene.add_rigid(shape, position=(1.0 * MM, 2.0 * MM, height - lowest), rotation=tilt)
    return System(scene, contact=Ipc())


def shaken(system: System, seed: int, size: float) -> Direction:
    """Return a random change of all unknowns by about ``size`` [m]."""
    rng = np.random.default_rng(seed)
    rigid = rng.normal(size=(system.n_rigid, 6)) * np.array([1.0] * 3 + [100.0] * 3)
    return Direction(soft=size * rng.normal(size=(system.n_vertices, 3)), rigid=size * rigid)


def slipping(system: System) -> State:
    """Return a state that has slipped since contact began, less than to full friction in places."""
    start = system.initial_state()
    system.contact.begin_step(start)
    away = shaken(system, 1, 4e-7)
    return start.moved(away)


def gradient(system: System, state: State) -> np.ndarray:
    system.derivatives.clear_gradient()
    system.contact.add_gradient(state, system.derivatives)
    return np.concatenate([system.derivatives.soft.ravel(), system.derivatives.rigid.ravel()])


def hessian(system: System, state: State, *, projected: bool = False) -> np.ndarray:
    system.find_couplings(state)
    d = system.derivatives
    d.clear_hessian()
    system.contact.add_hessian(state, d, projected=projected)
    soft = system.pattern.matrix(d.blocks).toarray() if system.n_vertices else np.zeros((0, 0))
    return np.block([[soft, d.coupling], [d.coupling.T, d.rigid_matrix]])


def differences(system: System, state: State, seed: int, size: float = 1e-9):
    """Return the slope of the energy along a random direction, of its gradient, and the direction.

    Torques are those of left rotations at each end; in coordinates about ``state`` they are T^T times as large, with
    the left Jacobian T = I + [phi]x / 2 to first order.
    """
    way = shaken(system, seed, 1.0)
    ends = [state.moved(way, share) for share in (size, -size)]
    energies = [system.contact.energy(end) for end in ends]
    gradients = [gradient(system, end) for end in ends]
    vector = np.concatenate([way.soft.ravel(), way.rigid.ravel()])
    turn = (gradients[0] - gradients[1]) / (2 * size)
    torques = gradient(system, state)[way.soft.size :].reshape(-1, 6)[:, 3:]
    turn[way.soft.size :].reshape(-1, 6)[:, 3:] -= 0.5 * np.cross(way.rigid[:, 3:], torques)
    return (energies[0] - energies[1]) / (2 * size), turn, vector


@pytest.mark.parametrize("friction", [0.0, 0.6])
@pytest.mark.parametrize("case", CASES)
def test_gradient_is_of_the_energy(case, friction):
    system = touching(case, friction=friction)
    state = slipping(system)
    given = gradient(system, state)
    assert np.abs(given).max() > 1e-3
    for seed in range(3, 6):
        slope, _, way = differences(system, state, seed)
        assert slope == pytest.approx(float(given @ way), rel=1e-5, abs=1e-5 * np.linalg.norm(given))


@pytest.mark.parametrize("friction", [0.0, 0.6])
@pytest.mark.parametrize("case", CASES)
def test_hessian_is_of_the_gradient(case, friction):
    system = touching(case, friction=friction)
    state = slipping(system)
    matrix = hessian(system, state)
    assert np.abs(matrix).max() > 1.0
    assert_hessian(system, state, matrix)
    eigenvalues = np.linalg.eigvalsh(hessian(system, state, projected=True))
    assert eigenvalues[0] > -1e-9 * eigenvalues[-1]


def assert_hessian(system: System, state: State, matrix: np.ndarray) -> None:
    for seed in range(3, 6):
        _, turn, way = differences(system, state, seed, 1e-10)
        assert np.abs(matrix @ way - turn).max() < 1e-4 * np.abs(turn).max()


def assert_turns_bend() -> None:
    """Forces that do not change, on points of a rigid body: all second derivatives are those of the rotation."""
    system = touching("rigid on soft")
    state, d, points = system.initial_state(), system.derivatives, system.contact.points
    forces = np.random.default_rng(7).normal(size=(len(points.soft), 3)) * (points.soft < 0)[:, None]
    d.clear_hessian()
    points.add_curvature(state, forces, d)
    assert np.abs(d.rigid_matrix).max() > 1e-3
    for seed in range(3):
        turn = Direction(soft=np.zeros((system.n_vertices, 3)), rigid=np.random.default_rng(seed).normal(size=(1, 6)))
        energies = [float(np.vdot(forces, points.at(state.moved(turn, h)))) for h in (1e-3, 0.0, -1e-3)]
        bend = (energies[0] - 2.0 * energies[1] + energies[2]) / 1e-6
        assert turn.rigid[0] @ d.rigid_matrix @ turn.rigid[0] == pytest.approx(bend, rel=1e-4)


def test_turns_bend():
    assert_turns_bend()


def test_a_wrong_sign_of_the_turns_bend_is_noticed(monkeypatch):
    right = Points.add_curvature
    monkeypatch.setattr(Points, "add_curvature", lambda self, state, gradient, d: right(self, state, -gradient, d))
    with pytest.raises(AssertionError):
        assert_turns_bend()


def test_planes_have_the_barrier_of_the_toolkit():
    z = np.array([1e-3, 0.1, 0.25, 0.9, 1.0, 2.0])
    assert barrier(z)[0][:5] == pytest.approx([toolkit().barrier(d, 1.0) for d in z[:5]], rel=1e-12)
    assert barrier(z)[0][5] == 0.0 and np.isinf(barrier(np.array([0.0, -1.0]))[0]).all()
    assert -barrier(np.array([0.25]))[1][0] == pytest.approx(HALF_GAP)


# -- laws --------------------------------------------------------------------------------------------------------------


def run(scene: Scene, *, duration: float, dt: float = 0.01, **options):
    """Simulate with the contact ipc; return the states after every step, and the system."""
    states, systems = [], []

    def watch(system: System, state: State) -> None:
        states.append(state)
        systems.append(system)

    found = simulate(scene, duration=duration, time_step=dt, contact="ipc", watch=watch, **options)
    assert found.status == "ok", found.reason
    return states, systems[-1], found


@pytest.mark.parametrize(("slope", "slides"), [(0.28, False), (0.32, True)])
def test_coulombs_law_on_a_slope(slope, slides):
    down = 9.81 * np.array([slope, 0.0, -1.0]) / np.hypot(slope, 1.0)
    scene = Scene(gravity=down, friction=0.3)
    scene.add_plane()
    scene.add_rigid(thing(BRICK), position=(0.0, 0.0, 3.0 * MM))
    states, _, _ = run(scene, duration=0.3)
    way = np.array([state.rigid_positions[0, 0] for state in states])
    if slides:
        assert states[-1].rigid_velocities[0, 0] == pytest.approx(0.3 * (down[0] + 0.3 * down[2]), rel=0.05)
    else:  # it creeps, as the docstring says, by less than slip_mm a step
        assert np.ptp(way[5:]) < len(way) * 1e-6


def test_a_soft_block_that_is_pulled_sticks_up_to_mu_n():
    ends = {}
    for pull in (0.9, 1.1):
        scene = Scene(friction=0.5)
        box(scene, (0.0, 0.0, -10.0 * MM), name="lower").fix("zmin")
        upper = box(scene, (2.0 * MM, 2.0 * MM, 0.05 * MM), size=0.8 * SIZE, name="upper")
        weight = float(RUBBER.density * np.prod(0.8 * SIZE) * 9.81)
        upper.load(np.arange(upper.mesh.n_vertices), (0.5 * pull * weight, 0.0, 0.0))
        states, _, _ = run(scene, duration=0.2)
        mine = slice(upper.first_vertex, None)
        ends[pull] = states[-1].positions[mine, 0].mean() - states[4].positions[mine, 0].mean()
    assert abs(ends[0.9]) < 20e-6
    assert ends[1.1] > 4.0 * abs(ends[0.9])


def free_of_intersections(system: System, state: State) -> bool:
    contact = system.contact
    vertices = contact.points.at(state)[: contact.surface.n_vertices]
    return not toolkit().has_intersections(contact.surface.mesh, np.asfortranarray(vertices))


@pytest.mark.parametrize("below", ["plane", "ball", "soft"])
def test_what_is_dropped_comes_to_rest(below):
    scene = Scene()
    if below == "plane":
        scene.add_plane()
    elif below == "ball":
        scene.add_rigid(thing({"kind": "sphere", "diameter_mm": 40}), position=(0.0, 0.0, -20.0 * MM), held=True)
    else:
        scene.add_plane(point=(0.0, 0.0, -10.0 * MM))
        box(scene, (-10.0 * MM, -10.0 * MM, -10.0 * MM), name="lower")
    body = box(scene, (-10.0 * MM, -10.0 * MM, 1.0 * MM), name="upper", cells=(4, 4, 2))
    states, system, found = run(scene, duration=0.6)
    mine = slice(body.first_vertex, None)
    heights = [state.positions[mine, 2].mean() - 5.0 * MM for state in states]
    assert -0.4 * MM < heights[-1] < 0.1 * MM
    assert np.ptp(heights[-10:]) < 2e-6
    assert free_of_intersections(system, states[-1])
    assert found.penetrations.max() < 0.1 * MM
    weight = RUBBER.density * np.prod(SIZE) * 9.81
    assert system.contact.soft_forces[-1] == pytest.approx(weight, rel=0.02 if below == "plane" else 0.1)


def test_a_squeeze_ends_without_intersection_and_forces_balance():
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    box(scene, (0.0, 0.0, -10.0 * MM), cells=(3, 3, 2), name="lower").fix("zmin")
    upper = box(scene, (6.0 * MM, 5.0 * MM, 0.3 * MM), cells=(3, 3, 2), size=0.6 * SIZE, name="upper", turn=0.4)
    upper.drive("zmax", Motion(path=Shift(vector=(0.0, 0.0, -3.0 * MM)), duration=0.1))
    states, system, _ = run(scene, duration=0.12)
    assert free_of_intersections(system, states[-1])
    lower, higher = system.contact.soft_forces
    assert lower == pytest.approx(higher) and lower > 5.0
    assert system.contact.penetration == 0.0


# -- what is refused, excluded and repeated ----------------------------------------------------------------------------


def test_bodies_that_start_in_each_other_are_refused_by_name():
    scene = Scene()
    box(scene, (0.0, 0.0, 0.0), name="cushion")
    scene.add_rigid(thing(BRICK), position=(10.0 * MM, 10.0 * MM, 11.0 * MM), name="brick")
    with pytest.raises(InputError, match="'cushion' and 'brick'|'brick' and 'cushion'"):
        Ipc().potential(scene)
    below = Scene()
    below.add_plane(name="floor")
    box(below, (0.0, 0.0, -0.2 * MM), name="cushion")
    with pytest.raises(InputError, match="'cushion' and 'floor'"):
        Ipc().potential(below)


@pytest.mark.parametrize("through", [1.0 * MM, 40.0 * MM])
def test_a_state_behind_a_wall_has_no_finite_energy(through):
    """Neither one that intersects nor one that has passed through as a whole, which no distance shows."""
    system = touching("rigid on soft")
    start = system.initial_state()
    system.contact.begin_step(start)
    way = system.zero_direction()
    way.rigid[0, 2] = -through
    assert np.isfinite(system.contact.energy(start)) and np.isinf(system.contact.energy(start.moved(way)))
    share = system.contact.step_limit(start, way)
    assert 0.0 < share < 1.0 and np.isfinite(system.contact.energy(start.moved(way, share)))
    system.contact.begin_step(start.moved(way, 1.0 * MM / through))
    assert np.isinf(system.contact.energy(start.moved(way, 1.0 * MM / through)))


def test_a_body_that_turns_stops_before_its_arc_meets_something():
    system = touching("rigid on soft")
    start = system.initial_state()
    system.contact.begin_step(start)
    way = system.zero_direction()
    way.rigid[0, 3:] = (2.0, 0.0, 0.0)
    share = system.contact.step_limit(start, way)
    assert 0.0 < share < 0.5
    assert free_of_intersections(system, start.moved(way, share))


def test_parts_that_are_near_at_rest_do_not_feel_each_other():
    one = box_mesh(SIZE, (2, 2, 1))
    lifted = one.vertices + (0.0, 0.0, SIZE[2] + GAP)
    both = {kind: np.concatenate([block, block + one.n_vertices]) for kind, block in one.blocks.items()}
    scene = Scene()
    scene.add_soft(Mesh(np.concatenate([one.vertices, lifted]), both), RUBBER)
    system = System(scene, contact=Ipc())
    system.contact.begin_step(system.initial_state())
    assert system.contact.energy(system.initial_state()) == 0.0


def stacked() -> Scene:
    scene = Scene()
    scene.add_plane()
    box(scene, (0.0, 0.0, 0.0), name="lower")
    tilt = rotation_matrix(np.array([0.02, 0.1, 0.3]))
    scene.add_rigid(thing(BRICK), position=(9.0 * MM, 9.0 * MM, 14.2 * MM), rotation=tilt)
    return scene


def test_the_same_bits_follow_again_and_from_a_checkpoint(tmp_path):
    class Stopped(Exception):
        pass

    def stop(system: System, state: State) -> None:
        if state.time > 0.035:
            raise Stopped

    whole = [run(stacked(), duration=0.08)[0][-1] for _ in range(2)]
    kept = {"checkpoint": tmp_path / "run.npz", "checkpoint_every": 0.0}
    with pytest.raises(Stopped):
        simulate(stacked(), duration=0.08, time_step=0.01, contact="ipc", watch=stop, **kept)
    continued = run(stacked(), duration=0.08, **kept)[0][-1]
    for name in ("positions", "velocities", "rigid_positions", "rigid_rotations", "angular_momenta"):
        first = getattr(whole[0], name).tobytes()
        assert first == getattr(whole[1], name).tobytes() == getattr(continued, name).tobytes(), name


def test_the_toolkit_is_imported_when_it_is_needed():
    code = "import sys, finqd.plugins.contact_ipc as c; c.Ipc(); sys.exit('ipctk' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
