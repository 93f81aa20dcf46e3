"""Where finqd's words meet those of quality diversity, and nowhere else.

    parameters (a point of the unit cube)  ->  solution
    fitness and margin                     ->  objective
    features                               ->  measures

The objective of a design that was simulated is ``fitness + (0.1 / objects) * (1 + margin) / 2``: the margin, in
[-1, 1], orders designs that hold the same number of objects (an archive never replaces on a tie) and is worth at most a
tenth of one object. So it lies in [0, 1.1]. A design that failed gets `PENALTY`, which lies below `THRESHOLD_MIN`: it
is told to the optimiser, but no cell ever takes it.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.errors import InputError

if TYPE_CHECKING:
    from ribs.archives import GridArchive

    from finqd.contracts import Parameter
    from finqd.design import Design

PENALTY = -1.0  # objective of a design that failed
THRESHOLD_MIN = -0.5  # a cell takes only what is above
TIE_BREAK = 0.1  # what the whole range of the margin is worth, in objects
RANGE_SAMPLES = 256  # a power of two, as Sobol points want it

Record = Mapping[str, Any]
Ranges = Mapping[str, tuple[float, float]]


def objective(fitness: float, margin: float, n_objects: int) -> float:
    """Return the objective of a simulated design, in [0, 1.1]; ``fitness`` in [0, 1], ``margin`` in [-1, 1].

    >>> two_held_well, three_held_barely = objective(0.2, 1.0, 10), objective(0.3, -1.0, 10)
    >>> round(two_held_well, 6), round(three_held_barely, 6)
    (0.21, 0.3)
    """
    return fitness + TIE_BREAK / n_objects * (1.0 + min(max(margin, -1.0), 1.0)) / 2.0


def measure_features(design: Design) -> dict[str, float]:
    """Return all features of a design, from its shape alone: nothing is meshed or simulated. Raises ``InputError``."""
    geometry = design.plugin("geometry")
    solids = [geometry.build(design.finger_si(i)) for i in range(len(design.fingers))]
    features: dict[str, float] = {}
    for plugin in design.plugin("features"):
        features |= plugin.measure(design, solids)
    return features


def main_features(design: Design) -> tuple[str, ...]:
    """Return the axes of a design's map: the first feature of each of its feature plugins."""
    return tuple(dict.fromkeys(plugin.names[0] for plugin in design.plugin("features")))


def feature_ranges(decode: Callable[[np.ndarray], Design], n_parameters: int) -> dict[str, tuple[float, float]]:
    """Return the map's axes: the first feature of each feature plugin, and its range over the search space.

    Of 256 Sobol designs: the range between the 1st and the 99th percentile, widened on both sides by a fifth (good
    designs lie at the edge, the paper's do), but not past the extremes of the sample and of two opposite corners of the
    cube. A value outside counts to the outermost cell. Raises ``InputError`` if no sample is a valid design.
    """
    from scipy.stats import qmc

    points = qmc.Sobol(n_parameters, scramble=False).random(RANGE_SAMPLES)  # the first one is the lower corner
    values: dict[str, list[float]] = {}
    reason = ""
    for unit in [*points, np.ones(n_parameters)]:
        try:
            design = decode(unit)
            features = measure_features(design)
        except InputError as error:
            reason = str(error)
            continue
        for name in main_features(design):
            values.setdefault(name, []).append(features[name])
    if not values:
        raise InputError(f"none of {RANGE_SAMPLES} sampled designs is valid ({reason})", where="geometry")
    return {name: _widened(np.array(column)) for name, column in values.items()}


def _widened(values: np.ndarray) -> tuple[float, float]:
    low, high = np.percentile(values, [1.0, 99.0])
    low, high = max(low - 0.2 * (high - low), values.min()), min(high + 0.2 * (high - low), values.max())
    if not high > low:  # a feature that does not vary still needs an axis
        low, high = low - 0.5 * max(abs(low), 1e-9), high + 0.5 * max(abs(high), 1e-9)
    return float(low), float(high)


def new_archive(n_parameters: int, ranges: Ranges, *, cells: int, seed: np.random.SeedSequence) -> GridArchive:
    """Return an empty grid over the features, ``cells`` along each; its field ``evaluation`` is a record's index."""
    from ribs.archives import GridArchive

    return GridArchive(
        solution_dim=n_parameters,
        dims=[cells] * len(ranges),
        ranges=list(ranges.values()),
        learning_rate=1.0,
        threshold_min=THRESHOLD_MIN,
        seed=seed,
        extra_fields={"evaluation": ((), np.int64)},
    )


def rebuilt(records: Sequence[Record], n_parameters: int, ranges: Ranges, *, cells: int) -> GridArchive:
    """Return the archive that these records make, in their order: of each cell the first of the best."""
    archive = new_archive(n_parameters, ranges, cells=cells, seed=np.random.SeedSequence(0))
    for record in records:
        if record["status"] == "ok":
            archive.add_single(
                record["unit"], record["objective"], _measures(record, ranges), evaluation=record["index"]
            )
    return archive


