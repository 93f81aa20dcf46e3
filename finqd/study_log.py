"""The log of a study: one JSON line a row, on disk before the next one is computed; it can be taken up again.

>>> import tempfile
>>> path = Path(tempfile.mkdtemp()) / "study.jsonl"
>>> append_row(path, {"rung": "draft", "seconds": 1.5})
>>> _ = path.write_text(path.read_text() + '{"rung": "fi')  # cut in the middle of a line
>>> [row["rung"] for row in read_rows(path)]
['draft']
>>> append_row(path, {"rung": "fine"})
>>> [row["rung"] for row in read_rows(path)]
['draft', 'fine']
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from finqd.errors import InputError
from finqd.runlog import plain


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a log, oldest first; an unfinished last line is left out, no file is no rows.

    Raises ``InputError`` if another line is no row.
    """
    try:
        lines = path.read_bytes().split(b"\n")[:-1]
    except FileNotFoundError:
        return []
    rows = []
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line)
        except ValueError:
            row = None
        if isinstance(row, dict):
            rows.append(row)
        elif any(rest.strip() for rest in lines[number:]) or line.strip():
            raise InputError(f"line {number} is no row of a study; move the file away", str(path))
    return rows


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Write one row behind the last whole line, and wait until it is on the disk; make the folder if there is none."""
    text = json.dumps(plain(row), allow_nan=False) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as file:
        file.truncate(_whole(file))
        file.write(text.encode())
        file.flush()
        os.fsync(file.fileno())


def _whole(file: Any) -> int:
    """Return where the last whole line ends."""
    file.seek(0)
    return file.read().rfind(b"\n") + 1
