"""The page of a search: what `finqd report` shows, gathered from a run into one plain dict, and written as HTML.

The page is one file that asks no network for anything (`finqd.report_page`). Everything on it comes from the run's
log, but for the shapes, which the geometry plugin builds again from the logged parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from finqd import __version__
from finqd import archive as qd
from finqd.design import Design
from finqd.errors import FinqdError, InputError
from finqd.labels import name_and_unit
from finqd.report_benchmark import benchmark_of
from finqd.report_facts import failures, object_failures, presets_of, screening_of, settings_table, stated
from finqd.report_rechecks import rechecks_of
from finqd.report_shapes import MAX_SHAPES, shapes_of
from finqd.runlog import plain
from finqd.sensitivity import sensitivity

VOLUME = "volume_mm3"
#: of an object's row in the log, what the page shows
OBJECT_FIELDS = (
    "status", "reason", "held", "margin", "drop_mm", "max_contact_force_N", "max_penetration_mm", "ended", "seconds",
)


def write_report(
    run: Any, out: Path, *, name: str, argument: str, benchmark: Path | None = None, shapes: int = MAX_SHAPES
) -> None:
    """Write the page of a run.

    run: as `finqd.runlog.read_run` returns it; name: what the page calls it; argument: RUN in the commands on it;
    benchmark: a result file of ``finqd evaluate benchmark --out FILE.json`` to compare with; shapes: designs that can
    be seen in 3-D at most, the best first. Raises ``InputError`` if the benchmark's file is no result or ``out`` cannot
    be written.
    """
    from finqd.cli_files import written_at_end
    from finqd.report_page import page

    with written_at_end(out, "--out") as write:
        data = report_data(run, name=name, argument=argument, benchmark=benchmark)
        write(page(data, shapes_of(designs_shown(data), limit=shapes)))


def report_data(run: Any, *, name: str, argument: str = "RUN", benchmark: Path | None = None) -> dict[str, Any]:
    """Return all that the page shows but the shapes: plain values, as JSON holds them, in the units of their keys."""
    records = run.records()  # once: the search may go on meanwhile
    archive = qd.rebuilt(records, len(run.parameters), run.ranges, cells=run.settings["cells"])
    elites = qd.elites(archive, records)
    objects = _objects(records)
    axes = _axes(run.ranges, archive.dims)
    volume = shown_volume(records, run.ranges)
    front = pareto_front([r for r in records if r["status"] == "ok" and _is_final(run, r)], volume)
    shown = _shown(archive, elites, front, run.ranges)
    designs = [_design_entry(run, record, cell, is_elite) for record, cell, is_elite in shown]
    compared = benchmark_of(run, benchmark, objects, archive)
    return plain({
        "name": name, "run_argument": argument, "finqd_version": __version__,
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "summary": _summary(records, elites, archive), "axes": axes, "features": _features(records, run.ranges),
        "parameters": [_parameter(path, p) for path, p in run.parameters], "objects": objects, "designs": designs,
        "curves": _curves(archive, records, run.ranges),
        "pareto": {**_named(volume), "front": [r["index"] for r in front], "cloud": _cloud(records, volume)},
        "benchmark": compared, "chosen": choose(designs, volume, compared),
        "sensitivity": sensitivity(records, [path for path, _ in run.parameters]),
        "failures": failures(records), "object_failures": object_failures(records),
        "rechecks": rechecks_of(run),
        "presets": presets_of(run, records), "screening": screening_of(records), **stated(run, records, elites),
        "settings": settings_table(run.settings),
        "colours": colour_stops(),
    })  # fmt: skip


def design_of(run: Any, record: Mapping[str, Any]) -> Design:
    """Return the design that a record is about, from its logged parameters.

    Raises ``InputError`` if what is installed takes them no more: another finger type, or other limits.
    """
    name = f"seed {record['seed']}, evaluation {record['index']}"
    base = {key: value for key, value in run.base.items() if key != "name"}
    return Design.from_vector(list(record["parameters"].values()), **base, name=name)


def designs_shown(data: Mapping[str, Any]) -> list[tuple[int, Any]]:
    """Return index and a function that makes the design of each one on the page, the best first."""
    order = sorted(data["designs"], key=lambda one: (-one["objective"], one["index"]))
    return [(one["index"], partial(_read, one)) for one in order]


def _read(one: Mapping[str, Any]) -> Design:
    if one["file"] is None:
        raise InputError(one["file_missing"])
    return Design.from_json(one["file"])


def shown_volume(records: Sequence[Mapping[str, Any]], ranges: qd.Ranges) -> str:
    """Return the feature that stands for material in the Pareto front: the volume, or the map's last axis without."""
    return VOLUME if any(VOLUME in record["features"] for record in records) else list(ranges)[-1]


