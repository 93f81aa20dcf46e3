"""What the page of a search says besides its designs: what failed, with which settings, and what was assumed."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from finqd.assumptions import ASSUMPTIONS, reductions_of
from finqd.effects import EFFECTS, effects_of
from finqd.errors import FinqdError
from finqd.presets import DEFAULT, apply_preset

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def failures(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return how often designs failed, by status and reason, the most frequent first."""
    failed = [(r["status"], r.get("reason") or "", r["index"]) for r in records if r["status"] != "ok"]
    return _counted(failed)


def object_failures(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return how often a grasp did not reach its end though its design counts, by object, status and reason."""
    rows = [
        (f"{name}: {row.get('status')}", row.get("reason") or "", record["index"])
        for record in records if record["status"] == "ok"
        for name, row in record["objects"].items() if row.get("status", "ok") != "ok"
    ]  # fmt: skip
    return _counted(rows)


def _counted(rows: Sequence[tuple[str, str, int]]) -> list[dict[str, Any]]:
    """Return rows that differ by nothing but numbers as one, with a count, the first reason and where it is."""
    groups: dict[tuple[str, str], dict[str, Any]] = {}
    for status, reason, index in rows:
        alike = _NUMBER.sub("#", reason)
        group = groups.setdefault(
            (status, alike), {"status": status, "reason": reason, "count": 0, "first_index": index, "differing": False}
        )
        group["count"] += 1
        group["differing"] |= group["reason"] != reason
    return sorted(groups.values(), key=lambda group: -group["count"])


def presets_of(run: Any, records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return each preset that the run used: what for, how many evaluations, and how far off it was measured to be."""
    from finqd.accuracy_bands import preset_sentence

    roles = {run.settings.get("screen") or None: "screening", run.settings.get("confirm") or None: "confirmation",
             run.settings.get("preset") or None: "all evaluations"}  # fmt: skip
    counts: dict[str, int] = {}
    for record in records:
        for one in (record, record.get("screen") or {}):
            if one.get("preset"):
                counts[one["preset"]] = counts.get(one["preset"], 0) + 1
    found = []
    for preset in dict.fromkeys([*(name for name in roles if name), *counts]):
        try:
            sentence = preset_sentence(preset)
        except FinqdError as error:
            sentence = str(error)
        row = {"preset": preset, "role": roles.get(preset, ""), "evaluations": counts.get(preset), "accuracy": sentence}
        found.append(row)
    return found


def screening_of(records: Sequence[Mapping[str, Any]]) -> dict[str, int] | None:
    """Return how often screening and confirmation disagree, or None if nothing was screened and confirmed.

    confirmed: designs that have both; other_fitness: of these, those with another fitness; verdicts and flipped: of
    single objects
    """
    both = [(r["screen"], r) for r in records if r.get("screen") and r["status"] == "ok" == r["screen"].get("status")]
    if not both:
        return None
    pairs = [
        (bool(row.get("held")), bool(final["objects"][name].get("held")))
        for screen, final in both for name, row in screen["objects"].items() if name in final["objects"]
    ]  # fmt: skip
    return {
        "confirmed": len(both), "other_fitness": sum(screen["fitness"] != final["fitness"] for screen, final in both),
        "verdicts": len(pairs), "flipped": sum(before != after for before, after in pairs),
    }


def stated(run: Any, records: Sequence[Mapping[str, Any]], elites: Sequence[tuple]) -> dict[str, Any]:
    """Return assumptions, reductions and effects, as they hold for the designs of the run; how often each was met."""
    from finqd.report import design_of

    assumed = list(dict.fromkeys([*ASSUMPTIONS, *(s for record in records for s in record.get("assumptions") or ())]))
    if not elites:
        return {"assumptions": assumed, "reductions": {}, "effects": []}
    preset = elites[0][1].get("preset") or run.settings.get("confirm") or run.settings.get("preset") or DEFAULT
    try:
        design = apply_preset(design_of(run, elites[0][1]), preset)
    except FinqdError:  # what is installed does not know the designs of this log; each of them says so
        return {"assumptions": assumed, "reductions": {}, "effects": []}
    grasps = [row["effects"] for _, record in elites for row in record["objects"].values() if row.get("effects")]
    effects = [
        {"name": name.replace("_", " "), "state": state, "what": EFFECTS[name].what if name in EFFECTS else "",
         **_met(name, grasps)}
        for name, state in effects_of(design).items()
    ]  # fmt: skip
    return {"assumptions": assumed, "reductions": reductions_of(design), "effects": effects}


def _met(name: str, grasps: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return in how many of the elites' grasps an effect between bodies was met; nothing of effects that always are."""
    seen = [grasp[name].get("since_s") for grasp in grasps if isinstance(grasp.get(name), Mapping)]
    return {"grasps": len(seen), "met": sum(since is not None for since in seen)} if seen else {}


def settings_table(settings: Mapping[str, Any]) -> list[list[str]]:
    """Return the run's settings as rows of key and value, in words."""
    rows = []
    for key, value in settings.items():
        if key == "parameters":  # a section of its own
            continue
        text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)
        rows.append([str(key), text])
    return rows
