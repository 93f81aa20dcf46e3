"""Where evaluations run: here, or in worker processes that can be killed.

`run_tasks` calls one function on many tasks and returns the results in the order of the tasks. What it promises:

- the results do not depend on ``jobs``: wherever a call runs, it has one BLAS thread (a worker one Numba thread too);
- a task that raises, crashes its process or takes too long is a `TaskFailure` in the list, never an exception here;
- whoever leaves, by Ctrl-C, by ``kill -9`` or by an exception, leaves no process behind, workers of workers included.

Each worker has a pipe of its own, and the parent is one loop over those pipes. Nothing is shared between workers, so
one may be killed at any instant without harm to the others. Pools with one shared queue lose that, pebble's among them:
measured with workers that die as soon as they start a task, it gave up the whole pool and the healthy tasks with it.
"""

from __future__ import annotations

import inspect
import multiprocessing
import os
import pickle
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import connection, resource_tracker
from typing import Any

from finqd.errors import InputError

#: read by the numerical libraries when they are first imported, so they must stand before a worker does that
BLAS_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
WORKER_THREADS = (*BLAS_THREADS, "NUMBA_NUM_THREADS")
START_ALLOWANCE_S = 60.0  # a time limit begins when the task does; starting the interpreter may take this long
PROGRESS_STEP = 0.005  # smaller steps of a task's progress are not worth a message


@dataclass(frozen=True, kw_only=True)
class TaskFailure:
    """What stands in the place of a result that is not there.

    ``kind``: "error" (the function raised), "crash" (its process died) or "timeout"; ``reason``: one sentence;
    ``details``: the traceback, if there is one; ``exception``: what was raised, if it can travel between processes.
    """

    kind: str
    reason: str
    details: str = ""
    exception: BaseException | None = field(default=None, compare=False)


def run_tasks(
    function: Callable[..., Any],
    tasks: Sequence[Any],
    *,
    jobs: int = 1,
    time_limit_s: float | None = None,
    on_result: Callable[[int, Any], None] | None = None,
    on_progress: Callable[[int, float], None] | None = None,
) -> list[Any]:
    """Return ``[function(task) for task in tasks]``, with a `TaskFailure` where that did not work.

    jobs: how many processes work at the same time; with 1 and no time limit the calls run in this process
    time_limit_s: wall-clock seconds of one task, after which its process is killed
    on_result: called here as ``on_result(index, result)`` as soon as a result is there, in the order in which they come
    on_progress: called here as ``on_progress(index, fraction)``, ``fraction`` in [0, 1]

    If ``function`` has a parameter ``progress``, it gets a callable there, ``progress(fraction)``. With processes,
    ``function``, tasks and results must be picklable, and a script must guard its main part with
    ``if __name__ == "__main__":``, because every worker imports it.
    Raises InputError if ``jobs`` or ``time_limit_s`` is out of range.
    """
    if isinstance(jobs, bool) or not isinstance(jobs, int) or jobs < 1:
        raise InputError(f"must be a whole number from 1 upwards, got {jobs!r}", where="jobs")
    if time_limit_s is not None and not time_limit_s > 0:
        raise InputError(f"must be a positive number of seconds, got {time_limit_s!r}", where="time_limit_s")
    board = _Board(results=[None] * len(tasks), on_result=on_result, on_progress=on_progress)
    if jobs == 1 and time_limit_s is None:
        _run_here(function, tasks, board)
    else:
        _run_in_workers(function, tasks, board, jobs=min(jobs, len(tasks)), time_limit_s=time_limit_s)
    return board.results


@dataclass(frozen=True)
class _Board:
    """The results so far, and who wants to hear of them."""

    results: list[Any]
    on_result: Callable[[int, Any], None] | None
    on_progress: Callable[[int, float], None] | None

    def put(self, index: int, result: Any) -> None:
        self.results[index] = result
        if self.on_result is not None:
            self.on_result(index, result)

    def move(self, index: int, fraction: float) -> None:
        if self.on_progress is not None:
            self.on_progress(index, fraction)


# in this process ------------------------------------------------------------------------------------------------------


def _run_here(function: Callable[..., Any], tasks: Sequence[Any], board: _Board) -> None:
    for index, task in enumerate(tasks):
        with _one_blas_thread():
            result = _call(function, task, partial(board.move, index))
        board.put(index, result)


