"""The loop that the studies in `benchmarks/` share: what is in the log is not computed again."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from finqd.study_log import append_row, read_rows
from finqd.workers import TaskFailure

BENCHMARKS = Path(__file__).resolve().parent.parent / "benchmarks"


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch):
    """The module `benchmarks/study.py`."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import study

    return study


def compute(task: tuple[str, str]) -> dict[str, object]:
    name, digest = task
    if name == "bad":
        raise ValueError("of no use")
    return {"name": name, "digest": digest, "answer": len(name)}


def go_on(study, log: Path, tasks: dict[str, str], **options) -> dict[str, dict]:
    """Compute what the log lacks; return all rows that hold."""
    rows = study.rows_that_hold(log, tasks, lambda row: row["name"])
    named = {name: (name, digest) for name, digest in tasks.items()}
    given = {"log": log, "words": lambda row: f"did {row['name']}", "jobs": 1, "minutes": math.inf, **options}
    study.compute_missing(named, rows, compute, **given)
    return rows


def test_only_what_is_missing_or_has_changed_is_computed(study, tmp_path: Path, capsys) -> None:
    log = tmp_path / "study.jsonl"
    append_row(log, {"name": "a", "digest": "1", "answer": 99, "commit": "old"})
    append_row(log, {"name": "b", "digest": "0", "answer": 99, "commit": "old"})
    rows = go_on(study, log, {"c": "1", "a": "1", "b": "1"})
    assert capsys.readouterr().out == "did c\ndid b\n"
    assert {name: row["answer"] for name, row in rows.items()} == {"a": 99, "b": 1, "c": 1}
    assert [(row["name"], list(row)[-1]) for row in read_rows(log)[2:]] == [("c", "commit"), ("b", "commit")]
    assert go_on(study, log, {"c": "1", "a": "1", "b": "1"}) == rows and capsys.readouterr().out == ""


def test_when_the_time_is_up_nothing_more_is_computed(study, tmp_path: Path) -> None:
    assert go_on(study, tmp_path / "study.jsonl", {"a": "1"}, minutes=-1.0) == {}
    assert not (tmp_path / "study.jsonl").exists()


def test_a_failure_is_tried_again_or_is_a_row(study, tmp_path: Path, capsys) -> None:
    log = tmp_path / "study.jsonl"
    for _ in range(2):
        assert list(go_on(study, log, {"bad": "1", "a": "1"})) == ["a"]
        assert "bad: error: ValueError: of no use" in capsys.readouterr().out

    def failed(key: str, failure: TaskFailure) -> dict[str, object]:
        return {"name": key, "digest": "1", "answer": failure.kind}

    assert go_on(study, log, {"bad": "1", "a": "1"}, failed=failed)["bad"]["answer"] == "error"
    assert go_on(study, log, {"bad": "1", "a": "1"})["bad"]["answer"] == "error"


@pytest.mark.parametrize("name", ["fuzz_grasps", "contact_models", "effects_auto"])
def test_the_logs_that_come_with_finqd_are_read(name: str, study, monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib

    module, log = importlib.import_module(name), BENCHMARKS / f"{name}.jsonl"
    logged = read_rows(log)
    assert logged
    digests = {module.key(row): row["digest"] for row in logged}
    rows = study.rows_that_hold(log, digests, module.key)
    assert rows.keys() == digests.keys() and all(module.words(row) for row in rows.values())
