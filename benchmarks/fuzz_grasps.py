"""Does anything break? Random designs on random objects; a table of statuses, every failure with its reason.

    python benchmarks/fuzz_grasps.py --log fuzz.jsonl [--suites draft,standard,wild] [--minutes 60] [--report]

Three suites, chosen before any of them was looked at (`SEED`):

- draft: 1,000 designs, uniform over the whole design space (scrambled Sobol points), each on one of the ten objects;
- standard: every fifth of them again, with the preset `standard`;
- wild: 200 more on `draft`, with friction, gravity, the protocol's times, the time step and the material drawn too.

They are interleaved, so that what is done is an unbiased sample of the whole. Writes a line a grasp as it goes, and
resumes from there; a line whose design or preset has changed since is done again. A crash of a process and a hang (no
answer though the simulation's own time limit is long over) are rows as well.
"""

from __future__ import annotations

import argparse
import collections
import math
from collections.abc import Iterable
from dataclasses import dataclass
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
from finqd.trajectory import Trajectory
from finqd.workers import TaskFailure

SEED = 4
CASES = {"draft": 1000, "standard": 200, "wild": 200}
LIMIT_S = 600.0  # of computing, after which a simulation ends itself
HANG_S = 300.0  # more than that: it has not
FAILED = ("diverged", "timeout")
BAR_MM = 0.2  # penetration that 99.9 % of the grasps stay below
#: what `wild` draws: path in the design file -> lowest, highest, and whether evenly by magnitude
WILD = {
    "protocol.friction_coefficient": (0.0, 2.0, False), "protocol.gravity_m_s2": (0.0, 30.0, False),
    "protocol.close_s": (0.1, 2.0, True), "protocol.squeeze_s": (0.0, 0.5, False), "protocol.lift_s": (0.1, 1.0, True),
    "protocol.lift_mm": (0.0, 100.0, False), "protocol.hold_s": (0.0, 0.5, False),
    "protocol.tip_clearance_mm": (0.0, 10.0, False), "protocol.time_step_ms": (2.0, 50.0, True),
    "material.youngs_modulus_MPa": (0.3, 300.0, True), "material.poisson_ratio": (0.0, 0.4999, False),
    "actuation.angle_deg": (0.0, 45.0, False), "actuation.force_limit_N": (0.1, 1e3, True),
}


@dataclass(frozen=True)
class Case:
    """One grasp: the design is ready for `evaluate`, its preset included."""

    suite: str
    number: int
    grasped: str
    preset: str
    design: Design


def cases(suites: Iterable[str]) -> list[Case]:
    """Return the cases of the suites, interleaved; the choice depends on `SEED` alone."""
    most = CASES["draft"] + CASES["wild"]
    units = qmc.Sobol(len(design_parameters()), seed=SEED).random(2 ** math.ceil(math.log2(most)))
    generator = np.random.default_rng(SEED)
    names = sorted(object_names())
    objects = [names[i] for i in generator.integers(len(names), size=most)]
    shares = generator.random((CASES["wild"], len(WILD)))
    fifth = CASES["draft"] // CASES["standard"]
    numbers = {
        "draft": range(CASES["draft"]), "standard": range(0, CASES["draft"], fifth), "wild": range(CASES["draft"], most)
    }
    placed = []
    for suite in suites:
        for place, number in enumerate(numbers[suite]):
            changes = {"protocol.wall_clock_limit_s": LIMIT_S}
            if suite == "wild":
                changes |= drawn(shares[place])
            preset = "standard" if suite == "standard" else "draft"
            design = apply_preset(Design.from_unit_vector(units[number].tolist()), preset, overrides=changes)
            placed.append(((place + 0.5) / CASES[suite], Case(suite, number, objects[number], preset, design)))
    return [case for _, case in sorted(placed, key=lambda one: one[0])]


def drawn(shares: np.ndarray) -> dict[str, float]:
    """Return values of what `WILD` names, from as many shares of its ranges."""
    values = {}
    for share, (path, (low, high, logarithmic)) in zip(shares, WILD.items(), strict=True):
        values[path] = float(low * (high / low) ** share if logarithmic else low + share * (high - low))
    return values


