"""The command line: reads what was typed, calls one function, prints what it returns. No physics here.

Everything heavy is imported by the command that needs it, so that ``finqd --help`` answers at once. What is wrong with
the input is one sentence on stderr and exit code 2; a simulation that fails is a row of the table.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import click

from finqd import __version__
from finqd.cli_accuracy import accuracy
from finqd.cli_recheck import recheck
from finqd.cli_report import export, report
from finqd.cli_search import log, optimise
from finqd.cli_verify import verify
from finqd.contracts import KINDS
from finqd.errors import FinqdError, InputError

PRESETS = ("draft", "standard", "fine", "reference", "paper")


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run one command and exit: 0 done, 1 the machine is unfit (doctor), 2 bad input, 130 interrupted."""
    warnings.showwarning = _show_warning
    try:
        code = finqd.main(arguments, prog_name="finqd", standalone_mode=False)
    except click.ClickException as error:
        code = _refuse(_one_line(error.format_message()).rstrip(".") + _usage_hint(error))
    except FinqdError as error:
        code = _refuse(_one_line(str(error)))
    except OSError as error:  # a disk that is full, a folder that goes away
        place = f"{error.filename}: " if error.filename else ""
        code = _refuse(_one_line(f"{place}{error.strerror or error}"))
    except click.Abort:
        click.echo("finqd: interrupted", err=True)
        code = 130
    sys.exit(code if isinstance(code, int) else 0)


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="finqd")
def finqd() -> None:
    """Design, simulate and search soft grippers.

    A DESIGN is a JSON file, or the name of one that comes with finqd (see `finqd designs`).
    """


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_objects_option = click.option(
    "--objects", "object_names", multiple=True, metavar="A,B,...",
    help="Objects to grasp, by name or JSON file; may be repeated.  [default: all that come with finqd]",
)
_jobs_option = click.option(
    "--jobs", type=click.IntRange(1, 1024), default=_cores, show_default="one a core", help="Simulations side by side."
)
_preset_option = click.option(
    "--preset", type=click.Choice(PRESETS), default="standard", show_default=True,
    help="Accuracy: mesh size, time step and tolerances together.",
)
_set_option = click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE",
    help="Change one value of the design, by its path in the JSON (protocol.hold_s=10); may be repeated.",
)


@finqd.command()
@click.argument("design")
@_objects_option
@click.option("--object", "surfaces", multiple=True, metavar="FILE",
              help="A watertight surface of your own (STL, OBJ or PLY, in mm); may be repeated.")
@click.option("--mass-g", type=float, metavar="GRAMS", help="Mass of each --object, instead of a solid one's.")
@click.option("--out", type=click.Path(path_type=Path), help="Write the whole result to this JSON file.")
@_jobs_option
@_preset_option
@_set_option
@click.option("--record", type=click.Path(path_type=Path), metavar="DIR",
              help="Keep the trajectories there, readable by ParaView.")
@click.option("--checkpoints", type=click.Path(path_type=Path), metavar="DIR",
              help="Keep each simulation there as it goes on; one that was stopped goes on from there.")
@click.option("--estimate-error", is_flag=True,
              help="Simulate again with a coarser mesh and with longer steps, and say how far off the result is.")
@click.option("--profile", is_flag=True, help="Say where the time went, by kind of work.")
@click.option("--quiet", is_flag=True, help="Print nothing but what goes wrong.")
def evaluate(
    design: str, object_names: tuple[str, ...], surfaces: tuple[str, ...], mass_g: float | None, out: Path | None,
    jobs: int, preset: str, settings: tuple[str, ...], record: Path | None, checkpoints: Path | None,
    estimate_error: bool, profile: bool, quiet: bool,
) -> None:
    """Build a gripper, close it on every object in a simulation, and say which it holds."""
    from finqd.cli_files import usable_folder, written_at_end
    from finqd.cli_progress import shown_progress

    chosen = _read_design(design, settings, preset)
    objects = [*_split(object_names), *_read_surfaces(surfaces, mass_g)] or None
    with written_at_end(out, "--out") as write, shown_progress(quiet=quiet) as progress:
        folder, kept = usable_folder(record, "--record"), usable_folder(checkpoints, "--checkpoints")
        from finqd.evaluate import evaluate as run  # takes a second, so only when nothing is left to refuse

        result = run(
            chosen, objects=objects, preset=preset, jobs=jobs, record=folder, progress=progress,
            estimate_error=estimate_error, checkpoints=kept, profile=profile,
        )
        write(json.dumps(result.to_dict(), indent=2, allow_nan=False) + "\n")
    if not quiet:
        from finqd.cli_tables import print_evaluation  # not in the way of the first step

        print_evaluation(result.to_dict())


@finqd.command()
@click.argument("design")
@_objects_option
@click.option("--what-if", is_flag=True,
              help="Simulate again with each effect the other way round, and say what that changes.")
