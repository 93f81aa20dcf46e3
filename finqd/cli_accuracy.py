"""``finqd accuracy``: what a better number costs."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from finqd.errors import InputError

if TYPE_CHECKING:
    from finqd.accuracy import Row, Study
    from finqd.accuracy_reference import Reference

_NUMBER = r"\s*(\d+(?:\.\d*)?|\.\d+)\s*"
_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}


@click.command()
@click.argument("case", type=click.Choice(("press", "closing", "grasp")), default="press")
@click.option("--design", default="benchmark", show_default=True, metavar="DESIGN", help="A file, or a known name.")
@click.option("--finger", type=int, metavar="I", help="Which finger is pressed, counted from 0 as in the file.")
@click.option("--object", "grasped", metavar="NAME", help="What is grasped, by name or JSON file.  [default: sphere]")
@click.option("--knob", "knobs", multiple=True, metavar="NAME", help="Only this knob; may be repeated.  "
              "[default: all; for --error and --budget those of mesh, step and preset]")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder of log, table, picture and page; "
              "a study that is there goes on.  [default: accuracy-CASE]")
@click.option("--jobs", type=click.IntRange(1, 1024), default=1, show_default=True,
              help="Rungs side by side; more than one spoils the seconds.")
@click.option("--error", metavar="PERCENT", help="Answer with the cheapest setting within this error, such as 5%.")
@click.option("--budget", metavar="TIME", help="Answer with the most accurate setting within this time, such as 60s.")
@click.option("--full", is_flag=True, help="The dear rungs too.")
@click.option("--reference", "wanted", default="auto", show_default=True, metavar="auto|compute|FILE",
              help="What errors are measured against: the one that ships with finqd if it fits, or made anew.")
@click.option("--limit", default="600s", show_default=True, metavar="TIME", help="Wall-clock time of one rung.")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Change one value of the design first.")
def accuracy(
    case: str, design: str, finger: int | None, grasped: str | None, knobs: tuple[str, ...], out: Path | None,
    jobs: int, error: str | None, budget: str | None, full: bool, wanted: str, limit: str, settings: tuple[str, ...],
) -> int:
    """Measure error against seconds for a ladder of meshes, steps, solvers and presets.

    CASE is a press of one finger (the default), the closing on an object, or a whole grasp.
    """
    percent = None if error is None else read_percent(error)
    seconds = None if budget is None else read_seconds(budget, "--budget")
    most = read_seconds(limit, "--limit")
    from finqd.cli import _read_design
    from finqd.cli_files import usable_folder
    from finqd.cli_progress import shown_progress

    chosen = _read_design(design, settings)
    reference = wanted if wanted in ("auto", "compute") else _read_reference(wanted)
    from finqd.accuracy import open_study
    from finqd.accuracy_cases import CASES, case_options
    from finqd.accuracy_ladder import TRADES

    options = case_options(CASES[case], finger=finger, grasped=grasped, design=chosen)
    if not knobs and (percent is not None or seconds is not None):
        knobs = TRADES
    folder = out or Path(f"accuracy-{case}")
    study = open_study(chosen, CASES[case], options, folder, knobs=knobs, full=full, limit=most, jobs=jobs)
    usable_folder(folder, "--out")
    with shown_progress() as progress:
        study.on_progress, study.on_row = progress, _say_row
        return _answer(study, reference, percent, seconds)


def _answer(study: Study, reference: str | Reference, percent: float | None, seconds: float | None) -> int:
    """Run what is asked for, print it, and return the exit code: 1 if there is no answer."""
    from finqd.accuracy import REFERENCE, best_within, cheapest_within, disturbed, outdated
    from finqd.accuracy_reference import write_reference
    from finqd.accuracy_report import write_report

    study.set_reference(reference)
    if study.reference is None:
        click.echo("finqd: no rung of the reference worked, so there are no errors, only values", err=True)
    else:
        write_reference(study.out / REFERENCE, study.reference)
        click.echo(study.reference.sentence())
    answers = []
    if percent is not None:
        answers.append((f"error up to {percent:g} %", cheapest_within(study, percent)))
    if seconds is not None:
        answers.append((f"at most {seconds:g} s", best_within(study, seconds)))
    if not answers:
        study.run(study.rungs)
        _print_table(study)
    if late := disturbed(study.table()):
        click.echo(f"finqd: the machine was busy with other work during {len(late)} rungs: their seconds are too long",
                   err=True)
    if old := outdated(study.table(), study.versions["source"]):
        click.echo(f"finqd: {len(old)} rungs were measured with another state of finqd's source; move the log away to "
                   "measure them again", err=True)
    for path in write_report(study):
        click.echo(path)
    for question, row in answers:
        _print_answer(study, question, row)
    return int(study.reference is None or any(row is None for _, row in answers))


def read_percent(text: str) -> float:
    """Return the percentage in ``5%``. Raises ``InputError`` for anything else.

    >>> read_percent("2.5 %")
    2.5
    """
    match = re.fullmatch(_NUMBER + r"%\s*", text)
    value = float(match[1]) if match else math.nan
    if not (math.isfinite(value) and 0.0 < value <= 1000.0):
        raise InputError(f"must be a percentage above 0, such as 5%, not {text!r}", "--error")
    return value


def read_seconds(text: str, where: str) -> float:
    """Return the seconds in ``60s``, ``5min`` or ``1h``. Raises ``InputError`` for anything else.

    >>> read_seconds("60s", "--budget"), read_seconds("1.5 min", "--budget")
    (60.0, 90.0)
    """
    match = re.fullmatch(_NUMBER + r"(s|min|h)\s*", text)
    value = float(match[1]) * _SECONDS[match[2]] if match else math.nan
    if not (math.isfinite(value) and 0.0 < value <= 1e6):
        raise InputError(f"must be a time above 0 with its unit, such as 60s, 5min or 1h, not {text!r}", where)
    return value


def _read_reference(name: str) -> Reference:
    from finqd.accuracy_reference import read_reference

    try:
        return read_reference(Path(name))
    except InputError as error:
        raise InputError(f"{error.message} ({name}); give auto, compute or a file", "--reference") from error


def _say_row(row: Row) -> None:
    if row["status"] != "ok":
        click.echo(f"finqd: {row['rung']}: {row['status']}: {row['reason']}", err=True)


def _print_table(study: Study) -> None:
    from finqd.accuracy import front
    from finqd.cli_tables import _console, _number, _table

    rows = study.table()
    best = {row["rung"] for row in front(rows)}
    quantity = study.case.quantities[study.case.main]
    table = _table(
        "", "knob", "rung", f"{quantity.label} [{quantity.unit}]>", "error [%]>", "change [%]>", "seconds>", "dofs>",
        "steps>", "Newton>",
    )
    for row in sorted(rows, key=lambda row: (list_index(row["knob"]), row["series"], row["seconds"])):
        value = row["values"].get(study.case.main)
        told = _number(value, 4) if row["status"] == "ok" else f"[red]{row['status']}[/red]"
        table.add_row(
            "*" if row["rung"] in best else "", row["knob"], row["rung"], told, _number(row["error_percent"], 3),
            _number(row["change_percent"], 3), _number(row["seconds"], 2), _number(row["dofs"], 0),
            _number(row["steps"], 0), _number(row["newton_iterations"], 0),
        )
    console = _console()
    console.print(table)
    console.print("* on the Pareto front; error against the reference, change against standard")
    if study.omitted:
        console.print(f"{len(study.omitted)} rungs were not run; the page says why", soft_wrap=True)


def list_index(knob: str) -> int:
    """Return where a knob stands in the table; the reference comes last."""
    from finqd.accuracy_ladder import KNOBS

    return list(KNOBS).index(knob) if knob in KNOBS else len(KNOBS)


def _print_answer(study: Study, question: str, row: Row | None) -> None:
    from finqd.accuracy_ladder import AS_GIVEN
    from finqd.presets import PRESETS

    if row is None:
        from finqd.accuracy import front

        nearest: Any = next(reversed(front(study.table())), None)
        least = ""
        if nearest is not None:
            cost = f"{nearest['resolved_percent']:.3g} % in {nearest['seconds']:.3g} s"
            least = f"; the most accurate is {nearest['rung']}: {cost}"
        hint = "" if study.full else " (--full has more)"
        click.echo(f"{question}: no rung of this ladder does{hint}{least}")
        return
    cost = f"{abs(row['error_percent']):.3g} % in {row['seconds']:.3g} s"
    own = any(rung.name == AS_GIVEN for rung in study.rungs) and row["rung"] in PRESETS
    hint = "    (without what the design itself says of mesher, stepper, contact and time step)\n" if own else ""
    click.echo(f"{question}: {row['rung']}, {cost}\n{hint}    {row['options']}")
