"""Error against seconds: runs a ladder of settings for one case, beside a reference made by two element families.

    DIR/accuracy.jsonl   every rung, a line each, as soon as it is done; a study that was interrupted goes on from there
    DIR/reference.json   what the errors are measured against, and how it was made

Every rung runs in a process of its own. Its ``seconds`` are those of set-up and steps, without meshing and without
compiling kernels or loading them; ``wall_seconds`` is everything but the start of the process.
"""

from __future__ import annotations

import hashlib
import json
import math
import time as clock
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from finqd.accuracy_cases import Case, Measure, expected_seconds, measured
from finqd.accuracy_ladder import NUMERICAL_CONSTANTS, Rung, build_ladder, options_text, reference_rungs
from finqd.accuracy_machine import describe_machine
from finqd.accuracy_reference import Reference, error_of, make_reference, shipped_reference
from finqd.errors import InputError
from finqd.presets import DEFAULT, PRESETS
from finqd.study_log import append_row, read_rows
from finqd.workers import TaskFailure, run_tasks

if TYPE_CHECKING:
    from finqd.design import Design

LOG, REFERENCE = "accuracy.jsonl", "reference.json"
DEAR_S, DEAR_TIMES = 40.0, 4.0  # rungs expected to take longer, and that many times `standard`, need a full ladder;
PRESET_TIMES = 5.0  # the presets only if they are expected to take that many times longer still
REFERENCE_LIMITS = 6.0  # a rung of the reference may take that many times the limit of another
UNDISTURBED = 0.6  # share of its time that a rung has the processor, meshing in another process set aside
REFINING = ("size", "element", "step", "stepper", "adaptive", "newton")  # knobs whose series refine one number
MARGIN = 1.5  # for a budget, rungs expected to take up to this many times as long are tried

#: what a row must hold; one that another version of finqd logged without it is run again
ROW_KEYS = {
    *measured(status="", reason=""), "wall_seconds", "cpu_seconds", "machine", "date", "limit_s", "jobs", "design",
    "versions", "options", "rung",
}

Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class RungTask:
    """One rung as it travels to its process."""

    measure: Measure
    design: Design
    options: Mapping[str, Any]
    limit: float


def measure_rung(task: RungTask, *, progress: Callable[[float], None] | None = None) -> dict[str, Any]:
    """Run one rung here; the whole time it took is ``wall_seconds``, that of the processor ``cpu_seconds``."""
    begun, busy = clock.perf_counter(), clock.process_time()
    found = task.measure(task.design, task.options, task.limit, progress)
    return {**found, "wall_seconds": clock.perf_counter() - begun, "cpu_seconds": clock.process_time() - busy}


