"""What a search costs beside its evaluations: 10,000 of a stand-in that takes a millisecond.

    python benchmarks/search_overhead.py [--evaluations 10000] [--algorithm cma_me] [--keep DIR]

Prints, over the run: seconds an evaluation beside the stand-in's own, the memory of the process, the size of the log;
then the seconds that a resumed run takes until it would go on (the whole replay), and what reading the log takes. All
in one process (workers `inline`), so that no pipe is measured. Milliseconds are of processor time and, in brackets, of
the clock: each result waits for the disk. Bars: 5 ms an evaluation, memory flat, resume within 10 s.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import stand_in

from finqd.algorithms import ALGORITHMS
from finqd.run_folder import FILE
from finqd.runlog import read_run
from finqd.search import Standing, optimise
from finqd.workers import Inline

SPENT = {"seconds": 0.0, "count": 0}


def evaluate(design: Any, **options: Any) -> stand_in.StandIn:
    """Call the stand-in, and note what it took."""
    begun = time.process_time()
    found = stand_in.evaluate(design, **options)
    SPENT["seconds"] += time.process_time() - begun
    SPENT["count"] += 1
    return found


def memory_mb() -> float:
    """Return the memory that this process has in use now [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--evaluations", type=int, default=10_000)
    parser.add_argument("--batch", type=int, default=20)
    parser.add_argument("--algorithm", default="cma_me", choices=list(ALGORITHMS))
    parser.add_argument("--keep", type=Path, help="where the run is left, for `report_size.py`")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        measure(arguments, arguments.keep or Path(folder) / "run")


def measure(arguments: argparse.Namespace, out: Path) -> None:
    """Run, resume, read."""
    iterations = max(1, arguments.evaluations // arguments.batch)
    options: dict[str, Any] = {
        "out": out, "algorithm": arguments.algorithm, "batch": arguments.batch, "evaluate": evaluate,
        "ranges": stand_in.RANGES, "workers": Inline(), "time_limit_s": None,
    }  # fmt: skip
    print(f"{arguments.algorithm}, {iterations} iterations of {arguments.batch}")
    steps = sorted({max(1, iterations * part // 10) for part in range(1, 11)})
    begun, clock, last = time.process_time(), time.monotonic(), 0
    print("evaluations  overhead [ms]  memory [MB]  log [MB]")

    def report(standing: Standing) -> None:
        nonlocal begun, clock, last
        number = standing.evaluations // arguments.batch
        if number not in steps or standing.evaluations % arguments.batch or number == last:
            return
        count = SPENT["count"]
        spent, passed = time.process_time() - begun - SPENT["seconds"], time.monotonic() - clock - SPENT["seconds"]
        print(f"{number * arguments.batch:11d}  {1e3 * spent / count:6.2f} ({1e3 * passed / count:.2f})"
              f"  {memory_mb():11.1f}  {(out / FILE).stat().st_size / 1e6:8.1f}", flush=True)  # fmt: skip
        begun, clock, last = time.process_time(), time.monotonic(), number
        SPENT.update(seconds=0.0, count=0)

    optimise(**options, iterations=iterations, report=report)
    for title, call in (
        ("resume, to where it goes on", lambda: optimise(**options, iterations=iterations)),
        ("read the log", lambda: read_run(out).archive()),
    ):
        begun, clock = time.process_time(), time.monotonic()
        call()
        print(f"{title}: {time.process_time() - begun:.1f} s ({time.monotonic() - clock:.1f})")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB, the resumed run included")


if __name__ == "__main__":
    main()
