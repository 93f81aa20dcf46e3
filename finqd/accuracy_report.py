"""What an accuracy study leaves for people: a table (CSV) and a page (HTML) that holds its picture."""

from __future__ import annotations

import base64
import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from finqd.accuracy import Row, Study, disturbed, front
from finqd.accuracy_effects import effects_section
from finqd.accuracy_ladder import KNOBS
from finqd.runlog import write_whole

COLUMNS = (
    "rung", "knob", "series", "status", "error_percent", "change_percent", "seconds", "wall_seconds", "cpu_seconds",
    "dofs", "steps",
    "newton_iterations", "max_penetration_mm", "on_front",
)
STYLE = """body{font:15px/1.45 system-ui,sans-serif;color:#222;background:#fff;max-width:1150px;margin:2em auto;
padding:0 1em}table{border-collapse:collapse;margin:.6em 0 1.4em;font-size:13.5px}th,td{padding:2px 9px;text-align:left;
border-bottom:1px solid #ddd;vertical-align:top}td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}
tr.front td{background:#eef5ee}tr.bad td{color:#a11}code{font-size:12.5px}img{max-width:100%}.wide{overflow-x:auto}"""

NOTE = (
    "Errors are signed: positive is too much. A single number can be right by luck, when two errors cancel: look at "
    "the other quantities before you trust a cheap rung. On the curves of all knobs but mesh size and element the "
    "mesh of <i>standard</i> is a floor; <i>change</i> is what the knob alone changes against <i>standard</i>."
)


def write_report(study: Study) -> list[Path]:
    """Write accuracy.csv, accuracy.png and accuracy.html into the study's folder, and return their paths."""
    from finqd.accuracy_plot import draw

    paths = [study.out / f"accuracy.{suffix}" for suffix in ("csv", "png", "html")]
    write_whole(paths[0], csv_text(study))
    draw(study, paths[1])
    write_whole(paths[2], page(study, picture=paths[1].read_bytes()))
    return paths


def csv_text(study: Study) -> str:
    """Return the table of all rungs: errors in percent (signed; positive is too much), values in their units."""
    quantities = study.case.quantities
    best = {row["rung"] for row in front(study.table())}
    errors = [f"error_of_{key}_{'percent' if q.relative else q.unit or 'flips'}" for key, q in quantities.items()]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*COLUMNS, *quantities, *errors, "options", "reason"])
    for row in study.table():
        named = {**row, "on_front": row["rung"] in best}
        values = [row["values"].get(key) for key in quantities]
        deviations = [row["errors"].get(key) for key in quantities]
        cells = [*(named[key] for key in COLUMNS), *values, *deviations, row["options"], row["reason"]]
        writer.writerow([_cell(value) for value in cells])
    return text.getvalue()


def richardson(rows: Sequence[Row], path: str, key: str) -> tuple[float, float] | None:
    """Return the limit and the order p that the three finest settings of a series give, by value = limit + c h^p.

    ``path``: the setting that is h. None if there are not three, or they do not run towards a limit.

    >>> rows = [{"settings": {"h": h}, "status": "ok", "values": {"f": 2 + 3 * h**2}} for h in (4, 3, 1)]
    >>> [round(number, 6) for number in richardson(rows, "h", "f")]
    [2.0, 2.0]
    """
    found = {r["settings"][path]: r["values"][key] for r in rows if path in r["settings"] and key in r["values"]}
    if len(found) < 3:
        return None
    (h1, f1), (h2, f2), (h3, f3) = sorted(found.items())[:3]
    if (f2 - f1) * (f3 - f2) <= 0.0:
        return None
    ratio = (f3 - f2) / (f2 - f1)

    def miss(p: float) -> float:
        return (h3**p - h2**p) / (h2**p - h1**p) - ratio

    low, high = 0.1, 8.0
    if miss(low) * miss(high) > 0.0:
        return None
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if miss(low) * miss(middle) > 0.0 else (low, middle)
    return f1 - (f2 - f1) * h1**low / (h2**low - h1**low), low


def extrapolations(study: Study) -> list[tuple[str, float, float]]:
    """Return series, limit and order for every series over mesh sizes that allows it. Nothing else uses these."""
    series: dict[str, list[Row]] = {}
    for row in study.table():
        if row["series"].startswith("size of"):
            series.setdefault(row["series"], []).append(row)
    limits = {name: richardson(rows, "mesher.size_mm", study.case.main) for name, rows in series.items()}
    return [(name, *found) for name, found in limits.items() if found is not None]


def page(study: Study, *, picture: bytes) -> str:
    """Return the page: picture, front, presets, all rungs, effects, reference, what was not run, origin."""
    rows = study.table()
    best = front(rows)
    chosen = {row["rung"] for row in best}
    presets = [row for row in rows if row["knob"] == "preset"]
    image = base64.b64encode(picture).decode()
    parts = [
        f"<p>{escape(_headline(study))}</p>",
        f'<p><img alt="error against seconds" src="data:image/png;base64,{image}"></p>',
        f"<p>{NOTE}</p>",
        "<h2>The Pareto front</h2>", _table(study, best, chosen),
        "<h2>The presets</h2>", _table(study, presets, chosen),
    ]
    for knob, meaning in KNOBS.items():
        turned = [row for row in rows if row["knob"] == knob != "preset"]
        if turned:
            parts += [f"<h2>{escape(knob)}: {escape(meaning)}</h2>", _table(study, turned, chosen)]
    parts += [effects_section(), _reference(study), _extrapolated(study), _omitted(study), _origin(study, rows)]
    title = f"finqd accuracy: {study.case.name}, {study.design.name}"
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head><body><h1>{escape(title)}</h1>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def _headline(study: Study) -> str:
    said = study.reference.sentence() if study.reference else "there is no reference: its rungs failed"
    return f"{study.case.title[0].upper()}{study.case.title[1:]}. {said[0].upper()}{said[1:]}."


