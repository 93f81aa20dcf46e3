"""`finqd.workers.open_workers`: one contract wherever evaluations run, and what is said when they cannot."""

from __future__ import annotations

import gc
import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from test_workers import children_of, counting, long_sum, running, square, threads, trouble, wait_until

from finqd import workers_dask
from finqd.errors import InputError, MissingLibraryError
from finqd.workers import WORKER_THREADS, WorkersError, open_workers

ROOT = Path(__file__).parents[1]
KINDS = ("inline", "processes", "embedded", "cluster")
KILLABLE = KINDS[1:]


def dies_at_first(folder):
    """A task that is killed the first time."""
    mark = Path(folder) / "been here"
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "second time"


def busy(folder):
    """A task that says who works on it, and then takes two minutes unless somebody writes ``end``."""
    (Path(folder) / f"{os.getppid()} {os.getpid()}").touch()
    wait_until((Path(folder) / "end").exists, 120)
    return "done"


def working(folder):
    """Return (parent, own) process numbers of the tasks `busy`."""
    return [tuple(map(int, path.name.split())) for path in Path(folder).glob("[0-9]* [0-9]*")]


class Cluster:
    """A scheduler and two workers by the command line, as docs/cluster.md has them; one of them with a nanny."""

    def __init__(self, folder, workers=2, scheduler=("scheduler", "--port", "0", "--no-dashboard")):
        folder.mkdir(exist_ok=True)
        self.file = folder / "scheduler.json"
        self.log = (folder / "log").open("w")
        self.scheduler = self.start(*scheduler, "--scheduler-file", self.file)
        self.workers = [
            self.start("worker", "--scheduler-file", self.file, "--nthreads", "1", "--memory-limit", "0",
                       "--no-dashboard", *(["--no-nanny"] if i else []), "--local-directory", folder)
            for i in range(workers)
        ]
        assert wait_until(lambda: self.file.exists() and self.file.read_text().endswith("}"), 60)
        self.address = json.loads(self.file.read_text())["address"]

    def start(self, *arguments):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
        command = [sys.executable, "-m", "dask", *map(str, arguments)]
        return subprocess.Popen(command, stdout=self.log, stderr=self.log, env=environment, start_new_session=True)

    def close(self):
        for process in (*self.workers, self.scheduler):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        self.log.close()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    found = Cluster(tmp_path_factory.mktemp("cluster"))
    yield found
    found.close()


def opened(kind, request, jobs=2):
    if kind == "cluster":
        return open_workers("dask", scheduler=request.getfixturevalue("cluster").address)
    return open_workers("dask" if kind == "embedded" else kind, jobs=jobs)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_results_to_the_last_bit_in_the_order_of_the_tasks(kind, request):
    expected = [long_sum(i) for i in range(3)]
    seen = {}
    with opened(kind, request) as workers:
        assert workers.run(long_sum, range(3), on_result=seen.__setitem__) == expected
        assert workers.run(square, []) == []
        assert workers.run(square, range(20)) == [i * i for i in range(20)]  # again, with the same workers
    assert seen == dict(enumerate(expected))


def test_one_process_gives_the_same_as_two():
    with open_workers("processes", jobs=1) as workers:
        assert workers.run(long_sum, [0, 1]) == [long_sum(0), long_sum(1)]


@pytest.mark.parametrize("kind", KILLABLE)
def test_one_thread_in_each_worker(kind, request):
    with opened(kind, request) as workers:
        assert workers.run(threads, [0]) == [([1], ["1"] * len(WORKER_THREADS))]


@pytest.mark.parametrize("kind", KILLABLE)
def test_a_crash_is_tried_again_once(kind, request, tmp_path):
    again = []
    with opened(kind, request) as workers:
        found = workers.run(
            dies_at_first, [str(tmp_path)], on_retry=lambda index, failure: again.append((index, failure.reason))
        )
    assert found == ["second time"]
    assert again == [(0, "the worker process was killed by SIGKILL (out of memory?)")]


