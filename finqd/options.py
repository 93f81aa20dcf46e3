"""The options of a plugin: the fields of its dataclass, read as JSON and checked against their annotations.

>>> in_words({"type": "number", "minimum": 0.5, "maximum": 20})
'a number from 0.5 to 20'
>>> in_words({"type": "integer", "exclusiveMinimum": 0})
'a whole number above 0'
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any, get_type_hints

from finqd.errors import PluginError
from finqd.units import unit_of


@dataclasses.dataclass(frozen=True)
class Option:
    """One option, in the unit that its name ends in; ``schema``: its JSON schema, ``allowed``: the same in words."""

    name: str
    default: Any
    unit: str
    allowed: str
    schema: dict[str, Any]


def options_of(plugin: type) -> list[Option]:
    """Return the options of a plugin class, in the order of its fields."""
    hints = _types(plugin)
    found = []
    for field in dataclasses.fields(plugin):
        if field.name in hints:
            schema = _adapter(hints[field.name]).json_schema()
            default = None if field.default is dataclasses.MISSING else field.default
            if field.default_factory is not dataclasses.MISSING:
                default = field.default_factory()
            found.append(Option(field.name, default, unit_of(field.name), in_words(schema), schema))
    return found


def checked_options(plugin: type, given: Mapping[str, Any], *, label: str, where: str = "") -> dict[str, Any]:
    """Return ``given`` with each value converted to its option's type.

    Values are read as JSON: a list may stand for a tuple and a whole number for a float, but true and false never for
    numbers, and neither NaN nor inf is a number. Raises ``PluginError``, naming the place and what is allowed;
    ``label`` names the plugin.
    """
    hints = _types(plugin)
    for key in given:
        if key not in hints:
            raise PluginError(f"{label} has no option {key!r}; allowed: {', '.join(hints) or 'none'}", where)
    prefix = f"{where}." if where else ""
    return {key: _checked(hints[key], value, prefix + str(key)) for key, value in given.items()}


def in_words(schema: Mapping[str, Any]) -> str:
    """Return what a JSON schema allows, as in "a number from 0.5 to 20"."""
    if "anyOf" in schema:
        return " or ".join(in_words(part) for part in schema["anyOf"])
    if "enum" in schema or "const" in schema:
        values = [json.dumps(value) for value in schema.get("enum", [schema.get("const")])]
        return "one of " + ", ".join(values) if len(values) > 1 else values[0]
    words = _TYPES.get(str(schema.get("type", "")), "a value")
    if "minimum" in schema and "maximum" in schema:
        return f"{words} from {schema['minimum']:g} to {schema['maximum']:g}"
    limits = [f"{said} {schema[key]:g}" for key, said in _LIMITS.items() if key in schema]
    return " ".join([words, " and ".join(limits)]).strip()


_TYPES = {
    "number": "a number", "integer": "a whole number", "boolean": "true or false", "string": "a text",
    "null": "null", "array": "a list", "object": "an object",
}
_LIMITS = {
    "minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below",
    "minItems": "of at least", "maxItems": "of at most",
}


def _types(plugin: type) -> dict[str, Any]:
    """Return option name -> annotated type, of the fields that the constructor takes."""
    hints = get_type_hints(plugin, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(plugin) if field.init}


def _adapter(annotation: Any) -> Any:
    from pydantic import ConfigDict, PydanticUserError, TypeAdapter

    try:
        return TypeAdapter(annotation, config=ConfigDict(strict=True, allow_inf_nan=False))
    except PydanticUserError:  # a nested dataclass brings its own configuration
        return TypeAdapter(annotation)


def _checked(annotation: Any, value: Any, where: str) -> Any:
    from pydantic import ValidationError

    adapter = _adapter(annotation)
    try:
        text = json.dumps(value)
        return adapter.validate_json(text)
    except ValidationError as error:
        raise PluginError(f"must be {in_words(adapter.json_schema())}, not {text[:60]}", where) from error
    except (TypeError, ValueError) as error:
        raise PluginError(f"must be {in_words(adapter.json_schema())}, not a {type(value).__name__}", where) from error
