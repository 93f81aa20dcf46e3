"""Evaluate the elites of a search again, under other conditions: is the map to be trusted?

`recheck_run` draws perturbations (`finqd.perturbations`), evaluates each elite under each of them, through the same
workers as the search, and writes each result into the run's log as it comes; `finqd.trust` says what they mean. It goes
on where it was stopped, and what was evaluated before, by content, is not evaluated again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd import archive as qd
from finqd.design import Design
from finqd.errors import InputError, MissingLibraryError
from finqd.perturbations import Scheme, perturbed
from finqd.provenance import versions
from finqd.run_folder import plain, write_whole
from finqd.trust import Trust, trust
from finqd.workers import TaskFailure, Workers, open_workers

if TYPE_CHECKING:
    from finqd.runlog import Run, RunLog

Record = Mapping[str, Any]
Progress = Callable[[str, float], None]


FILE = "recheck.json"

#: of an evaluation, what a row has too
RESULT = ("status", "reason", "details", "fitness", "margin", "objective", "features", "objects", "seconds", "host",
          "versions", "attempts")  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class _Task:
    """One elite under one perturbation."""

    record: Record
    number: int
    perturbation: Mapping[str, float]
    design: Design | TaskFailure  # a failure: there is no such design

    @cached_property
    def content(self) -> tuple[Any, ...] | None:
        """What a result depends on, beside the run's objects."""
        return (self.design.digest(), self.record["preset"]) if isinstance(self.design, Design) else None


def recheck(
    folder: Path, *, count: int, scheme: Scheme | None = None, kind: str = "processes", jobs: int | None = None,
    scheduler: str | None = None, time_limit_s: float | None = 3600.0, evaluate: Callable[..., Any] | None = None,
    progress: Progress | None = None, other_versions: bool = False,
) -> Trust:
    """Recheck the run in a folder, see `recheck_run`; write what that says to ``recheck.json`` beside its log.

    kind, jobs, scheduler: where evaluations run, see `finqd.workers.open_workers`; evaluate: as for a search
    other_versions: compare with results of other versions of finqd or its libraries

    Raises InputError as that does, and for objects or versions that are others than when the run began.
    """
    from finqd.runlog import RunLog, read_run
    from finqd.search_evaluate import evaluated
    from finqd.search_settings import refuse_other_world

    if evaluate is None:
        from finqd.evaluate import evaluate
    run = read_run(folder)
    refuse_other_world(run.settings, run.base, other_versions=other_versions, where=str(folder))
    call = partial(evaluated, evaluate=evaluate, objects=run.settings["objects"])
    with open_workers(kind, jobs=jobs, scheduler=scheduler) as workers, RunLog(folder) as log:
        found = recheck_run(
            run, log, count=count, scheme=scheme, workers=workers, call=call, time_limit_s=time_limit_s,
            progress=progress, where=str(folder),
        )
    write_whole(folder / FILE, json.dumps(found.to_dict(), indent=2, allow_nan=False) + "\n")
    return found


def recheck_run(
    run: Run, log: RunLog, *, count: int, workers: Workers, call: Callable[..., Any], scheme: Scheme | None = None,
    time_limit_s: float | None = 3600.0, progress: Progress | None = None, where: str = "run",
) -> Trust:
    """Evaluate each elite of ``run`` under the first ``count`` perturbations of ``scheme``; return what that says.

    call: evaluates a design with a preset where a worker is, as `finqd.search_evaluate.evaluated` does; the preset is
        the one that an elite was told with
    progress: called as ``progress("80 rechecks", fraction)``
    where: what sentences about the run begin with

    Raises InputError if there is no elite, and whatever input an evaluation finds wrong (a design that was evaluated
    before is not at fault for an object's file that is gone, or a library): nothing is written for it then.
    """
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise InputError(f"must be a whole number from 1 upwards, got {count!r}", where="recheck")
    scheme, elites, rows = scheme or Scheme(), run.elites(), list(run.rechecks())
    if not elites:
        raise InputError("has no elite to recheck", where=where)
    known = {(row["design_digest"], row["preset"]): row for row in rows if _repeats(row)}
    left = []

    def keep(task: _Task, result: Any) -> None:
        if isinstance(result, TaskFailure) and isinstance(result.exception, (InputError, MissingLibraryError)):
            raise result.exception
        rows.append(_row(task, result, scheme, run))
        log.append_recheck(rows[-1])

    designs = {record["index"]: _design(run, record, where) for _, record in elites}
    for task in _open_tasks(rows, [record for _, record in elites], designs, count=count, scheme=scheme):
        found = known.get(task.content) or _found(task, log, run)
        if found is not None:
            keep(task, found)
        elif isinstance(task.design, TaskFailure):
            keep(task, task.design)
        else:
            left.append(task)
    _evaluate_all(left, keep, workers=workers, call=call, time_limit_s=time_limit_s, progress=progress)
    return trust(
        elites, rows, archive=run.archive(), features=tuple(run.ranges), scheme=scheme.to_dict(), count=count
    )


