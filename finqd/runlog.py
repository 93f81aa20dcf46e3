"""The append-only record of a search: one JSON object a line, on disk before the next one is written.

>>> import tempfile
>>> folder = Path(tempfile.mkdtemp())
>>> with RunLog(folder / "evaluations.jsonl") as log:
...     log.append({"index": 0, "fitness": 0.9, "margin": float("nan")})
>>> read_log(folder / "evaluations.jsonl")
[{'index': 0, 'fitness': 0.9, 'margin': None}]
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from finqd.errors import InputError


class RunLog:
    """A file of JSON lines that only grows; each line is flushed and synchronised to the disk as it is appended."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("x", encoding="utf-8")

    def append(self, record: Mapping[str, Any]) -> None:
        """Write one record; numbers that JSON does not know (NaN, infinity) become null."""
        self._file.write(json.dumps(plain(record), allow_nan=False) + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_log(path: Path) -> list[dict[str, Any]]:
    """Return the records in the order in which they were written, without a last line that a cut left unfinished."""
    lines = path.read_text(encoding="utf-8").split("\n")
    return [json.loads(line) for line in lines[:-1]]


def plain(value: Any) -> Any:
    """Return ``value`` as JSON knows it: numpy arrays and numbers, mappings and tuples made plain, non-finite null."""
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    raise TypeError(f"a log holds plain values, not {type(value).__name__}")


def write_whole(path: Path, text: str) -> None:
    """Write a file so that whoever reads it, even after a cut, finds either the old text or all of the new one."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(text)
    os.chmod(temporary, 0o644)  # mkstemp makes private files
    os.replace(temporary, path)


def new_run_folder(path: Path) -> Path:
    """Return ``path`` as an empty folder that can be written to. Raises ``InputError`` if it cannot be that."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            occupied = any(path.iterdir())
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot write to this folder ({reason})", where=str(path)) from error
    if occupied:
        raise InputError("is not empty, and a search cannot be resumed yet; name a new folder", where=str(path))
    return path
