"""Motion: what steppers conserve, damp and get right in time, without contact or with a plane."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from finqd import registry
from finqd.mechanics.material import Material
from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.scene import Scene
from finqd.simulate import simulate
from finqd.trajectory import Trajectory
from finqd.units import MM, MS
from finqd.verification.cases import Failed, checked
from finqd.verification.elastic import RUBBER, stiffness
from finqd.verification.statics import silicone_scene, top_edge

GRAVITY = 9.81  # [m/s^2]
#: converges as far as double precision goes, for conservation laws
TO_ROUND_OFF = {"tolerance_N": 1e-10, "linear_tolerance": 1e-12}
#: order of convergence of positions at fixed time; a stepper that is not here is measured by nobody
ORDERS = {"implicit_euler": 1, "bdf2": 2, "imex": 1, "explicit": 2}


def precise(stepper: str, settings: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return a stepper's spec with those of the ``settings`` (default: `TO_ROUND_OFF`) that it knows."""
    known = {option.name for option in registry.options("stepper", stepper)}
    chosen = TO_ROUND_OFF if settings is None else settings
    return {"name": stepper, **{key: value for key, value in chosen.items() if key in known}}


def mechanical_energy(system: System, state: State) -> float:
    """Return kinetic, elastic, contact, friction and dead-load energy [J] of a scene of soft bodies."""
    return 0.5 * float(np.vdot(system.masses, np.sum(state.velocities**2, axis=1))) + system.energy(state)


# -- free bodies -------------------------------------------------------------------------------------------------------


def free_fall(time_step: float, stepper: str = "implicit_euler") -> float:
    """Return the largest distance [m] of a falling soft box from g t (t + dt)/2, the exact implicit Euler result."""
    scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
    scene.add_soft(box_mesh((0.03, 0.02, 0.01), (2, 2, 1)), RUBBER)
    found = checked(simulate(scene, duration=0.2, time_step=time_step, stepper=stepper, record=True))
    fallen = found.soft_positions[0, :, 2] - found.soft_positions[:, :, 2]
    times = found.times[:, None]
    return float(np.abs(fallen - GRAVITY * times * (times + time_step) / 2).max())


@dataclass(frozen=True)
class Conserved:
    """Histories of a free body: linear and angular momentum about its centre of mass (n, 3), energy (n,)."""

    linear: np.ndarray
    angular: np.ndarray
    energy: np.ndarray

    @property
    def linear_drift(self) -> float:
        """Largest change of the linear momentum, relative."""
        return float(np.abs(self.linear - self.linear[0]).max() / np.linalg.norm(self.linear[0]))

    @property
    def angular_loss(self) -> float:
        """Share of the angular momentum that is lost in the end."""
        size = np.linalg.norm(self.angular, axis=1)
        return float(1.0 - size[-1] / size[0])

    @property
    def energy_gain(self) -> float:
        """Largest gain of energy in a step [J]."""
        return max(float(np.diff(self.energy).max()), 0.0)


@cache
def spinning_bar(
    time_step: float, *, duration: float = 0.2, divisions: tuple[int, int, int] = (6, 1, 1),
    stepper: str = "implicit_euler",
) -> Conserved:
    """Return what becomes of a soft bar that flies and spins freely, stepped to round-off."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    mesh = box_mesh((0.06, 0.01, 0.01), divisions)
    bar = scene.add_soft(mesh, RUBBER, velocity=(0.1, -0.2, 0.3))
    bar.velocities += np.cross((3.0, 0.0, 10.0), mesh.vertices - mesh.vertices.mean(axis=0))
    linear, angular, energy = [], [], []

    def watch(system: System, state: State) -> None:
        momenta = system.masses[:, None] * state.velocities
        middle = system.masses @ state.positions / system.masses.sum()
        linear.append(momenta.sum(axis=0))
        angular.append(np.cross(state.positions - middle, momenta).sum(axis=0))
        energy.append(mechanical_energy(system, state))

    checked(simulate(scene, duration=duration, time_step=time_step, stepper=precise(stepper), watch=watch))
    return Conserved(np.array(linear), np.array(angular), np.array(energy))


def spinning_brick(time_step: float) -> np.ndarray:
    """Return the angular momentum [kg m^2/s] after each step of a rigid brick that tumbles freely, shape (n, 3)."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    brick = load_object({"name": "brick", "shape": {"kind": "box", "size_mm": [40, 25, 10]}, "mass_g": 50})
    scene.add_rigid(brick, position=(0.0, 0.0, 0.0), angular_velocity=(0.5, 10.0, 0.3))
    momenta: list[np.ndarray] = []
    checked(simulate(
        scene, duration=1.0, time_step=time_step, stepper=precise("implicit_euler"),
        watch=lambda system, state: momenta.append(state.angular_momenta[0]),
    ))
    return np.array(momenta)


