"""The accuracy ladder: its logic with a press that costs nothing, and one real press, coarse and short."""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from finqd.accuracy import (
    LOG,
    REFERENCE,
    best_within,
    cheapest_within,
    disturbed,
    fingerprint,
    front,
    measure_rung,
    open_study,
    outdated,
)
from finqd.accuracy_cases import CASES, case_options, measured
from finqd.accuracy_effects import effects_section
from finqd.accuracy_ladder import (
    AS_GIVEN,
    KNOBS,
    Rung,
    as_options,
    build_ladder,
    options_text,
    reference_rungs,
    without_numerics,
)
from finqd.accuracy_plot import _free_place
from finqd.accuracy_reference import (
    error_of,
    extrapolated,
    make_reference,
    read_reference,
    shipped_reference,
    write_reference,
)
from finqd.accuracy_report import csv_text, page, richardson, write_report
from finqd.data import designs_folder, studies_folder
from finqd.design import Design, parse_setting
from finqd.errors import InputError
from finqd.presets import PRESETS, apply_preset
from finqd.study_log import append_row, read_rows
from finqd.workers import TaskFailure

ROOT = Path(__file__).resolve().parent.parent
EXACT = 5.0  # [N], what the stand-in converges to
LOCKED = {("tetrahedral", 1): 0.10, ("tetrahedral", 2): 0.006, ("swept", 1): 0.010}


def tenths_of_standard(step_ms):
    """A time step in tenths of the one of `standard`, so that no test here knows what that is."""
    return 10.0 * step_ms / PRESETS["standard"]["protocol"]["time_step_ms"]


def fake_press(design, options, limit, progress):
    """A press without mechanics: second order in mesh size, first order in the step, cost as it would be."""
    mesher, step = design.plugin("mesher"), tenths_of_standard(design.protocol.time_step_ms)
    name = design.spec("mesher")["name"]
    size, order = mesher.size_mm, getattr(mesher, "order", 1)
    if design.spec("contact").get("stiffness_N_mm3") == 3000:
        return measured(status="diverged", reason="no equilibrium <here> & now", seconds=1.0, dofs=99)
    least = getattr(mesher, "least_edges", 1)  # what the reference refines by, together with the size
    through = size if least == 1 else (size / least) ** 0.5
    error = LOCKED.get((name, order), 0.005) * through**2 + 2e-4 * step
    seconds = {1: 10.0, 2: 60.0}[order] / through**2 * 10.0 / step
    values = {"force_N": EXACT * (1 + error), "half_force_N": 2.0 * (1 + error), "energy_mJ": 30.0 * (1 + error)}
    return measured(
        status="ok", reason="", values=values, seconds=seconds, dofs=int(9000 / size), steps=int(600 / step),
        newton_iterations=int(1200 / step), max_penetration_mm=0.004,
    )


class Runner:
    """Stands in for `finqd.workers.run_tasks`: runs here, keeps what it ran."""

    def __init__(self, fail=None):
        self.ran, self.fail = [], fail

    def __call__(self, function, tasks, *, jobs, time_limit_s, on_result, on_progress):
        assert function is measure_rung and len(tasks) <= jobs and time_limit_s > 0
        for index, task in enumerate(tasks):
            self.ran.append(task.design)
            if self.fail is not None and len(self.ran) == self.fail:
                raise KeyboardInterrupt
            on_progress(index, 1.0)
            on_result(index, function(task))


@pytest.fixture(scope="module")
def design():
    return Design.from_json(ROOT / "designs" / "benchmark.json")


@pytest.fixture
def study_in(design):
    """Return a function that opens the study of a folder, with the stand-in for the press."""
    case = replace(CASES["press"], measure=fake_press)

    def study_in(folder, *, fail=None, **options):
        study = open_study(design, case, {"finger": 0}, folder, **options)
        study.runner = Runner(fail)
        return study

    return study_in


# -- the ladder ----------------------------------------------------------------------------------------------------


def test_every_rung_is_what_its_options_say_on_the_command_line(design):
    ladder = build_ladder(design)
    assert len({rung.name for rung in ladder.rungs}) == len(ladder.rungs) > 50
    assert {rung.knob for rung in ladder.rungs} <= set(KNOBS)
    for rung in ladder.rungs:
        words = as_options(rung).split(" --set ")
        pasted = dict(parse_setting(word) for word in words[1:])
        preset = words[0].removeprefix("--preset ")
        assert apply_preset(design, preset, overrides=pasted).digest() == rung.applied(design).digest(), rung.name


