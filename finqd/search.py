"""Search the design space for a map of different good grippers: ask, evaluate, tell.

CMA-ME (Fontaine et al. 2020, arXiv:1912.02400) through ``ribs``: a grid archive over the features and one emitter that
ranks by improvement, over the unit cube of whatever parameters the geometry declares. The same seed gives the same
archive with any number of jobs, as long as no evaluation runs into its time limit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from finqd import archive as qd
from finqd.contracts import Parameter
from finqd.data import bundled_names, objects_folder
from finqd.design import Design, design_parameters
from finqd.errors import InputError, MissingLibraryError
from finqd.runlog import RunLog, new_run_folder
from finqd.search_files import record_of, settings_of, write_archive, write_json
from finqd.search_plots import draw
from finqd.workers import TaskFailure, run_tasks

if TYPE_CHECKING:
    from ribs.archives import GridArchive
    from ribs.schedulers import Scheduler

SIGMA0 = 0.2  # of the unit cube's edge: larger steps mostly leave it

Progress = Callable[[str, float], None]


class Evaluator(Protocol):
    """What a search calls on a design: `finqd.evaluate.evaluate`, or anything that can be pickled and looks like it.

    The result has ``fitness`` in [0, 1], ``margin`` in [-1, 1], ``features``, and ``to_dict()``, in which ``objects``
    holds a row for each object.
    """

    def __call__(self, design: Design, *, objects: Any, preset: str, jobs: int, progress: Progress) -> Any: ...  # noqa: D102


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """The archive of a search, the records that it was told (those of the log, in order), and the map's axes."""

    archive: GridArchive
    records: tuple[qd.Record, ...]
    ranges: qd.Ranges
    out: Path

    @property
    def elites(self) -> list[tuple[tuple[int, ...], qd.Record]]:
        """Grid cell and record of each elite."""
        return qd.elites(self.archive, self.records)


def optimise(
    *,
    out: Path,
    iterations: int = 5,
    batch: int = 15,
    objects: Sequence[Any] | None = None,
    jobs: int = 1,
    seed: int = 0,
    preset: str = "standard",
    base_design: Design | None = None,
    evaluate: Evaluator | None = None,
    cells: int = 10,
    ranges: qd.Ranges | None = None,
    time_limit_s: float = 3600.0,
    progress: Progress | None = None,
) -> SearchResult:
    """Run ``iterations`` rounds of ``batch`` designs each; return the archive. `finqd.search_files` lists the files.

    objects: as for `finqd.evaluate.evaluate`; None means all that come with finqd
    jobs: designs evaluated side by side, each in a worker process
    base_design: where geometry, material, plugins and protocol come from; its fingers and spacing do not matter
    cells: cells of the map along each feature
    ranges: features to map and their ranges, in their units; by default the first feature of each feature plugin of
        the design, with the range that `finqd.archive.feature_ranges` finds
    time_limit_s: wall-clock seconds of one evaluation; a design that takes longer has failed
    progress: called as ``progress("iteration 1 of 5", fraction)``

    A design that fails (no simulation finished, its process crashed, time limit) is a line of the log with its reason
    and never an elite. Raises ``InputError`` for bad options and for a folder that is not empty. Ctrl-C ends the
    workers, leaves the log with all that finished and the archive with all that was told, and is raised again.
    """
    _check(objects=objects, preset=preset, ranges=ranges, iterations=iterations, batch=batch, seed=seed, cells=cells)
    call = partial(_evaluated, evaluate=evaluate or _default_evaluator(), objects=objects, preset=preset)
    evaluate_all = partial(run_tasks, call, jobs=jobs, time_limit_s=time_limit_s)
    evaluate_all([])  # refuses its options before a file is written
    run = _Run.start(base_design, batch=batch, seed=seed, cells=cells, ranges=ranges)
    settings = settings_of(
        run.base, run.parameters, run.ranges, iterations=iterations, batch=batch, seed=seed, sigma0=SIGMA0, cells=cells,
        objects=objects, preset=preset, jobs=jobs, time_limit_s=time_limit_s,
    )  # fmt: skip
    out, status = new_run_folder(Path(out)), "interrupted"
    write_json(out / "run.json", {"status": "running", **settings})
    try:
        with RunLog(out / "evaluations.jsonl") as log:
            for iteration in range(iterations):
                shown = partial(progress, f"iteration {iteration + 1} of {iterations}") if progress else None
                run.step(iteration, evaluate_all, log, shown)
                write_archive(out, run.archive, run.records, run.ranges, run.parameters, run.decoded)
        status = "finished"
    finally:
        write_archive(out, run.archive, run.records, run.ranges, run.parameters, run.decoded)
        draw(out, run.archive, run.records, run.ranges)
        write_json(out / "run.json", {"status": status, "evaluations_told": len(run.records), **settings})
    return SearchResult(archive=run.archive, records=tuple(run.records), ranges=run.ranges, out=out)