def brick_drift(time_step: float) -> float:
    """Return the largest change of a tumbling brick's angular momentum, relative."""
    momenta = spinning_brick(time_step)
    return float(np.abs(momenta - momenta[0]).max() / np.linalg.norm(momenta[0]))


# -- a plane -----------------------------------------------------------------------------------------------------------


@cache
def landing(
    time_step: float, divisions: tuple[int, int, int] = (3, 3, 3), stepper: str = "implicit_euler"
) -> tuple[np.ndarray, Trajectory]:
    """Return the energy [J] after each step of a soft cube that falls 20 mm onto a plane, and the trajectory."""
    scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
    cube = scene.add_soft(box_mesh((0.03, 0.03, 0.03), divisions), RUBBER)
    cube.start_positions[:, 2] += 0.02
    scene.add_plane()
    energy: list[float] = []

    def watch(system: System, state: State) -> None:
        energy.append(mechanical_energy(system, state))

    found = simulate(scene, duration=0.4, time_step=time_step, watch=watch, stepper=stepper)
    return np.array(energy), checked(found)


@cache
def rebound(stepper: str, time_step: float) -> float:
    """Return how high a rigid block rises again that falls 20 mm onto a plane, over that: implicit contact keeps none.

    True of steps that are long beside the contact's own period: at 0.5 ms 0.3 % of the height are left, measured.
    """
    height, drop = 0.02, 0.02
    block = load_object({"name": "block", "shape": {"kind": "box", "size_mm": [40, 40, 20]}, "mass_g": 50})
    scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
    scene.add_plane()
    scene.add_rigid(block, position=(0.0, 0.0, 0.5 * height + drop))
    found = checked(simulate(scene, duration=0.25, time_step=time_step, stepper=stepper))
    above = found.rigid_positions[:, 0, 2] - 0.5 * height
    turn = int(np.argmax(np.diff(above) >= 0.0)) + 1  # the first moment at which it no longer falls
    return max(float(above[turn:].max()), 0.0) / drop


ROD = Material(youngs_modulus=1e6, poisson_ratio=0.0, density=1000.0)  # nu 0: the motion is one-dimensional
ROD_LENGTH, ROD_SIDE, ROD_SPEED = 0.1, 0.01, 0.1


@cache
def rod_impact(divisions: int = 100, *, steps: int = 100, stepper: str = "bdf2") -> tuple[float, float]:
    """Return plateau force and impulse of an elastic rod that hits a plane, over rho c v A and 2 m v.

    One-dimensional waves (Saint-Venant): the plane feels rho c v A for 2 L/c, then the rod leaves with its speed
    reversed. ``steps``: time steps in 2 L/c. Both are taken from the rod's momentum, since a penalty's force chatters
    where it is not implicit; the plateau is the slope of the line fitted to its middle half, as chatter at two instants
    alone would be worth 3 %.
    """
    speed = np.sqrt(ROD.youngs_modulus / ROD.density)
    contact_time = 2.0 * ROD_LENGTH / speed
    scene = Scene(gravity=(0.0, 0.0, 0.0), friction=0.0)
    mesh = box_mesh((ROD_SIDE, ROD_SIDE, ROD_LENGTH), (1, 1, divisions))
    rod = scene.add_soft(mesh, ROD, velocity=(0.0, 0.0, -ROD_SPEED))
    rod.fix(np.arange(mesh.n_vertices), axes=(0, 1))
    scene.add_plane()
    momenta = [(0.0, -ROD.density * ROD_SIDE**2 * ROD_LENGTH * ROD_SPEED)]
    checked(simulate(
        scene, duration=1.6 * contact_time, time_step=contact_time / steps, stepper=stepper,
        contact={"name": "penalty", "smoothing_mm": 1e-4, "stiffness_N_mm3": 1000.0},
        watch=lambda system, state: momenta.append((state.time, float(system.masses @ state.velocities[:, 2]))),
    ))
    times, momentum = np.array(momenta).T
    middle = np.abs(times / contact_time - 0.5) <= 0.25
    plateau = np.polyfit(times[middle], momentum[middle], 1)[0]
    area, mass = ROD_SIDE**2, ROD.density * ROD_SIDE**2 * ROD_LENGTH
    impulse = float(momentum[-1] - momentum[0]) / (2.0 * mass * ROD_SPEED)
    return float(plateau / (ROD.density * speed * ROD_SPEED * area)), impulse


