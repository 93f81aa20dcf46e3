"""What rechecks of elites say of a map: how far fitness can be trusted where conditions are a little other."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def rechecks_of(
    rows: Sequence[Mapping[str, Any]], elites: Sequence[tuple[tuple[int, ...], Mapping[str, Any]]], cells: int
) -> dict[str, Any] | None:
    """Return what the rechecks found, or None if there are none.

    ``elites``: index -> its rows in short, ``success`` (mean fitness over its rechecks, failed ones counting 0: how
    likely one of the objects is held), ``flips`` (share of verdicts, object by object, other than the log's) and
    ``worst`` fitness. ``raw`` and ``corrected``: coverage and QD score of the rechecked elites as logged and with
    ``success`` and the mean objective in the place of what was logged.
    """
    if not rows:
        return None
    by_index: dict[int, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_index.setdefault(row["index"], []).append(row)
    found = {}
    for _, record in elites:
        if record["index"] in by_index:
            found[str(record["index"])] = _one(record, by_index[record["index"]])
    objective = {str(record["index"]): record["objective"] for _, record in elites}
    names = sorted({name for row in rows for name in row.get("perturbation") or {}})
    return {
        "perturbed": names, "rows": len(rows), "elites": found, "rechecked": len(found), "of": len(elites),
        "raw": {"coverage": len(found) / cells, "qd_score": math.fsum(objective[index] for index in found)},
        "corrected": {
            "coverage": sum(one["finished"] > 0 for one in found.values()) / cells,
            "qd_score": math.fsum(one["objective"] for one in found.values()),
        },
    }


def _one(record: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    from finqd.archive import objective

    fitness = [row["fitness"] if row["status"] == "ok" and row["fitness"] is not None else 0.0 for row in rows]
    n = max(1, len(record["objects"]))
    scores = [
        objective(row["fitness"], row["margin"], n) if row["status"] == "ok" and row["fitness"] is not None else 0.0
        for row in rows
    ]
    compared = flipped = 0
    for row in rows:
        for name, logged in record["objects"].items():
            seen = (row.get("objects") or {}).get(name, {})
            if seen.get("held") is not None and logged.get("held") is not None:
                compared += 1
                flipped += bool(seen["held"]) != bool(logged["held"])
    short = [{key: row.get(key) for key in ("perturbation", "status", "reason", "fitness", "margin")} for row in rows]
    return {
        "rows": short, "success": float(np.mean(fitness)), "worst": min(fitness), "objective": float(np.mean(scores)),
        "finished": sum(row["status"] == "ok" for row in rows), "verdicts": compared,
        "flips": flipped / compared if compared else None,
    }
