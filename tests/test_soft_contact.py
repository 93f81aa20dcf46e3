"""Contact of soft bodies with each other and themselves: distances, derivatives, laws, and what is near what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from finqd.errors import InputError
from finqd.mechanics import soft_contact_kernels as kernels
from finqd.mechanics.material import Material
from finqd.mechanics.near_faces_kernels import called_watches, gaps_left, relative_moves, same_numbers
from finqd.mechanics.proximity_kernels import closest_on_triangle, faces_gap
from finqd.mechanics.rotation_kernels import rotation_matrix
from finqd.mechanics.soft_contact import SoftContact
from finqd.mechanics.state import Direction, State
from finqd.mechanics.system import System
from finqd.mesh import Mesh
from finqd.mesh_shapes import box_mesh
from finqd.plugins.contact_penalty import Penalty
from finqd.scene import Motion, Scene, Shift
from finqd.simulate import simulate
from finqd.trajectory import Trajectory
from finqd.units import MM

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.4, density=1000.0)
GAP = 0.1 * MM


# -- distances ---------------------------------------------------------------------------------------------------------

#: a point beside a triangle: above its inside, beside an edge, beside a corner, and above an edge of a flat surface
PLACES = {"inside": [0.3, 0.3, 0.4], "edge": [0.5, -0.3, 0.4], "corner": [-0.4, -0.3, 0.4]}
TRIANGLE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.1], [0.0, 1.0, 0.05]])


def distance_and_slope(y: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return distance, its gradient (12,) and the closest point's share, of a point and a triangle ``y`` (4, 3)."""
    share = np.empty(3)
    closest_on_triangle(y[0], y[1], y[2], y[3], share)
    off = y[0] - share @ y[1:]
    size = float(np.linalg.norm(off))
    return size, np.concatenate([off, *(-s * off for s in share)]) / size, share


@pytest.mark.kernel
@pytest.mark.parametrize("place", PLACES)
def test_second_derivative_of_a_distance_is_that_of_differences(place: str) -> None:
    y, h = np.concatenate([[PLACES[place]], TRIANGLE]), 1e-5
    size, slope, share = distance_and_slope(y)
    found, expected = np.empty((12, 12)), np.empty((12, 12))
    kernels.distance_hessian(*y, share, slope[:3], size, found)
    for i, step in enumerate(h * np.eye(12).reshape(12, 4, 3)):
        expected[:, i] = (distance_and_slope(y + step)[1] - distance_and_slope(y - step)[1]) / (2 * h)
    assert np.abs(expected).max() > 0.5
    assert np.abs(found - expected).max() < 1e-8


@pytest.mark.kernel
def test_a_rim_between_triangles_of_one_plane_does_not_bend_the_distance() -> None:
    flat = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    found, above = np.empty((12, 12)), np.array([0.5, 0.0, 0.2])
    kernels.distance_hessian(above, *flat, np.array([0.5, 0.5, 0.0]), np.array([0.0, 0.0, 1.0]), 0.2, found)
    assert np.abs(found[:3, :3]).max() < 1e-12  # moving over the plane changes nothing
    beside = np.empty((12, 12))
    kernels.distance_hessian(above, *flat, np.array([0.5, 0.5, 0.0]), np.array([0.0, -0.6, 0.8]), 0.2, beside)
    assert np.abs(beside[:3, :3]).max() > 1.0  # an edge does


@pytest.mark.kernel
def test_the_closest_point_of_a_triangle_is_closer_than_all_others() -> None:
    generator, share = np.random.default_rng(3), np.empty(3)
    others = generator.dirichlet(np.ones(3), 300)
    for _ in range(60):
        point, corners = generator.normal(size=3), generator.normal(size=(3, 3))
        closest_on_triangle(point, *corners, share)
        assert share.min() >= 0.0 and share.sum() == pytest.approx(1.0, abs=1e-12)
        nearest = np.linalg.norm(point - share @ corners)
        assert nearest <= np.linalg.norm(point - others @ corners, axis=1).min() + 1e-12