@dataclass(kw_only=True)
class Study:
    """A ladder on one design and case, and what is known of it so far.

    rungs: those to be run, by expected cost; omitted: name -> why a rung is not run (dear, not installed, or another
        of its series that was to cost less ran out of time)
    rows: one mapping a measured rung, as in the log, without its error (see `table`)
    """

    case: Case
    design: Design
    options: Mapping[str, Any]
    out: Path
    rungs: tuple[Rung, ...]
    omitted: Mapping[str, str]
    limit: float = 600.0
    jobs: int = 1
    full: bool = False
    swept: bool = True  # whether the reference's meshes are; tetrahedra where the shape is none that can be
    reference: Reference | None = None
    rows: list[Row] = field(default_factory=list)
    on_row: Callable[[Row], None] | None = None
    on_progress: Callable[[str, float], None] | None = None
    runner: Callable[..., list[Any]] = run_tasks
    designs: dict[str, Design] = field(default_factory=dict)  # what each rung computes
    keys: dict[str, str] = field(default_factory=dict)
    costs: dict[str, float] = field(default_factory=dict)  # expected seconds on an ordinary core

    # -- running --------------------------------------------------------------------------------------------------

    def run(self, rungs: Sequence[Rung], *, limit: float | None = None) -> None:
        """Measure what of ``rungs`` is not in the log; equal settings are measured once."""
        limit = self.limit if limit is None else limit
        waiting: dict[str, Rung] = {}
        for rung in rungs:
            if self.row_of(rung, limit=limit) is None:
                waiting.setdefault(self.key(rung), rung)
        todo = [rung for rung in waiting.values() if not self._hopeless(rung, limit)]
        while todo:
            self._run_side_by_side(todo[: self.jobs], limit)
            todo = [rung for rung in todo[self.jobs :] if not self._hopeless(rung, limit)]

    def _hopeless(self, rung: Rung, limit: float) -> bool:
        """Tell whether a rung of the same series that was to cost less ran out of as much time, and note it."""
        presets = {self.key(known) for known in self.rungs if known.knob == "preset"}
        if rung.knob not in REFINING or self.key(rung) in presets:
            return False
        for known in self.rungs:
            cheaper = known.series == rung.series and self.costs[known.name] < self.costs[rung.name]
            row = self.row_of(known) if cheaper else None
            if row is not None and row["status"] == "timeout" and row["limit_s"] >= limit:
                reason = f"{known.name}, which is to cost less, took over {row['limit_s']:g} s"
                self.omitted = {**self.omitted, rung.name: reason}
                return True
        return False

    def _run_side_by_side(self, rungs: Sequence[Rung], limit: float) -> None:
        tasks = [
            RungTask(measure=self.case.measure, design=self.applied(r), options=self.options, limit=limit)
            for r in rungs
        ]

        def on_result(index: int, result: Any) -> None:
            row = self._row(rungs[index], tasks[index], result)
            self.rows.append(row)
            append_row(self.out / LOG, {**row, "errors": self.errors(row)})
            if self.on_row is not None:
                self.on_row(row)

        def on_progress(index: int, share: float) -> None:
            if self.on_progress is not None:
                self.on_progress(rungs[index].name, share)

        # meshing has a limit of its own; the process is killed only if neither limit was kept
        self.runner(
            measure_rung, tasks, jobs=self.jobs, time_limit_s=1.2 * limit + 120.0, on_result=on_result,
            on_progress=on_progress,
        )

    def _row(self, rung: Rung, task: RungTask, result: Any) -> Row:
        if isinstance(result, TaskFailure):
            result = {**measured(status=result.kind, reason=result.reason), "wall_seconds": None, "cpu_seconds": None}
        return {
            "rung": rung.name, "knob": rung.knob, "series": rung.series, "case": self.case.name,
            "preset": rung.preset, "settings": dict(rung.settings), "options": options_text(rung.preset, rung.settings),
            **result, "limit_s": task.limit, "key": self.key(rung), "design_digest": task.design.digest(),
            "design": self.design.name, "versions": self.versions, "machine": self.machine,
            "date": clock.strftime("%Y-%m-%d %H:%M", clock.gmtime()), "jobs": self.jobs,
        }

    # -- what is known --------------------------------------------------------------------------------------------

    @cached_property
    def versions(self) -> dict[str, str]:
        """Versions on which results depend, and the digest of finqd's source."""
        from finqd.provenance import versions

        return dict(versions())

    @cached_property
    def machine(self) -> dict[str, Any]:
        """What the seconds depend on."""
        return describe_machine()

    def applied(self, rung: Rung) -> Design:
        """Return the design that a rung computes."""
        if rung.name not in self.designs:
            self.designs[rung.name] = rung.applied(self.design.with_overrides(self.case.overrides))
        return self.designs[rung.name]

    def key(self, rung: Rung) -> str:
        """Return a hash of all that a rung's value depends on, versions included; for the source see `outdated`."""
        if rung.name not in self.keys:
            released = {name: one for name, one in self.versions.items() if name != "source"}
            parts = [self.case.name, self.applied(rung).digest(), fingerprint(self.options), released]
            self.keys[rung.name] = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:24]
        return self.keys[rung.name]

    @property
    def physics(self) -> str:
        """A hash of all that the exact values depend on: nothing of how they are computed."""
        resolved = self.design.with_overrides(self.case.overrides).resolved()
        known: dict[str, Any] = {key: resolved.get(key) for key in self.case.physics}
        if resolved["elasticity"]["name"] != "corotated":  # the law is physics; the usual one was once left out here
            known["elasticity"] = resolved["elasticity"]
        # a constant of zero is left out: what a later version adds to the material, and is off, changes no value
        known["material"] = {key: value for key, value in known["material"].items() if value != 0}
        if "protocol" in known:
            known["protocol"] = {k: v for k, v in known["protocol"].items() if k not in NUMERICAL_CONSTANTS}
        if self.case.fingers == 1:
            known["finger"] = dict(self.design.fingers[self.options["finger"]])
            text = json.dumps([self.case.name, known], sort_keys=True)
        else:
            text = json.dumps([self.case.name, known, fingerprint(self.options)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:24]

    def row_of(self, rung: Rung, *, limit: float | None = None) -> Row | None:
        """Return the newest row with the settings of a rung, None if it has to be run (again).

        What crashed is run again, and what ran out of time if it has more of it now.
        """
        key = self.key(rung)
        for row in reversed(self.rows):
            if row.get("key") == key and row.keys() >= ROW_KEYS:
                late = row["status"] == "timeout" and limit is not None and limit > row.get("limit_s", 0.0)
                return None if row["status"] == "crash" or late else row
        return None

    def errors(self, row: Row) -> dict[str, float]:
        """Return the signed error of each value against the reference: percent, or the quantity's unit."""
        if self.reference is None or row["status"] != "ok":
            return {}
        return {
            key: found for key, quantity in self.case.quantities.items()
            if (found := error_of(quantity, row["values"].get(key), self.reference.values.get(key))) is not None
        }

    def table(self) -> list[Row]:
        """Return a row for each rung that is measured, with its own name, knob and series, and its errors.

        Rungs with the same settings (``standard`` lies on many curves) share what was measured. Added: ``errors``;
        ``error_percent`` of the case's quantity, signed; ``resolved_percent``, its size but not below what the
        reference itself is uncertain by; ``change_percent`` against ``standard``.
        """
        standard = self._standard()
        rows = []
        for rung in (*self.rungs, *self.reference_rungs()):
            found = self.row_of(rung)
            if found is not None:
                names = {"rung": rung.name, "knob": rung.knob, "series": rung.series, "preset": rung.preset}
                options = options_text(rung.preset, rung.settings)
                row = {**found, **names, "settings": dict(rung.settings), "options": options}
                rows.append(self._judged(row, standard))
        return rows

    def reference_rungs(self) -> tuple[Rung, ...]:
        """The rungs of which this study makes its reference, if it does."""
        return () if self.reference is not None and self.reference.source != "computed" else reference_rungs(
            self.case.name, full=self.full, swept=self.swept
        )

    def _standard(self) -> float | None:
        found = self.row_of(next(rung for rung in self.rungs if rung.name == DEFAULT))
        return found["values"].get(self.case.main) if found else None

    def _judged(self, row: Row, standard: float | None) -> Row:
        errors, value = self.errors(row), row["values"].get(self.case.main)
        error = errors.get(self.case.main)
        floor = self.reference.uncertainty_percent if self.reference else 0.0
        return {
            **row, "errors": errors, "error_percent": error,
            "resolved_percent": None if error is None else max(abs(error), floor),
            "change_percent": None if value is None or not standard else 100.0 * (value / standard - 1.0),
        }

    def expected(self, rung: Rung) -> float:
        """Return about how long a rung takes [s], by what the rungs so far took here."""
        ratios = sorted(
            row["seconds"] / self.costs[known.name]
            for known in self.rungs if (row := self.row_of(known)) and row["status"] == "ok" and row["seconds"] > 0.0
        )
        return (ratios[len(ratios) // 2] if ratios else 1.0) * self.costs[rung.name]

    def set_reference(self, wanted: str | Reference) -> None:
        """Take the reference that ships with finqd ("auto", if there is one), or make it ("compute").

        Raises ``InputError`` for a reference of another case, shape, material or object: its values are no errors.
        """
        found = shipped_reference(self.case.name, self.physics) if wanted == "auto" else None
        if isinstance(wanted, Reference):
            found = wanted
            same = (found.case, found.physics, found.quantity) == (self.case.name, self.physics, self.case.main)
            if not same:
                what = f"{found.case} of {found.design or 'another design'}"
                raise InputError(f"is of another case or another physics: {what}", f"--reference {found.source}")
        if found is None:
            rows = self._families()
            if all(row is not None and row["status"] == "mesh_failed" for row in rows):
                self.swept = False  # what cannot be swept can still be filled with tetrahedra
                rows = self._families()
            found = make_reference(self.case, self.physics, rows, full=self.full, one_family=not self.swept)
        self.reference = found

    def _families(self) -> list[Row | None]:
        rungs = reference_rungs(self.case.name, full=self.full, swept=self.swept)
        self.run(rungs, limit=REFERENCE_LIMITS * self.limit)
        return [self.row_of(rung) for rung in rungs]


def open_study(
    design: Design, case: Case, options: Mapping[str, Any], out: Path, *, knobs: Iterable[str] = (),
    full: bool = False, limit: float = 600.0, jobs: int = 1,
) -> Study:
    """Return a study with what its folder already knows; nothing is run yet.

    Raises ``InputError`` for an unknown knob or a log that is none.
    """
    ladder = build_ladder(design.with_overrides(case.overrides), knobs=knobs, frictionless=case.name == "press")
    study = Study(
        case=case, design=design, options=options, out=out, rungs=ladder.rungs, omitted={}, limit=limit, jobs=jobs,
        full=full, rows=read_rows(out / LOG), designs=dict(ladder.designs),
    )
    study.costs = costs = {rung.name: expected_seconds(case, study.applied(rung)) for rung in ladder.rungs}
    most = max(DEAR_S, DEAR_TIMES * costs[DEFAULT])
    dear = {
        name: f"expected to take about {cost:.0f} s; --full runs it"
        for name, cost in costs.items() if cost > most * (PRESET_TIMES if name in PRESETS else 1.0) and not full
    }
    study.rungs = tuple(sorted((r for r in ladder.rungs if r.name not in dear), key=lambda r: costs[r.name]))
    study.omitted = {**dear, **ladder.missing}
    return study


def front(rows: Sequence[Row]) -> list[Row]:
    """Return the rows that no other beats in both seconds and error, by seconds; without the reference's own.

    Errors below what the reference is uncertain by count as equal, so that luck is not taken for accuracy.

    >>> rows = [{"rung": n, "seconds": s, "resolved_percent": e, "knob": "size"}
    ...         for n, s, e in [("a", 1, 10), ("b", 2, 12), ("c", 3, 1), ("d", 4, 1)]]
    >>> [row["rung"] for row in front(rows)]
    ['a', 'c']
    """
    best, found = math.inf, []
    usable = [row for row in rows if row["resolved_percent"] is not None and row["knob"] != "reference"]
    for row in sorted(usable, key=lambda row: (row["seconds"], row["resolved_percent"])):
        if row["resolved_percent"] < best:
            best = row["resolved_percent"]
            found.append(row)
    return found


def cheapest_within(study: Study, error_percent: float) -> Row | None:
    """Return the cheapest rung whose error is at most this; what the log knows is taken from there.

    Otherwise rungs are run in order of expected cost until one meets it. None if none does.
    """
    def meeting() -> Row | None:
        fits = [row for row in front(study.table()) if row["resolved_percent"] <= error_percent]
        return fits[0] if fits else None

    found = meeting()
    for rung in sorted(study.rungs, key=study.expected):
        if found is not None:
            break
        if study.row_of(rung, limit=study.limit) is None:
            study.run([rung])
            found = meeting()
    return found


def best_within(study: Study, budget_s: float) -> Row | None:
    """Return the most accurate rung that takes at most this many seconds; None if none does.

    Rungs that are likely to fit and are not in the log are run, cheapest first.
    """
    for rung in sorted(study.rungs, key=study.expected):
        if study.row_of(rung) is None and study.expected(rung) <= MARGIN * budget_s:
            study.run([rung], limit=min(study.limit, 2.0 * budget_s + 30.0))
    fits = [row for row in front(study.table()) if row["seconds"] <= budget_s]
    return fits[-1] if fits else None


def disturbed(rows: Sequence[Row]) -> list[str]:
    """Return the rungs that had the processor for less than `UNDISTURBED` of their time: other work was going on."""
    return [
        row["rung"] for row in rows
        if row["status"] == "ok" and row["seconds"] > 1.0 and row.get("cpu_seconds") is not None
        and row["cpu_seconds"] < UNDISTURBED * row["wall_seconds"]
    ]


def outdated(rows: Sequence[Row], source: str) -> list[str]:
    """Return the rungs that were measured with another state of finqd's source under the same version."""
    return [row["rung"] for row in rows if row["versions"].get("source") != source]


def fingerprint(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return a case's options as plain values; an object by its name, mass and surface."""
    plain = {}
    for key, value in options.items():
        if hasattr(value, "triangles"):
            surface = hashlib.sha256(value.vertices.tobytes() + value.triangles.tobytes()).hexdigest()[:16]
            plain[key] = [value.name, f"{value.mass:.9g}", surface]
        else:
            plain[key] = value
    return plain
