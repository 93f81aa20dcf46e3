"""The page of a search says what its log says, whatever the log holds, and nothing in a log can act on the page."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re

import numpy as np
import pytest
from synthetic_run import OBJECTS, PARAMETERS, SyntheticRun, synthetic_record, synthetic_run

from finqd import archive as qd
from finqd.data import designs_folder
from finqd.design import Design
from finqd.errors import InputError
from finqd.export import gripper_parts
from finqd.report import choose, design_of, designs_shown, elapsed, pareto_front, report_data, write_report
from finqd.report_shapes import packed, shapes_of, unpacked
from finqd.sensitivity import sensitivity

HOSTILE = '</script><img src=x onerror="document.title=1"><!-- &amp; {{script}}'


@pytest.fixture(scope="module")
def run() -> SyntheticRun:
    return synthetic_run(60, cells=6)


@pytest.fixture(scope="module")
def data(run):
    return report_data(run, name="a run")


def embedded(page: str, name: str):
    """Return the JSON that a page carries."""
    return json.loads(re.search(f'<script type="application/json" id="{name}">(.*?)</script>', page, re.DOTALL)[1])


def written(run, tmp_path, **options):
    write_report(run, tmp_path / "page.html", name=options.pop("name", "a run"), argument="RUN", **options)
    return (tmp_path / "page.html").read_text(encoding="utf-8")


# the numbers ----------------------------------------------------------------------------------------------------------


def test_the_numbers_on_the_page_are_those_of_the_log(run, data):
    records, archive = run.records(), run.archive()
    ok = [record for record in records if record["status"] == "ok"]
    said = data["summary"]
    assert said["evaluations"] == 60 and said["failed"] == 60 - len(ok) > 0
    assert said["elites"] == archive.stats.num_elites and said["coverage"] == archive.stats.coverage
    assert said["qd_score"] == pytest.approx(archive.stats.qd_score, rel=1e-12)
    assert said["best_fitness"] == max(record["fitness"] for record in ok)
    by_index = {record["index"]: record for record in records}
    elites = {record["index"]: cell for cell, record in run.elites()}
    assert {d["index"] for d in data["designs"] if d["elite"]} == set(elites)
    for d in data["designs"]:
        record = by_index[d["index"]]
        assert (d["fitness"], d["margin"], d["features"]) == (record["fitness"], record["margin"], record["features"])
        assert d["parameters"] == list(record["parameters"].values())
        for name, row in record["objects"].items():
            assert d["objects"][name]["held"] == row["held"] and d["objects"][name]["drop_mm"] == row["drop_mm"]
        if d["elite"]:
            assert tuple(d["cell"]) == elites[d["index"]]
        file = Design.from_json(d["file"])
        assert file.to_vector().tolist() == pytest.approx(d["parameters"]) and file == design_of(run, record)


def test_the_curves_are_those_of_the_archive_and_keep_every_change(run, data):
    coverage, score = qd.curves(run.archive(), run.records(), run.ranges)
    found = data["curves"]
    at = np.searchsorted(found["evaluations"], np.arange(1, 61), side="right") - 1
    assert np.array(found["coverage"])[at] == pytest.approx(coverage, abs=1e-7)
    assert np.array(found["score"])[at] == pytest.approx(score, abs=1e-7)
    assert found["evaluations"][-1] == 60 and found["seconds"][-1] == 60 * 31.0
    assert found["iterations"] == [15, 30, 45]


def test_a_result_counts_once_all_told_before_it_are_in():
    records = [{"finished_at": t, "seconds": 1.0} for t in (5.0, 2.0, 9.0)]
    assert elapsed(records) == [5.0, 5.0, 9.0]
    assert elapsed([{**records[0], "finished_at": None}, *records[1:]]) == [1.0, 2.0, 3.0]


def test_no_design_beats_the_front(run, data):
    ok = [record for record in run.records() if record["status"] == "ok"]
    front = pareto_front(ok, "volume_mm3")
    assert [r["index"] for r in front] == data["pareto"]["front"] and len(front) > 1
    for record in ok:
        volume, fitness = record["features"]["volume_mm3"], record["fitness"]
        assert any(f["features"]["volume_mm3"] <= volume and f["fitness"] >= fitness for f in front)
    for f in front:
        others = [r for r in ok if r["features"]["volume_mm3"] <= f["features"]["volume_mm3"] and r is not f]
        assert all(r["fitness"] < f["fitness"] for r in others)
    assert set(data["pareto"]["front"]) <= {d["index"] for d in data["designs"]}
    assert len(data["pareto"]["cloud"]["x"]) == len(ok)


def test_the_designs_chosen_for_the_table_are_what_they_are_called():
    def design(index, objective, volume, workspace=1500.0):
        features = {"volume_mm3": volume, "workspace_mm2": workspace}
        return {"index": index, "fitness": round(objective, 1), "objective": objective, "features": features,
                "objects": dict.fromkeys(OBJECTS)}  # fmt: skip

    designs = [design(0, 0.909, 60e3), design(1, 0.901, 50e3), design(2, 0.801, 40e3), design(3, 0.902, 70e3, 2000.0)]
    assert choose(designs, "volume_mm3", None) == [
        {"index": 0, "why": "best"}, {"index": 1, "why": "lightest of those that hold the most"},
        {"index": 2, "why": "lightest with one object fewer"},
        {"index": 3, "why": "widest of those that hold the most"},
    ]
    known = choose(designs, "volume_mm3", {"fitness": 0.9})
    assert known[1] == {
        "index": 1, "why": "lightest of those that hold the most; lightest that holds as many as the benchmark"
    }
    assert choose([], "volume_mm3", None) == []


def test_failures_that_differ_by_a_number_are_counted_together(run, data):
    failed = [record for record in run.records() if record["status"] != "ok"]
    assert sum(row["count"] for row in data["failures"]) == len(failed)
    late = next(row for row in data["failures"] if row["status"] == "timeout")
    first = next(record for record in failed if record["status"] == "timeout")
    assert late["first_index"] == first["index"] and late["reason"] == first["reason"]
    assert late["count"] == sum(record["status"] == "timeout" for record in failed)


def test_rechecks_are_summed_up_by_elite(tmp_path):
    pytest.importorskip("finqd.trust")
    run = synthetic_run(30, cells=4, rechecked=3)
    found = report_data(run, name="a")["rechecks"]
    assert len(found["elites"]) == 3 and found["rows"] == 9 and found["count"] == 3 and found["of"] == len(run.elites())
    index, one = next(iter(found["elites"].items()))
    rows = [row for row in run.rechecks() if row["index"] == int(index)]
    record = run.records()[int(index)]
    verdicts = [(row["objects"][name]["held"], record["objects"][name]["held"]) for row in rows for name in OBJECTS]
    assert one["success"]["rate"] == pytest.approx(np.mean([now for now, _ in verdicts]))
    assert one["flips"]["rate"] == pytest.approx(np.mean([now != then for now, then in verdicts]))
    objectives = [run.records()[int(i)]["objective"] for i in found["elites"]]
    assert found["raw"]["qd_score"] == pytest.approx(math.fsum(objectives))


def test_screening_and_confirmation_are_compared_and_only_what_is_confirmed_is_on_the_front():
    run = synthetic_run(20, cells=4)
    ok = [record for record in run.told if record["status"] == "ok"]
    for record in ok[::2]:
        rows = {name: {**row, "held": not row["held"] if name == "cube" else row["held"]}
                for name, row in record["objects"].items()}  # fmt: skip
        record["screen"] = {"status": "ok", "fitness": record["fitness"] + 0.1, "objects": rows, "preset": "draft"}
    for record in ok[1::2]:
        record |= {"preset": "draft", "fitness": 1.0, "objective": 1e-3}  # only screened, and better than it is
    run.confirm = "standard"
    data = report_data(run, name="a")
    n = len(ok[::2])
    assert data["screening"] == {"confirmed": n, "other_fitness": n, "verdicts": 10 * n, "flipped": n}
    assert set(data["pareto"]["front"]) <= {record["index"] for record in ok[::2]}
    assert [(row["preset"], row["role"]) for row in data["presets"]] == [
        ("draft", "screening"), ("standard", "confirmation")
    ]
    assert report_data(synthetic_run(3), name="a")["screening"] is None


# sensitivity ----------------------------------------------------------------------------------------------------------


def test_sensitivity_finds_what_matters_and_says_how_much_is_chance():
    random = np.random.default_rng(0)
    units = random.random((400, 3))
    records = [
        {"status": "ok", "objective": float(np.exp(3 * u[0]) - 2 * u[1]), "parameters": dict(zip("abc", u.tolist()))}
        for u in units
    ]
    found = sensitivity(records, ["a", "b", "c"])
    rows = {row["path"]: row for row in found["rows"]}
    assert [row["path"] for row in found["rows"]][0] == "a" and rows["a"]["rank_correlation"] > 0.9
    assert rows["b"]["rank_correlation"] < -found["chance"] and abs(rows["c"]["rank_correlation"]) < 2 * found["chance"]
    assert rows["a"]["regression"] > 0.9 and 0.9 < found["explained"] <= 1.0
    from scipy.stats import spearmanr

    expected = spearmanr(units[:, 1], [record["objective"] for record in records]).statistic
    assert rows["b"]["rank_correlation"] == pytest.approx(expected)


def test_a_regression_tells_apart_what_correlation_cannot():
    """b goes with a, and only a acts: both are correlated with the fitness, one coefficient is near 0."""
    random = np.random.default_rng(1)
    a = random.random(600)
    b = a + 0.4 * random.random(600)
    pairs = zip(a.tolist(), b.tolist())
    records = [{"status": "ok", "objective": x, "parameters": {"a": x, "b": y}} for x, y in pairs]
    rows = {row["path"]: row for row in sensitivity(records, ["a", "b"])["rows"]}
    assert rows["b"]["rank_correlation"] > 0.8 and abs(rows["b"]["regression"]) < 0.05


def test_sensitivity_says_when_there_is_nothing_to_say():
    def records(n, objective=lambda i: float(i)):
        return [{"status": "ok", "objective": objective(i), "parameters": {"a": i, "b": 1.0}} for i in range(n)]

    assert "at least 4" in sensitivity(records(3), ["a", "b"])["missing"]
    assert "equally good" in sensitivity(records(9, lambda i: 0.5), ["a", "b"])["missing"]
    few = sensitivity(records(5), ["a", "b"])
    assert few["explained"] is None and {row["regression"] for row in few["rows"]} == {None}
    constant = next(row for row in few["rows"] if row["path"] == "b")
    assert constant["rank_correlation"] is None


# shapes ---------------------------------------------------------------------------------------------------------------


def test_a_shape_comes_back_closed_with_the_volume_of_its_parts():
    design = Design.from_json(designs_folder() / "benchmark.json")
    parts = gripper_parts(design)
    shape = packed(parts)
    points, triangles = unpacked(shape)
    assert [name for name, _ in shape["parts"]] == ["mount", "finger", "mount", "finger", "mount", "finger", "mount"]
    assert sum(count for _, count in shape["parts"]) == len(triangles)
    start, volumes = 0, []
    for _, count in shape["parts"]:
        some = triangles[start : start + count]
        edges = np.sort(np.concatenate([some[:, [0, 1]], some[:, [1, 2]], some[:, [2, 0]]]), axis=1)
        assert np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)  # closed
        a, b, c = np.moveaxis(points[some], 1, 0)
        volumes.append(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)
        start += count
    finger = design.plugin("geometry").build(design.finger_si(0)).volume * 1e9
    assert np.array(volumes)[[1, 3, 5]] == pytest.approx(finger, rel=2e-3) and min(volumes) > 0.0
    assert points[:, 2].min() == pytest.approx(-94.5, abs=0.01) and points[:, 2].max() == pytest.approx(2.75, abs=0.01)


def test_what_does_not_fit_is_missing_with_the_reason(run, data):
    wanted = designs_shown(data)
    assert wanted[0][0] == data["summary"]["best_index"]
    few = shapes_of(wanted, limit=2)
    assert list(few["shapes"]) == [str(index) for index, _ in wanted[:2]]
    assert few["missing"][str(wanted[2][0])] == "the page holds the shapes of the best 2 designs only (--shapes)"
    room = len(few["shapes"][str(wanted[0][0])]["data"]) + 10
    assert "fill the" in shapes_of(wanted[:2], budget=room)["missing"][str(wanted[1][0])]

    def broken():
        raise InputError("no")

    assert shapes_of([(5, broken)]) == {"shapes": {}, "missing": {"5": "the shape could not be built: no"}}
    many = np.zeros((70_000, 3))
    assert packed([("finger", many, np.array([[0, 1, 2]]))]) is None


def test_large_shapes_are_stored_coarser():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    shape = packed([("finger", points, triangles)])
    assert shape["step_mm"] == pytest.approx(1000 / 32767)
    assert unpacked(shape)[0] == pytest.approx(1000 * points, abs=0.02)


# the page -------------------------------------------------------------------------------------------------------------


def test_the_page_is_one_file_that_asks_for_nothing(run, data, tmp_path):
    page = written(run, tmp_path, shapes=3)
    carried = embedded(page, "data")
    assert {**carried, "made": ""} == json.loads(json.dumps({**data, "run_argument": "RUN", "made": ""}))
    assert len(embedded(page, "shapes")["shapes"]) == 3
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    links = re.findall(r"(?:src|href)\s*=\s*[\"']?([^\"'>]*)", markup)
    assert links and all(link.startswith(("#", "data:")) for link in links)
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "") and "https://" not in page
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', page)[1]
    assert policy.startswith("default-src 'none'; ")
    script = re.search(r"<script>(.*?)</script>", page, re.DOTALL)[1]
    style = re.search(r"<style>(.*?)</style>", page, re.DOTALL)[1]
    for kind, text in (("script", script), ("style", style)):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy


def test_hostile_names_are_text(tmp_path):
    run = synthetic_run(12, cells=4)
    for record in run.told:
        record["objects"] = {HOSTILE if name == "cube" else name: row for name, row in record["objects"].items()}
        record["reason"] = record["host"] = f"{HOSTILE}\u2028"
    run.base = {"description": HOSTILE}
    page = written(run, tmp_path, name=HOSTILE, shapes=0)
    assert page.count("<script") == 3 and page.count("</script>") == 3 and "<img" not in page and "<!--" not in page
    assert "&lt;/script&gt;&lt;img" in page  # the title
    carried = embedded(page, "data")
    assert carried["name"] == HOSTILE and HOSTILE in carried["objects"]
    assert json.loads(carried["designs"][0]["file"])["description"] == HOSTILE


def failed(index):
    return {**synthetic_record(index, np.full(28, 0.5)), "status": "error", "reason": "RuntimeError: never",
            "fitness": None, "margin": None, "objective": qd.PENALTY, "features": {}, "objects": {}}  # fmt: skip


@pytest.mark.parametrize(
    "records",
    [[], [failed(0)], [failed(i) for i in range(5)], [synthetic_record(0, np.full(28, 0.5))]],
    ids=["empty", "one failed", "all failed", "one"],
)
def test_a_run_with_next_to_nothing_in_it_has_a_page(records, tmp_path):
    page = written(SyntheticRun(records, cells=4), tmp_path)
    carried = embedded(page, "data")
    assert carried["summary"]["evaluations"] == len(records) and carried["rechecks"] is None
    good = [record for record in records if record["status"] == "ok"]
    assert len(carried["designs"]) == len(good) == len(carried["chosen"]) == len(embedded(page, "shapes")["shapes"])
    assert sum(row["count"] for row in carried["failures"]) == len(records) - len(good)
    assert carried["benchmark"]["command"].startswith("finqd evaluate benchmark --preset standard")
    assert carried["sensitivity"]["missing"]


@pytest.mark.parametrize("axes", [1, 3])
def test_maps_with_one_and_three_axes_have_a_page(axes, tmp_path):
    ranges = {"workspace_mm2": (1169.0, 2079.0), "volume_mm3": (35e3, 94e3), "finger_volume_mm3": (30e3, 90e3)}
    run = SyntheticRun([synthetic_record(i, unit) for i, unit in enumerate(np.random.default_rng(3).random((8, 28)))],
                       cells=3, ranges=dict(list(ranges.items())[:axes]))  # fmt: skip
    carried = embedded(written(run, tmp_path, shapes=0), "data")
    assert len(carried["axes"]) == axes == len(carried["designs"][0]["cell"])


def test_a_page_that_cannot_be_written_is_one_sentence(run, tmp_path):
    with pytest.raises(InputError, match="--out: cannot write to"):
        write_report(run, tmp_path / "no" / "page.html", name="a", argument="RUN")


def test_designs_that_the_installed_version_refuses_are_shown_without_file_and_shape(tmp_path):
    run = synthetic_run(8, cells=3)
    for record in run.told:
        if record["parameters"]:
            record["parameters"]["spacing_mm"] = 1e4
    page = written(run, tmp_path)
    for design in embedded(page, "data")["designs"]:
        assert design["file"] is None and "spacing_mm" in design["file_missing"]
        missing = embedded(page, "shapes")["missing"][str(design["index"])]
        assert missing == f"the shape could not be built: {design['file_missing']}"
    assert embedded(page, "data")["effects"] == []


# the benchmark --------------------------------------------------------------------------------------------------------


def result_file(tmp_path, **changes):
    design = Design.from_json(designs_folder() / "benchmark.json")
    rows = {name: {"status": "ok", "held": name != "triangle", "margin": 0.5, "drop_mm": 1.0} for name in OBJECTS}
    result = {"format": "finqd result", "design": design.resolved(), "preset": "standard", "fitness": 0.9,
              "margin": 0.4, "features": qd.measure_features(design), "objects": rows, **changes}  # fmt: skip
    path = tmp_path / "benchmark.json"
    path.write_text(json.dumps(result))
    return path


def test_the_benchmark_is_compared_with_where_its_result_is_given(run, tmp_path):
    found = report_data(run, name="a", benchmark=result_file(tmp_path))["benchmark"]
    assert found["fitness"] == 0.9 and found["notes"] == [] and found["command"] is None
    assert found["objects"]["triangle"]["held"] is False
    assert found["features"]["volume_mm3"] == pytest.approx(51142.8, abs=5)
    assert found["cell"] == [5, 1]  # 2078.46 mm^2 and 51,143 mm^3 on a map of 6 x 6 cells
    assert len(found["parameters"]) == len(PARAMETERS)
    other = report_data(run, name="a", benchmark=result_file(tmp_path, preset="draft", objects={}))["benchmark"]
    assert other["notes"] == ["simulated with the preset draft, the search with standard",
                              "on other objects than the search: its fitness is not comparable"]  # fmt: skip


NO_ROWS = '{"format": "finqd result", "fitness": 1, "margin": 0, "features": {}, "objects": {"cube": 3}}'


@pytest.mark.parametrize("text", ["", "[]", '{"format": "finqd result"}', "\x00", NO_ROWS])
def test_what_is_no_result_is_one_sentence(run, tmp_path, text):
    path = tmp_path / "benchmark.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"benchmark\.json: is no (result of finqd evaluate|JSON file)"):
        report_data(run, name="a", benchmark=path)
    with pytest.raises(InputError, match="cannot be read: No such file"):
        report_data(run, name="a", benchmark=tmp_path / "none.json")