def test_a_curve_contains_standard_itself(design):
    ladder = build_ladder(design)
    standard = apply_preset(design, "standard").digest()
    through = {rung.knob for rung in ladder.rungs if rung.applied(design).digest() == standard}
    assert {"preset", "size", "step", "linear", "contact"} <= through
    assert {rung.name for rung in ladder.rungs if rung.knob == "preset"} == set(PRESETS)


def test_no_two_rungs_of_element_families_compute_the_same(design):
    """What a family leaves open the preset would fill: all of them were graded once, because `standard` is."""
    ladder = build_ladder(design)
    digests: dict[str, str] = {}
    for rung in ladder.rungs:
        if rung.series.startswith("size of"):
            assert digests.setdefault(ladder.designs[rung.name].digest(), rung.name) == rung.name


def test_what_is_not_installed_is_named_with_its_reason(design, monkeypatch):
    rungs = [
        Rung(name="standard", knob="preset", series="preset"),
        Rung(name="alien", knob="stepper", series="stepper", settings={"stepper": "alien"}),
        Rung(name="option", knob="newton", series="newton", settings={"stepper.no_such_option": 1}),
        Rung(name="backend", knob="linear", series="linear", settings={"stepper.backend": "superlu"}),
    ]
    monkeypatch.setattr("finqd.accuracy_ladder._all_rungs", lambda: rungs)
    monkeypatch.setattr("finqd.mechanics.linear_backends.available_backends", lambda: ("qdldl",))
    ladder = build_ladder(design)
    assert [rung.name for rung in ladder.rungs] == ["standard"]
    assert "no stepper plugin 'alien'" in ladder.missing["alien"] and "no option" in ladder.missing["option"]
    assert ladder.missing["backend"] == "the library superlu is not installed"


def test_a_knob_alone_comes_with_standard_and_an_unknown_one_is_refused(design):
    assert {rung.knob for rung in build_ladder(design, knobs=["step"]).rungs} == {"step", "preset"}
    assert [r.name for r in build_ladder(design, knobs=["step"]).rungs if r.knob == "preset"] == ["standard"]
    with pytest.raises(InputError, match="no knob 'steps'; known: size, element"):
        build_ladder(design, knobs=["steps"])


def test_presets_and_reference_do_not_depend_on_what_the_design_says_of_its_numerics(design):
    own = design.with_overrides({"mesher.size_mm": 7, "protocol.time_step_ms": 3, "protocol.hold_s": 2})
    rungs = [r for r in build_ladder(own).rungs if r.name in PRESETS] + list(reference_rungs("press", full=True))
    for rung in rungs:
        assert rung.applied(own).digest() == rung.applied(design.with_overrides({"protocol.hold_s": 2})).digest()
    assert without_numerics(own).protocol.hold_s == 2.0
    given = next(rung for rung in build_ladder(own).rungs if rung.name == AS_GIVEN)
    assert given.applied(own).digest() == apply_preset(own, "standard").digest()
    assert all(rung.name != AS_GIVEN for rung in build_ladder(design).rungs)
    step = next(rung for rung in build_ladder(own).rungs if rung.name == "step 5 ms")
    assert step.applied(own).plugin("mesher").size_mm == 7.0  # a knob is turned on the design as it is


def test_the_law_of_a_design_is_its_reference_s_and_its_presets_too(design, tmp_path):
    own = design.with_overrides({"elasticity": "neo_hookean"})
    rungs = [r for r in build_ladder(own).rungs if r.name in PRESETS] + list(reference_rungs("press", full=False))
    assert {rung.applied(own).spec("elasticity")["name"] for rung in rungs} == {"neo_hookean"}
    studies = [open_study(one, CASES["press"], {"finger": 0}, tmp_path) for one in (design, own)]
    assert studies[0].physics != studies[1].physics


def test_the_reference_is_made_by_two_families(design):
    for case in CASES:
        for full in (False, True):
            first, second, *half = (rung.applied(design) for rung in reference_rungs(case, full=full))
            kinds = [(d.spec("mesher")["name"], d.plugin("mesher").order) for d in (first, second)]
            assert kinds[0] != kinds[1]
            assert first.protocol.time_step_ms == second.protocol.time_step_ms
            mesher = first.plugin("mesher")
            assert mesher.size_mm / mesher.least_edges < 2.7 and mesher.grading > 1.0 and len(half) == 1
            for coarse in half:  # a mesh half as fine, by which the second family is extrapolated
                one, other = second.plugin("mesher"), coarse.plugin("mesher")
                assert (other.size_mm, 2 * other.least_edges) == (2 * one.size_mm, one.least_edges)
                assert other.order == one.order and other.grading == one.grading and other.layers == one.layers


# -- running, resuming ---------------------------------------------------------------------------------------------


