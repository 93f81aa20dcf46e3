"""Verification of the mechanics: closed forms, conservation laws and published values, through the public Scene.

    python benchmarks/verification.py [--only TEXT] [--grasps] [--json FILE]

Each case is a function that `tests/test_mechanics.py` calls as well, on coarser meshes.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from finqd.mechanics.material import Material
from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.objects import GraspObject, load_object
from finqd.plugins.stepper_implicit_euler import ImplicitEuler
from finqd.scene import Motion, Scene, Shift, Timed
from finqd.simulate import simulate
from finqd.trajectory import Trajectory
from finqd.units import MM

GRAVITY = 9.81  # [m/s^2]
RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.45, density=1000.0)
PAD = Material(youngs_modulus=1e7, poisson_ratio=0.0, density=1000.0)  # nu 0: friction cannot change its push
#: converges as far as double precision goes, for conservation laws
TO_ROUND_OFF = ImplicitEuler(tolerance_N=1e-10, linear_tolerance=1e-12)
PAD_STROKE = 0.0215 * MM  # makes about 5 N
SILICONE = Material(youngs_modulus=263_824, poisson_ratio=0.499, density=1070.0)
DESIGNS = Path(__file__).resolve().parents[1] / "designs"


@dataclass(frozen=True)
class Row:
    """One line of the table; ``error`` is relative unless ``unit`` says otherwise."""

    case: str
    quantity: str
    source: str
    reference: float
    value: float
    error: float
    bar: float
    seconds: float

    @property
    def passed(self) -> bool:
        return abs(self.error) <= self.bar


def checked(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory if it ran through; raise RuntimeError with the reason if not."""
    if trajectory.status != "ok":
        raise RuntimeError(f"{trajectory.status}: {trajectory.reason}")
    return trajectory


def mechanical_energy(system: System, state: State) -> float:
    """Return kinetic, elastic, contact, friction and dead-load energy [J] of a scene of soft bodies."""
    return 0.5 * float(np.vdot(system.masses, np.sum(state.velocities**2, axis=1))) + system.energy(state)


# -- laws --------------------------------------------------------------------------------------------------------------


def free_fall(time_step: float) -> float:
    """Return the largest distance [m] of a falling soft box from g t (t + dt)/2, the exact implicit Euler result."""
    scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
    scene.add_soft(box_mesh((0.03, 0.02, 0.01), (2, 2, 1)), RUBBER)
    found = checked(simulate(scene, duration=0.2, time_step=time_step, record=True))
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


def spinning_bar(time_step: float, *, duration: float = 0.2, divisions: tuple[int, int, int] = (6, 1, 1)) -> Conserved:
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

    checked(simulate(scene, duration=duration, time_step=time_step, stepper=TO_ROUND_OFF, watch=watch))
    return Conserved(np.array(linear), np.array(angular), np.array(energy))


def landing(time_step: float, divisions: tuple[int, int, int] = (3, 3, 3)) -> tuple[np.ndarray, Trajectory]:
    """Return the energy [J] after each step of a soft cube that falls 20 mm onto a plane, and the trajectory."""
    scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
    cube = scene.add_soft(box_mesh((0.03, 0.03, 0.03), divisions), RUBBER)
    cube.start_positions[:, 2] += 0.02
    scene.add_plane()
    energy: list[float] = []

    def watch(system: System, state: State) -> None:
        energy.append(mechanical_energy(system, state))

    found = simulate(scene, duration=0.4, time_step=time_step, watch=watch)
    return np.array(energy), checked(found)


