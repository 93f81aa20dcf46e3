"""Keeps what takes long to make, and follows from its input alone, on disk by content: meshes, surfaces, fields, poses.

A key is a digest of the input and of all else that decides the bits: finqd's own sources, libraries, the processor. So
a hit is what would have been made, to the last bit, and after an update nothing is found. Files are NumPy's ``.npz``,
each whole or not there; one that is damaged is made again. They are in the user's cache folder, or where
``FINQD_CACHE_DIR`` says; that variable, set to nothing, switches the cache off. The least recently used go where there
is more than `LIMIT`.

>>> import tempfile
>>> os.environ["FINQD_CACHE_DIR"], before = tempfile.mkdtemp(), os.environ.get("FINQD_CACHE_DIR")
>>> def squares():
...     print("working")
...     return np.arange(3.0) ** 2
>>> plain = {"pack": lambda made: {"made": made}, "unpack": lambda arrays: arrays["made"]}
>>> remembered("squares", (3,), squares, **plain)
working
array([0., 1., 4.])
>>> remembered("squares", (3,), squares, **plain)
array([0., 1., 4.])
>>> os.environ["FINQD_CACHE_DIR"] = before or ""
"""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np

from finqd.provenance import installed, versions

LIMIT = 1_000_000_000  # [bytes] of all files together
LOOK_EVERY = LIMIT // 20  # bytes that a process writes before it looks again how much there is
ABANDONED_S = 3600.0  # an unfinished file as old as that belongs to a process that was killed
CONTENTS = "contents"  # the names of a file's arrays, as the last of them
PACKAGE = Path(__file__).resolve().parent

Made = TypeVar("Made")
Part = bytes | str | int | float | np.ndarray


def remembered(
    kind: str, parts: Sequence[Part], make: Callable[[], Made], *,
    pack: Callable[[Made], Mapping[str, np.ndarray]], unpack: Callable[[Mapping[str, np.ndarray]], Made],
) -> Made:
    """Return ``make()``, or what it returned the last time with the same ``parts``, in whatever process that was.

    kind: of what is made: equal parts of two kinds are two things; parts: all that ``make`` depends on but for finqd's
    sources and libraries; pack, unpack: to named arrays, and back. Arrays keep their bits, types and memory order.
    """
    folder = cache_folder()
    if folder is None:
        return make()
    path = folder / f"{_key(kind, parts)}.npz"
    with suppress(Exception):  # not there, cut short, damaged, somebody else's: whatever it is, it is made again
        return unpack(_read(path))
    made = make()
    _keep(path, pack(made))
    return made


def cache_folder() -> Path | None:
    """Return the folder of the files, which need not be there yet; None if the cache is switched off."""
    chosen = os.environ.get("FINQD_CACHE_DIR")
    if chosen == "":
        return None
    users = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    place = users / "finqd" if chosen is None else Path(os.path.expanduser(chosen))
    return place / "made" if chosen is not None or place.is_absolute() else None  # no home: "~" would be made here


def usable(folder: Path) -> bool:
    """Return whether files can be written to ``folder``, which is made if need be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _key(kind: str, parts: Sequence[Part]) -> str:
    digest = hashlib.sha256()
    for part in (kind, _circumstances(), *parts):
        if isinstance(part, np.ndarray):
            head, body = f"{part.dtype.str} {part.shape}", np.ascontiguousarray(part).reshape(-1).view(np.uint8).data
        else:
            head, body = type(part).__name__, memoryview(part if isinstance(part, bytes) else repr(part).encode())
        digest.update(f"{head} {len(body)};".encode())  # so that no two lists of parts run together into one
        digest.update(body)
    return digest.hexdigest()


@cache
def _circumstances() -> str:
    """Return what decides the bits of a result beside its input: sources, libraries, processor."""
    from llvmlite.binding import get_host_cpu_name

    libraries = {**versions(), **installed(("shapely", "trimesh"))}
    machine = (platform.python_version(), platform.machine(), *platform.libc_ver(), get_host_cpu_name())
    return repr((sorted(libraries.items()), machine))


def _read(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a file, checksums compared, and note its use; raises what is wrong with it."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as members:
        arrays = {name: members[name] for name in members.files}
    if list(arrays) != [*arrays[CONTENTS], CONTENTS]:  # a damaged directory of an archive may hide members
        raise ValueError(f"{path} is not whole")
    del arrays[CONTENTS]
    with suppress(OSError):  # a cache that is only read serves as well
        os.utime(path)
    return arrays


def _keep(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a file, whole or not at all; where that fails, say so once and write no more."""
    folder = path.parent
    if folder in _refusing or sum(array.nbytes for array in arrays.values()) > LIMIT or _sources_changed():
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=folder, prefix=".", suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, **arrays, **{CONTENTS: np.array(list(arrays), dtype=str)})  # type: ignore[arg-type]
                size = file.tell()
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as error:
        _refusing.add(folder)
        what = f"nothing is kept in {folder} ({error.strerror or error}): it is made again in each run"
        warnings.warn(f"{what}; FINQD_CACHE_DIR names another folder", RuntimeWarning, stacklevel=3)
        return
    _make_room(folder, size)


def _sources_changed() -> bool:
    """Return whether finqd was edited or updated under this process, so that nobody can say what it is running."""
    return any(path.stat().st_mtime > _BEGUN for path in PACKAGE.rglob("*.py"))


def _make_room(folder: Path, written: int) -> None:
    """Delete the least recently used files of a folder beyond `LIMIT`, and what killed processes left there."""
    if _unseen.get(folder, LOOK_EVERY) + written < LOOK_EVERY:
        _unseen[folder] += written
        return
    _unseen[folder] = 0
    files, total = [], 0
    for path in folder.iterdir():
        with suppress(OSError):  # another process was quicker
            state = path.stat()
            if path.suffix == ".part" and state.st_mtime < time.time() - ABANDONED_S:
                path.unlink()
            elif path.suffix == ".npz":
                files.append((state.st_mtime, state.st_size, path))
                total += state.st_size
    for _, size, path in sorted(files):
        if total <= LIMIT:
            break
        with suppress(OSError):
            path.unlink()
            total -= size


_BEGUN = time.time()
_refusing: set[Path] = set()
_unseen: dict[Path, int] = {}  # bytes written to a folder since it was last looked at
