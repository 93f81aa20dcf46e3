"""finqd beside peers that install from the package index: the same mesh, material and motion, accuracy beside seconds.

    python benchmarks/peers.py [--cases sag_0.3,sag_0.49,weight,press] [--programs finqd,mujoco,drake]
                               [--python PATH] [--cold] [--limit-s 300] [--log peers.jsonl] [--report]

In a mesh that is given MuJoCo's flexes and Drake's deformable bodies know linear tetrahedra only; so finqd runs them
too, and its own quadratic bricks besides. Peers run in ``--python``, another interpreter, where ``pip install mujoco
drake`` has been done (by default the one that runs this); one that it cannot import is left out. Every program runs in
a process of its own, on one thread. Seconds are of processor time, for set-up and motion, without meshing; finqd's warm
(a second run in the same process), and with ``--cold`` also from an empty cache of kernels.

One rule for all gives the time step: down the same ladder, the first step whose result the next smaller one changes by
less than 1 %. Errors are against converged meshes, which are computed (`peer_cases`), or have been in `finqd verify`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from peer_cases import CASES, Outcome, PeerCase, Task, Variant

from finqd.errors import FinqdError, InputError
from finqd.study_log import append_row, read_rows
from finqd.verification.cases import Failed

LADDER = (0.04, 0.02, 0.01, 0.005, 0.002, 0.001)  # [s]
SAME = 0.01  # share by which the result of the next smaller step may differ
MODULES = {"mujoco": "mujoco", "drake": "pydrake", "finqd": "finqd"}
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
FOLDER = Path(__file__).resolve().parent


def environment(program: str, **more: str) -> dict[str, str]:
    """Return the environment of a program's process; finqd is found beside this script."""
    found = {**os.environ, **ONE_THREAD, **more}
    if program == "finqd":
        found["PYTHONPATH"] = os.pathsep.join([str(FOLDER.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    else:
        found.pop("PYTHONPATH", None)
    return found


def missing(program: str, python: str) -> str:
    """Return one sentence on what to install if ``python`` cannot import a program, nothing if it can."""
    command = [python, "-c", f"import {MODULES[program]}"]
    try:
        done = subprocess.run(command, capture_output=True, env=environment(program))
    except OSError as error:
        raise InputError(f"cannot be run: {error.strerror}", "--python") from error
    if done.returncode == 0:
        return ""
    return f"{program} is left out: {python} cannot import it; install it there by `pip install {program}`."


def ask(program: str, python: str, task: Task, *, timeout: float, **more: str) -> Outcome:
    """Run one task in a process of its own; whatever goes wrong there is ``failed``, one sentence."""
    command = [python, str(FOLDER / f"peer_{program}.py")]
    with tempfile.TemporaryDirectory() as folder:  # MuJoCo leaves a file of its warnings where it runs
        try:
            done = subprocess.run(
                command, input=json.dumps(task), capture_output=True, text=True, timeout=timeout, cwd=folder,
                env=environment(program, **more),
            )
        except subprocess.TimeoutExpired:
            return {"failed": f"not done after {timeout:g} s"}
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"ended with status {done.returncode}"]
        return {"failed": " ".join(lines[-1].split())}
    return json.loads(done.stdout)


def down_the_ladder(case: PeerCase, variant: Variant, python: str, limit: float) -> Outcome:
    """Return the outcome of the largest time step that is good enough, or the last one with why it may not be.

    ``ladder``: what every step that was tried gave, by milliseconds.
    """
    task: Task = {**case.task(variant.mesh), "stepper": variant.stepper, "limit_s": limit, "repeats": 2}
    dofs, larger = 3 * (len(task["vertices"]) - len(task["clamped"])), {"failed": "not run"}
    ladder: dict[str, Any] = {}
    for step in LADDER:
        found = ask(variant.program, python, {**task, "time_step": step}, timeout=4 * limit)
        found = {**found, "time_step": step, "dofs": dofs, "ladder": ladder}
        if not found["failed"]:
            found["value"] = case.value(found)
        ladder[f"{1e3 * step:g}"] = found["failed"] or found["value"]
        if not larger["failed"]:
            if found["failed"]:
                return noted(larger, f"{1e3 * step:g} ms: {found['failed']}")
            if abs(found["value"] - larger["value"]) <= SAME * abs(found["value"]):
                return larger
        larger = found
    return larger if larger["failed"] else noted(larger, "smaller steps may change it")


def stepper_of(variant: Variant) -> str:
    """Return the name of finqd's stepper, nothing for peers, which have their own."""
    return variant.stepper["name"] if variant.program == "finqd" else ""


def noted(found: Outcome, remark: str) -> Outcome:
    """Return an outcome with one more remark."""
    return {**found, "note": "; ".join(filter(None, [found.get("note", ""), remark]))}


def measured(
    name: str, variant: Variant, python: str, *, reference: tuple[float, str], limit: float, cold: bool
) -> dict[str, Any]:
    """Return the row of one program in one case, with what it is held against."""
    case = CASES[name]
    found = down_the_ladder(case, variant, python, limit)
    row = {"case": name, "asked": variant.program, "mesh": variant.mesh, "stepper": stepper_of(variant), **found}
    row["reference"], row["source"] = reference
    if not found["failed"]:
        row["error"] = found["value"] / reference[0] - 1.0
        row["check"] = case.check(found)
    if cold and variant.program == "finqd" and not found["failed"]:
        task = {**case.task(variant.mesh), "stepper": variant.stepper, "limit_s": limit, "repeats": 1}
        with tempfile.TemporaryDirectory() as cache:
            task["time_step"] = found["time_step"]
            row["cold_s"] = ask("finqd", python, task, timeout=3 * limit, NUMBA_CACHE_DIR=cache).get("first_s")
    return row


def line(row: dict[str, Any], unit: str) -> str:
    """Return a row of the table."""
    name = row.get("program", row["asked"])
    if row["failed"]:
        return f"| {name} | {row['mesh']} | | {1e3 * row.get('time_step', 0):g} ms | | | {row['failed']} | | |"
    cold = f"{row['cold_s']:.0f}" if row.get("cold_s") else ""
    remarks = "; ".join(filter(None, [row.get("check", ""), row.get("note", ""), row.get("law", "")]))
    seconds, off = row["seconds"] + row["set_up_s"], 100 * row["error"]
    return (
        f"| {name}, {row['solver']} | {row['mesh']} | {row['dofs']:,} | {1e3 * row['time_step']:g} ms "
        f"| {seconds:.2f} | {cold} | {row['value']:.4g} {unit} | {off:+.1f} % | {remarks} |"
    )


def table(name: str, rows: list[dict[str, Any]]) -> None:
    """Print the rows of one case."""
    case = CASES[name]
    if not rows:
        print(f"\n{name}: {case.title}\nno rows")
        return
    found = f"{rows[0]['reference']:.4g} {case.unit} ({rows[0]['source']})"
    print(f"\n{name}: {case.title}\nreference: {found}; {case.effects}\n")
    print(f"| program | mesh | unknowns | time step | seconds | cold | {case.quantity} | off | |")
    print("|---|---|---|---|---|---|---|---|---|")
    for row in rows:
        print(line(row, case.unit))
    sys.stdout.flush()


def chosen(text: str, known: Any, option: str) -> list[str]:
    """Return the names in a list. Raises InputError for one that is not known."""
    names = [name for name in text.split(",") if name]
    for name in names:
        if name not in known:
            raise InputError(f"there is no {name!r}; known: {', '.join(known)}", option)
    return names


def arguments_of(argv: list[str] | None) -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--programs", default=",".join(MODULES))
    parser.add_argument("--python", default=sys.executable, help="interpreter that can import the peers")
    parser.add_argument("--cold", action="store_true", help="run finqd from an empty cache of kernels, too")
    parser.add_argument("--limit-s", type=float, default=300.0, help="processor seconds after which a run is stopped")
    parser.add_argument("--log", type=Path, help="keep rows here, and take them from here where they are already")
    parser.add_argument("--report", action="store_true", help="print what the log holds, and run nothing")
    return parser.parse_args(argv)


def run(arguments: argparse.Namespace) -> None:
    """Measure and print, a case at a time."""
    cases = chosen(arguments.cases, CASES, "--cases")
    programs = chosen(arguments.programs, MODULES, "--programs")
    if not arguments.limit_s > 0.0:
        raise InputError(f"must be more than 0, not {arguments.limit_s:g}", "--limit-s")
    if arguments.report and arguments.log is None:
        raise InputError("goes with --log", "--report")
    pythons = {program: sys.executable if program == "finqd" else arguments.python for program in programs}
    for program in [] if arguments.report else programs:
        if reason := missing(program, pythons[program]):
            print(reason, file=sys.stderr, flush=True)
            del pythons[program]
    logged = [] if arguments.log is None else read_rows(arguments.log)
    kept = {(row["case"], row["asked"], row["mesh"], row["stepper"]): row for row in logged}
    for name in cases:
        known = [(row["reference"], row["source"]) for row in kept.values() if row["case"] == name]
        for variant in CASES[name].variants:
            key = (name, variant.program, variant.mesh, stepper_of(variant))
            if key in kept or variant.program not in pythons or arguments.report:
                continue
            known = known or [CASES[name].reference()]
            kept[key] = measured(
                name, variant, pythons[variant.program], reference=known[0], limit=arguments.limit_s,
                cold=arguments.cold,
            )
            if arguments.log is not None:
                append_row(arguments.log, kept[key])
        wanted = [(name, v.program, v.mesh, stepper_of(v)) for v in CASES[name].variants]
        table(name, [kept[key] for key in wanted if key in kept])


def main(argv: list[str] | None = None) -> int:
    """Return the exit status: 2 for what was typed wrongly, 1 where a reference could not be computed."""
    try:
        run(arguments_of(argv))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (FinqdError, Failed) as error:  # of a reference
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