def spinning_brick(time_step: float) -> np.ndarray:
    """Return the angular momentum [kg m^2/s] after each step of a rigid brick that tumbles freely, shape (n, 3)."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    brick = load_object({"name": "brick", "shape": {"kind": "box", "size_mm": [40, 25, 10]}, "mass_g": 50})
    scene.add_rigid(brick, position=(0.0, 0.0, 0.0), angular_velocity=(0.5, 10.0, 0.3))
    momenta: list[np.ndarray] = []
    checked(
        simulate(
            scene, duration=1.0, time_step=time_step, stepper=TO_ROUND_OFF,
            watch=lambda system, state: momenta.append(state.angular_momenta[0]),
        )
    )
    return np.array(momenta)


# -- friction ----------------------------------------------------------------------------------------------------------


def block_on_slope(
    share: float, *, friction: float = 0.6, divisions: tuple[int, int, int] = (2, 2, 1), time_step: float = 0.01
) -> tuple[float, float]:
    """Return acceleration [m/s^2] and distance [m], in 1 s, of a soft block where tan(angle) = share * friction.

    The slope is the plane z = 0 and gravity is turned. The acceleration is the mean over the last two thirds.
    """
    angle = math.atan(share * friction)
    scene = Scene(gravity=(GRAVITY * math.sin(angle), 0.0, -GRAVITY * math.cos(angle)), friction=friction)
    block = scene.add_soft(box_mesh((0.03, 0.03, 0.01), divisions), RUBBER)
    block.start_positions[:, 2] -= 1e-6
    scene.add_plane()
    found = checked(simulate(scene, duration=1.0, time_step=time_step, record=True))
    along = found.soft_positions[:, :, 0].mean(axis=1)
    return mean_acceleration(found.times, along), float(along[-1] - along[0])


def sliding_acceleration(share: float, friction: float = 0.6) -> float:
    """Return g (sin - mu cos) [m/s^2] of the slope of `block_on_slope`."""
    angle = math.atan(share * friction)
    return GRAVITY * (math.sin(angle) - friction * math.cos(angle))


def mean_acceleration(times: np.ndarray, along: np.ndarray) -> float:
    """Return the mean acceleration [m/s^2] over the last two thirds of a recorded motion."""
    speeds, middle = np.diff(along) / np.diff(times), 0.5 * (times[1:] + times[:-1])
    first = len(speeds) // 3
    return float((speeds[-1] - speeds[first]) / (middle[-1] - middle[first]))


def rolling_ball(angle_deg: float, *, time_step: float, duration: float = 0.5) -> float:
    """Return the acceleration of a solid ball on a slope over (5/7) g sin(angle): 1 if it rolls as it should."""
    angle = math.radians(angle_deg)
    scene = Scene(gravity=(GRAVITY * math.sin(angle), 0.0, -GRAVITY * math.cos(angle)))
    scene.add_plane()
    ball = load_object("sphere")
    scene.add_rigid(ball, position=(0.0, 0.0, ball.ball_radius))
    found = checked(simulate(scene, duration=duration, time_step=time_step))
    return mean_acceleration(found.times, found.rigid_positions[:, 0, 0]) / (5 / 7 * GRAVITY * math.sin(angle))


def squeezed_block(
    mass: float, *, friction: float = 0.6, divisions: tuple[int, int, int] = (3, 4, 4), time_step: float = 0.01
) -> tuple[float, float]:
    """Return the force [N] of two pads that squeeze a block on the floor, and its lag [m] behind a lift of 3 mm.

    The force, about 5 N, is measured just before the lift, which takes 1 s, so that it adds less than 0.2 % to the
    weight; 0.3 s after it the lag is taken.
    """
    block = load_object({"name": "block", "shape": {"kind": "box", "size_mm": [20, 30, 80]}, "mass_g": mass * 1e3})
    scene = Scene(gravity=(0.0, 0.0, -GRAVITY), friction=friction)
    scene.add_plane()
    scene.add_rigid(block, position=(0.0, 0.0, 0.04))
    size = np.array([0.01, 0.016, 0.016])
    lift = Timed(path=Shift(vector=(0.0, 0.0, 3 * MM)), start=0.2, duration=1.0)
    for side in (-1.0, 1.0):
        place = np.eye(4)
        place[:3, 3] = (0.01 if side > 0 else -0.02, -0.5 * size[1], 0.04 - 0.5 * size[2])
        pad = scene.add_soft(box_mesh(size, divisions).transformed(place), PAD)
        closing = Motion(path=Shift(vector=(-side * PAD_STROKE, 0.0, 0.0)), duration=0.1, carriers=(lift,))
        pad.drive("xmax" if side > 0 else "xmin", closing)
    found = checked(simulate(scene, duration=1.5, time_step=time_step))
    heights = found.rigid_positions[:, 0, 2]
    before = int(np.searchsorted(found.times, 0.2 - 1e-9))
    return float(found.contact_forces[before].mean()), float(3 * MM - (heights[-1] - heights[before]))


def squeezed_lag(share: float, *, friction: float = 0.6, **settings: Any) -> tuple[float, float]:
    """Return the pads' force [N] and the lag [m] of a block that weighs ``share`` of what they can carry, 2 mu N."""
    force, _ = squeezed_block(0.1, friction=friction, **settings)
    return squeezed_block(share * 2 * friction * force / GRAVITY, friction=friction, **settings)


