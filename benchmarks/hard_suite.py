"""The hard cases (`tests/hard`), slow ones included: run as far as time allows, a line of the log for each.

    python benchmarks/hard_suite.py --log hard.jsonl [--minutes 60] [--jobs 2] [--report]

Cases come in an order drawn once (`SEED`), so that what is done is an unbiased sample of all families. Resumes with
those not run yet, then those that did not pass. Every line names the commit that it was run on.
"""

from __future__ import annotations

import argparse
import collections
import math
import random
import time
from pathlib import Path
from typing import Any

import pytest
from checkout import FOLDER, commit, commits

from finqd.study_log import append_row, read_rows

SEED = 4


class Collected:
    """Keeps what pytest finds."""

    ids: list[str]

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Keep the cases' names."""
        self.ids = [item.nodeid for item in session.items]


class Log:
    """Writes a line when a case ends, and ends the session when the time is up."""

    def __init__(self, path: Path, *, deadline: float) -> None:
        self.path, self.deadline, self.commit = path, deadline, commit()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Write how a case ended: its own phase, or another that failed or was left out."""
        if report.when == "call" or not report.passed:
            row = {"case": report.nodeid, "outcome": report.outcome, "seconds": round(report.duration, 1),
                   "commit": self.commit, "reason": first_line(report)}
            append_row(self.path, row)
        if time.time() > self.deadline:
            pytest.exit("the time is up", returncode=0)


def first_line(report: pytest.TestReport) -> str:
    """Return the sentence that pytest's own summary would give for a failure; nothing for a pass."""
    crash = getattr(report.longrepr, "reprcrash", None)
    return "" if report.passed else str(crash.message if crash else report.longrepr).partition("\n")[0]


def all_cases() -> list[str]:
    """Return the names of all hard cases, in the order that `SEED` draws."""
    found = Collected()
    options = ["--collect-only", "-p", "no:terminal", "-p", "no:cacheprovider"]
    if pytest.main([*options, str(FOLDER / "tests" / "hard")], plugins=[found]) != pytest.ExitCode.OK:
        raise SystemExit("the cases can't be collected: try pytest --collect-only tests/hard")
    return random.Random(SEED).sample(found.ids, len(found.ids))


def newest(log: Path) -> dict[str, dict[str, Any]]:
    """Return the newest row of each case."""
    return {row["case"]: row for row in read_rows(log)}


def report(rows: list[dict[str, Any]], count: int) -> None:
    """Print, family by family, how the cases ended and what they took; then every one that did not pass."""
    passed = sum(row["outcome"] == "passed" for row in rows)
    print(f"\n{len(rows)} of {count} cases run, {passed} passed, {sum(row['seconds'] for row in rows) / 3600:.1f} h")
    families = collections.defaultdict(list)
    for row in rows:
        families[Path(row["case"].partition("::")[0]).stem].append(row)
    for family, members in sorted(families.items()):
        outcomes = collections.Counter(row["outcome"] for row in members)
        seconds = sorted(row["seconds"] for row in members)
        print(f"  {family:18s} {len(members):4d}  {dict(outcomes)}  median {seconds[len(seconds) // 2]:.0f} s, "
              f"longest {seconds[-1]:.0f} s")
    print(f"  {commits(rows)}")
    for row in rows:
        if row["outcome"] != "passed":
            print(f"  {row['case']}: {row['outcome']}: {row['reason']}")


def main() -> None:
    """Run what has not passed yet, and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=math.inf)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--report", action="store_true", help="only print what the log holds")
    arguments = parser.parse_args()
    names = all_cases()
    rows = newest(arguments.log)
    left = [name for name in names if name not in rows]
    left += [name for name in names if name in rows and rows[name]["outcome"] != "passed"]
    if left and not arguments.report:
        log = Log(arguments.log.resolve(), deadline=time.time() + 60.0 * arguments.minutes)
        options = ["-q", "-p", "no:cacheprovider", "--rootdir", str(FOLDER), "-n", str(arguments.jobs)]
        pytest.main([*options, "--maxschedchunk=1", *(str(FOLDER / name) for name in left)], plugins=[log])
        rows = newest(arguments.log)
    report([rows[name] for name in names if name in rows], len(names))


if __name__ == "__main__":
    main()
