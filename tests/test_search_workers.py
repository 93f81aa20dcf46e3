"""A whole search gives the same archive wherever its evaluations run, and its elites can be rechecked there."""

from __future__ import annotations

import hashlib
import os
import signal

import numpy as np
import pytest

from finqd.perturbations import Scheme
from finqd.recheck import recheck
from finqd.search import optimise
from finqd.workers import open_workers

OBJECTS = ("one", "two", "three")  # of the stand-in; the search is asked for a ball, which is loaded fastest
RANGES = {"workspace_mm2": (1169.0, 2079.0), "volume_mm3": (90.0, 120.0)}
OPTIONS = {"iterations": 2, "batch": 4, "objects": ["sphere"], "preset": "draft", "cells": 6, "time_limit_s": 60.0,
           "ranges": RANGES}  # fmt: skip


class Found:
    """What the stand-in evaluator returns."""

    def __init__(self, design):
        numbers = np.random.default_rng(int(hashlib.sha256(design.digest().encode()).hexdigest()[:12], 16)).random(3)
        held = numbers < 0.6
        self.fitness, self.margin = float(held.mean()), float(numbers[0])
        length = float(np.mean([finger["length_mm"] for finger in design.fingers]))  # no volume, but quick
        self.features = {"workspace_mm2": design.workspace * 1e6, "volume_mm3": length}
        self.rows = {name: {"status": "ok", "held": bool(one)} for name, one in zip(OBJECTS, held)}

    def to_dict(self):
        return {"objects": self.rows}


def stand_in(design, *, objects, preset, jobs, progress):
    progress("sphere", 1.0)
    return Found(design)


def dies_once(design, *, objects, preset, jobs, progress):
    """A stand-in whose process is killed the first time that it meets each third design."""
    mark = os.path.join(os.environ["FINQD_TEST_MARKS"], design.digest())
    if int(design.digest(), 16) % 3 == 0 and not os.path.exists(mark):
        with open(mark, "w"):
            os.kill(os.getpid(), signal.SIGKILL)
    return stand_in(design, objects=objects, preset=preset, jobs=jobs, progress=progress)


WHERE = [{"kind": "inline"}, {"jobs": 1}, {"jobs": 2}, {"kind": "dask", "jobs": 2}]


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    out = tmp_path_factory.mktemp("expected") / "run"
    optimise(out=out, evaluate=stand_in, **OPTIONS)
    found = recheck(out, count=2, kind="inline", evaluate=stand_in, scheme=Scheme(seed=1))
    return (out / "archive.csv").read_bytes(), found.to_dict()


@pytest.mark.parametrize("where", WHERE, ids=["inline", "1 process", "2 processes", "dask"])
def test_the_same_archive_and_the_same_recheck_everywhere(where, tmp_path, expected):
    with open_workers(**where) as workers:
        optimise(out=tmp_path / "run", evaluate=stand_in, workers=workers, **OPTIONS)
    assert (tmp_path / "run" / "archive.csv").read_bytes() == expected[0]
    found = recheck(tmp_path / "run", count=2, evaluate=stand_in, scheme=Scheme(seed=1), **where)
    assert found.complete and found.to_dict() == expected[1]


@pytest.mark.parametrize("where", WHERE[2:], ids=["processes", "dask"])
def test_crashes_that_do_not_come_again_change_nothing(where, tmp_path, expected, monkeypatch):
    monkeypatch.setenv("FINQD_TEST_MARKS", str(tmp_path))
    with open_workers(**where) as workers:
        result = optimise(out=tmp_path / "run", evaluate=dies_once, workers=workers, **OPTIONS)
    assert {record["status"] for record in result.records} == {"ok"}
    assert any((tmp_path / record["design_digest"]).exists() for record in result.records)
    assert (tmp_path / "run" / "archive.csv").read_bytes() == expected[0]
