"""Progress on stderr while simulations run: one bar an object on a terminal, one line an object elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from finqd.search_progress import Standing

Progress = Callable[[str, float], None]


@contextmanager
def shown_progress(*, quiet: bool = False) -> Iterator[Progress]:
    """Return a function of (name, fraction from 0 to 1) that shows how far each of the named things is."""
    if quiet:
        yield lambda name, fraction: None
    elif sys.stderr.isatty():
        with _bars() as progress:
            yield progress
    else:
        yield _lines()


@contextmanager
def _bars() -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import BarColumn, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    tasks: dict[str, TaskID] = {}
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:

        def show(name: str, fraction: float) -> None:
            if name not in tasks:
                tasks[name] = bars.add_task(name, total=1.0)
            bars.update(tasks[name], completed=min(max(fraction, 0.0), 1.0))

        yield show


def _lines() -> Progress:
    done: set[str] = set()

    def show(name: str, fraction: float) -> None:
        if fraction >= 1.0 and name not in done:
            done.add(name)
            click.echo(f"{name}: done", err=True)

    return show


@contextmanager
def shown_standing(*, quiet: bool = False) -> Iterator[Callable[[Standing], None]]:
    """Return a function that shows where a search stands: a line that changes on a terminal, lines elsewhere."""
    if quiet:
        yield lambda standing: None
        return
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.live import Live

        with Live(console=Console(stderr=True), transient=True, refresh_per_second=4) as live:
            yield lambda standing: live.update(standing.sentence())
        return
    shown: tuple[float, ...] = ()

    def show(standing: Standing) -> None:
        nonlocal shown
        news = (standing.evaluations, standing.coverage, standing.qd_score)  # the map's only at an iteration's end
        if news != shown:
            shown = news
            click.echo(standing.sentence(), err=True)

    yield show
