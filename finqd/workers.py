"""Where evaluations run: here, in processes of this machine, or on the workers of a dask cluster.

`Workers` is the contract, `open_workers` the door; whoever has a `Workers` does not know where it runs. It promises:

- results come in the order of the tasks, and do not depend on where or how many side by side they were computed:
  wherever a call runs, it has one BLAS thread (a worker one Numba thread too);
- a task that raises, crashes its process or takes too long is a `TaskFailure` in the list, never an exception here;
- a crash costs one evaluation: it is tried again, once, and then recorded;
- whoever leaves, by Ctrl-C, by ``kill -9`` or by an exception, leaves no process behind, workers of workers included.

>>> with open_workers("inline") as workers:
...     workers.run(abs, [-1, 2, -3])
[1, 2, 3]
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Protocol

from finqd.errors import InputError, WorkersError
from finqd.workers_processes import Processes
from finqd.workers_task import (
    BLAS_THREADS,
    WORKER_THREADS,
    Board,
    OnProgress,
    OnResult,
    OnRetry,
    TaskFailure,
    call,
    check_limits,
    late,
    one_blas_thread,
)

__all__ = [
    "BLAS_THREADS", "KINDS", "WORKER_THREADS", "TaskFailure", "Workers", "WorkersError", "cores", "open_workers",
    "run_tasks",
]

KINDS = ("inline", "processes", "dask")


class Workers(Protocol):
    """What runs the evaluations of a search."""

    def run(
        self, function: Callable[..., Any], tasks: Sequence[Any], *, time_limit_s: float | None = None,
        retries: int = 1, on_result: OnResult | None = None, on_progress: OnProgress | None = None,
        on_retry: OnRetry | None = None,
    ) -> list[Any]:
        """Return ``[function(task) for task in tasks]``, with a `TaskFailure` where that did not work.

        time_limit_s: wall-clock seconds of one attempt, after which its process is killed
        retries: how often a task is tried again whose process died; one that raised or took too long is not
        on_result: called here as ``on_result(index, result)`` as soon as a result is there, in the order of coming
        on_progress: called here as ``on_progress(index, fraction)``, ``fraction`` in [0, 1]
        on_retry: called here as ``on_retry(index, failure)`` when a task is going to be tried again

        If ``function`` has a parameter ``progress``, it gets a callable there, ``progress(fraction)``. Function, tasks
        and results must be picklable unless all runs here. Raises InputError for options out of range, and
        `WorkersError` if the workers are gone or unfit: what ``on_result`` was told stays true.
        """

    def close(self) -> None:
        """End what was started; tasks that run are given up."""


@contextmanager
def open_workers(
    kind: str = "processes", *, jobs: int | None = None, scheduler: str | None = None
) -> Iterator[Workers]:
    """Yield the workers of a kind, and close them.

    kind: "inline" (in this process, one after the other; a time limit interrupts Python code only, not a compiled
        function that hangs), "processes", or "dask"
    jobs: how many tasks run side by side; None: one a core. A dask scheduler has as many as its workers have threads
    scheduler: address of a dask scheduler, ``tcp://host:8786``; with None, "dask" is a cluster inside this process

    A script must guard its main part with ``if __name__ == "__main__":``, because every worker process imports it.
    Raises InputError for an option out of range, MissingLibraryError if dask is not installed, `WorkersError` if the
    scheduler does not answer.
    """
    if kind not in KINDS:
        raise InputError(f"must be one of {', '.join(KINDS)}, not {kind!r}", where="workers")
    if scheduler is not None and kind != "dask":
        raise InputError(f"goes with the workers dask, not with {kind}", where="scheduler")
    workers: Workers
    if kind == "inline":
        workers = Inline()
    elif kind == "processes":
        workers = Processes(cores() if jobs is None else jobs)
    else:
        from finqd.workers_dask import open_dask  # an extra

        workers = open_dask(scheduler, jobs=cores() if jobs is None else jobs)
    try:
        yield workers
    finally:
        workers.close()


def run_tasks(
    function: Callable[..., Any], tasks: Sequence[Any], *, jobs: int = 1, time_limit_s: float | None = None,
    on_result: OnResult | None = None, on_progress: OnProgress | None = None,
) -> list[Any]:
    """Return the results of tasks that are computed once, see `Workers.run`; crashes are not tried again.

    jobs: how many processes work at the same time; with 1 and no time limit the calls run in this process
    Raises InputError if ``jobs`` or ``time_limit_s`` is out of range.
    """
    options: dict[str, Any] = {"retries": 0, "on_result": on_result, "on_progress": on_progress}
    with Processes(jobs) as workers:
        if jobs == 1 and time_limit_s is None:
            return Inline().run(function, tasks, **options)
        return workers.run(function, tasks, time_limit_s=time_limit_s, **options)


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Inline:
    """This process, one task after the other: for debuggers and profilers."""

    def run(
        self, function: Callable[..., Any], tasks: Sequence[Any], *, time_limit_s: float | None = None,
        retries: int = 1, on_result: OnResult | None = None, on_progress: OnProgress | None = None,
        on_retry: OnRetry | None = None,
    ) -> list[Any]:
        """Return the result of each task, see `Workers`. A task that crashes takes this process along."""
        check_limits(time_limit_s=time_limit_s, retries=retries)
        board = Board.of(tasks, retries=retries, on_result=on_result, on_progress=on_progress, on_retry=on_retry)
        with one_blas_thread():
            for index, task in enumerate(tasks):
                try:
                    with _alarm(time_limit_s):
                        result = call(function, task, partial(board.move, index))
                except _TimeUp:
                    if time_limit_s is None:
                        raise  # the limit of the task that this one is part of
                    result = late(time_limit_s)
                board.put(index, result)
        return board.results

    def close(self) -> None:
        """Nothing was started."""


class _TimeUp(KeyboardInterrupt):
    """The time limit is over. What lets Ctrl-C through, a task inside the task too, lets this through."""


@contextmanager
def _alarm(seconds: float | None) -> Iterator[None]:
    """Raise `_TimeUp` here after so many seconds, where the system has a timer for that."""
    if seconds is None or not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def ring(number: int, frame: Any) -> None:
        raise _TimeUp

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
