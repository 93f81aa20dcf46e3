"""Kind and name -> plugin, through entry points: built-ins come through the same door as anybody's.

A distribution registers a plugin by naming it in its ``pyproject.toml``::

    [project.entry-points."finqd.mesher"]
    fine = "my_package:FineMesher"

Only the plugin that is asked for is imported. What a plugin is, `finqd.contracts` says.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from finqd.contracts import KINDS
from finqd.errors import FinqdError, PluginError
from finqd.options import checked, in_words, join, nearest, option_schemas, option_types
from finqd.units import unit_of


@dataclasses.dataclass(frozen=True)
class Entry:
    """One registered plugin: ``target`` is ``module:class``; ``distribution`` and ``version`` say who brought it."""

    kind: str
    name: str
    distribution: str
    version: str
    target: str


@dataclasses.dataclass(frozen=True)
class Option:
    """One option of a plugin, in the unit that its name ends in; ``schema``: its JSON schema, ``allowed``: in words."""

    name: str
    unit: str
    default: Any
    allowed: str
    schema: dict[str, Any]


def entries(kind: str | None = None) -> list[Entry]:
    """Return what is registered, of one kind or of all, sorted by kind and name; nothing is imported."""
    kinds = KINDS if kind is None else (_known(kind),)
    return [
        Entry(k, ep.name, _distribution(ep), ep.dist.version if ep.dist else "?", ep.value)
        for k in kinds
        for ep in sorted(_registered(k), key=lambda ep: (ep.name, _distribution(ep)))
    ]


def names(kind: str) -> list[str]:
    """Return the names registered under ``kind``, sorted, each once."""
    return sorted({entry.name for entry in entries(kind)})


def load(kind: str, name: str, *, where: str = "") -> Any:
    """Return the plugin class registered as ``name``, importing it and nothing else.

    Raises ``PluginError``, with ``where`` in front: unknown (lists the known), registered by two distributions, not
    importable, or not a dataclass (each names the distribution).
    """
    matches = [ep for ep in _registered(_known(kind, where)) if ep.name == name]
    if not matches:
        raise PluginError(f"there is no {kind} plugin {name!r}; {_listed(kind)}", where)
    if len(matches) > 1:
        owners = " and ".join(sorted(f"{_distribution(ep)} ({ep.value})" for ep in matches))
        raise PluginError(f"the {kind} plugin {name!r} is registered {len(matches)} times, by {owners}", where)
    (entry_point,) = matches
    try:
        plugin = entry_point.load()
    except FinqdError:
        raise
    except Exception as error:  # a plugin's module may raise anything at all while it is imported
        text = f"{_label(kind, entry_point)} does not import ({type(error).__name__}: {_line(error)})"
        raise PluginError(text, where) from error
    if not (isinstance(plugin, type) and dataclasses.is_dataclass(plugin)):
        raise PluginError(f"{_label(kind, entry_point)} is not a dataclass: {entry_point.value}", where)
    return plugin


def create(kind: str, spec: str | Mapping[str, Any], *, where: str = "") -> Any:
    """Return the plugin that a design file names: ``"swept"``, or ``{"name": "swept", "size_mm": 4}`` with options.

    ``where``: the JSON path of ``spec``. Raises ``PluginError`` as `load` does, and for an option that is unknown, of
    the wrong type, out of range or not finite (see `finqd.options`).
    """
    if isinstance(spec, str):
        spec = {"name": spec}
    if not isinstance(spec, Mapping) or not isinstance(spec.get("name"), str):
        raise PluginError(f'must be the name of a {kind} plugin, or an object with its "name"; {_listed(kind)}', where)
    name = spec["name"]
    plugin = load(kind, name, where=where)
    types, values = option_types(plugin), {}
    for key, value in spec.items():
        if key in types:
            values[key] = checked(types[key], value, join(where, key), PluginError)
        elif key != "name":
            near = nearest(str(key), types)
            hint = f"; did you mean {near}?" if near else ""
            raise PluginError(
                f"{kind} {name!r} has no option {key!r}; allowed: {', '.join(types) or 'none'}{hint}", where
            )
    try:
        return plugin(**values)
    except (TypeError, ValueError) as error:  # an option without default, or what __post_init__ says of a contradiction
        raise PluginError(f"{kind} {name!r}: {_line(error)}", where) from error


def options(kind: str, name: str) -> list[Option]:
    """Return the options of a plugin, in the order of its fields."""
    return [
        Option(key, unit_of(key), schema.get("default"), in_words(schema), schema)
        for key, schema in option_schemas(load(kind, name)).items()
    ]


def _registered(kind: str) -> tuple[EntryPoint, ...]:
    return _scanned(tuple(sys.path))[kind]


@lru_cache(maxsize=8)
def _scanned(path: tuple[str, ...]) -> dict[str, tuple[EntryPoint, ...]]:
    """Return what the distributions on ``path`` (this is ``sys.path``) register, by kind.

    Kept, since one look takes about 15 ms: what is installed while a process runs, the next process sees.
    """
    everything = entry_points()
    return {kind: tuple(everything.select(group=f"finqd.{kind}")) for kind in KINDS}


def _known(kind: str, where: str = "") -> str:
    if kind not in KINDS:
        raise PluginError(f"there is no plugin kind {kind!r}; known: {', '.join(KINDS)}", where)
    return kind


def _label(kind: str, entry_point: EntryPoint) -> str:
    """Return who is to blame; to name the distribution takes milliseconds, so only where something is wrong."""
    return f"the {kind} plugin {entry_point.name!r} of the distribution {_distribution(entry_point)!r}"


def _listed(kind: str) -> str:
    return f"known: {', '.join(names(kind)) or 'none'}"


def _distribution(entry_point: EntryPoint) -> str:
    return entry_point.dist.name if entry_point.dist else "?"


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
