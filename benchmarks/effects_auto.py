"""What is left out where it is not called for: does it change results, and what does it save?

    python benchmarks/effects_auto.py --log benchmarks/effects_auto.jsonl [--minutes 60] [--report]

100 Sobol designs on the ten objects with the preset `draft`, each grasp in three ways: `whole`, with single time steps
to the end of the hold; `early`, the same, ended where its verdict is certain; `auto`, as finqd does it by default, with
long steps where nothing happens as well. Grasps come in an order drawn at random (`SEED`), the three of each together,
so that what is done is an unbiased sample. Writes a line a grasp as it goes, and resumes; a line whose design or preset
has changed since is done again. Prints verdict flips, differences of force and drop, and iterations and seconds saved.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
from checkout import commits
from scipy.stats import qmc
from study import compute_missing, rows_that_hold

from finqd.design import Design, design_parameters
from finqd.evaluate import evaluate
from finqd.objects import object_names
from finqd.presets import apply_preset

SEED = 6
DESIGNS = 100
PRESET = "draft"
LIMIT_S = 1800.0
FIRM_N = 0.5  # [N] relative differences of smaller forces say nothing
WAYS: dict[str, dict[str, Any]] = {
    "whole": {"protocol.calm_step_factor": 1, "protocol.early_verdict": False},
    "early": {"protocol.calm_step_factor": 1},
    "auto": {},
}
WORK = ("newton_iterations", "quasi_iterations", "steps")
Key = tuple[int, str, str]  # design, object, way


def tasks() -> dict[Key, Design]:
    """Return all simulations in their order: each with its design, ready for `evaluate`."""
    size = 2 ** math.ceil(math.log2(DESIGNS))  # Sobol points are balanced in powers of two
    units = qmc.Sobol(len(design_parameters()), seed=SEED).random(size)[:DESIGNS]
    grasps = [(i, name) for i in range(DESIGNS) for name in sorted(object_names())]
    limit = {"protocol.wall_clock_limit_s": LIMIT_S}
    return {
        (*grasps[i], way): apply_preset(
            Design.from_unit_vector(units[grasps[i][0]].tolist()), PRESET, overrides={**limit, **changes})
        for i in np.random.default_rng(SEED).permutation(len(grasps)) for way, changes in WAYS.items()
    }


def simulate(task: tuple[Key, Design]) -> dict[str, Any]:
    """Return a row of the log."""
    (design, name, way), ready = task
    row = evaluate(ready, objects=[name], preset=PRESET).to_dict()["objects"][name]
    forces = row["final_contact_force_N"]
    kept = ("status", "reason", "ended", "held", "drop_mm", "margin", "max_penetration_mm", "simulated_s", "seconds")
    return {
        "design": design, "object": name, "way": way, "digest": ready.digest(),
        "force_N": None if forces is None else sum(forces), **{key: row[key] for key in kept},
        **{key: row["counters"].get(key, 0) for key in WORK},
    }


def key(row: dict[str, Any]) -> Key:
    """Return which simulation a row is of."""
    return row["design"], row["object"], row["way"]


def words(row: dict[str, Any]) -> str:
    """Return a row in words."""
    held = "held" if row["held"] else "lost"
    return f"{row['design']} {row['object']} {row['way']} {row['status']} {held} {row['seconds']:.0f} s"


def run(arguments: argparse.Namespace) -> dict[Key, dict[str, Any]]:
    """Simulate what the log does not hold yet, until the time is up; return all rows that hold."""
    wanted = tasks()
    rows = rows_that_hold(arguments.log, {one: design.digest() for one, design in wanted.items()}, key)
    if not arguments.report:
        compute_missing({one: (one, design) for one, design in wanted.items()}, rows, simulate, log=arguments.log,
                        words=words, jobs=arguments.jobs, minutes=arguments.minutes)
    return rows


def report(rows: dict[Key, dict[str, Any]]) -> None:
    """Print what each of the cheaper ways changes against `whole`, and what it saves."""
    print(f"\nsimulations: {commits(rows.values())}")
    for way in ("early", "auto"):
        pairs = [(row, rows[*key[:2], "whole"]) for key, row in rows.items()
                 if key[2] == way and (*key[:2], "whole") in rows]
        if pairs:
            print(f"\n{way} against whole: {len(pairs)} of {10 * DESIGNS} grasps")
            report_pairs(pairs)


def report_pairs(pairs: list[tuple[dict[str, Any], dict[str, Any]]]) -> None:
    """Print flips, differences and savings."""
    flips = [(one, whole) for one, whole in pairs if (one["status"], one["held"]) != (whole["status"], whole["held"])]
    print(f"  other status or verdict: {len(flips)}; ended early: {sum(bool(one['ended']) for one, _ in pairs)}")
    for one, whole in flips:
        print(f"    design {one['design']}, {one['object']}: " + "; ".join(
            f"{row['way']} {row['status']} {'held' if row['held'] else 'lost'} {row['reason']} drop {row['drop_mm']} mm"
            for row in (one, whole)))
    held = [(one, whole) for one, whole in pairs if one["held"] and whole["held"]]
    if held:
        firm = [abs(one["force_N"] / whole["force_N"] - 1) for one, whole in held if whole["force_N"] > FIRM_N]
        drops = [abs(one["drop_mm"] - whole["drop_mm"]) for one, whole in held]
        for name, values, unit in (("force", 100 * np.array(firm), "%"), ("drop", np.array(drops), "mm")):
            print(f"  {name} of {len(values)} that both hold: median {np.median(values):.3f} {unit}, "
                  f"99 % below {np.percentile(values, 99):.3f}, largest {values.max():.3f}")
    for key in (*WORK, "seconds"):
        ours, theirs = (sum(pair[i][key] for pair in pairs) for i in (0, 1))
        print(f"  {key}: {ours:.0f} against {theirs:.0f}, ratio {theirs / max(ours, 1e-9):.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=math.inf)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--report", action="store_true", help="only print what the log holds")
    report(run(parser.parse_args()))