def test_each_rung_is_logged_at_once_and_an_interrupted_study_goes_on(study_in, tmp_path):
    interrupted = study_in(tmp_path, fail=6)
    with pytest.raises(KeyboardInterrupt):
        interrupted.set_reference("compute")
        interrupted.run(interrupted.rungs)
    assert len(read_rows(tmp_path / LOG)) == 5
    text = (tmp_path / LOG).read_text()
    (tmp_path / LOG).write_text(text + text.splitlines()[-1][:70])  # killed in the middle of the next line

    resumed = study_in(tmp_path)
    resumed.set_reference("compute")
    resumed.run(resumed.rungs)
    keys = {resumed.key(rung) for rung in (*resumed.rungs, *resumed.reference_rungs())}
    assert len(resumed.runner.ran) == len(keys) - 5
    rows = read_rows(tmp_path / LOG)
    assert [json.loads(line)["key"] for line in (tmp_path / LOG).read_text().splitlines()] == [r["key"] for r in rows]
    assert {row["key"] for row in rows} == keys and len(rows) == len(keys)

    again = study_in(tmp_path)
    again.set_reference("compute")
    again.run(again.rungs)
    assert again.runner.ran == [] and csv_text(again) == csv_text(resumed)


def test_a_row_says_what_was_run_and_with_what(study_in, tmp_path):
    study = study_in(tmp_path)
    study.set_reference("compute")
    study.run([rung for rung in study.rungs if rung.name == "hex8 2 mm"])
    row = read_rows(tmp_path / LOG)[-1]
    settings = {"mesher": "swept", "mesher.order": 1, "mesher.layers": None, "mesher.notch_nodes": "middle"}
    assert row["settings"] == {**settings, "mesher.grading": 1.0, "mesher.size_mm": 2} and row["knob"] == "element"
    assert row["versions"]["finqd"] and row["machine"]["cores"] >= 1 and row["status"] == "ok"
    assert row["options"] == (
        "--preset standard --set mesher=swept --set mesher.order=1 --set mesher.layers=null "
        "--set mesher.notch_nodes=middle --set mesher.grading=1 --set mesher.size_mm=2"
    )
    assert row["design_digest"] == study.runner.ran[-1].digest() != study.design.digest()
    exact = study.reference.values["force_N"]
    assert row["errors"]["force_N"] == pytest.approx(100 * (row["values"]["force_N"] / exact - 1))
    assert row["wall_seconds"] < 1.0 and row["seconds"] == pytest.approx(2.5)


def test_rows_of_another_state_of_the_source_stay_and_are_told_of(study_in, tmp_path):
    study = study_in(tmp_path, knobs=["step"])
    study.run(study.rungs)
    other = study_in(tmp_path, knobs=["step"])
    other.__dict__["versions"] = {**study.versions, "source": "another"}
    other.run(other.rungs)
    assert other.runner.ran == [] and outdated(study.table(), study.versions["source"]) == []
    assert len(outdated(other.table(), "another")) == len(other.table()) > 3


def test_other_versions_are_run_again(study_in, tmp_path):
    study = study_in(tmp_path, knobs=["step"])
    study.run(study.rungs)
    other = study_in(tmp_path, knobs=["step"])
    other.__dict__["versions"] = {**study.versions, "numpy": "0.1"}
    other.run(other.rungs)
    assert len(other.runner.ran) == len(study.runner.ran)


def test_a_row_that_lacks_something_is_run_again(study_in, tmp_path):
    study = study_in(tmp_path, knobs=["step"])
    study.run(study.rungs)
    rows = read_rows(tmp_path / LOG)
    del rows[0]["wall_seconds"], rows[1]["values"]
    (tmp_path / LOG).write_text("".join(json.dumps(row) + "\n" for row in rows))
    again = study_in(tmp_path, knobs=["step"])
    again.run(again.rungs)
    assert len(again.runner.ran) == 2


def test_what_crashed_or_now_has_more_time_is_run_again_and_what_diverged_is_not(study_in, tmp_path):
    study = study_in(tmp_path, limit=10.0)
    rungs = {rung.name: rung for rung in study.rungs}
    failures = {"hex8 2 mm": "crash", "hex8 3 mm": "timeout", "hex8 6 mm": "error"}
    study.runner = lambda function, tasks, *, on_result, **rest: [
        on_result(i, TaskFailure(kind=failures[name], reason="gone")) for i, name in enumerate([current])
    ]
    for current in failures:
        study.run([rungs[current]])
    study = study_in(tmp_path, limit=20.0)
    study.run([rungs[name] for name in failures])
    assert sorted(d.plugin("mesher").size_mm for d in study.runner.ran) == [2.0, 3.0]
    rows = {row["rung"]: row for row in study.table()}
    assert rows["hex8 6 mm"]["status"] == "error" and rows["hex8 6 mm"]["reason"] == "gone"
    assert rows["hex8 2 mm"]["status"] == rows["hex8 3 mm"]["status"] == "ok"


