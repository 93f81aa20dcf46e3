"""One call of one task, wherever it runs: what it may come to, and how that travels between processes."""

from __future__ import annotations

import inspect
import os
import pickle
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from finqd.errors import InputError

#: read by the numerical libraries when they are first imported, so they must stand before a worker does that
BLAS_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
WORKER_THREADS = (*BLAS_THREADS, "NUMBA_NUM_THREADS")
PROGRESS_STEP = 0.005  # smaller steps of a task's progress are not worth a message

OnResult = Callable[[int, Any], None]
OnProgress = Callable[[int, float], None]


@dataclass(frozen=True, kw_only=True)
class TaskFailure:
    """What stands in the place of a result that is not there.

    ``kind``: "error" (the function raised), "crash" (its process died) or "timeout"; ``reason``: one sentence;
    ``details``: the traceback, if there is one; ``exception``: what was raised, if it can travel between processes;
    ``attempts``: how often it was tried.
    """

    kind: str
    reason: str
    details: str = ""
    exception: BaseException | None = field(default=None, compare=False)
    attempts: int = 1


OnRetry = Callable[[int, TaskFailure], None]


@dataclass(kw_only=True)
class Board:
    """The results so far, how often each task was tried, and who wants to hear of them."""

    results: list[Any]
    attempts: list[int]
    retries: int
    on_result: OnResult | None
    on_progress: OnProgress | None
    on_retry: OnRetry | None

    @classmethod
    def of(
        cls, tasks: Sequence[Any], *, retries: int, on_result: OnResult | None = None,
        on_progress: OnProgress | None = None, on_retry: OnRetry | None = None,
    ) -> Board:
        """Return an empty board."""
        count = len(tasks)
        return cls(results=[None] * count, attempts=[1] * count, retries=retries, on_result=on_result,
                   on_progress=on_progress, on_retry=on_retry)

    def put(self, index: int, result: Any) -> None:
        """Keep a result, and tell of it."""
        if isinstance(result, TaskFailure):
            result = replace(result, attempts=self.attempts[index])
        self.results[index] = result
        if self.on_result is not None:
            self.on_result(index, result)

    def move(self, index: int, fraction: float) -> None:
        """Tell of progress."""
        if self.on_progress is not None:
            self.on_progress(index, fraction)

    def again(self, index: int, crash: TaskFailure) -> bool:
        """Return whether a task whose process died is to be tried once more; if not, the crash is its result."""
        if self.attempts[index] > self.retries:
            self.put(index, crash)
            return False
        self.retried(index, crash)
        return True

    def retried(self, index: int, crash: TaskFailure) -> None:
        """Count another attempt, and tell of it."""
        self.attempts[index] += 1
        if self.on_retry is not None:
            self.on_retry(index, crash)


def check_limits(*, time_limit_s: float | None, retries: int = 0) -> None:
    """Raise InputError for limits that are out of range."""
    if time_limit_s is not None and not time_limit_s > 0:
        raise InputError(f"must be a positive number of seconds, got {time_limit_s!r}", where="time_limit_s")
    if isinstance(retries, bool) or not isinstance(retries, int) or retries < 0:
        raise InputError(f"must be a whole number from 0 upwards, got {retries!r}", where="retries")


def late(time_limit_s: float | None) -> TaskFailure:
    """Return what became of a task that took too long."""
    return TaskFailure(kind="timeout", reason=f"stopped after its time limit of {time_limit_s} s")


def call(function: Callable[..., Any], task: Any, report: Callable[[float], None]) -> Any:
    """Return ``function(task)``, or the `TaskFailure` that an exception became. Ctrl-C passes through."""
    try:
        if takes_progress(function):
            return function(task, progress=_thinned(report))
        return function(task)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit too: a task must not end the program that asked for it
        return failure(error)


def takes_progress(function: Callable[..., Any]) -> bool:
    """Return whether a function has a parameter ``progress``."""
    try:
        return "progress" in inspect.signature(function).parameters
    except ValueError:  # some built-in functions have no signature
        return False


def failure(error: BaseException) -> TaskFailure:
    """Return what an exception is as data; to be called where it is handled."""
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


def packed(result: Any) -> bytes:
    """Pickle here and now, so that what cannot be sent becomes a failure of this task rather than of the pipe."""
    try:
        text = pickle.dumps(result)
        if isinstance(result, TaskFailure):
            pickle.loads(text)  # exceptions with arguments of their own often pickle but do not unpickle
        return text
    except Exception as error:
        found = result if isinstance(result, TaskFailure) else failure(error)
        return pickle.dumps(TaskFailure(kind=found.kind, reason=found.reason, details=found.details))


def unpacked(value: bytes) -> Any:
    """Return what `packed` made travel, or a failure if it does not arrive."""
    try:
        return pickle.loads(value)
    except Exception as error:
        return failure(error)


@contextmanager
def environment(names: Sequence[str]) -> Iterator[None]:
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
def one_blas_thread() -> Iterator[None]:
    """Limit the BLAS libraries that are loaded, and those that load inside: sums in threads depend on their number."""
    from threadpoolctl import threadpool_limits

    with environment(BLAS_THREADS), threadpool_limits(limits=1, user_api="blas"):
        yield
