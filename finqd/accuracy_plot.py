"""The picture of an accuracy study: error against seconds on logarithmic axes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from finqd.accuracy import Row, Study, front

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DPI = 130
INK, SOFT, FRONT, PRESET = "#222222", "#999999", "#111111", "#c1121f"
#: element families have colours of their own; else a colour says what is turned, and a mark which of several it is
FAMILIES = {
    "size of tet4": "#d62828", "size of tet10": "#e07a1f", "size of hex8": "#2a9d4a",
    "size of hex8, two through a wall": "#8cc63f", "size of hex20": "#0b3c8c",
    "size of hex20, quarter nodes": "#1f8bb0", "size of hex20, quarter nodes, graded": "#000000",
}
COLOURS = {
    "size": "#1f6f8b", "element": "#9a7b4f", "step": "#7fbf9a", "adaptive": "#5aa05a", "stepper": "#8e5bb5",
    "newton": "#b58b00", "linear": "#5c7fd6", "contact": "#d1699b", "elasticity": "#7a5230",
}
MARKS = "osD^vP<>hX*pd"
Box = tuple[float, float, float, float]  # left, bottom, right, top
LABEL_WIDTH, LABEL_HEIGHT = 5.6, 26.0  # of a letter, and of a label's two lines [points]


def draw(study: Study, path: Path) -> None:
    """Write the picture: one curve a series, the Pareto front, the presets and the paper's setting by name."""
    from matplotlib.figure import Figure  # without pyplot: no window system, nothing global

    rows = [row for row in study.table() if row["status"] == "ok" and row["error_percent"] is not None]
    figure = Figure(figsize=(12.5, 7.2), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xscale="log", yscale="log")
    axes.margins(0.07, 0.1)
    lowest = _lowest(study, rows)
    for colour, mark, name, line in _curves(study, rows):
        points = [(row["seconds"], max(abs(row["error_percent"]), lowest)) for row in line]
        width = 2.0 if name.startswith("size of") else 1.1
        axes.plot(*zip(*points), color=colour, marker=mark, markersize=5.5, linewidth=width, alpha=0.85, label=name)
    best = [(row["seconds"], max(row["resolved_percent"], lowest)) for row in front(rows)]
    if best:
        axes.plot(*zip(*best), color=FRONT, linewidth=5, alpha=0.22, solid_capstyle="round", label="Pareto front")
    marked = [(row["seconds"], max(abs(row["error_percent"]), lowest)) for row in rows if row["knob"] == "preset"]
    if marked:
        axes.plot(*zip(*marked), linestyle="")  # makes room for them
    _dress(axes, study)
    figure.draw_without_rendering()  # labels are placed where the points are, once the layout is done
    _mark_presets(axes, {row["rung"]: row for row in rows if row["knob"] == "preset"}, lowest)
    figure.savefig(path, dpi=DPI)


def _curves(study: Study, rows: Sequence[Row]) -> list[tuple[str, str, str, list[Row]]]:
    """Return colour, mark, label and points of each series, in the ladder's order of knobs; settings from coarse on."""
    series: dict[str, list[Row]] = {}
    for row in rows:
        if row["knob"] in COLOURS:
            series.setdefault(row["series"], []).append(row)
    drawn, used = [], dict.fromkeys(COLOURS, 0)
    for name, line in sorted(series.items(), key=lambda item: list(COLOURS).index(item[1][0]["knob"])):
        knob = line[0]["knob"]
        colour, mark = FAMILIES.get(name, COLOURS[knob]), MARKS[used[knob] % len(MARKS)]
        drawn.append((colour, mark, name, sorted(line, key=_setting)))
        used[knob] += 1
    return drawn


def _setting(row: Row) -> tuple[Any, ...]:
    """Return the turned value itself, so that a curve runs along its knob; names in the order of their seconds."""
    numbers = [v for v in row["settings"].values() if isinstance(v, (int, float)) and not isinstance(v, bool)]
    names = any(isinstance(value, str) for value in row["settings"].values()) and not numbers
    return (row["seconds"],) if names or row["knob"] == "linear" else tuple(-float(number) for number in numbers)


def _lowest(study: Study, rows: Sequence[Row]) -> float:
    """Return where the picture's floor is [%]: an error of nothing has no logarithm."""
    floor = study.reference.uncertainty_percent if study.reference else 0.0
    found = [abs(row["error_percent"]) for row in rows if abs(row["error_percent"]) > 0.0]
    return max(0.3 * floor, 0.5 * min(found, default=1.0) if floor == 0.0 else 0.0, 1e-4)