# -- order in time -----------------------------------------------------------------------------------------------------


@cache
def _mode() -> tuple[Any, np.ndarray, float]:
    """Return mesh, lowest eigenvector (n, 3) and its angular frequency [1/s] of a clamped bar, masses lumped."""
    import scipy.linalg as la

    mesh = box_mesh((0.06, 0.02, 0.015), (4, 1, 1))
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_soft(mesh, RUBBER).fix("xmin")
    system = System(scene, contact=registry.create("contact", "penalty"))
    free = ~system.fixed.ravel()
    pattern, blocks = stiffness(mesh, system.potentials[0], mesh.vertices)
    matrix = pattern.matrix(blocks).toarray()[np.ix_(free, free)]
    squares, vectors = la.eigh(matrix, np.diag(np.repeat(system.masses, 3)[free]), subset_by_index=(0, 0))
    shape = np.zeros(3 * mesh.n_vertices)
    shape[free] = vectors[:, 0] / np.abs(vectors[:, 0]).max()
    return mesh, shape.reshape(-1, 3), float(np.sqrt(squares[0]))


MODE_SETTINGS = {"tolerance_N": 2e-9, "linear_tolerance": 1e-9, "max_iterations": 100}


def mode_error(stepper: str, steps: int, *, share: float = 0.3) -> float:
    """Return the error at time T of a bar released in its lowest mode, over the amplitude; exact is cos(omega T).

    ``steps`` of equal length make T = ``share`` of a period; `explicit` chooses its substeps itself, and is refined by
    its ``safety``, 32 / ``steps``. The amplitude, 1e-5 of the length
    (1e-7 for `explicit`, whose errors are smaller), is linear.
    """
    mesh, shape, omega = _mode()
    amplitude = (1e-7 if stepper == "explicit" else 1e-5) * 0.06
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    bar = scene.add_soft(mesh, RUBBER)
    bar.fix("xmin")
    bar.start_positions += amplitude * shape
    duration = share * 2.0 * np.pi / omega
    spec = precise(stepper, MODE_SETTINGS)
    if stepper == "explicit":  # it chooses its substeps itself, as shares of what is stable
        spec["safety"], steps = 32.0 / steps, 2
    found = checked(simulate(scene, duration=duration, time_step=duration / steps, stepper=spec, record=True))
    exact = amplitude * np.cos(omega * duration) * shape
    off = found.soft_positions[-1] - mesh.vertices - exact
    return float(np.abs(off).max() / amplitude)


# -- silicone ----------------------------------------------------------------------------------------------------------


#: damping of the silicone by its stiffness [s]: the one constant that is fitted, to `RING_DOWN` without a weight
SILICONE_DAMPING = 2.2 * MS
#: weight that hangs on the tip [N] -> frequency [Hz] and damping ratio of the measured vibration: damped cosines fitted
#: to motion capture of the tip at 100 Hz, 0.03 to 0.9 s after the release, means of two recordings each, which differ
#: by 1 % and 10 % at most. Source: recordings of the cantilevers of Dubied, Michelis, Spielberg and Katzschmann, IEEE
#: Robot. Autom. Lett. 7 (2022) 5015, in the public repository of that paper
RING_DOWN = {0.0: (7.74, 0.0518), 0.51: (4.32, 0.0502)}
#: weight [N] -> first peak [m] and its time [s] in the same paper. The bar was not let go at once: followed back to
#: the release, the vibrations recorded are 0.77 to 0.84 (0.51 N: 0.64 to 0.72) of a sudden release's
FIRST_PEAK = {0.0: (11.06 * MM, 60 * MS), 0.51: (25.67 * MM, 130 * MS)}
SETTLED, RING_TIME = 0.03, 0.9  # [s] after the release: from when to when a damped cosine is fitted to the vibration


