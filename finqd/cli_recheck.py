"""``finqd recheck``: are the elites of a search to be trusted?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from finqd.errors import InputError

if TYPE_CHECKING:
    from finqd.trust import Share, Trust

RESULT = "recheck.json"


def worker_options(command: Any) -> Any:
    """Add the options that say where evaluations run: ``kind``, ``jobs``, ``scheduler`` and ``time_limit_s``."""
    for option in (
        click.option("--time-limit-s", type=click.FloatRange(0, min_open=True), default=3600.0, show_default=True,
                     help="Wall-clock time of one evaluation, after which it is stopped."),
        click.option("--scheduler", metavar="ADDRESS", help="Of a dask scheduler, as tcp://host:8786: evaluations run "
                     "on its workers."),
        click.option("--jobs", type=click.IntRange(1, 1024), help="Evaluations side by side.  [default: one a core]"),
        click.option("--workers", "kind", type=click.Choice(("inline", "processes", "dask")),
                     help="Where evaluations run: one after the other in this process, in processes of this machine, "
                     "or on a dask cluster.  [default: dask with --scheduler, else processes]"),
    ):
        command = option(command)
    return command


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("-k", "--times", "count", type=click.IntRange(1), default=8, show_default=True, metavar="K",
              help="Evaluations of each elite; a power of two spreads them best.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the perturbations.")
@click.option("--vary", multiple=True, metavar="NAME=LOW:HIGH|NAME=off",
              help="Another range of one quantity, or leave it as it is; may be repeated.")
@worker_options
@click.option("--other-versions", is_flag=True, help="Go on though finqd or its libraries were others in the search.")
@click.option("--quiet", is_flag=True, help="Print nothing but what goes wrong.")
def recheck(
    run: Path, count: int, seed: int, vary: tuple[str, ...], kind: str | None, jobs: int | None,
    scheduler: str | None, time_limit_s: float, other_versions: bool, quiet: bool,
) -> None:
    """Evaluate the elites of a search again, under other conditions, and say how far its map is to be trusted.

    RUN is the folder of a search. Friction, the object's place and turn, stiffness, time step and mesh size vary; what
    comes of it is written into the run's log, and RUN/recheck.json. Stopped, the same command goes on.
    """
    from finqd.cli_progress import shown_progress
    from finqd.perturbations import Scheme

    scheme = Scheme(seed=seed, ranges=dict(map(read_range, vary)))
    with shown_progress(quiet=quiet) as progress:
        from finqd.recheck import recheck as start  # takes a second, so only when nothing is left to refuse

        found = start(
            run, count=count, scheme=scheme, kind=kind or ("dask" if scheduler else "processes"), jobs=jobs,
            scheduler=scheduler, time_limit_s=time_limit_s, progress=progress, other_versions=other_versions,
        )
    if not quiet:
        print_trust(found)


def read_range(text: str) -> tuple[str, tuple[float, float] | None]:
    """Return name and range of ``--vary``.

    >>> read_range("friction=0.9:1.1"), read_range("turn_deg=off")
    (('friction', (0.9, 1.1)), ('turn_deg', None))
    """
    name, _, value = text.partition("=")
    if value.strip() == "off":
        return name.strip(), None
    try:
        low, high = map(float, value.split(":"))
    except ValueError:
        raise InputError(f"must be NAME=LOW:HIGH or NAME=off, as in friction=0.9:1.1, not {text!r}", "--vary") from None
    return name.strip(), (low, high)


def print_trust(found: Trust) -> None:
    """Print what rechecks say: elites, objects, and the map as a whole."""
    from finqd.cli_tables import _console, _number, _table

    console = _console()
    table = _table("cell", "evaluation>", "fitness>", "rechecked>", "95 %>", "keeps>", "flips>", "failed>")
    for one in sorted(found.elites, key=lambda one: -(one.corrected or 0.0)):
        table.add_row(
            str(one.cell), str(one.index), _number(one.raw_fitness, 3), _number(one.success.rate, 3),
            _ends(one.success), f"{one.keeps.part} of {one.keeps.whole}", _number(one.flips.rate, 3), str(one.failed),
        )
    console.print(table)
    table = _table("object", "held>", "95 %>", "flips>", "95 %>")
    for thing in found.objects:
        table.add_row(thing.name, _number(thing.held.rate, 3), _ends(thing.held), _number(thing.flips.rate, 3),
                      _ends(thing.flips))
    console.print(table)
    for key, words, digits in (("qd_score", "QD score", 3), ("coverage", "coverage", 4)):
        raw, corrected = (_number(scores[key], digits) for scores in (found.raw, found.corrected))
        console.print(f"{words}: {raw} as searched, {corrected} corrected")
    if not found.complete:
        console.print("not all rechecks are there; the scores are those of elites that have some")


def _ends(share: Share) -> str:
    low, high = share.interval
    return f"{low:.2f}-{high:.2f}"