@pytest.mark.parametrize("kind", KILLABLE)
def test_a_second_crash_is_recorded_and_harms_nobody_else(kind, request):
    again = []
    with opened(kind, request) as workers:
        found = workers.run(
            trouble, ["os-exit", "fine", "raise", "fine"], on_retry=lambda index, failure: again.append(index)
        )
    assert [getattr(one, "kind", one) for one in found] == ["crash", "fine", "error", "fine"]
    assert found[0].attempts == 2 and found[0].reason == "the worker process ended with exit code 7"
    assert found[2].attempts == 1 and found[2].reason == "ValueError: no such thing" and again == [0]


@pytest.mark.parametrize("kind", KINDS)
def test_what_hangs_is_stopped_at_the_limit(kind, request):
    with opened(kind, request) as workers:
        found = workers.run(trouble, ["sleep", "fine"], time_limit_s=1.0)
    assert found[0].kind == "timeout" and found[0].reason == "stopped after its time limit of 1.0 s"
    assert found[0].attempts == 1 and found[1] == "fine"


def nested(kind):
    with open_workers("inline") as workers:
        return workers.run(trouble, [kind])


def test_the_limit_holds_through_tasks_inside_a_task():
    with open_workers("inline") as workers:
        (found,) = workers.run(nested, ["sleep"], time_limit_s=1.0)
    assert found.kind == "timeout"


@pytest.mark.parametrize("kind", KINDS)
def test_progress_arrives(kind, request):
    seen = []
    with opened(kind, request) as workers:
        assert workers.run(counting, [100], on_progress=lambda i, fraction: seen.append(fraction)) == [100]
    assert seen == sorted(seen) and seen[0] == 0.01


@pytest.mark.parametrize("kind", KILLABLE)
def test_an_exception_in_a_callback_passes_and_leaves_no_task_at_work(kind, request, tmp_path):
    def stop(index, result):
        assert wait_until(lambda: working(tmp_path), 60)
        raise OSError("disk full")

    before = set(children_of(os.getpid()))
    with pytest.raises(OSError, match="disk full"), opened(kind, request) as workers:
        workers.run(either, ["fine", str(tmp_path)], on_result=stop)
    ((_, pid),) = working(tmp_path)
    assert wait_until(lambda: not running([pid]), 30)
    assert wait_until(lambda: not running(set(children_of(os.getpid())) - before), 30)


def either(task):
    return task if task == "fine" else busy(task)


def test_a_worker_that_died_while_idle_costs_nobody_an_attempt():
    again = []
    with open_workers("processes", jobs=1) as workers:
        (pid,) = workers.run(own_number, [0])
        os.kill(pid, signal.SIGKILL)
        (worker,) = workers._workers
        assert wait_until(lambda: not worker.process.is_alive(), 20)  # its last thread, too
        assert workers.run(own_number, [0], on_retry=lambda *call: again.append(call)) != [pid]
    assert again == []


def own_number(_):
    return os.getpid()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"kind": "threads"}, "workers: must be one of inline, processes, dask, not 'threads'"),
        ({"jobs": 0}, "jobs: must be a whole number from 1 upwards, got 0"),
        ({"scheduler": "tcp://a:1"}, "scheduler: goes with the workers dask, not with processes"),
        ({"kind": "dask", "scheduler": "8786:"}, "scheduler: must be an address as tcp://host:8786, not '8786:'"),
    ],
)
def test_bad_options_get_one_sentence(options, sentence):
    with pytest.raises(InputError) as error, open_workers(**options):
        pass
    assert str(error.value) == sentence


def test_a_bad_number_of_retries_gets_one_sentence():
    with pytest.raises(InputError) as error, open_workers("inline") as workers:
        workers.run(square, [1], retries=-1)
    assert str(error.value) == "retries: must be a whole number from 0 upwards, got -1"


# dask -----------------------------------------------------------------------------------------------------------------


def test_dask_is_imported_only_where_it_is_used():
    code = "import sys, finqd.workers, finqd.cli; print([m for m in ('dask', 'distributed') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingLibraryError, match=r"pip install 'finqd\[dask\]'"), open_workers("dask"):
        pass


