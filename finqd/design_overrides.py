"""Single values of a design document by path, for ``--set key=value``."""

from __future__ import annotations

import re
from typing import Any

from finqd.design_schema import DEFAULT_PLUGINS, FINGER_COUNT
from finqd.errors import InputError
from finqd.options import join, shown

_STEP = re.compile(r"\.?([^.\[\]]+)|\[(\d{1,3})\]")


def split_path(path: str, *, place: str) -> list[str | int]:
    """Return the steps of a JSON path.

    >>> split_path("fingers[1].rib_count", place="--set")
    ['fingers', 1, 'rib_count']
    """
    steps: list[str | int] = []
    position = 0
    while position < len(path) and (match := _STEP.match(path, position)):
        steps.append(match[1] if match[1] is not None else int(match[2]))
        position = match.end()
    if not steps or position < len(path) or not isinstance(steps[0], str) or path.startswith("."):
        text = f"this is no path such as protocol.hold_s or fingers[1].rib_count: {shown(path)}"
        raise InputError(text, place.rstrip(":"))
    return steps


def apply_override(document: dict[str, Any], path: str, value: Any, *, place: str) -> None:
    """Set one value of a design document, in place; the document has to be checked afterwards.

    A section that the document leaves out is begun, a plugin named by a text becomes an object, ``finger`` means all
    three fingers. Raises ``InputError`` if the path leads nowhere.
    """
    first, *rest = split_path(path, place=place)
    if first in ("finger", "fingers"):
        _override_fingers(document, str(first), rest, value, place)
        return
    if not rest:
        document[str(first)] = value
        return
    default = DEFAULT_PLUGINS.get(str(first), {})
    section = _opened(document.get(str(first), default))
    document[str(first)] = section
    _put(section, rest, value, join(place, first))


def _override_fingers(document: dict[str, Any], first: str, rest: list[str | int], value: Any, place: str) -> None:
    if not rest:
        document.pop("finger", None)
        document.pop("fingers", None)
        document[first] = value
        return
    if "finger" in document:
        finger = document.pop("finger")
        document["fingers"] = [dict(finger) for _ in range(FINGER_COUNT)]
    if first == "fingers":
        _put(document["fingers"], rest, value, join(place, first))
        return
    for finger in document["fingers"]:
        _put(finger, rest, value, join(place, first))
    if all(finger == document["fingers"][0] for finger in document["fingers"]):
        document["finger"] = document.pop("fingers")[0]  # so that what is wrong is named as the user named it


def _put(target: Any, steps: list[str | int], value: Any, where: str) -> None:
    step, *rest = steps
    if isinstance(step, int):
        if not isinstance(target, list) or step >= len(target):
            count = f"only {len(target)}" if isinstance(target, list) else "no"
            raise InputError(f"there are {count} entries here", join(where, step))
    elif not isinstance(target, dict):
        raise InputError("there are no keys here", join(where, step))
    if not rest:
        target[step] = value
        return
    inner = _opened(target[step] if isinstance(step, int) else target.get(step, {}))  # type: ignore[union-attr]
    target[step] = inner
    _put(inner, rest, value, join(where, step))


def _opened(value: Any) -> Any:
    """Return ``value`` in the form that takes keys: a plugin's name as an object."""
    if isinstance(value, str):
        return {"name": value}
    return list(value) if isinstance(value, list) else value