@cache
def silicone_course(
    divisions: tuple[int, int, int], weight: float, *, stepper: str, time_step: float, duration: float,
    damping: float = 0.0, elasticity: str = "corotated",
) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and sag [m] of the tip of the silicone bar, released from straight with ``weight`` [N] hung on.

    damping: of the silicone, by its stiffness [s]
    """
    scene, beam = silicone_scene(divisions, "hex8", elasticity, weight, damping)
    found = checked(simulate(scene, duration=duration, time_step=time_step, stepper=stepper, record=True))
    height = found.soft_positions[:, top_edge(beam), 2].mean(axis=1)
    return found.times, height[0] - height


def silicone_peak(
    divisions: tuple[int, int, int], weight: float, *, stepper: str, time_step: float, duration: float = 0.2,
    damping: float = 0.0,
) -> tuple[float, float]:
    """Return the first peak [m] of `silicone_course`, and when it comes [s]."""
    times, sag = silicone_course(
        divisions, weight, stepper=stepper, time_step=time_step, duration=duration, damping=damping
    )
    falling = np.flatnonzero(np.diff(sag) < 0.0)
    if not len(falling):
        raise Failed("the tip is still sinking at the end")
    return float(sag[falling[0]]), float(times[falling[0]])


def silicone_ring_down(
    divisions: tuple[int, int, int], weight: float, *, time_step: float, damping: float = SILICONE_DAMPING,
) -> tuple[float, float]:
    """Return frequency [Hz] and damping ratio of `silicone_course` by bdf2: of the damped cosine that fits it best.

    From `SETTLED` on, which leaves out how the bar was let go.
    """
    from scipy.optimize import least_squares

    times, sag = silicone_course(
        divisions, weight, stepper="bdf2", time_step=time_step, duration=RING_TIME, damping=damping
    )
    t, y = times[times >= SETTLED], sag[times >= SETTLED]
    _, half = silicone_peak(
        divisions, weight, stepper="bdf2", time_step=time_step, duration=RING_TIME, damping=damping
    )

    def off(p: np.ndarray) -> np.ndarray:
        return p[0] + (p[1] * np.cos(p[3] * t) + p[2] * np.sin(p[3] * t)) * np.exp(-p[4] * t) - y

    start = [y.mean(), -0.5 * np.ptp(y), 0.0, np.pi / half, 1.0]
    omega, rate = least_squares(off, start, x_scale=[0.01, 0.01, 0.01, 10.0, 1.0]).x[3:]
    return float(omega / (2 * np.pi)), float(rate / np.hypot(omega, rate))


def silicone_modal_peak(divisions: tuple[int, int, int], duration: float = 0.12) -> tuple[float, float]:
    """Return the first peak [m] of `silicone_peak` without a force, and its time [s], from the modes of the same mesh.

    u(t) = sum over modes phi (phi . f) / omega^2 (1 - cos(omega t)), for small displacements; masses are lumped.
    """
    import scipy.linalg as la

    scene, beam = silicone_scene(divisions, "hex8", "corotated", 0.0)
    system = System(scene, contact=registry.create("contact", "penalty"))
    free = ~system.fixed.ravel()
    roots = np.sqrt(np.repeat(system.masses, 3)[free])
    pattern, blocks = stiffness(beam.mesh, system.potentials[0], beam.mesh.vertices)
    matrix = pattern.matrix(blocks).toarray()[np.ix_(free, free)]
    squares, vectors = la.eigh(matrix / np.outer(roots, roots))
    watched = np.zeros((beam.mesh.n_vertices, 3))
    watched[top_edge(beam), 2] = -1.0 / len(top_edge(beam))
    shares = (vectors.T @ (system.forces.ravel()[free] / roots)) * (vectors.T @ (watched.ravel()[free] / roots))
    times = np.linspace(0.0, duration, 2401)
    sag = (1.0 - np.cos(np.outer(times, np.sqrt(squares)))) @ (shares / squares)
    peak = int(np.argmax(sag))
    return float(sag[peak]), float(times[peak])
