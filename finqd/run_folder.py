"""The folder of a run: who may write to it, and files that are whole or not there."""

from __future__ import annotations

import math
import os
import socket
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from finqd.errors import InputError

FILE, LOCK, PROGRESS = "run.sqlite", "run.lock", "progress.log"


def locked(folder: Path) -> IO[str]:
    """Return the run's lock file, locked until it is closed or this process ends. Raises ``InputError``."""
    path = folder / LOCK
    try:
        file = open(path, "a+", encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot write to this folder ({error.strerror or error})", str(folder)) from error
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        owner = file.read(200).strip() or "another process"
        file.close()
        raise InputError(f"is being written to by {owner}; wait for it, or stop it", str(folder)) from None
    except (ImportError, OSError):  # Windows, a file system without locks: whoever starts two drivers is not stopped
        pass
    with suppress(OSError):  # who holds it is for the sentence above only
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
    return file


def plain(value: Any) -> Any:
    """Return ``value`` as JSON knows it: numpy arrays and numbers, mappings and tuples made plain, non-finite null."""
    if value is None or isinstance(value, (str, bool, int)):  # most of a record is
        return value
    if isinstance(value, float) and not isinstance(value, np.generic):
        return value if math.isfinite(value) else None
    if isinstance(value, (dict, Mapping)):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    raise TypeError(f"a log holds plain values, not {type(value).__name__}")


def write_whole(path: Path, text: str) -> None:
    """Write a file so that whoever reads it, even after a cut, finds either the old text or all of the new one."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.chmod(temporary, 0o644)  # mkstemp makes private files
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)
        raise


def new_run_folder(path: Path) -> Path:
    """Return ``path`` as a folder that can be written to, with nothing in it but what a start that was cut short left.

    Raises ``InputError`` if it cannot be that.
    """
    leavings = {FILE, f"{FILE}-wal", f"{FILE}-shm", LOCK, PROGRESS}
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            occupied = any(one.name not in leavings for one in path.iterdir())
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot write to this folder ({reason})", where=str(path)) from error
    if occupied:
        raise InputError("is not empty, and holds no run to go on with; name a new folder", where=str(path))
    return path
