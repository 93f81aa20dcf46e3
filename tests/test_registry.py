"""The plugin door: every kind, from a distribution that exists only for the test."""

from __future__ import annotations

import sys

import pytest

from finqd import registry
from finqd.contracts import KINDS
from finqd.errors import PluginError

SOURCE = '''
"""A module with one plugin."""
from __future__ import annotations
from dataclasses import dataclass
from typing import Annotated, Literal
from pydantic import Field

@dataclass(frozen=True)
class Mine:
    """First line.

    More.
    """

    size_mm: Annotated[float, Field(gt=0, le=20)] = 4.0
    count: Annotated[int, Field(ge=1, le=10)] = 8
    mode: Literal["a", "b"] = "a"
    fancy: bool = False
    pair: tuple[float, float] = (1.0, 2.0)
    maybe: float | None = None

    def __post_init__(self):
        if self.mode == "b" and self.fancy:
            raise ValueError("mode b is never\\n fancy")

@dataclass(frozen=True)
class Needy:
    """Has an option without default."""

    must: float
'''


@pytest.fixture
def mine(make_distribution):
    make_distribution(
        "fake-fingers", {kind: {"mine": "fake_fingers:Mine"} for kind in KINDS}, module="fake_fingers", source=SOURCE
    )


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_is_listed_and_loaded_from_a_foreign_distribution(mine, kind):
    assert "mine" in registry.names(kind)
    (entry,) = [entry for entry in registry.entries(kind) if entry.name == "mine"]
    assert (entry.distribution, entry.version, entry.target) == ("fake-fingers", "1.5", "fake_fingers:Mine")
    assert "fake_fingers" not in sys.modules, "listing imports nothing"
    assert registry.load(kind, "mine").__name__ == "Mine"
    assert registry.create(kind, "mine").size_mm == 4.0
    assert registry.create(kind, {"name": "mine", "count": 3}).count == 3


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_has_a_built_in_under_its_own_group(kind):
    assert [entry for entry in registry.entries(kind) if entry.distribution == "finqd"]


@pytest.mark.parametrize("kind", KINDS)
def test_an_unknown_name_is_answered_with_the_known_ones(mine, kind):
    with pytest.raises(PluginError, match=rf"^here: there is no {kind} plugin 'mime'; known: .*\bmine\b"):
        registry.load(kind, "mime", where="here")


def test_an_unknown_kind_is_answered_with_the_kinds():
    for call in (registry.entries, registry.names):
        with pytest.raises(PluginError, match="no plugin kind 'geometri'; known: geometry, mesher"):
            call("geometri")
    with pytest.raises(PluginError, match="no plugin kind 'geometri'"):
        registry.load("geometri", "fin_ray")


@pytest.mark.parametrize("kind", KINDS)
def test_two_distributions_with_one_name_are_both_named(mine, make_distribution, kind):
    make_distribution("rival", {kind: {"mine": "rival_module:Other"}})
    with pytest.raises(PluginError, match=r"2 times, by fake-fingers \(.*\) and rival \(rival_module:Other\)"):
        registry.load(kind, "mine")


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("import not_there_at_all", "ModuleNotFoundError: No module named 'not_there_at_all'"),
        ("1 / 0", "ZeroDivisionError"),
        ("def f(:", "SyntaxError"),
        ("", "AttributeError"),
    ],
)
def test_a_failing_import_names_the_distribution_and_the_cause(make_distribution, source, said):
    make_distribution("broken", {"mesher": {"bad": "broken_module:Bad"}}, module="broken_module", source=source)
    with pytest.raises(PluginError, match=f"'bad' of the distribution 'broken' does not import .{said}") as caught:
        registry.load("mesher", "bad")
    assert "\n" not in str(caught.value)
    registry.names("mesher")  # the others are none the worse


def test_something_else_than_a_dataclass_is_refused(make_distribution):
    make_distribution("odd", {"mesher": {"odd": "odd_module:f"}}, module="odd_module", source="def f(): ...")
    with pytest.raises(PluginError, match="of the distribution 'odd' is not a dataclass: odd_module:f"):
        registry.load("mesher", "odd")


