"""What does each effect cost, and what does it change? The benchmark gripper, each effect the other way round.

    python benchmarks/effects_cost.py --log effects_cost.jsonl [--objects sphere,cube] [--preset draft] [--report]
        [--study]

One grasp after the other, all with warm kernels; an object's round (plain, then each effect switched) is repeated, and
seconds are medians. Writes a line an object and round as it goes, and resumes. ``--study`` writes the first round of
each object to studies/effects.json, which the pages of `finqd accuracy` show.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

from checkout import commit, commits

from finqd.accuracy_effects import FILE
from finqd.data import designs_folder, studies_folder
from finqd.design import Design
from finqd.explain import explain
from finqd.objects import object_names
from finqd.presets import PRESETS
from finqd.provenance import versions
from finqd.runlog import write_whole
from finqd.study_log import append_row, read_rows


def measure(log: Path, *, objects: list[str], preset: str, repeat: int) -> None:
    """Do the rounds that the log lacks; the first one after the start is preceded by one that warms the kernels up."""
    design, warm = Design.from_json(designs_folder() / "benchmark.json"), False
    done = {(row["object"], row["preset"], row["round"]) for row in read_rows(log)}
    for round_ in range(repeat):
        for name in objects:
            if (name, preset, round_) in done:
                continue
            if not warm:
                explain(design, objects=[name], preset=preset)
                warm = True
            (found,) = explain(design, objects=[name], preset=preset, what_if=True)
            append_row(log, {
                "object": name, "preset": preset, "round": round_, "commit": commit(), **found.to_dict(),
            })
            print(f"{name}, round {round_}: {found.outcome.seconds:.1f} s", flush=True)


def report(rows: list[dict[str, Any]]) -> None:
    """Print a table for each object and preset."""
    for name, preset in sorted({(row["object"], row["preset"]) for row in rows}):
        mine = [row for row in rows if (row["object"], row["preset"]) == (name, preset)]
        first = mine[0]
        plain = statistics.median(row["seconds"] for row in mine)
        verdict = "held" if first["held"] else "lost"
        print(f"\n{name}, {preset}: {verdict}, drop {first['drop_mm']} mm, force {first['force_N']} N, {plain:.2f} s "
              f"(median of {len(mine)}, warm); {commits(mine)}")
        print(f"{'effect':<26}{'is':<5}{'since [s]':>10}{'seconds with it / without':>28}", end="")
        print(f"{'held':>7}{'force':>9}{'drop [mm]':>11}")
        for effect, line in first["effects"].items():
            other = line.get("what_if", {})
            since = "-" if line["since_s"] is None else f"{line['since_s']:.2f}"
            if not other.get("state"):
                print(f"{effect:<26}{line['state']:<5}{since:>10}   {other.get('reason', 'cannot be switched here')}")
                continue
            seconds = statistics.median(row["effects"][effect]["what_if"]["seconds"] for row in mine)
            with_it, without = (plain, seconds) if line["state"] == "on" else (seconds, plain)
            ratio = f"{with_it / without:.2f}" if without > 0.0 else "-"
            held = "yes" if other["held"] else "no"
            force = f"{other['force_N']:.2f} N" if other["force_N"] is not None else other["status"]
            drop = f"{other['drop_mm']:.2f}" if other["drop_mm"] is not None else "-"
            print(f"{effect:<26}{line['state']:<5}{since:>10}{ratio:>28}{held:>7}{force:>9}{drop:>11}")


def write_study(rows: list[dict[str, Any]], preset: str, conditions: str) -> None:
    """Write the first round of each object with a preset to studies/effects.json."""
    chosen = {row["object"]: row for row in reversed(rows) if row["preset"] == preset}
    objects = {name: chosen[name] for name in sorted(chosen)}
    again = f"python benchmarks/effects_cost.py --log LOG --preset {preset} --objects {','.join(objects)} --study"
    write_whole(studies_folder() / FILE, json.dumps({
        "preset": preset, "date": time.strftime("%Y-%m-%d"), "commit": commits(list(objects.values())),
        "conditions": conditions,
        "versions": versions(), "repeat": again, "objects": objects,
    }, indent=2) + "\n")  # fmt: skip


def main() -> None:
    """Measure, then report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--log", required=True, type=Path)
    parser.add_argument("--objects", default="sphere,cube", help=f"of {', '.join(object_names())}")
    parser.add_argument("--preset", default="draft", choices=list(PRESETS))
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--report", action="store_true", help="only print what the log holds")
    parser.add_argument("--study", action="store_true", help="write studies/effects.json from the log")
    parser.add_argument("--conditions", default="one grasp after the other, warm", help="of the study, in words")
    given = parser.parse_args()
    if not given.report:
        measure(given.log, objects=given.objects.split(","), preset=given.preset, repeat=given.repeat)
    rows = list(read_rows(given.log))
    report(rows)
    if given.study:
        write_study(rows, given.preset, given.conditions)


if __name__ == "__main__":
    main()