# -- published values --------------------------------------------------------------------------------------------------


def silicone_cantilever(divisions: tuple[int, int, int], element: str = "hex8") -> float:
    """Return how far the tip [m] of a clamped silicone bar, 100 x 30 x 30 mm, sags at rest under its own weight."""
    scene = Scene(gravity=(0.0, 0.0, -9.807))
    beam = scene.add_soft(box_mesh((0.1, 0.03, 0.03), divisions, element), SILICONE)
    beam.fix("xmin")
    found = checked(simulate(scene, duration=4.0, time_step=0.1, record=True))
    heights = found.soft_positions[:, beam.vertices("xmax"), 2].mean(axis=1)
    assert abs(heights[-1] - heights[-2]) < 1e-6, "not at rest yet"
    return float(heights[0] - heights[-1])


# -- grasps ------------------------------------------------------------------------------------------------------------


def grasp(design: str, grasped: str | GraspObject, overrides: dict[str, Any] | None = None) -> tuple[Trajectory, bool]:
    """Return the trajectory of one grasp of a design file that comes with finqd, and whether the object was held."""
    from finqd.design import Design
    from finqd.evaluate import evaluate

    done = evaluate(Design.from_json(DESIGNS / design), objects=[grasped], overrides=overrides)
    (found,), (verdict,) = done.trajectories.values(), done.result.verdicts.values()
    return checked(found), verdict.held


def creep() -> float:
    """Return by how much [m] the sphere moves in the last 8 of 10 s in which the benchmark gripper holds it."""
    found, held = grasp("benchmark.json", "sphere", {"protocol.hold_s": 10.0})
    late = found.rigid_positions[found.times >= found.times[-1] - 8.0, 0, 2]
    return float(np.ptp(late)) if held else math.inf


def cross_check_height() -> float:
    """Return the final height [m] of the sphere's centre in the job that three other simulators ran."""
    ball = load_object({"name": "sphere50", "shape": {"kind": "sphere", "diameter_mm": 50}, "mass_g": 50})
    found, held = grasp("cross_check.json", ball)
    return float(found.rigid_positions[-1, 0, 2]) if held else 0.0


# -- the table ---------------------------------------------------------------------------------------------------------

#: case, quantity, source, reference, bar, absolute error?, what computes it (a tuple gives a line each)
Case = tuple[str, str, str, float, float, bool, Callable[[], float]]


