"""Fixtures that several test files share."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

# One evaluation is serial inside; two test processes on two cores must not fight over threads.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

MakeDistribution = Callable[..., None]


@pytest.fixture
def make_distribution(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> MakeDistribution:
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
