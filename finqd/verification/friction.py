"""Coulomb friction through Scene, stepper and contact: slope, rolling ball, squeezing pads."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from finqd.mechanics.material import Material
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.scene import Motion, Scene, Shift, Timed
from finqd.simulate import simulate
from finqd.units import MM
from finqd.verification.cases import checked
from finqd.verification.elastic import RUBBER

GRAVITY = 9.81  # [m/s^2]
PAD = Material(youngs_modulus=1e7, poisson_ratio=0.0, density=1000.0)  # nu 0: friction cannot change its push
PAD_STROKE = 0.0215 * MM  # makes about 5 N
#: the block that is 1 % too steep is driven by 0.5 mN: no default tolerance (0.05 mN a vertex) can judge that to 1 %
SLOPE_STEPPER = {"name": "implicit_euler", "tolerance_N": 1e-7, "friction_tolerance": 1e-4}


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
    found = checked(simulate(scene, duration=1.0, time_step=time_step, stepper=SLOPE_STEPPER, record=True))
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


@cache
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
