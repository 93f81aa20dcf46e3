"""Do verdicts depend on the preset? Grasps with one preset against the same grasps with better ones, and the paper's.

    python benchmarks/verdict_flips.py --log benchmarks/verdict_flips.jsonl --suites fine,reference [--report]
    python benchmarks/verdict_flips.py --log paper.jsonl --suites paper --limit-s 7200

The first log is the study as far as it has got; the command goes on with it, and with ``--report`` only prints it.

Three suites of pairs, chosen before any of them was looked at (`SEED`):

- fine: 10 Sobol designs x 10 objects, `standard` against `fine`;
- reference: 20 of those pairs drawn at random, `standard` against `reference`;
- paper: the benchmark design x 10 objects, `standard` against `paper`.

The pairs of every suite are shuffled and the suites interleaved, so that whatever part of the study is done is an
unbiased sample of the whole. Error estimates follow, first for grasps whose verdict flips, then for every fifth:
whether they flag flips is the question, and how often they flag others is answered by the sample. Writes a line a grasp
as it goes, and resumes from there; a line whose design or preset has changed since is not used. Prints flips, whether
the estimate had flagged each, errors of force and drop, and what the better one costs.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from finqd.data import designs_folder, studies_folder
from finqd.design import Design, design_parameters
from finqd.evaluate import evaluate
from finqd.objects import object_names
from finqd.presets import PRESETS, apply_preset
from finqd.runlog import write_whole
from finqd.study_log import append_row, read_rows
from finqd.workers import TaskFailure, run_tasks

SEED = 20
DESIGNS = 10
REFERENCE_PAIRS = 20
ESTIMATED = 5  # every so manieth grasp is estimated, whatever its verdict
SUITES = ("fine", "reference", "paper")
LEAST_PAIRS = 20  # fewer say nothing of shares
FIRM_N = 0.5  # [N] relative errors of smaller forces say nothing
QUANTILE = 90  # what the bands in studies/presets.json mean by an error: 90 % of grasps are nearer than that


@dataclass(frozen=True, order=True)
class Grasp:
    """One simulation: a design by name, an object, a preset."""

    design: str
    grasped: str
    preset: str


@dataclass(frozen=True)
class Pair:
    """A grasp with the preset under study, and the one it is compared with."""

    suite: str
    ours: Grasp
    other: Grasp


def designs() -> dict[str, Design]:
    """Return the designs of the study by name."""
    size = 2 ** math.ceil(math.log2(DESIGNS))  # Sobol points are balanced in powers of two
    units = qmc.Sobol(len(design_parameters()), seed=0).random(size)[:DESIGNS]
    found = {f"sobol {i}": Design.from_unit_vector(unit) for i, unit in enumerate(units)}
    return {**found, "benchmark": Design.from_json(designs_folder() / "benchmark.json")}


def pairs(preset: str, suites: list[str]) -> list[Pair]:
    """Return all pairs of the suites, shuffled and interleaved; the choice depends on `SEED` alone."""
    generator = np.random.default_rng(SEED)
    sobol = [(f"sobol {i}", name) for i in range(DESIGNS) for name in sorted(object_names())]
    chosen = {
        "fine": [sobol[i] for i in generator.permutation(len(sobol))],
        "reference": [sobol[i] for i in generator.permutation(len(sobol))[:REFERENCE_PAIRS]],
        "paper": [("benchmark", str(name)) for name in generator.permutation(sorted(object_names()))],
    }
    placed = [
        ((i + 0.5) / len(chosen[suite]), Pair(suite, Grasp(design, name, preset), Grasp(design, name, suite)))
        for suite in suites for i, (design, name) in enumerate(chosen[suite])
    ]
    return [pair for _, pair in sorted(placed, key=lambda one: one[0])]


def prepared(grasp: Grasp, design: Design, limit_s: float) -> Design:
    """Return the design as it is simulated."""
    return apply_preset(design, grasp.preset, overrides={"protocol.wall_clock_limit_s": limit_s})


def simulate(task: tuple[Grasp, Design, bool, float]) -> dict[str, Any] | None:
    """Simulate one grasp; return a row of the log, None if the time is up."""
    grasp, design, estimated, deadline = task
    if time.time() > deadline:
        return None
    evaluation = evaluate(design, objects=[grasp.grasped], preset=grasp.preset, estimate_error=estimated)
    result = evaluation.to_dict()
    row = result["objects"][grasp.grasped]
    kept = {key: row[key] for key in ("status", "reason", "held", "drop_mm", "steps", "newton_iterations", "seconds")}
    forces = row["final_contact_force_N"]
    return {
        "design": grasp.design, "object": grasp.grasped, "preset": grasp.preset, "digest": result["digest"], **kept,
        "force_N": None if forces is None else sum(forces), "dofs": result["mesh"].get("dofs"),
        "estimate": row.get("estimate"), "estimate_levels": result.get("estimate"), "versions": result["versions"],
    }


def key(row: dict[str, Any]) -> Grasp:
    """Return the grasp that a row of the log is about."""
    return Grasp(row["design"], row["object"], row["preset"])


def read_log(log: Path, known: dict[str, Design], limit_s: float) -> dict[Grasp, dict[str, Any]]:
    """Return the rows that still hold."""
    rows: dict[Grasp, dict[str, Any]] = {}
    for row in read_rows(log):
        grasp = key(row)
        if row["digest"] == prepared(grasp, known[grasp.design], limit_s).digest():
            rows[grasp] = row
    return rows


def run(arguments: argparse.Namespace, wanted: list[Pair]) -> dict[Grasp, dict[str, Any]]:
    """Simulate what the log does not hold yet, until the time is up; return all rows."""
    log, known = Path(arguments.log), designs()
    rows = read_log(log, known, arguments.limit_s)
    deadline = time.time() + 60.0 * arguments.budget_minutes
    todo = dict.fromkeys(grasp for pair in wanted for grasp in (pair.ours, pair.other))
    simulate_missing(arguments, known, rows, list(todo), set(), deadline)
    flipped = {pair.ours for pair in wanted if {pair.ours, pair.other} <= rows.keys()
               and rows[pair.ours]["status"] == rows[pair.other]["status"] == "ok"
               and rows[pair.ours]["held"] != rows[pair.other]["held"] and pair.suite != "paper"}
    simulate_missing(arguments, known, rows, list(flipped), flipped, deadline)
    sample = {pair.ours for pair in [pair for pair in wanted if pair.suite != "paper"][::ESTIMATED]}
    simulate_missing(arguments, known, rows, list(sample), sample, deadline)
    return rows


def simulate_missing(
    arguments: argparse.Namespace, known: dict[str, Design], rows: dict[Grasp, dict[str, Any]], todo: list[Grasp],
    estimated: set[Grasp], deadline: float,
) -> None:
    """Simulate those of ``todo`` that have no row yet, or no estimate though they are to have one; log, add to rows."""
    log = Path(arguments.log)
    grasps = [g for g in todo if g not in rows or (g in estimated and not has_estimate(rows[g]))]
    tasks = [(g, prepared(g, known[g.design], arguments.limit_s), g in estimated, deadline) for g in grasps]

    def on_result(index: int, row: Any) -> None:
        if isinstance(row, TaskFailure):
            print(f"{grasps[index]}: {row.kind}: {row.reason}", flush=True)
        elif row is not None:
            rows[key(row)] = row
            append_row(log, row)
            print(f"{row['design']:10s} {row['object']:10s} {row['preset']:10s} {words(row)}", flush=True)

    run_tasks(simulate, tasks, jobs=arguments.jobs, on_result=on_result)


def has_estimate(row: dict[str, Any]) -> bool:
    """Tell whether a row has an error estimate; one of three levels, as they once were fewer."""
    return row["estimate"] is not None and len(row["estimate_levels"]["levels"]) == 3


def words(row: dict[str, Any]) -> str:
    """Return one grasp in words."""
    verdict = row["status"] if row["status"] != "ok" else "held" if row["held"] else "lost"
    mark = "?" if row["estimate"] and row["estimate"]["uncertain"] else " "
    drop = "-" if row["drop_mm"] is None else f"{row['drop_mm']:.2f}"
    force = "-" if row["force_N"] is None else f"{row['force_N']:.2f}"
    return f"{verdict:5s}{mark} force {force:>6s} N  drop {drop:>6s} mm  {row['seconds']:7.1f} s"


def done(wanted: list[Pair], suite: str, rows: dict[Grasp, Any]) -> Iterator[tuple[Pair, dict, dict]]:
    """Yield the pairs of a suite of which both grasps are there and came to a verdict."""
    for pair in wanted:
        both = [rows[grasp] for grasp in (pair.ours, pair.other) if grasp in rows]
        if pair.suite == suite and [row["status"] for row in both] == ["ok", "ok"]:
            yield pair, both[0], both[1]


def without_verdict(wanted: list[Pair], suite: str, rows: dict[Grasp, Any]) -> Iterator[str]:
    """Yield in words the grasps of a suite that came to no verdict."""
    for grasp in dict.fromkeys(g for pair in wanted if pair.suite == suite for g in (pair.ours, pair.other)):
        if grasp in rows and rows[grasp]["status"] != "ok":
            yield f"{grasp.design}, {grasp.grasped}, {grasp.preset}: {words(rows[grasp])} {rows[grasp]['reason']}"


def report(wanted: list[Pair], rows: dict[Grasp, dict[str, Any]]) -> None:
    """Print each suite: flips, flags, errors, seconds."""
    for suite in SUITES:
        for failure in without_verdict(wanted, suite, rows):
            print(f"no verdict: {failure}")
        found = list(done(wanted, suite, rows))
        if not found:
            continue
        total = sum(pair.suite == suite for pair in wanted)
        codes = {row["versions"].get("source") or row.get("code") for _, *both in found for row in both}
        named = len(codes - {None})
        mixed = f"; made with {named} states of the source and older ones" if None in codes else (
            f"; made with {named} states of the source" if named > 1 else "")
        print(f"\n{found[0][0].ours.preset} against {suite}: {len(found)} of {total} pairs{mixed}")
        report_flips(found)
        report_errors(found)
        if suite == "paper":
            for pair, ours, other in found:
                print(f"  {pair.ours.grasped:10s} {pair.ours.preset}: {words(ours)}   paper: {words(other)}")


def report_flips(found: list[tuple[Pair, dict, dict]]) -> None:
    """Print which verdicts differ, and which of them the estimate had flagged."""
    flips = [(pair, ours, other) for pair, ours, other in found if ours["held"] != other["held"]]
    low, high = wilson(len(flips), len(found))
    share = 100 * len(flips) / len(found)
    print(f"  verdict flips: {len(flips)}, {share:.1f} % (95 % interval {low:.1f} to {high:.1f})")
    for pair, ours, other in flips:
        print(f"    {pair.ours.design}, {pair.ours.grasped}: {words(ours)}   {pair.other.preset}: {words(other)}")
        if has_estimate(ours):
            print(f"      flagged: {ours['estimate']['reason'] or 'NOT FLAGGED'}")
        elif pair.suite != "paper":
            print("      not estimated yet")
    estimated = [(ours, other) for _, ours, other in found if has_estimate(ours)]
    if estimated:
        flagged = sum(ours["estimate"]["uncertain"] for ours, _ in estimated)
        missed = sum(ours["held"] != other["held"] and not ours["estimate"]["uncertain"] for ours, other in estimated)
        print(f"  flagged uncertain: {flagged} of {len(estimated)}; flips that were not flagged: {missed}")


def held_by_both(found: list[tuple[Pair, dict, dict]]) -> list[tuple[str, str, list[tuple[float, dict, dict]]]]:
    """Return for force and drop: name, entry of a row, and the errors of those that both hold, with their rows."""
    held = [(ours, other) for _, ours, other in found if ours["held"] and other["held"]]
    forces = [(100 * abs(a["force_N"] / b["force_N"] - 1), a, b) for a, b in held if b["force_N"] > FIRM_N]
    drops = [(abs(a["drop_mm"] - b["drop_mm"]), a, b) for a, b in held]
    return [("force [%]", "force_N", forces), ("drop [mm]", "drop_mm", drops)]


def report_errors(found: list[tuple[Pair, dict, dict]]) -> None:
    """Print errors of force and drop where both hold the object, how they lie to the estimate, and the seconds."""
    for name, entry, errors in held_by_both(found):
        if not errors:
            continue
        values = np.array([error for error, _, _ in errors])
        line = f"  {name} of {len(values)} held by both: median {np.median(values):.2f}, " \
               f"{QUANTILE} % below {np.percentile(values, QUANTILE):.2f}, largest {values.max():.2f}"
        spreads = [(abs(a[entry] - b[entry]), a["estimate"][entry][1]) for _, a, b in errors if has_estimate(a)]
        known = [(error, spread) for error, spread in spreads if spread is not None]
        if known:
            inside = sum(error <= spread for error, spread in known)
            line += f"; within the estimated spread: {inside} of {len(known)}"
        print(line)
    ours = np.array([row["seconds"] for _, row, _ in found])
    other = np.array([row["seconds"] for _, _, row in found])
    ratios = other / np.maximum(ours, 1e-9)
    print(f"  seconds a grasp: {ours.mean():.1f} and {other.mean():.1f}; "
          f"ratio of the sums {other.sum() / ours.sum():.2f}, median ratio {np.median(ratios):.2f}")
    costs = [row["estimate_levels"]["seconds"] for _, row, _ in found if has_estimate(row)]
    if costs:
        base = sum(cost["base"] for cost in costs)
        extra = sum(value for cost in costs for name, value in cost.items() if name != "base")
        print(f"  the estimate costs {extra / max(base, 1e-9):.2f} times the grasp itself")


def write_bands(preset: str, suite: str, found: list[tuple[Pair, dict, dict]]) -> None:
    """Write what a suite found of ``preset`` to studies/presets.json, which every result then carries."""
    path = studies_folder() / "presets.json"
    document = json.loads(path.read_text())
    force, drop = (np.percentile([error for error, *_ in errors], QUANTILE) for *_, errors in held_by_both(found))
    flips = sum(ours["held"] != other["held"] for _, ours, other in found)
    document["studies"]["grasp"] |= {"date": time.strftime("%Y-%m-%d"), "versions": found[-1][1]["versions"]}
    document["presets"][preset] |= {
        "settings": PRESETS[preset], "grasp_force_error_percent": round(float(force), 2),
        "drop_error_mm": round(float(drop), 3), "verdict_flips_percent": round(100 * flips / len(found), 1),
        "grasp_seconds": round(float(np.median([ours["seconds"] for _, ours, _ in found])), 1),
        "grasps_compared": f"{len(found)} grasps against {suite}",
    }
    write_whole(path, json.dumps(document, indent=2) + "\n")


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a share [%] (Wilson 1927)."""
    z, share = 1.96, count / total
    centre = (share + z * z / (2 * total)) / (1 + z * z / total)
    half = z / (1 + z * z / total) * math.sqrt(share * (1 - share) / total + z * z / (4 * total * total))
    return 100 * max(centre - half, 0.0), 100 * min(centre + half, 1.0)


