"""Workers of a dask cluster, through ``dask.distributed``; docs/cluster.md says how to start one.

A thread of a dask worker does not evaluate, it keeps a process of its own that does (`finqd.workers_processes`): so a
time limit holds there too, a crash costs one evaluation and not the dask worker, and an evaluation that nobody waits
for any more (the driver was interrupted, killed or cut off) ends within a second or two. A dask worker that is lost
with its machine costs nothing but time: the scheduler gives what ran there to another one, up to its own
``distributed.scheduler.allowed-failures``.
"""

from __future__ import annotations

import gc
import logging
import multiprocessing
import pickle
import queue
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from finqd.errors import InputError, MissingLibraryError, WorkersError
from finqd.provenance import versions
from finqd.workers_processes import TICK_S, Processes
from finqd.workers_task import (
    Board,
    OnProgress,
    OnResult,
    OnRetry,
    TaskFailure,
    call,
    check_limits,
    packed,
    unpacked,
)

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_S = 10.0  # a scheduler answers in this time, or it is not there
PATIENCE_S = 600.0  # how long evaluations wait while there is not one worker: a queue of batch jobs takes its time
GONE = ("closing", "closed", "stopping", "stopped", "failed")  # states of a dask worker; one that is paused goes on
PROGRESS_S = 0.5  # an evaluation reports not more often: its messages go through the scheduler


