"""How long the next step is: shorter where one fails, longer where nothing happens."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.mechanics.state import Direction
from finqd.units import MM

if TYPE_CHECKING:
    from finqd.mechanics.state import State, StepReport
    from finqd.mechanics.system import System
    from finqd.scene import Scene

HALVINGS = 8  # a step is halved at most this often before the simulation ends as diverged
CALM_STEPS = 2  # steps that must succeed before a halved step is doubled again, or a whole one spans more frames
EASY = 10  # Newton iterations of such a step; one that takes more would hardly succeed at twice the length,
HARD_STEP = 0.25  # and counts for this much
NEWTON = 8  # iterations without a new matrix that one of Newton's costs as much as
SMOOTH = 10  # such iterations of a step after which longer ones are tried,
BUSY = 24  # and after which shorter ones are
STEADY = 0.05  # share of the contact forces that may change in a frame before longer steps are tried
JUMP = 0.3  # share of them that may change in a step of several frames; one that changes more is taken back
ROUGH = 0.1 * MM  # way by which a rigid body may leave a uniform motion in a frame, that counts as much as `STEADY`
LIGHT = 0.05  # [N] contact force below which changes count as share of this
FEW = 4  # Newton iterations that a long step is given, as many more for each renewal
AHEAD = 1.5  # lengths of a long step that must be free of contact, at the speeds of its start, where nothing touches


@dataclass(kw_only=True)
class StepControl:
    """Steps of one frame (the time step asked for), halved where one fails, doubled when calm.

    frame: [s]; longest: frames that a step may span where nothing happens; proposed: the stepper's own opinion [s],
    None as long as it has none; span: frames that the next step spans; quiet: steps since anything happened
    """

    frame: float
    longest: int = 1
    halvings: int = 0
    calm: float = 0.0
    proposed: float | None = None
    span: int = 1
    quiet: int = 0

    @property
    def shortest(self) -> float:
        return self.frame / 2**HALVINGS

    def length(self, left: float) -> float:
        """Return the next step [s], of ``left`` [s] to the end of the frame."""
        if self.proposed is None:
            return min(self.frame / 2**self.halvings, left)
        # equal steps to the end of the frame, so that none is a remainder
        return left / max(math.ceil(left / self.proposed * (1 - 1e-9)), 1)

    def judge(self, report: StepReport, dt: float) -> bool:
        """Take what a step of ``dt``, a frame at most, says; return whether to go on."""
        if report.next_dt is not None:
            if not report.converged and dt <= self.shortest * (1 + 1e-9):
                return False
            self.proposed = min(max(report.next_dt, self.shortest), self.frame)
        elif report.converged:
            self.calm += 1.0 if report.iterations <= EASY else HARD_STEP
            if self.calm >= CALM_STEPS and self.halvings:
                self.halvings, self.calm = self.halvings - 1, 0.0
        elif self.halvings == HALVINGS:
            return False
        else:
            self.halvings, self.calm = self.halvings + 1, 0.0
        return True

    def look(self, report: StepReport, change: float) -> None:
        """Note how a whole step went: ``change`` is what `happened` in a frame of it."""
        if self.longest == 1 or self.proposed is not None:
            return
        effort = NEWTON * report.iterations + report.quasi_iterations
        if self.halvings or not report.converged or effort > BUSY or change > STEADY:
            self.begin_anew()
            return
        self.quiet = self.quiet + 1 if effort <= SMOOTH else 0
        if self.quiet >= CALM_STEPS and self.span < self.longest:
            self.span, self.quiet = min(2 * self.span, self.longest), 0

    def begin_anew(self) -> None:
        """Go on with steps of one frame: something happens."""
        self.span, self.quiet = 1, 0


def happened(system: System, start: State, end: State, before: np.ndarray) -> float:
    """Return how much has happened in a step, as a share of the contact forces; ``before`` [N]: those at its start."""
    return max(force_change(before, system.contact.soft_forces), STEADY / ROUGH * unrest(system, start, end))


def force_change(before: np.ndarray, after: np.ndarray) -> float:
    """Return the share of the largest normal force by which that on any soft body changes; 1 if one is touched anew.

    before, after: [N], (n_soft,)
    """
    if np.any((before > 0.0) != (after > 0.0)):
        return 1.0
    size = max(float(np.max(before, initial=0.0)), float(np.max(after, initial=0.0)), LIGHT)
    return float(np.max(np.abs(after - before), initial=0.0)) / size


def unrest(system: System, start: State, end: State) -> float:
    """Return how far any rigid body has left a uniform motion in a step [m], as seen from what drives are mounted on.

    |v1 - v0 - (m1 - m0)| dt and the same of the angular velocities times the body's radius; m: the mount's velocities.
    """
    if not system.n_rigid or start.previous is None:
        return 0.0
    dt = end.time - start.time
    turn = system.spins(end.rigid_rotations, end.angular_momenta) - system.spins(
        start.rigid_rotations, start.angular_momenta)
    change = end.rigid_velocities - start.rigid_velocities
    motions = system.scene.motions
    if motions:
        poses = [motions[0][2].mount(time) for time in (start.previous.time, start.time, end.time)]
        ways = [(b - a)[:3, 3] + start.rigid_positions @ (b - a)[:3, :3].T for a, b in zip(poses, poses[1:])]
        change = change - (ways[1] / dt - ways[0] / (start.time - start.previous.time))
    roughest = np.linalg.norm(change, axis=1) + np.linalg.norm(turn, axis=1) * system.rigid_sizes
    return float(np.max(np.where(system.rigid_held, 0.0, roughest))) * dt


@dataclass(frozen=True)
class Timetable:
    """When drives begin and end [s], which no long step passes over."""

    times: tuple[float, ...] = field(default=())

    @classmethod
    def of(cls, scene: Scene) -> Timetable:
        """Return that of a scene's motions and of what carries them."""
        timed = [part for _, _, motion in scene.motions for part in (motion, *motion.carriers)]
        return cls(tuple(sorted({t for part in timed for t in (part.start, part.start + part.duration)})))

    def frames(self, time: float, frame: float, most: int) -> int:
        """Return how many whole frames [s], ``most`` of them, there are from ``time`` [s] to the next entry."""
        if any(abs(t - time) <= frame for t in self.times if t <= time + 1e-9 * frame):
            return 1  # one of them has just been
        ahead = [int((t - time) / frame * (1 + 1e-9)) for t in self.times if t > time + 1e-9 * frame]
        return max(1, min([most, *ahead]))


def hasty(stepper: Any) -> Any:
    """Return the stepper that tries long steps: it gives up soon, as shorter ones will do then."""
    if not hasattr(stepper, "max_iterations"):
        return stepper
    return replace(stepper, max_iterations=min(stepper.max_iterations, FEW))


def way_is_free(system: System, state: State, dt: float) -> bool:
    """Tell whether nothing that touches nothing soft comes to do so within ``dt`` [s], at today's velocities."""
    spins = system.spins(state.rigid_rotations, state.angular_momenta)
    rigid = np.concatenate([state.rigid_velocities, spins], axis=1)
    direction = Direction(soft=AHEAD * dt * state.velocities, rigid=AHEAD * dt * rigid)
    return bool(system.contact.step_limit(state, direction) == 1.0)
