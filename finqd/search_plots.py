"""Pictures of a search: the map as a heatmap, coverage and QD score, and success against volume."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd import archive as qd
from finqd.labels import label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from ribs.archives import GridArchive

DPI = 160
COVERAGE, QD_SCORE = "coverage [% of cells]", "QD score (sum of the cells' objectives)"
INK, LINE, GRID = "#222222", "#1f6f8b", "#dddddd"


def draw(out: Path, archive: GridArchive, records: Sequence[qd.Record], ranges: qd.Ranges) -> None:
    """Write ``heatmap.png`` (of a map with one or two axes), ``coverage.png`` and ``qd_score.png``."""
    if len(ranges) <= 2:
        _heatmap(archive, records, ranges).savefig(out / "heatmap.png", dpi=DPI)
    coverage, score = qd.curves(archive, records, ranges)
    _curve(100.0 * coverage, records, COVERAGE).savefig(out / "coverage.png", dpi=DPI)
    _curve(score, records, QD_SCORE).savefig(out / "qd_score.png", dpi=DPI)


def draw_for_paper(out: Path, run: Any) -> list[Path]:
    """Write the pictures of a run as PNG files into ``out``, and return their paths.

    ``run``: as `finqd.runlog.read_run` returns it. Besides what `draw` writes: both curves over the seconds of
    computing, and ``pareto.png``. No heatmap of a map with more than two axes.
    """
    from finqd.report import elapsed, shown_volume

    records, archive = run.records(), run.archive()
    draw(out, archive, records, run.ranges)
    coverage, score = qd.curves(archive, records, run.ranges)
    seconds = np.array(elapsed(records))
    for name, values, title in (("coverage", 100.0 * coverage, COVERAGE), ("qd_score", score, QD_SCORE)):
        _curve(values, records, title, seconds=seconds).savefig(out / f"{name}_seconds.png", dpi=DPI)
    _pareto(records, run.elites(), shown_volume(records, run.ranges)).savefig(out / "pareto.png", dpi=DPI)
    names = ["coverage", "coverage_seconds", "qd_score", "qd_score_seconds", "pareto"]
    return [out / f"{name}.png" for name in (["heatmap"] if len(run.ranges) <= 2 else []) + names]


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


def _curve(
    values: np.ndarray, records: Sequence[qd.Record], ylabel: str, *, seconds: np.ndarray | None = None
) -> Figure:
    """Draw a quantity over the number of evaluations, or over ``seconds``, with the ends of the iterations marked."""
    from matplotlib.ticker import MaxNLocator

    figure, axes = _figure(7.2, 4.2)
    across = np.arange(1, len(values) + 1) if seconds is None else seconds
    axes.step([0, *across], [0.0, *values], where="post", color=LINE, linewidth=1.8)
    iterations = np.array([record["iteration"] for record in records])
    ends = np.flatnonzero(np.diff(iterations, append=-1))
    if len(ends) <= 40:
        axes.plot(across[ends], values[ends], "o", color=LINE, markersize=4, clip_on=False, label="end of an iteration")
    xlabel = "evaluations" if seconds is None else "computing time [s]"
    axes.set(xlabel=xlabel, ylabel=ylabel, xlim=(0, max(across[-1] if len(across) else 1, 1)))
    axes.set_ylim(bottom=0.0)
    if seconds is None:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _plain(axes)
    if 0 < len(ends) <= 40:
        axes.legend(frameon=False, loc="lower right")
    return figure


def _pareto(records: Sequence[qd.Record], elites: Sequence[tuple], volume: str) -> Figure:
    """Draw fitness over volume: all designs, the elites, and the front, beyond which nothing holds more with less."""
    from matplotlib.ticker import StrMethodFormatter

    from finqd.report import pareto_front

    figure, axes = _figure(7.2, 4.6)
    ok = [record for record in records if record["status"] == "ok"]
    front = pareto_front(ok, volume)
    shown = (
        ("all designs", ok, {"color": "#b9c2c9", "s": 12}),
        ("elites", [record for _, record in elites], {"color": LINE, "s": 16}),
        ("front", front, {"facecolor": "white", "edgecolor": INK, "s": 42, "zorder": 4}),
    )
    for name, some, style in shown:
        points = [(r["features"][volume], r["fitness"]) for r in some if volume in r["features"]]
        axes.scatter(*(zip(*points) if points else ((), ())), label=name, **style)
    if front:
        axes.step(*zip(*[(r["features"][volume], r["fitness"]) for r in front]), where="post", color=INK, linewidth=1.2)
    axes.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    axes.set(xlabel=label(volume), ylabel="fitness (share of objects held)", ylim=(-0.03, 1.05))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.6g}"))
    _plain(axes)
    return figure


def _plain(axes: Axes) -> None:
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
