"""``finqd optimise`` and ``finqd log``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from finqd.errors import InputError

PRESETS = ("draft", "standard", "fine", "reference", "paper")
WORKERS = ("inline", "processes", "dask")
ALGORITHMS = ("cma_me", "cma_mae", "map_elites", "sobol")
NUMBERS = ("algorithm", "iterations", "batch", "seed", "cells", "time_limit_s")  # options with a default
SEARCH = ("algorithm", "iterations", "batch", "seed", "cells", "time_limit_s")  # of RUN.toml, what has a default
_preset = click.Choice(PRESETS)


@click.command()
@click.argument("run", required=False, type=click.Path(path_type=Path), metavar="[RUN.toml]")
@click.option("--finger", metavar="NAME", help="Finger type: a geometry plugin.  [default: fin_ray]")
@click.option("--design", metavar="DESIGN", help="Where protocol, plugins and material are taken from.")
@click.option("--algorithm", type=click.Choice(ALGORITHMS), help="[default: cma_me]")
@click.option("--iterations", type=click.IntRange(1), help="Rounds of the search.  [default: 5]")
@click.option("--batch", type=click.IntRange(1), help="Designs a round.  [default: 15]")
@click.option("--cells", type=click.IntRange(1, 1000), help="Cells of the map along each feature.  [default: 10]")
@click.option("--seed", type=click.IntRange(0), help="Seed of the search.  [default: 0]")
@click.option("--objects", "object_names", multiple=True, metavar="A,B,...",
              help="Objects to grasp, by name or JSON file; may be repeated.  [default: all that come with finqd]")
@click.option("--preset", "--confirm", "preset", type=_preset,
              help="Accuracy of the results that count.  [default: standard]")
@click.option("--screen", type=_preset,
              help="Evaluate every design with this preset first, and with that above only what would enter the map.")
@click.option("--time-limit-s", type=click.FloatRange(0, min_open=True),
              help="Wall-clock time of one evaluation.  [default: 3600]")
@click.option("--workers", type=click.Choice(WORKERS),
              help="Where evaluations run: in this process, in processes of this machine, or on a dask cluster.  "
                   "[default: dask with --scheduler, else processes]")
@click.option("--scheduler", metavar="ADDRESS", help="Of a dask scheduler, as tcp://host:8786 (docs/cluster.md).")
@click.option("--jobs", type=click.IntRange(1, 1024), help="Designs side by side.  [default: one a core]")
@click.option("--recheck", type=click.IntRange(0, 1000), metavar="K",
              help="Evaluate the elites again under K other conditions in the end, as `finqd recheck` does.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR",
              help="Folder of the run; one that holds a run goes on with it.")
@click.option("--set", "changes", multiple=True, metavar="KEY=VALUE",
              help="Change one value of the designs by its path in the JSON (protocol.hold_s=10); may be repeated.")
@click.option("--other-versions", is_flag=True,
              help="Go on with a run that other versions of finqd or its libraries began.")
@click.option("--quiet", is_flag=True, help="Print nothing but what goes wrong.")
def optimise(run: Path | None, quiet: bool, other_versions: bool, **options: Any) -> None:
    """Search the design space for a map of different good grippers.

    What RUN.toml sets (see `finqd.run_file`), options override. Stopped, however that came, the same command goes on.
    """
    from finqd.cli_tables import print_search
    from finqd.run_file import RunFile, read_run_file

    given = {} if run is None else read_run_file(run)
    apart = ("object_names", "changes")
    given |= {key: value for key, value in options.items() if value is not None and key not in apart}
    search = {key: given.get(key, getattr(RunFile, key)) for key in SEARCH}
    if "out" not in given:
        raise InputError("missing; name the folder of the run, as in --out search", "--out")
    out, preset = Path(given["out"]), options["preset"] or given.get("confirm") or given.get("preset") or "standard"
    from finqd.cli import _cores, _split

    where: dict[str, Any] = {
        "kind": given.get("workers") or ("dask" if given.get("scheduler") else "processes"),
        "jobs": given.get("jobs") or _cores(), "scheduler": given.get("scheduler"),
    }  # fmt: skip
    base, objects = _base_design(given, options["changes"]), _split(options["object_names"]) or given.get("objects")
    with _shown(quiet=quiet) as report:
        from finqd.search import optimise as start
        from finqd.workers import open_workers

        with open_workers(**where) as workers:
            result = start(
                out=out, **search, objects=objects, workers=workers, preset=preset, screen=given.get("screen"),
                ranges=given.get("ranges"), base_design=base, other_versions=other_versions, report=report,
            )  # fmt: skip
    if not quiet:
        print_search(result)
    if given.get("recheck"):
        _recheck(
            out, given["recheck"], where, time_limit_s=search["time_limit_s"], other_versions=other_versions,
            quiet=quiet,
        )


def _recheck(out: Path, count: int, where: dict[str, Any], *, quiet: bool, **options: Any) -> None:
    from finqd.cli_progress import shown_progress
    from finqd.cli_recheck import print_trust
    from finqd.recheck import recheck

    with shown_progress(quiet=quiet) as progress:
        found = recheck(out, count=count, **where, **options, progress=progress)
    if not quiet:
        print_trust(found)


def _base_design(given: dict[str, Any], changes: tuple[str, ...]) -> Any:
    """Return a design with the settings that all designs of the search share; its own shape does not matter."""
    import numpy as np

    from finqd.cli import _read_design
    from finqd.design import Design, design_parameters, parse_setting

    overrides = {**(given.get("set") or {}), **dict(map(parse_setting, changes))}
    finger = given.get("finger")
    if given.get("design"):
        base = _read_design(given["design"])
        if finger is not None and finger not in (base.settings["geometry"], base.spec("geometry")["name"]):
            raise InputError("give a design or a finger type, not two that differ", "finger")
    elif finger is None and not overrides:
        return None
    else:
        base = _any_design(finger or "fin_ray", design_parameters, Design, np)
    return base.with_overrides(overrides, source="set:") if overrides else base


def _any_design(finger: Any, design_parameters: Any, design_type: Any, np: Any) -> Any:
    count = len(design_parameters(finger))
    random, sentence = np.random.default_rng(0), ""
    for unit in [np.full(count, 0.5), *random.random((256, count))]:
        try:
            return design_type.from_unit_vector(unit, geometry=finger)
        except InputError as error:
            sentence = str(error)
    raise InputError(f"none of 257 designs is valid ({sentence})", "finger")


def _shown(*, quiet: bool) -> Any:
    from finqd.cli_progress import shown_standing

    return shown_standing(quiet=quiet)


@click.group()
def log() -> None:
    """Read the log of a search."""


@log.command("export")
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--to", "path", type=click.Path(path_type=Path), required=True, metavar="FILE",
              help="A .csv or .parquet file.")
def export(run: Path, path: Path) -> None:
    """Write a table with a row for each design that the search in the folder RUN has evaluated."""
    from finqd.log_export import export_log
    from finqd.runlog import read_run

    count = export_log(read_run(run), path)
    click.echo(f"{count} evaluations written to {path}")
