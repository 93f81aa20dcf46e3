"""Designs: what goes in comes out, whichever way it went in."""

from __future__ import annotations

import json
import math
import pickle

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finqd.contracts import KINDS
from finqd.data import bundled_names, designs_folder
from finqd.design import Design, design_parameters, parse_setting
from finqd.design_schema import DEFAULT_PLUGINS, SPACING
from finqd.errors import InputError
from finqd.presets import PRESETS, apply_preset
from finqd.protocol import GraspProtocol

PARAMETERS = design_parameters()
BENCHMARK = [94.5, 37.5, 21.3, 15.0, 2.0, 2.0, 8.0, 2.0, 0.0]

#: a finger type of somebody else: three parameters, one of them a count, and a contradiction of its own
CONE = '''
"""A solid finger."""
from __future__ import annotations
from dataclasses import dataclass
from typing import ClassVar
from finqd.contracts import Parameter

@dataclass(frozen=True)
class Cone:
    """A solid, tapered finger."""

    finger_parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(name="length", unit="mm", low=50, high=100, allowed_low=10, allowed_high=200),
        Parameter(name="tilt", unit="deg", low=-10, high=10, allowed_low=-45, allowed_high=45),
        Parameter(name="facets", unit="", low=3, high=6, allowed_low=3, allowed_high=12, integer=True),
    )
    blunt: bool = False

    def check(self, finger):
        return "length_mm is too short for so much tilt_deg" if finger["length"] < finger["tilt"] / 10 else None

    def build(self, finger):
        raise NotImplementedError
'''


@pytest.fixture
def benchmark() -> Design:
    return Design.from_json(designs_folder() / "benchmark.json")


@pytest.fixture
def cone(make_distribution):
    make_distribution("cones", {"geometry": {"cone": "cones_plugin:Cone"}}, module="cones_plugin", source=CONE)


def units(n: int) -> st.SearchStrategy:
    """Points of the unit cube, its faces and corners among them."""
    return st.lists(st.floats(0, 1) | st.sampled_from([0.0, 1.0, math.nextafter(1, 0)]), min_size=n, max_size=n)


# -- JSON ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", bundled_names(designs_folder()))
def test_designs_that_come_with_finqd_are_canonical_and_named_after_their_file(name):
    path = designs_folder() / f"{name}.json"
    design = Design.from_json(path)
    assert design.name == name
    assert design.to_json() == path.read_text(), "written as finqd would write it"
    assert Design.from_json(design.to_json()) == design
    jsonschema.validate(json.loads(path.read_text()), Design.json_schema())


def test_benchmark_holds_the_papers_numbers(benchmark):
    np.testing.assert_array_equal(benchmark.to_vector(), BENCHMARK * 3 + [40.0])
    assert benchmark.warnings == ("finger.tip_length_mm: 15 lies outside the search range 20 to 30",)
    assert benchmark.spacing == 0.04
    assert benchmark.workspace == pytest.approx(2078.46e-6, abs=0.005e-6)
    assert (benchmark.material.youngs_modulus, benchmark.material.poisson_ratio) == (11.6e6, 0.49)


def test_fingers_become_si_once(benchmark):
    design = benchmark.with_overrides({"fingers[2].rib_angle_deg": 30})
    finger = design.finger_si(2)
    assert finger["length"] == pytest.approx(0.0945, rel=1e-15)
    assert finger["rib_angle"] == pytest.approx(math.pi / 6, rel=1e-15)
    assert finger["rib_count"] == 8 and isinstance(finger["rib_count"], int)
    assert design.finger_si(0)["rib_angle"] == 0.0
    assert list(finger) == [p.name for p in design.plugin("geometry").finger_parameters]


def test_text_mapping_and_file_give_the_same_design(benchmark, tmp_path):
    text = benchmark.to_json()
    (tmp_path / "other.json").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert Design.from_json(text) == Design.from_json(json.loads(text)) == benchmark
    assert Design.from_json(tmp_path / "other.json") == Design.from_json(str(tmp_path / "other.json")) == benchmark


def test_a_file_without_a_name_is_named_after_itself(benchmark, tmp_path):
    document = {key: value for key, value in benchmark.to_dict().items() if key != "name"}
    (tmp_path / "slim.json").write_text(json.dumps(document))
    assert Design.from_json(tmp_path / "slim.json").name == "slim"
    assert Design.from_json(document).name == "unnamed"