@pytest.mark.kernel
def test_the_gap_of_faces_never_exceeds_the_distance_of_their_points() -> None:
    generator = np.random.default_rng(4)
    shares, closest = generator.dirichlet(np.ones(4), 200), []
    for _ in range(100):
        points = generator.normal(size=(8, 3))
        points[4:] += [2.5, 0.5, 0.0]
        a, b = np.array([0, 1, 2, 3]), np.array([4, 5, 6, 7])
        gap = faces_gap(points, a, b, np.inf)
        true = np.linalg.norm((shares @ points[:4])[:, None] - (shares @ points[4:])[None], axis=2).min()
        assert gap <= true
        closest.append(gap / true)
    assert np.median(closest) > 0.3


@pytest.mark.kernel
@pytest.mark.parametrize("distance", [0.02, 0.5, 0.93])
def test_the_barrier_is_smooth_and_repels(distance: float) -> None:
    d, h, k = distance * GAP, 1e-5 * GAP, 1e5
    energy, slope, second = kernels.barrier(d, GAP, k)
    ahead, behind = kernels.barrier(d + h, GAP, k), kernels.barrier(d - h, GAP, k)
    assert energy > 0.0 > slope
    assert (ahead[0] - behind[0]) / (2 * h) == pytest.approx(slope, rel=1e-6)
    assert (ahead[1] - behind[1]) / (2 * h) == pytest.approx(second, rel=1e-6)
    assert kernels.barrier(GAP, GAP, k) == (0.0, 0.0, 0.0)
    assert max(np.abs(kernels.barrier(GAP * (1 - 1e-9), GAP, k)) / (k * np.array([GAP**2, GAP, 1.0]))) < 1e-8
    assert kernels.barrier(0.0, GAP, k)[0] == np.inf


# -- the potential -----------------------------------------------------------------------------------------------------

#: element type, and how the upper box is turned [rad]: a face, an edge, a corner first
TOUCHES = {
    "face": ("hex8", (0.0, 0.0, 0.3)), "edge": ("hex20", (0.7, 0.0, 0.3)), "corner": ("tet10", (0.7, 0.5, 0.2)),
    "wedge": ("wedge6", (0.05, -0.04, 0.4)), "rim": ("tet4", (0.0, 0.6, 0.1)),
}


def two_boxes(case: str, *, friction: float = 0.6) -> System:
    """Return a soft box that nearly touches another one below it, by 0.6 gaps."""
    element, turn = TOUCHES[case]
    scene = Scene(friction=friction)
    scene.add_soft(box_mesh((0.012, 0.012, 0.004), (3, 3, 1), element), RUBBER)
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(np.array(turn))
    upper = box_mesh((0.006, 0.006, 0.004), (2, 2, 1), element).transformed(pose)
    lowest = upper.vertices[np.argmin(upper.vertices[:, 2])]
    pose[:3, 3] = np.array([0.0047, 0.0052, 0.004 + 0.6 * GAP]) - lowest
    pose[:2, 3] += 0.0 if case in ("corner", "edge", "rim") else -0.002
    scene.add_soft(box_mesh((0.006, 0.006, 0.004), (2, 2, 1), element).transformed(pose), RUBBER)
    return System(scene, contact=Penalty(sample_spacing_mm=0.25))


def touching(system: System) -> State:
    """Return a state a little beside the one where contact's history begins: some contacts stick, some slip."""
    generator = np.random.default_rng(2)
    start = system.initial_state()
    shape = start.positions.shape
    start = replace(start, positions=start.positions + 2e-6 * generator.normal(size=shape))
    system.contact.begin_step(start)
    moved = start.positions + 1e-6 * generator.normal(size=shape)
    moved[system.scene.soft_bodies[1].first_vertex :] += [6e-6, 3e-6, -3e-6]
    return replace(start, positions=moved)


def gradient(system: System, state: State) -> np.ndarray:
    system.derivatives.clear_gradient()
    system.contact.add_gradient(state, system.derivatives)
    return system.derivatives.soft.ravel().copy()