def pareto_front(records: Sequence[Mapping[str, Any]], volume: str) -> list[Mapping[str, Any]]:
    """Return the records that none beats in fitness with as little volume, by volume; ties by margin, then by index."""
    usable = [r for r in records if isinstance(r["features"].get(volume), (int, float))]
    order = sorted(usable, key=lambda r: (r["features"][volume], -r["fitness"], -r["margin"], r["index"]))
    front: list[Mapping[str, Any]] = []
    for record in order:
        if not front or record["fitness"] > front[-1]["fitness"]:
            front.append(record)
    return front


def choose(designs: Sequence[Mapping[str, Any]], volume: str, benchmark: Mapping[str, Any] | None) -> list[dict]:
    """Return up to four designs for the table to begin with, as ``{"index": ..., "why": ...}``.

    The best one; the lightest that holds as many objects; the lightest that holds no fewer than the benchmark does, or
    one object fewer than the best where the benchmark is not known; and the widest of those that hold the most.
    """
    if not designs:
        return []
    best = max(designs, key=lambda d: d["objective"])
    equals = [d for d in designs if d["fitness"] >= best["fitness"] - 1e-9]
    known = None if benchmark is None else benchmark["fitness"]
    goal = best["fitness"] - 1.0 / max(1, len(best["objects"])) if known is None else known
    enough = [d for d in designs if d["fitness"] >= goal - 1e-9]

    def light(d: Mapping[str, Any]) -> tuple[float, float]:
        return d["features"][volume], -d["objective"]

    wide = next((k for k in best["features"] if k != volume and k.startswith("workspace")), None)
    picks = [(best, "best"), (min(equals, key=light), "lightest of those that hold the most")]
    if enough:
        why = "lightest with one object fewer" if known is None else "lightest that holds as many as the benchmark"
        picks.append((min(enough, key=light), why))
    if wide:
        picks.append((max(equals, key=lambda d: d["features"][wide]), "widest of those that hold the most"))
    reasons: dict[int, list[str]] = {}
    for one, why in picks:
        reasons.setdefault(one["index"], []).append(why)
    return [{"index": index, "why": "; ".join(why)} for index, why in reasons.items()]


def colour_stops() -> list[str]:
    """Return 33 even steps of viridis, whose lightness rises evenly for the eye, as #rrggbb."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colormaps["viridis"](share)) for share in np.linspace(0.0, 1.0, 33)]


def _is_final(run: Any, record: Mapping[str, Any]) -> bool:
    """Return whether a record is as exact as the run's results are; one that was only screened is not."""
    confirm = run.settings.get("confirm")
    return confirm is None or record.get("preset") in (None, confirm)


def _axes(ranges: qd.Ranges, dims: Sequence[int]) -> list[dict[str, Any]]:
    return [{**_named(key), "low": low, "high": high, "cells": int(n)} for (key, (low, high)), n in
            zip(ranges.items(), dims)]  # fmt: skip


def _named(key: str) -> dict[str, str]:
    name, unit = name_and_unit(key)
    return {"key": key, "name": name, "unit": unit}


def _parameter(path: str, parameter: Any) -> dict[str, Any]:
    return {
        **_named(path.rpartition(".")[2]), "path": path, "low": parameter.low, "high": parameter.high,
        "integer": parameter.integer, "description": parameter.description,
    }


