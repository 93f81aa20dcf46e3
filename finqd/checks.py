"""The conformance kit: what every plugin of a kind must satisfy, run by finqd's own tests and by anybody's.

A third party's whole test file::

    from finqd.checks import parametrize_with_checks

    @parametrize_with_checks(distribution="my-fingers")
    def test_conformance(check, kind, name):
        check(kind, name)

A check takes kind and name of a registered plugin, returns nothing, and raises ``AssertionError`` with a sentence that
says what the plugin does against its contract (`finqd.contracts`).
"""

from __future__ import annotations

import dataclasses
import json
import pickle
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from finqd import registry
from finqd.checks_mechanics import CONTACT, ELASTICITY, STEPPER
from finqd.checks_scores import ACTUATION, FEATURES, FITNESS
from finqd.checks_shape import GEOMETRY, MESHER
from finqd.contracts import KINDS
from finqd.errors import InputError, PluginError

Check = Callable[[str, str], None]


def check_is_a_frozen_dataclass(kind: str, name: str) -> None:
    """Equal options make equal plugins, and nobody can change a plugin that others hold."""
    plugin = registry.load(kind, name)
    assert plugin.__dataclass_params__.frozen, f"{plugin.__name__} is not frozen: write @dataclass(frozen=True)"
    assert plugin.__dataclass_params__.eq, f"two {plugin.__name__} with the same options are not equal"


def check_says_what_it_is(kind: str, name: str) -> None:
    """The docstring's first line is what ``finqd plugins`` prints."""
    plugin = registry.load(kind, name)
    text = (plugin.__doc__ or "").strip()
    made_up = text.startswith(f"{plugin.__name__}(")  # what the dataclass decorator writes if there is none
    assert text and not made_up, f"{plugin.__name__} has no docstring"


def check_works_without_options(kind: str, name: str) -> None:
    """Every option has a default, so that the name alone is a choice."""
    plugin = registry.create(kind, name)
    assert plugin == registry.create(kind, {"name": name}), f"{kind} {name!r} differs from itself"


def check_options_are_json(kind: str, name: str) -> None:
    """A plugin with all its options written out in JSON is the plugin with none written out."""
    options = registry.options(kind, name)
    for option in options:
        assert option.schema, f"option {option.name} of {kind} {name!r} has no type"
    written = json.loads(json.dumps({option.name: option.default for option in options}, allow_nan=False))
    again = registry.create(kind, {"name": name, **written})
    assert again == registry.create(kind, name), f"{kind} {name!r} is not what its own defaults {written} make"


def check_refuses_an_unknown_option(kind: str, name: str) -> None:
    """A misspelt option is never ignored; the answer lists what there is."""
    known = [field.name for field in dataclasses.fields(registry.load(kind, name)) if field.init]
    try:
        registry.create(kind, {"name": name, "no_such_option": 1})
    except PluginError as error:
        missing = [option for option in ("no_such_option", *known) if option not in str(error)]
        assert not missing, f"the refusal {str(error)!r} does not name {missing}"
    else:
        raise AssertionError(f"{kind} {name!r} takes an option that it does not have")


def check_travels_to_workers(kind: str, name: str) -> None:
    """Evaluations run in other processes."""
    plugin = registry.create(kind, name)
    assert pickle.loads(pickle.dumps(plugin)) == plugin, f"{kind} {name!r} is another one after pickling"


EVERY_KIND: tuple[Check, ...] = (
    check_is_a_frozen_dataclass, check_says_what_it_is, check_works_without_options, check_options_are_json,
    check_refuses_an_unknown_option, check_travels_to_workers,
)
OF_A_KIND: dict[str, tuple[Check, ...]] = {
    "geometry": GEOMETRY, "mesher": MESHER, "elasticity": ELASTICITY, "stepper": STEPPER, "contact": CONTACT,
    "actuation": ACTUATION, "fitness": FITNESS, "features": FEATURES,
}


def checks_of(kind: str) -> tuple[Check, ...]:
    """Return the checks that a plugin of this kind must pass. Raises ``PluginError`` for an unknown kind."""
    if kind not in KINDS:
        raise PluginError(f"there is no plugin kind {kind!r}; known: {', '.join(KINDS)}")
    return EVERY_KIND + OF_A_KIND[kind]


def cases(*, kinds: Iterable[str] = KINDS, distribution: str | None = None) -> Iterator[tuple[Check, str, str]]:
    """Yield (check, kind, name) for all registered plugins, or for those that one distribution brought."""
    for kind in kinds:
        for entry in registry.entries(kind):
            if distribution is None or _normal(entry.distribution) == _normal(distribution):
                yield from ((check, kind, entry.name) for check in checks_of(kind))


def parametrize_with_checks(*, kinds: Iterable[str] = KINDS, distribution: str | None = None) -> Any:
    """Return the ``pytest.mark.parametrize`` of a test function of (check, kind, name): one test a case.

    ``distribution``: only plugins that this distribution registers. Raises ``InputError`` if there is nothing to test,
    since a kit that tests nothing would pass.
    """
    import pytest

    found = list(cases(kinds=kinds, distribution=distribution))
    if not found:
        raise InputError(f"no plugin to check is registered by {distribution or 'any distribution'}; is it installed?")
    ids = [f"{kind}-{name}-{check.__name__.removeprefix('check_')}" for check, kind, name in found]
    return pytest.mark.parametrize(("check", "kind", "name"), found, ids=ids)


def _normal(distribution: str) -> str:
    """Return a distribution's name as package indexes compare it."""
    return distribution.lower().replace("_", "-").replace(".", "-")
