"""Reads JSON that people wrote: every way in which a file can be wrong is one sentence.

Beyond what the standard library refuses: a key given twice, files too large to be meant, and literals
(``NaN``, ``Infinity``) that become numbers which no range allows, so that the check of the value names their path.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from finqd.errors import InputError
from finqd.options import join, require_object

#: larger files are refused before they are read [bytes]
SIZE_LIMIT = 1_000_000


def read_json_object(source: str | os.PathLike[str] | Mapping[str, Any], *, kind: str) -> tuple[dict[str, Any], str]:
    """Return the JSON object in a file, a text or a mapping, and the place to put in front of what is wrong in it.

    ``source``: a path; or a text, which starts with ``{``; or a mapping, taken as it is. ``kind``: what the file holds
    (``"design"``), used as the place of a text or mapping. Raises ``InputError``.
    """
    if isinstance(source, Mapping):
        return dict(source), f"{kind}:"
    if isinstance(source, str) and source.lstrip().startswith("{"):
        return _parse(source, f"{kind}:"), f"{kind}:"
    place = f"{os.fspath(source)}:"
    return _parse(_read(source, kind), place), place


def _read(source: str | os.PathLike[str], kind: str) -> str:
    name = os.fspath(source)
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise InputError(f"this is no file name: {name!r}", where=kind)
    path = Path(name)
    try:
        if not path.exists():
            raise InputError("there is no such file", where=name)
        if path.is_dir():
            raise InputError(f"is a directory, not a {kind} file", where=name)
        if not path.is_file():
            raise InputError(f"is not a regular file, so not a {kind} file", where=name)
        if path.stat().st_size > SIZE_LIMIT:
            raise InputError(f"is too large for a {kind} file: more than {SIZE_LIMIT // 1000} kB", where=name)
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"is not UTF-8 text: byte {error.start} cannot be read", where=name) from error
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", where=name[:200]) from error


def _parse(text: str, place: str) -> dict[str, Any]:
    if not text.strip():
        raise InputError("is empty", where=place.rstrip(":"))
    try:
        document = json.loads(text, object_pairs_hook=_Object, parse_int=_integer)
        _refuse_duplicates(document, place)
    except json.JSONDecodeError as error:
        message = f"is not valid JSON: {error.msg} at line {error.lineno}, column {error.colno}"
        raise InputError(message, where=place.rstrip(":")) from error
    except RecursionError as error:
        raise InputError("is nested too deeply", where=place.rstrip(":")) from error
    return dict(require_object(document, place.rstrip(":")))


class _Object(dict):
    """A JSON object that remembers a key given twice: only later is it known where the object lies."""

    def __init__(self, pairs: list[tuple[str, Any]]) -> None:
        super().__init__(pairs)
        seen: set[str] = set()
        self.duplicates = [key for key, _ in pairs if key in seen or seen.add(key)]  # type: ignore[func-returns-value]


def _integer(text: str) -> float:
    try:
        return int(text)
    except ValueError:  # Python limits the digits of an integer; a range refuses infinity
        return float(text)


def _refuse_duplicates(document: Any, place: str) -> None:
    waiting = [(document, place)]
    while waiting:
        value, where = waiting.pop()
        if isinstance(value, _Object):
            if value.duplicates:
                raise InputError("this key is given twice", where=join(where, value.duplicates[0]))
            waiting.extend((child, join(where, key)) for key, child in value.items())
        elif isinstance(value, list):
            waiting.extend((child, join(where, i)) for i, child in enumerate(value))
