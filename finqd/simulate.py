"""The time loop: steps, step control, recording."""

from __future__ import annotations

import math
import os
import time as clock
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd import registry
from finqd.checkpoint import Checkpoint, fingerprint
from finqd.errors import InputError
from finqd.mechanics.state import State, StepReport
from finqd.mechanics.system import System
from finqd.step_control import JUMP, StepControl, Timetable, happened, hasty, way_is_free
from finqd.trajectory import Trajectory

if TYPE_CHECKING:
    from finqd.profiling import Profile
    from finqd.scene import Scene
#: asked at a frame: system, state, and by name what has been recorded of all frames so far
Decided = Callable[[System, State, Mapping[str, Sequence[Any]]], str]
KEPT = ("halvings", "calm", "proposed", "span", "quiet")  # of the step control, in a checkpoint


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
            "soft_centres": system.soft_centres(state.positions),
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
class _Run:
    """A simulation on its way: ``done`` of its ``frames`` are behind it."""

    system: System
    stepper: Any
    recorder: _Recorder
    control: StepControl
    state: State
    duration: float
    frames: int
    done: int = 0
    status: str = "ok"
    reason: str = ""
    ended: str = ""
    decided: Decided | None = None
    timetable: Timetable = field(default_factory=Timetable)
    report: StepReport = field(default_factory=StepReport)

    def start(self) -> None:
        """Take the first frame."""
        self.system.contact.begin_step(self.state)
        self.system.contact.commit(self.state)
        self.recorder.frame(self.system, self.state)

    def go(self, after_step: Callable[[], None], progress: Callable[[float], None] | None) -> None:
        """Step to the end, until ``decided`` says why that need not be reached, or ``status`` is not "ok" any more."""
        while self.done < self.frames and not self.ended:
            if self._long_step():
                after_step()
            frame_end = self.duration * (self.done + 1) / self.frames
            while self.status == "ok" and self.state.time < frame_end * (1 - 1e-12):
                self._step(frame_end - self.state.time)
                after_step()
            if self.status != "ok":
                break
            self.recorder.frame(self.system, self.state)
            self.done += 1
            self.ended = "" if self.decided is None else self.decided(self.system, self.state, self.recorder.rows)
            if progress is not None:
                progress(1.0 if self.ended else self.done / self.frames)

    def _step(self, left: float) -> None:
        dt = self.control.length(left)
        start, before = self.state, self.system.contact.soft_forces
        self.state, self.report = self.stepper.step(self.system, start, dt)
        self._count()
        if not self.control.judge(self.report, dt):
            self.status = "diverged"
            self.reason = f"at t = {self.state.time:.4f} s, dt = {dt:.2g} s: {self.report.reason}"
        if self.report.converged and self.control.longest > 1:
            self.control.look(self.report, happened(self.system, start, self.state, before))

    def _count(self) -> None:
        """Take what the last step says of itself."""
        self.recorder.count(self.report)
        self.recorder.largest_penetration = max(self.recorder.largest_penetration, self.system.contact.penetration)

    def _long_step(self) -> bool:
        """Try a step of several frames, where nothing has happened lately; take it back if something does in it."""
        control, system, start = self.control, self.system, self.state
        frame = control.frame
        if control.span == 1 or abs(start.time - self.done * frame) > 1e-9 * frame:
            return False
        span = self.timetable.frames(start.time, frame, min(control.span, self.frames - self.done))
        if span == 1:
            return False
        before = system.contact.soft_forces
        if not np.any(before > 0.0) and not way_is_free(system, start, span * frame):
            control.begin_anew()
            return False
        kept, deepest = system.contact.history(), self.recorder.largest_penetration
        end = self.duration * (self.done + span) / self.frames
        self.state, self.report = hasty(self.stepper).step(system, start, end - start.time)
        change = happened(system, start, self.state, before) if self.report.converged else 1.0
        if change > JUMP:
            system.contact.restore(kept)
            self.report.converged = False
            self.state, self.recorder.largest_penetration = start, deepest
            self.recorder.count(self.report)
            control.begin_anew()
            return False
        self._count()
        control.look(self.report, change / span)
        self.done += span - 1  # its last frame is recorded as any other
        return True