@dataclass
class _Run:
    """A search under way."""

    base: Mapping[str, Any]  # what all designs share: geometry, material, plugins, protocol
    parameters: Sequence[tuple[str, Parameter]]
    ranges: qd.Ranges
    archive: GridArchive
    scheduler: Scheduler
    batch: int
    seed: int
    redraws: int = 0
    records: list[qd.Record] = field(default_factory=list)  # what was told, in order

    @classmethod
    def start(cls, base_design: Design | None, *, batch: int, seed: int, cells: int, ranges: qd.Ranges | None) -> _Run:
        base = {} if base_design is None else {k: v for k, v in base_design.settings.items() if k != "name"}
        parameters = design_parameters(base.get("geometry", "fin_ray"))
        found = ranges or qd.feature_ranges(partial(Design.from_unit_vector, **base), len(parameters))
        archive = qd.new_archive(len(parameters), found, cells=cells, seed=_stream(seed, 0))
        return cls(base, parameters, found, archive, _new_scheduler(archive, batch, _stream(seed, 1)), batch, seed)

    def step(
        self, iteration: int, evaluate_all: Callable[..., Any], log: RunLog, shown: Callable[[float], None] | None
    ) -> None:
        """Ask for a batch, evaluate it, log each result as it comes, tell all of them."""
        units = self.scheduler.ask()
        first = iteration * self.batch
        designs = [self.decoded(unit, first + i) for i, unit in enumerate(units)]
        valid = [i for i, design in enumerate(designs) if isinstance(design, Design)]
        records: dict[int, qd.Record] = {}
        refused: list[BaseException] = []
        fractions = np.zeros(len(units))

        def move(i: int, fraction: float) -> None:
            fractions[i] = fraction
            if shown is not None:
                shown(float(fractions.mean()))

        def keep(i: int, result: Any) -> None:
            record = record_of(units[i], designs[i], result, self.parameters, tuple(self.ranges))
            place = {"index": first + i, "iteration": iteration, "emitter": 0, "seed": self.seed}
            records[i] = {**place, **record}
            log.append(records[i])
            if isinstance(result, TaskFailure) and isinstance(result.exception, (InputError, MissingLibraryError)):
                refused.append(result.exception)
            move(i, 1.0)

        for i in sorted(set(range(len(units))) - set(valid)):
            keep(i, designs[i])
        evaluate_all(
            [designs[i] for i in valid],
            on_result=lambda k, result: keep(valid[k], result),
            on_progress=lambda k, fraction: move(valid[k], fraction),
        )
        if len(valid) == len(refused) > 0 and self.archive.empty:
            raise refused[0]  # not one design could be tried: it is what the user gave that is wrong
        self.tell([records[i] for i in range(len(units))])

    def tell(self, batch: list[qd.Record]) -> None:
        if self.archive.empty and all(record["status"] != "ok" for record in batch):
            # Nothing to learn from, and ribs would restart from an elite, of which there is none: draw anew instead.
            self.redraws += 1
            self.scheduler = _new_scheduler(self.archive, self.batch, _stream(self.seed, 1 + self.redraws))
        else:
            qd.tell(self.scheduler, batch, self.ranges)
        self.records.extend(batch)

    def decoded(self, unit: np.ndarray, index: int) -> Design | TaskFailure:
        """Return the design at a point of the unit cube, or why there is none there."""
        try:
            return Design.from_unit_vector(unit, **self.base, name=f"seed {self.seed}, evaluation {index}")
        except InputError as error:  # values that contradict each other, each within its range
            return TaskFailure(kind="invalid", reason=str(error))


