"""Compiled kernels that are kept on disk are those of the present sources."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from finqd.mechanics import compiled
from finqd.mechanics.distance_kernels import signed_distance

CALLED = "from {source} import njit\n@njit(cache=True)\ndef called(x):\n    return {factor} * x\n"
CALLING = """from {source} import njit
from called_kernels import called
@njit(cache=True)
def calling(x):
    return called(x) + 1.0
"""


#: asks for a kernel once another process is at compiling it; that one goes on only when this one has asked
ASKING = """import pathlib, sys, time
import numba, numba.core.event as event
import compiled, calling_kernels
numba.njit(lambda x: x + 1.0)(1.0)  # the compiler takes a second to begin with
own, other = map(pathlib.Path, sys.argv[1:])
def met():
    own.touch()
    while not other.exists():
        time.sleep(0.01)
class Meeting(event.Listener):
    def on_start(self, event):
        if {first}:
            met()
            time.sleep(0.5)  # and so the other one has looked for the kernel, in vain
    def on_end(self, event):
        pass
event.register("numba:compile", Meeting())
if not {first}:
    met()
print(calling_kernels.calling(10.0), *compiled.kernel_counts())
"""


def asking(folder: Path, *, first: bool) -> subprocess.Popen[str]:
    """Start a process that wants both kernels; the first waits in its compiler for a second, and that one for it."""
    files = ["first", "second"] if first else ["second", "first"]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache")}
    return subprocess.Popen(
        [sys.executable, "-c", ASKING.format(first=first), *files], cwd=folder, env=environment, text=True,
        stdout=subprocess.PIPE,
    )


@pytest.fixture
def kernels(tmp_path: Path) -> Path:
    """A folder with two kernels, one of which calls the other, and what compiles them."""
    if numba.config.DISABLE_JIT:
        pytest.skip("nothing is compiled")
    shutil.copy(compiled.__file__, tmp_path / "compiled.py")
    (tmp_path / "called_kernels.py").write_text(CALLED.format(source="compiled", factor=2.0))
    (tmp_path / "calling_kernels.py").write_text(CALLING.format(source="compiled"))
    return tmp_path


def answer(folder: Path, source: str, factor: float) -> float:
    """Write both files into ``folder`` and return what a new process makes of them.

    Without Python's own cache: it knows sources by size and whole seconds, and would take a quick edit for no change.
    """
    (folder / "called_kernels.py").write_text(CALLED.format(source=source, factor=factor))
    (folder / "calling_kernels.py").write_text(CALLING.format(source=source))
    program = "import calling_kernels; print(calling_kernels.calling(10.0))"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return float(done.stdout)


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_a_kernel_follows_a_change_in_the_file_of_one_that_it_calls(tmp_path: Path) -> None:
    shutil.copy(compiled.__file__, tmp_path / "compiled.py")
    assert [answer(tmp_path, "compiled", factor) for factor in (2.0, 3.0, 2.0)] == [21.0, 31.0, 21.0]
    twin = tmp_path / "twin"
    twin.mkdir()
    assert [answer(twin, "numba", factor) for factor in (2.0, 3.0)] == [21.0, 21.0], "Numba alone would do, now"


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_kernels_are_kept_in_a_folder_of_their_own_and_nobody_elses() -> None:
    folder = compiled.kernel_folder()
    assert folder is not None and signed_distance.stats.cache_path.startswith(str(folder))
    assert not str(numba.config.CACHE_DIR).startswith(str(folder))


def test_without_a_writable_place_kernels_work_all_the_same(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(blocker / "below"))
    assert compiled.kernel_folder() is None
    assert compiled.njit(cache=True)(lambda x: 2.0 * x)(3.0) == 6.0


def test_every_kernel_is_kept_there() -> None:
    sources = Path(compiled.__file__).parents[1].rglob("*.py")
    others = [path.name for path in sources if "numba import njit" in path.read_text()]
    assert others == [], "they would go stale: take njit from finqd.mechanics.compiled"


def test_of_two_processes_that_want_a_kernel_one_compiles_it_and_the_other_loads_it(kernels: Path) -> None:
    first, second = asking(kernels, first=True), asking(kernels, first=False)
    (one, _), (other, _) = first.communicate(), second.communicate()
    assert first.returncode == second.returncode == 0
    assert one.split() == ["21.0", "2", "0"], "both kernels, compiled"
    assert other.split() == ["21.0", "0", "1"], "the code of the one that it calls is inside"
    assert len(list(kernels.rglob("*.nbc"))) == 2


def test_a_process_that_dies_while_it_compiles_holds_up_nobody(kernels: Path) -> None:
    first = asking(kernels, first=True)
    while not (kernels / "first").exists():
        assert first.poll() is None
    second = asking(kernels, first=False)
    while not (kernels / "second").exists():
        assert second.poll() is None
    first.send_signal(signal.SIGKILL)
    first.communicate()
    assert second.communicate()[0].split() == ["21.0", "2", "0"] and second.returncode == 0


def test_nobody_waits_for_ever_nor_for_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fcntl = pytest.importorskip("fcntl")
    path, through = tmp_path / "kernel.lock", []
    with compiled._lock(path), compiled._lock(path):
        through.append("a kernel that calls itself")
    monkeypatch.setattr(compiled, "LOCK_WAIT_S", 0.05)
    with open(path, "a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with compiled._lock(path):
            through.append("behind one that does not go on")
    with compiled._lock(tmp_path / "nowhere" / "kernel.lock"):
        through.append("without a place for the lock")
    assert len(through) == 3 and not compiled._locked
