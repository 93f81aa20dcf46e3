"""When a grasp is decided before its end: nothing moves any more, or what has fallen cannot rise again.

Asked at every frame, and only answers once the gripper has been lifted and holds: nothing is driven any more. A verdict
that comes early must be the one at the end; `benchmarks/effects_auto.py` looks whether it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.units import MM

if TYPE_CHECKING:
    from finqd.mechanics.state import State
    from finqd.mechanics.system import System

STILL = 0.02 * MM  # way that anything would go until the end, at the speed that it has
CLEAR = 0.5 * MM  # from the threshold, within which a verdict is left to the simulation
SURE = 2.0  # thresholds of drop from which on the margin does not depend on the drop any more


@dataclass(frozen=True, kw_only=True)
class EarlyVerdict:
    """Tells why a grasp is decided.

    lift: start of the lift [s]; hold: its end [s]; end: of the grasp [s]
    rise: of the gripper [m]; threshold: drop from which on the object is lost [m]; stepper: of the simulation
    """

    lift: float
    hold: float
    end: float
    rise: float
    threshold: float
    stepper: Any

    def __call__(self, system: System, state: State, frames: Mapping[str, Sequence[Any]]) -> str:
        """Return one sentence if the verdict is certain at ``state``, the last of ``frames``, else nothing."""
        left = self.end - state.time
        if state.time < self.hold * (1 - 1e-9) or not left > 0.0 or not self._undriven(state):
            return ""
        heights = object_heights(frames["rigid_positions"], frames["soft_centres"])
        drop = float(np.interp(self.lift, frames["times"], heights)) + self.rise - heights[-1]
        if abs(drop - self.threshold) < CLEAR:
            return ""
        at = f"at t = {state.time:.3f} s"
        if left * fastest(system, state) < STILL and self._stable(system, state):
            return f"{at} everything is at rest, in a stable equilibrium"
        if drop > SURE * self.threshold and self._fallen(system, state, drop):
            return f"{at} the object lies free, and cannot rise again"
        return ""

    @staticmethod
    def _undriven(state: State) -> bool:
        """Tell whether every drive has stalled or come to its end."""
        before = state.previous
        return before is not None and bool(np.all((state.progress == 1.0) | (state.progress == before.progress)))

    def _stable(self, system: System, state: State) -> bool:
        """Tell whether the forces that resist a small motion are positive definite at ``state``, without inertia.

        So they are where friction sticks, or the shape of what is in touch holds; a body that may roll away is not.
        """
        if not hasattr(self.stepper, "solver"):
            return False
        d = system.derivatives
        d.clear_hessian()
        system.add_hessian(state)
        system.hold_fixed()
        solver = self.stepper.solver(system)
        solver.forget()  # only the factorisation of this very matrix tells
        solution = solver.solve(d.blocks, d.coupling, d.rigid_matrix, np.ones_like(d.soft), np.zeros_like(d.rigid))
        solver.forget()  # it has no inertia: no use to a step
        return bool(solution.definite)

    def _fallen(self, system: System, state: State, drop: float) -> bool:
        """Tell whether a rigid object touches no finger, and all kinetic energy would not lift it far enough."""
        weight = float(np.linalg.norm(system.scene.gravity)) * float(np.sum(system.rigid_masses))
        if np.any(system.contact.soft_forces > 0.0) or not system.n_rigid or weight == 0.0:
            return False
        return drop - system.kinetic_energy(state) / weight > self.threshold + CLEAR


def object_heights(rigid: Sequence[Any] | np.ndarray, soft: Sequence[Any] | np.ndarray) -> list[float]:
    """Return the height of a grasp's object in each frame [m]: of the rigid body, or of the last soft one."""
    return [float(places[0][2]) if len(places) else float(centres[-1][2]) for places, centres in zip(rigid, soft)]


def fastest(system: System, state: State) -> float:
    """Return the largest speed of any point [m/s]."""
    turning = np.linalg.norm(system.spins(state.rigid_rotations, state.angular_momenta), axis=1) * system.rigid_sizes
    rigid = np.linalg.norm(state.rigid_velocities, axis=1) + turning
    soft = np.linalg.norm(state.velocities, axis=1)
    return max(float(np.max(soft, initial=0.0)), float(np.max(rigid, initial=0.0)))
