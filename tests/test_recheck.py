"""`finqd.recheck`: elites again under other conditions, in the log of their run."""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import qmc

from finqd.archive import new_archive, objective
from finqd.cli_recheck import recheck as recheck_command
from finqd.design import Design, design_parameters
from finqd.errors import InputError
from finqd.perturbations import ADDED, RANGES, Scheme
from finqd.provenance import versions
from finqd.recheck import recheck, recheck_run, trust_of
from finqd.run_folder import plain
from finqd.runlog import RunLog, read_run
from finqd.search_settings import versions_of
from finqd.trust import Share
from finqd.workers import open_workers

OBJECTS = ["cube", "disk", "sphere"]
AXES = {"workspace_mm2": (1000.0, 2200.0), "volume_mm3": (10_000.0, 90_000.0)}
NOTHING = {name: (0.0, 0.0) if name in ADDED else (1.0, 1.0) for name in RANGES}
BASE = {"protocol": {"hold_s": 2.0}}


def result_of(held, features):
    fitness = sum(held) / len(held)
    return {"fitness": fitness, "margin": 0.25, "features": features, "seconds": 0.0,
            "objects": {name: {"status": "ok", "held": bool(one)} for name, one in zip(OBJECTS, held)}}


def features_of(design):
    return {"workspace_mm2": design.workspace * 1e6, "volume_mm3": 500.0 * sum(f["length_mm"] for f in design.fingers)}


def steady(task, *, progress=None):
    """A stand-in that holds the same objects under all conditions."""
    design, _ = task
    number = round(100 * design.spacing_mm)
    return result_of([number % 2, number % 3 > 0, 1], features_of(design))


def flipping(task, *, progress=None, rate=0.3):
    """A stand-in each of whose verdicts differs with a known probability from that under nominal conditions."""
    design, _ = task
    bits = np.random.default_rng(int(hashlib.sha256(design.digest().encode()).hexdigest()[:12], 16)).random(3)
    raw = [one["held"] for one in steady(task)["objects"].values()]
    return result_of([bool(one) ^ bool(bit < rate) for one, bit in zip(raw, bits)], features_of(design))


def must_not_run(task, *, progress=None):
    raise AssertionError("it was evaluated before")


def object_gone(task, *, progress=None):
    raise InputError("there is no such file", where="part.stl")


def fragile(task, *, progress=None):
    """A stand-in that fails with less friction."""
    design, _ = task
    if design.protocol.friction_coefficient < 0.6:
        raise ValueError("does not converge")
    return steady(task)


class Log:
    """Stands for a run's log."""

    def __init__(self, run, room=10**9):
        self.run, self.room = run, room

    def append_recheck(self, row):
        if len(self.run.rows) >= self.room:
            raise KeyboardInterrupt
        self.run.rows.append(row)

    def found(self, digest, preset, objects):
        assert objects == OBJECTS
        same = [r for _, r in self.run.elites() if (r["design_digest"], r["preset"]) == (digest, preset)]
        return same[0] if same else None


def run_of(count):
    """Return a run of so many elites, evaluated by `steady`."""
    archive = new_archive(28, AXES, cells=40, seed=np.random.SeedSequence(0))
    elites = []
    for i, unit in enumerate(qmc.Sobol(28, scramble=True, seed=0).random(8)[:count]):
        design = Design.from_unit_vector(unit, **BASE)
        result = steady((design, "draft"))
        (cell,) = archive.int_to_grid_index([archive.index_of_single(list(result["features"].values()))]).tolist()
        elites.append((tuple(cell), plain({
            **result, "index": 3 * i, "unit": unit, "preset": "draft", "status": "ok", "reason": "",
            "design_digest": design.digest(), "objective": objective(result["fitness"], 0.25, 3),
        })))
    assert len({cell for cell, _ in elites}) == count
    rows = []
    return SimpleNamespace(base=BASE, ranges=AXES, settings={"objects": OBJECTS}, rows=rows,
                           elites=lambda: elites, rechecks=lambda: tuple(rows), archive=lambda: archive)


def rechecked(run, evaluate, *, count=4, room=10**9, kind="inline", **options):
    with open_workers(kind, jobs=2) as workers:
        return recheck_run(run, Log(run, room), count=count, workers=workers, call=evaluate, where="RUN", **options)


def test_without_a_perturbation_the_raw_numbers_come_again_and_nothing_is_evaluated():
    run = run_of(4)
    found = rechecked(run, must_not_run, scheme=Scheme(ranges=NOTHING))
    assert found.complete and found.corrected == found.raw and found.raw["coverage"] == 4 / 1600
    assert all(one.corrected == one.raw and one.flips.rate == 0.0 and one.keeps.rate == 1.0 for one in found.elites)
    assert all(row["features"] == record["features"] and row["objects"] == record["objects"]
               for row in run.rows for _, record in run.elites() if record["index"] == row["index"])


def test_conditions_that_change_no_verdict_give_the_raw_numbers_exactly():
    run = run_of(4)
    found = rechecked(run, steady)
    assert found.complete and found.corrected == found.raw and len(run.rows) == 16
    assert len({row["design_digest"] for row in run.rows}) == 16


