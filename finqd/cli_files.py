"""Files that a command writes: refused before the work starts, complete or not there at all when it ends."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from finqd.errors import InputError


@contextmanager
def written_at_end(path: Path | None, option: str) -> Iterator[Callable[[str], None]]:
    """Return a function that writes a text to ``path`` in one go; the target is tried out first.

    The text goes to a temporary file in the same folder, which then takes the name: nobody ever sees half a result, and
    an older one survives whatever happens before. With ``path`` None the function does nothing. ``option``: what
    the user typed, put in front of the sentence. Raises ``InputError`` if nothing can be written there.
    """
    if path is None:
        yield lambda text: None
    elif path.exists() and not path.is_file() and not path.is_dir():  # /dev/stdout, a pipe: nothing to rename
        with path.open("w", encoding="utf-8") as file:
            yield lambda text: print(text, end="", file=file)
    else:
        temporary = _temporary_beside(path, option)
        try:
            yield lambda text: _replace(path, temporary, text, option)
        finally:
            temporary.unlink(missing_ok=True)


def usable_folder(path: Path | None, option: str) -> Path | None:
    """Return ``path`` as a folder that exists and can be written to. Raises ``InputError`` otherwise."""
    if path is None:
        return None
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return path
    except (OSError, ValueError) as error:
        raise InputError(f"cannot write to the folder {str(path)!r} ({_reason(error)})", option) from error


def _temporary_beside(path: Path, option: str) -> Path:
    if path.is_dir():
        raise InputError(f"{str(path)!r} is a folder, not a file", option)
    try:
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError("the file is read-only")
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name[:100]}.", suffix=".part")
    except (OSError, ValueError) as error:
        raise InputError(f"cannot write to {str(path)!r} ({_reason(error)})", option) from error
    os.close(handle)
    return Path(name)


def _replace(path: Path, temporary: Path, text: str, option: str) -> None:
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o666 & ~_umask())  # mkstemp makes private files
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"cannot write to {str(path)!r} ({_reason(error)})", option) from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
