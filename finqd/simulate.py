"""The time loop: steps, step control, recording."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd import registry
from finqd.errors import InputError
from finqd.mechanics.state import State, StepReport
from finqd.mechanics.system import System
from finqd.trajectory import Trajectory

if TYPE_CHECKING:
    from finqd.scene import Scene

HALVINGS = 8  # a step is halved at most this often before the simulation ends as diverged
CALM_STEPS = 2  # steps that must succeed before a halved step is doubled again
EASY = 10  # Newton iterations of such a step; one that takes more would hardly succeed at twice the length,
HARD_STEP = 0.25  # and counts for this much


@dataclass(kw_only=True)
class _Recorder:
    """Collects what becomes a `Trajectory`."""

    record: bool
    rows: dict[str, list[Any]] = field(default_factory=dict)
    counters: dict[str, int] = field(default_factory=dict)
    largest_penetration: float = 0.0

    def frame(self, system: System, state: State) -> None:
        """Take one moment."""
        kinetic = 0.5 * float(np.vdot(system.masses, np.sum(state.velocities**2, axis=1)))
        values = {
            "times": state.time, "rigid_positions": state.rigid_positions, "rigid_rotations": state.rigid_rotations,
            "contact_forces": system.contact.soft_forces, "penetrations": self.largest_penetration,
            "stroke": state.progress, "kinetic": kinetic, "elastic": system.elastic_energy(state.positions),
        }
        if self.record:
            values["soft_positions"] = state.positions
        for key, value in values.items():
            self.rows.setdefault(key, []).append(value)
        self.largest_penetration = 0.0

    def count(self, report: StepReport) -> None:
        """Add up the counters of one attempted step."""
        counted = {
            "steps": int(report.converged), "rejected_steps": int(not report.converged),
            "newton_iterations": report.iterations, "quasi_iterations": report.quasi_iterations,
            "rigid_iterations": report.rigid_iterations, "line_search_steps": report.line_searches,
            "factorisations": report.factorisations, "cg_iterations": report.cg_iterations,
            "projections": report.projections, "friction_updates": report.friction_updates,
            "error_rejections": report.error_rejections, "error_overruns": report.error_overruns,
            "substeps": report.substeps,
        }
        for key, value in counted.items():
            self.counters[key] = self.counters.get(key, 0) + value

    def trajectory(self, **rest: Any) -> Trajectory:
        """Return everything collected."""
        arrays: dict[str, Any] = {key: np.array(value) for key, value in self.rows.items()}
        energies = {key: arrays.pop(key) for key in ("kinetic", "elastic")}
        soft = arrays.pop("soft_positions", np.zeros((0, 0, 3)))
        times = arrays["times"] if self.record else np.zeros(0)
        return Trajectory(
            **arrays, energies=energies, soft_positions=soft, recorded_times=times, counters=dict(self.counters), **rest
        )


@dataclass(kw_only=True)
class _StepControl:
    """How long the next step is: halved where one fails, doubled when calm; or what the stepper proposes.

    frame: longest step [s]; proposed: the stepper's own opinion [s], None as long as it has none
    """

    frame: float
    halvings: int = 0
    calm: float = 0.0
    proposed: float | None = None

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
        """Take what a step of ``dt`` says; return whether to go on."""
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


def simulate(
    scene: Scene, *, duration: float, time_step: float, stepper: Any = "implicit_euler", contact: Any = "penalty",
    record: bool = False, wall_clock_limit: float = math.inf, progress: Callable[[float], None] | None = None,
    watch: Callable[[System, State], None] | None = None,
) -> Trajectory:
    """Run ``scene`` for ``duration`` [s] in steps of at most ``time_step`` [s].

    stepper, contact: plugins or their names. record: keep soft positions of every frame (one a time step).
    progress: called with the share of time done; watch: called with the system and the state after every step.
    A step that fails is halved, up to 2^-8, then the run ends with status ``diverged``; a run that takes longer than
    ``wall_clock_limit`` [s] ends with status ``timeout``. A stepper that estimates its error chooses its steps itself,
    within the same bounds; then ``time_step`` is only how often a frame is kept. Raises InputError for numbers that
    make no sense.
    """
    for name, value in (("duration", duration), ("time_step", time_step)):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{name} must be a positive number of seconds, not {value}")
    begun = clock.perf_counter()
    stepper = registry.create("stepper", stepper) if isinstance(stepper, (str, dict)) else stepper
    contact = registry.create("contact", contact) if isinstance(contact, (str, dict)) else contact
    system = System(scene, contact=contact)
    state = system.initial_state()
    recorder = _Recorder(record=record)
    system.contact.begin_step(state)
    system.contact.commit(state)
    recorder.frame(system, state)
    set_up = clock.perf_counter() - begun
    status, reason = "ok", ""
    frames = max(round(duration / time_step), 1)
    control = _StepControl(frame=duration / frames)
    system.shortest_step = control.shortest
    for frame in range(1, frames + 1):
        frame_end = duration * frame / frames
        while status == "ok" and state.time < frame_end * (1 - 1e-12):
            dt = control.length(frame_end - state.time)
            state, report = stepper.step(system, state, dt)
            recorder.count(report)
            recorder.largest_penetration = max(recorder.largest_penetration, system.contact.penetration)
            if not control.judge(report, dt):
                status, reason = "diverged", f"at t = {state.time:.4f} s, dt = {dt:.2g} s: {report.reason}"
            elif report.converged and watch is not None:
                watch(system, state)
            if status == "ok" and clock.perf_counter() - begun > wall_clock_limit:
                status, reason = "timeout", f"at t = {state.time:.4f} s after {wall_clock_limit:g} s of computing"
        if status != "ok":
            break
        recorder.frame(system, state)
        if progress is not None:
            progress(frame / frames)
    timings = {"set_up": set_up, "steps": clock.perf_counter() - begun - set_up}
    return recorder.trajectory(status=status, reason=reason, timings=timings)