def tell(scheduler: Any, batch: Sequence[Record], ranges: Ranges) -> None:
    """Tell a scheduler what became of the designs it asked for, in its order: finite numbers, whatever happened."""
    scheduler.tell(
        objective=[record["objective"] for record in batch],
        measures=[_measures(record, ranges) for record in batch],
        evaluation=[record["index"] for record in batch],
    )


def _measures(record: Record, ranges: Ranges) -> list[float]:
    """Return a record's features on the axes; the middle where they are missing (only a failed design lacks any)."""
    return [
        float(value) if _is_finite(value := record["features"].get(name)) else 0.5 * (low + high)
        for name, (low, high) in ranges.items()
    ]


def _is_finite(value: Any) -> bool:
    return isinstance(value, (int, float, np.number)) and math.isfinite(value)


def why_failed(evaluation: Record, names: Sequence[str]) -> str:
    """Return why a design that was evaluated counts as failed, in one sentence, or "" if it does not.

    It failed if no simulation reached its end, or if a number that the search needs (``names``: the features on the
    axes) is missing or not finite.
    """
    objects = evaluation["objects"]
    if objects and all(row.get("status") != "ok" for row in objects.values()):
        name, row = next(iter(objects.items()))
        return f"no simulation finished; {name}: {row.get('reason') or row.get('status')}"
    numbers = {key: evaluation[key] for key in ("fitness", "margin")}
    numbers |= {name: evaluation["features"].get(name) for name in names}
    return ", ".join(f"{name} is {value}" for name, value in numbers.items() if not _is_finite(value))


def curves(archive: GridArchive, records: Sequence[Record], ranges: Ranges) -> tuple[np.ndarray, np.ndarray]:
    """Return coverage (share of cells filled) and QD score (sum of the cells' objectives) after each evaluation.

    Both have the length of ``records``, which are taken in the order in which they were told.
    """
    best: dict[int, float] = {}
    coverage, score = [], []
    for record in records:
        cell = int(archive.index_of_single(_measures(record, ranges)))
        if record["objective"] > best.get(cell, THRESHOLD_MIN):
            best[cell] = record["objective"]
        coverage.append(len(best) / archive.cells)
        score.append(math.fsum(best.values()))
    return np.array(coverage), np.array(score)


def elites(archive: GridArchive, records: Sequence[Record]) -> list[tuple[tuple[int, ...], Record]]:
    """Return grid cell and record of every elite, in the order of the cells."""
    if archive.empty:
        return []
    data = archive.data(["index", "evaluation"])
    order = np.argsort(data["index"])
    cells = archive.int_to_grid_index(data["index"][order])
    by_index = {record["index"]: record for record in records}
    return [(tuple(map(int, cell)), by_index[int(e)]) for cell, e in zip(cells, data["evaluation"][order])]


def entered(archive: GridArchive, records: Sequence[Record], ranges: Ranges) -> list[int]:
    """Return the indices of the records that entered the archive when they were told, elites still or not."""
    best: dict[int, float] = {}
    found = []
    for record in records:
        cell = int(archive.index_of_single(_measures(record, ranges)))
        if record["objective"] > best.get(cell, THRESHOLD_MIN):
            best[cell] = record["objective"]
            found.append(record["index"])
    return found


def elite_indices(archive: GridArchive) -> list[int]:
    """Return the indices of the records that are elites."""
    return [] if archive.empty else [int(index) for index in archive.data("evaluation")]


def would_enter(archive: GridArchive, record: Record, ranges: Ranges) -> bool:
    """Return whether a record that counts would enter the archive."""
    occupied, elite = archive.retrieve_single(_measures(record, ranges))
    return record["objective"] > (elite["objective"] if occupied else THRESHOLD_MIN)


def archive_table(
    found: Sequence[tuple[tuple[int, ...], Record]], ranges: Ranges, parameters: Sequence[tuple[str, Parameter]]
) -> str:
    """Return elites as CSV, a row each: cell, scores, parameters in JSON units, unit vector."""
    paths = [path for path, _ in parameters]
    axes = [f"cell_{name}" for name in ranges]
    objects = sorted({name for _, record in found for name in record["objects"]})
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [*axes, "evaluation", "objective", "fitness", "margin", *ranges, *(f"held_{name}" for name in objects)]
        + ["design_digest", *paths, *(f"unit_{i}" for i in range(len(paths)))]
    )
    for cell, record in found:
        held = [record["objects"].get(name, {}).get("held") for name in objects]
        writer.writerow(
            [*cell, record["index"], record["objective"], record["fitness"], record["margin"]]
            + [record["features"][name] for name in ranges]
            + [*held, record["design_digest"], *record["parameters"].values(), *record["unit"]]
        )
    return text.getvalue()
