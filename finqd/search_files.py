"""What a search writes, as it goes along.

    OUT/run.json           settings, search space, ranges, versions, and how the run ended
    OUT/evaluations.jsonl  every evaluation, a line each, in the order in which they finished
    OUT/archive.csv        the elites after the last whole iteration
    OUT/elites/*.json      their design files, named after their cells
    OUT/*.png              heatmap, coverage, QD score (`finqd.search_plots`)
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd import archive as qd
from finqd.contracts import Parameter
from finqd.design import Design
from finqd.runlog import plain, write_whole
from finqd.workers import TaskFailure

if TYPE_CHECKING:
    from ribs.archives import GridArchive

Parameters = Sequence[tuple[str, Parameter]]


def record_of(
    unit: np.ndarray, design: Design | TaskFailure, result: Any, parameters: Parameters, features: Sequence[str]
) -> dict[str, Any]:
    """Return what the log says of one evaluation.

    ``result``: what the search's worker returned, or the `TaskFailure` in its place. ``status`` is "ok", "failed" (was
    evaluated, but see `finqd.archive.why_failed`), "invalid" (no design), "error", "crash" or "timeout".
    """
    record: dict[str, Any] = {"unit": unit.tolist(), "parameters": {}, "design_digest": None}
    if isinstance(design, Design):
        record["parameters"] = {path: value for (path, _), value in zip(parameters, design.to_vector().tolist())}
        record["design_digest"] = design.digest()
    record |= {"fitness": None, "margin": None, "objective": qd.PENALTY, "features": {}, "objects": {}, "seconds": None}
    if isinstance(result, TaskFailure):
        record |= {"status": result.kind, "reason": result.reason, "details": result.details}
    else:
        reason = qd.why_failed(result, features)
        record |= {**plain(result), "status": "failed" if reason else "ok", "reason": reason}
        if not reason:
            record["objective"] = qd.objective(record["fitness"], record["margin"], max(1, len(record["objects"])))
    return {**record, "versions": versions()}


def settings_of(
    base: Mapping[str, Any], parameters: Parameters, ranges: qd.Ranges, *, objects: Sequence[Any] | None, **options: Any
) -> dict[str, Any]:
    """Return what ``run.json`` says of a run, enough to repeat it."""
    return {
        "algorithm": "CMA-ME: GridArchive, one EvolutionStrategyEmitter (2imp), reflected at the unit cube, from 0.5",
        "objective": f"fitness + {qd.TIE_BREAK} / objects * (1 + margin) / 2",
        "penalty": qd.PENALTY,
        "threshold_min": qd.THRESHOLD_MIN,
        "objects": None if objects is None else [getattr(one, "name", str(one)) for one in objects],
        **options,
        "ranges": ranges,
        "design": base,
        "parameters": [
            {"path": path, "unit": p.unit, "low": p.low, "high": p.high, "integer": p.integer} for path, p in parameters
        ],
        "versions": versions(),
    }


@cache
def versions() -> Mapping[str, str]:
    """Return the versions that a result depends on."""
    from finqd.provenance import versions as versions_of_simulation

    return {"python": sys.version.split()[0], "ribs": version("ribs"), **versions_of_simulation()}


def write_archive(
    out: Path,
    archive: GridArchive,
    records: Sequence[qd.Record],
    ranges: qd.Ranges,
    parameters: Parameters,
    decode: Callable[[np.ndarray, int], Design | TaskFailure],
) -> None:
    """Write the archive as a table and as design files, each file whole or not at all."""
    write_whole(out / "archive.csv", qd.archive_table(archive, records, ranges, parameters))
    (out / "elites").mkdir(exist_ok=True)
    for cell, record in qd.elites(archive, records):
        design = decode(np.array(record["unit"]), record["index"])
        assert isinstance(design, Design)  # it was evaluated
        name = "_".join(["cell", *(f"{i:02d}" for i in cell)])
        write_whole(out / "elites" / f"{name}.json", design.to_json())


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all."""
    write_whole(path, json.dumps(plain(content), indent=2, ensure_ascii=False) + "\n")
