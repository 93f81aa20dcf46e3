"""Checks values against annotated dataclass fields, and says in words what is allowed.

The options of plugins, the protocol's constants and the material are dataclasses whose fields carry their ranges
(``Annotated[float, Ge(0)]``). Values come from JSON, where there is one kind of number and where true is not 1. Every
refusal is one sentence with the JSON path and what is allowed.

>>> from annotated_types import Ge, Le
>>> from typing import Annotated
>>> checked(Annotated[float, Ge(0.5), Le(20)], 4, where="mesher.size_mm")
4.0
>>> checked(Annotated[float, Ge(0.5), Le(20)], 40, where="mesher.size_mm")
Traceback (most recent call last):
finqd.errors.InputError: mesher.size_mm: must be a number from 0.5 to 20, not 40
"""

from __future__ import annotations

import dataclasses
import difflib
import json
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any, get_type_hints

from finqd.errors import InputError

_TYPES = {
    "number": "a number", "integer": "a whole number", "boolean": "true or false", "string": "a text", "null": "null",
    "array": "a list", "object": "an object",
}


@lru_cache(maxsize=512)
def option_types(owner: type) -> dict[str, Any]:
    """Return option name -> annotated type, of the fields that the constructor of the dataclass ``owner`` takes.

    Kept, since evaluating the annotations takes milliseconds: not to be written to.
    """
    hints = get_type_hints(owner, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(owner) if field.init}


def option_schemas(owner: type) -> dict[str, dict[str, Any]]:
    """Return option name -> JSON schema, with its default and, where the field's metadata has one, its description."""
    types = option_types(owner)
    schemas = {}
    for field in dataclasses.fields(owner):
        if field.name in types:
            schemas[field.name] = {**annotation_schema(types[field.name]), **_extras(field)}
    return schemas


def annotation_schema(annotation: Any) -> dict[str, Any]:
    """Return the JSON schema of an annotated type."""
    return _adapter(annotation).json_schema()


def checked(annotation: Any, value: Any, where: str = "", error_type: type[InputError] = InputError) -> Any:
    """Return ``value`` as the annotated type. It is checked as JSON, so that a list may stand for a tuple.

    Raises ``error_type``: wrong type, out of range, not finite.
    """
    from pydantic import ValidationError

    adapter = _adapter(annotation)
    try:
        text = json.dumps(value)
        return adapter.validate_json(text)
    except ValidationError as error:
        raise error_type(f"must be {in_words(adapter.json_schema())}, not {shown(value)}", where) from error
    except (TypeError, ValueError, RecursionError) as error:
        raise error_type(f"must be {in_words(adapter.json_schema())}, not a {type(value).__name__}", where) from error


def checked_fields(owner: type, values: Any, where: str, error_type: type[InputError] = InputError) -> dict[str, Any]:
    """Return ``values``, a JSON object, checked against the fields of the dataclass ``owner``, in the fields' order.

    Raises ``error_type`` as `checked` does, and for unknown keys.
    """
    types = option_types(owner)
    given = require_object(values, where, error_type)
    refuse_unknown(given, types, where, error_type)
    return {key: checked(types[key], given[key], join(where, key), error_type) for key in types if key in given}


def require_object(value: Any, where: str, error_type: type[InputError] = InputError) -> Mapping[str, Any]:
    """Return ``value`` if it is a JSON object; raise ``error_type`` otherwise."""
    if not isinstance(value, Mapping):
        raise error_type(f"must be an object {{...}}, not {shown(value)}", where)
    return value


def refuse_unknown(
    keys: Iterable[Any], known: Iterable[str], where: str, error_type: type[InputError] = InputError
) -> None:
    """Raise ``error_type`` for the first of ``keys`` that is not known, with the likeliest known one."""
    known = list(known)
    for key in keys:
        if key not in known:
            near = nearest(str(key), known)
            hint = f"did you mean {near}?" if near else f"known: {', '.join(known) or 'none'}"
            raise error_type(f"unknown key; {hint}", join(where, str(key)))


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known word that ``word`` is most likely a misspelling of, or None.

    >>> nearest("rib_cuont", ["rib_angle_deg", "rib_count"])
    'rib_count'
    """
    by_lower = {other.lower(): other for other in known}
    found = difflib.get_close_matches(word.lower()[:100], by_lower, n=1, cutoff=0.6)
    return by_lower[found[0]] if found else None


def join(where: str, step: Any) -> str:
    """Return the place of a key or index below a place; a file's name ends in a colon.

    >>> join(join(join("a.json:", "fingers"), 1), "rib_count")
    'a.json: fingers[1].rib_count'
    """
    if isinstance(step, int) and not isinstance(step, bool):
        return f"{where}[{step}]"
    name = step if isinstance(step, str) and step.isidentifier() and len(step) < 60 else shown(step)
    if not where:
        return name
    return f"{where} {name}" if where.endswith(":") else f"{where}.{name}"


def shown(value: Any) -> str:
    """Return ``value`` as short JSON on one line, for a sentence."""
    try:
        text = json.dumps(value)
    except (TypeError, ValueError, RecursionError):
        return f"a {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."


def in_words(schema: Mapping[str, Any]) -> str:
    """Return what a JSON schema allows.

    >>> in_words({"type": "number", "exclusiveMinimum": 0, "maximum": 20})
    'a number above 0 and up to 20'
    """
    if "anyOf" in schema:
        return " or ".join(in_words(part) for part in schema["anyOf"])
    if "enum" in schema or "const" in schema:
        values = schema["enum"] if "enum" in schema else [schema["const"]]
        listed = ", ".join(json.dumps(value) for value in values)
        return f"one of {listed}" if len(values) > 1 else listed
    words = _TYPES.get(str(schema.get("type", "")), "a value")
    if "maxItems" in schema and schema.get("minItems") == schema["maxItems"]:
        words += f" of {schema['maxItems']}"
    low, above = schema.get("minimum"), schema.get("exclusiveMinimum")
    high, below = schema.get("maximum"), schema.get("exclusiveMaximum")
    if low is not None and high is not None:
        return f"{words} from {low:g} to {high:g}"
    bounds = [
        f"of at least {low:g}" if low is not None else f"above {above:g}" if above is not None else "",
        f"up to {high:g}" if high is not None else f"below {below:g}" if below is not None else "",
    ]
    return " ".join([words, " and ".join(filter(None, bounds))]).strip()


@lru_cache(maxsize=512)
def _adapter(annotation: Any) -> Any:
    from pydantic import ConfigDict, PydanticUserError, TypeAdapter

    try:
        return TypeAdapter(annotation, config=ConfigDict(strict=True, allow_inf_nan=False))
    except PydanticUserError:  # a nested dataclass or model brings its own configuration
        return TypeAdapter(annotation)


def _extras(field: dataclasses.Field) -> dict[str, Any]:
    from pydantic_core import to_jsonable_python

    extras = {key: field.metadata[key] for key in ("description",) if key in field.metadata}
    if field.default is not dataclasses.MISSING:
        extras["default"] = to_jsonable_python(field.default)
    elif field.default_factory is not dataclasses.MISSING:
        extras["default"] = to_jsonable_python(field.default_factory())
    return extras
