"""The search with a cheap analytic evaluator and a finger type of our own: no simulation is needed to test it."""

from __future__ import annotations

import csv
import os
import time
from dataclasses import dataclass

import numpy as np
import pytest

from finqd import archive as qd
from finqd.algorithms import new_scheduler
from finqd.design import Design
from finqd.errors import InputError, MissingLibraryError
from finqd.runlog import RunLog, read_run
from finqd.search import optimise, reflected

BLADE = '''
from dataclasses import dataclass
from typing import ClassVar
import numpy as np
from finqd.contracts import Parameter
from finqd.solid import Prism

@dataclass(frozen=True)
class Blade:
    """A slab that is no fin ray."""

    finger_parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(name="length", unit="mm", low=60, high=100, allowed_low=10, allowed_high=200),
        Parameter(name="layer_count", unit="", low=1, high=4, allowed_low=1, allowed_high=4, integer=True),
    )

    def check(self, finger):
        long = finger["layer_count"] == 1 and finger["length"] > 0.085
        return "length_mm must stay below 85 with one layer" if long else None

    def build(self, finger):
        x, y = 0.005 * finger["layer_count"], finger["length"]
        return Prism(np.array([[0, 0], [x, 0], [x, y], [0, y]]), (), 0.02, np.array([[0, 0], [0, y]]))
'''
RANGES = {"workspace_mm2": (1169.0, 2079.0), "volume_mm3": (20e3, 130e3)}
NAMES = ("cube", "disk", "pasta", "sphere")


@dataclass
class FakeEvaluation:
    fitness: float
    margin: float
    features: dict
    objects: dict

    def to_dict(self):
        return {"objects": self.objects}


def fake_evaluate(design, *, objects, preset, jobs, progress):
    """Better towards one corner of the cube; four objects, of which some are held."""
    assert jobs == 1 and preset == "standard"
    quality = float(np.mean(1.0 - (design.to_unit_vector() - 0.7) ** 2)) - 0.72
    margins = [float(np.clip(20 * quality - i, -1, 1)) for i in range(len(NAMES))]
    rows = {name: {"status": "ok", "held": m > 0, "margin": m} for name, m in zip(NAMES, margins)}
    for name in NAMES:
        progress(name, 1.0)
    held = sum(row["held"] for row in rows.values())
    return FakeEvaluation(held / len(NAMES), float(np.mean(margins)), qd.measure_features(design), rows)


def number_of(design):
    return int(design.name.rpartition(" ")[2])


def troubled_evaluate(design, **options):
    """Every way to fail, by the number of the evaluation; what is left over is fine."""
    found = fake_evaluate(design, **options)
    match number_of(design):
        case 0:
            os._exit(9)
        case 1:
            time.sleep(120)
        case 2:
            raise RuntimeError("mesh with holes")
        case 3:
            found.fitness = float("nan")
        case 4:
            found.margin = float("inf")
        case 5:
            found.objects = {name: {"status": "diverged", "reason": "at 0.3 s"} for name in NAMES}
        case 6:
            found.features["volume_mm3"] = float("nan")
        case 7:
            del found.features["workspace_mm2"]
        case 8:
            found.objects["cube"] |= {"status": "diverged", "held": False}  # one of four: still a design to rank
    return found


def late_evaluate(design, **options):
    """Nothing works in the first round."""
    if number_of(design) < 4:
        raise RuntimeError("cold")
    return fake_evaluate(design, **options)


def never_evaluate(design, **options):
    raise RuntimeError("never")


def refusing_evaluate(design, **options):
    raise InputError("has a hole", where="mine.stl")


def lacking_evaluate(design, **options):
    raise MissingLibraryError("gmsh needs libGLU; install libglu1-mesa")


@pytest.fixture
def base(make_distribution):
    make_distribution("blades", {"geometry": {"blade": "blade_of_ours:Blade"}}, module="blade_of_ours", source=BLADE)
    return Design.from_vector([80, 2] * 3 + [35], geometry="blade", material={"youngs_modulus_MPa": 5})


@pytest.fixture
def search(base, tmp_path):
    """Return `optimise` with short defaults."""

    def run(out="out", **options):
        defaults = {"evaluate": fake_evaluate, "iterations": 2, "batch": 6, "ranges": RANGES, "cells": 6}
        return optimise(out=tmp_path / out, base_design=base, **{**defaults, **options})

    return run