def _call(function: Callable[..., Any], task: Any, report: Callable[[float], None]) -> Any:
    """Return ``function(task)``, or the `TaskFailure` that an exception became. Ctrl-C passes through."""
    try:
        if _takes_progress(function):
            return function(task, progress=_thinned(report))
        return function(task)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit too: a task must not end the program that asked for it
        return _failure(error)


def _takes_progress(function: Callable[..., Any]) -> bool:
    try:
        return "progress" in inspect.signature(function).parameters
    except ValueError:  # some built-in functions have no signature
        return False


def _failure(error: BaseException) -> TaskFailure:
    text = " ".join(str(error).split())
    return TaskFailure(
        kind="error",
        reason=f"{type(error).__name__}: {text}" if text else type(error).__name__,
        details=traceback.format_exc(),
        exception=error,
    )


def _thinned(report: Callable[[float], None]) -> Callable[[float], None]:
    """Return ``report`` without the calls that would change next to nothing."""
    last = -1.0

    def progress(fraction: float) -> None:
        nonlocal last
        fraction = min(max(float(fraction), 0.0), 1.0)
        if fraction - last >= PROGRESS_STEP or (fraction == 1.0 and last < 1.0):
            last = fraction
            report(fraction)

    return progress


@contextmanager
def _environment(names: Sequence[str]) -> Iterator[None]:
    """Set each of these variables to "1" for a while."""
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """Limit the BLAS libraries that are loaded, and those that load inside: sums in threads depend on their number."""
    from threadpoolctl import threadpool_limits

    with _environment(BLAS_THREADS), threadpool_limits(limits=1, user_api="blas"):
        yield


# in worker processes --------------------------------------------------------------------------------------------------


class _Worker:
    """One process, the parent's end of its pipe, and the task it is busy with (None: idle)."""

    def __init__(self) -> None:
        spawn = multiprocessing.get_context("spawn")  # a fork would copy threads' locks, gmsh and BLAS state
        self.pipe, theirs = spawn.Pipe()
        self.process = spawn.Process(target=_work, args=(theirs,), name="finqd-worker")
        self.process.daemon = False  # daemons may not have children, and evaluations mesh in one
        with _environment(WORKER_THREADS):
            self.process.start()
        theirs.close()
        self.index: int | None = None
        self.deadline = float("inf")

    def assign(self, index: int, payload: bytes, time_limit_s: float | None) -> None:
        self.index = index
        self.deadline = float("inf") if time_limit_s is None else time.monotonic() + START_ALLOWANCE_S + time_limit_s
        with suppress(OSError):  # it has died already; the loop finds its pipe closed and says so
            self.pipe.send_bytes(payload)

    def message(self) -> tuple[str, Any]:
        """Return the next message: its kind and value; kind "dead" if none can come, "" if there is none yet."""
        alive = self.process.is_alive()  # asked first: what a dead worker wrote before it died is still to be read
        try:
            if self.pipe.poll():
                return self.pipe.recv()
        except (EOFError, OSError):
            alive = False
        return ("", None) if alive else ("dead", None)

    def crash(self) -> TaskFailure:
        """Return how its process came to its end."""
        self.process.join(1.0)
        code = self.process.exitcode
        if code is not None and code < 0:
            name = signal.Signals(-code).name if -code in [s.value for s in signal.Signals] else f"signal {-code}"
            hint = " (out of memory?)" if name == "SIGKILL" else ""
            return TaskFailure(kind="crash", reason=f"the worker process was killed by {name}{hint}")
        return TaskFailure(kind="crash", reason=f"the worker process ended with exit code {code}")

    def end(self) -> None:
        """End the process: by itself if it is idle, else at once."""
        self.pipe.close()
        if self.index is None:
            self.process.join(2.0)
        self.process.kill()  # its own children notice and go as well: see `_die_with_parent`
        self.process.join()
        self.process.close()


