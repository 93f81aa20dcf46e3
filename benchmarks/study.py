"""The loop of a study that may be stopped at any time: find in its log what is missing, compute it, write a line each.

A study is a mapping from keys to tasks, and a function that computes the row of a task. Rows are lines of JSON
(`finqd.study_log`); each gets the commit that it was computed on.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from checkout import commit

from finqd.study_log import append_row, read_rows
from finqd.workers import TaskFailure, run_tasks

Key = TypeVar("Key", bound=Hashable)
Row = dict[str, Any]


def rows_that_hold(log: Path, digests: Mapping[Key, str], key: Callable[[Row], Key]) -> dict[Key, Row]:
    """Return the newest row of each key whose ``digest`` is what the key's is today: others are to be done again."""
    rows = {}
    for row in read_rows(log):
        name = key(row)
        if digests.get(name) == row["digest"]:
            rows[name] = row
    return rows


def compute_missing(
    tasks: Mapping[Key, Any], rows: dict[Key, Row], compute: Callable[[Any], Row], *, log: Path,
    words: Callable[[Row], str], jobs: int, minutes: float, time_limit_s: float | None = None,
    failed: Callable[[Key, TaskFailure], Row | None] | None = None,
) -> None:
    """Compute the rows of those ``tasks`` that ``rows`` lacks, in their order; add each to log and ``rows`` at once.

    compute: a function of a module, since processes run it; words: what is printed of a row; minutes: when no task
    starts any more; failed: the row of a task that raised, crashed or took too long (``time_limit_s``), by default
    none, so that it is tried again the next time.
    """
    source, left = commit(), [key for key in tasks if key not in rows]

    def on_result(position: int, row: Any) -> None:
        key = left[position]
        if isinstance(row, TaskFailure):
            print(f"{key}: {row.kind}: {row.reason}", flush=True)
            row = None if failed is None else failed(key, row)
        if row is not None:
            rows[key] = {**row, "commit": source}
            append_row(log, rows[key])
            print(words(row), flush=True)

    in_time = functools.partial(_in_time, compute, time.time() + 60.0 * minutes)
    run_tasks(in_time, [tasks[key] for key in left], jobs=jobs, on_result=on_result, time_limit_s=time_limit_s)


def _in_time(compute: Callable[[Any], Row], deadline: float, task: Any) -> Row | None:
    return compute(task) if time.time() <= deadline else None
