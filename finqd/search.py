"""Search the design space for a map of different good grippers: ask, evaluate, tell.

The algorithms (`finqd.algorithms`) run over the unit cube of whatever parameters the geometry declares. The run's log
is the truth (`finqd.runlog`): each evaluation is in it before the algorithm is told, and on an existing log the
algorithm is asked and told again, from the log, up to where it stood. So the same seed gives the same archive with any
number of jobs, in one go or killed and resumed, as long as no evaluation runs into its time limit.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from finqd import archive as qd
from finqd.algorithms import ALGORITHMS, new_scheduler, reflected
from finqd.design import Design, design_parameters
from finqd.errors import InputError
from finqd.fidelity import Agreement, agreement
from finqd.runlog import Record, Run, RunLog, begun, read_run
from finqd.search_evaluate import Evaluations, evaluated
from finqd.search_files import write_derived
from finqd.search_progress import Reporter, Standing
from finqd.search_settings import check_options, check_ranges, refuse_changes, settings_of
from finqd.workers import Workers, open_workers
from finqd.workers_task import check_limits

if TYPE_CHECKING:
    from ribs.archives import GridArchive
    from ribs.schedulers import Scheduler

__all__ = ["ALGORITHMS", "Evaluator", "SearchResult", "Standing", "optimise", "reflected"]

SAME = 1e-6  # of the cube's edge: another machine's rounding; more is another algorithm

Progress = Callable[[str, float], None]


class Evaluator(Protocol):
    """What a search calls on a design: `finqd.evaluate.evaluate`, or anything that can be pickled and looks like it.

    The result has ``fitness`` in [0, 1], ``margin`` in [-1, 1], ``features``, and ``to_dict()``, in which ``objects``
    holds a row for each object. Its name is a setting of the run; what it does must follow from the design alone.
    """

    def __call__(self, design: Design, *, objects: Any, preset: str, jobs: int, progress: Progress) -> Any: ...  # noqa: D102


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """The archive of a search, its run as `finqd.runlog.read_run` reads it, and where the search stood at its end."""

    archive: GridArchive
    run: Run
    standing: Standing
    out: Path

    @property
    def ranges(self) -> qd.Ranges:
        """The map's axes: feature -> range."""
        return self.run.ranges

    @cached_property
    def records(self) -> tuple[Record, ...]:
        """What the search was told, in order."""
        return self.run.records()

    @property
    def agreement(self) -> Agreement | None:
        """How often screening and confirmation disagree, None without screening."""
        if self.run.settings["screen"] is None:
            return None
        return agreement(self.records, qd.entered(self.archive, self.records, self.ranges))

    @property
    def elites(self) -> list[tuple[tuple[int, ...], qd.Record]]:
        """Grid cell and record of each elite."""
        return qd.elites(self.archive, self.records)