def cases() -> Iterator[Case]:
    """Yield the cases at their fine setting."""
    euler, law = "exact for implicit Euler", "conservation law"
    yield "free fall", "distance from g t (t + dt)/2 [m]", euler, 0.0, 1e-11, True, lambda: free_fall(0.01)
    for dt in (0.002, 0.001):
        bar = f"spinning bar, dt {dt * 1e3:g} ms"
        yield bar, "linear momentum, change", law, 0.0, 1e-8, True, lambda dt=dt: spinning_bar(dt).linear_drift
        yield bar, "angular momentum, loss", "first order in dt", 0.0, 20.0 * dt, True, (
            lambda dt=dt: spinning_bar(dt).angular_loss
        )
        yield bar, "energy, largest gain [J]", law, 0.0, 0.0, True, (
            lambda dt=dt: max(float(np.diff(spinning_bar(dt).energy).max()), 0.0)
        )
    yield "landing cube", "energy, largest gain [J]", law, 0.0, 1e-8, True, (
        lambda: max(float(np.diff(landing(0.002, (6, 6, 6))[0]).max()), 0.0)
    )
    yield "landing cube", "floor's force at rest [N]", "weight", 0.027 * GRAVITY, 1e-3, False, (
        lambda: float(landing(0.002, (6, 6, 6))[1].contact_forces[-1, 0])
    )
    yield "tumbling brick", "angular momentum, change", law, 0.0, 1e-12, True, (
        lambda: float(np.abs((m := spinning_brick(0.01)) - m[0]).max() / np.linalg.norm(m[0]))
    )
    slope: dict[str, Any] = {"divisions": (6, 6, 2), "time_step": 0.005}
    yield "slope, tan = 0.99 mu", "distance in 1 s [m]", "Coulomb: sticks", 0.0, 1e-5, True, (
        lambda: block_on_slope(0.99, **slope)[1]
    )
    for share in (1.01, 1.3):
        expected = sliding_acceleration(share)
        yield f"slope, tan = {share} mu", "acceleration [m/s^2]", "g (sin - mu cos)", expected, 0.01, False, (
            lambda share=share: block_on_slope(share, **slope)[0]
        )
    for dt in (0.01, 0.002):
        yield f"rolling ball, dt {dt * 1e3:g} ms", "acceleration / (5/7 g sin)", "closed form", 1.0, 0.01, False, (
            lambda dt=dt: rolling_ball(15.0, time_step=dt)
        )
    pads: dict[str, Any] = {"divisions": (5, 8, 8), "time_step": 0.005}
    for share, lag in ((0.98, 0.0), (1.02, 3 * MM)):
        yield f"two pads, weight {share} x 2 mu N", "lag behind a 3 mm lift [m]", "Coulomb", lag, 0.1 * MM, True, (
            lambda share=share: squeezed_lag(share, **pads)[1]
        )
    for divisions in ((10, 3, 3), (20, 6, 6), (30, 8, 8), (40, 12, 12)):
        size = "x".join(map(str, divisions))
        bar = 0.03 if divisions[0] >= 30 else 0.15
        yield f"silicone cantilever, {size} hex8", "sag [m]", "measured 6.71 mm (code 6.77)", 6.71 * MM, bar, False, (
            lambda divisions=divisions: silicone_cantilever(divisions)
        )


def grasp_cases() -> Iterator[Case]:
    """Yield whole grasps, a minute or so each."""
    yield "sphere held 10 s", "creep in the last 8 s [m]", "true stick", 0.0, 0.01 * MM, True, creep
    yield "cross-check grasp", "height of the sphere [m]", "84.1 to 84.6 mm by three others", 84.5 * MM, 1 * MM, True, (
        cross_check_height
    )


def measure(case: Case) -> Row:
    """Run a case."""
    name, quantity, source, reference, bar, absolute, compute = case
    begun = time.perf_counter()
    value = compute()
    error = value - reference if absolute else value / reference - 1.0
    return Row(name, quantity, source, reference, value, error, bar, time.perf_counter() - begun)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--grasps", action="store_true", help="with the two whole grasps")
    parser.add_argument("--json", type=Path, help="write the rows there as well")
    options = parser.parse_args()
    rows = []
    print("| case | quantity | source | reference | value | error | bar | passed | seconds |\n" + "|---" * 9 + "|")
    for case in [*cases(), *(grasp_cases() if options.grasps else ())]:
        if options.only not in case[0]:
            continue
        row = measure(case)
        rows.append(row)
        print(
            f"| {row.case} | {row.quantity} | {row.source} | {row.reference:.5g} | {row.value:.5g} | {row.error:+.2g} "
            f"| {row.bar:.2g} | {'yes' if row.passed else 'NO'} | {row.seconds:.1f} |", flush=True,
        )
    if options.json:
        options.json.write_text(json.dumps([{**asdict(row), "passed": row.passed} for row in rows], indent=2) + "\n")


if __name__ == "__main__":
    main()