def test_one_design_has_one_spelling(benchmark):
    document = benchmark.to_dict()
    finger = document.pop("finger")
    as_three = Design.from_json({**document, "fingers": [finger, {**finger, "rib_angle_deg": -0.0}, finger]})
    spelt = Design.from_json({**document, "finger": {**finger, "rib_count": 8.0, "tip_length_mm": 15}})
    assert as_three == spelt == benchmark
    assert as_three.to_json() == spelt.to_json() == benchmark.to_json()
    assert hash(as_three) == hash(benchmark)


def test_a_design_is_read_only_and_survives_pickling(benchmark):
    with pytest.raises(TypeError):
        benchmark.fingers[0]["length_mm"] = 1.0
    benchmark.to_dict()["finger"]["length_mm"] = 1.0
    copy = pickle.loads(pickle.dumps(benchmark))
    assert copy == benchmark and copy.warnings == benchmark.warnings and copy.digest() == benchmark.digest()


def test_digest_follows_what_is_simulated_and_nothing_else(benchmark):
    assert Design.from_json(benchmark.resolved()).digest() == benchmark.digest()
    assert benchmark.with_overrides({"name": "x", "description": "y"}).digest() == benchmark.digest()
    changes = {"protocol.hold_s": 1.5, "finger.rib_count": 7, "spacing_mm": 39.9, "material.poisson_ratio": 0.48,
               "geometry.profile": "right", "fitness.drop_threshold_mm": 9, "features": ["workspace"]}
    digests = {benchmark.with_overrides({key: value}).digest() for key, value in changes.items()}
    assert len(digests) == len(changes) and benchmark.digest() not in digests


def test_resolved_writes_out_every_default(benchmark):
    resolved = benchmark.resolved()
    assert set(KINDS) <= set(resolved)
    assert resolved["protocol"] == GraspProtocol().as_dict()
    assert resolved["features"][1] == {"name": "volume", "plate_mm": 2.75}
    again = Design.from_json(resolved)
    assert again.resolved() == resolved


def test_plugins_of_every_kind_are_made_with_their_options(benchmark):
    design = benchmark.with_overrides({"fitness.drop_threshold_mm": 3})
    assert design.plugin("fitness").drop_threshold_mm == 3.0
    assert [type(p).__name__ for p in design.plugin("features")] == ["Workspace", "Volume"]
    assert design.plugin("geometry").profile == "isosceles"
    with pytest.raises(InputError, match="no plugin kind 'colour'"):
        design.plugin("colour")


@pytest.mark.parametrize("kind", DEFAULT_PLUGINS)
def test_defaults_are_registered(benchmark, kind):
    assert benchmark.plugin(kind) is not None


# -- vectors ---------------------------------------------------------------------------------------


def test_vector_order_is_three_fingers_then_spacing():
    paths = [path for path, _ in PARAMETERS]
    assert len(paths) == 28 and paths[-1] == "spacing_mm" and PARAMETERS[-1][1] is SPACING
    assert paths[:9] == [
        f"fingers[0].{key}" for key in (
            "length_mm", "width_mm", "thickness_mm", "tip_length_mm", "contact_wall_mm", "back_wall_mm", "rib_count",
            "rib_thickness_mm", "rib_angle_deg",
        )
    ]
    assert paths[9] == "fingers[1].length_mm"


@settings(deadline=None, max_examples=60)
@given(unit=units(28))
def test_unit_vector_and_design_round_trip(unit):
    design = Design.from_unit_vector(unit, name="any")
    assert design.warnings == (), "a search stays in the search ranges"
    again = Design.from_vector(design.to_vector(), name="any")
    assert again == design and again.to_json() == design.to_json() and Design.from_json(design.to_json()) == design
    back = design.to_unit_vector()
    for (_, p), u, v in zip(PARAMETERS, unit, back):
        bins = p.high - p.low + 1
        assert abs(u - v) <= (0.5 / bins + 1e-12 if p.integer else 1e-12)
    assert np.all(np.abs(Design.from_unit_vector(back).to_vector() - design.to_vector()) <= 1e-11)


def test_whole_numbers_get_equal_shares_of_the_unit_interval():
    index = [path for path, _ in PARAMETERS].index("fingers[0].rib_count")
    unit = np.full(28, 0.5)
    counts = []
    for u in (np.arange(50) + 0.5) / 50:
        unit[index] = u
        counts.append(Design.from_unit_vector(unit).fingers[0]["rib_count"])
    assert [counts.count(n) for n in range(1, 11)] == [5] * 10
    assert set(counts) == set(range(1, 11))


def test_corners_of_the_unit_cube_are_the_search_ranges():
    low, high = Design.from_unit_vector(np.zeros(28)), Design.from_unit_vector(np.ones(28))
    np.testing.assert_array_equal(low.to_vector(), [p.low for _, p in PARAMETERS])
    np.testing.assert_array_equal(high.to_vector(), [p.high for _, p in PARAMETERS])


