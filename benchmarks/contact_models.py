"""Is the fast contact model right? The same 30 grasps with `penalty` and with `ipc`, which never lets bodies intersect.

    python benchmarks/contact_models.py --log contact_models.jsonl [--minutes 60] [--report]

Grasps are the benchmark gripper and two designs drawn at random (`SEED`), on the ten objects each, in an order drawn at
random too, so that what is done is an unbiased sample of the whole. Writes a line a simulation as it goes, and resumes
from there; a line whose design has changed since is done again. Prints verdicts, contact forces and seconds of both.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
from checkout import commits
from study import compute_missing, rows_that_hold

from finqd.data import designs_folder
from finqd.design import Design, design_parameters
from finqd.evaluate import evaluate
from finqd.objects import object_names
from finqd.presets import apply_preset

SEED = 5
DRAWN = 2  # designs, beside the benchmark's
MODELS = ("penalty", "ipc")
PRESET = "draft"
LIMIT_S = 1200.0
FIRM_N = 0.5  # [N] relative differences of smaller forces say nothing
Key = tuple[str, str, str]  # design, object, contact model


def tasks() -> dict[Key, Design]:
    """Return all simulations in their order: each with its design, ready for `evaluate`."""
    generator = np.random.default_rng(SEED)
    found = {"benchmark": Design.from_json(designs_folder() / "benchmark.json")}
    for i in range(DRAWN):
        found[f"random {i}"] = Design.from_unit_vector(generator.random(len(design_parameters())).tolist())
    grasps = [(design, name) for design in found for name in sorted(object_names())]
    limit = {"protocol.wall_clock_limit_s": LIMIT_S}
    return {
        (*grasps[i], model): apply_preset(found[grasps[i][0]], PRESET, overrides={**limit, "contact.name": model})
        for i in generator.permutation(len(grasps)) for model in MODELS
    }


def simulate(task: tuple[Key, Design]) -> dict[str, Any]:
    """Return a row of the log."""
    (design, name, model), ready = task
    row = evaluate(ready, objects=[name], preset=PRESET).to_dict()["objects"][name]
    forces = row["final_contact_force_N"]
    kept = ("status", "reason", "held", "drop_mm", "max_penetration_mm", "seconds", "newton_iterations")
    return {
        "design": design, "object": name, "contact": model, "digest": ready.digest(),
        "force_N": None if forces is None else sum(forces), **{key: row[key] for key in kept},
    }


def key(row: dict[str, Any]) -> Key:
    """Return which simulation a row is of."""
    return row["design"], row["object"], row["contact"]


def words(row: dict[str, Any]) -> str:
    """Return a row in words."""
    force = "-" if row["force_N"] is None else f"{row['force_N']:.2f} N"
    held = "held" if row["held"] else "lost"
    return " ".join((*key(row), row["status"], held, force, f"{row['seconds']:.0f} s"))


def run(arguments: argparse.Namespace) -> dict[Key, dict[str, Any]]:
    """Simulate what the log does not hold yet, until the time is up; return all rows that hold."""
    wanted = tasks()
    rows = rows_that_hold(arguments.log, {one: design.digest() for one, design in wanted.items()}, key)
    if not arguments.report:
        compute_missing({one: (one, design) for one, design in wanted.items()}, rows, simulate, log=arguments.log,
                        words=words, jobs=arguments.jobs, minutes=arguments.minutes)
    return rows


def report(rows: dict[Key, dict[str, Any]]) -> None:
    """Print what the two models agree in, and what each costs."""
    pairs = [(rows[key], rows[*key[:2], "ipc"]) for key in rows if key[2] == "penalty" and (*key[:2], "ipc") in rows]
    print(f"\n{len(pairs)} of {10 * (1 + DRAWN)} grasps with both models; simulations: {commits(rows.values())}")
    whole = [(ours, other) for ours, other in pairs if ours["status"] == other["status"] == "ok"]
    same = [ours["held"] == other["held"] for ours, other in whole]
    if not whole:
        return
    print(f"  both finished: {len(whole)}; verdicts agree in {sum(same)} ({100 * np.mean(same):.0f} %)")
    firm = [(ours, other) for ours, other in whole
            if ours["held"] and other["held"] and min(ours["force_N"], other["force_N"]) > FIRM_N]
    if firm:
        off = np.array([abs(ours["force_N"] / other["force_N"] - 1.0) for ours, other in firm])
        print(f"  forces of {len(firm)} that both hold: {100 * np.median(off):.1f} % apart (median), within 5 %: "
              f"{np.sum(off <= 0.05)}, largest {100 * off.max():.1f} %")
    seconds = {model: [pair[i]["seconds"] for pair in whole] for i, model in enumerate(MODELS)}
    ratio = np.median(np.array(seconds["ipc"]) / np.array(seconds["penalty"]))
    ours, other = (np.median(seconds[model]) for model in MODELS)
    print(f"  seconds a grasp, median: penalty {ours:.0f}, ipc {other:.0f}, ratio {ratio:.1f}")
    for ours, other in pairs:
        differ = ours["held"] != other["held"] or "ok" != ours["status"] or "ok" != other["status"]
        far = None not in (ours["force_N"], other["force_N"]) and ours["held"] and other["held"] and (
            abs(ours["force_N"] - other["force_N"]) > 0.05 * other["force_N"])
        if differ or far:
            words = [f"{row['contact']} {row['status']} {'held' if row['held'] else 'lost'} "
                     f"{row['force_N'] or math.nan:.2f} N {row['reason']}" for row in (ours, other)]
            print(f"  {ours['design']}, {ours['object']}: {'; '.join(words)}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=math.inf)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--report", action="store_true", help="only print what the log holds")
    report(run(parser.parse_args()))