@click.option("--out", type=click.Path(path_type=Path), help="Write the tables to this JSON file.")
@_jobs_option
@_preset_option
@_set_option
def explain(
    design: str, object_names: tuple[str, ...], what_if: bool, out: Path | None, jobs: int, preset: str,
    settings: tuple[str, ...],
) -> None:
    """Say which effects the grasps of a gripper call for, since when, and why."""
    from finqd.cli_files import written_at_end
    from finqd.cli_progress import shown_progress
    from finqd.cli_tables import print_explanation

    chosen, objects = _read_design(design, settings, preset), _split(object_names) or None
    with written_at_end(out, "--out") as write, shown_progress() as progress:
        from finqd.explain import explain as run

        found = run(chosen, objects=objects, preset=preset, what_if=what_if, jobs=jobs, progress=progress)
        rows = {one.object_name: one.to_dict() for one in found}
        write(json.dumps(rows, indent=2, allow_nan=False) + "\n")
    for name, row in rows.items():
        print_explanation(name, row)


@finqd.command()
@click.option("--geometry", default="fin_ray", show_default=True, metavar="NAME", help="Finger type of the designs.")
def schema(geometry: str) -> None:
    """Print the JSON Schema of design files."""
    from finqd.design import Design

    click.echo(json.dumps(Design.json_schema(geometry), indent=2))


@finqd.command()
@click.option("--kind", type=click.Choice(KINDS), help="Only this kind.")
def plugins(kind: str | None) -> None:
    """List the plugins that are installed, with their options."""
    from finqd.cli_tables import print_plugins

    print_plugins(kind)


@finqd.command()
def presets() -> None:
    """List the presets: what each sets, and how far off it has been measured to be."""
    from finqd.cli_tables import print_presets

    print_presets()


@finqd.command()
def objects() -> None:
    """List the objects that come with finqd."""
    from finqd.cli_tables import print_objects

    print_objects()


@finqd.command()
def designs() -> None:
    """List the designs that come with finqd."""
    from finqd.cli_tables import print_designs

    print_designs()


@finqd.command()
@_preset_option
@click.option("--all", "everything", is_flag=True, help="Those of all other plugins that are installed, too.")
@click.option("--quiet", is_flag=True, help="Print nothing but what goes wrong.")
def warmup(preset: str, everything: bool, quiet: bool) -> None:
    """Compile the kernels that evaluations use, and keep them on disk.

    An evaluation does so too, the first time; afterwards, every process of this machine loads them.
    """
    from finqd.warmup import warm_up

    say = (lambda line: None) if quiet else click.echo
    done = warm_up(preset, everything=everything, report=say)
    compiled, loaded = sum(family.compiled for family in done), sum(family.loaded for family in done)
    seconds = sum(family.seconds for family in done)
    say(f"{compiled} kernels compiled, {loaded} loaded in {seconds:.1f} s; they are in {done[0].folder}")


@finqd.command()
def doctor() -> int:
    """Check this machine and say what is missing."""
    from finqd.cli_tables import print_findings
    from finqd.doctor import examine, fit

    findings = examine()
    print_findings(findings)
    return 0 if fit(findings) else 1


finqd.add_command(accuracy)
finqd.add_command(recheck)
finqd.add_command(export)
finqd.add_command(report)
finqd.add_command(optimise)
finqd.add_command(log)
finqd.add_command(verify)


def _read_design(text: str, settings: Sequence[str] = (), preset: str | None = None) -> Any:
    """Return the design that DESIGN and ``--set`` mean, and warn of values that a search would not try.

    With a ``preset``, which may choose plugins, ``--set`` changes the options of those.
    """
    from finqd.design import Design, parse_setting

    design, changes = Design.from_json(_find_design(text)), dict(map(parse_setting, settings))
    if changes and preset is not None:
        from finqd.presets import apply_preset

        design = apply_preset(design, preset, overrides=changes, source="--set:")
    elif changes:
        design = design.with_overrides(changes, source="--set:")
    for warning in design.warnings:
        click.echo(f"finqd: warning: {_one_line(warning)}", err=True)
    return design


def _find_design(text: str) -> Path:
    """Return the file that DESIGN means: a file of that name, else a design that comes with finqd."""
    from finqd.data import bundled_names, designs_folder

    path, known = Path(text), bundled_names(designs_folder())
    if not path.exists() and text in known:
        return designs_folder() / f"{text}.json"
    if not path.exists() and path.suffix != ".json":
        raise InputError(f"there is no such file; designs that come with finqd: {', '.join(known)}", text)
    return path


def _split(values: Sequence[str]) -> list[str]:
    """Return the names in ``--objects a,b --objects c``."""
    found = [name.strip() for value in values for name in value.split(",") if name.strip()]
    if values and not found:
        raise InputError("names no object", "--objects")
    return found


def _read_surfaces(surfaces: Sequence[str], mass_g: float | None) -> list[Any]:
    if mass_g is not None and not surfaces:
        raise InputError("goes with --object", "--mass-g")
    if not surfaces:
        return []
    from finqd.objects import load_object

    return [load_object(Path(surface), mass_g=mass_g) for surface in surfaces]


def _refuse(sentence: str) -> int:
    click.echo(f"finqd: {sentence}", err=True)
    return 2


def _usage_hint(error: click.ClickException) -> str:
    context = getattr(error, "ctx", None)
    return f" (see {context.command_path} --help)" if context else ""


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    click.echo(f"finqd: warning: {_one_line(str(message))}", err=True)