def optimise(
    *, out: Path, algorithm: str = "cma_me", iterations: int = 5, batch: int = 15,
    objects: Sequence[Any] | None = None, jobs: int = 1, seed: int = 0, preset: str = "standard",
    screen: str | None = None, base_design: Design | None = None, evaluate: Evaluator | None = None, cells: int = 10,
    ranges: qd.Ranges | None = None, time_limit_s: float | None = 3600.0, workers: Workers | None = None,
    other_versions: bool = False, progress: Progress | None = None, report: Callable[[Standing], None] | None = None,
) -> SearchResult:
    """Run ``iterations`` rounds of ``batch`` designs each, or what is left of them; return the archive.

    out: the run's folder; one that holds a run goes on with it. `finqd.search_files` lists what else is in it
    algorithm: one of `ALGORITHMS`
    objects: as for `finqd.evaluate.evaluate`; None means all that come with finqd
    jobs: designs evaluated side by side, each in a worker process
    preset: of all evaluations; screen: a cheaper one, with which every design is evaluated first: then only those that
        would enter the map are evaluated with ``preset``, and only these results can become elites
    base_design: where geometry, material, plugins and protocol come from; its fingers and spacing do not matter
    cells: cells of the map along each feature
    ranges: features to map and their ranges, in their units; by default the first feature of each feature plugin of
        the design, with the range that `finqd.archive.feature_ranges` finds
    time_limit_s: wall-clock seconds of one evaluation, None: as long as it takes; who takes longer has failed
    workers: where evaluations run, see `finqd.workers.Workers`; by default ``jobs`` processes (in this one with one job
        and no time limit)
    other_versions: go on with a run that was begun with other versions of finqd or its libraries
    progress: called as ``progress("iteration 1 of 5", fraction)``; report: called with a `Standing` after each design

    A design that fails (no simulation finished, its process crashed twice, time limit) is in the log with its reason
    and never an elite. Raises ``InputError`` for bad options, a folder that is neither empty nor a run, a run that
    began with other settings (``iterations`` may grow) or that another process writes to, and a full disk. Ctrl-C ends
    the workers, leaves the log with all that finished, and is raised again.
    """
    presets: dict[str, Any] = {"preset": preset, "screen": screen}
    check_options(
        algorithm=algorithm, objects=objects, presets=presets, ranges=ranges, iterations=iterations, batch=batch,
        seed=seed, cells=cells,
    )  # fmt: skip
    check_limits(time_limit_s=time_limit_s)
    call = partial(evaluated, evaluate=evaluate or _default_evaluator(), objects=objects)
    base = {} if base_design is None else {k: v for k, v in base_design.settings.items() if k != "name"}
    settings = partial(
        settings_of, base=base, objects=objects, algorithm=algorithm, seed=seed, iterations=iterations, batch=batch,
        cells=cells, limits={"time_limit_s": time_limit_s}, evaluate=call.keywords["evaluate"], **presets,
    )  # fmt: skip
    kind = "inline" if jobs == 1 and time_limit_s is None else "processes"
    with ExitStack() as stack:
        mine = stack.enter_context(open_workers(kind, jobs=jobs)) if workers is None else workers
        log = stack.enter_context(_log(Path(out), base, ranges, settings, other_versions=other_versions))
        run_all = partial(mine.run, time_limit_s=time_limit_s)
        search = _Search.start(log, run_all=run_all, call=call, report=report)
        try:
            for iteration in range(iterations):
                name = f"iteration {iteration + 1} of {iterations}"
                search.step(iteration, partial(progress, name) if progress else None)
                search.refresh()
        finally:
            search.refresh(always=True)
        return SearchResult(archive=search.archive, run=read_run(Path(out)), standing=search.reporter.standing, out=out)


@contextmanager
def _log(
    out: Path, base: Mapping[str, Any], ranges: qd.Ranges | None, settings: Callable[..., dict[str, Any]], *,
    other_versions: bool,
) -> Iterator[RunLog]:
    """Open the log of a run that goes on, if that is the same run, or begin a new one."""
    parameters = design_parameters(base.get("geometry", "fin_ray"))
    if ranges is not None:
        check_ranges(ranges, base, len(parameters))
    if begun(out):
        with RunLog(out) as log:
            old = log.run.settings
            sampled = ranges is None and old.get("sampled")
            new = settings(ranges=log.run.ranges if sampled else ranges or {}, sampled=ranges is None)
            refuse_changes(old, new, other_versions=other_versions, where=str(out))
            if new != old:
                log.change_settings(new)
            yield log
        return
    found = ranges or qd.feature_ranges(partial(Design.from_unit_vector, **base), len(parameters))
    new = settings(ranges=found, sampled=ranges is None)
    with RunLog.start(out, settings=new, base=base, parameters=parameters, ranges=found) as log:
        yield log


