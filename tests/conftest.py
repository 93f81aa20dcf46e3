"""Fixtures that several test files share."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
import pytest

from finqd import cli

# One evaluation is serial inside; two test processes on two cores must not fight over threads.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

# What tests look at is made by the code that they test; `test_cache.py` looks at what the cache makes of it.
os.environ["FINQD_CACHE_DIR"] = ""

# Who starts the tests in the background of a script has SIGINT ignored, and every process below inherits that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

MakeDistribution = Callable[..., None]


@pytest.fixture(autouse=True)
def unset_memory(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """In plain Python, fill a kernel's new arrays with what overflows or is no index, if it is read before it is set.

    What such memory holds is luck otherwise: a kernel that read it failed one run in many.
    """
    if not numba.config.DISABLE_JIT or request.node.get_closest_marker("kernel") is None:
        return
    empty = np.empty

    def poisoned(shape: int | tuple[int, ...], dtype: object = float, **options: object) -> np.ndarray:
        array = empty(shape, dtype, **options)
        if array.dtype.kind in "fi":
            array.fill(1e200 if array.dtype.kind == "f" else np.iinfo(array.dtype).max // 2)
        return array

    monkeypatch.setattr(np, "empty", poisoned)


@pytest.fixture
def make_distribution(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[MakeDistribution]:
    """Return a function that puts a fake installed distribution on ``sys.path``, and takes it off after the test."""
    modules: list[str] = []

    def make(name: str, plugins: Mapping[str, Mapping[str, str]], *, module: str = "", source: str = "") -> None:
        folder = tmp_path / name
        info = folder / f"{name.replace('-', '_')}-1.5.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.5\n")
        lines = [
            line
            for kind, targets in plugins.items()
            for line in [f"[finqd.{kind}]", *(f"{key} = {target}" for key, target in targets.items())]
        ]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
        if module:
            (folder / f"{module}.py").write_text(source)
            modules.append(module)
        monkeypatch.syspath_prepend(str(folder))

    yield make
    for module in modules:
        sys.modules.pop(module, None)


ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Environment:
    """A virtual environment with wheels of its own; libraries come from the environment that runs the tests."""

    folder: Path

    @property
    def site_packages(self) -> Path:
        paths = {"base": str(self.folder), "platbase": str(self.folder)}
        return Path(sysconfig.get_path("purelib", "venv", paths))

    def executable(self, name: str) -> str:
        return str(Path(sysconfig.get_path("scripts", "venv", {"base": str(self.folder)})) / name)

    def finqd(self, *arguments: str, cwd: Path, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run a command of finqd in this environment."""
        return self.run("python", "-m", "finqd", *arguments, cwd=cwd, check=check)

    def run(self, name: str, *arguments: str, cwd: Path, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run a program of this environment, away from the checkout."""
        environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
        done = subprocess.run(
            [self.executable(name), *arguments], cwd=cwd, env=environment, capture_output=True, text=True,
            stdin=subprocess.DEVNULL,
        )
        assert not check or done.returncode == 0, f"{name} {arguments}: {done.stdout}\n{done.stderr}"
        return done


def make_environment(folder: Path, sources: Sequence[Path], *, shared: Sequence[Path] = ()) -> Environment:
    """Build a wheel of each source folder and install it in a new environment, without asking any index.

    shared: further folders on its path. The libraries of the running environment come last; an editable finqd there
    does not come along, because only the environment's own ``.pth`` files count.
    """
    venv.create(folder, with_pip=False)
    environment = Environment(folder)
    wheels = folder / "wheels"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", wheels]
    subprocess.run([*build, *sources], check=True)
    install = [*pip, "--python", environment.executable("python"), "install", "--no-deps", "--no-index"]
    subprocess.run([*install, *wheels.glob("*.whl")], check=True)
    libraries = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (environment.site_packages / "shared.pth").write_text("\n".join([*map(str, shared), *sorted(libraries)]) + "\n")
    return environment


@pytest.fixture(scope="session")
def wheel_environment(tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """An environment in which finqd is installed from its wheel, as a user has it."""
    return make_environment(tmp_path_factory.mktemp("wheel") / "env", [ROOT])


@pytest.fixture(scope="session")
def example_environment(tmp_path_factory: pytest.TempPathFactory, wheel_environment: Environment) -> Environment:
    """An environment with the example distribution beside that very finqd, so that kernels compile only once."""
    source = ROOT / "examples" / "finqd-tapered-finger"
    return make_environment(
        tmp_path_factory.mktemp("example") / "env", [source], shared=[wheel_environment.site_packages]
    )


@pytest.fixture
def run(capsys):
    """Return a function that runs one command line and returns (exit code, stdout, stderr)."""

    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            cli.main([str(argument) for argument in arguments])
        said = capsys.readouterr()
        return end.value.code, said.out, said.err

    return run
