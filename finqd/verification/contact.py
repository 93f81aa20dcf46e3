"""Hertz's contact of an elastic ball with a rigid plane."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from finqd.mechanics.material import Material
from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.scene import Motion, Scene, Shift
from finqd.simulate import simulate
from finqd.units import MM
from finqd.verification.cases import Failed, checked
from finqd.verification.meshes import quarter_ball
from finqd.verification.statics import resting

BALL = Material(youngs_modulus=1e6, poisson_ratio=0.3, density=1000.0)
RADIUS, FORCE = 10 * MM, 0.1
HERTZ_RADIUS, HERTZ_APPROACH = 0.880 * MM, 0.0775 * MM
#: the penalty gives way by less than 0.2 um under Hertz's largest pressure, 0.06 N/mm^2
STIFF = {"name": "penalty", "stiffness_N_mm3": 1000.0, "smoothing_mm": 2e-4, "sample_spacing_mm": 0.1}


@dataclass(frozen=True)
class Hertz:
    """Radius of the contact and approach of the ball's centre to the plane [m]."""

    radius: float
    approach: float


@cache
def hertz(n: int, *, element: str = "hex8", grading: float = 4.0, elasticity: str = "corotated") -> Hertz:
    """Return what becomes of an elastic ball between two planes under `FORCE`, a quarter of its lower half meshed.

    The equator stays plane by symmetry, and is moved down; results are interpolated at the force. The approach is the
    equator's; the radius comes from the second moment of the nodal contact forces, which for Hertz's pressure is
    2/5 a^2. A ball of finite size is stiffer than Hertz's half space by 3.2 % here (Tatara 1991: the approach loses
    F f/(pi E), f = 2 (1 + nu) R^2/(a^2 + 4 R^2)^1.5 + (1 - nu^2)/(a^2 + 4 R^2)^0.5).
    """
    mesh = quarter_ball(RADIUS, n, element, grading=grading)
    scene = Scene(gravity=(0.0, 0.0, 0.0), friction=0.0)
    ball = scene.add_soft(mesh, BALL, elasticity=elasticity)
    ball.fix("xmin", axes=(0,))
    ball.fix("ymin", axes=(1,))
    equator = ball.vertices("zmax")
    deepest = 1.1 * HERTZ_APPROACH
    ball.drive(equator, Motion(path=Shift(vector=(0.0, 0.0, -deepest)), duration=1.0))
    scene.add_plane(point=(0.0, 0.0, -RADIUS))
    history: list[tuple[float, float, float]] = []

    def watch(system: System, state: State) -> None:
        system.derivatives.clear_gradient()
        system.contact.add_gradient(state, system.derivatives)
        push = -system.derivatives.soft[:, 2]
        total = float(push.sum())
        if total > 0.0:
            spread = float(push @ np.sum(state.positions[:, :2] ** 2, axis=1)) / total
            depth = -float(np.mean(state.positions[equator, 2] - mesh.vertices[equator, 2]))
            history.append((4.0 * total, depth, np.sqrt(2.5 * spread)))

    checked(simulate(scene, duration=1.0, time_step=0.2, stepper=resting(), contact=STIFF, watch=watch))
    force, depth, radius = np.array(history).T
    if not force[-1] > FORCE:
        raise Failed(f"the ball is too soft: {force[-1]:.3g} N at {deepest / MM:.3g} mm")
    return Hertz(float(np.interp(FORCE ** (1 / 3), force ** (1 / 3), radius)),
                 float(np.interp(FORCE ** (2 / 3), force ** (2 / 3), depth)))


def finite_approach() -> float:
    """Return Tatara's approach [m] of the finite ball, see `hertz`."""
    e, nu, a, r = BALL.youngs_modulus, BALL.poisson_ratio, HERTZ_RADIUS, RADIUS
    far = a * a + 4 * r * r
    f = 2 * (1 + nu) * r * r / far**1.5 + (1 - nu * nu) / far**0.5
    return 0.75 * (1 - nu * nu) * FORCE / (e * a) - FORCE * f / (np.pi * e)