def hessian(system: System, state: State, *, projected: bool = False) -> np.ndarray:
    system.find_couplings(state)
    system.derivatives.clear_hessian()
    system.contact.add_hessian(state, system.derivatives, projected=projected)
    return system.pattern.matrix(system.derivatives.blocks).toarray()


@pytest.mark.parametrize("friction", [0.0, 0.6])
@pytest.mark.parametrize("case", TOUCHES)
def test_derivatives_of_soft_contact_are_those_of_differences(case: str, friction: float) -> None:
    system = two_boxes(case, friction=friction)
    state = touching(system)
    soft = system.contact.soft
    exact, h = hessian(system, state), 1e-9
    assert soft.rows.count > 0 and (friction == 0.0) == (len(soft.friction.key) == 0)
    for seed in (5, 6, 7):
        move = np.random.default_rng(seed).normal(size=state.positions.shape)
        ahead, behind = (replace(state, positions=state.positions + s * h * move) for s in (1, -1))
        slope = (system.contact.energy(ahead) - system.contact.energy(behind)) / (2 * h)
        assert gradient(system, state) @ move.ravel() == pytest.approx(slope, rel=1e-5)
        expected = (gradient(system, ahead) - gradient(system, behind)) / (2 * h)
        found = exact @ move.ravel()
        assert np.abs(expected).max() > 0.0
        # a sample whose closest point passes from one piece to the next bends there
        assert np.linalg.norm(found - expected) < 1e-3 * np.linalg.norm(expected)
    assert np.linalg.eigvalsh(hessian(system, state, projected=True))[0] > -1e-9 * np.abs(exact).max()


def test_what_one_body_feels_the_other_feels_too() -> None:
    system = two_boxes("corner")
    forces = gradient(system, touching(system)).reshape(-1, 3)
    upper = system.scene.soft_bodies[1].first_vertex
    assert np.linalg.norm(forces[:upper].sum(axis=0)) > 1e-6
    np.testing.assert_allclose(forces[:upper].sum(axis=0), -forces[upper:].sum(axis=0), rtol=1e-9)
    system.contact.commit(touching(system))
    assert system.contact.soft_forces[0] == pytest.approx(system.contact.soft_forces[1])


def test_switched_off_nothing_is_there() -> None:
    system = two_boxes("face")
    off = System(system.scene, contact=Penalty(soft_contact=False))
    state = touching(system)
    off.contact.begin_step(state)
    assert system.contact.energy(state) > 0.0
    assert off.contact.soft is None and off.contact.energy(state) == 0.0


# -- what is near ------------------------------------------------------------------------------------------------------


@pytest.mark.kernel
def test_a_rigid_motion_brings_no_points_of_one_body_nearer() -> None:
    generator = np.random.default_rng(2)
    reference = generator.normal(size=(20, 3))
    turned = reference @ rotation_matrix(np.array([0.3, -2.0, 1.0])).T + [1.0, -2.0, 0.5]
    moves = np.full((20, 3), np.nan)
    assert relative_moves(turned, reference, 4, 16, True, moves) < 1e-14
    assert np.abs(moves[4:16]).max() < 1e-14 and np.isnan(moves[:4]).all() and np.isnan(moves[16:]).all()
    assert relative_moves(turned, reference, 4, 16, False, moves) > 1.0
    turned[7] += [0.0, 0.2, 0.0]
    assert 0.15 < relative_moves(turned, reference, 4, 16, True, moves) < 0.25
    turned[7, 1] = np.nan
    assert np.isnan(relative_moves(turned, reference, 4, 16, True, moves))