def trust_of(run: Run) -> Trust | None:
    """Return what a run's rechecks say, of those by the scheme that was used last; None if there are none."""
    rows = run.rechecks()
    if not rows:
        return None
    scheme = rows[-1]["scheme"]
    count = 1 + max(row["number"] for row in rows if row["scheme"] == scheme)
    return trust(run.elites(), rows, archive=run.archive(), features=tuple(run.ranges), scheme=scheme, count=count)


def _open_tasks(
    rows: Sequence[Record], records: Sequence[Record], designs: Mapping[int, Design], *, count: int, scheme: Scheme
) -> list[_Task]:
    """Return what is not in the log yet, perturbation by perturbation: stopped early, all elites have about as many."""
    done = {(row["index"], row["number"]) for row in rows if row["scheme"] == scheme.to_dict()}
    return [
        _Task(record=record, number=number, perturbation=perturbation,
              design=_under(designs[record["index"]], perturbation, record["preset"]))
        for number, perturbation in enumerate(scheme.draw(count))
        for record in records
        if (record["index"], number) not in done
    ]


def _design(run: Run, record: Record, where: str) -> Design:
    """Return an elite's design. Raises InputError if it is not the one that was evaluated."""
    design = Design.from_unit_vector(np.array(record["unit"]), **run.base, name=f"evaluation {record['index']}")
    if design.digest() != record["design_digest"]:
        raise InputError(
            f"evaluation {record['index']} is another design now: the finger type or its defaults have changed since",
            where=where,
        )
    return design


def _repeats(row: Record) -> bool:
    """Return whether the same would come again of the same content: not for sure after a crash or a time limit."""
    made_with = row["versions"] or {}
    return row["status"] in ("ok", "failed") and all(made_with.get(name) == one for name, one in versions().items())


def _under(design: Design, perturbation: Mapping[str, float], preset: str) -> Design | TaskFailure:
    try:
        return perturbed(design, perturbation, preset=preset)
    except InputError as error:  # one of its values lies at the edge of what a design may hold
        return TaskFailure(kind="invalid", reason=str(error))


def _found(task: _Task, log: RunLog, run: Run) -> Record | None:
    """Return what the search knows of this very content."""
    return None if task.content is None else log.found(*task.content, run.settings["objects"])


def _evaluate_all(
    tasks: Sequence[_Task], keep: Callable[[_Task, Any], None], *, workers: Workers, call: Callable[..., Any],
    time_limit_s: float | None, progress: Progress | None,
) -> None:
    fractions = np.zeros(len(tasks))

    def move(index: int, fraction: float) -> None:
        fractions[index] = fraction
        if progress is not None:
            progress(f"{len(tasks)} rechecks", float(fractions.mean()))

    def take(index: int, result: Any) -> None:
        keep(tasks[index], result)
        move(index, 1.0)

    workers.run(
        call, [(task.design, task.record["preset"]) for task in tasks], time_limit_s=time_limit_s, on_result=take,
        on_progress=move,
    )


def _row(task: _Task, result: Any, scheme: Scheme, run: Run) -> dict[str, Any]:
    """Return what the log says of one recheck."""
    row: dict[str, Any] = {
        "index": task.record["index"], "number": task.number, "perturbation": dict(task.perturbation),
        "scheme": scheme.to_dict(), "preset": task.record["preset"],
        "design_digest": task.content[0] if task.content else None,
        **dict.fromkeys(RESULT), "objective": qd.PENALTY, "features": {}, "objects": {}, "attempts": 1,
        "versions": dict(versions()),
    }
    if isinstance(result, TaskFailure):
        return {**row, "status": result.kind, "reason": result.reason, "details": result.details,
                "attempts": result.attempts}
    row |= {key: value for key, value in result.items() if key in RESULT}
    if "status" not in result:  # it was evaluated just now
        reason = qd.why_failed(result, tuple(run.ranges))
        row |= {"status": "failed" if reason else "ok", "reason": reason}
        if not reason:
            row["objective"] = qd.objective(row["fitness"], row["margin"], max(1, len(row["objects"])))
    return plain(row)
