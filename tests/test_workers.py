"""`finqd.workers`: order, equality over jobs, failures as data, and no process left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from finqd.errors import InputError
from finqd.workers import WORKER_THREADS, TaskFailure, run_tasks


def square(x):
    return x * x


def slow_first(task):
    """Task 0 of a folder waits until task 1 has been there."""
    i, folder = task
    (Path(folder) / str(i)).touch()
    assert i or not folder.endswith("2") or wait_until((Path(folder) / "1").exists, 60)
    return i, os.getpid()


def trouble(kind):
    if kind == "raise":
        raise ValueError("no such\n thing")
    if kind == "input":
        raise InputError("must be 3", where="fingers[0]")
    if kind == "exit":
        sys.exit(5)
    if kind == "os-exit":
        os._exit(7)
    if kind == "segfault":
        os.kill(os.getpid(), signal.SIGSEGV)
    if kind == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "sleep":
        time.sleep(60)
    if kind == "lambda":
        return lambda: 3
    if kind == "awkward":
        raise AwkwardError(1, 2)
    return kind


class AwkwardError(Exception):
    """Pickles, but does not unpickle: its arguments are not those of its constructor."""

    def __init__(self, one, two):
        super().__init__("only one argument")


def threads(_):
    from threadpoolctl import threadpool_info

    np.ones((2, 2)) @ np.ones((2, 2))
    pools = sorted({pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"})
    return pools, [os.environ.get(name) for name in WORKER_THREADS]


def long_sum(seed):
    matrix = np.random.default_rng(seed).normal(size=(400, 400))
    return float(np.linalg.eigvalsh(matrix @ matrix.T).sum()), float((matrix @ matrix)[3, 5])


def counting(n, progress):
    for i in range(n):
        progress((i + 1) / n)
    return n


def nested(i):
    """A task that has workers of its own, one of which is too slow and one of which dies."""
    results = run_tasks(trouble, ["fine", "sleep", "killed"], jobs=2, time_limit_s=1.0)
    return [getattr(result, "kind", result) for result in results]


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_the_order_of_the_tasks(jobs, tmp_path):
    seen, folder = [], tmp_path / f"jobs-{jobs}"
    folder.mkdir()
    tasks = [(i, str(folder)) for i in range(5)]
    results = run_tasks(slow_first, tasks, jobs=jobs, on_result=lambda index, result: seen.append((index, result)))
    assert [i for i, _ in results] == [0, 1, 2, 3, 4]
    assert sorted(seen) == list(enumerate(results))
    if jobs == 2:
        assert seen[0][0] != 0  # the slow first task did not hold up the others
        assert os.getpid() not in {pid for _, pid in results} and len({pid for _, pid in results}) == 2
    else:
        assert {pid for _, pid in results} == {os.getpid()}


def test_no_tasks():
    assert run_tasks(square, [], jobs=3) == []
    assert run_tasks(square, []) == []


def test_the_same_numbers_to_the_last_bit_here_and_in_workers():
    assert run_tasks(long_sum, [1, 2, 3]) == run_tasks(long_sum, [1, 2, 3], jobs=2)


def test_one_thread_each(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    (pools, environment), _ = run_tasks(threads, [0, 1], jobs=2)
    assert pools == [1] and environment == ["1"] * len(WORKER_THREADS)
    ((pools, environment),) = run_tasks(threads, [0])
    assert pools == [1] and environment[0] == "1"
    assert os.environ["OMP_NUM_THREADS"] == "4" and "NUMBA_NUM_THREADS" not in os.environ


@pytest.mark.parametrize(("jobs", "limit"), [(1, None), (1, 30.0), (3, None)])
def test_an_exception_is_data(jobs, limit):
    tasks = ["fine", "raise", "input", "exit", "fine"]
    fine, raised, wrong, left, last = run_tasks(trouble, tasks, jobs=jobs, time_limit_s=limit)
    assert (fine, last) == ("fine", "fine")
    assert raised == TaskFailure(kind="error", reason="ValueError: no such thing", details=raised.details)
    assert "in trouble" in raised.details and isinstance(raised.exception, ValueError)
    assert isinstance(wrong.exception, InputError) and wrong.exception.where == "fingers[0]"
    assert left.kind == "error" and left.reason == "SystemExit: 5"


def test_crashes_and_timeouts_are_data_and_harm_nobody_else():
    tasks = ["os-exit", "fine", "segfault", "sleep", "killed", "fine", "lambda", "awkward"]
    begin = time.monotonic()
    results = run_tasks(trouble, tasks, jobs=2, time_limit_s=1.5)
    assert time.monotonic() - begin < 40  # the sleeper wanted 60 s
    assert [getattr(r, "kind", r) for r in results] == [
        "crash", "fine", "crash", "timeout", "crash", "fine", "error", "error",
    ]  # fmt: skip
    assert results[0].reason == "the worker process ended with exit code 7"
    assert "SIGSEGV" in results[2].reason and "SIGKILL (out of memory?)" in results[4].reason
    assert results[3].reason == "stopped after its time limit of 1.5 s"
    assert "lambda" in results[6].reason and results[7].reason == "AwkwardError: only one argument"
    assert results[7].exception is None


def test_many_instant_crashes_lose_no_task():
    """The case in which shared queues break: workers that die right after they took a task."""
    results = run_tasks(trouble, ["os-exit", "fine"] * 12, jobs=3)
    assert [getattr(r, "kind", r) for r in results] == ["crash", "fine"] * 12


@pytest.mark.parametrize("jobs", [1, 2])
def test_progress_arrives_thinned_rising_and_complete(jobs):
    seen = {0: [], 1: []}
    assert run_tasks(counting, [1000, 3], jobs=jobs, on_progress=lambda i, f: seen[i].append(f)) == [1000, 3]
    assert seen[1] == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert seen[0] == sorted(seen[0]) and seen[0][-1] == 1.0 and 50 < len(seen[0]) <= 201


def test_workers_may_have_workers():
    assert run_tasks(nested, [0, 1], jobs=2) == [["fine", "timeout", "crash"]] * 2


def test_an_exception_in_a_callback_passes_and_leaves_nobody_behind():
    def stop(index, result):
        raise OSError("disk full")

    before = set(children_of(os.getpid()))  # the mesher's process outlives the tests that used it
    with pytest.raises(OSError, match="disk full"):
        run_tasks(trouble, ["fine", "sleep"], jobs=2, on_result=stop)
    assert not running(set(children_of(os.getpid())) - before)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"jobs": 0}, "jobs: must be a whole number from 1 upwards, got 0"),
        ({"jobs": 1.5}, "jobs: must be a whole number from 1 upwards, got 1.5"),
        ({"jobs": True}, "jobs: must be a whole number from 1 upwards, got True"),
        ({"time_limit_s": 0}, "time_limit_s: must be a positive number of seconds, got 0"),
        ({"time_limit_s": float("nan")}, "time_limit_s: must be a positive number of seconds, got nan"),
    ],
)
def test_bad_options_get_one_sentence(options, sentence):
    with pytest.raises(InputError) as error:
        run_tasks(square, [1], **options)
    assert str(error.value) == sentence


# nobody is left behind ------------------------------------------------------------------------------------------------


SCRIPT = """
import os, sys, time
from finqd.workers import run_tasks

