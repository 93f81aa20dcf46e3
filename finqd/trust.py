"""What rechecks say of a map: corrected beside raw scores, and how sure each elite's verdicts are.

`DEFINITION` says how: after M. Flageat and A. Cully, Uncertain Quality-Diversity: evaluation methodology and new
methods for quality-diversity in uncertain domains, IEEE Trans. Evol. Comput., 2024 (arXiv:2302.00463), whose corrected
archive this is. It leaves out the optimist's share of the raw one: an elite may be one because it was lucky.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.perturbations import interval

if TYPE_CHECKING:
    from ribs.archives import GridArchive

DEFINITION = (
    "Corrected: each elite is evaluated anew under the perturbations, and put into an empty archive at its mean "
    "features with its mean objective; where two meet, the better mean stays. QD score: sum of the cells' "
    "objectives; coverage: share of cells filled; raw: those of the same elites as the search told them. A recheck "
    "that failed (no simulation finished, crash, time limit) counts as one that holds nothing, with objective 0; an "
    "elite all of whose rechecks failed is in no cell. Success: share of verdicts (recheck by object) that are "
    "held. Keeps: share of rechecks in which an elite held at least as many objects as raw. Flips: share of "
    "verdicts that differ from the raw ones. Intervals: Wilson's, 95 %, made for independent trials: perturbations "
    "are spread more evenly than those, but verdicts of one recheck, and elites under one perturbation, go "
    "together."
)

Record = Mapping[str, Any]
Cell = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Share:
    """So many of so many: a probability with Wilson's 95 % interval."""

    part: int
    whole: int

    @property
    def rate(self) -> float | None:
        """The share, None of nothing."""
        return self.part / self.whole if self.whole else None

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the probability."""
        return interval(self.part, self.whole)

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        return {"part": self.part, "whole": self.whole, "rate": self.rate, "interval_95": list(self.interval)}


@dataclass(frozen=True, kw_only=True)
class ObjectTrust:
    """One object: whether it was held raw (None: pooled over elites); rechecks that held it; verdicts that flipped."""

    name: str
    raw: bool | None
    held: Share
    flips: Share

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        return {"raw": self.raw, "held": self.held.to_dict(), "flips": self.flips.to_dict()}


@dataclass(frozen=True, kw_only=True)
class EliteTrust:
    """One elite. ``corrected``: its mean objective, None without rechecks; ``cell``: where it is in the raw map.

    success: verdicts (recheck by object) that are held, whose rate is the mean fitness if that is the share of objects
    held; flips: verdicts that differ from the raw ones; keeps: rechecks in which it held at least as many objects as
    raw; failed: rechecks that failed; objects: each object's
    """

    index: int
    cell: Cell
    rechecks: int
    failed: int
    raw: float
    corrected: float | None
    raw_fitness: float
    fitness: float | None
    success: Share
    keeps: Share
    flips: Share
    objects: tuple[ObjectTrust, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        return {
            "index": self.index, "cell": list(self.cell), "rechecks": self.rechecks, "failed": self.failed,
            "objective": {"raw": self.raw, "corrected": self.corrected},
            "fitness": {"raw": self.raw_fitness, "mean": self.fitness},
            "success": self.success.to_dict(), "keeps": self.keeps.to_dict(), "flips": self.flips.to_dict(),
            "objects": {one.name: one.to_dict() for one in self.objects},
        }


@dataclass(frozen=True, kw_only=True)
class Trust:
    """What the rechecks by one scheme say; ``raw`` and ``corrected``: {"qd_score", "coverage"} of the same elites.

    scheme: as in the log; rechecks: asked for an elite; complete: whether all are there; cells: of the map; elites: in
    the order of the cells; objects: pooled over elites
    """

    scheme: Mapping[str, Any]
    rechecks: int
    complete: bool
    cells: int
    raw: Mapping[str, float]
    corrected: Mapping[str, float]
    elites: tuple[EliteTrust, ...]
    objects: tuple[ObjectTrust, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        return {
            "format": "finqd recheck", "definition": DEFINITION,
            "scheme": dict(self.scheme), "rechecks": self.rechecks, "complete": self.complete, "cells": self.cells,
            "raw": dict(self.raw), "corrected": dict(self.corrected),
            "elites": [one.to_dict() for one in self.elites], "objects": {o.name: o.to_dict() for o in self.objects},
        }


def trust(
    elites: Sequence[tuple[Cell, Record]], rows: Sequence[Record], *, archive: GridArchive, features: Sequence[str],
    scheme: Mapping[str, Any], count: int,
) -> Trust:
    """Return what ``rows`` say of ``elites``; of rows by another scheme, or with numbers from ``count`` on, nothing.

    archive: the raw map, for its grid; features: its axes
    """
    by_index: dict[int, dict[int, Record]] = {}
    for row in rows:
        if row["scheme"] == scheme and row["number"] < count:
            by_index.setdefault(row["index"], {})[row["number"]] = row
    found = [
        (cell, record, [row for _, row in sorted(by_index.get(record["index"], {}).items())])  # sums in one order
        for cell, record in elites
    ]
    told = tuple(_elite(*one) for one in found)
    rechecked = [one.raw for one in told if one.rechecks]
    means = [
        (one.corrected, _mean_features(record, rows, features))
        for one, (_, record, rows) in zip(told, found)
        if one.corrected is not None and one.failed < one.rechecks
    ]
    best: dict[int, float] = {}
    for value, place in means:
        cell = int(archive.index_of_single(place))
        best[cell] = max(value, best.get(cell, value))
    return Trust(
        scheme=scheme, rechecks=count, complete=all(one.rechecks == count for one in told), cells=int(archive.cells),
        raw=_scores(rechecked, int(archive.cells)), corrected=_scores(best.values(), int(archive.cells)),
        elites=told, objects=_pooled(told),
    )


def _scores(objectives: Any, cells: int) -> dict[str, float]:
    values = list(objectives)
    return {"qd_score": math.fsum(values), "coverage": len(values) / cells}


def _elite(cell: Cell, record: Record, rows: Sequence[Record]) -> EliteTrust:
    names = sorted(record["objects"])
    raw = {name: bool(record["objects"][name].get("held")) for name in names}
    held = {name: sum(_held(row, name) for row in rows) for name in names}
    flips = {name: sum(_held(row, name) != raw[name] for row in rows) for name in names}
    count = len(rows)
    n_raw = sum(raw.values())
    return EliteTrust(
        index=record["index"], cell=cell, rechecks=count, failed=sum(row["status"] != "ok" for row in rows),
        raw=record["objective"], corrected=_mean([_or_zero(row, "objective") for row in rows]),
        raw_fitness=record["fitness"], fitness=_mean([_or_zero(row, "fitness") for row in rows]),
        success=Share(part=sum(held.values()), whole=count * len(names)),
        keeps=Share(part=sum(sum(_held(row, name) for name in names) >= n_raw for row in rows), whole=count),
        flips=Share(part=sum(flips.values()), whole=count * len(names)),
        objects=tuple(
            ObjectTrust(name=name, raw=raw[name], held=Share(part=held[name], whole=count),
                        flips=Share(part=flips[name], whole=count))
            for name in names
        ),
    )


def _held(row: Record, name: str) -> bool:
    return row["status"] == "ok" and bool(row["objects"].get(name, {}).get("held"))


def _or_zero(row: Record, key: str) -> float:
    return float(row[key]) if row["status"] == "ok" else 0.0


def _mean(values: Sequence[float]) -> float | None:
    """Return the mean; of equal values just that value, to the last bit."""
    if not values:
        return None
    return values[0] if min(values) == max(values) else float(np.mean(values))


def _mean_features(record: Record, rows: Sequence[Record], features: Sequence[str]) -> list[float]:
    good = [row for row in rows if row["status"] == "ok"]
    return [value if (value := _mean([row["features"][name] for row in good])) is not None else record["features"][name]
            for name in features]


def _pooled(elites: Sequence[EliteTrust]) -> tuple[ObjectTrust, ...]:
    names = sorted({one.name for elite in elites for one in elite.objects})
    pooled = []
    for name in names:
        found = [one for elite in elites for one in elite.objects if one.name == name]
        pooled.append(ObjectTrust(
            name=name, raw=None,
            held=Share(part=sum(o.held.part for o in found), whole=sum(o.held.whole for o in found)),
            flips=Share(part=sum(o.flips.part for o in found), whole=sum(o.flips.whole for o in found)),
        ))
    return tuple(pooled)