@pytest.mark.kernel
@pytest.mark.parametrize("bodies", [(0, 0), (0, 1)])
def test_faces_are_never_nearer_than_what_is_said_to_be_left(bodies: tuple[int, int]) -> None:
    generator = np.random.default_rng(4)
    spans, faces = np.array([[0, 8], [8, 16]]), np.arange(16).reshape(4, 4)
    listed = np.array([[0, 1], [1, 0]]) if bodies == (0, 0) else np.array([[0, 2], [1, 3], [0, 3]])

    def apart(positions: np.ndarray) -> np.ndarray:
        ends = [positions[faces[listed[:, side]]] for side in (0, 1)]
        return np.linalg.norm(ends[0][:, :, None] - ends[1][:, None], axis=-1).min(axis=(1, 2))

    for size in np.repeat([0.01, 0.1, 1.0], 20):
        reference = generator.normal(size=(16, 3))
        positions = reference + size * generator.normal(size=(16, 3))
        positions[:8] = positions[:8] @ rotation_matrix(generator.normal(size=3) * (bodies == (0, 0))).T
        left, gaps = np.empty(len(listed)), apart(reference)
        fine = left.copy()
        way = gaps_left(positions, reference, spans, *bodies, np.zeros((16, 3)), np.inf, faces, listed, gaps, fine)
        gaps_left(positions, reference, spans, *bodies, np.zeros((16, 3)), gaps[0] - way, faces, listed, gaps, left)
        assert left[0] == gaps[0] - way  # far enough for a rough bound
        assert (left <= apart(positions) + 1e-12).all() and (fine <= apart(positions) + 1e-12).all()
        assert (gaps - way <= apart(positions) + 1e-12).all()


@pytest.mark.kernel
def test_bodies_are_looked_at_when_their_slack_is_used_up_and_when_it_is_unknown() -> None:
    spans, bodies = np.array([[0, 2], [2, 4]]), np.array([[0, 0], [0, 1], [1, 1]])
    last, drift, mark, out = np.zeros((4, 3)), np.zeros(2), np.zeros((3, 2)), np.zeros(3, dtype=np.int64)
    slack, still = np.array([1.0, 1.0, 1.0]), np.zeros((4, 3))

    def called(positions: np.ndarray, direction: np.ndarray = still, *, moved: bool = True, moving: bool = False):
        count = called_watches(positions, moved, direction, moving, spans, last, drift, bodies, slack, mark, out)
        return None if count < 0 else out[:count].tolist()

    moves = still.copy()
    moves[1, 2] = 0.6  # both faces of a body may go as far: twice that is more than the slack, once is not
    assert called(still) == [] and called(still, moves, moving=True) == [0] and called(moves) == [0]
    assert drift.tolist() == [0.6, 0.0] and np.array_equal(last, moves)
    assert called(moves, moves, moved=False, moving=True) == [0, 1]
    assert called(still) == [0, 1] and drift.tolist() == [1.2, 0.0]  # ways add up, there and back
    mark[:] = drift[bodies]
    assert called(still) == []
    assert called(still, np.full((4, 3), np.nan), moving=True) == [0, 1, 2]
    assert called(np.full((4, 3), np.nan)) is None and called(still + 1e4) is None
    assert drift.tolist() == [1.2, 0.0]
    assert same_numbers(still, still.copy()) and not same_numbers(still, moves) and not same_numbers(still, still[:3])


def clip(*, arm: float = 0.02, between: float = 0.002) -> Mesh:
    """Return a U of two arms, ``between`` [m] apart, that a back joins."""
    whole = box_mesh((0.004, arm, 0.004 + between), (2, 10, 3))
    brick = whole.blocks["hex8"]
    middle = whole.vertices[brick].mean(axis=1)
    height = 0.004 + between
    slot = (np.abs(middle[:, 2] - height / 2) < height / 6) & (middle[:, 1] > arm / 10)
    kept = brick[~slot]
    used, nodes = np.unique(kept, return_inverse=True)
    return Mesh(whole.vertices[used], {"hex8": nodes.reshape(kept.shape)})