def test_a_log_that_is_none_is_refused_and_no_log_is_no_rows(tmp_path):
    path = tmp_path / LOG
    assert read_rows(path) == []
    path.write_text('{"rung": "a"}\nthis is a letter\n{"rung": "b"}\n')
    with pytest.raises(InputError, match="line 2 is no row of a study"):
        read_rows(path)
    path.write_text('{"rung": "a"}\n{"rung":')
    append_row(path, {"rung": "b", "seconds": float("nan")})
    assert read_rows(path) == [{"rung": "a"}, {"rung": "b", "seconds": None}]


def test_the_default_ladder_leaves_the_dear_rungs_to_full(study_in, tmp_path):
    study, full = study_in(tmp_path), study_in(tmp_path, full=True)
    more = {rung.name for rung in full.rungs} - {rung.name for rung in study.rungs}
    assert {"tet10 2 mm", "tet10 1.5 mm"} <= more and not {"draft", "standard", "fine", "paper"} & more
    assert all("--full" in study.omitted[name] for name in more)
    assert not any("friction" in rung.name for rung in full.rungs)  # a press is frictionless


# -- reference, errors, front --------------------------------------------------------------------------------------


def test_errors_are_against_the_first_family_and_what_the_second_differs_by_is_told(study_in, tmp_path):
    study = study_in(tmp_path)
    study.set_reference("compute")
    stepped = EXACT * (1.0 + 2e-4 * tenths_of_standard(20.0))
    first = stepped + EXACT * 0.005 * (2 / 2) ** 2
    # the stand-in is of second order in its mesh, so that two meshes of the other family extrapolate to its limit
    assert study.reference.values["force_N"] == pytest.approx(first)
    assert study.reference.confirmed_by == pytest.approx(stepped)
    assert study.reference.difference_percent == pytest.approx(100 * (first - stepped) / first)
    assert study.reference.agrees and "the limit of hex8 4 mm graded" in study.reference.sentence()
    full = study_in(tmp_path, full=True)
    full.set_reference("compute")
    gap = 0.005 * (1 / 4)
    assert full.reference.difference_percent == pytest.approx(100 * gap / (stepped / EXACT + gap), rel=1e-6)
    assert full.reference.agrees and "the reference is hex20 1 mm" in full.reference.sentence()
    assert extrapolated(15.8, 15.8) == 15.8 and extrapolated(1.25, 2.0) == pytest.approx(1.0)


def test_one_family_alone_and_none(study_in, tmp_path):
    study = study_in(tmp_path)
    good = {**fake_press(study.design, {}, 1.0, None), "rung": "hex8", "options": "", "versions": {}, "machine": {},
            "design": "d"}
    bad = {**good, **measured(status="timeout", reason="slow"), "rung": "tet10"}
    far = {**good, "values": {**good["values"], "force_N": 1.02 * good["values"]["force_N"]}}
    apart = make_reference(study.case, "p", [good, far], full=False)
    assert apart.difference_percent == pytest.approx(2.0) and "NO agreement" in apart.sentence()
    alone = make_reference(study.case, "p", [good, bad], full=False)
    assert alone.difference_percent is None and not alone.agrees
    assert "by hex8 alone (tet10: timeout)" in alone.sentence()
    assert make_reference(study.case, "p", [bad, None], full=False) is None


def test_a_shape_that_cannot_be_swept_has_a_reference_of_tetrahedra(study_in, tmp_path):
    study = study_in(tmp_path, knobs=["step"])

    def tetrahedra_only(design, options, limit, progress):
        if design.spec("mesher")["name"] == "swept":
            return measured(status="mesh_failed", reason="no profile")
        return fake_press(design, options, limit, progress)

    study.case = replace(study.case, measure=tetrahedra_only)
    study.set_reference("compute")
    fine, coarse = (rung.applied(study.design).plugin("mesher") for rung in study.reference_rungs())
    assert (fine.order, coarse.order, coarse.size_mm) == (2, 2, 2 * fine.size_mm)
    assert [family["status"] for family in study.reference.families] == ["ok", "ok"]
    assert not study.reference.agrees and "one family alone" in study.reference.sentence()
    assert study.reference.uncertainty_percent == study.reference.difference_percent > 0.0