def main() -> None:
    """Read the options, run, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", required=True)
    parser.add_argument("--preset", choices=tuple(PRESETS), default="standard", help="the one under study")
    parser.add_argument("--suites", default=",".join(SUITES), help="some of fine, reference, paper")
    parser.add_argument("--pairs", type=int, help="only that many, from the beginning of the interleaved order")
    parser.add_argument("--budget-minutes", type=float, default=math.inf, help="no grasp starts later")
    parser.add_argument("--limit-s", type=float, default=1800.0, help="a simulation is given up after that")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--report", action="store_true", help="only print what the log holds")
    parser.add_argument("--bands", action="store_true", help="write the preset's errors into studies/presets.json")
    arguments = parser.parse_args()
    suites = arguments.suites.split(",")
    if not set(suites) <= set(SUITES):
        parser.error(f"--suites: known are {', '.join(SUITES)}")
    wanted = pairs(arguments.preset, suites)[: arguments.pairs]
    if arguments.report:
        arguments.budget_minutes = -1.0
    rows = run(arguments, wanted)
    report(wanted, rows)
    if arguments.bands:
        suite = "fine" if arguments.preset != "fine" else "reference"
        mine = [pair for pair in wanted if pair.suite == suite]
        if len(mine) < LEAST_PAIRS or any(not {pair.ours, pair.other} <= rows.keys() for pair in mine):
            parser.exit(1, f"not all pairs of the suite {suite} are there, or less than {LEAST_PAIRS}: no bands\n")
        write_bands(arguments.preset, suite, list(done(wanted, suite, rows)))


if __name__ == "__main__":
    main()
