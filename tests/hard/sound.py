"""What every hard case must show, whatever else: finite, no element inverted, nothing tunnelled, no energy won."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from finqd.mechanics.state import State
from finqd.mechanics.system import System
from finqd.mesh import Mesh
from finqd.scene import Scene
from finqd.simulate import simulate
from finqd.trajectory import Trajectory

#: of the sweep from 1 to 50 ms; half of them are left to the slow tests
STEPS_MS = [2, 10, 50, *(pytest.param(step, marks=pytest.mark.slow) for step in (1, 5, 20))]
PENETRATION = 0.2e-3  # [m] at most
#: share of the energy that was there which may be won between two steps; what BDF2 never lets grow is a norm of two
#: states together (Dahlquist 1976), not the energy of one
GAIN = {"implicit_euler": 1e-3, "bdf2": 5e-2}
UNBALANCED_N = 5e-5  # that a step may leave, and that does work along the way


@dataclass
class Course:
    """The states that a run went through, and the energy of each [J], in all and kinetic."""

    states: list[State] = field(default_factory=list)
    energies: list[float] = field(default_factory=list)
    kinetic: list[float] = field(default_factory=list)
    system: System | None = None

    def __call__(self, system: System, state: State) -> None:
        self.system = system
        self.states.append(state)
        self.kinetic.append(system.kinetic_energy(state))
        self.energies.append(self.kinetic[-1] + system.energy(state))

    def longest_way(self) -> float:
        """Return how far anything has gone [m]."""
        ways = [0.0]
        for name in ("positions", "rigid_positions"):
            places = np.array([getattr(state, name) for state in self.states])
            if places.size:
                ways.append(float(np.linalg.norm(np.diff(places, axis=0), axis=2).sum(axis=0).max()))
        return sum(ways)


def sound(
    scene: Scene, *, duration: float, time_step_ms: float, driven: bool = False, penetration: float = PENETRATION,
    **options: Any,
) -> tuple[Trajectory, Course]:
    """Run a scene and return what became of it; fails unless it is sound.

    driven: something puts energy into it
    """
    course = Course()
    found = simulate(scene, duration=duration, time_step=1e-3 * time_step_ms, watch=course, **options)
    assert found.status == "ok", found.reason
    end = course.states[-1]
    for values in (end.positions, end.velocities, end.rigid_positions, end.rigid_velocities, end.angular_momenta):
        assert np.all(np.isfinite(values))
    for body in scene.soft_bodies:
        mine = end.positions[body.first_vertex : body.first_vertex + body.mesh.n_vertices]
        assert Mesh(mine, body.mesh.blocks).quality().inverted == 0, f"{body.name} has inverted elements"
    assert found.penetrations.max() <= penetration, f"sinks {1e3 * found.penetrations.max():.3f} mm into something"
    if not driven:
        energies = np.array(course.energies)
        size = np.ptp(energies) + max(course.kinetic)
        won = np.max(energies - np.minimum.accumulate(energies))
        stepper = options.get("stepper")
        share = GAIN[stepper if isinstance(stepper, str) else "implicit_euler"]
        allowed = share * size + UNBALANCED_N * course.longest_way()
        assert won <= allowed, f"{won:.3g} J out of nothing, of {size:.3g} J"
    return found, course
