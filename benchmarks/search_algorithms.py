"""Does searching beat sampling? Four algorithms at an equal number of evaluations, several seeds.

    python benchmarks/search_algorithms.py --log LOG.jsonl [--evaluations 600] [--seeds 3] [--real] [--report]

On a stand-in (`stand_in.py` says what it has of a gripper and what not), or, with ``--real``, on grasps of all ten
objects with the preset `draft`: hours. Writes a line a run as it goes, and resumes from there. Prints coverage, QD
score and best objective of each algorithm as the median of the seeds, with the lowest and the highest; and whether its
lowest QD score lies above the highest of sampling.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

import stand_in
from checkout import commit, commits

from finqd.algorithms import ALGORITHMS
from finqd.search import optimise
from finqd.study_log import append_row, read_rows
from finqd.workers import Inline

BATCH = 15
SHOWN = ("coverage", "qd_score", "best")


def run(algorithm: str, seed: int, evaluations: int, *, real: bool, folder: Path) -> dict[str, Any]:
    """Return how one search ended. A real one stays in ``folder``, where it goes on after a stop."""
    options: dict[str, Any] = {"preset": "draft", "jobs": 2}
    if not real:
        options = {"evaluate": stand_in.evaluate, "ranges": stand_in.RANGES, "workers": Inline(), "time_limit_s": None}
    found = optimise(
        out=folder / f"{algorithm}-{seed}-{evaluations}", algorithm=algorithm, seed=seed, batch=BATCH,
        iterations=evaluations // BATCH, **options,
    )  # fmt: skip
    stats = found.archive.stats
    return {"coverage": float(stats.coverage), "qd_score": float(stats.qd_score), "best": float(stats.obj_max),
            "failed": sum(record["status"] != "ok" for record in found.records)}  # fmt: skip


def report(rows: list[dict[str, Any]]) -> None:
    """Print the table of each kind and number of evaluations."""
    for real, evaluations in sorted({(row["real"], row["evaluations"]) for row in rows}):
        mine = [row for row in rows if (row["real"], row["evaluations"]) == (real, evaluations)]
        print(f"\n{'grasps with draft' if real else 'stand-in'}, {evaluations} evaluations, batches of {BATCH}; "
              f"{commits(mine)}")  # fmt: skip
        print(f"{'algorithm':12s} seeds  " + "  ".join(f"{name:>26s}" for name in SHOWN))
        sampled = [row["qd_score"] for row in mine if row["algorithm"] == "sobol"]
        for algorithm in ALGORITHMS:
            own = [row for row in mine if row["algorithm"] == algorithm]
            if not own:
                continue
            cells = []
            for name in SHOWN:
                values = [row[name] for row in own]
                cells.append(f"{statistics.median(values):8.3f} ({min(values):.3f} to {max(values):.3f})")
            beats = ""
            if sampled and algorithm != "sobol":
                beats = "beats" if min(row["qd_score"] for row in own) > max(sampled) else "does not clearly beat"
                beats += " sampling"
            print(f"{algorithm:12s} {len(own):5d}  " + "  ".join(f"{cell:>26s}" for cell in cells) + f"  {beats}")


def main() -> None:
    """Run what is missing; print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=Path, required=True)
    parser.add_argument("--evaluations", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--algorithms", default=",".join(ALGORITHMS))
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--folder", type=Path, help="of real runs  [default: beside the log]")
    parser.add_argument("--report", action="store_true", help="only print what the log holds")
    arguments = parser.parse_args()
    rows, source = read_rows(arguments.log), commit()
    done = {(row["real"], row["evaluations"], row["algorithm"], row["seed"]) for row in rows}
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or (arguments.log.with_suffix("") if arguments.real else Path(temporary))
        for seed in range(0 if arguments.report else arguments.seeds):
            for algorithm in arguments.algorithms.split(","):
                case = (arguments.real, arguments.evaluations, algorithm, seed)
                if case in done:
                    continue
                found = run(algorithm, seed, arguments.evaluations, real=arguments.real, folder=folder)
                row = {**dict(zip(("real", "evaluations", "algorithm", "seed"), case)), **found, "commit": source}
                append_row(arguments.log, row)
                rows.append(row)
                print(f"{algorithm} {seed}: QD score {found['qd_score']:.3f}", file=sys.stderr, flush=True)
    report(rows)


if __name__ == "__main__":
    main()