def test_a_scheduler_that_does_not_answer(monkeypatch):
    monkeypatch.setattr(workers_dask, "CONNECT_S", 1.0)
    with pytest.raises(WorkersError) as error, open_workers("dask", scheduler="tcp://127.0.0.1:9"):
        pass
    assert str(error.value) == (
        "no dask scheduler answers at tcp://127.0.0.1:9; one is started with: dask scheduler (see docs/cluster.md)"
    )


def test_no_garbage_is_collected_while_a_client_starts(monkeypatch):
    """One that never connected ends in the collector, which waited for the one that was starting: for ever."""
    distributed = pytest.importorskip("distributed")
    seen = []

    def client(*_, **options):
        seen.append(gc.isenabled())
        raise OSError("nobody there")

    monkeypatch.setattr(distributed, "Client", client)
    with pytest.raises(WorkersError), open_workers("dask", scheduler="tcp://127.0.0.1:9"):
        pass
    assert seen == [False] and gc.isenabled()


def test_a_scheduler_without_workers(tmp_path):
    alone = Cluster(tmp_path / "alone", workers=0)
    try:
        workers = workers_dask.open_dask(alone.address, jobs=1, patience_s=1.0)
        with pytest.raises(WorkersError, match=f"at {alone.address} has had no worker for 1 s; one is started with"):
            workers.run(square, [1])
        workers.close()
    finally:
        alone.close()


def test_another_finqd_on_the_workers_is_refused(cluster, monkeypatch):
    here = {**workers_dask.versions(), "source": "another"}
    monkeypatch.setattr(workers_dask, "versions", lambda: here)
    with pytest.raises(WorkersError) as error, open_workers("dask", scheduler=cluster.address) as workers:
        workers.run(square, [1])
    assert "the dask worker at tcp://" in str(error.value)
    assert str(error.value).endswith(" (here another); install the same one everywhere")


def test_workers_without_finqd_are_refused(tmp_path):
    bare = Cluster(tmp_path / "bare", workers=0)
    code = "import sys; sys.modules['finqd'] = None; from dask.__main__ import main; main()"
    command = [sys.executable, "-c", code, "worker", "--scheduler-file", str(bare.file), "--no-nanny"]
    bare.workers.append(subprocess.Popen(command, stdout=bare.log, stderr=bare.log, start_new_session=True))
    try:
        with pytest.raises(WorkersError) as error, open_workers("dask", scheduler=bare.address) as workers:
            workers.run(square, [1])
        assert str(error.value).startswith("the dask worker on ") and "has no such finqd (" in str(error.value)
    finally:
        bare.close()


def test_what_was_told_stays_when_the_scheduler_goes(tmp_path):
    lost, told = Cluster(tmp_path / "lost", workers=1), []

    def tell(index, result):
        told.append(result)
        os.killpg(lost.scheduler.pid, signal.SIGKILL)

    try:
        with pytest.raises(WorkersError) as error, open_workers("dask", scheduler=lost.address) as workers:
            workers.run(either, ["fine", str(tmp_path), str(tmp_path)], on_result=tell)
        assert str(error.value) == f"the dask scheduler at {lost.address} is gone"
        assert told == ["fine"]
    finally:
        lost.close()


@pytest.mark.parametrize("number", ["SIGKILL", "SIGTERM"])  # out of the blue; by a batch system at its wall time
def test_a_dask_worker_that_is_lost_costs_nothing_but_time(tmp_path, number):
    two, again = Cluster(tmp_path / "two", workers=2), []
    try:
        with open_workers("dask", scheduler=two.address) as workers:

            def lose(index, result):
                if index == 0:
                    assert wait_until(lambda: working(tmp_path), 60)
                    ((parent, pid),) = working(tmp_path)
                    os.kill(parent, getattr(signal, number))
                    assert wait_until(lambda: not running([pid]), 60)  # its child does not stay
                    (tmp_path / "end").touch()

            found = workers.run(either, ["fine", str(tmp_path)], on_result=lose, on_retry=lambda *call: again.append(1))
        assert found == ["fine", "done"] and len(working(tmp_path)) == 2 and again == []
    finally:
        two.close()


