"""Which state of the sources a row of a log was measured on."""

from __future__ import annotations

import collections
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1]


def commit() -> str:
    """Return the commit of the checkout, with ``-dirty`` if files were changed since; ``unknown`` without Git."""
    try:
        told = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=FOLDER, capture_output=True, text=True)
    except FileNotFoundError:
        return "unknown"
    return told.stdout.strip() or "unknown"


def commits(rows: Iterable[dict[str, Any]]) -> str:
    """Return how many rows were measured on which commit."""
    counts = collections.Counter(row.get("commit", "unknown") for row in rows)
    return ", ".join(f"{count} on {name}" for name, count in counts.items())
