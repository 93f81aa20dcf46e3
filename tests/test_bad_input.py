"""Malformed design files: each is one sentence with file, place and what is allowed; never a traceback.

The files are made here, from the benchmark, by what is wrong with them.
"""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finqd.cli import main
from finqd.data import designs_folder
from finqd.design import Design
from finqd.errors import InputError
from finqd.json_input import SIZE_LIMIT

BENCHMARK = json.loads((designs_folder() / "benchmark.json").read_text())
TEXT = json.dumps(BENCHMARK, indent=2)
LENGTH = "finger.length_mm: must be a number from 40 to 300, not "


@dataclass(frozen=True)
class Bad:
    """One malformed file: its bytes, and what its sentence says after the file's name."""

    name: str
    content: bytes
    sentence: str
    schema_too: bool = False  # a JSON Schema can express what is wrong


def raw(name: str, content: str | bytes, sentence: str) -> Bad:
    return Bad(name, content if isinstance(content, bytes) else content.encode(), sentence)


def edited(name: str, edit: Callable[[dict[str, Any]], Any], sentence: str, schema_too: bool = True) -> Bad:
    document = copy.deepcopy(BENCHMARK)
    edit(document)
    return Bad(name, json.dumps(document).encode(), sentence, schema_too)


def put(name: str, path: str, value: Any, sentence: str, schema_too: bool = True) -> Bad:
    def edit(document: dict[str, Any]) -> None:
        *steps, last = path.split(".")
        for step in steps:
            document = document.setdefault(step, {})
        document[last] = value

    return edited(name, edit, sentence, schema_too)


def fingers(change: Callable[[list[Any]], Any]) -> Callable[[dict[str, Any]], None]:
    def edit(document: dict[str, Any]) -> None:
        three = [dict(document["finger"]) for _ in range(3)]
        del document["finger"]
        document["fingers"] = change(three) or three

    return edit