def test_lists_of_near_faces_lose_nothing_whatever_the_way_there() -> None:
    scene = Scene()
    scene.add_soft(clip(), RUBBER)
    pose = np.eye(4)
    pose[:3, 3] = (0.0, 0.021, 0.0)
    scene.add_soft(clip().transformed(pose), RUBBER)
    system, generator, seen = System(scene, contact=Penalty()), np.random.default_rng(0), []
    rest, half = system.initial_state().positions, scene.soft_bodies[1].first_vertex
    for k in range(40):
        bent = rest.copy()
        arms = np.sign(rest[:, 2] - rest[:, 2].mean())
        bent[:, 2] -= arms * generator.uniform(0.6e-3, 1.1e-3) * ((rest[:, 1] % 0.021) / 0.02) ** 2
        bent[half:, 1] -= generator.uniform(0.8e-3, 1.0e-3)
        bent = bent @ rotation_matrix(generator.normal(size=3) * (k % 3)).T + generator.normal(size=3) * 1e-2
        system.contact.soft.find(bent)
        fresh: SoftContact = System(scene, contact=Penalty()).contact.soft
        fresh.find(bent)
        assert np.array_equal(system.contact.soft.keys, fresh.keys)
        assert np.array_equal(system.contact.soft.forces(), fresh.forces())
        seen.append(fresh.rows.count)
    assert min(seen) < max(seen) and max(seen) > 20


def test_moves_that_were_looked_at_before_they_were_gone_lose_nothing() -> None:
    """Arms that close bit by bit: whole moves, whose ends are known by then, and moves that were cut or not made."""
    scene = Scene()
    scene.add_soft(clip(), RUBBER)
    system, generator, seen = System(scene, contact=Penalty()), np.random.default_rng(5), []
    soft, state = system.contact.soft, system.initial_state()
    rest, share, whole = state.positions, 0.0, 0
    arms = np.sign(rest[:, 2] - rest[:, 2].mean()) * (rest[:, 1] / 0.02) ** 2
    assert not system.contact.soft.rows.count
    for k in range(60):
        share = min(share + generator.uniform(-0.03, 0.1), 1.0)
        goal = rest - np.outer(arms, [0.0, 0.0, share * 1.0e-3]) + 1e-5 * generator.normal(size=rest.shape)
        direction = Direction(soft=goal - state.positions, rigid=np.zeros((0, 6)))
        limit = soft.step_limit(state, direction, 1.0)
        whole += limit == 1.0
        if k % 7 != 3:
            state = state.moved(direction, limit * (0.5 if k % 5 == 4 else 1.0))
        soft.find(state.positions)
        fresh: SoftContact = System(scene, contact=Penalty()).contact.soft
        fresh.find(state.positions)
        assert np.array_equal(soft.keys, fresh.keys)
        assert np.array_equal(soft.forces(), fresh.forces())
        seen.append(fresh.rows.count)
    assert min(seen) == 0 and max(seen) > 20 and 15 < whole < 50


def test_a_move_ends_before_it_goes_through_a_thin_sheet() -> None:
    scene = Scene()
    scene.add_soft(box_mesh((0.02, 0.02, 0.0005), (4, 4, 1)), RUBBER)
    pose = np.eye(4)
    pose[:3, 3] = (0.008, 0.008, 0.005)
    ball = scene.add_soft(box_mesh((0.004, 0.004, 0.004), (2, 2, 2)).transformed(pose), RUBBER)
    system = System(scene, contact=Penalty())
    state = system.initial_state()

    def limit(*move: float) -> float:
        soft = np.zeros_like(state.positions)
        soft[ball.first_vertex :] = move
        return system.contact.step_limit(state, Direction(soft=soft, rigid=np.zeros((0, 6))))

    through = limit(0.0, 0.0, -0.02)
    assert through == pytest.approx(0.9 * 0.0045 / 0.02, rel=0.02)
    assert limit(0.0, 0.0, -0.004) == 1.0 and limit(0.0, 0.0, 0.05) == 1.0
    assert limit(0.05, 0.0, -0.005) == 1.0  # passes the rim
    assert limit(0.05, 0.0, -0.02) < 0.3