def test_a_series_that_ran_out_of_time_is_not_gone_on_with(study_in, tmp_path):
    study = study_in(tmp_path, knobs=["step"], limit=60.0)

    def slow(design, options, limit, progress):
        if design.protocol.time_step_ms <= 10:
            return measured(status="timeout", reason="slow", seconds=limit)
        return fake_press(design, options, limit, progress)

    study.case = replace(study.case, measure=slow)
    study.run(study.rungs)
    late = [row["rung"] for row in study.rows if row["status"] == "timeout"]
    assert late == ["step 10 ms"] and {"step 5 ms", "step 2.5 ms"} <= study.omitted.keys()
    assert study.omitted["step 5 ms"] == "step 10 ms, which is to cost less, took over 60 s"
    again = study_in(tmp_path, knobs=["step"], limit=60.0)
    again.case = study.case
    assert cheapest_within(again, 1e-9) is None and again.runner.ran == [], "not after a resume, nor one by one"


def test_no_reference_means_values_without_errors(study_in, tmp_path):
    study = study_in(tmp_path, knobs=["step"])
    study.run(study.rungs)
    assert all(row["error_percent"] is None and row["values"] for row in study.table())
    assert front(study.table()) == []
    write_report(study)
    assert "there is no reference" in (tmp_path / "accuracy.html").read_text().lower()


def test_a_reference_reads_back_and_fits_only_its_own_physics(study_in, tmp_path, monkeypatch, design):
    study = study_in(tmp_path)
    study.set_reference("compute")
    write_reference(tmp_path / "reference_mine.json", study.reference)
    monkeypatch.setattr("finqd.accuracy_reference.studies_folder", lambda: tmp_path)
    found = shipped_reference("press", study.physics)
    assert found.values == study.reference.values and found.source == "shipped"
    assert shipped_reference("grasp", study.physics) is None

    def physics(**overrides):
        other = open_study(design.with_overrides(overrides), study.case, {"finger": 0}, tmp_path)
        return other.physics

    assert physics() == physics(**{"mesher.size_mm": 1, "protocol.time_step_ms": 2, "spacing_mm": 35}) == study.physics
    assert physics(**{"material.rayleigh_stiffness_ms": 0}) == study.physics
    assert study.physics not in (
        physics(**{"material.youngs_modulus_MPa": 3}), physics(**{"finger.rib_count": 4}),
        physics(**{"material.rayleigh_stiffness_ms": 1}),
    )
    fresh = study_in(tmp_path / "elsewhere")
    fresh.set_reference("auto")
    assert fresh.runner.ran == [] and fresh.reference.source == "shipped" and fresh.reference_rungs() == ()
    with pytest.raises(InputError, match="is no reference"):
        read_reference(ROOT / "designs" / "benchmark.json")
    other = open_study(design.with_overrides({"finger.rib_count": 4}), study.case, {"finger": 0}, tmp_path)
    with pytest.raises(InputError, match="^--reference shipped: is of another case or another physics: press of"):
        other.set_reference(found)


@pytest.mark.parametrize(("key", "value"), [
    ("families", 3), ("families", []), ("families", [{}]), ("families", [{"rung": "a", "status": "ok"}]),
    ("values", None), ("values", {}), ("values", {"force_N": "5.286"}), ("difference_percent", "much"),
    ("difference_percent", -3), ("case", None), ("surprise", 1),
])
def test_a_reference_that_is_damaged_is_refused_in_a_sentence(tmp_path, key, value):
    whole = json.loads((studies_folder() / "reference_press_benchmark.json").read_text())
    path = tmp_path / "r.json"
    path.write_text(json.dumps({**whole, key: value}))
    with pytest.raises(InputError, match="is no reference"):
        read_reference(path)


@pytest.mark.parametrize("path", sorted(studies_folder().glob("reference_*.json")), ids=lambda path: path.stem)
def test_references_that_ship_agree_and_fit_the_design_they_were_made_for(path, tmp_path):
    found = read_reference(path)
    case, shipped = CASES[found.case], Design.from_json(ROOT / "designs" / f"{found.design}.json")
    study = open_study(shipped, case, case_options(case, finger=None, grasped=None, design=shipped), tmp_path)
    assert found.physics == study.physics, "the physics have changed: make it again, as the file says"
    assert found.agrees and len(found.families) == 3 and found.repeat and found.date and found.versions["finqd"]
    assert set(found.values) == set(case.quantities)


def test_errors_by_kind_of_quantity():
    quantities = CASES["grasp"].quantities
    assert error_of(quantities["final_force_N"], 2.1, 2.0) == pytest.approx(5.0)
    assert error_of(quantities["drop_mm"], 0.5, 0.2) == pytest.approx(0.3)
    assert error_of(quantities["held"], False, True) == 1.0 and error_of(quantities["held"], True, True) == 0.0
    assert error_of(quantities["final_force_N"], None, 2.0) is None
    assert error_of(quantities["final_force_N"], 2.0, 0.0) is None