def table(folder):
    with (folder / "archive.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_search_of_a_foreign_finger_writes_everything(search, tmp_path):
    seen = []
    result = search(iterations=3, jobs=2, progress=lambda name, fraction: seen.append((name, fraction)))
    run = read_run(tmp_path / "out")
    log = run.records()
    assert [record["index"] for record in log] == list(range(18)) and log == result.records
    assert all(line["iteration"] == line["index"] // 6 for line in log)
    first = log[0]
    assert {"unit", "parameters", "design_digest", "fitness", "margin", "objective", "features", "objects"} < set(first)
    assert {"status", "reason", "seconds", "seed", "versions", "emitter", "host", "preset", "attempts"} < set(first)
    assert list(first["parameters"])[:2] == ["fingers[0].length_mm", "fingers[0].layer_count"]
    assert set(first["objects"]) == set(NAMES) and first["versions"]["ribs"].startswith("0.")

    rows = table(tmp_path / "out")
    assert len(rows) == len(result.elites) == result.archive.stats.num_elites > 3
    for row, (cell, record) in zip(rows, result.elites):
        assert (int(row["cell_workspace_mm2"]), int(row["cell_volume_mm3"])) == cell
        design = Design.from_json(tmp_path / f"out/elites/cell_{cell[0]:02d}_{cell[1]:02d}.json")
        assert design.digest() == row["design_digest"] == record["design_digest"]
        assert float(row["spacing_mm"]) == pytest.approx(design.spacing_mm) and design.material.youngs_modulus == 5e6
        assert qd.measure_features(design)["volume_mm3"] == pytest.approx(float(row["volume_mm3"]))
    assert len(os.listdir(tmp_path / "out/elites")) == len(rows)

    assert run.settings["seed"] == 0 and run.settings["algorithm"] == "cma_me" and run.settings["preset"] == "standard"
    assert [path for path, _ in run.parameters][1] == "fingers[0].layer_count" and run.parameters[1][1].integer
    assert run.ranges == RANGES and run.base["geometry"] == "blade" and run.elites() == result.elites
    times = [record["finished_at"] for record in log]
    assert all(time > 0 for time in times) and max(times[:6]) <= min(times[6:])
    lines = (tmp_path / "out/progress.log").read_text().splitlines()
    assert "18 of 18 designs, coverage" in lines[-1] and "0 failed" in lines[-1]
    for picture in ("heatmap", "coverage", "qd_score"):
        assert (tmp_path / f"out/{picture}.png").read_bytes()[:4] == b"\x89PNG"
    assert seen[-1] == ("iteration 3 of 3", 1.0) and all(0 < fraction <= 1 for _, fraction in seen)


def test_the_same_seed_gives_the_same_archive_with_one_and_two_jobs(search, tmp_path):
    for name, options in {"one": {}, "two": {"jobs": 2}, "other": {"seed": 1}}.items():
        search(name, **options)
    one, two, other = ((tmp_path / name / "archive.csv").read_bytes() for name in ("one", "two", "other"))
    assert one == two != other
    one, two = (read_run(tmp_path / name).records() for name in ("one", "two"))
    varying = {"seconds": 0, "finished_at": 0}
    assert [{**line, **varying} for line in one] == [{**line, **varying} for line in two]


def test_failures_are_logged_with_their_reason_and_never_become_elites(search, tmp_path):
    result = search(evaluate=troubled_evaluate, iterations=1, batch=12, jobs=2, time_limit_s=4.0)
    records = result.records
    reasons = {record["index"]: (record["status"], record["reason"]) for record in records}
    assert {index: reasons[index] for index in range(8)} == {
        0: ("crash", "the worker process ended with exit code 9"),
        1: ("timeout", "stopped after its time limit of 4.0 s"),
        2: ("error", "RuntimeError: mesh with holes"),
        3: ("failed", "fitness is nan"),
        4: ("failed", "margin is inf"),
        5: ("failed", "no simulation finished; cube: at 0.3 s"),
        6: ("failed", "volume_mm3 is nan"),
        7: ("failed", "workspace_mm2 is None"),
    }
    assert all(record["objective"] == qd.PENALTY for record in records if record["status"] != "ok")
    fine = {record["index"] for record in records if record["status"] == "ok"}
    assert 8 in fine
    assert {record["index"] for _, record in result.elites} <= fine and result.elites
    assert len(read_run(tmp_path / "out").records()) == 12
    assert [record["attempts"] for record in records][:3] == [2, 1, 1]  # only a crash may come from elsewhere
    assert result.archive.stats.coverage == len(result.elites) / 36


def test_values_that_contradict_each_other_are_logged_and_cost_nothing(search):
    result = search(iterations=2, batch=16, seed=3)
    invalid = [record for record in result.records if record["status"] == "invalid"]
    assert 0 < len(invalid) < 16  # about one in ten has a finger that is too long for one layer
    assert all("length_mm must stay below 85" in record["reason"] for record in invalid)
    assert all(record["fitness"] is None and record["seconds"] is None for record in invalid)


@pytest.mark.parametrize("batch", [1, 4])
def test_a_search_in_which_nothing_works_ends_with_an_empty_archive(search, tmp_path, batch):
    result = search(evaluate=never_evaluate, batch=batch)
    assert result.archive.empty and result.elites == [] and len(result.records) == 2 * batch
    assert (tmp_path / "out/archive.csv").read_text().startswith("cell_workspace_mm2,")
    assert table(tmp_path / "out") == []
    assert (tmp_path / "out/heatmap.png").exists()
    assert len({tuple(record["unit"]) for record in result.records}) == 2 * batch  # not the same designs again


def test_a_search_recovers_from_a_first_round_in_which_nothing_works(search):
    result = search(evaluate=late_evaluate, iterations=3, batch=4)
    assert result.elites and all(record["index"] >= 4 for _, record in result.elites)


def test_an_interrupted_search_leaves_log_archive_and_pictures(search, tmp_path):
    def stop(name, fraction):
        if name == "iteration 2 of 3" and fraction > 0.4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search(iterations=3, jobs=2, progress=stop)
    run = read_run(tmp_path / "out")
    assert len(run.records()) == 6
    with RunLog(tmp_path / "out") as log:
        known = log.evaluations(0, 18)
    assert 6 < len(known) < 12  # what was finished of the second round is kept
    rows = table(tmp_path / "out")
    assert rows and {int(row["evaluation"]) for row in rows} <= set(range(6))  # what was told, nothing half told
    assert (tmp_path / "out/heatmap.png").exists() and len(os.listdir(tmp_path / "out/elites")) == len(rows)
    assert not [path for path in (tmp_path / "out").iterdir() if path.name.endswith(".part")]


@pytest.mark.parametrize(("wrong", "error"), [(refusing_evaluate, InputError), (lacking_evaluate, MissingLibraryError)])
def test_what_is_wrong_for_every_design_is_raised_not_searched(search, tmp_path, wrong, error):
    with pytest.raises(error, match="hole|libGLU"):
        search(evaluate=wrong, batch=3)
    assert read_run(tmp_path / "out").records() == ()  # nothing was found out about a design


# objective, archive, scheduler ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 10, 137])
def test_the_margin_orders_designs_but_never_outweighs_an_object(n):
    for held in range(n):
        assert qd.objective(held / n, 1.0, n) < qd.objective((held + 1) / n, -1.0, n)
        assert qd.objective(held / n, 0.1, n) > qd.objective(held / n, 0.0, n)
    assert qd.objective(0.0, -1.0, n) == 0.0 > qd.THRESHOLD_MIN > qd.PENALTY
    assert qd.objective(0.5, 99.0, n) == qd.objective(0.5, 1.0, n)


def record(index, objective, *, volume=50e3, workspace=1500.0, status="ok"):
    features = {"workspace_mm2": workspace, "volume_mm3": volume}
    return {"index": index, "objective": objective, "features": features, "status": status}


def archive_and_scheduler(batch):
    archive = qd.new_archive(3, RANGES, cells=5, seed=np.random.SeedSequence(0))
    return archive, new_scheduler("cma_me", archive, batch, np.random.SeedSequence(1))


def test_ties_keep_the_first_and_a_worse_design_never_replaces_an_elite():
    """Two designs of one batch in a cell, 0.8 and 0.6; a later 0.75 lies between their mean and the elite."""
    archive, scheduler = archive_and_scheduler(3)
    scheduler.ask()
    qd.tell(scheduler, [record(0, 0.8), record(1, 0.6), record(2, 0.8)], RANGES)
    assert archive.data("evaluation").tolist() == [0]
    scheduler.ask()
    qd.tell(scheduler, [record(3, 0.75), record(4, 0.8), record(5, qd.PENALTY, status="failed")], RANGES)
    assert archive.data("evaluation").tolist() == [0]


@pytest.mark.slow  # ribs compiles what only this needs
def test_added_as_a_batch_a_worse_design_would_replace_an_elite():
    """The wrong twin of the test above: why the scheduler adds one by one."""
    twin, wrong = archive_and_scheduler(3)
    wrong._add_mode = "batch"
    wrong.ask()
    qd.tell(wrong, [record(0, 0.8), record(1, 0.6), record(2, 0.8)], RANGES)
    wrong.ask()
    qd.tell(wrong, [record(3, 0.75), record(4, 0.0), record(5, qd.PENALTY)], RANGES)
    assert twin.data("evaluation").tolist() == [3]


def test_nothing_held_is_a_result_and_fills_a_cell_but_a_failure_does_not():
    archive, scheduler = archive_and_scheduler(2)
    scheduler.ask()
    qd.tell(scheduler, [record(0, 0.0), record(1, qd.PENALTY, volume=float("nan"), status="failed")], RANGES)
    assert archive.data("evaluation").tolist() == [0]


def test_the_curves_end_where_the_archive_does(search):
    result = search(iterations=3)
    coverage, score = qd.curves(result.archive, result.records, result.ranges)
    assert len(coverage) == len(score) == 18 and np.all(np.diff(coverage) >= 0) and np.all(np.diff(score) >= -1e-12)
    assert coverage[-1] == pytest.approx(result.archive.stats.coverage)
    assert score[-1] == pytest.approx(result.archive.stats.qd_score)


def test_all_designs_lie_in_the_cube_even_from_a_corner(search):
    """ribs' own bounds never return from a corner of a space with 28 dimensions: half of each sample lies outside."""
    archive = qd.new_archive(28, RANGES, cells=5, seed=np.random.SeedSequence(0))
    scheduler = new_scheduler("cma_me", archive, 4, np.random.SeedSequence(1))
    scheduler.emitters[0]._opt.reset(np.zeros(28))
    units = scheduler.ask()
    assert np.all((units >= 0) & (units <= 1)) and units.std() > 0.05
    wild = np.random.default_rng(0).normal(0.5, 3.0, 1000)
    assert np.all((reflected(wild) >= 0) & (reflected(wild) <= 1))
    inside = np.linspace(0, 1, 101)
    assert np.array_equal(reflected(inside), inside)
    assert all(0 <= u <= 1 for record in search().records for u in record["unit"])


def test_whole_numbers_are_uniform_over_the_cube(base):
    units = (np.arange(40) + 0.5) / 40
    counts = [Design.from_unit_vector([0.5, u] * 3 + [0.5], geometry="blade").fingers[0]["layer_count"] for u in units]
    assert np.bincount(np.array(counts, dtype=int)).tolist() == [0, 10, 10, 10, 10]


def test_the_ranges_follow_from_the_geometry(base):
    def decode(unit):
        return Design.from_unit_vector(unit, **base.settings)

    ranges = qd.feature_ranges(decode, 7)
    assert list(ranges) == ["workspace_mm2", "volume_mm3"]
    assert ranges["workspace_mm2"] == pytest.approx((1169.134, 2078.461), abs=1e-3)  # 3 sqrt(3)/4 of 30^2 and 40^2
    low, high = ranges["volume_mm3"]
    plates = 2.75 * 1169.134, 2.75 * 2078.461
    assert 3 * 60 * 5 * 20 + plates[0] <= low < 40e3 and 80e3 < high <= 3 * 100 * 20 * 20 + plates[1]

    def nothing(unit):
        raise InputError("no")

    with pytest.raises(InputError, match=r"geometry: none of 256 sampled designs is valid \(no\)"):
        qd.feature_ranges(nothing, 7)


def test_a_feature_that_does_not_vary_still_has_an_axis():
    low, high = qd._widened(np.full(10, 3.0))
    assert low < 3.0 < high and qd._widened(np.zeros(4))[0] < 0 < qd._widened(np.zeros(4))[1]


# bad input ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"batch": 0}, "batch: must be a whole number from 1 upwards, got 0"),
        ({"iterations": -1}, "iterations: must be a whole number from 1 upwards, got -1"),
        ({"iterations": 2.5}, "iterations: must be a whole number from 1 upwards, got 2.5"),
        ({"seed": -3}, "seed: must be a whole number from 0 upwards, got -3"),
        ({"cells": 0}, "cells: must be a whole number from 1 upwards, got 0"),
        ({"jobs": 0}, "jobs: must be a whole number from 1 upwards, got 0"),
        ({"time_limit_s": -1.0}, "time_limit_s: must be a positive number of seconds, got -1.0"),
        ({"preset": "best"}, "preset: there is no preset 'best'; known: draft, standard, fine"),
        ({"objects": ["banana"]}, '"banana": no object has this name; known: cube, '),
        ({"objects": []}, "objects: no object"),
        ({"objects": ["cube", "cube"]}, "objects: each object once, please: cube"),
        ({"ranges": {"volume_mm3": (5.0, 5.0)}}, "ranges.volume_mm3: must be a low and a higher number, got 5.0 and"),
    ],
)
def test_bad_options_get_one_sentence_and_no_folder(search, tmp_path, options, sentence):
    with pytest.raises(InputError) as error:
        search(**options)
    assert str(error.value).startswith(sentence) and "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_is_left_alone(search, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/evaluations.jsonl").write_text("dear to me\n")
    with pytest.raises(InputError, match="out: is not empty, and holds no run to go on with; name a new folder"):
        search()
    assert os.listdir(tmp_path / "out") == ["evaluations.jsonl"]
    assert (tmp_path / "out/evaluations.jsonl").read_text() == "dear to me\n"


def test_a_folder_that_cannot_be_is_refused(search, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write to this folder"):
        search(tmp_path / "file" / "out")
