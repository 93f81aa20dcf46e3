"""Compiled kernels that are kept on disk are those of the present sources."""

from __future__ import annotations

import os
import shutil
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