def test_the_benchmark_has_no_place_in_the_unit_cube_but_a_nearest_one(benchmark):
    with pytest.raises(InputError, match=r"^fingers\[0\]\.tip_length_mm: 15 lies outside the search range 20 to 30$"):
        benchmark.to_unit_vector()
    unit = benchmark.to_unit_vector(clip=True)
    assert unit[3] == 0.0 and unit[6] == 0.75 and unit[27] == 1.0


def test_settings_carry_over_to_other_vectors(benchmark):
    base = benchmark.with_overrides({"protocol.hold_s": 2, "geometry.profile": "right"})
    design = Design.from_unit_vector(np.full(28, 0.5), **base.settings)
    assert design.protocol.hold_s == 2.0 and design.plugin("geometry").profile == "right"
    assert Design.from_vector(base.to_vector(), **base.settings) == base


@pytest.mark.parametrize("change, sentence", [
    (lambda v: v[:-1], "vector: must be 28 numbers, not 27"),
    (lambda v: [v], "vector: must be 28 numbers, not 1 x 28"),
    (lambda v: 3.0, "vector: must be 28 numbers, not one number"),
    (lambda v: ["a", *v[1:]], "vector: must be 28 numbers"),
    (lambda v: [*v[:3], math.nan, *v[4:]], "vector: entry 3 (fingers[0].tip_length_mm): must be a finite number, not"),
    (lambda v: [*v[:27], math.inf], "vector: entry 27 (spacing_mm): must be a finite number, not inf"),
    (lambda v: [*v[:27], 500.0], "vector: entry 27 (spacing_mm): must be a number from 15 to 120, not 500.0"),
    (lambda v: [*v[:15], 7.5, *v[16:]], "vector: entry 15 (fingers[1].rib_count): must be a whole number from"),
])
def test_bad_vectors_name_the_entry(change, sentence):
    with pytest.raises(InputError) as caught:
        Design.from_vector(change(BENCHMARK * 3 + [40.0]))
    assert str(caught.value).startswith(sentence)


def test_bad_unit_vectors_name_the_entry():
    unit = np.full(28, 0.5)
    unit[10] = 1.0 + 1e-9
    with pytest.raises(InputError, match=r"unit vector: entry 10 \(fingers\[1\]\.width_mm\): must be .* 0 to 1"):
        Design.from_unit_vector(unit)
    with pytest.raises(InputError, match="spacing_mm comes from the vector"):
        Design.from_vector(BENCHMARK * 3 + [40.0], spacing_mm=30)


# -- other finger types ----------------------------------------------------------------------------


def test_a_finger_type_with_other_parameters_needs_no_change(cone):
    parameters = design_parameters("cone")
    assert len(parameters) == 10
    rng = np.random.default_rng(1)
    for unit in rng.random((20, 10)):
        design = Design.from_unit_vector(unit, geometry="cone")
        assert design.parameters == parameters
        assert Design.from_vector(design.to_vector(), geometry="cone") == Design.from_json(design.to_json()) == design
        assert np.all(np.abs(Design.from_unit_vector(design.to_unit_vector(), geometry="cone").to_vector()
                             - design.to_vector()) <= 1e-11)
    finger = {"length_mm": 80, "tilt_deg": 5, "facets": 4}
    document = {"geometry": {"name": "cone", "blunt": True}, "finger": finger, "spacing_mm": 35}
    si = {"length": 0.08, "tilt": pytest.approx(math.radians(5)), "facets": 4}
    assert Design.from_json(document).finger_si(1) == si
    jsonschema.validate(document, Design.json_schema("cone"))
    with pytest.raises(InputError, match=r"^design: finger: length_mm is too short for so much tilt_deg$"):
        Design.from_json({**document, "finger": {"length_mm": 60, "tilt_deg": 45, "facets": 4}})


# -- overrides and presets -------------------------------------------------------------------------


def test_overrides_reach_every_section(benchmark):
    design = benchmark.with_overrides({
        "protocol.hold_s": 2, "spacing_mm": 36, "material.density_kg_m3": 1000, "geometry": "fin_ray",
        "fingers[1].rib_count": 5, "finger.contact_wall_mm": 1.5, "features[1].plate_mm": 3, "fitness": "share_held",
        "features[0]": {"name": "workspace"}, "name": "changed",
    })
    assert design.protocol.hold_s == 2.0 and design.spacing_mm == 36.0 and design.name == "changed"
    assert [f["rib_count"] for f in design.fingers] == [8, 5, 8]
    assert [f["contact_wall_mm"] for f in design.fingers] == [1.5] * 3
    assert design.plugin("features")[1].plate_mm == 3.0
    assert benchmark.spacing_mm == 40.0, "the design itself stays as it was"


