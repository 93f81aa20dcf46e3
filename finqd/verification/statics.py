"""Bodies at rest through Scene and stepper: the elastica, roll-up under an end moment, a silicone cantilever."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from finqd import registry
from finqd.mechanics.loads import face_tractions
from finqd.mechanics.material import Material
from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.scene import Scene, SoftBody
from finqd.simulate import simulate
from finqd.units import MM
from finqd.verification.cases import Failed, checked

SILICONE = Material(youngs_modulus=263_824, poisson_ratio=0.499, density=1070.0)
SILICONE_GRAVITY = 9.807  # [m/s^2]
STRIP = Material(youngs_modulus=1e7, poisson_ratio=0.0, density=1000.0)
LENGTH = 1.0  # of the strip [m]
DEPTH = 0.02  # of the strip, in the direction in which it bends [m]
WIDTH = 0.02
BENDING = STRIP.youngs_modulus * WIDTH * DEPTH**3 / 12  # EI [N m^2]
PERIOD = 2 * np.pi / 3.516 * LENGTH**2 * np.sqrt(STRIP.density * WIDTH * DEPTH / BENDING)  # of its first mode [s]
PRECISE = {"tolerance_N": 1e-7, "linear_tolerance": 1e-8, "max_iterations": 100}


def resting(name: str = "") -> dict[str, Any]:
    """Return the stepper that finds a state of rest: ``quasi_static`` where it is registered."""
    names = registry.names("stepper")
    return {"name": name or ("quasi_static" if "quasi_static" in names else "implicit_euler"), **PRECISE}


# -- the elastica ------------------------------------------------------------------------------------------------------

#: P L^2 / EI -> tip's deflection and shortening over L
ELASTICA = {1.0: (0.30172, 0.05643), 2.0: (0.49346, 0.16064), 4.0: (0.66996, 0.32894)}


@cache
def elastica(load: float, divisions: tuple[int, int, int] = (50, 1, 1), element: str = "hex8",
             elasticity: str = "corotated") -> tuple[float, float]:
    """Return deflection and shortening over L of a strip's tip under a dead load P = ``load`` EI/L^2 there."""
    mesh = box_mesh((LENGTH, WIDTH, DEPTH), divisions, element)
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    strip = scene.add_soft(mesh, STRIP, elasticity=elasticity)
    strip.fix("xmin")
    strip.loads += face_tractions(mesh, "xmax", (0.0, 0.0, load * BENDING / LENGTH**2 / (WIDTH * DEPTH)))
    tip = at_rest(scene, strip.vertices("xmax"), time_step=PERIOD / 3)
    return tip[2] / LENGTH, -tip[0] / LENGTH


def at_rest(scene: Scene, tip: np.ndarray, *, time_step: float, steps: int = 60, stepper: Any = None) -> np.ndarray:
    """Return the mean displacement [m] of vertices ``tip`` once a scene with one soft body has come to rest."""
    found = checked(simulate(
        scene, duration=steps * time_step, time_step=time_step, stepper=stepper or resting(), record=True,
    ))
    path = found.soft_positions[:, tip].mean(axis=1)
    size = float(np.linalg.norm(path[-1] - path[0]))
    if not np.linalg.norm(path[-1] - path[-2]) <= 1e-4 * size:
        raise Failed("not at rest yet")
    return path[-1] - path[0]


# -- roll-up -----------------------------------------------------------------------------------------------------------


@cache
def roll_up(divisions: tuple[int, int, int] = (60, 1, 1), element: str = "hex8", elasticity: str = "corotated",
            *, ramp: int = 60) -> float:
    """Return the distance of a strip's tip from its root, over L, under the end moment 2 pi EI/L.

    The moment is the couple of bending stresses on the end section. Forces keep their directions during a step, and
    are turned to the section's normal after it: where the section has stopped turning the couple is exact.
    """
    mesh = box_mesh((LENGTH, WIDTH, DEPTH), divisions, element)
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    strip = scene.add_soft(mesh, STRIP, elasticity=elasticity)
    strip.fix("xmin")
    strip.fix(np.arange(mesh.n_vertices), axes=(1,))  # a ring under a dead couple would leave its plane
    moment = 2.0 * np.pi * BENDING / LENGTH

    def bending(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        stress = -moment * (points[:, 2] - DEPTH / 2) / (WIDTH * DEPTH**3 / 12)
        return stress[:, None] * normals

    couple = face_tractions(mesh, "xmax", bending)[:, 0]
    tip, low, high = strip.vertices("xmax"), *(np.intersect1d(strip.vertices("xmax"), strip.vertices(s))
                                               for s in ("zmin", "zmax"))

    def follow(system: System, state: State) -> None:
        up = state.positions[high].mean(axis=0) - state.positions[low].mean(axis=0)
        normal = np.array([up[2], 0.0, -up[0]]) / np.hypot(up[0], up[2])
        system.forces[:] = min((state.time / PERIOD + 1.0) / ramp, 1.0) * couple[:, None] * normal

    strip.loads[:, 0] = couple / ramp
    found = checked(simulate(
        scene, duration=(ramp + 40) * PERIOD, time_step=PERIOD, stepper=resting(), record=True, watch=follow,
    ))
    ends = found.soft_positions[:, tip].mean(axis=1)
    if not np.linalg.norm(ends[-1] - ends[-2]) <= 1e-4 * LENGTH:
        raise Failed("not at rest yet")
    return float(np.linalg.norm(ends[-1] - (0.0, WIDTH / 2, DEPTH / 2)) / LENGTH)


# -- silicone ----------------------------------------------------------------------------------------------------------


def silicone_scene(
    divisions: tuple[int, int, int], element: str, elasticity: str, weight: float, damping: float = 0.0
) -> tuple[Scene, SoftBody]:
    """Return a silicone bar, 100 x 30 x 30 mm, clamped at its root, with ``weight`` [N] hung on the tip's top edge.

    What hangs there has the inertia of its mass. damping: of the silicone, by its stiffness [s]
    """
    scene = Scene(gravity=(0.0, 0.0, -SILICONE_GRAVITY))
    mesh = box_mesh((100 * MM, 30 * MM, 30 * MM), divisions, element)
    beam = scene.add_soft(mesh, replace(SILICONE, rayleigh_stiffness=damping), elasticity=elasticity)
    beam.fix("xmin")
    edge = top_edge(beam)
    across = mesh.vertices[edge, 1]
    width = np.gradient(np.sort(across))  # a node's share of the edge, by the trapezoidal rule
    share = np.empty(len(edge))
    share[np.argsort(across)] = np.where(np.isin(np.arange(len(edge)), (0, len(edge) - 1)), 0.5, 1.0) * width
    beam.extra_masses[edge] += weight / SILICONE_GRAVITY * share / share.sum()
    return scene, beam


def top_edge(beam: SoftBody) -> np.ndarray:
    """Return the vertices of the tip's top edge, where the bar was measured (its markers were there)."""
    return np.intersect1d(beam.vertices("xmax"), beam.vertices("zmax"))


@cache
def silicone_sag(divisions: tuple[int, int, int], weight: float = 0.0, element: str = "hex8",
                 elasticity: str = "corotated") -> float:
    """Return how far [m] the tip's top edge of the silicone bar sags at rest, with ``weight`` [N] hung on it."""
    scene, beam = silicone_scene(divisions, element, elasticity, weight)
    return float(-at_rest(scene, top_edge(beam), time_step=0.1, steps=40)[2])
