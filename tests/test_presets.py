"""Presets: what they set and what wins over them; their measured errors, and where those say nothing."""

from __future__ import annotations

import json

import pytest

from finqd import accuracy_bands
from finqd.accuracy_bands import MEASURED, NOT_MEASURED, accuracy, bands, preset_sentence
from finqd.data import designs_folder, studies_folder
from finqd.design import Design
from finqd.errors import FinqdError, InputError
from finqd.presets import DEFAULT, PRESETS, apply_preset, departures

CONE = '''
from __future__ import annotations
import dataclasses
from finqd.contracts import Parameter

@dataclasses.dataclass(frozen=True)
class Cone:
    """A cone."""
    finger_parameters = (
        Parameter(name="length", unit="mm", low=50, high=90, allowed_low=10, allowed_high=200),
    )
    def check(self, finger):
        return None
'''


def benchmark(**overrides) -> Design:
    return Design.from_json(designs_folder() / "benchmark.json").with_overrides(overrides)


# -- what a preset sets ----------------------------------------------------------------------------


def test_the_paper_chooses_a_mesher_and_a_solver_where_the_design_leaves_them_open():
    paper = apply_preset(benchmark(), "paper")
    mesher, stepper = paper.plugin("mesher"), paper.plugin("stepper")
    assert paper.spec("mesher")["name"] == "tetrahedral" and (mesher.size_mm, mesher.order) == (2.0, 1)
    assert paper.spec("stepper")["name"] == "implicit_euler" and paper.spec("elasticity")["name"] == "corotated"
    assert (stepper.linear_solver, stepper.preconditioner) == ("cg", "jacobi")
    assert (stepper.linear_iterations, stepper.linear_tolerance) == (1000, 1e-6)
    assert paper.protocol.time_step_ms == 10.0
    assert departures(paper, "paper") == ()


def test_a_design_that_names_its_mesher_keeps_it_and_takes_that_ones_options():
    paper = apply_preset(benchmark(mesher="swept"), "paper")
    assert paper.spec("mesher") == {"name": "swept", "size_mm": 2.0}
    assert departures(paper, "paper") == ("mesher is swept, not tetrahedral",)


def test_values_of_the_design_win_over_the_preset_and_overrides_over_both():
    design = benchmark(**{"mesher.size_mm": 3, "protocol.time_step_ms": 7})
    fine = apply_preset(design, "fine")
    assert (fine.plugin("mesher").size_mm, fine.protocol.time_step_ms) == (3.0, 7.0)
    changed = apply_preset(design, "fine", overrides={"mesher.size_mm": 5})
    assert (changed.plugin("mesher").size_mm, changed.protocol.time_step_ms) == (5.0, 7.0)


def test_an_override_of_an_option_is_one_of_the_plugin_that_the_preset_chooses():
    paper = apply_preset(benchmark(), "paper", overrides={"mesher.size_mm": 1, "stepper.linear_iterations": 50})
    assert paper.spec("mesher") == {"name": "tetrahedral", "size_mm": 1.0, "order": 1}
    assert departures(paper, "paper") == ("mesher.size_mm is 1, not 2", "stepper.linear_iterations is 50, not 1000")


def test_an_override_of_the_plugin_takes_the_preset_s_options_for_that_plugin():
    draft = apply_preset(benchmark(), "draft", overrides={"mesher": "tetrahedral"})
    assert draft.spec("mesher") == {"name": "tetrahedral", "size_mm": 6.0}


@pytest.mark.parametrize("preset", PRESETS)
def test_applying_a_preset_twice_changes_nothing_and_departs_from_nothing(preset):
    once = apply_preset(benchmark(), preset)
    assert apply_preset(once, preset).to_json() == once.to_json()
    assert departures(once, preset) == ()


def test_presets_are_finer_one_by_one():
    sizes, steps = [], []
    for preset in ("draft", "standard", "fine", "reference"):
        design = apply_preset(benchmark(), preset)
        sizes.append(design.plugin("mesher").size_mm)
        steps.append(design.protocol.time_step_ms)
    assert sizes == sorted(sizes, reverse=True) and steps == sorted(steps, reverse=True)


def test_what_changes_no_result_is_no_departure():
    design = benchmark(**{"stepper.backend": "superlu", "protocol.wall_clock_limit_s": 5, "protocol.hold_s": 3})
    assert departures(apply_preset(design, DEFAULT), DEFAULT) == ()


@pytest.mark.parametrize("overrides, sentence", [
    ({"mesher.sise_mm": 2}, "--set: mesher: mesher 'tetrahedral' has no option 'sise_mm'"),
    ({"mesher": "sweptt"}, "--set: mesher: there is no mesher plugin 'sweptt'"),
    ({"protocol.time_step_ms": 0}, "--set: protocol.time_step_ms: must be a number from 0.001 to 1000, not 0"),
])
def test_bad_overrides_are_one_sentence(overrides, sentence):
    with pytest.raises(InputError) as caught:
        apply_preset(benchmark(), "paper", overrides=overrides, source="--set:")
    assert str(caught.value).startswith(sentence) and "\n" not in str(caught.value)


# -- measured errors -------------------------------------------------------------------------------


