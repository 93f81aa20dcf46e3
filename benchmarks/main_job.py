"""The main job as a whole process: seconds cold and warm, memory, and whether results repeat to the byte.

    python benchmarks/main_job.py [--objects sphere,cube] [--preset standard] [--repeat 3]

Cold: with an empty cache of compiled kernels. Warm: the cache of that first run. Effects that are on, and versions, are
printed with the result itself.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any


def run_once(arguments: argparse.Namespace, folder: Path, *, name: str, jobs: int) -> tuple[float, dict[str, Any]]:
    """Run ``finqd evaluate`` in a process of its own; return wall seconds and the result."""
    out = folder / f"{name}.json"
    command = [sys.executable, "-m", "finqd", "evaluate", arguments.design, "--preset", arguments.preset]
    command += ["--jobs", str(jobs), "--quiet", "--out", str(out)]
    command += ["--objects", arguments.objects] if arguments.objects else []
    begun = time.perf_counter()
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "kernels")}
    subprocess.run(command, check=True, env=environment, stderr=subprocess.DEVNULL)
    return time.perf_counter() - begun, json.loads(out.read_text())


def without_times(result: dict[str, Any]) -> str:
    """Return a result as text, without what a clock says."""
    objects = {name: {k: v for k, v in row.items() if k != "seconds"} for name, row in result["objects"].items()}
    return json.dumps({**result, "timings": None, "objects": objects}, sort_keys=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--design", default="benchmark")
    parser.add_argument("--objects", default="")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        cold, first = run_once(arguments, Path(folder), name="cold", jobs=2)
        print(f"cold, 2 jobs: {cold:.1f} s; timings {json.dumps(first['timings'])}", flush=True)
        seconds, texts = [], [without_times(first)]
        for i in range(arguments.repeat):
            wall, result = run_once(arguments, Path(folder), name=f"warm{i}", jobs=2)
            seconds.append(wall)
            texts.append(without_times(result))
            print(f"warm, 2 jobs: {wall:.1f} s", flush=True)
        wall, result = run_once(arguments, Path(folder), name="one", jobs=1)
        texts.append(without_times(result))
        print(f"warm, 1 job: {wall:.1f} s")
    print(f"median warm, 2 jobs: {statistics.median(seconds):.1f} s")
    print(f"largest process: {resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024:.0f} MB")
    print(f"all {len(texts)} results equal but for times: {len(set(texts)) == 1}")
    print(json.dumps(result["effects"]), json.dumps(result["versions"]))


if __name__ == "__main__":
    main()
