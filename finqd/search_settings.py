"""What a search was asked for: checked, kept in its log, and compared when it goes on."""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from finqd import archive as qd
from finqd import registry
from finqd.algorithms import ALGORITHMS, SIGMA0
from finqd.data import objects_folder
from finqd.design import Design
from finqd.errors import InputError
from finqd.options import shown
from finqd.run_folder import plain

#: what may differ when a run goes on; ``iterations`` may only grow
FREE = ("iterations", "versions")


def check_options(
    *, algorithm: str, objects: Any, presets: Mapping[str, str | None], ranges: qd.Ranges | None, **numbers: Any
) -> None:
    """Refuse options that cannot work, before anything is built or written."""
    from finqd.presets import PRESETS

    if algorithm not in ALGORITHMS:
        raise InputError(f"there is no algorithm {algorithm!r}; known: {', '.join(ALGORITHMS)}", where="algorithm")
    for name, value in numbers.items():
        least = 0 if name == "seed" else 1
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise InputError(f"must be a whole number from {least} upwards, got {value!r}", where=name)
    for name, preset in presets.items():
        if preset is not None and preset not in PRESETS:
            raise InputError(f"there is no preset {preset!r}; known: {', '.join(PRESETS)}", where=name)
    if presets["screen"] is not None and presets["screen"] == presets["preset"]:
        raise InputError(f"must be another preset than that which confirms, {presets['preset']!r}", where="screen")
    for name, (low, high) in (ranges or {}).items():
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise InputError(f"must be a low and a higher number, got {low!r} and {high!r}", where=f"ranges.{name}")
    if objects is not None:
        from finqd.evaluate import load_objects

        load_objects(objects)


def check_ranges(ranges: qd.Ranges, base: Mapping[str, Any], parameters: int) -> None:
    """Refuse axes that no feature plugin of the designs measures."""
    units = np.random.default_rng(0).random((64, parameters))
    for unit in units:
        try:
            known = qd.measure_features(Design.from_unit_vector(unit, **base))
        except InputError:
            continue
        for name in ranges:
            if name not in known:
                raise InputError(f"no such feature; known: {', '.join(known)}", where=f"ranges.{name}")
        return


def settings_of(
    *, base: Mapping[str, Any], ranges: qd.Ranges, objects: Sequence[Any] | None, preset: str, screen: str | None,
    evaluate: Any, **options: Any,
) -> dict[str, Any]:
    """Return what the log says of a run, enough to repeat it.

    ``preset``: of all evaluations, None if they are screened with ``screen`` and confirmed with ``confirm``.
    """
    settings = {
        **options,
        "description": ALGORITHMS[options["algorithm"]].description,
        "sigma0": SIGMA0,
        "objective": f"fitness + {qd.TIE_BREAK} / objects * (1 + margin) / 2",
        "penalty": qd.PENALTY,
        "threshold_min": qd.THRESHOLD_MIN,
        "objects": None if objects is None else [_object_name(one) for one in objects],
        "objects_digest": _objects_digest(objects),
        "preset": None if screen else preset, "screen": screen, "confirm": preset if screen else None,
        "evaluator": _evaluator_name(evaluate),
        "ranges": ranges,
        "design": base,
        "versions": versions_of(base),
    }
    return plain(settings)


def refuse_changes(old: Mapping[str, Any], new: Mapping[str, Any], *, other_versions: bool, where: str) -> None:
    """Raise ``InputError`` for the first setting in which a run that goes on differs from what it began with."""
    for name, before, now in _differences(old, new):
        top = name.partition(".")[0]
        if top == "iterations" and isinstance(now, int) and now > before:
            continue
        if top == "versions" and other_versions:
            continue
        text = f"{name} was {shown(before)} when this run began, and is {shown(now)} now"
        if top == "iterations":
            text += "; it may only grow"
        elif top == "versions":
            text += "; to go on with results of both, give --other-versions"
        else:
            text += "; a run goes on as it began: take that back, or name a new folder"
        raise InputError(text, where=where)


def refuse_other_world(
    settings: Mapping[str, Any], base: Mapping[str, Any], *, other_versions: bool, where: str
) -> None:
    """Raise ``InputError`` if what a run's results depend on beside its settings, objects and versions, has changed."""
    from finqd.evaluate import load_objects

    objects = settings["objects"]
    if objects is not None:
        load_objects(objects)  # one whose file is gone is told of in words
    now = {"objects_digest": _objects_digest(objects), "versions": versions_of(base)}
    old = {key: settings[key] for key in now if key in settings}
    refuse_changes(old, {key: plain(now[key]) for key in old}, other_versions=other_versions, where=where)


def versions_of(base: Mapping[str, Any]) -> dict[str, str]:
    """Return the versions that a result of this run depends on: finqd, its libraries, who brought the plugins."""
    from finqd.design_schema import DEFAULT_PLUGINS

    named = {"geometry": base.get("geometry", "fin_ray"), **{k: base.get(k, v) for k, v in DEFAULT_PLUGINS.items()}}
    specs = [(kind, one) for kind, spec in named.items() for one in (spec if isinstance(spec, list) else [spec])]
    wanted = {(kind, one if isinstance(one, str) else one.get("name")) for kind, one in specs}
    owners = {(e.distribution, e.version) for kind, _ in wanted for e in registry.entries(kind)
              if (e.kind, e.name) in wanted and e.distribution != "finqd"}  # fmt: skip
    return {**_versions(), **{name: number for name, number in sorted(owners)}}


@cache
def _versions() -> Mapping[str, str]:
    from finqd.provenance import versions as versions_of_simulation

    return {"python": sys.version.split()[0], "ribs": version("ribs"), **versions_of_simulation()}


def _differences(old: Any, new: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in [*old, *(key for key in new if key not in old)]:
            yield from _differences(old.get(key), new.get(key), f"{name}.{key}" if name else str(key))
    elif old != new:
        yield name, old, new


def _object_name(one: Any) -> str:
    if isinstance(one, (str, os.PathLike)):
        path = Path(one)
        return str(path.resolve()) if path.suffix and path.exists() else str(one)
    return str(getattr(one, "name", one))


def _objects_digest(objects: Sequence[Any] | None) -> str:
    """Return a digest of the objects' content: a file that is edited makes other results."""
    digest = hashlib.sha256()
    folder = objects_folder()
    for one in sorted(folder.glob("*.json")) if objects is None else objects:
        if not isinstance(one, (str, os.PathLike)):
            digest.update(pickle.dumps([getattr(one, key, None) for key in ("name", "mass", "vertices", "triangles")]))
            continue
        path = folder / f"{one}.json" if (folder / f"{one}.json").is_file() else Path(one)
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _evaluator_name(evaluate: Any) -> str:
    plain_function = getattr(evaluate, "func", evaluate)  # of a functools.partial
    name = getattr(plain_function, "__qualname__", type(plain_function).__qualname__)
    return f"{getattr(plain_function, '__module__', '?')}.{name}"