def brute_force_front(rows):
    return {
        a["rung"] for a in rows
        if not any((b["seconds"] <= a["seconds"] and b["resolved_percent"] <= a["resolved_percent"]) and b is not a
                   and (b["seconds"], b["resolved_percent"]) != (a["seconds"], a["resolved_percent"]) for b in rows)
    }


def test_the_front_is_what_nothing_beats(study_in, tmp_path):
    study = study_in(tmp_path)
    study.set_reference("compute")
    study.run(study.rungs)
    rows = [row for row in study.table() if row["status"] == "ok" and row["knob"] != "reference"]
    found = front(study.table())
    points = {(row["seconds"], row["resolved_percent"]) for row in found}
    expected = brute_force_front(rows)
    assert points == {(row["seconds"], row["resolved_percent"]) for row in rows if row["rung"] in expected}
    assert len(points) == len(found) >= 3
    assert [row["seconds"] for row in found] == sorted(row["seconds"] for row in found)
    # what is nearer to the reference than the families are to each other gains nothing by that
    study.set_reference(replace(study.reference, difference_percent=20.0))
    rows = [row for row in study.table() if row["status"] == "ok" and row["knob"] != "reference"]
    assert all(row["resolved_percent"] >= study.reference.uncertainty_percent == 10.0 for row in rows)
    assert any(abs(row["error_percent"]) < study.reference.uncertainty_percent for row in rows)


def test_richardson_finds_limit_and_order_and_gives_up_where_there_is_none():
    def rows(function):
        return [{"settings": {"h": h}, "values": {"f": function(h)}} for h in (6, 4, 2, 1)]

    limit, order = richardson(rows(lambda h: 5 + 0.3 * h**1.5), "h", "f")
    assert (limit, order) == (pytest.approx(5.0, abs=1e-9), pytest.approx(1.5, abs=1e-9))
    assert richardson(rows(lambda h: (-1) ** h * h), "h", "f") is None
    assert richardson(rows(lambda h: h)[:2], "h", "f") is None
    assert richardson(rows(lambda h: 5.0), "h", "f") is None


# -- questions -----------------------------------------------------------------------------------------------------


def test_the_cheapest_setting_within_an_error(study_in, tmp_path):
    study = study_in(tmp_path)
    study.set_reference("compute")
    answer = cheapest_within(study, 17.0)
    ran = len(study.runner.ran)
    assert 2 < ran < 20, "it stops as soon as it has one"
    assert answer["resolved_percent"] <= 17.0
    study.run(study.rungs)
    rows = [row for row in study.table() if row["status"] == "ok" and row["knob"] != "reference"]
    fits = [row for row in rows if row["resolved_percent"] <= 17.0]
    complete = study_in(tmp_path)
    complete.set_reference("compute")
    answer = cheapest_within(complete, 17.0)
    assert complete.runner.ran == [], "a complete log is not run again"
    assert answer["seconds"] == min(row["seconds"] for row in fits)
    assert cheapest_within(complete, 1e-9) is None


def test_the_best_setting_within_a_budget(study_in, tmp_path):
    study = study_in(tmp_path)
    study.set_reference("compute")
    answer = best_within(study, 1.0)
    assert answer["seconds"] <= 1.0
    assert len(study.runner.ran) < len(study.rungs) + 2
    study.run(study.rungs)
    rows = [row for row in study.table() if row["status"] == "ok" and row["knob"] != "reference"]
    fits = [row for row in rows if row["seconds"] <= 1.0]
    assert answer["resolved_percent"] == min(row["resolved_percent"] for row in fits)
    assert best_within(study, 1e-6) is None


# -- what is written -----------------------------------------------------------------------------------------------


