"""The commands that show what a search found: the page, pictures for papers, and the shape of a design or an elite."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from finqd.errors import InputError

LOG = "run.sqlite"  # what makes a folder a run
PAGE, BENCHMARK = "report.html", "benchmark.json"
NEIGHBOURS = 5


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE.html",
              help=f"Where the page goes.  [default: RUN/{PAGE}]")
@click.option("--png", type=click.Path(path_type=Path), metavar="DIR",
              help="Write pictures for papers there; the page only if --out is given too.")
@click.option("--benchmark", type=click.Path(path_type=Path), metavar="FILE.json",
              help="Compare with this result, from `finqd evaluate DESIGN --out FILE.json`.  "
                   f"[default: RUN/{BENCHMARK} if it is there]")
@click.option("--shapes", type=click.IntRange(0), default=300, show_default=True,
              help="Designs that can be seen in 3-D at most, the best first.")
def report(run: Path, out: Path | None, png: Path | None, benchmark: Path | None, shapes: int) -> None:
    """Show what a search found: one HTML page, without network, from which to pick a gripper.

    RUN is the folder of a search, which may still be going on.
    """
    from finqd.runlog import read_run

    found = read_run(run)
    if png is not None:
        from finqd.cli_files import usable_folder
        from finqd.search_plots import draw_for_paper

        usable_folder(png, "--png")
        for path in draw_for_paper(png, found):
            click.echo(path)
    if png is None or out is not None:
        from finqd.report import write_report

        target = run / PAGE if out is None else out
        known = run / BENCHMARK
        compared = benchmark if benchmark is not None else known if known.is_file() else None
        name = run.resolve().name
        write_report(found, target, name=name, argument=_argument(run), benchmark=compared, shapes=shapes)
        click.echo(target)


@click.command()
@click.argument("design", metavar="DESIGN|RUN")
@click.option("--cell", metavar="I,J,...", help="Of a RUN, the folder of a search: the elite of this cell of its map.")
@click.option("--out", type=click.Path(path_type=Path), required=True,
              help="A .stl or .step file, or a folder to hold both.")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE",
              help="Change one value of the design, by its path in the JSON (protocol.hold_s=10); may be repeated.")
def export(design: str, cell: str | None, out: Path, settings: tuple[str, ...]) -> None:
    """Write the gripper's shape, with its mount, for printing (STL) or CAD (STEP)."""
    from finqd.cli import _read_design
    from finqd.export import export_gripper

    if (Path(design) / LOG).exists():
        chosen = _elite(Path(design), cell, settings)
    elif cell is not None:
        raise InputError(f"goes with the folder of a search (one with {LOG}), and {design!r} is none", "--cell")
    else:
        chosen = _read_design(design, settings)
    for path in export_gripper(chosen, out):
        click.echo(path)


def _elite(run: Path, cell: str | None, settings: Sequence[str]) -> Any:
    """Return the design of a cell's elite. Raises ``InputError`` with cells that are filled if that one is not."""
    from finqd.design import parse_setting
    from finqd.report import design_of
    from finqd.runlog import read_run

    found = read_run(run)
    records = dict(found.elites())
    if not records:
        raise InputError("no cell of its map is filled yet", str(run))
    if cell is None:
        best = sorted(records, key=lambda place: -records[place]["objective"])[:NEIGHBOURS]
        raise InputError(f"name the cell of its map; the best are {_cells(best, records)}", "--cell")
    dims = tuple(int(n) for n in found.archive().dims)
    place = _place(cell, dims)
    if place not in records:
        near = sorted(records, key=lambda other: (sum((a - b) ** 2 for a, b in zip(place, other)), other))[:NEIGHBOURS]
        raise InputError(f"cell {_joined(place)} is empty; filled cells nearby: {_cells(near, records)}", "--cell")
    design = design_of(found, records[place])
    changes = dict(map(parse_setting, settings))
    return design.with_overrides(changes, source="--set:") if changes else design


def _place(cell: str, dims: tuple[int, ...]) -> tuple[int, ...]:
    """Return the cell that a text names."""
    corners, middle = [[0] * len(dims), [n - 1 for n in dims]], [n // 2 for n in dims]
    allowed = " to ".join(map(_joined, corners))
    expected = f"must be {len(dims)} whole numbers from {allowed}, as in {_joined(middle)}, not {cell!r}"
    try:
        place = tuple(int(text) for text in cell.split(","))
    except ValueError as error:
        raise InputError(expected, "--cell") from error
    if len(place) != len(dims) or not all(0 <= i < n for i, n in zip(place, dims)):
        raise InputError(expected, "--cell")
    return place


def _cells(places: Sequence[tuple[int, ...]], records: Any) -> str:
    return "; ".join(f"{_joined(place)} (fitness {records[place]['fitness']:.3g})" for place in places)


def _joined(place: Sequence[int]) -> str:
    return ",".join(map(str, place))


def _argument(run: Path) -> str:
    """Return RUN as a shell takes it."""
    import shlex

    return shlex.quote(str(run))
