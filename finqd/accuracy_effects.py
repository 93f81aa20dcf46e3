"""What effects cost and change, for the page of an accuracy study: as measured once, with the benchmark gripper.

``studies/effects.json``, which comes with finqd, holds what `finqd.explain` found: each effect the other way round.
`benchmarks/effects_cost.py --study` writes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

from finqd.data import studies_folder
from finqd.json_input import read_json_object

FILE = "effects.json"
COLUMNS = ("effect", "", "since [s]", "cost [s]", "the other way round", "force [%]", "drop [mm]", "time [factor]")
COST = (
    "Cost: seconds in kernels and the Python round them; one figure together for object contact, friction and floor, "
    "for self-contact and finger-to-finger contact, and for the elements. The rest: what changes if the effect alone "
    "is the other way round."
)


def effects_section() -> str:
    """Return the section of the page, nothing if the study does not come with this finqd."""
    path = studies_folder() / FILE
    if not path.is_file():
        return ""
    study, _ = read_json_object(path, kind="study")
    title = f"Effects: the benchmark gripper, {study['preset']}"
    when = f"{study['date']}, {study['commit']}, {study['conditions']}"
    told = f"{when}. To repeat it: "
    parts = [f"<h2>{escape(title)}</h2><p>{escape(COST)} {escape(told)}<code>{escape(study['repeat'])}</code></p>"]
    for name, row in study["objects"].items():
        verdict = "held" if row["held"] else "lost"
        parts.append(f"<h3>{escape(name)}: {verdict}, drop {_shown(row['drop_mm'], '.2f')} mm, force "
                     f"{_shown(row['force_N'], '.2f')} N, {row['seconds']:.1f} s</h3>{_table(row)}")
    return "\n".join(parts)


def _table(row: Mapping[str, Any]) -> str:
    head = "".join(f'<th class="{"n" if i > 1 and i != 4 else ""}">{title}</th>' for i, title in enumerate(COLUMNS))
    lines = [f"<tr>{head}</tr>"]
    for effect, line in row["effects"].items():
        start = f"<td>{escape(effect.replace('_', ' '))}</td><td>{escape(line['state'])}</td>"
        numbers = [_shown(line["since_s"], ".2f"), _shown(line["seconds"], ".2f")]
        verdict, *changes = _changes(row, line.get("what_if", {}))
        cells = "".join(f'<td class="n">{escape(text)}</td>' for text in changes)
        before = "".join(f'<td class="n">{text}</td>' for text in numbers)
        lines.append(f"<tr>{start}{before}<td>{escape(verdict)}</td>{cells}</tr>")
    return '<div class="wide"><table>' + "\n".join(lines) + "</table></div>"


def _changes(row: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return the other verdict, and the changes of force [%], drop [mm] and seconds [factor], as text."""
    if not other.get("state"):
        return [other.get("reason", "-"), "-", "-", "-"]
    verdict = ("held" if other["held"] else "lost") if other["status"] == "ok" else other["status"]
    force = drop = None
    if row["force_N"] and other["force_N"] is not None:
        force = 100.0 * (other["force_N"] / row["force_N"] - 1.0)
    if row["drop_mm"] is not None and other["drop_mm"] is not None:
        drop = other["drop_mm"] - row["drop_mm"]
    ratio = other["seconds"] / row["seconds"] if row["seconds"] > 0.0 else None
    return [f"{other['state']}: {verdict}", _shown(force, "+.3f"), _shown(drop, "+.4f"), _shown(ratio, ".2f")]


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