@dataclass(kw_only=True)
class _Keeper:
    """Writes a run to its checkpoint now and then; never changes how it goes."""

    path: Path
    fingerprint: str
    every: float
    full: bool = False  # it could not be written
    last: float = field(default_factory=clock.perf_counter)

    def look(self, run: _Run) -> None:
        """Save the run if the last time is long ago."""
        if clock.perf_counter() - self.last >= self.every:
            self.save(run)

    def save(self, run: _Run) -> None:
        """Write the run as it is after its last step; where that fails, say so once and let the run go on."""
        if self.full:
            return
        try:
            self._checkpoint(run).save(self.path)
        except OSError as error:
            warnings.warn(f"no checkpoint {self.path}: {error.strerror or error}", RuntimeWarning, stacklevel=2)
            self.full = True
        self.last = clock.perf_counter()

    def _checkpoint(self, run: _Run) -> Checkpoint:
        rows, control = run.recorder.rows, run.control
        header = {
            "done": run.done, "status": run.status, "reason": run.reason, "counters": run.recorder.counters,
            "largest_penetration": run.recorder.largest_penetration, "ended": run.ended,
            **{name: getattr(control, name) for name in KEPT},
        }
        return Checkpoint(
            fingerprint=self.fingerprint, state=run.state, history=run.system.history(),
            rows={name: np.array(values) for name, values in rows.items()}, header=header,
        )

    def restore(self, run: _Run) -> bool:
        """Take the run to where the checkpoint is, if there is one; return whether there is.

        Raises InputError for a file that cannot be a checkpoint of this run, and if there is no place for one.
        """
        if not hasattr(run.system.contact, "history"):
            raise InputError("the contact plugin cannot be stopped: it has no history()", str(self.path))
        if not self.path.parent.is_dir():
            raise InputError("its folder does not exist", str(self.path))
        if not self.path.exists():
            return False
        kept = Checkpoint.load(self.path, fingerprint=self.fingerprint)
        head = kept.header
        run.state, run.done = kept.state, head["done"]
        run.system.restore(kept.history)
        run.recorder.rows = {name: list(values) for name, values in kept.rows.items()}
        run.recorder.counters, run.recorder.largest_penetration = dict(head["counters"]), head["largest_penetration"]
        run.ended = head["ended"]
        for name in KEPT:
            setattr(run.control, name, head[name])
        if head["status"] == "diverged":
            run.status, run.reason = head["status"], head["reason"]
        return True


def simulate(
    scene: Scene, *, duration: float, time_step: float, stepper: Any = "implicit_euler", contact: Any = "penalty",
    record: bool = False, wall_clock_limit: float = math.inf, progress: Callable[[float], None] | None = None,
    watch: Callable[[System, State], None] | None = None, checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: float = 10.0, longest_step: int = 1, decided: Decided | None = None,
    profile: Profile | None = None,
) -> Trajectory:
    """Run ``scene`` for ``duration`` [s] in steps of at most ``time_step`` [s].

    stepper, contact: plugins or their names. record: keep soft positions of every frame (one a time step).
    progress: called with the share of time done; watch: called with the system and the state after every step.
    checkpoint: a file that the simulation is kept in, written every ``checkpoint_every`` [s] of computing and at its
    end. If it is there already, the simulation goes on from it, and ends with the same bits as one that was never
    stopped; the time limit begins anew.
    longest_step: time steps that one may span where nothing happens: no contact begins or ends, its forces hardly
    change, and no drive begins or ends. A long step in which something does happen is taken back, and gone through in
    single ones. decided: asked at every frame; it returns why the rest need not be simulated, or nothing. The
    trajectory then ends there, with that sentence as ``ended``. profile: of `finqd.profiling.profiled`, to note where
    the time goes; no result depends on it.
    A step that fails is halved, up to 2^-8, then the run ends with status ``diverged``; a run that takes longer than
    ``wall_clock_limit`` [s] ends with status ``timeout``. A stepper that estimates its error chooses its steps itself,
    within the same bounds; then ``time_step`` is only how often a frame is kept. Raises InputError for numbers that
    make no sense, and for a checkpoint that is damaged or belongs to another simulation.
    """
    if longest_step < 1:
        raise InputError(f"longest_step must be 1 or more time steps, not {longest_step}")
    for name, value in (("duration", duration), ("time_step", time_step)):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{name} must be a positive number of seconds, not {value}")
    begun = clock.perf_counter()
    stepper = registry.create("stepper", stepper) if isinstance(stepper, (str, dict)) else stepper
    contact = registry.create("contact", contact) if isinstance(contact, (str, dict)) else contact
    system = System(scene, contact=contact)
    frames = max(round(duration / time_step), 1)
    run = _Run(
        system=system, stepper=stepper, duration=duration, frames=frames, recorder=_Recorder(record=record),
        control=StepControl(frame=duration / frames, longest=longest_step if hasattr(system.contact, "history") else 1),
        state=system.initial_state(), decided=decided, timetable=Timetable.of(scene),
    )
    system.shortest_step = run.control.shortest
    keeper = None
    if checkpoint is not None:
        named = fingerprint(
            scene, duration=duration, frames=frames, record=record, stepper=stepper, contact=contact,
            longest_step=longest_step, decided=decided if is_dataclass(decided) else decided is not None,
        )
        keeper = _Keeper(path=Path(checkpoint), fingerprint=named, every=checkpoint_every)
    if keeper is None or not keeper.restore(run):
        run.start()
    set_up = clock.perf_counter() - begun
    if profile is not None:
        profile.watch(run, keeper)

    def after_step() -> None:
        if keeper is not None:
            keeper.look(run)
        if run.report.converged and watch is not None:
            watch(system, run.state)
        if run.status == "ok" and clock.perf_counter() - begun > wall_clock_limit:
            run.status = "timeout"
            run.reason = f"at t = {run.state.time:.4f} s after {wall_clock_limit:g} s of computing"

    run.go(after_step, progress)
    if keeper is not None:
        keeper.save(run)
    timings = {"set_up": set_up, "steps": clock.perf_counter() - begun - set_up}
    met = [[*pair, time] for pair, time in getattr(system.contact, "met_pairs", dict)().items()]
    return run.recorder.trajectory(
        status=run.status, reason=run.reason, ended=run.ended, timings=timings,
        effects={"met": met} if met else {},
    )
