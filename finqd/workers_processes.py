"""Worker processes of this machine, which can be killed.

Each worker has a pipe of its own, and the parent is one loop over those pipes. Nothing is shared between workers, so
one may be killed at any instant without harm to the others. Pools with one shared queue lose that, pebble's among them:
measured with workers that die as soon as they start a task, it gave up the whole pool and the healthy tasks with it.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from multiprocessing import connection, resource_tracker
from typing import Any

from finqd.errors import InputError, WorkersError
from finqd.workers_task import (
    WORKER_THREADS,
    Board,
    OnProgress,
    OnResult,
    OnRetry,
    TaskFailure,
    call,
    check_limits,
    environment,
    failure,
    late,
    packed,
    unpacked,
)

START_ALLOWANCE_S = 60.0  # a time limit begins when the task does; starting the interpreter may take this long
TICK_S = 1.0
GUARD = 'a script of your own must guard its main part with if __name__ == "__main__"'
_starting = threading.Lock()  # several threads of a dask worker start processes, and the environment is theirs together


class Processes:
    """Up to ``jobs`` processes, started when they are needed and kept from one `run` to the next.

    For one thread at a time. Raises InputError if ``jobs`` is out of range.
    """

    def __init__(self, jobs: int) -> None:
        if isinstance(jobs, bool) or not isinstance(jobs, int) or jobs < 1:
            raise InputError(f"must be a whole number from 1 upwards, got {jobs!r}", where="jobs")
        self.jobs = jobs
        self._workers: list[_Worker] = []
        self._proven = False  # one has begun: processes work here

    def run(
        self, function: Callable[..., Any], tasks: Sequence[Any], *, time_limit_s: float | None = None,
        retries: int = 1, on_result: OnResult | None = None, on_progress: OnProgress | None = None,
        on_retry: OnRetry | None = None, on_tick: Callable[[], None] | None = None,
    ) -> list[Any]:
        """Return the result of each task, see `finqd.workers.Workers`.

        on_tick: called about once a second while tasks run; what it raises ends them
        Raises WorkersError if not one process lives long enough to begin: no task is at fault then
        """
        check_limits(time_limit_s=time_limit_s, retries=retries)
        board = Board.of(tasks, retries=retries, on_result=on_result, on_progress=on_progress, on_retry=on_retry)
        waiting = deque((index, pickle.dumps((function, task))) for index, task in enumerate(tasks))
        resource_tracker.ensure_running()  # it unblocks SIGINT as it starts, so before SIGINT is blocked
        try:
            self._end([worker for worker in self._workers if not worker.process.is_alive()])  # died while idle
            while waiting or any(worker.index is not None for worker in self._workers):
                self._assign(waiting, time_limit_s)
                for worker in _ready(self._workers, on_tick):
                    index, payload = worker.index, worker.payload
                    crash = _serve(worker, board, time_limit_s)
                    self._proven = self._proven or worker.began
                    if crash is not None:
                        self._end([worker])
                        assert index is not None  # only busy workers are asked
                        if crash.kind != "crash":
                            board.put(index, crash)
                        elif not self._proven and 0 < retries < board.attempts[index]:
                            raise WorkersError(f"{crash.reason} before it began, each time; {GUARD}")
                        elif board.again(index, crash):
                            waiting.append((index, payload))
        except BaseException:
            self.close()  # what is still at work has nobody to report to
            raise
        return board.results

    def _assign(self, waiting: deque[tuple[int, bytes]], time_limit_s: float | None) -> None:
        """Give what waits to the idle, and to new workers as long as there may be more."""
        idle = [worker for worker in self._workers if worker.index is None]
        while waiting and (idle or len(self._workers) < self.jobs):
            if not idle:
                with interrupts_blocked():  # no moment at which a process runs that the list does not know
                    self._workers.append(_Worker())
                idle.append(self._workers[-1])
            idle.pop(0).assign(*waiting.popleft(), time_limit_s)

    def _end(self, workers: Sequence[_Worker]) -> None:
        with interrupts_blocked():  # a second Ctrl-C must not stop the cleaning up after the first
            for worker in workers:
                self._workers.remove(worker)
                worker.end()

    def close(self) -> None:
        """End all processes, those at work at once."""
        self._end(list(self._workers))

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


class _Worker:
    """One process, the parent's end of its pipe, and the task it is busy with (None: idle)."""

    def __init__(self) -> None:
        spawn = multiprocessing.get_context("spawn")  # a fork would copy threads' locks, gmsh and BLAS state
        self.pipe, theirs = spawn.Pipe()
        self.process = spawn.Process(target=_work, args=(theirs,), name="finqd-worker")
        self.process.daemon = False  # daemons may not have children, and evaluations mesh in one
        with _starting, environment(WORKER_THREADS):
            self.process.start()
        theirs.close()
        self.index: int | None = None
        self.payload = b""
        self.began = False  # its interpreter is up, and it listens
        self.deadline = float("inf")

    def assign(self, index: int, payload: bytes, time_limit_s: float | None) -> None:
        self.index, self.payload = index, payload
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


def _ready(workers: Sequence[_Worker], on_tick: Callable[[], None] | None) -> list[_Worker]:
    """Wait for the next event; return the workers with something to read, dead, or past their deadline."""
    busy = [worker for worker in workers if worker.index is not None]
    sources = [source for worker in busy for source in (worker.pipe, worker.process.sentinel)]
    while True:
        left = min(worker.deadline for worker in busy) - time.monotonic()
        if on_tick is not None:
            on_tick()
            left = min(left, TICK_S)
        found = connection.wait(sources, timeout=None if left == float("inf") else max(left, 0.0))
        now = time.monotonic()
        ready = [w for w in busy if w.pipe in found or w.process.sentinel in found or now >= w.deadline]
        if ready:
            return ready


def _serve(worker: _Worker, board: Board, time_limit_s: float | None) -> TaskFailure | None:
    """Take what a busy worker has to say; return what became of its task if it is dead or must be."""
    while worker.index is not None:
        kind, value = worker.message()
        if kind == "began":
            worker.began = True
        elif kind == "started":
            worker.deadline = float("inf") if time_limit_s is None else time.monotonic() + time_limit_s
        elif kind == "progress":
            board.move(worker.index, value)
        elif kind == "done":
            index, worker.index = worker.index, None
            board.put(index, unpacked(value))
        elif kind == "dead":
            return worker.crash()
        elif time.monotonic() >= worker.deadline:
            return late(time_limit_s)
        else:
            break
    return None


# inside a worker ------------------------------------------------------------------------------------------------------


def _work(pipe: connection.Connection) -> None:
    """The worker's main loop: a task in, messages and one result out, until the parent closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    _die_with_parent()
    pipe.send(("began", None))
    while True:
        try:
            payload = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        pipe.send(("done", packed(_answer(payload, pipe))))


def _answer(payload: bytes, pipe: connection.Connection) -> Any:
    try:
        function, task = pickle.loads(payload)
    except Exception as error:
        return failure(error)
    pipe.send(("started", None))
    return call(function, task, lambda fraction: pipe.send(("progress", fraction)))


def _die_with_parent() -> None:
    """End this process as soon as its parent is gone, whatever it is busy with: a killed worker takes its own along."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="finqd-parent-watch", daemon=True).start()


@contextmanager
def interrupts_blocked() -> Iterator[None]:
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
