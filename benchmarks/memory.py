"""Does memory grow? Many evaluations in one process, as a long search makes them.

    python benchmarks/memory.py [--evaluations 300] [--designs 10] [--objects sphere,pasta] [--trace]

Each is one grasp by `draft` with linear bricks of 8 mm and a short protocol in steps of 50 ms (close 0.3 s, squeeze and
lift 0.1 s, hold 0.05 s), of designs and objects in turn, so that each pair comes back. Prints what the process holds
(resident) as it goes and its growth from the fiftieth evaluation on: by then kernels are compiled, and the meshes that
are kept in memory (32) are all there. ``--trace`` prints which lines have taken memory since then and not given it
back; it slows everything down. Effects: all that are on by default, see the end of the output; seconds are wall-clock.
"""

from __future__ import annotations

import argparse
import collections
import gc
import itertools
import json
import math
import os
import resource
import statistics
import sys
import time
import tracemalloc
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

from checkout import commit  # noqa: E402
from scipy.stats import qmc  # noqa: E402

from finqd.data import designs_folder  # noqa: E402
from finqd.design import Design, design_parameters  # noqa: E402
from finqd.evaluate import evaluate  # noqa: E402

PRESET = "draft"
SHORT = {
    "protocol.close_s": 0.3, "protocol.squeeze_s": 0.1, "protocol.lift_s": 0.1, "protocol.hold_s": 0.05,
    "protocol.time_step_ms": 50.0, "mesher.size_mm": 8.0, "mesher.layers": 1, "mesher.order": 1,
    "mesher.notch_nodes": "middle",
}
SETTLED = 50
SHOWN = (10, 50, 100, 150, 200, 250, 300)
BAR_MB = 5.0


def resident_mb() -> float:
    """Return the memory that this process holds now [MB]; the most that it ever held, where the system says no more."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * resource.getpagesize() / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def designs(count: int) -> list[Design]:
    """Return the benchmark design and further ones from a Sobol sequence."""
    found = [Design.from_json(designs_folder() / "benchmark.json")]
    units = qmc.Sobol(len(design_parameters()), seed=7).random_base2(math.ceil(math.log2(max(count, 2))))
    return found + [Design.from_unit_vector(unit.tolist()) for unit in units[: count - 1]]


def difference(before: tracemalloc.Snapshot, after: tracemalloc.Snapshot) -> None:
    """Print which lines hold more than before."""
    for line in after.compare_to(before, "lineno")[:15]:
        print(f"  {line.size_diff / 1e3:+9.1f} kB, {line.count_diff:+6d} blocks: {line.traceback}")


def main() -> None:
    """Evaluate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--evaluations", type=int, default=300)
    parser.add_argument("--designs", type=int, default=10)
    parser.add_argument("--objects", default="sphere,pasta")
    parser.add_argument("--trace", action="store_true")
    arguments = parser.parse_args()
    pairs = itertools.cycle(itertools.product(designs(arguments.designs), arguments.objects.split(",")))
    held, seconds, statuses, before = [], [], collections.Counter(), None
    for number, (design, name) in enumerate(itertools.islice(pairs, arguments.evaluations), start=1):
        begun = time.perf_counter()
        found = evaluate(design, objects=[name], preset=PRESET, overrides=SHORT)
        seconds.append(time.perf_counter() - begun)
        statuses[found.trajectories[name].status] += 1
        held.append(resident_mb())
        if number in SHOWN:
            typical = statistics.median(seconds)
            print(f"after {number:4d} evaluations: {held[-1]:7.1f} MB, {typical:.2f} s each (median)", flush=True)
        if number == SETTLED and arguments.trace:
            gc.collect()
            tracemalloc.start()
        if number == SETTLED + 1 and arguments.trace:
            before = tracemalloc.take_snapshot()
    if before is not None:
        gc.collect()
        difference(before, tracemalloc.take_snapshot())
    if len(held) > SETTLED:
        growth, collected = held[-1] - held[SETTLED - 1], gc.collect()
        print(f"growth from evaluation {SETTLED} to {len(held)}: {growth:+.1f} MB (bar {BAR_MB:g} MB); largest "
              f"{max(held):.1f} MB; after collecting {collected} objects {resident_mb():.1f} MB")
    print(f"commit {commit()}; statuses {dict(statuses)}; effects {json.dumps(found.to_dict()['effects'])}")


if __name__ == "__main__":
    main()
