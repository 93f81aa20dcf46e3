"""What the README shows, runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def test_the_cantilever_of_the_readme_sags(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert "(40, 12, 12)" in code
    exec(compile(code.replace("(40, 12, 12)", "(20, 6, 6)"), "README.md", "exec"), {})
    assert 1e3 * float(capsys.readouterr().out) == pytest.approx(6.56, abs=0.01)  # 6.72 on the README's finer mesh


def test_the_picture_of_the_readme_is_there() -> None:
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", README.read_text()):
        assert (README.parent / picture).stat().st_size > 10_000
