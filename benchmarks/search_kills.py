"""Is anything lost when a search is killed? The driver and its workers, at random moments, again and again.

    python benchmarks/search_kills.py [--kills 20] [--seed 0]

A search of a stand-in that takes 0.2 s runs undisturbed first. Then the same search, with two worker processes, is
killed (``kill -9``) and begun again until it has been killed so often: each time at a random moment between its start
and 10 s later, in turn the driver and one of its workers. After each kill of the driver the log is read: all that had
been told before, and every whole iteration before the last line of ``progress.log``, must be in it. In the end the
archive must be that of the undisturbed search, to the last bit, and no record may differ but in times.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import stand_in

from finqd.runlog import begun, read_run

ITERATIONS, BATCH, SECONDS = 30, 20, 0.2


def evaluate(design: Any, **options: Any) -> stand_in.StandIn:
    """Call the stand-in, slowly."""
    time.sleep(SECONDS)
    return stand_in.evaluate(design, **options)


def search(out: Path) -> None:
    """Run or resume the search."""
    from finqd.search import optimise
    from finqd.workers import open_workers

    with open_workers("processes", jobs=2) as workers:
        optimise(
            out=out, iterations=ITERATIONS, batch=BATCH, evaluate=evaluate, ranges=stand_in.RANGES, workers=workers
        )


def children(pid: int) -> list[int]:
    """Return the workers of a driver."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
            command = (stat.parent / "cmdline").read_bytes()
        except OSError:  # it has ended
            continue
        if int(fields[1]) == pid and b"spawn_main" in command:
            found.append(int(stat.parent.name))
    return sorted(found)


def untimed(out: Path) -> list[dict[str, Any]]:
    """Return the records of a run without what differs from one computation to the next."""
    times = dict.fromkeys(("seconds", "finished_at", "host", "attempts"), 0)
    return [{**record, **times} for record in read_run(out).records()]


def disturbed(out: Path, kills: int, chance: random.Random) -> None:
    """Run the search to its end, killed so often on the way."""
    done = told = 0
    while True:
        with subprocess.Popen([sys.executable, __file__, "--child", str(out)], stderr=subprocess.DEVNULL) as driver:
            victim = "driver" if done % 2 == 0 else "worker"
            while done < kills and driver.poll() is None:
                time.sleep(chance.uniform(0.0, 10.0))
                target = [driver.pid] if victim == "driver" else children(driver.pid)
                if driver.poll() is not None or not target:
                    continue
                os.kill(chance.choice(target), signal.SIGKILL)
                done += 1
                print(f"kill {done:2d}: {victim}", flush=True)
                if victim == "driver":
                    break
                victim = "driver"
            driver.wait()
        before, told = told, len(read_run(out).records()) if begun(out) else 0
        print(f"         the log holds {told} that were told", flush=True)
        if told < before or told < _said(out):
            sys.exit(f"{before} and {_said(out)} were told of before")
        if driver.returncode == 0:
            return


def _said(out: Path) -> int:
    """Return how many evaluations of whole iterations the last line of ``progress.log`` tells of."""
    path = out / "progress.log"
    found = re.findall(r", (\d+) of \d+ designs", path.read_text()) if path.exists() else []
    return int(found[-1]) // BATCH * BATCH - BATCH if found else 0


def main() -> None:
    """Run undisturbed, run disturbed, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child is not None:
        search(arguments.child)
        return
    with tempfile.TemporaryDirectory() as folder:
        whole, parts = Path(folder) / "whole", Path(folder) / "parts"
        search(whole)
        disturbed(parts, arguments.kills, random.Random(arguments.seed))
        same_archive = (whole / "archive.csv").read_bytes() == (parts / "archive.csv").read_bytes()
        one, other = untimed(whole), untimed(parts)
        differing = [a["index"] for a, b in zip(one, other) if a != b]
        print(f"{len(one)} and {len(other)} records, {len(differing)} differ; archives "
              f"{'equal to the last bit' if same_archive else 'DIFFER'}")  # fmt: skip
        sys.exit(0 if same_archive and not differing and len(one) == len(other) else 1)


if __name__ == "__main__":
    main()
