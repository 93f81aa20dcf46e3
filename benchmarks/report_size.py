"""How long the page of a large search takes to make, and how large it is: 30 s and 30 MB are the bar.

    python benchmarks/report_size.py [--evaluations 10000] [--cells 30] [--rechecked 0] [--out page.html]

The run is made up (`tests/synthetic_run.py`): real designs of the fin ray, invented fitness, features near the real
ones. It is written as a log first, which the report reads.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

from finqd.report import designs_shown, report_data
from finqd.report_page import page
from finqd.report_shapes import MAX_SHAPES, shapes_of
from finqd.runlog import RunLog, read_run

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from synthetic_run import synthetic_run  # noqa: E402


def write_log(folder: Path, options: argparse.Namespace) -> None:
    """Make a run up and write it as a log."""
    made = synthetic_run(options.evaluations, cells=options.cells, rechecked=options.rechecked, measured=False)
    with RunLog.start(
        folder, settings=made.settings, base=made.base, parameters=made.parameters, ranges=made.ranges
    ) as log:
        for record in made.records():
            log.append(record)
        for row in made.rechecks():
            log.append_recheck(row)
        log.note_told(options.evaluations)


def main() -> None:
    """Make a run and its page; print seconds, sizes and memory."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--evaluations", type=int, default=10_000)
    parser.add_argument("--cells", type=int, default=30, help="along each of the two axes")
    parser.add_argument("--rechecked", type=int, default=0, help="elites with three rechecks each")
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "finqd_report_size.html")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        write_log(Path(folder) / "run", options)
        told = time.perf_counter() - begun
        print(f"{options.evaluations} evaluations made up and logged in {told:.0f} s (not part of the report)")
        marks, busy = [time.perf_counter()], time.process_time()
        data = report_data(read_run(Path(folder) / "run"), name="made up")
    marks.append(time.perf_counter())
    shapes = shapes_of(designs_shown(data), limit=MAX_SHAPES)
    marks.append(time.perf_counter())
    options.out.write_text(page(data, shapes), encoding="utf-8")
    marks.append(time.perf_counter())
    for name, begin, end in zip(("numbers", "shapes", "page"), marks, marks[1:]):
        print(f"{name:8} {end - begin:6.1f} s")
    packed = sum(len(shape["data"]) for shape in shapes["shapes"].values())
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    busy = time.process_time() - busy  # what it takes on a core of its own, whoever else is at work
    print(f"together {marks[-1] - marks[0]:6.1f} s (bar: 30 s), {busy:.1f} s of a core")
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.1f} MB (bar: 30 MB), {packed / 1e6:.1f} MB of it shapes")
    print(f"{len(data['designs'])} designs on the page, {len(shapes['shapes'])} of them in 3-D; peak {memory:.0f} MB")


if __name__ == "__main__":
    main()