def test_table_picture_and_page(study_in, tmp_path):
    study = study_in(tmp_path)
    study.set_reference("compute")
    study.run(study.rungs)
    table, picture, html = write_report(study)
    rows = list(csv.DictReader(io.StringIO(table.read_text())))
    assert len(rows) == len(study.rungs) + 3
    by_name = {row["rung"]: row for row in rows}
    coarse = by_name["hex8 8 mm"]
    exact = study.reference.values["force_N"]
    assert float(coarse["error_percent"]) == pytest.approx(100 * (EXACT * 1.642 / exact - 1), rel=1e-6)
    assert float(coarse["change_percent"]) == pytest.approx(100 * (1.642 / 1.03325 - 1), rel=1e-6)
    assert (coarse["dofs"], coarse["steps"], coarse["newton_iterations"]) == ("1125", "60", "120")
    assert float(coarse["max_penetration_mm"]) == 0.004 and coarse["options"].endswith("mesher.size_mm=8")
    failed = by_name["contact stiffness_N_mm3 3000"]
    assert (failed["status"], failed["error_percent"]) == ("diverged", "") and "<here>" in failed["reason"]
    assert {row["rung"] for row in rows if row["on_front"] == "true"} == {row["rung"] for row in front(study.table())}
    assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size > 20_000

    text = html.read_text()
    assert not re.search(r'(src|href)="(?!data:)', text), "the page needs nothing but itself"
    assert "no equilibrium &lt;here&gt; &amp; now" in text and "<here>" not in text
    words = ("The Pareto front", "--reference compute", "Not run", "order 2.00", "penetration [mm]", "Newton")
    for needed in (*words, *PRESETS, study.versions["numpy"], study.machine["processor"]):
        assert needed in text, needed


def test_the_page_shows_what_effects_cost_and_change(monkeypatch, tmp_path):
    monkeypatch.setattr("finqd.accuracy_effects.studies_folder", lambda: tmp_path)
    assert effects_section() == "", "no study, no section"
    off = {"state": "off", "status": "ok", "held": False, "drop_mm": 30.0, "force_N": 7.0, "seconds": 5.0}
    effects = {
        "friction": {"state": "on", "since_s": 0.5, "seconds": 1.25, "why": "", "what_if": off},
        "damping": {"state": "off", "since_s": None, "seconds": None, "why": "", "what_if": {
            "state": None, "reason": "cannot be forced <on>"}},
        "soft_object": {"state": "off", "since_s": None, "seconds": None, "why": ""},
    }
    row = {"held": True, "drop_mm": 0.5, "force_N": 14.0, "seconds": 10.0, "effects": effects}
    study = {"preset": "standard", "date": "2026-01-02", "commit": "abc", "conditions": "warm",
             "repeat": "again", "objects": {"ball": row}}
    (tmp_path / "effects.json").write_text(json.dumps(study))
    text = re.sub(r"<[^>]*>", "|", effects_section())
    assert "|friction||on||0.50||1.25||off: lost||-50.000||+29.5000||0.50|" in text
    assert "|damping||off||-||-||cannot be forced &lt;on&gt;||-||-||-|" in text
    assert "|soft object||off||-||-||-||" in text
    assert "ball: held, drop 0.50 mm, force 14.00 N, 10.0 s" in text and "abc, warm" in text


def test_labels_of_presets_cover_neither_stars_nor_each_other():
    stars = [(100.0 + 9.0 * i, 100.0) for i in range(5)]
    taken = [(x - 9.0, y - 9.0, x + 9.0, y + 9.0) for x, y in stars]
    for star in stars:
        (dx, dy), box = _free_place(star, 80.0, taken, (0.0, 80.0, 240.0, 400.0))
        assert box[0] >= 0.0 and box[1] >= 80.0 and box[2] <= 240.0 and box[3] <= 400.0
        assert box == pytest.approx((star[0] + dx - 40, star[1] + dy - 13, star[0] + dx + 40, star[1] + dy + 13))
        assert all(box[0] > b[2] or box[2] < b[0] or box[1] > b[3] or box[3] < b[1] for b in taken)
        taken.append(box)


def test_a_picture_without_any_error_can_be_drawn(study_in, tmp_path):
    study = study_in(tmp_path, knobs=["linear"])
    assert "nothing" not in page(study, picture=b"")
    assert [path.name for path in write_report(study)] == ["accuracy.csv", "accuracy.png", "accuracy.html"]


# -- cases and command line ----------------------------------------------------------------------------------------


def test_options_belong_to_their_case(design):
    assert case_options(CASES["press"], finger=2, grasped=None, design=design) == {"finger": 2}
    assert case_options(CASES["closing"], finger=None, grasped=None, design=design)["object"].name == "sphere"
    for case, finger, grasped, place in (("press", 3, None, "--finger"), ("press", None, "cube", "--object"),
                                         ("grasp", 0, None, "--finger")):
        with pytest.raises(InputError, match=place):
            case_options(CASES[case], finger=finger, grasped=grasped, design=design)
    one, other = (case_options(CASES["grasp"], finger=None, grasped=name, design=design) for name in ("cube", "disk"))
    assert fingerprint(one) != fingerprint(other) and json.dumps(fingerprint(one))


