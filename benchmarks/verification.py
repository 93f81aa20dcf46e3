"""Verification of the mechanics: the same as `finqd verify`, all of it, whole grasps too.

    python benchmarks/verification.py [CASE ...] [--fast] [--json FILE]
"""

from __future__ import annotations

import sys

from finqd.cli import main

if __name__ == "__main__":
    main(["verify", "--grasps", *sys.argv[1:]])