def test_rows_say_what_was_done():
    run, scheme = run_of(2), Scheme(seed=5, ranges={"mesh_size": None})
    rechecked(run, steady, count=3, scheme=scheme)
    assert [(row["index"], row["number"]) for row in run.rows] == [(i, k) for k in range(3) for i in (0, 3)]
    for row in run.rows:
        assert row["perturbation"] == scheme.draw(3)[row["number"]] and "mesh_size" not in row["perturbation"]
        assert row["scheme"] == scheme.to_dict() and row["preset"] == "draft" and row["status"] == "ok"


def test_a_known_rate_of_flips_is_found_within_its_interval():
    found = rechecked(run_of(4), partial(flipping, rate=0.3), count=32)
    by_object, by_elite = ([one.flips for one in ones] for ones in (found.objects, found.elites))
    assert sum(one.part for one in by_object) == sum(one.part for one in by_elite)
    low, high = Share(part=sum(one.part for one in by_elite), whole=4 * 32 * 3).interval
    assert low < 0.3 < high and high - low < 0.1
    assert all(one.rate == pytest.approx(0.3, abs=0.15) for one in (*by_object, *by_elite))
    assert found.corrected["qd_score"] < found.raw["qd_score"]


def test_an_interrupted_recheck_goes_on_to_the_same_rows():
    whole, pieces = run_of(3), run_of(3)
    expected = rechecked(whole, flipping, count=5)
    for room in (4, 10):
        with pytest.raises(KeyboardInterrupt):
            rechecked(pieces, flipping, count=5, room=room)
        assert len(pieces.rows) == room and not trust_of(pieces).complete
    assert rechecked(pieces, flipping, count=5).to_dict() == expected.to_dict()
    assert pieces.rows == whole.rows
    assert rechecked(pieces, must_not_run, count=5).to_dict() == trust_of(pieces).to_dict() == expected.to_dict()


def test_more_rechecks_keep_the_first_ones_and_another_seed_begins_anew():
    run = run_of(2)
    rechecked(run, steady, count=2)
    first = list(run.rows)
    rechecked(run, steady, count=6)
    assert run.rows[:4] == first and len(run.rows) == 12
    found = rechecked(run, steady, count=2, scheme=Scheme(seed=9))
    assert len(run.rows) == 16 and found.complete and trust_of(run).scheme["seed"] == 9


def test_processes_give_the_same_rows():
    here, there = run_of(2), run_of(2)
    assert rechecked(here, flipping).to_dict() == rechecked(there, flipping, kind="processes").to_dict()
    order = {(row["index"], row["number"]): row for row in there.rows}
    assert [order[row["index"], row["number"]] for row in here.rows] == here.rows


def test_failures_are_rows_with_their_reason_and_count_as_nothing_held():
    run = run_of(2)
    found = rechecked(run, fragile, count=8)
    failed = [row for row in run.rows if row["status"] == "error"]
    assert 0 < len(failed) < 16 and all(row["reason"] == "ValueError: does not converge" for row in failed)
    assert all(row["perturbation"]["friction"] < 1 for row in failed)
    assert sum(one.failed for one in found.elites) == len(failed)
    assert found.corrected["qd_score"] < found.raw["qd_score"]


def test_what_is_no_fault_of_the_design_s_is_one_sentence_and_not_written():
    run = run_of(2)
    with pytest.raises(InputError, match="^part.stl: there is no such file$"):
        rechecked(run, object_gone)
    assert run.rows == []


def test_a_run_of_another_finger_is_refused():
    run = run_of(1)
    run.elites()[0][1]["design_digest"] = "f" * 64
    with pytest.raises(InputError, match="RUN: evaluation 0 is another design now: the finger type or its defaults"):
        rechecked(run, steady)


@pytest.mark.parametrize("count", [0, 1.5, True])
def test_a_bad_number_gets_one_sentence(count):
    with pytest.raises(InputError, match="recheck: must be a whole number from 1 upwards, got"):
        rechecked(run_of(1), steady, count=count)


def test_a_run_without_elites_gets_one_sentence():
    run = run_of(1)
    run.elites().clear()
    assert trust_of(run) is None
    with pytest.raises(InputError, match="^RUN: has no elite to recheck$"):
        rechecked(run, steady)


def test_progress_is_told():
    seen = []
    rechecked(run_of(2), steady, count=2, progress=lambda text, fraction: seen.append((text, fraction)))
    assert seen == [("4 rechecks", 0.25), ("4 rechecks", 0.5), ("4 rechecks", 0.75), ("4 rechecks", 1.0)]


# a run's folder, and the command --------------------------------------------------------------------------------------


class Found:
    """What evaluations return, see `finqd.evaluate.Evaluation`."""

    def __init__(self, design, preset):
        result = steady((design, preset))
        self.fitness, self.margin, self.features = result["fitness"], result["margin"], result["features"]
        self.objects = result["objects"]

    def to_dict(self):
        return {"objects": self.objects}