CASES = [
    # what is no JSON, or none of ours
    raw("empty", "", "is empty"),
    raw("blank", " \n\t\n", "is empty"),
    raw("not_json", "length = 94.5", "is not valid JSON: Expecting value at line 1, column 1"),
    raw("cut_off", TEXT[:200], "is not valid JSON: "),
    raw("trailing_comma", '{\n  "name": "a",\n}', "is not valid JSON: "),
    raw("comment", "// mine\n" + TEXT, "is not valid JSON: Expecting value at line 1, column 1"),
    raw("two_documents", TEXT + TEXT, "is not valid JSON: Extra data at line"),
    raw("list", "[1, 2, 3]", "must be an object {...}, not [1, 2, 3]"),
    raw("number", "28", "must be an object {...}, not 28"),
    raw("null", "null", "must be an object {...}, not null"),
    raw("latin_1", TEXT.replace("benchmark", "f\u00fcr").encode("latin-1"), "is not UTF-8 text: byte "),
    raw("utf_16", TEXT.encode("utf-16"), "is not UTF-8 text: byte 0 cannot be read"),
    raw("binary", bytes(range(256)), "is not UTF-8 text: byte 128 cannot be read"),
    raw("huge", " " * (SIZE_LIMIT + 1), "is too large for a design file: more than 1000 kB"),
    raw("deep_list", "[" * 100_000, "is nested too deeply"),
    raw("deep_object", '{"finger":' * 100_000, "is nested too deeply"),
    raw("duplicate", TEXT.replace('"name"', '"spacing_mm": 35, "name"', 1), "spacing_mm: this key is given twice"),
    raw("duplicate_inside", TEXT.replace('"rib_count"', '"rib_count": 3, "rib_count"'),
        "finger.rib_count: this key is given twice"),
    # keys
    edited("no_geometry", lambda d: d.pop("geometry"), "geometry: missing; must name a geometry plugin (known: "),
    edited("no_finger", lambda d: d.pop("finger"), 'finger: missing; give it once, or "fingers" as a list of 3'),
    edited("no_spacing", lambda d: d.pop("spacing_mm"), "spacing_mm: missing; must be a number from 15 to 120"),
    edited("no_length", lambda d: d["finger"].pop("length_mm"), "finger.length_mm: missing; must be a number from"),
    put("misspelt", "spacing_m", 0.04, "spacing_m: unknown key; did you mean spacing_mm?"),
    put("misspelt_in_finger", "finger.rib_cuont", 8, "finger.rib_cuont: unknown key; did you mean rib_count?"),
    put("wrong_case", "finger.Length_MM", 90, "finger.Length_MM: unknown key; did you mean length_mm?"),
    put("strange_key", "finger.a\nb", 1, 'finger."a\\nb": unknown key; known: length_mm, width_mm'),
    put("empty_key", "finger.", 1, 'finger."": unknown key; known: '),
    put("misspelt_constant", "protocol.hodl_s", 1, "protocol.hodl_s: unknown key; did you mean hold_s?"),
    put("misspelt_modulus", "material.youngs_modulus_GPa", 1,
        "material.youngs_modulus_GPa: unknown key; did you mean youngs_modulus_MPa?"),
    # types
    put("text_for_number", "finger.length_mm", "94.5", LENGTH + '"94.5"'),
    put("true_for_number", "finger.rib_count", True, "finger.rib_count: must be a whole number from 0 to 30, not true"),
    put("null_for_number", "spacing_mm", None, "spacing_mm: must be a number from 15 to 120, not null"),
    put("list_for_number", "finger.width_mm", [30], "finger.width_mm: must be a number from 10 to 150, not [30]"),
    put("half_a_rib", "finger.rib_count", 7.5, "finger.rib_count: must be a whole number from 0 to 30, not 7.5"),
    put("finger_list", "finger", [1, 2], "finger: must be an object {...}, not [1, 2]"),
    put("protocol_list", "protocol", [], "protocol: must be an object {...}, not []"),
    put("material_text", "material", "rubber", 'material: must be an object {...}, not "rubber"'),
    put("name_number", "name", 7, "name: must be a text of 1 to 100 printable characters, not 7"),
    put("name_blank", "name", " ", 'name: must be a text of 1 to 100 printable characters, not " "'),
    put("name_lines", "name", "a\nb", 'name: must be a text of 1 to 100 printable characters, not "a\\nb"', False),
    put("name_surrogate", "name", "\ud800", "name: must be a text of 1 to 100 printable characters, not ", False),
    # ranges
    put("too_long", "finger.length_mm", 1e6, LENGTH + "1000000.0"),
    put("negative", "finger.contact_wall_mm", -2, "finger.contact_wall_mm: must be a number from 0.4 to 10, not -2"),
    put("metres", "spacing_mm", 0.04, "spacing_mm: must be a number from 15 to 120, not 0.04"),
    put("incompressible", "material.poisson_ratio", 0.5, "material.poisson_ratio: must be a number from 0 to 0.4999"),
    put("no_stiffness", "material.youngs_modulus_MPa", 0,
        "material.youngs_modulus_MPa: must be a number above 0 and up to 1e+06, not 0"),
    put("no_time", "protocol.time_step_ms", 0, "protocol.time_step_ms: must be a number from 0.001 to 1000, not 0"),
    put("negative_friction", "protocol.friction_coefficient", -0.1,
        "protocol.friction_coefficient: must be a number from 0 to 5, not -0.1"),
    raw("nan", TEXT.replace("94.5", "NaN"), LENGTH + "NaN"),
    raw("infinity", TEXT.replace("94.5", "-Infinity"), LENGTH + "-Infinity"),
    raw("overflow", TEXT.replace("94.5", "1e999"), LENGTH + "Infinity"),
    raw("many_digits", TEXT.replace("94.5", "9" * 5000), LENGTH + "Infinity"),
    raw("nan_constant", TEXT[:-2] + ', "protocol": {"hold_s": NaN}}',
        "protocol.hold_s: must be a number from 0 to 600, "),
    raw("long_integer", TEXT.replace('"rib_count": 8', '"rib_count": 1' + "0" * 400),
        "finger.rib_count: must be a whole number from 0 to 30, not 1000"),
    # fingers
    edited("two_fingers", fingers(lambda three: three[:2]), "fingers: must be a list of exactly 3 fingers, 2 given"),
    edited("four_fingers", fingers(lambda three: three + three[:1]),
           "fingers: must be a list of exactly 3 fingers, 4 given"),
    edited("fingers_object", lambda d: d.update(fingers=d.pop("finger")),
           "fingers: must be a list of exactly 3 fingers, not {"),
    put("both", "fingers", [BENCHMARK["finger"]] * 3, 'fingers: give either "finger" or "fingers", not both'),
    edited("second_finger", fingers(lambda three: three[1].update(rib_count=99)),
           "fingers[1].rib_count: must be a whole number from 0 to 30, not 99"),
    edited("third_finger_null", fingers(lambda three: [*three[:2], None]),
           "fingers[2]: must be an object {...}, not null"),
    # values that contradict each other
    edited("walls_fill_the_finger", lambda d: d["finger"].update(width_mm=10, contact_wall_mm=10, back_wall_mm=10),
           "finger: contact_wall_mm 10 and back_wall_mm 10 leave no cavity", False),
    edited("tip_fills_the_finger", fingers(lambda three: three[2].update(length_mm=40, tip_length_mm=60)),
           "fingers[2]: tip_length_mm must stay below 37 for this length_mm, got 60", False),
    edited("ribs_fill_the_finger", lambda d: d["finger"].update(rib_count=30, rib_thickness_mm=8),
           "finger: rib_thickness_mm must stay below ", False),
    # plugins
    put("unknown_geometry", "geometry", "fin_rai", "geometry: there is no geometry plugin 'fin_rai'; known: "),
    put("unknown_mesher", "mesher", {"name": "sweep"}, "mesher: there is no mesher plugin 'sweep'; known: swept"),
    put("plugin_number", "fitness", 4, 'fitness: must be the name of a fitness plugin, or an object with its "name"'),
    put("plugin_nameless", "fitness", {"drop_threshold_mm": 4}, "fitness: must be the name of a fitness plugin, or an"),
    put("unknown_option", "fitness", {"name": "share_held", "drop_treshold_mm": 4},
        "fitness: fitness 'share_held' has no option 'drop_treshold_mm'; allowed: drop_threshold_mm; did you mean"),
    put("option_type", "geometry.profile", "round",
        'geometry.profile: must be one of "isosceles", "right", not "round"'),
    put("option_range", "fitness", {"name": "share_held", "drop_threshold_mm": 0},
        "fitness.drop_threshold_mm: must be a number above 0 and up to 1000 or null, not 0"),
    put("features_text", "features", "workspace", 'features: must be a list of features plugins, not "workspace"'),
    put("features_unknown", "features", ["workspace", "beauty"],
        "features[1]: there is no features plugin 'beauty'; known"),
    put("features_twice", "features", ["volume", {"name": "volume"}], "features[1]: 'volume' is named twice", False),
]