def test_the_lines_of_the_manual(tmp_path):
    """docs/cluster.md's scheduler and, twice, its worker; only host, port and number of threads are others."""
    manual_text = (ROOT / "docs" / "cluster.md").read_text()
    lines = [line.split() for line in manual_text.splitlines() if line.startswith("    dask ")]
    assert [line[:2] for line in lines] == [["dask", "scheduler"], ["dask", "worker"]]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    scheduler, worker = ([word.replace("HOST", "127.0.0.1").replace("8786", port) for word in line] for line in lines)
    manual = Cluster(tmp_path / "manual", workers=0, scheduler=[*scheduler[1:], "--no-dashboard"])
    manual.workers += [manual.start(*worker[1:], "--no-dashboard") for _ in range(2)]
    try:
        with open_workers("dask", scheduler=f"tcp://127.0.0.1:{port}") as workers:
            assert workers.run(square, range(5)) == [0, 1, 4, 9, 16]
    finally:
        manual.close()


UNGUARDED = """
from finqd.workers import open_workers

with open_workers(jobs=1) as workers:
    workers.run(abs, [1])
"""


def test_processes_that_never_begin_are_not_the_tasks_fault(tmp_path):
    """A script without a guard round its main part: each worker begins with workers of its own, and Python refuses."""
    (tmp_path / "script.py").write_text(UNGUARDED)
    found = subprocess.run([sys.executable, str(tmp_path / "script.py")], capture_output=True, text=True)
    assert found.returncode == 1
    assert found.stderr.strip().splitlines()[-1] == (
        "finqd.errors.WorkersError: the worker process ended with exit code 1 before it began, each time; "
        'a script of your own must guard its main part with if __name__ == "__main__"'
    )


SCRIPT = """
import sys
from finqd.workers import open_workers

def work(folder):
    import os, pathlib, time
    (pathlib.Path(folder) / f"{os.getppid()} {os.getpid()}").touch()
    time.sleep(0 if os.path.exists(folder + "/end") else 120)
    return "by value"

if __name__ == "__main__":
    folder, kind, scheduler = sys.argv[1:]
    with open_workers(kind, jobs=2, scheduler=scheduler or None) as workers:
        print(workers.run(work, [folder] * 2))
"""


def script(tmp_path, kind, request):
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "pids").mkdir()
    scheduler = request.getfixturevalue("cluster").address if kind == "cluster" else ""
    kind = "processes" if kind == "processes" else "dask"
    command = [sys.executable, str(tmp_path / "script.py"), str(tmp_path / "pids"), kind, scheduler]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def test_functions_of_a_script_reach_the_cluster(tmp_path, request):
    (tmp_path / "end").touch()
    driver = script(tmp_path, "cluster", request)
    (tmp_path / "pids" / "end").touch()
    assert driver.communicate() == ("['by value', 'by value']\n", "")


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="POSIX signals")
@pytest.mark.parametrize("kind", KILLABLE)
@pytest.mark.parametrize("how", ["interrupt", "kill"])
def test_nothing_is_at_work_after_the_driver(tmp_path, request, kind, how):
    driver = script(tmp_path, kind, request)
    try:
        assert wait_until(lambda: len(working(tmp_path / "pids")) == 2, 60)
        pids = [pid for _, pid in working(tmp_path / "pids")]
        assert running(pids) == sorted(pids)
        os.killpg(driver.pid, signal.SIGINT if how == "interrupt" else signal.SIGKILL)
        _, stderr = driver.communicate(timeout=60)
        assert stderr.count("Traceback") == (1 if how == "interrupt" else 0)  # the driver's own KeyboardInterrupt
        assert wait_until(lambda: not running(pids), 30)
    finally:
        if driver.poll() is None:
            os.killpg(driver.pid, signal.SIGKILL)
