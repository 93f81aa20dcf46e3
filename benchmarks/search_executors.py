"""Where evaluations run must not matter: identical archives, and what each place costs an evaluation.

    python benchmarks/search_executors.py [--rounds 20] [--batch 16]

CMA-ME over 28 parameters (`ribs`), with a stand-in evaluator: real designs and their real features, an invented
fitness, and verdicts of ten objects, so that what travels has the size of a real result. Inline, 1 and 2 processes, and
dask with 2 workers, embedded and by the command line (docs/cluster.md). Printed are the seconds until the first two
evaluations are there; the stand-in's own wall-clock time (median); and, of the rounds after the first, what an
evaluation takes beside that: of the time of so many workers what was not spent in the stand-in. Archives are compared
by a digest of all their cells: solutions, objectives, measures, evaluations, to the last bit. Timing needs a quiet
machine.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from finqd import archive as qd
from finqd.design import Design
from finqd.workers import open_workers

RANGES = {"workspace_mm2": (1169.0, 2079.0), "volume_mm3": (35.9e3, 93.6e3)}
OBJECTS = ("cube", "cylinder", "diablo", "diamond", "disk", "flan", "hourglass", "pasta", "sphere", "triangle")


def stand_in(design: Design) -> dict[str, Any]:
    """Return what an evaluation looks like."""
    begun = time.perf_counter()
    number = int(design.digest()[:12], 16)
    verdicts = np.random.default_rng(number).random(len(OBJECTS))
    held = verdicts < np.mean(design.to_unit_vector())
    row = {"status": "ok", "margin": 0.5, "drop_mm": 1.0}
    rows = {name: {**row, "held": bool(one)} for name, one in zip(OBJECTS, held)}
    features = qd.measure_features(design)
    return {"fitness": float(held.mean()), "margin": 0.5, "objects": rows, "features": features,
            "seconds": time.perf_counter() - begun}


def searched(workers: Any, *, rounds: int, batch: int) -> tuple[str, list[float], list[list[float]]]:
    """Run a search; return the digest of its archive, seconds of each round, and the stand-in's own in each."""
    from ribs.emitters import EvolutionStrategyEmitter
    from ribs.schedulers import Scheduler

    archive = qd.new_archive(28, RANGES, cells=10, seed=np.random.SeedSequence(0))
    emitter = EvolutionStrategyEmitter(
        archive, x0=np.full(28, 0.5), sigma0=0.1, ranker="2imp", batch_size=batch, seed=np.random.SeedSequence(1)
    )
    scheduler = Scheduler(archive, [emitter], add_mode="single")
    seconds, own = [], []
    for i in range(rounds):
        units = np.clip(scheduler.ask(), 0.0, 1.0)
        designs = [Design.from_unit_vector(unit) for unit in units]
        begun = time.perf_counter()
        results = workers.run(stand_in, designs, time_limit_s=600.0)
        seconds.append(time.perf_counter() - begun)
        own.append([result["seconds"] for result in results])
        records = [{**result, "index": i * batch + k, "objective": qd.objective(result["fitness"], 0.5, len(OBJECTS))}
                   for k, result in enumerate(results)]
        qd.tell(scheduler, records, RANGES)
    digest = hashlib.sha256()
    for name, column in sorted(archive.data().items()):
        digest.update(name.encode() + np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()[:16], seconds, own


@contextmanager
def cluster(count: int) -> Iterator[str]:
    """Start a scheduler and workers by the command line; yield the address."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scheduler.json"
        common = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
        paths = [str(Path(__file__).parent), *sys.path]
        common["env"] = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
        dask = [sys.executable, "-m", "dask"]
        scheduler = [*dask, "scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
        worker = [*dask, "worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny", "--no-dashboard",
                  "--memory-limit", "0", "--local-directory", folder]
        running = [subprocess.Popen(command, **common) for command in [scheduler, *[worker] * count]]  # type: ignore
        try:
            while not (file.exists() and file.read_text().endswith("}")):
                time.sleep(0.1)
            yield json.loads(file.read_text())["address"]
        finally:
            for process in running:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--batch", type=int, default=16)
    options = parser.parse_args()
    print(f"{options.rounds} rounds of {options.batch}, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print(f"{'where':24} {'start [s]':>9} {'stand-in [ms]':>13} {'beside it [ms]':>14}  archive")
    found = set()
    places = [("inline", 1, {"kind": "inline"}), ("1 process", 1, {"jobs": 1}), ("2 processes", 2, {"jobs": 2}),
              ("dask, 2, embedded", 2, {"kind": "dask", "jobs": 2}), ("dask, 2, command line", 2, {"kind": "dask"})]
    for name, side_by_side, where in places:
        with cluster(2) if name.endswith("command line") else nullcontext() as address:
            extra = {"scheduler": address} if address else {}
            begun = time.perf_counter()
            with open_workers(**where, **extra) as workers:  # type: ignore[arg-type]
                searched(workers, rounds=1, batch=2)
                started = time.perf_counter() - begun
                archive, seconds, own = searched(workers, rounds=options.rounds, batch=options.batch)
        found.add(archive)
        inside = 1000 * statistics.median(one for batch in own[1:] for one in batch)
        beside = statistics.median(side_by_side * whole - sum(parts) for whole, parts in zip(seconds[1:], own[1:]))
        print(f"{name:24} {started:9.1f} {inside:13.2f} {1000 * beside / options.batch:14.2f}  {archive}")
    print("all archives are identical" if len(found) == 1 else f"{len(found)} DIFFERENT archives")
    sys.exit(len(found) != 1)


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # of ribs, about a first batch without improvement
    main()