def test_only_the_plugin_named_is_imported(mine, make_distribution):
    make_distribution("bomb", {"mesher": {"bomb": "bomb_module:Bomb"}}, module="bomb_module", source="1 / 0")
    registry.load("mesher", "mine")
    assert "bomb_module" not in sys.modules


@pytest.mark.parametrize(
    ("options", "field", "value"),
    [
        ({"size_mm": 4}, "size_mm", 4.0),
        ({"size_mm": 0.5}, "size_mm", 0.5),
        ({"pair": [3, 4.5]}, "pair", (3.0, 4.5)),
        ({"maybe": None}, "maybe", None),
        ({"mode": "b"}, "mode", "b"),
    ],
)
def test_options_become_the_type_of_their_field(mine, options, field, value):
    got = getattr(registry.create("mesher", {"name": "mine", **options}), field)
    assert got == value and type(got) is type(value)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"sise_mm": 4}, r"mesher: mesher 'mine' has no option 'sise_mm'; allowed: size_mm, count, mode, fancy"),
        ({"size_mm": 0}, r"mesher\.size_mm: must be a number above 0 and up to 20, not 0"),
        ({"size_mm": 20.5}, "not 20.5"),
        ({"size_mm": "4"}, 'not "4"'),
        ({"size_mm": True}, "not true"),
        ({"size_mm": None}, "not null"),
        ({"size_mm": float("nan")}, "not NaN"),
        ({"size_mm": float("inf")}, "not Infinity"),
        ({"count": 2.5}, "must be a whole number from 1 to 10, not 2.5"),
        ({"count": True}, "not true"),
        ({"count": 11}, "not 11"),
        ({"mode": "c"}, 'must be one of "a", "b", not "c"'),
        ({"fancy": 1}, "must be true or false, not 1"),
        ({"pair": [1]}, r"must be a list of 2, not \[1\]"),
        ({"maybe": "x"}, "must be a number or null"),
        ({"maybe": {1, 2}}, "not a set"),
        ({"mode": "b", "fancy": True}, "'mine': mode b is never fancy"),
    ],
)
def test_bad_options_get_one_sentence_with_place_and_range(mine, options, said):
    with pytest.raises(PluginError, match=said) as caught:
        registry.create("mesher", {"name": "mine", **options}, where="mesher")
    assert str(caught.value).startswith("mesher") and "\n" not in str(caught.value)


@pytest.mark.parametrize("spec", [3, None, [], {}, {"name": 3}, {"size_mm": 4}])
def test_a_spec_that_names_nothing_is_refused(mine, spec):
    with pytest.raises(PluginError, match='must be the name of a mesher plugin, or an object with its "name"; known: '):
        registry.create("mesher", spec)


def test_an_option_without_default_must_be_given(make_distribution):
    make_distribution("needy", {"mesher": {"needy": "needy_module:Needy"}}, module="needy_module", source=SOURCE)
    with pytest.raises(PluginError, match="missing 1 required positional argument: 'must'"):
        registry.create("mesher", "needy")


def test_options_say_name_default_unit_and_range(mine):
    found = {option.name: option for option in registry.options("mesher", "mine")}
    assert list(found) == ["size_mm", "count", "mode", "fancy", "pair", "maybe"]
    assert found["size_mm"].unit == "mm" and found["size_mm"].default == 4.0
    assert found["size_mm"].schema == {
        "type": "number", "exclusiveMinimum": 0, "maximum": 20, "default": 4.0,
    }
    assert found["count"].allowed == "a whole number from 1 to 10" and found["count"].unit == ""
    assert found["mode"].schema["enum"] == ["a", "b"]


def test_what_is_installed_is_looked_up_once_for_each_path(mine, monkeypatch):
    calls = []
    real = registry.entry_points
    monkeypatch.setattr(registry, "entry_points", lambda: calls.append(1) or real())
    registry._scanned.cache_clear()
    for _ in range(3):
        assert "mine" in registry.names("mesher") and registry.load("geometry", "mine")
    assert len(calls) == 1
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if "fake-fingers" not in entry])
    assert "mine" not in registry.names("mesher"), "another path is looked at anew"
    assert len(calls) == 2