def sleeper(folder):
    open(os.path.join(folder, str(os.getpid())), "w").close()
    time.sleep(120)

def parent_of_sleeper(folder):
    open(os.path.join(folder, str(os.getpid())), "w").close()
    return run_tasks(sleeper, [folder], time_limit_s=100)

if __name__ == "__main__":
    run_tasks(parent_of_sleeper, [sys.argv[1]] * 2, jobs=2)
"""


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="POSIX signals")
@pytest.mark.parametrize("how", ["interrupt", "interrupt group", "kill"])
def test_nothing_survives_the_parent(tmp_path, how):
    """Two workers with a worker each: all four are gone after Ctrl-C, and after kill -9 of the parent."""
    script, folder = tmp_path / "script.py", tmp_path / "pids"
    script.write_text(SCRIPT)
    folder.mkdir()
    parent = subprocess.Popen(
        [sys.executable, str(script), str(folder)], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert wait_until(lambda: len(os.listdir(folder)) == 4, 60)
        pids = [int(name) for name in os.listdir(folder)]
        assert running(pids) == sorted(pids)
        if how == "interrupt group":  # what a terminal does
            os.killpg(parent.pid, signal.SIGINT)
        else:
            parent.send_signal(signal.SIGINT if how == "interrupt" else signal.SIGKILL)
        _, stderr = parent.communicate(timeout=30)
        assert wait_until(lambda: not running(pids), 20)
        assert stderr.count("Traceback") == (0 if how == "kill" else 1)  # the parent's KeyboardInterrupt, no worker's
    finally:
        if parent.poll() is None:
            os.killpg(parent.pid, signal.SIGKILL)


def wait_until(condition, seconds):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


def state_and_parent(pid):
    """Return a process's state letter and parent, or None if it is gone (Linux; elsewhere by signal 0)."""
    try:
        if not Path("/proc/self/stat").exists():
            os.kill(pid, 0)
            return "?", 0
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return fields[0], int(fields[1])
    except (ProcessLookupError, FileNotFoundError):
        return None


def running(pids):
    found = {pid: state_and_parent(pid) for pid in pids}
    return sorted(pid for pid, entry in found.items() if entry is not None and entry[0] != "Z")


def children_of(pid):
    """Return this process's children but for multiprocessing's resource tracker (Linux; elsewhere none)."""
    children = []
    for entry in Path("/proc").glob("[0-9]*"):
        found = state_and_parent(int(entry.name))
        if found is not None and found[1] == pid and "resource_tracker" not in (entry / "cmdline").read_text():
            children.append(int(entry.name))
    return children