def _run_in_workers(
    function: Callable[..., Any], tasks: Sequence[Any], board: _Board, *, jobs: int, time_limit_s: float | None
) -> None:
    waiting = deque((index, pickle.dumps((function, task))) for index, task in enumerate(tasks))
    workers: list[_Worker] = []
    resource_tracker.ensure_running()  # it unblocks SIGINT as it starts, so before SIGINT is blocked
    try:
        while waiting or any(worker.index is not None for worker in workers):
            while waiting and len(workers) < jobs:
                with _interrupts_blocked():  # no moment at which a process runs that the list does not know
                    workers.append(_Worker())
                workers[-1].assign(*waiting.popleft(), time_limit_s)
            for worker in _ready(workers):
                if not _serve(worker, board, time_limit_s):
                    with _interrupts_blocked():
                        workers.remove(worker)
                        worker.end()
                elif worker.index is None and waiting:
                    worker.assign(*waiting.popleft(), time_limit_s)
    finally:
        with _interrupts_blocked():  # a second Ctrl-C must not stop the cleaning up after the first
            for worker in workers:
                worker.end()


def _ready(workers: Sequence[_Worker]) -> list[_Worker]:
    """Wait for the next event; return the workers with something to read, dead, or past their deadline."""
    busy = [worker for worker in workers if worker.index is not None]
    left = min(worker.deadline for worker in busy) - time.monotonic()
    sources = [source for worker in busy for source in (worker.pipe, worker.process.sentinel)]
    found = connection.wait(sources, timeout=None if left == float("inf") else max(left, 0.0))
    now = time.monotonic()
    return [w for w in busy if w.pipe in found or w.process.sentinel in found or now >= w.deadline]


def _serve(worker: _Worker, board: _Board, time_limit_s: float | None) -> bool:
    """Take what a busy worker has to say; return False if it is dead or must be."""
    while worker.index is not None:
        kind, value = worker.message()
        if kind == "started":
            worker.deadline = float("inf") if time_limit_s is None else time.monotonic() + time_limit_s
        elif kind == "progress":
            board.move(worker.index, value)
        elif kind == "done":
            index, worker.index = worker.index, None
            board.put(index, _unpacked(value))
        elif kind == "dead" or time.monotonic() >= worker.deadline:
            index = worker.index
            late = TaskFailure(kind="timeout", reason=f"stopped after its time limit of {time_limit_s} s")
            board.put(index, worker.crash() if kind == "dead" else late)
            return False
        else:
            break
    return True


def _unpacked(value: bytes) -> Any:
    try:
        return pickle.loads(value)
    except Exception as error:
        return _failure(error)


# inside a worker ------------------------------------------------------------------------------------------------------


def _work(pipe: connection.Connection) -> None:
    """The worker's main loop: a task in, messages and one result out, until the parent closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    _die_with_parent()
    while True:
        try:
            payload = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        pipe.send(("done", _packed(_answer(payload, pipe))))


def _answer(payload: bytes, pipe: connection.Connection) -> Any:
    try:
        function, task = pickle.loads(payload)
    except Exception as error:
        return _failure(error)
    pipe.send(("started", None))
    return _call(function, task, lambda fraction: pipe.send(("progress", fraction)))


def _packed(result: Any) -> bytes:
    """Pickle here and now, so that what cannot be sent becomes a failure of this task rather than of the pipe."""
    try:
        packed = pickle.dumps(result)
        if isinstance(result, TaskFailure):
            pickle.loads(packed)  # exceptions with arguments of their own often pickle but do not unpickle
        return packed
    except Exception as error:
        failure = result if isinstance(result, TaskFailure) else _failure(error)
        return pickle.dumps(TaskFailure(kind=failure.kind, reason=failure.reason, details=failure.details))


def _die_with_parent() -> None:
    """End this process as soon as its parent is gone, whatever it is busy with: a killed worker takes its own along."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="finqd-parent-watch", daemon=True).start()


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Hold SIGINT back for a while; a process started inside never gets it, not even while its imports run.

    Masking it in this thread is for the children, which inherit the mask. Another thread of this process may still take
    the signal, and Python then calls its handler in the main thread, so the handler waits too.
    """
    came: list[int] = []
    here = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, lambda number, frame: came.append(number)) if here else None
    try:
        with _sigint_masked() if hasattr(signal, "pthread_sigmask") else nullcontext():
            yield
    finally:
        if here:
            signal.signal(signal.SIGINT, handler)
    if came and callable(handler):
        handler(came[0], None)


@contextmanager
def _sigint_masked() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