@dataclass
class _Search:
    """A search under way: a pure function of seed and log, and what is evaluated where the log ends."""

    log: RunLog
    evaluations: Evaluations
    reporter: Reporter
    archive: GridArchive
    scheduler: Scheduler
    told: int  # of an earlier session
    redraws: int = 0
    written: dict[tuple[int, ...], int] = field(default_factory=dict)  # what lies in the folder: cell -> evaluation

    @classmethod
    def start(
        cls, log: RunLog, *, run_all: Callable[..., Any], call: Callable[..., Any],
        report: Callable[[Standing], None] | None,
    ) -> _Search:
        run, settings = log.run, log.run.settings
        total = settings["iterations"] * settings["batch"]
        standing = Standing(
            iteration=0, iterations=settings["iterations"], evaluations=0, total=total, seconds=log.seconds
        )
        reporter = Reporter(run.folder, standing=standing, report=report)
        evaluations = Evaluations(
            log=log, run_all=run_all, call=call, base=run.base, parameters=run.parameters, features=tuple(run.ranges),
            seed=settings["seed"], versions=settings["versions"], clock=lambda: reporter.seconds,
        )  # fmt: skip
        archive = qd.new_archive(
            len(run.parameters), run.ranges, cells=settings["cells"], seed=_stream(settings["seed"], 0)
        )
        scheduler = new_scheduler(settings["algorithm"], archive, settings["batch"], _stream(settings["seed"], 1))
        return cls(log, evaluations, reporter, archive, scheduler, log.told)

    def step(self, iteration: int, shown: Callable[[float], None] | None) -> None:
        """Ask for a batch, evaluate what the log does not hold, note that it is told, and tell it."""
        batch = self.log.run.settings["batch"]
        first = iteration * batch
        self.reporter.begin_iteration(iteration)
        asked = self.scheduler.ask()
        known = self.log.evaluations(first, first + batch)
        units = self._agreed(asked, first, known)
        records = self._evaluated(units, iteration, known, shown)
        old = first + batch <= self.told
        if not old:
            self.log.note_told(first + batch)
        self.tell([records[index] for index in units])
        self.reporter.end_iteration(iteration, self.archive, quiet=old)

    def _evaluated(
        self, units: Mapping[int, np.ndarray], iteration: int, known: Mapping[tuple[int, str], Record],
        shown: Callable[[float], None] | None,
    ) -> dict[int, Record]:
        """Return the final record of each design: the confirmed one, if it was screened and would enter the map."""
        settings, fractions = self.log.run.settings, dict.fromkeys(units, 0.0)
        screen, final = settings["screen"], settings["confirm"] or settings["preset"]

        def move(index: int, fraction: float) -> None:
            fractions[index] = fraction
            if shown is not None:
                shown(sum(fractions.values()) / len(fractions))

        def finish(record: Record) -> None:
            (self.reporter.recall if (record["index"], record["preset"]) in known else self.reporter.count)(record)
            move(record["index"], 1.0)

        def noted(record: Record) -> None:
            if record["preset"] == final or not self._enters(record):
                finish(record)

        stage = partial(
            self.evaluations.stage, iteration=iteration, known=known, on_record=noted, empty=self.archive.empty
        )
        if screen is None:
            records = stage(units, preset=final, on_progress=move)
        else:
            screened = stage(units, preset=screen, on_progress=lambda i, fraction: move(i, 0.5 * fraction))
            chosen = {i: unit for i, unit in units.items() if self._enters(screened[i])}
            confirmed = stage(chosen, preset=final, on_progress=lambda i, fraction: move(i, 0.5 + 0.5 * fraction))
            records = {i: {**confirmed[i], "screen": screened[i]} if i in chosen else screened[i] for i in units}
        for index, record in records.items():
            if (index, record["preset"]) in known:
                finish(record)
        return records

    def _enters(self, record: Record) -> bool:
        """Return whether a design would enter the map as it was before this batch, if its screening were true."""
        return record["status"] == "ok" and qd.would_enter(self.archive, record, self.log.run.ranges)

    def _agreed(
        self, asked: np.ndarray, first: int, known: Mapping[tuple[int, str], Record]
    ) -> dict[int, np.ndarray]:
        """Return index -> point of the cube, of the log where it has one, which must be the one asked for.

        Another machine may round otherwise, and an evolution strategy then asks for the same points but for that.
        """
        logged = {index: np.array(record["unit"]) for (index, _), record in known.items()}
        for i, unit in enumerate(asked):
            if first + i in logged and not np.allclose(unit, logged[first + i], rtol=0.0, atol=SAME):
                text = f"cannot go on: its algorithm asks for another design as evaluation {first + i} than it did"
                raise InputError(f"{text} when that was evaluated, so ribs or NumPy differ", str(self.log.run.folder))
        units = np.array([logged.get(first + i, unit) for i, unit in enumerate(asked)])
        self.scheduler._cur_solutions = units  # type: ignore[assignment]  # what is told is what was evaluated; there is no public way to say so
        return {first + i: unit for i, unit in enumerate(units)}

    def tell(self, batch: list[Record]) -> None:
        """Tell the algorithm what became of what it asked for."""
        settings = self.log.run.settings
        nothing = self.archive.empty and all(record["status"] != "ok" for record in batch)
        if nothing and ALGORITHMS[settings["algorithm"]].restarts:
            # Nothing to learn from, and ribs would restart from an elite, of which there is none: draw anew instead.
            self.redraws += 1
            seed = _stream(settings["seed"], 1 + self.redraws)
            self.scheduler = new_scheduler(settings["algorithm"], self.archive, settings["batch"], seed)
            return
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".* was empty before adding solutions")
            qd.tell(self.scheduler, batch, self.log.run.ranges)

    def refresh(self, *, always: bool = False) -> None:
        """Write the files that are derived from the log, at the end and now and then before."""
        write_derived(self.log, self.archive, self.written, always=always)


def _default_evaluator() -> Evaluator:
    from finqd.evaluate import evaluate

    return evaluate


def _stream(seed: int, number: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=(number,))