@pytest.mark.parametrize("arguments", [
    ["--error", "5"], ["--error", "fast"], ["--error", "-5%"], ["--error", "0%"], ["--error", "nan%"],
    ["--budget", "60"], ["--budget", "-1s"], ["--budget", "inf s"], ["--limit", "0s"], ["--knob", "speed"],
    ["--finger", "9"], ["--object", "cube"], ["--reference", "nothing.json"], ["--design", "nowhere"], ["lifting"],
    ["grasp", "--object", "nothing"], ["--set", "mesher.size_mm=-1"], ["--jobs", "0"],
])  # fmt: skip
def test_what_makes_no_sense_is_one_sentence(run, tmp_path, arguments):
    code, out, said = run("accuracy", "--out", tmp_path / "new", *arguments)
    sentences = [line for line in said.splitlines() if "warning" not in line]
    assert (code, out) == (2, "") and len(sentences) == 1 and sentences[0].startswith("finqd: ")
    assert not (tmp_path / "new").exists()


def test_the_command_runs_a_ladder_and_answers_from_it(run, tmp_path, monkeypatch):
    monkeypatch.setitem(CASES, "press", replace(CASES["press"], measure=fake_press))

    def without_processes(*arguments, **options):
        study = open_study(*arguments, **options)
        study.runner = Runner()
        return study

    monkeypatch.setattr("finqd.accuracy.open_study", without_processes)
    command = ["accuracy", "--reference", "compute", "--out", tmp_path, "--knob", "size"]
    code, out, said = run(*command)
    assert code == 0 and "hex20, quarter nodes, graded 2 mm" in out and "on the Pareto front" in out
    assert "the limit of hex8" in out
    assert {path.name for path in tmp_path.iterdir()} == {
        LOG, REFERENCE, "accuracy.csv", "accuracy.png", "accuracy.html"
    }
    code, out, said = run(*command, "--error", "3%", "--budget", "4s")
    assert code == 0 and "error up to 3 %: standard, " in out
    assert "at most 4 s: hex20, quarter nodes, graded 4 mm, " in out
    assert "    --preset standard --set mesher=swept --set mesher.order=2 --set mesher.layers=2" in out
    code, out, said = run(*command, "--error", "0.001%")
    assert code == 1 and "no rung of this ladder does (--full has more); the most accurate is" in out


def test_a_real_press_in_a_process_of_its_own(design, tmp_path):
    coarse = {"mesher.size_mm": 10, "protocol.time_step_ms": 50, "material.youngs_modulus_MPa": 5.0}
    study = open_study(design.with_overrides(coarse), CASES["press"], {"finger": 0}, tmp_path, knobs=["size"])
    rung = Rung(name="tiny", knob="size", series="size of hex8", settings={})
    study.run([rung])
    row = study.row_of(rung)
    assert row["status"] == "ok" and row["values"]["force_N"] > row["values"]["half_force_N"] > 0.0
    assert 0.0 < row["seconds"] < row["wall_seconds"] and row["dofs"] > 300 and row["steps"] >= 12
    assert 0.0 < row["max_penetration_mm"] < 0.1 and row["values"]["energy_mJ"] > 0.0
    other = open_study(design.with_overrides(coarse), CASES["press"], {"finger": 0}, tmp_path, knobs=["size"])
    assert other.row_of(rung) == {**row, "errors": {}}  # read from the log


def test_rungs_that_shared_the_processor_are_told_of():
    row = {"status": "ok", "seconds": 5.0, "wall_seconds": 6.0, "cpu_seconds": 5.8, "rung": "calm"}
    assert disturbed([row, {**row, "cpu_seconds": 2.0, "rung": "late"}, {**row, "cpu_seconds": None}]) == ["late"]


def test_options_are_written_as_a_shell_takes_them():
    assert options_text("draft", {}) == "--preset draft"
    text = options_text("standard", {"stepper.tolerance_N": 1e-6})
    assert text == "--preset standard --set stepper.tolerance_N=1e-06"


def test_what_presets_set_of_the_protocol_is_no_part_of_what_is_studied():
    """A ladder's rungs have the steps of their own preset; a tolerance is what a rung says, not the preset."""
    design = Design.from_json(designs_folder() / "benchmark.json")
    changed = {"protocol.calm_step_factor": 2, "protocol.early_verdict": False, "protocol.time_step_ms": 7}
    bare = without_numerics(design.with_overrides({**changed, "protocol.hold_s": 3.0}))
    assert bare.to_dict()["protocol"] == {"hold_s": 3.0}
    tolerances = [rung.settings for rung in build_ladder(design, knobs=["newton"]).rungs
                  if "stepper.tolerance_N" in rung.settings]
    assert tolerances and all(settings["stepper.tolerance_share"] == 0.0 for settings in tolerances)
