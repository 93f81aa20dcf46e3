"""The command ``verify``: runs verification cases and prints a row each as they come."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from finqd.verification.cases import Case, Row

#: column titles and widths; a negative width is of a column of numbers
COLUMNS = (("case", 16), ("quantity", 50), ("unit", 5), ("reference", -10), ("value", -10), ("error", -9), ("band", -8),
           ("", -6), ("seconds", -7))


@click.command()
@click.argument("names", nargs=-1, metavar="[CASE]...")
@click.option("--fast", is_flag=True, help="Coarser twins, which take seconds.")
@click.option("--grasps", "with_grasps", is_flag=True, help="Whole grasps too, a minute or so each.")
@click.option("--list", "only_list", is_flag=True, help="Print what there is, and run nothing.")
@click.option("--json", "out", type=click.Path(path_type=Path), metavar="FILE", help="Write the rows there as well.")
def verify(names: tuple[str, ...], fast: bool, with_grasps: bool, only_list: bool, out: Path | None) -> int:
    """Check the mechanics on this machine against closed forms and published values.

    Without a CASE all are run. Errors are relative, or in the row's unit where the band is followed by a unit. Exit
    code 1 if one leaves its band.
    """
    from finqd.cli_files import written_at_end
    from finqd.verification.cases import measure
    from finqd.verification.catalogue import cases

    chosen = cases(names, fast=fast, with_grasps=with_grasps)
    if only_list:
        for case in chosen:
            click.echo(f"{case.name:18s} {case.quantity}: {case.reference:.5g} {_unit(case)}({case.source})")
        return 0
    click.echo(_line([title for title, _ in COLUMNS]))
    rows: list[Row] = []
    source = ""
    with written_at_end(out, "--json") as write:
        for case in chosen:
            rows.append(measure(case))
            _print(rows[-1], said=source)
            source = rows[-1].source
        write(json.dumps([row.to_dict() for row in rows], indent=2, allow_nan=False) + "\n")
    missed = [row for row in rows if not row.passed]
    seconds = sum(row.seconds for row in rows)
    click.echo(f"{len(rows) - len(missed)} of {len(rows)} inside their bands, in {seconds:.0f} s")
    return 1 if missed else 0


def _print(row: Row, *, said: str) -> None:
    """Print a row, and below it its source unless that was ``said`` just now, and its note."""
    band = f"{row.band:.2g}" if row.absolute else f"{row.band:.1%}"
    error = f"{row.error:+.2g}" if row.absolute else f"{row.error:+.2%}"
    click.echo(_line([
        row.case, row.quantity, row.unit, f"{row.reference:.5g}", f"{row.value:.5g}", error, band,
        "ok" if row.passed else "MISSED", f"{row.seconds:.1f}",
    ]))
    below = [text for text in (row.source if row.source != said else "", row.note) if text]
    if below:
        click.echo(f"{'':17s}{'; '.join(below)}")


def _line(cells: list[str]) -> str:
    """Return cells in columns; one that is too long pushes the rest to the right."""
    return " ".join(
        cell.ljust(width) if width > 0 else cell.rjust(-width) for cell, (_, width) in zip(cells, COLUMNS, strict=True)
    ).rstrip()


def _unit(case: Case) -> str:
    return "" if case.unit == "-" else f"{case.unit} "
