"""The log as the truth: a search that was stopped goes on, with the same archive as one that was not."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import time

import numpy as np
import pytest

from finqd import archive as qd
from finqd.algorithms import ALGORITHMS
from finqd.errors import InputError
from finqd.log_export import export_log
from finqd.run_file import read_run_file
from finqd.runlog import RunLog, read_run
from finqd.search import optimise

RANGES = {"workspace_mm2": (1169.0, 2079.0), "volume_mm3": (35.9e3, 93.6e3)}
calls = []


class Found:
    def __init__(self, design, preset):
        unit = design.to_unit_vector()
        shift = 0.05 * np.sin(40.0 * unit[0]) if preset == "draft" else 0.0  # what the cheap one gets wrong
        quality = float(np.mean(1.0 - (unit - 0.7) ** 2)) - 0.72 + shift
        margins = {name: float(np.clip(8 * quality - k, -1, 1)) for k, name in enumerate(("cube", "disk"))}
        self.objects = {name: {"status": "ok", "held": m > 0, "margin": m} for name, m in margins.items()}
        self.fitness = sum(row["held"] for row in self.objects.values()) / 2
        self.margin = sum(margins.values()) / 2
        self.features = {"workspace_mm2": 1e6 * design.workspace, "volume_mm3": 36e3 + 50e3 * float(unit[4])}

    def to_dict(self):
        return {"objects": self.objects}


def evaluate(design, *, objects, preset, jobs, progress):
    calls.append((design.digest(), preset))
    return Found(design, preset)


@pytest.fixture
def search(tmp_path):
    calls.clear()

    def run(out="run", **options):
        defaults = {"evaluate": evaluate, "iterations": 4, "batch": 5, "ranges": RANGES, "cells": 6,
                    "time_limit_s": None}
        return optimise(out=tmp_path / out, **{**defaults, **options})

    return run


def elites_of(result):
    return [(cell, record["index"], record["objective"], record["unit"]) for cell, record in result.elites]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_stopped_anywhere_and_gone_on_it_is_the_same_archive(search, tmp_path, algorithm):
    whole = search("whole", algorithm=algorithm)
    assert len(calls) == 20 and len(whole.records) == 20 and whole.elites
    for stop_after in (1, 7, 15):
        calls.clear()

        def stop(standing, stop_after=stop_after):
            if standing.evaluations == stop_after:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            search(f"cut{stop_after}", algorithm=algorithm, report=stop)
        again = search(f"cut{stop_after}", algorithm=algorithm)
        assert elites_of(again) == elites_of(whole)
        assert len(calls) == len(set(calls)) == 20  # nothing was evaluated twice, nothing lost
    assert [(c, r["index"]) for c, r in read_run(tmp_path / "cut7").elites()] == [e[:2] for e in elites_of(whole)]


def test_a_run_may_grow_and_is_the_one_that_was_longer_from_the_start(search):
    longer = search("longer", iterations=5)
    search(iterations=2)
    assert elites_of(search(iterations=5)) == elites_of(longer)
    with pytest.raises(InputError, match="iterations was 5 when this run began, and is 3 now; it may only grow"):
        search(iterations=3)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"seed": 1}, "seed was 0 when this run began, and is 1 now; a run goes on as it began"),
        ({"algorithm": "sobol"}, 'algorithm was "cma_me" when this run began, and is "sobol" now'),
        ({"objects": ["cube"]}, 'objects was null when this run began, and is ["cube"] now'),
        ({"ranges": {**RANGES, "volume_mm3": (1.0, 2.0)}}, "ranges.volume_mm3 was [35900.0, 93600.0] when"),
        ({"screen": "draft"}, 'preset was "standard" when this run began, and is null now'),
    ],
)
def test_another_setting_is_refused_by_name_and_nothing_is_touched(search, tmp_path, options, sentence):
    search(iterations=1)
    before = read_run(tmp_path / "run").records()
    with pytest.raises(InputError) as error:
        search(iterations=1, **options)
    assert sentence in str(error.value) and "\n" not in str(error.value)
    assert read_run(tmp_path / "run").records() == before


def test_other_versions_are_refused_unless_asked_for(search, monkeypatch):
    search(iterations=1)
    monkeypatch.setattr("finqd.search_settings._versions", lambda: {"ribs": "9.9"})
    with pytest.raises(InputError, match="versions.*--other-versions"):
        search(iterations=2)
    assert len(search(iterations=2, other_versions=True).records) == 10


def test_screening_confirms_what_would_enter_and_only_that_becomes_an_elite(search, tmp_path):
    result = search(screen="draft", preset="standard", iterations=6)
    confirmed = [record for record in result.records if record["screen"] is not None]
    alone = [record for record in result.records if record["screen"] is None]
    assert confirmed and alone and {r["preset"] for r in alone} == {"draft"}
    assert all(r["preset"] == "standard" and r["screen"]["preset"] == "draft" for r in confirmed)
    assert {record["preset"] for _, record in result.elites} == {"standard"}
    assert len(calls) == 30 + len(confirmed)
    assert elites_of(result) == [(c, r["index"], r["objective"], r["unit"]) for c, r in result.run.elites()]
    found = result.agreement
    assert (found.screened, found.confirmed, found.verdicts) == (30, len(confirmed), 2 * len(confirmed))
    assert 0 < found.entered <= found.confirmed and "is not known" in found.sentence()

    def stop(standing):
        if standing.evaluations == 13:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search("cut", screen="draft", preset="standard", iterations=6, report=stop)
    assert elites_of(search("cut", screen="draft", preset="standard", iterations=6)) == elites_of(result)


DRIVER = """
import sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
import test_search_resume as t
def slow(design, **options):
    time.sleep(0.05)
    return t.Found(design, options["preset"])