@pytest.fixture(params=CASES, ids=[case.name for case in CASES])
def bad(request, tmp_path) -> tuple[Bad, Path]:
    path = tmp_path / f"{request.param.name}.json"
    path.write_bytes(request.param.content)
    return request.param, path


def check_sentence(text: str) -> None:
    assert text.isprintable() or "\ud800" in text, "one line"
    assert len(text) < 700 and "Traceback" not in text and "pydantic" not in text and "::" not in text


def test_there_are_more_than_forty_cases():
    assert len({case.name for case in CASES}) == len(CASES) > 40


def test_one_sentence_with_file_and_place(bad):
    case, path = bad
    with pytest.raises(InputError) as caught:
        Design.from_json(path)
    check_sentence(str(caught.value))
    assert str(caught.value).startswith(f"{path}: {case.sentence}")


def test_the_command_exits_with_2_and_one_line(bad, capsys):
    _, path = bad
    with pytest.raises(SystemExit) as caught:
        main(["evaluate", str(path)])
    out, err = capsys.readouterr()
    assert caught.value.code == 2 and out == ""
    assert err.startswith(f"finqd: {path}: ") and err.count("\n") == 1


@pytest.mark.parametrize("case", [case for case in CASES if case.schema_too], ids=lambda case: case.name)
def test_the_schema_refuses_what_it_can_express(case, validator):
    assert not validator.is_valid(json.loads(case.content))