@pytest.fixture
def studied(monkeypatch):
    """A file of bands in which `standard` has been measured."""
    numbers = dict.fromkeys(MEASURED)
    known = {"press_force_error_percent": 3.21, "press_fingers_error_percent": 7.5, "verdict_flips_percent": 2.0}
    row = {**numbers, "settings": PRESETS["standard"], **known}
    study = {"title": "a press", "date": "2026-01-31", "versions": {}, "repeat": "finqd accuracy press"}
    document = {
        "valid_for": {"geometry": "fin_ray", "poisson_ratio": 0.49}, "presets": {"standard": row},
        "studies": {"press": study, "press_fingers": study, "grasp": {**study, "title": "grasps"}},
    }
    monkeypatch.setattr(accuracy_bands, "bands", lambda: document)
    return document


def measured(**overrides) -> dict:
    return accuracy(apply_preset(benchmark(), "standard", overrides=overrides), "standard")


def test_a_measured_preset_says_how_far_off_it_is_and_from_which_studies(studied):
    found = measured()
    sentence = "force of a press 3.2 % off, on 9 of 10 fingers within 7.5 %, 2 % of verdicts flip"
    assert found["applies"] and found["sentence"] == sentence
    assert found["press_force_error_percent"] == 3.21 and found["drop_error_mm"] is None
    assert found["studies"]["press"]["repeat"] == "finqd accuracy press" and "grasp" in found["studies"]
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_it_says_how_many_grasps_were_compared_and_with_what(studied):
    studied["presets"]["standard"]["grasps_compared"] = "100 grasps against fine"
    found = measured()
    assert found["sentence"].endswith("2 % of verdicts flip (100 grasps against fine)")
    assert found["grasps_compared"] == "100 grasps against fine"


def test_what_no_study_has_measured_is_named_by_none(studied):
    studied["presets"]["standard"]["verdict_flips_percent"] = None
    assert measured()["studies"].keys() == {"press", "press_fingers"}


@pytest.mark.parametrize("overrides, sentence", [
    ({"mesher.size_mm": 5}, "does not apply: mesher.size_mm is 5, not 2.5"),
    ({"mesher.layers": 1}, "does not apply: mesher.layers is 1, not 2"),
    ({"mesher": "tetrahedral"}, "does not apply: mesher is tetrahedral, not swept"),
    ({"stepper.tolerance_N": 0.01}, "does not apply: stepper.tolerance_N is 0.01, not 5e-05"),
    ({"protocol.time_step_ms": 30}, "does not apply: protocol.time_step_ms is 30, not 20"),
    ({"material.poisson_ratio": 0.3}, "does not apply: measured with a Poisson's ratio of 0.49"),
])
def test_it_does_not_apply_to_what_was_not_studied(studied, overrides, sentence):
    found = measured(**overrides)
    assert not found["applies"] and found["sentence"] == sentence
    assert found["press_force_error_percent"] == 3.21, "the number stays, with the sentence beside it"


def test_it_does_not_apply_to_another_finger_type(studied, make_distribution):
    make_distribution("cones", {"geometry": {"cone": "cones_module:Cone"}}, module="cones_module", source=CONE)
    design = Design.from_json({"geometry": "cone", "finger": {"length_mm": 60}, "spacing_mm": 35})
    found = accuracy(apply_preset(design, "standard"), "standard")
    assert (found["applies"], found["sentence"]) == (False, "does not apply: measured on fingers of the type fin_ray")


def test_a_preset_that_has_changed_since_its_study_is_not_measured(studied):
    studied["presets"]["standard"]["settings"] = {"mesher": {"swept": {"size_mm": 5.0}}}
    found = measured()
    assert found["sentence"] == f"{NOT_MEASURED}: the preset has changed since its study" and not found["applies"]
    assert preset_sentence("standard") == found["sentence"]


def test_a_preset_without_a_row_is_not_measured(studied):
    found = accuracy(apply_preset(benchmark(), "draft"), "draft")
    assert (found["applies"], found["sentence"], found["studies"]) == (False, NOT_MEASURED, {})


def test_the_file_that_ships_knows_every_preset_and_claims_only_what_names_its_study():
    file = bands()
    assert file["presets"].keys() == PRESETS.keys()
    for name, row in file["presets"].items():
        assert row.keys() - {"grasps_compared"} == {"settings", *MEASURED}, name
        assert ("grasps_compared" in row) == (row["verdict_flips_percent"] is not None), name
        known = [key for key in MEASURED if row[key] is not None]
        assert all(isinstance(row[key], float | int) and row[key] >= 0 for key in known), name
        assert not known or row["settings"] == PRESETS[name], f"{name} has changed: measure it again"
        for study in {MEASURED[key] for key in known}:
            assert file["studies"][study]["date"] and file["studies"][study]["versions"], study


@pytest.mark.parametrize("text", ["", "[1]", "{}", '{"presets": '])
def test_a_damaged_installation_is_one_sentence(monkeypatch, tmp_path, text):
    (tmp_path / "presets.json").write_text(text)
    monkeypatch.setattr(accuracy_bands, "studies_folder", lambda: tmp_path)
    bands.cache_clear()
    with pytest.raises(FinqdError, match="^this installation of finqd is damaged") as caught:
        bands()
    assert "\n" not in str(caught.value)
    bands.cache_clear()
    assert studies_folder().is_dir()