def _mark_presets(axes: Axes, presets: Mapping[str, Row], lowest: float) -> None:
    """Mark each preset by a star and a label, which lies where it covers no star and no other label."""
    taken: list[Box] = []
    points = {
        name: (row["seconds"], max(abs(row["error_percent"]), lowest))
        for name, row in sorted(presets.items(), key=lambda item: item[1]["seconds"])
    }
    seen = {name: axes.transData.transform(point) * (72.0 / axes.figure.dpi) for name, point in points.items()}
    taken += [(x - 9, y - 9, x + 9, y + 9) for x, y in seen.values()]
    left, bottom, right, top = (value * 72.0 / axes.figure.dpi for value in axes.get_window_extent().extents)
    for name, point in points.items():
        axes.plot(*point, marker="*", markersize=17, color=PRESET, markeredgecolor="white", linestyle="", zorder=9)
        text = "the paper's setting" if name == "paper" else name
        error = abs(presets[name]["error_percent"])
        told = f"{text}\n{error:.{3 if error >= 100.0 else 2}g} %, {presets[name]['seconds']:.2g} s"
        width = LABEL_WIDTH * max(map(len, told.split("\n")))
        shift, box = _free_place(tuple(seen[name]), width, taken, (left, bottom, right, top))
        taken.append(box)
        axes.annotate(
            told, point, xytext=shift, textcoords="offset points", ha="center", va="center", fontsize=9.5,
            fontweight="bold", color=PRESET, zorder=10, arrowprops={"arrowstyle": "-", "color": PRESET, "lw": 0.8},
            bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.0},
        )


def _free_place(
    point: Sequence[float], width: float, taken: Sequence[Box], inside: Box
) -> tuple[tuple[float, float], Box]:
    """Return how far from ``point`` the middle of a label lies that covers nothing, and its box; all in points."""
    angles = [math.pi * share for share in (0.5, -0.5, -0.1, 0.1, 0.9, 1.1)]
    places = [(1.6 * far * math.cos(a), far * math.sin(a)) for far in range(32, 240, 12) for a in angles]
    centres = [(point[0] + dx, point[1] + dy) for dx, dy in places]
    across, up = 0.5 * width, 0.5 * LABEL_HEIGHT
    boxes = [(x - across, y - up, x + across, y + up) for x, y in centres]
    clear = [
        b[0] >= inside[0] and b[1] >= inside[1] and b[2] <= inside[2] and b[3] <= inside[3]
        and all(b[0] > t[2] or b[2] < t[0] or b[1] > t[3] or b[3] < t[1] for t in taken) for b in boxes
    ]
    best = clear.index(True) if True in clear else 0
    return places[best], boxes[best]


def _dress(axes: Axes, study: Study) -> None:
    from matplotlib.ticker import FuncFormatter, LogFormatter

    class Plain(LogFormatter):
        """Labels what `LogFormatter` would, without powers of ten."""

        def __call__(self, x: float, pos: int | None = None) -> str:
            return f"{x:g}" if super().__call__(x, pos) else ""

    quantity = study.case.quantities[study.case.main]
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_major_formatter(plain)
    axes.yaxis.set_major_formatter(plain)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(Plain(labelOnlyBase=False, minor_thresholds=(1.5, 0.5)))
    axes.set_xlabel("seconds on one core (without meshing and compiling)", color=INK)
    axes.set_ylabel(f"error of the {quantity.label} [%]", color=INK)
    axes.set_title(f"{study.case.title}: {study.design.name}", fontsize=12, color=INK)
    if study.reference and study.reference.uncertainty_percent > 0.0:
        low, high = axes.get_ylim()
        low = min(low, 0.2 * study.reference.uncertainty_percent)
        axes.axhspan(low, study.reference.uncertainty_percent, color=SOFT, alpha=0.18, zorder=0)
        axes.text(
            0.995, study.reference.uncertainty_percent, "the reference is no surer than this ", fontsize=8.5,
            color=INK, ha="right", va="top", transform=axes.get_yaxis_transform(),
        )
        axes.set_ylim(max(low, 0.2 * study.reference.uncertainty_percent), high)
    axes.grid(which="major", color="#dddddd", linewidth=0.7)
    axes.grid(which="minor", color="#eeeeee", linewidth=0.4)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        axes.legend(handles, labels, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