def test_thin_walls_and_notches_do_not_push_themselves_at_rest() -> None:
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_soft(clip(between=0.15 * MM), RUBBER)  # nearer than two gaps, which counts as one
    pose = np.eye(4)
    pose[2, 3] = 0.02
    scene.add_soft(box_mesh((0.01, 0.01, 0.00005), (4, 4, 1)).transformed(pose), RUBBER)
    system = System(scene, contact=Penalty())
    state = system.initial_state()
    system.contact.begin_step(state)
    assert system.contact.energy(state) == 0.0


def test_soft_bodies_that_touch_at_the_start_are_refused_by_name() -> None:
    scene = Scene()
    pose = np.eye(4)
    pose[2, 3] = 0.01
    scene.add_soft(box_mesh((0.01, 0.01, 0.01), (2, 2, 2)), RUBBER, name="lower")
    scene.add_soft(box_mesh((0.01, 0.01, 0.01), (2, 2, 2)).transformed(pose), RUBBER, name="upper")
    with pytest.raises(InputError, match="lower and upper: soft bodies must not touch at the start"):
        simulate(scene, duration=0.01, time_step=0.01)


# -- laws --------------------------------------------------------------------------------------------------------------


def collide(*, friction: float, **options) -> tuple[Trajectory, np.ndarray, list[float]]:
    """Throw a soft box at another one, off centre, in free space; return momenta and energies step by step."""
    scene = Scene(gravity=(0.0, 0.0, 0.0), friction=friction)
    scene.add_soft(box_mesh((0.01, 0.01, 0.01), (2, 2, 2)), RUBBER)
    pose = np.eye(4)
    pose[:3, 3] = (0.012, 0.004, 0.003)
    scene.add_soft(box_mesh((0.01, 0.01, 0.01), (2, 2, 2)).transformed(pose), RUBBER, velocity=(-1.0, 0.2, 0.0))
    momenta, energies = [], []

    def watch(system: System, state: State) -> None:
        moved = system.masses[:, None] * state.velocities
        momenta.append(np.concatenate([moved.sum(axis=0), np.cross(state.positions, moved).sum(axis=0)]))
        energies.append(system.energy(state) + 0.5 * np.vdot(moved, state.velocities))

    found = simulate(scene, duration=0.01, time_step=2e-4, watch=watch, record=True, **options)
    assert found.status == "ok", found.reason
    return found, np.array(momenta), energies


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_a_collision_keeps_momentum_and_wins_no_energy(friction: float) -> None:
    found, momenta, energies = collide(friction=friction)
    assert found.contact_forces.max() > 0.1
    size = 1e-3 * np.hypot(1.0, 0.2)  # one gram
    assert np.ptp(momenta[:, :3], axis=0).max() < 1e-4 * size
    assert np.max(np.diff(energies)) < 1e-3 * energies[0]
    first = found.soft_positions[-1][:27].mean(axis=0) - found.soft_positions[0][:27].mean(axis=0)
    assert first[0] < -1e-3  # it was pushed on


@pytest.mark.parametrize(("tangent", "slides"), [(0.4, False), (0.6, True)])
def test_a_soft_block_on_a_soft_slope_slides_by_coulombs_law(tangent: float, slides: bool) -> None:
    angle = np.arctan(tangent)
    scene = Scene(gravity=9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)]), friction=1.0)
    base = scene.add_soft(box_mesh((0.06, 0.02, 0.004), (12, 4, 1)), RUBBER, name="base")
    base.fix("zmin")
    pose = np.eye(4)
    pose[:3, 3] = (0.012, 0.005, 0.004 + GAP)
    block = scene.add_soft(box_mesh((0.01, 0.01, 0.01), (2, 2, 2)).transformed(pose), RUBBER, name="block")
    scene.set_friction("base", "block", 0.5)
    found = simulate(scene, duration=0.3, time_step=0.01, record=True)
    assert found.status == "ok", found.reason
    along = found.soft_positions[:, block.first_vertex :, 0].mean(axis=1)
    if slides:
        # the first step falls through the gap, and a few go over a bump where triangles meet
        rates = np.diff(along, n=2) / 0.01**2
        expected = 9.81 * (np.sin(angle) - 0.5 * np.cos(angle))
        assert np.median(rates) == pytest.approx(expected, rel=0.02)
        assert np.mean(np.abs(rates - expected) < 0.1 * expected) > 0.7
    else:
        assert abs(along[-1] - along[0]) < 0.02 * MM