def _evaluated(
    design: Design, *, evaluate: Evaluator, objects: Any, preset: str, progress: Callable[[float], None]
) -> dict[str, Any]:
    """Evaluate one design, in a worker; return the parts of the result that the search needs."""
    begin = time.perf_counter()
    fractions: dict[str, float] = {}
    expected = len(objects) if objects is not None else len(bundled_names(objects_folder()))

    def move(name: str, fraction: float) -> None:
        fractions[name] = fraction
        progress(sum(fractions.values()) / max(expected, len(fractions)))

    found = evaluate(design, objects=objects, preset=preset, jobs=1, progress=move)
    record = {"fitness": found.fitness, "margin": found.margin, "features": dict(found.features)}
    result = found.to_dict()
    record |= {"accuracy": result.get("accuracy", {}).get("sentence"), "objects": result.get("objects", {})}
    return {**record, "seconds": time.perf_counter() - begin}


def _default_evaluator() -> Evaluator:
    from finqd.evaluate import evaluate

    return evaluate


def _new_scheduler(archive: GridArchive, batch: int, seed: Any) -> Scheduler:
    from ribs.emitters import EvolutionStrategyEmitter
    from ribs.schedulers import Scheduler

    class Reflecting(EvolutionStrategyEmitter):
        """Folds what lies outside the unit cube back; ribs' own bounds draw again, near a corner without end."""

        def ask(self) -> np.ndarray:
            return reflected(super().ask())

    with np.errstate(invalid="ignore"):  # ribs divides 0 by 0 for a batch of one, and never uses the result
        emitter = Reflecting(
            archive, x0=np.full(archive.solution_dim, 0.5), sigma0=SIGMA0, ranker="2imp", batch_size=batch, seed=seed
        )
    # Added one by one: for a batch, a finite threshold_min makes a cell's threshold the mean of all that fell into it,
    # and then a later, worse design replaces its elite.
    return Scheduler(archive, [emitter], add_mode="single")


def reflected(points: np.ndarray) -> np.ndarray:
    """Return points folded into the unit cube at its faces, as often as it takes.

    >>> reflected(np.array([0.3, -0.2, 1.25, 2.5])).round(12).tolist()
    [0.3, 0.2, 0.75, 0.5]
    """
    folded = np.mod(points, 2.0)
    return np.where(folded > 1.0, 2.0 - folded, folded)


def _stream(seed: int, number: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=(number,))


def _check(*, objects: Any, preset: str, ranges: qd.Ranges | None, **numbers: Any) -> None:
    """Refuse options that cannot work, before anything is built or written."""
    from finqd.presets import PRESETS

    for name, value in numbers.items():
        least = 0 if name == "seed" else 1
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise InputError(f"must be a whole number from {least} upwards, got {value!r}", where=name)
    if preset not in PRESETS:
        raise InputError(f"there is no preset {preset!r}; known: {', '.join(PRESETS)}", where="preset")
    for name, (low, high) in (ranges or {}).items():
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise InputError(f"must be a low and a higher number, got {low!r} and {high!r}", where=f"ranges.{name}")
    if objects is not None:
        from finqd.evaluate import load_objects

        load_objects(objects)
