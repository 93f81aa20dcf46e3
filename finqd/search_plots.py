"""Pictures of a search: the map as a heatmap, and coverage and QD score over the evaluations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd import archive as qd
from finqd.units import unit_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from ribs.archives import GridArchive

DPI = 160
INK, LINE, GRID = "#222222", "#1f6f8b", "#dddddd"
UNIT_NAMES = {"mm2": "mm²", "mm3": "mm³", "m2": "m²", "m3": "m³", "deg": "°", "kg_m3": "kg/m³"}


def draw(out: Path, archive: GridArchive, records: Sequence[qd.Record], ranges: qd.Ranges) -> None:
    """Write ``heatmap.png`` (of a map with one or two axes), ``coverage.png`` and ``qd_score.png``."""
    if len(ranges) <= 2:
        _heatmap(archive, records, ranges).savefig(out / "heatmap.png", dpi=DPI)
    coverage, score = qd.curves(archive, records, ranges)
    _curve(100.0 * coverage, records, "coverage [% of cells]").savefig(out / "coverage.png", dpi=DPI)
    _curve(score, records, "QD score (sum of the cells' objectives)").savefig(out / "qd_score.png", dpi=DPI)


def label(key: str) -> str:
    """Return the axis label of a JSON key.

    >>> label("volume_mm3"), label("slenderness")
    ('volume [mm³]', 'slenderness')
    """
    unit = next((u for u in UNIT_NAMES if key.endswith(f"_{u}")), unit_of(key))
    name = key.removesuffix(f"_{unit}") if unit else key
    return name.replace("_", " ") + (f" [{UNIT_NAMES.get(unit, unit)}]" if unit else "")


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure  # without pyplot: no window system, nothing global

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    axes.tick_params(color=INK, labelcolor=INK)
    return figure, axes


def _heatmap(archive: GridArchive, records: Sequence[qd.Record], ranges: qd.Ranges) -> Figure:
    """Draw the fitness of each cell's elite."""
    from matplotlib.ticker import StrMethodFormatter
    from ribs.visualize import grid_archive_heatmap

    figure, axes = _figure(7.2, 5.6)
    found = qd.elites(archive, records)
    data = archive.data(["index", "objective", "measures"], return_type="pandas").sort_values("index")
    data["objective"] = [record["fitness"] for _, record in found]
    style: dict[str, Any] = {"edgecolor": GRID, "linewidth": 0.4}
    bar = {"label": "fitness (share of objects held)"}
    grid_archive_heatmap(
        archive, axes, df=data, cmap="viridis", vmin=0.0, vmax=1.0, pcm_kwargs=style, cbar_kwargs=bar, aspect="auto"
    )
    names = list(ranges)
    axes.set_xlabel(label(names[0]))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.6g}"))
    if len(names) == 2:
        axes.set_ylabel(label(names[1]))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.6g}"))
        _write_numbers(axes, archive, found)
    best = max((record["fitness"] for _, record in found), default=None)
    failed = sum(record["status"] != "ok" for record in records)
    title = f"{len(found)} of {archive.cells} cells filled by {len(records)} designs ({failed} failed)"
    axes.set_title(title + (f", best fitness {best:.3g}" if best is not None else ""), fontsize=11, color=INK)
    return figure


def _write_numbers(axes: Axes, archive: GridArchive, found: Sequence[tuple[tuple[int, ...], qd.Record]]) -> None:
    """Write the fitness into each cell, where the cells are large enough to read it."""
    if max(archive.dims) > 14:
        return
    centres = [0.5 * (edges[1:] + edges[:-1]) for edges in archive.boundaries]
    for (i, j), record in found:
        colour = INK if record["fitness"] > 0.6 else "white"
        axes.text(
            centres[0][i], centres[1][j], f"{record['fitness']:.2g}", ha="center", va="center", fontsize=8, color=colour
        )


def _curve(values: np.ndarray, records: Sequence[qd.Record], ylabel: str) -> Figure:
    """Draw a quantity over the number of evaluations, with the ends of the iterations marked."""
    from matplotlib.ticker import MaxNLocator

    figure, axes = _figure(7.2, 4.2)
    axes.step([0, *range(1, len(values) + 1)], [0.0, *values], where="post", color=LINE, linewidth=1.8)
    iterations = np.array([record["iteration"] for record in records])
    ends = np.flatnonzero(np.diff(iterations, append=-1)) + 1
    axes.plot(ends, values[ends - 1], "o", color=LINE, markersize=4, clip_on=False, label="end of an iteration")
    axes.set(xlabel="evaluations", ylabel=ylabel, xlim=(0, max(len(values), 1)))
    axes.set_ylim(bottom=0.0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if len(ends):
        axes.legend(frameon=False, loc="lower right")
    return figure