def evaluate(design, *, objects, preset, jobs, progress):
    assert objects == OBJECTS and jobs == 1
    for name in objects:
        progress(name, 1.0)
    return Found(design, preset)


@pytest.fixture
def folder(tmp_path):
    """A run of two elites on disk."""
    settings = {"objects": OBJECTS, "cells": 40, "preset": "draft"}
    with RunLog.start(
        tmp_path / "run", settings=settings, base=BASE, parameters=design_parameters(), ranges=AXES
    ) as log:
        for number, (_, record) in enumerate(run_of(2).elites()):
            log.append({**record, "index": number, "versions": versions()})
        log.note_told(2)
    return tmp_path / "run"


def test_a_folder_is_rechecked_and_what_it_says_is_beside_its_log(folder):
    seen = []
    found = recheck(folder, count=3, kind="inline", evaluate=evaluate, progress=lambda *call: seen.append(call))
    assert json.loads((folder / "recheck.json").read_text()) == json.loads(json.dumps(found.to_dict()))
    assert found.complete and found.corrected == found.raw and seen[-1] == ("6 rechecks", 1.0)


def test_a_folder_that_is_stopped_goes_on_to_the_same_rows(folder, tmp_path):
    expected = recheck(folder, count=3, kind="inline", evaluate=evaluate)
    whole = read_run(folder).rechecks()
    again = tmp_path / "again"
    shutil.copytree(folder, again)
    with sqlite3.connect(again / "run.sqlite") as connection:
        connection.execute("DELETE FROM rechecks WHERE id > 2")
    connection.close()
    assert len(read_run(again).rechecks()) == 2
    assert recheck(again, count=3, kind="processes", evaluate=evaluate).to_dict() == expected.to_dict()
    timeless = [[{**row, "seconds": 0} for row in sorted(rows, key=lambda row: (row["number"], row["index"]))]
                for rows in (whole, read_run(again).rechecks())]
    assert timeless[0] == timeless[1] and len(whole) == 6


def test_nominal_conditions_are_found_in_the_log_of_the_search(folder):
    found = recheck(folder, count=2, kind="inline", evaluate=None, scheme=Scheme(ranges=NOTHING))
    assert found.complete and found.corrected == found.raw and len(read_run(folder).rechecks()) == 4


@pytest.mark.parametrize(
    ("changed", "options", "sentence"),
    [
        ({"objects_digest": "0123456789abcdef"}, ["--other-versions"],
         "objects_digest was \"0123456789abcdef\" when this run began, and is "),
        ({"versions": {**versions_of(BASE), "numpy": "1.0"}}, [],
         'versions.numpy was "1.0" when this run began, and is '),
        ({"versions": {**versions_of(BASE), "numpy": "1.0"}}, ["--other-versions"], ""),
    ],
)  # fmt: skip
def test_what_was_searched_with_other_objects_or_versions_is_not_compared(
    folder, monkeypatch, changed, options, sentence
):
    monkeypatch.setattr("finqd.evaluate.evaluate", evaluate)
    with RunLog(folder) as log:
        log.change_settings({**log.run.settings, **changed})
    done = CliRunner().invoke(recheck_command, [str(folder), "-k", "1", "--workers", "inline", *options])
    rows = len(read_run(folder).rechecks())
    if sentence:
        assert isinstance(done.exception, InputError) and sentence in str(done.exception) and rows == 0
    else:
        assert done.exit_code == 0 and rows == 2, done.output


def test_the_command_says_what_came_of_it(folder, monkeypatch):
    monkeypatch.setattr("finqd.evaluate.evaluate", evaluate)
    options = ["-k", "2", "--workers", "inline", "--vary", "mesh_size=off"]
    done = CliRunner().invoke(recheck_command, [str(folder), *options])
    assert done.exit_code == 0, done.output
    assert "QD score: " in done.output and "coverage: 0.0013 as searched, 0.0013 corrected" in done.output
    assert "sphere" in done.output and "2 of 2" in done.output
    assert "mesh_size" not in json.loads((folder / "recheck.json").read_text())["scheme"]["ranges"]


@pytest.mark.parametrize(
    ("vary", "sentence"),
    [
        ("friction", "--vary: must be NAME=LOW:HIGH or NAME=off, as in friction=0.9:1.1, not 'friction'"),
        ("friction=1:2:3", "--vary: must be NAME=LOW:HIGH or NAME=off, as in friction=0.9:1.1, not 'friction=1:2:3'"),
        ("mu=1:2", "ranges.mu: nothing of this name is varied; known: friction, offset_x_mm, offset_y_mm, turn_deg, "
         "stiffness, time_step, mesh_size"),
    ],
)
def test_what_cannot_be_varied_gets_one_sentence(folder, vary, sentence):
    done = CliRunner().invoke(recheck_command, [str(folder), "--vary", vary])
    assert isinstance(done.exception, InputError) and str(done.exception) == sentence
    assert not (folder / "recheck.json").exists()