def test_overriding_all_three_fingers_keeps_or_unites_them(benchmark):
    apart = benchmark.with_overrides({"fingers[0].rib_count": 5})
    assert "fingers" in apart.document
    assert apart.with_overrides({"finger.rib_count": 8}) == benchmark
    assert apart.with_overrides({"finger": benchmark.to_dict()["finger"]}) == benchmark


@pytest.mark.parametrize("overrides, sentence", [
    ({"protocol.hold_s": -1}, "--set: protocol.hold_s: must be a number from 0 to 600, not -1"),
    ({"protocol.hodl_s": 1}, "--set: protocol.hodl_s: unknown key; did you mean hold_s?"),
    ({"protocl.hold_s": 1}, "--set: protocl: unknown key; did you mean protocol?"),
    ({"fingers[3].rib_count": 1}, "--set: fingers[3]: there are only 3 entries here"),
    ({"finger.rib_count": 0.5}, "--set: finger.rib_count: must be a whole number from"),
    ({"spacing_mm.x": 1}, "--set: spacing_mm.x: there are no keys here"),
    ({"protocol[0]": 1}, "--set: protocol[0]: there are no entries here"),
    ({"a..b": 1}, '--set: this is no path such as protocol.hold_s or fingers[1].rib_count: "a..b"'),
    ({"": 1}, "--set: this is no path"),
    ({"fingers": 3}, "--set: fingers: must be a list of exactly 3 fingers, not 3"),
])
def test_bad_overrides_are_one_sentence(benchmark, overrides, sentence):
    with pytest.raises(InputError) as caught:
        benchmark.with_overrides(overrides, source="--set:")
    assert str(caught.value).startswith(sentence) and "\n" not in str(caught.value)


def test_settings_are_parsed_as_json_or_text():
    assert parse_setting("a=[1, 2]") == ("a", [1, 2])
    assert parse_setting("a.b = x=y") == ("a.b", "x=y")
    for text in ("a", "=1", ""):
        with pytest.raises(InputError, match="--set: must be key=value"):
            parse_setting(text)


def test_presets_set_what_is_open_and_nothing_else(benchmark):
    fine = apply_preset(benchmark, "fine")
    assert (fine.plugin("mesher").size_mm, fine.protocol.time_step_ms) == (2.0, 10.0)
    own = {"size_mm": 3, "layers": 4, "order": 1, "notch_nodes": "middle"}
    stepper = {"name": "implicit_euler", "tolerance_share": 1e-4, "stall_iterations": 7,
               "contact_curvature": True}
    contact = {"name": "penalty", "stiffness_N_mm3": 200.0, "smoothing_mm": 0.02, "friction_stiffness_ratio": 0.3,
               "sample_spacing_mm": 0.4}
    explicit = benchmark.with_overrides(
        {"mesher": {"name": "swept", **own}, "stepper": stepper, "contact": contact, "protocol.time_step_ms": 7,
         "protocol.calm_step_factor": 1})
    assert apply_preset(explicit, "draft").digest() == explicit.digest()
    other = apply_preset(benchmark.with_overrides({"mesher": "tetrahedral"}), "draft")
    assert other.spec("mesher")["name"] == "tetrahedral"
    with pytest.raises(InputError, match="--preset: there is no preset 'fnie'; known: draft, standard, fine"):
        apply_preset(benchmark, "fnie")


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_only_name_options_that_exist(benchmark, preset):
    for mesher in PRESETS[preset]["mesher"]:
        design = apply_preset(benchmark.with_overrides({"mesher": mesher}), preset)
        assert design.plugin("mesher").size_mm == PRESETS[preset]["mesher"][mesher]["size_mm"]


def test_protocol_constants_have_units_and_descriptions():
    protocol = GraspProtocol()
    assert (protocol.si("lift_mm"), protocol.si("time_step_ms"), protocol.si("gravity_m_s2")) == (0.03, 0.01, 9.81)
    schema = Design.json_schema()["properties"]["protocol"]["properties"]
    assert list(schema) == list(protocol.as_dict())
    assert all(one["description"] and one["default"] == protocol.as_dict()[key] for key, one in schema.items())


def test_schema_is_itself_valid():
    jsonschema.Draft202012Validator.check_schema(Design.json_schema())