def _table(study: Study, rows: Iterable[Row], chosen: set[str]) -> str:
    quantities = study.case.quantities
    titles = [
        ("rung", ""), ("error [%]", "n"), ("change [%]", "n"),
        *((f"{q.label}{f' [{q.unit}]' if q.unit else ''}", "n") for q in quantities.values()),
        *((f"error of {q.label} [{q.error_unit}]", "n") for k, q in quantities.items()
          if k != study.case.main and q.error_unit),
        ("seconds", "n"), ("wall [s]", "n"), ("dofs", "n"), ("steps", "n"), ("Newton iterations", "n"),
        ("penetration [mm]", "n"), ("settings", ""),
    ]  # fmt: skip
    lines = ["<tr>" + "".join(f'<th class="{kind}">{escape(title)}</th>' for title, kind in titles) + "</tr>"]
    for row in rows:
        numbers = [
            _number(row["error_percent"]), _number(row["change_percent"]),
            *(_number(row["values"].get(key)) for key in quantities),
            *(_number(row["errors"].get(k)) for k, q in quantities.items() if k != study.case.main and q.error_unit),
            _number(row["seconds"]), _number(row["wall_seconds"]), str(row["dofs"]), str(row["steps"]),
            str(row["newton_iterations"]), _number(row["max_penetration_mm"]),
        ]
        told = "" if row["status"] == "ok" else f"<br>{escape(row['status'])}: {escape(row['reason'])}"
        kind = "bad" if told else "front" if row["rung"] in chosen else ""
        cells = "".join(f'<td class="n">{escape(number)}</td>' for number in numbers)
        options = f"<td><code>{escape(row['options'])}</code></td>"
        lines.append(f'<tr class="{kind}"><td>{escape(row["rung"])}{told}</td>{cells}{options}</tr>')
    return '<div class="wide"><table>' + "\n".join(lines) + "</table></div>"


def _reference(study: Study) -> str:
    reference = study.reference
    if reference is None:
        return "<h2>The reference</h2><p>None: no rung of it worked.</p>"
    lines = [f"<h2>The reference</h2><p>{escape(reference.sentence())}. Source: {escape(reference.source)}, "
             f"{escape(reference.date)}. To repeat it: <code>{escape(reference.repeat)}</code></p>", "<table>"]
    keys = list(study.case.quantities)
    lines.append("<tr><th>family</th>" + "".join(f'<th class="n">{escape(key)}</th>' for key in keys)
                 + '<th class="n">dofs</th><th class="n">seconds</th><th>settings</th></tr>')
    for family in reference.families:
        cells = "".join(f'<td class="n">{_number(family["values"].get(key), 6)}</td>' for key in keys)
        told = "" if family["status"] == "ok" else f" ({family['status']}: {family['reason']})"
        lines.append(f"<tr><td>{escape(family['rung'] + told)}</td>{cells}<td class=\"n\">{family['dofs']}</td>"
                     f"<td class=\"n\">{_number(family['seconds'])}</td>"
                     f"<td><code>{escape(family['options'])}</code></td></tr>")
    exact = "".join(f'<td class="n">{_number(reference.values.get(key), 6)}</td>' for key in keys)
    lines.append(f"<tr><td><b>reference</b></td>{exact}<td></td><td></td><td></td></tr></table>")
    lines.append(f"<p>{escape(_listed(reference.versions))}; {escape(_listed(reference.machine))}</p>")
    return "\n".join(lines)


def _extrapolated(study: Study) -> str:
    found = extrapolations(study)
    if not found:
        return ""
    unit = study.case.quantities[study.case.main].unit
    lines = [f"<li>{escape(name)}: {limit:.5g} {unit}, order {order:.2f}</li>" for name, limit, order in found]
    return ("<h2>Extrapolated</h2><p>Richardson's limit of the three finest sizes of each family; a check, used by no "
            "error here.</p><ul>" + "".join(lines) + "</ul>")


def _omitted(study: Study) -> str:
    if not study.omitted:
        return ""
    lines = [f"<li>{escape(name)}: {escape(reason)}</li>" for name, reason in study.omitted.items()]
    return "<h2>Not run</h2><ul>" + "".join(lines) + "</ul>"


def _origin(study: Study, rows: Sequence[Row]) -> str:
    machines = sorted({_listed(row["machine"]) for row in rows}) or [_listed(study.machine)]
    told = [f"<li>{escape(machine)}</li>" for machine in machines]
    warning = "<p><b>The seconds come from more than one machine.</b></p>" if len(machines) > 1 else ""
    if any(row.get("jobs", 1) > 1 for row in rows):
        warning += "<p><b>Rungs ran side by side (--jobs): their seconds are longer than alone.</b></p>"
    if late := disturbed(rows):
        told_late = f"The machine was busy with other work during {len(late)} rungs: their seconds are too long."
        warning += f"<p><b>{told_late}</b></p>"
    dates = sorted(row["date"] for row in rows)
    when = f"{dates[0]} to {dates[-1]} UTC" if dates else ""
    return (f"<h2>Where this comes from</h2>{warning}<p>{escape(when)}. One process a rung, one thread; seconds of "
            "set-up and steps, without meshing, compiling and loading of kernels.</p>"
            f"<ul>{''.join(told)}</ul><p>{escape(_listed(study.versions))}</p>"
            f"<p>Design digest {escape(study.design.digest())}</p>")


def _listed(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in values.items())


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.8g}" if isinstance(value, float) and math.isfinite(value) else value


def _number(value: Any, digits: int = 4) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "held" if value else "lost"
    return f"{value:.{digits}g}" if isinstance(value, (int, float)) else str(value)