slow.__module__, slow.__qualname__ = "test_search_resume", "evaluate"
t.optimise(out=Path({out!r}), evaluate=slow, iterations=4, batch=5, ranges=t.RANGES, cells=6, time_limit_s=None)
"""


def test_a_driver_killed_at_once_loses_nothing_that_was_finished(search, tmp_path):
    out = tmp_path / "killed"
    code = DRIVER.format(tests=os.path.dirname(__file__), out=str(out))
    driver = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
    while not (out / "progress.log").exists() and driver.poll() is None:
        time.sleep(0.02)
    with pytest.raises(InputError, match=r"is being written to by process \d+ on .*; wait for it, or stop it"):
        search("killed")
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    with RunLog(out) as log:  # the lock went with its holder
        done = len(log.evaluations(0, 20))
    assert done >= 1
    again = search("killed")
    assert len(calls) == 20 - done
    assert elites_of(again) == elites_of(search("whole"))


# the log --------------------------------------------------------------------------------------------------------------


def test_what_is_no_log_is_one_sentence(search, tmp_path):
    with pytest.raises(InputError, match="holds no run: there is no run.sqlite in it"):
        read_run(tmp_path / "nothing")
    search(iterations=1)
    path = tmp_path / "run" / "run.sqlite"
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA user_version = 7")
    connection.close()
    for action in (lambda: read_run(tmp_path / "run"), lambda: search(iterations=1)):
        with pytest.raises(InputError, match="is a log of version 7, and this finqd reads version 1; use the finqd"):
            action()
    path.write_bytes(b"no database at all, but long enough for one" * 200)
    for action in (lambda: read_run(tmp_path / "run"), lambda: search(iterations=1)):
        with pytest.raises(InputError, match="run.sqlite: is damaged, or no log of finqd"):
            action()


def test_a_full_disk_is_a_sentence_and_what_was_written_stays(search, tmp_path):
    search(iterations=1)
    with RunLog(tmp_path / "run") as log:
        pages = log._connection.execute("PRAGMA page_count").fetchone()[0]
        log._connection.execute(f"PRAGMA max_page_count = {pages}")
        with pytest.raises(InputError, match="the disk is full; all that was written before is kept"):
            for index in range(5, 500):
                log.append({"index": index, "preset": "standard", "status": "ok", "details": "x" * 4000})
    assert len(read_run(tmp_path / "run").records()) == 5
    assert elites_of(search(iterations=1)) == elites_of(search("whole", iterations=1))


def test_the_log_as_a_table(search, tmp_path):
    result = search(iterations=2)
    assert export_log(result.run, tmp_path / "log.csv") == 10
    lines = (tmp_path / "log.csv").read_text().splitlines()
    assert len(lines) == 11 and "fingers[0].length_mm" in lines[0] and "cube_held" in lines[0]
    parquet = pytest.importorskip("pyarrow.parquet")
    export_log(result.run, tmp_path / "log.parquet")
    table = parquet.read_table(tmp_path / "log.parquet").to_pydict()
    assert table["objective"] == [record["objective"] for record in result.records]
    with pytest.raises(InputError, match="--to: must end in .csv or .parquet, not '.txt'"):
        export_log(result.run, tmp_path / "log.txt")


# RUN.toml -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("algoritm = 'cma_me'", "algoritm: unknown key; did you mean algorithm?"),
        ("algorithm = 'best'", 'algorithm: must be one of "cma_me", "cma_mae", "map_elites", "sobol", not "best"'),
        ("iterations = 0", "iterations: must be a whole number from 1 to 1e+07, not 0"),
        ("batch = true", "batch: must be a whole number from 1 to 100000, not true"),
        ("preset = 'draft'\nconfirm = 'draft'", "confirm: give preset or confirm, they mean the same"),
        ("iterations = ", "is not valid TOML: Invalid value (at end of document)"),
    ],
)
def test_a_bad_file_is_one_sentence(run, tmp_path, text, sentence):
    path = tmp_path / "run.toml"
    path.write_text(text)
    code, _, said = run("optimise", path, "--out", tmp_path / "run")
    assert code == 2 and sentence in said and said.count("\n") == 1 and not (tmp_path / "run").exists()


def test_paths_in_a_file_are_relative_to_it(tmp_path):
    (tmp_path / "run.toml").write_text('out = "here"\nobjects = ["cube", "mine.json"]\n')
    found = read_run_file(tmp_path / "run.toml")
    assert found["out"] == str(tmp_path / "here") and found["objects"] == ["cube", str(tmp_path / "mine.json")]


def test_options_override_the_file(run, tmp_path, monkeypatch):
    monkeypatch.setattr("finqd.evaluate.evaluate", evaluate)
    path = tmp_path / "run.toml"
    path.write_text('iterations = 1\nbatch = 2\nout = "run"\nalgorithm = "sobol"\n[set]\n"protocol.hold_s" = 2\n'
                    "[ranges]\nvolume_mm3 = [35e3, 95e3]\n")
    asked = {}

    def start(**options):
        asked.update(options)
        return optimise(**{**options, "jobs": 1, "time_limit_s": None})

    monkeypatch.setattr("finqd.search.optimise", start)
    code, said, progress = run("optimise", path, "--batch", "3")
    assert code == 0, progress
    assert asked["batch"] == 3 and asked["iterations"] == 1 and asked["base_design"].protocol.hold_s == 2
    assert "3 designs evaluated" in said and "3 of 3 designs, coverage" in progress
    assert set(qd.elites(read_run(tmp_path / "run").archive(), read_run(tmp_path / "run").records())[0][1]["features"])
