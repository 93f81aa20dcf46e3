"""Contact model ipc: derivatives against finite differences, Coulomb's law, rest, and that nothing ever intersects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from finqd.errors import InputError
from finqd.mechanics import ipc_points
from finqd.mechanics.ipc_barrier import HALF_GAP, barrier
from finqd.mechanics.ipc_surface import TRIANGLES, soft_triangles, toolkit
from finqd.mechanics.material import Material
from finqd.mechanics.rotation_kernels import rotation_matrix
from finqd.mechanics.state import Direction, State
from finqd.mechanics.system import System
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
