"""How far off are the presets on other fingers? The press on the first finger of Sobol designs, against a finer mesh.

    python benchmarks/preset_press.py --log benchmarks/preset_press.jsonl [--finger 2] [--report] [--bands]

The ladder (`finqd accuracy press`) judges presets by one finger, on which errors may cancel by luck. Here every preset
presses the first finger of the ten designs of `verdict_flips.py`, and each force is compared with that of `YARDSTICK`,
a mesh of quadratic bricks whose own error is told by the benchmark finger, of which the converged force is known.
Writes a line a press as it goes, and resumes from there. ``--bands`` writes the 90 % quantile of the errors to
studies/presets.json, which every result then carries. ``--finger 2`` (3) presses another finger of the same designs:
a preset whose mesh was chosen by the first ones is judged by those.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from verdict_flips import designs

from finqd.data import studies_folder
from finqd.design import Design
from finqd.presets import PRESETS, apply_preset
from finqd.provenance import versions
from finqd.runlog import write_whole
from finqd.study_log import append_row, read_rows
from finqd.verification.press import REFERENCE, press_finger
from finqd.workers import TaskFailure, run_tasks

YARDSTICK, BENCHMARK = "yardstick", "benchmark"
#: settings of the yardstick over the preset `standard`
SETTINGS = {"mesher.size_mm": 1.5, "mesher.layers": 3, "mesher.least_edges": 3, "mesher.grading": 2.0}
QUANTILE = 90  # what a band means by an error: 90 % of fingers are nearer than that
LIMIT_S = 1800.0

Row = dict[str, Any]


def applied(design: Design, level: str) -> Design:
    """Return what is simulated for a preset, or for the yardstick."""
    if level == YARDSTICK:
        return apply_preset(design, "standard", overrides=SETTINGS)
    return apply_preset(design, level)


def cases(finger: int) -> dict[str, Design]:
    """Return the designs by the name that rows have; the benchmark's fingers are all the same."""
    if finger == 0:
        return designs()
    return {f"{name}, finger {finger + 1}": design for name, design in designs().items() if name != BENCHMARK}


def press(task: tuple[str, str, Design, int]) -> Row:
    """Press one finger; return a row of the log."""
    name, level, design, finger = task
    found = press_finger(design, finger=finger, wall_clock_limit=LIMIT_S)
    ok = found.status == "ok"
    return {
        "design": name, "level": level, "digest": design.digest(), "status": found.status, "reason": found.reason,
        "force_N": found.force if ok else None, "dofs": found.dofs, "seconds": found.seconds, "versions": versions(),
    }


def run(log: Path, levels: list[str], *, finger: int, jobs: int, report: bool) -> dict[tuple[str, str], Row]:
    """Press what the log does not hold yet; return all rows by design and level."""
    chosen = cases(finger)
    tasks = [(name, level, applied(design, level), finger) for name, design in chosen.items() for level in levels]
    wanted = {(name, level): design.digest() for name, level, design, _ in tasks}
    logged = {(row["design"], row["level"]): row for row in read_rows(log)}
    rows = {key: row for key, row in logged.items() if row["digest"] == wanted.get(key)}
    todo = [task for task in tasks if task[:2] not in rows]

    def on_result(index: int, row: Any) -> None:
        if isinstance(row, TaskFailure):
            print(f"{todo[index][:2]}: {row.kind}: {row.reason}", flush=True)
            return
        rows[row["design"], row["level"]] = row
        append_row(log, row)

    if not report:
        run_tasks(press, todo, jobs=jobs, on_result=on_result)
    return rows


def errors(rows: dict[tuple[str, str], Row], level: str) -> dict[str, float]:
    """Return the signed errors of a level's force against the yardstick's [%], by design; of the Sobol designs."""
    found = {}
    for (name, one), row in rows.items():
        exact = rows.get((name, YARDSTICK), {}).get("force_N")
        if one == level and name != BENCHMARK and exact and row["force_N"]:
            found[name] = 100.0 * (row["force_N"] / exact - 1.0)
    return found


def report_rows(rows: dict[tuple[str, str], Row], levels: list[str]) -> None:
    """Print the error of every finger by level, and their quantiles."""
    known = rows.get((BENCHMARK, YARDSTICK))
    if known is not None and known["status"] == "ok":
        off = 100.0 * (known["force_N"] / REFERENCE - 1.0)
        print(f"{YARDSTICK} on the benchmark finger: {known['force_N']:.4f} N, {off:+.2f} % off the converged force")
    for level in levels[1:]:
        found = errors(rows, level)
        if found:
            values = np.array(list(found.values()))
            listed = ", ".join(f"{value:+.1f}" for value in values)
            print(f"{level:10s} {len(values)} fingers: median {np.median(np.abs(values)):.1f} %, {QUANTILE} % below "
                  f"{np.percentile(np.abs(values), QUANTILE):.1f} %, mean {values.mean():+.1f} %   [{listed}]")
    for (name, level), row in rows.items():
        if row["status"] != "ok":
            print(f"{name}, {level}: {row['status']}: {row['reason']}")


def write_bands(rows: dict[tuple[str, str], Row], levels: list[str]) -> None:
    """Write the quantiles to studies/presets.json, and the benchmark finger's error and the settings with them."""
    path = studies_folder() / "presets.json"
    document = json.loads(path.read_text())
    document["studies"]["press_fingers"] |= {"date": time.strftime("%Y-%m-%d"), "versions": versions()}
    for level in levels[1:]:
        found = np.abs(list(errors(rows, level).values()))
        row, band = rows[BENCHMARK, level], document["presets"][level]
        if band["settings"] != PRESETS[level]:  # a preset that has changed since `preset_bands.py` wrote its row
            off = 100.0 * abs(row["force_N"] / REFERENCE - 1.0)
            band |= {"press_force_error_percent": round(off, 2), "press_seconds": round(row["seconds"], 2),
                     "settings": PRESETS[level]}  # fmt: skip
        band |= {"press_fingers_error_percent": round(float(np.percentile(found, QUANTILE)), 2)}
    write_whole(path, json.dumps(document, indent=2) + "\n")


def main() -> None:
    """Read the options, run, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=Path, required=True)
    parser.add_argument("--presets", default="draft,standard,fine,reference", help="paper too, if need be")
    parser.add_argument("--finger", type=int, choices=(1, 2, 3), default=1, help="of each design")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--report", action="store_true", help="only print what the log holds")
    parser.add_argument("--bands", action="store_true", help="write the errors into studies/presets.json")
    arguments = parser.parse_args()
    chosen = arguments.presets.split(",")
    if not set(chosen) <= set(PRESETS):
        parser.error(f"--presets: known are {', '.join(PRESETS)}")
    levels = [YARDSTICK, *chosen]
    if arguments.bands and arguments.finger != 1:
        parser.error("--bands are those of the first fingers")
    rows = run(arguments.log, levels, finger=arguments.finger - 1, jobs=arguments.jobs, report=arguments.report)
    report_rows(rows, levels)
    if arguments.bands:
        if any(len(errors(rows, level)) < len(designs()) - 1 for level in chosen):
            parser.exit(1, "the study is not complete: no bands from this\n")
        write_bands(rows, levels)


if __name__ == "__main__":
    main()
