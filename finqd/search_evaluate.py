"""Turns designs that a search asked for into records of its log: found there, or evaluated and written there.

What is evaluated is written as it comes, before anybody is told. What has been evaluated before, by content, is not
evaluated again: neither after a kill, nor for the same design asked for twice.
"""

from __future__ import annotations

import socket
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from finqd import archive as qd
from finqd.contracts import Parameter
from finqd.data import bundled_names, objects_folder
from finqd.design import Design
from finqd.errors import InputError, MissingLibraryError
from finqd.runlog import Record, RunLog
from finqd.workers import TaskFailure

#: of an evaluation, what a repetition of its content has too
RESULT = ("fitness", "margin", "objective", "features", "objects", "accuracy", "status", "reason", "details", "host",
          "versions", "attempts")  # fmt: skip

Progress = Callable[[str, float], None]


@dataclass(frozen=True, kw_only=True)
class Evaluations:
    """Evaluates designs of one run.

    run_all: as `finqd.workers.Workers.run`; call: what evaluates a design, in a worker; features: on the map's axes;
    clock: seconds of computing of this run; on_record: told of what was just written, ``on_record(record)``
    """

    log: RunLog
    run_all: Callable[..., Any]
    call: Callable[..., dict[str, Any]]
    base: Mapping[str, Any]
    parameters: Sequence[tuple[str, Parameter]]
    features: tuple[str, ...]
    seed: int
    versions: Mapping[str, str]
    clock: Callable[[], float]

    def stage(
        self, units: Mapping[int, np.ndarray], *, preset: str, iteration: int, known: Mapping[tuple[int, str], Record],
        on_record: Callable[[Record], None], on_progress: Callable[[int, float], None], empty: bool,
    ) -> dict[int, Record]:
        """Return the record of each design, by its index in the run; ``units``: index -> point of the unit cube.

        known: records of the log, by index and preset. on_record: told of each record that is new; on_progress: of an
        index and a share done. empty: whether no design has worked yet: then, if what the user gave is refused for
        every design, that is raised and not recorded, since it is not the designs that are wrong.
        """
        stage = _Stage(self, units, preset, iteration, on_record)
        waiting: dict[str, list[tuple[int, Design]]] = {}
        for index, unit in units.items():
            if (index, preset) in known:
                stage.records[index] = known[index, preset]
                continue
            design = decoded(unit, index, base=self.base, seed=self.seed)
            if isinstance(design, TaskFailure):
                stage.keep(index, design, design)
            elif (same := self._found(design, preset)) is not None:
                stage.keep(index, design, _repetition(same))
            else:
                waiting.setdefault(design.digest(), []).append((index, design))
        self._run(list(waiting.values()), stage, on_progress, empty=empty)
        return stage.records

    def _found(self, design: Design, preset: str) -> Record | None:
        objects = self.log.run.settings["objects"]
        return self.log.found(design.digest(), preset, objects, versions=self.versions)

    def _run(
        self, groups: Sequence[Sequence[tuple[int, Design]]], stage: _Stage, on_progress: Callable[[int, float], None],
        *, empty: bool,
    ) -> None:
        """Evaluate one design of each group of equal ones, and note the result for all of them."""
        if not groups:  # all found, as in most of a replay: no worker is asked, which would take longer than that
            return
        refused: list[tuple[int, Any]] = []
        again = Counter[int]()

        def on_result(k: int, result: Any) -> None:
            if empty and isinstance(getattr(result, "exception", None), (InputError, MissingLibraryError)):
                refused.append((k, result))
            else:
                stage.keep_all(groups[k], result, attempts=1 + again[k])

        self.run_all(
            self.call, [(group[0][1], stage.preset) for group in groups], on_result=on_result,
            on_progress=lambda k, fraction: on_progress(groups[k][0][0], fraction),
            on_retry=lambda k, _: again.update([k]),
        )
        if len(groups) == len(refused):
            raise refused[0][1].exception  # not one design could be tried: it is what the user gave that is wrong
        for k, result in refused:
            stage.keep_all(groups[k], result)


@dataclass
class _Stage:
    """The records of some designs with one preset, as they come."""

    owner: Evaluations
    units: Mapping[int, np.ndarray]
    preset: str
    iteration: int
    on_record: Callable[[Record], None]
    records: dict[int, Record] = field(default_factory=dict)

    def keep_all(self, group: Sequence[tuple[int, Design]], result: Any, *, attempts: int = 1) -> None:
        """Note the result of equal designs: the first one's, and repetitions of it."""
        self.keep(*group[0], result, attempts=attempts)
        for index, design in group[1:]:
            self.keep(index, design, _repetition(self.records[group[0][0]]))

    def keep(self, index: int, design: Design | TaskFailure, result: Any, *, attempts: int = 1) -> None:
        owner = self.owner
        record: Record = {
            "index": index, "iteration": self.iteration, "emitter": 0, "seed": owner.seed, "preset": self.preset,
            "unit": self.units[index].tolist(), "parameters": {}, "design_digest": None, "fitness": None,
            "margin": None, "objective": qd.PENALTY, "features": {}, "objects": {}, "accuracy": None, "seconds": None,
            "reason": "", "details": "", "host": socket.gethostname(),
            "attempts": max(attempts, getattr(result, "attempts", 1)),
            "versions": dict(owner.versions), "finished_at": owner.clock(), "screen": None,
        }  # fmt: skip
        if isinstance(design, Design):
            values = design.to_vector().tolist()
            record["parameters"] = {path: value for (path, _), value in zip(owner.parameters, values)}
            record["design_digest"] = design.digest()
        record = owner.log.append({**record, **self._outcome(result)})
        self.records[index] = record
        self.on_record(record)

    def _outcome(self, result: Any) -> dict[str, Any]:
        """Return status, reason and objective of a result, and what else it says.

        ``status`` is "ok", "failed" (was evaluated, but see `finqd.archive.why_failed`), "invalid" (no design),
        "error", "crash" or "timeout".
        """
        if isinstance(result, TaskFailure):
            return {"status": result.kind, "reason": result.reason, "details": result.details}
        if "status" in result:
            return result  # a repetition
        reason = qd.why_failed(result, self.owner.features)
        found = {**result, "status": "failed" if reason else "ok", "reason": reason}
        if not reason:
            found["objective"] = qd.objective(result["fitness"], result["margin"], max(1, len(result["objects"])))
        return found


def _repetition(record: Record) -> dict[str, Any]:
    """Return what a record says of its design, for the same design asked for again: it took no time."""
    return {**{key: record[key] for key in RESULT}, "seconds": 0.0, "repeats": record["index"]}


def decoded(unit: np.ndarray, index: int, *, base: Mapping[str, Any], seed: int) -> Design | TaskFailure:
    """Return the design at a point of the unit cube, or why there is none there."""
    try:
        return Design.from_unit_vector(unit, **base, name=f"seed {seed}, evaluation {index}")
    except InputError as error:  # values that contradict each other, each within its range
        return TaskFailure(kind="invalid", reason=str(error))


def evaluated(
    task: tuple[Design, str], *, evaluate: Callable[..., Any], objects: Any, progress: Callable[[float], None]
) -> dict[str, Any]:
    """Evaluate one design with a preset, in a worker; return the parts of the result that the search needs."""
    design, preset = task
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
    return {**record, "seconds": time.perf_counter() - begin, "host": socket.gethostname()}