def _objects(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names of all objects of the log, in the order in which they first appear."""
    return list(dict.fromkeys(name for record in records for name in record["objects"]))


def _features(records: Sequence[Mapping[str, Any]], ranges: qd.Ranges) -> list[dict[str, str]]:
    keys = dict.fromkeys([*ranges, *(key for record in records for key in record["features"])])
    return [_named(key) for key in keys]


def _shown(
    archive: Any, elites: Sequence[tuple], front: Sequence[Mapping[str, Any]], ranges: qd.Ranges
) -> list[tuple[Mapping[str, Any], tuple[int, ...], bool]]:
    """Return record, cell and whether it is an elite, of every design that can be picked: elites and the front."""
    found = {record["index"]: (record, cell, True) for cell, record in elites}
    for record in front:
        if record["index"] not in found:
            cell = archive.index_of_single([record["features"][name] for name in ranges])
            place = archive.int_to_grid_index([cell])[0]
            found[record["index"]] = (record, tuple(int(i) for i in place), False)
    return list(found.values())


def _design_entry(run: Any, record: Mapping[str, Any], cell: tuple[int, ...], is_elite: bool) -> dict[str, Any]:
    rows = {
        name: {key: row.get(key) for key in OBJECT_FIELDS if key in row} for name, row in record["objects"].items()
    }
    kept = ("index", "iteration", "emitter", "fitness", "margin", "objective", "features", "seconds", "accuracy",
            "preset", "design_digest")
    screened = record.get("screen") or None
    file, missing = None, ""
    try:
        file = design_of(run, record).to_json()
    except FinqdError as error:
        missing = str(error)
    return {
        **{key: record.get(key) for key in kept}, "cell": list(cell), "elite": is_elite, "objects": rows,
        "parameters": list(record["parameters"].values()), "file": file, "file_missing": missing,
        "screen": None if screened is None else {key: screened.get(key) for key in ("fitness", "margin", "preset")},
    }


def _summary(records: Sequence[Mapping[str, Any]], elites: Sequence[tuple], archive: Any) -> dict[str, Any]:
    ok = [record for record in records if record["status"] == "ok"]
    best = max(ok, key=lambda r: r["objective"], default=None)
    return {
        "evaluations": len(records), "failed": len(records) - len(ok), "elites": len(elites),
        "cells": int(archive.cells), "coverage": len(elites) / archive.cells,
        "qd_score": math.fsum(record["objective"] for _, record in elites),
        "best_fitness": None if best is None else best["fitness"],
        "best_index": None if best is None else best["index"],
        "iterations": 1 + max((record["iteration"] for record in records), default=-1),
        "evaluation_seconds": math.fsum(record.get("seconds") or 0.0 for record in records),
        "elapsed_seconds": max((elapsed(records)), default=0.0),
        "hosts": sorted({record["host"] for record in records if record.get("host")}),
    }


def elapsed(records: Sequence[Mapping[str, Any]]) -> list[float]:
    """Return seconds of computing since the run began, after each record: a result counts once all before it are in.

    Where the log does not say when a result came in, the evaluations' own seconds are added up.
    """
    seconds, total, found = [record.get("finished_at") for record in records], 0.0, []
    if any(value is None for value in seconds):
        seconds = np.cumsum([record.get("seconds") or 0.0 for record in records]).tolist()
    for value in seconds:
        total = max(total, value)
        found.append(total)
    return found


def _curves(archive: Any, records: Sequence[Mapping[str, Any]], ranges: qd.Ranges) -> dict[str, list[float]]:
    """Return coverage and QD score where they change: after how many evaluations, and how many seconds."""
    coverage, score = qd.curves(archive, records, ranges)
    seconds = np.array(elapsed(records))
    if not len(records):
        return {"evaluations": [0], "seconds": [0.0], "coverage": [0.0], "score": [0.0], "iterations": []}
    changes = np.flatnonzero(np.diff(score, prepend=-1.0) != 0.0)
    kept = np.union1d(changes, [len(records) - 1])
    iterations = np.array([record["iteration"] for record in records])
    return {
        "evaluations": [0, *(kept + 1).tolist()], "seconds": [0.0, *np.round(seconds[kept], 3).tolist()],
        "coverage": [0.0, *np.round(coverage[kept], 8).tolist()], "score": [0.0, *np.round(score[kept], 8).tolist()],
        "iterations": (np.flatnonzero(np.diff(iterations)) + 1).tolist(),
    }


def _cloud(records: Sequence[Mapping[str, Any]], volume: str) -> dict[str, list[float]]:
    points = [(r["features"].get(volume), r["fitness"]) for r in records if r["status"] == "ok"]
    usable = [(x, y) for x, y in points if isinstance(x, (int, float)) and math.isfinite(x)]
    return {"x": [float(f"{x:.6g}") for x, _ in usable], "fitness": [float(f"{y:.6g}") for _, y in usable]}
