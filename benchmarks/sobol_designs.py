"""Robustness over the design space: Sobol designs on a few objects; every failure with its reason.

    python benchmarks/sobol_designs.py --designs 100 --objects sphere,diamond --preset draft --log sobol.jsonl

Writes a line a design as it goes and resumes from there.
"""

from __future__ import annotations

import argparse
import collections
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from finqd.design import Design, design_parameters
from finqd.evaluate import evaluate
from finqd.workers import TaskFailure, run_tasks


def evaluate_one(task: tuple[int, list[float], list[str], str]) -> dict[str, Any]:
    """Evaluate one design; return a row of the log."""
    index, unit, objects, preset = task
    begun = time.perf_counter()
    design = Design.from_unit_vector(unit)
    result = evaluate(design, objects=objects, preset=preset).to_dict()
    kept = {key: result[key] for key in ("objects", "mesh", "status", "reason")}
    return {"index": index, "vector": design.to_vector().tolist(), **kept, "seconds": time.perf_counter() - begun}


def line(name: str, row: dict[str, Any]) -> str:
    """Return one grasp in words."""
    drop = "-" if row["drop_mm"] is None else f"{row['drop_mm']:.2f} mm"
    return f"{name} {row['status']} {'held' if row['held'] else 'lost'} drop {drop}"


def run(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Evaluate what the log does not hold yet; return all rows."""
    log = Path(arguments.log)
    rows = [json.loads(text) for text in log.read_text().splitlines()] if log.exists() else []
    done = {row["index"] for row in rows}
    size = 2 ** math.ceil(math.log2(arguments.designs))  # Sobol points are balanced in powers of two
    units = qmc.Sobol(len(design_parameters()), seed=arguments.seed).random(size)[: arguments.designs]
    objects = arguments.objects.split(",")
    tasks = [(i, unit.tolist(), objects, arguments.preset) for i, unit in enumerate(units) if i not in done]

    def on_result(position: int, row: Any) -> None:
        if isinstance(row, TaskFailure):
            print(f"{tasks[position][0]:4d}  {row.kind}: {row.reason}", flush=True)
            return
        rows.append(row)
        with log.open("a") as file:
            file.write(json.dumps(row) + "\n")
        grasps = "  ".join(line(*o) for o in row["objects"].items())
        print(f"{row['index']:4d}  {row['seconds']:6.1f} s  {grasps}", flush=True)

    run_tasks(evaluate_one, tasks, jobs=arguments.jobs, on_result=on_result)
    return rows


def report(rows: list[dict[str, Any]]) -> None:
    """Print shares of statuses and verdicts, penetrations and times."""
    grasps = [(row["index"], name, o) for row in rows for name, o in row["objects"].items()]
    print(f"\n{len(rows)} designs, {len(grasps)} grasps")
    for status, count in collections.Counter(o["status"] for _, _, o in grasps).most_common():
        print(f"  {status:12s} {count:4d}  {100 * count / len(grasps):.1f} %")
    finite = all(o["drop_mm"] is not None and math.isfinite(o["drop_mm"]) for _, _, o in grasps if o["status"] == "ok")
    print("  every finished grasp is finite:", finite)
    for name in sorted({name for _, name, _ in grasps}):
        mine = [o for _, n, o in grasps if n == name]
        depth = np.array([o["max_penetration_mm"] or 0.0 for o in mine])
        print(
            f"  {name}: held {sum(o['held'] for o in mine)} of {len(mine)}; penetration median {np.median(depth):.3f}, "
            f"largest {depth.max():.3f} mm; seconds a grasp median {np.median([o['seconds'] for o in mine]):.1f}, "
            f"largest {max(o['seconds'] for o in mine):.1f}"
        )
    for index, name, o in grasps:
        if o["status"] != "ok":
            print(f"  design {index}, {name}: {o['status']}: {o['reason']}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--designs", type=int, default=100)
    parser.add_argument("--objects", default="sphere,diamond")
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--log", required=True)
    report(run(parser.parse_args()))