def squeezed_clip(**options) -> tuple[Trajectory, Scene]:
    scene = Scene(gravity=(0.0, 0.0, 0.0), friction=0.3)
    body = scene.add_soft(clip(), RUBBER)
    vertices = body.mesh.vertices
    tips = vertices[:, 1] > vertices[:, 1].max() - 1e-6
    top = vertices[:, 2].max()
    for where, way in ((vertices[:, 2] < 1e-6, 0.0013), (vertices[:, 2] > top - 1e-6, -0.0013)):
        body.drive(np.flatnonzero(tips & where), Motion(path=Shift(vector=(0.0, 0.0, way)), duration=0.2))
    return simulate(scene, duration=0.3, time_step=0.02, record=True, contact=Penalty(**options)), scene


def least_opening(found: Trajectory, scene: Scene) -> float:
    """Return how far apart the inner sides of the arms' tips are at the end [m]; negative if they have passed."""
    rest, end = scene.soft_bodies[0].mesh.vertices, found.soft_positions[-1]
    tips = rest[:, 1] > rest[:, 1].max() - 1e-6
    levels = np.unique(np.round(rest[tips, 2], 9))
    lower, upper = (end[tips & (np.abs(rest[:, 2] - level) < 1e-8), 2] for level in levels[1:3])
    return float(upper.min() - lower.max())


def test_arms_of_one_body_stop_each_other() -> None:
    found, scene = squeezed_clip()
    assert found.status == "ok", found.reason
    assert 0.0 < least_opening(found, scene) < GAP
    assert found.contact_forces.max() == 0.0  # no force from outside
    through, scene = squeezed_clip(soft_contact=False)
    assert through.status == "ok" and least_opening(through, scene) < -0.3 * MM  # the wrong twin


def test_a_run_with_soft_contact_goes_on_with_the_same_bits(tmp_path) -> None:
    whole, *_ = collide(friction=0.5)
    path = tmp_path / "run.npz"

    class Stopped(Exception):
        pass

    def stop(share: float) -> None:
        if share > 0.5:
            raise Stopped

    with pytest.raises(Stopped):
        collide(friction=0.5, checkpoint=path, checkpoint_every=0.0, progress=stop)
    rest, *_ = collide(friction=0.5, checkpoint=path)
    assert whole.soft_positions.tobytes() == rest.soft_positions.tobytes()


def test_what_is_remembered_of_the_way_changes_nothing() -> None:
    """Two blocks that stray, jump far away and come back: contacts are those of a potential that has seen nothing."""
    generator = np.random.default_rng(4)

    def made() -> tuple[SoftContact, np.ndarray]:
        scene, pose = Scene(), np.eye(4)
        pose[2, 3] = 0.0105
        scene.add_soft(box_mesh((0.01, 0.01, 0.01), (2, 2, 2)), RUBBER)
        scene.add_soft(box_mesh((0.01, 0.01, 0.01), (2, 2, 2)).transformed(pose), RUBBER)
        contact = Penalty().potential(scene)
        return contact.soft, np.concatenate([body.mesh.vertices for body in scene.soft_bodies])

    old, rest = made()
    upper, touched = np.arange(len(rest)) >= len(rest) // 2, 0
    for i in range(60):
        places = rest + 2e-5 * generator.normal(size=rest.shape)
        places[upper, 2] -= generator.uniform(0.0, 4.6e-4)
        if i % 20 == 10:
            places[upper] += 1e9 if i == 30 else np.nan
        old.find(places)
        fresh, _ = made()
        fresh.find(places)
        touched += old.rows.count > 0
        for one, other in zip(old.rows.arrays, fresh.rows.arrays, strict=True):
            np.testing.assert_array_equal(one[: old.rows.count], other[: fresh.rows.count])
    assert 10 < touched < 57