def open_dask(scheduler: str | None, *, jobs: int, patience_s: float = PATIENCE_S) -> Dask:
    """Return the workers of the scheduler at an address, or ``jobs`` workers of a cluster inside this process.

    patience_s: how long [s] to wait while the scheduler has no worker
    Raises MissingLibraryError without dask, InputError for an address that is none, `WorkersError` if nobody answers.
    """
    try:
        import distributed
    except ImportError as error:
        raise MissingLibraryError("the workers dask need dask: pip install 'finqd[dask]'") from error
    for name in ("distributed", "distributed.client", "distributed.core", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # they print tracebacks of what is one sentence here
    if scheduler is None:
        with _no_garbage():
            cluster = distributed.LocalCluster(  # as threads: the evaluations are processes anyway
                n_workers=jobs, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0", memory_limit=0,
            )
            client = distributed.Client(cluster, set_as_default=False)
        return Dask(client, where="the embedded cluster", cluster=cluster, patience_s=patience_s)
    try:
        with _no_garbage():
            client = distributed.Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise WorkersError(
            f"no dask scheduler answers at {scheduler}; one is started with: dask scheduler (see docs/cluster.md)"
        ) from error
    except (ValueError, TypeError) as error:
        raise InputError(f"must be an address as tcp://host:8786, not {scheduler!r}", where="scheduler") from error
    return Dask(client, where=scheduler, patience_s=patience_s)


@contextmanager
def _no_garbage() -> Iterator[None]:
    """Keep the collector from running: clients and clusters start and end in this.

    A client that never connected is closed when it is collected as garbage; if that happens while another one starts or
    ends, in this thread, the first waits for a lock that the second holds, for ever. So garbage is collected before.
    """
    collects = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


class Abandoned(Exception):
    """An evaluation was given up, and is no failure."""


class Dask:
    """The workers of one dask scheduler; see `finqd.workers.Workers`."""

    def __init__(self, client: Client, *, where: str, cluster: Any = None, patience_s: float = PATIENCE_S) -> None:
        self._client = client
        self._cluster = cluster
        self._patience_s = patience_s
        self._where = where

    def run(
        self, function: Callable[..., Any], tasks: Sequence[Any], *, time_limit_s: float | None = None,
        retries: int = 1, on_result: OnResult | None = None, on_progress: OnProgress | None = None,
        on_retry: OnRetry | None = None,
    ) -> list[Any]:
        """Return the result of each task, see `finqd.workers.Workers`."""
        import cloudpickle  # a script's own functions travel by value: the workers do not have the script

        check_limits(time_limit_s=time_limit_s, retries=retries)
        board = Board.of(tasks, retries=retries, on_result=on_result, on_progress=on_progress, on_retry=on_retry)
        events: queue.SimpleQueue[tuple[str, int, Any]] = queue.SimpleQueue()
        topic = f"finqd-{uuid.uuid4().hex}"
        self._client.subscribe_topic(topic, lambda event: events.put(("progress", *event[1])))
        futures: dict[int, Future] = {}

        def submit(index: int) -> None:
            futures[index] = self._client.submit(
                _entry(), cloudpickle.dumps((function, tasks[index])), index, topic, dict(versions()),
                {"time_limit_s": time_limit_s, "retries": retries}, key=f"{topic}-{uuid.uuid4().hex}", pure=False,
            )
            futures[index].add_done_callback(partial(_note, events, index))

        try:
            for index in range(len(tasks)):
                submit(index)
            self._collect(board, futures, events, submit)
        finally:
            with suppress(Exception):  # of a client that has lost its scheduler
                self._client.cancel(list(futures.values()), force=True)
                self._client.unsubscribe_topic(topic)
        return board.results

    def _collect(
        self, board: Board, futures: dict[int, Future], events: queue.SimpleQueue, submit: Callable[[int], None]
    ) -> None:
        """Put the results on the board as they come; submit again what a dask worker that closes has given up."""
        alone_since = time.monotonic()
        while futures:
            try:
                kind, index, value = events.get(timeout=TICK_S)
            except queue.Empty:
                alone_since = self._look_around(alone_since)
                continue
            if kind == "progress" and index in futures:
                board.move(index, value)
            elif kind == "done":
                future = futures.pop(index)
                if future.status == "error" and isinstance(future.exception(), Abandoned):
                    submit(index)
                else:
                    self._take(board, index, future)
            alone_since = time.monotonic()

    def _look_around(self, alone_since: float) -> float:
        """Return since when there has been no worker; raise if the scheduler is gone, or it has been too long."""
        if self._client.status != "running":
            raise self._gone()
        if self._client.scheduler_info(n_workers=-1)["workers"]:
            return time.monotonic()
        if time.monotonic() - alone_since > self._patience_s:
            raise WorkersError(
                f"the dask scheduler at {self._where} has had no worker for {self._patience_s:g} s; "
                f"one is started with: dask worker {self._where}"
            )
        return alone_since

    def _take(self, board: Board, index: int, future: Future) -> None:
        from distributed import CancelledError, KilledWorker

        if future.status == "cancelled":
            raise self._gone()
        error = future.exception() if future.status == "error" else None
        if isinstance(error, KilledWorker):
            board.attempts[index] = error.allowed_failures + 1
            board.put(index, TaskFailure(kind="crash", reason="each dask worker that it was given to died"))
            return
        if isinstance(error, CancelledError):
            raise self._gone()
        if error is not None:  # of dask or of finqd there, never of the evaluation
            said = " ".join(str(error.__cause__ or error).split())
            raise WorkersError(f"a worker of {self._where} cannot run finqd ({said})")
        kind, value, crashes = future.result()
        if kind == "unlike":
            raise WorkersError(f"the dask worker {value}; install the same one everywhere")
        for crash in crashes:
            board.retried(index, crash)
        board.put(index, unpacked(value) if kind == "done" else value)

    def _gone(self) -> WorkersError:
        return WorkersError(f"the dask scheduler at {self._where} is gone")

    def close(self) -> None:
        """Leave the scheduler; end the embedded cluster."""
        with _no_garbage():
            with suppress(Exception):  # it may be gone already
                self._client.close(timeout=CONNECT_S)
            if self._cluster is not None:
                self._cluster.close(timeout=CONNECT_S)
        _close_idle()


def _note(events: queue.SimpleQueue, index: int, future: Future) -> None:
    events.put(("done", index, None))


# on a dask worker -----------------------------------------------------------------------------------------------------

_idle: queue.SimpleQueue[Processes] = queue.SimpleQueue()  # each with one process, for the next evaluation here


def _entry() -> Callable[..., Any]:
    """Return `_evaluate` as something that travels by value: a worker without finqd says so, instead of dying of it."""

    def evaluate(*arguments: Any) -> Any:
        try:
            from finqd.workers_dask import _evaluate
        except ImportError as error:
            return "unlike", f"on {__import__('socket').gethostname()} has no such finqd ({error})", []
        return _evaluate(*arguments)

    return evaluate


def _evaluate(
    payload: bytes, index: int, topic: str, expected: Mapping[str, str], limits: Mapping[str, Any]
) -> tuple[str, Any, list[TaskFailure]]:
    """Evaluate in a process of this thread's own.

    Return a kind, what goes with it, and the crashes before: "done" and the packed result, "failed" and a
    `TaskFailure`, or "unlike" and a sentence about versions.
    """
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()
    if multiprocessing.current_process().daemon:  # under a nanny; a daemon may not have children of its own
        multiprocessing.current_process().daemon = False
    told = 0.0

    def report(_: int, fraction: float) -> None:
        nonlocal told
        if fraction == 1.0 or time.monotonic() - told > PROGRESS_S:
            told = time.monotonic()
            worker.log_event(topic, (index, fraction))

    crashes: list[TaskFailure] = []
    own = _one_idle() or Processes(1)
    try:
        (result,) = own.run(
            _call_received, [_Sent(payload, expected)], **limits, on_progress=report,
            on_retry=lambda _, crash: crashes.append(crash), on_tick=partial(_still_wanted, worker, key),
        )
    finally:
        _idle.put(own)
    if isinstance(result, TaskFailure):
        return "failed", result, crashes
    kind, value = result
    return kind, f"at {worker.address} has {value}" if kind == "unlike" else value, crashes


def _still_wanted(worker: Any, key: Any) -> None:
    """Raise if nobody waits for the task: its driver has left, or another worker has taken it over."""
    task = worker.state.tasks.get(key)
    if worker.status.name in GONE or task is None or task.state in ("cancelled", "released", "forgotten"):
        raise Abandoned("nobody waits for this evaluation any more, or the dask worker closes")


class _Sent:
    """What the driver sent: bytes on the dask worker, a function and a task (`_received`) in the evaluation's process.

    So the imports that this takes come before the task begins, and its time limit with it.
    """

    def __init__(self, payload: bytes, expected: Mapping[str, str]) -> None:
        self.content = payload, expected

    def __reduce__(self) -> tuple[Any, ...]:
        return _received, self.content


def _received(payload: bytes, expected: Mapping[str, str]) -> tuple[Any, Any]:
    return pickle.loads(payload) if versions() == expected else (None, unlike(versions(), expected))


def _call_received(received: tuple[Any, Any], *, progress: Callable[[float], None]) -> tuple[str, Any]:
    """Call a function that was sent; the dask worker passes the packed result on without a look."""
    function, task = received
    return ("unlike", task) if function is None else ("done", packed(call(function, task, progress)))


def unlike(there: Mapping[str, str], here: Mapping[str, str]) -> str:
    """Return in words in which versions two places differ.

    >>> unlike({"finqd": "0.1", "numpy": "2.4"}, {"finqd": "0.1", "numpy": "2.3", "mkl": "2026"})
    'mkl none (here 2026), numpy 2.4 (here 2.3)'
    """
    names = sorted(name for name in {*there, *here} if there.get(name) != here.get(name))
    return ", ".join(f"{name} {there.get(name, 'none')} (here {here.get(name, 'none')})" for name in names)


def _close_idle() -> None:
    """End the processes that wait in this process (of an embedded cluster, after it was closed)."""
    while own := _one_idle():
        own.close()


def _one_idle() -> Processes | None:
    try:
        return _idle.get_nowait()
    except queue.Empty:
        return None