def simulate(case: Case) -> dict[str, Any]:
    """Simulate one case; return a row of the log."""
    evaluation = evaluate(case.design, objects=[case.grasped], preset=case.preset)
    row = evaluation.to_dict()["objects"][case.grasped]
    kept = ("status", "reason", "held", "drop_mm", "max_penetration_mm", "max_contact_force_N", "seconds", "counters")
    finite = is_finite(evaluation.trajectories[case.grasped])
    return {**named(case), **{key: row[key] for key in kept}, "finite": finite}


def named(case: Case) -> dict[str, Any]:
    """Return what tells a case from all others."""
    return {"suite": case.suite, "number": case.number, "object": case.grasped, "digest": case.design.digest()}


def is_finite(trajectory: Trajectory) -> bool:
    """Return whether every number of a trajectory is one."""
    arrays = [
        trajectory.rigid_positions, trajectory.rigid_rotations, trajectory.soft_centres, trajectory.contact_forces,
        trajectory.penetrations, *trajectory.energies.values(),
    ]
    return all(bool(np.all(np.isfinite(values))) for values in arrays)


def key(row: dict[str, Any]) -> tuple[str, int]:
    """Return which case a row is of."""
    return row["suite"], row["number"]


def words(row: dict[str, Any]) -> str:
    """Return a row in words."""
    return (f"{row['suite']} {row['number']} {row['object']}: {row['status']} {row['seconds']:.0f} s "
            f"{row['reason']}")


def run(arguments: argparse.Namespace, wanted: list[Case]) -> dict[tuple[str, int], dict[str, Any]]:
    """Simulate what the log does not hold yet, until the time is up; return all rows that hold."""
    tasks = {(case.suite, case.number): case for case in wanted}
    rows = rows_that_hold(arguments.log, {one: case.design.digest() for one, case in tasks.items()}, key)

    def failed(one: tuple[str, int], failure: TaskFailure) -> dict[str, Any]:
        kind = "hang" if failure.kind == "timeout" else "crash"
        return {**named(tasks[one]), "status": kind, "reason": failure.reason, "finite": True, "held": False,
                "seconds": 0.0}

    if not arguments.report:
        compute_missing(tasks, rows, simulate, log=arguments.log, words=words, jobs=arguments.jobs,
                        minutes=arguments.minutes, failed=failed, time_limit_s=LIMIT_S + HANG_S)
    return rows


def report(rows: list[dict[str, Any]], suite: str) -> None:
    """Print statuses, penetrations and times of a suite."""
    if not rows:
        return
    print(f"\n{suite}: {len(rows)} of {CASES[suite]} cases, held {sum(row['held'] for row in rows)}")
    for status, count in collections.Counter(row["status"] for row in rows).most_common():
        print(f"  {status:12s} {count:4d}  {100 * count / len(rows):.1f} %")
    failed = sum(row["status"] in FAILED for row in rows)
    print(f"  diverged or timeout: {100 * failed / len(rows):.2f} %;  not finite: {sum(not r['finite'] for r in rows)}")
    depths = [(row["max_penetration_mm"], row) for row in rows if row.get("max_penetration_mm") is not None]
    deepest = sorted(depths, key=lambda one: -one[0])[:3]
    within = sum(depth <= BAR_MM for depth, _ in depths)
    print(f"  penetration at most {BAR_MM} mm in {100 * within / len(depths):.1f} %; the worst:",
          ", ".join(f"{depth:.3f} mm ({row['number']}, {row['object']})" for depth, row in deepest))
    seconds = np.array([row["seconds"] for row in rows])
    print(f"  seconds a grasp: median {np.median(seconds):.1f}, 95 % below {np.quantile(seconds, 0.95):.1f}, "
          f"largest {seconds.max():.1f}")
    print(f"  {commits(rows)}")
    for row in rows:
        if row["status"] != "ok" or not row["finite"]:
            print(f"  {row['number']}, {row['object']}: {row['status']}: {row['reason']}")


def main() -> None:
    """Run the study as far as time allows, and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=Path, required=True)
    parser.add_argument("--suites", default=",".join(CASES))
    parser.add_argument("--minutes", type=float, default=math.inf)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--report", action="store_true", help="only print what the log holds")
    arguments = parser.parse_args()
    suites = arguments.suites.split(",")
    unknown = sorted(set(suites) - set(CASES))
    if unknown:
        parser.error(f"there is no suite {', '.join(unknown)}; known: {', '.join(CASES)}")
    rows = run(arguments, cases(suites))
    for suite in suites:
        report([row for (of, _), row in sorted(rows.items()) if of == suite], suite)


if __name__ == "__main__":
    main()