@pytest.fixture(scope="module")
def validator() -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(Design.json_schema())


def test_the_schema_takes_the_benchmark(validator):
    assert validator.is_valid(BENCHMARK)
    assert validator.is_valid({**BENCHMARK, "$schema": "finqd.schema.json", "mesher": "swept", "fitness": "share_held"})


def test_places_that_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "pipe.json")
    cases = {
        tmp_path / "none.json": "there is no such file",
        tmp_path: "is a directory, not a design file",
        tmp_path / "pipe.json": "is not a regular file, so not a design file",
        tmp_path / ("x" * 5000): "cannot be read: File name too long",
    }
    for path, words in cases.items():
        with pytest.raises(InputError, match=words):
            Design.from_json(path)
    for text in ("", "a\0b"):
        with pytest.raises(InputError, match="^design: this is no file name: "):
            Design.from_json(text)


def test_an_unreadable_file_is_one_sentence(tmp_path, monkeypatch):
    def refuse(self):
        raise PermissionError(13, "Permission denied")

    (tmp_path / "locked.json").write_text(TEXT)
    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(InputError, match=r"locked\.json: cannot be read: Permission denied$"):
        Design.from_json(tmp_path / "locked.json")


def test_a_text_or_mapping_is_called_design():
    with pytest.raises(InputError, match=r"^design: is not valid JSON: "):
        Design.from_json("{")
    with pytest.raises(InputError, match=r"^design: spacing_mm: must be a number from 15 to 120, not a object$"):
        Design.from_json({**BENCHMARK, "spacing_mm": object()})
    with pytest.raises(InputError, match=r'^design: "5": unknown key; known: name, '):
        Design.from_json({**BENCHMARK, 5: 1})


def test_the_command_prints_no_traceback_in_a_process_of_its_own(tmp_path):
    (tmp_path / "bad.json").write_text(TEXT.replace("94.5", "NaN"))
    run = subprocess.run(
        [sys.executable, "-m", "finqd", "evaluate", "bad.json"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )
    assert (run.returncode, run.stdout) == (2, "")
    assert run.stderr == "finqd: bad.json: finger.length_mm: must be a number from 40 to 300, not NaN\n"


junk = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@settings(deadline=None, max_examples=150)
@given(data=st.data())
def test_whatever_stands_anywhere_is_taken_or_refused_in_one_sentence(data):
    full = {**copy.deepcopy(BENCHMARK), "material": {}, "protocol": {"hold_s": 1}, "fitness": {"name": "share_held"},
            "features": ["workspace"]}
    section = data.draw(st.sampled_from(sorted(full)))
    value = data.draw(junk)
    if isinstance(full[section], dict) and data.draw(st.booleans()):
        known = sorted(full[section])
        full[section][data.draw(st.sampled_from(known) if known else st.text(max_size=5))] = value
    else:
        full[section] = value
    try:
        design = Design.from_json(full)
    except InputError as error:
        check_sentence(str(error))
    else:
        assert Design.from_json(design.to_json()) == design


@settings(deadline=None, max_examples=150)
@given(cut=st.integers(0, len(TEXT) - 1), junk=st.text(max_size=3), drop=st.integers(0, 4))
def test_a_damaged_text_is_taken_or_refused_in_one_sentence(cut, junk, drop):
    try:
        Design.from_json("{" + TEXT[1:cut] + junk + TEXT[max(1, cut) + drop :])
    except InputError as error:
        check_sentence(str(error))
