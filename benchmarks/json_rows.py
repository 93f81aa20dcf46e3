"""The logs of studies: a JSON object a line, written as it comes, so that a study once stopped goes on from there."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def read_rows(log: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of a log, none if there is no such file; a line that a kill cut short is left out."""
    for number, text in enumerate(log.read_text().splitlines() if log.exists() else [], start=1):
        try:
            row = json.loads(text)
        except json.JSONDecodeError:
            print(f"{log.name}, line {number}: damaged, left out", file=sys.stderr)
            continue
        yield row


def add_row(log: Path, row: dict[str, Any]) -> None:
    """Append a row; a line that a kill cut short does not swallow it."""
    with log.open("a+b") as file:
        whole = file.tell() == 0
        if not whole:
            file.seek(-1, 2)
            whole = file.read(1) == b"\n"
        file.write(b"" if whole else b"\n")
        file.write(json.dumps(row).encode() + b"\n")
