"""How far a search is: numbers after each evaluation, a sentence of them, and a file of such sentences."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from finqd.run_folder import PROGRESS

if TYPE_CHECKING:
    from ribs.archives import GridArchive

LINE_EVERY_S = 2.0  # lines of the file; the end of an iteration has one in any case


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Where a search stands.

    evaluations, total: designs done, and to be done; coverage: share of cells filled; qd_score: sum of the objectives;
    best: fitness, None if there is none; failed: designs; seconds: computed so far, in all sessions; left_s: estimate,
    None as long as there is nothing to go by
    """

    iteration: int
    iterations: int
    evaluations: int
    total: int
    coverage: float = 0.0
    qd_score: float = 0.0
    best: float | None = None
    failed: int = 0
    seconds: float = 0.0
    left_s: float | None = None

    def sentence(self) -> str:
        """Return all that in a line."""
        best = "-" if self.best is None else f"{self.best:.3f}"
        left = "" if self.left_s is None else f", about {_duration(self.left_s)} left"
        return (
            f"iteration {self.iteration + 1} of {self.iterations}, {self.evaluations} of {self.total} designs, "
            f"coverage {100 * self.coverage:.1f} %, QD score {self.qd_score:.3f}, best fitness {best}, "
            f"{self.failed} failed, {_duration(self.seconds)}{left}"
        )


class Reporter:
    """Keeps the standing of a search, writes it to the run's ``progress.log`` and tells who wants to know."""

    def __init__(self, folder: Path, *, standing: Standing, report: Callable[[Standing], None] | None) -> None:
        self.standing, self._report, self._path = standing, report, folder / PROGRESS
        self._begun, self._before, self._computed = time.perf_counter(), standing.seconds, 0
        self._last_line = -LINE_EVERY_S
        self._writable = True

    @property
    def seconds(self) -> float:
        """Seconds of computing since the run's first start, pauses between sessions left out."""
        return self._before + time.perf_counter() - self._begun

    def count(self, record: dict) -> None:
        """Take in the final record of one design; ``computed`` tells those of this session."""
        one, self._computed = self.standing, self._computed + 1
        fitness = record["fitness"] if record["status"] == "ok" else None
        best = one.best if fitness is None else max(fitness, -1.0 if one.best is None else one.best)
        left = (self.seconds - self._before) / self._computed * (one.total - one.evaluations - 1)
        self.standing = replace(
            one, evaluations=one.evaluations + 1, best=best, failed=one.failed + (record["status"] != "ok"),
            seconds=self.seconds, left_s=left,
        )  # fmt: skip
        self._tell(always=False)

    def recall(self, record: dict) -> None:
        """Take in a record of an earlier session."""
        one, fitness = self.standing, record["fitness"] if record["status"] == "ok" else None
        best = one.best if fitness is None else max(fitness, -1.0 if one.best is None else one.best)
        failed = one.failed + (record["status"] != "ok")
        self.standing = replace(one, evaluations=one.evaluations + 1, best=best, failed=failed)

    def end_iteration(self, iteration: int, archive: GridArchive, *, quiet: bool) -> None:
        """Take in the map after an iteration; ``quiet``: of an earlier session."""
        stats = archive.stats
        score = 0.0 if archive.empty else float(stats.qd_score)
        self.standing = replace(
            self.standing, iteration=iteration, coverage=float(stats.coverage), qd_score=score
        )
        if not quiet:
            self._tell(always=True)

    def begin_iteration(self, iteration: int) -> None:
        """Note which iteration is under way."""
        self.standing = replace(self.standing, iteration=iteration)

    def _tell(self, *, always: bool) -> None:
        if self._report is not None:
            self._report(self.standing)
        now = time.perf_counter()
        if self._writable and (always or now - self._last_line >= LINE_EVERY_S):
            self._last_line = now
            try:
                with self._path.open("a", encoding="utf-8") as file:
                    file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {self.standing.sentence()}\n")
            except OSError as error:  # a full disk: the log says so where it matters
                self._writable = False
                warnings.warn(f"{self._path}: not written any more ({error.strerror or error})", stacklevel=2)


def _duration(seconds: float) -> str:
    """Return a duration in words.

    >>> _duration(9.4), _duration(600), _duration(36000)
    ('9 s', '10 min', '10.0 h')
    """
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
