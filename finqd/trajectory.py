"""Trajectory: what a simulation leaves behind, and its file format.

The file is a NumPy archive (``.npz``, no pickles): one entry an array, and an entry ``header`` with the rest as JSON.

>>> import tempfile
>>> from pathlib import Path
>>> flight = Trajectory(status="ok", times=np.array([0.0, 0.1]), counters={"steps": 1})
>>> with tempfile.TemporaryDirectory() as folder:
...     flight.save(Path(folder) / "flight.npz")
...     Trajectory.load(Path(folder) / "flight.npz").counters
{'steps': 1}
"""

from __future__ import annotations

import json
import math
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from finqd.errors import InputError
from finqd.protocol import GraspProtocol

FORMAT = "finqd trajectory"
VERSION = 3

#: a rigid body's surface in its body frame: vertices [m], (n, 3), and triangles (m, 3), outward
Surface = tuple[np.ndarray, np.ndarray]

#: what NumPy, zipfile and json raise for bytes that are not what they should be
DAMAGE = (
    OSError, EOFError, ValueError, KeyError, AttributeError, TypeError, RuntimeError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


def _empty(*shape: int) -> Any:
    return field(default_factory=lambda: np.zeros(shape))


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """What happened in a simulation: one row a frame, from the start on. SI units.

    status: "ok", or why there is no full result ("diverged", "timeout", "mesh_failed", ...); reason: one sentence then
    ended: why the simulation was ended early, as all that it was to tell was known; nothing if it was not
    times [s], (n_frames,), not evenly spaced where steps span several frames
    rigid_positions: centres of mass [m], (n_frames, n_rigid, 3); rigid_rotations: (n_frames, n_rigid, 3, 3)
    soft_centres: centres of mass of the soft bodies [m], (n_frames, n_soft, 3)
    contact_forces: sum of the normal forces on each soft body [N], (n_frames, n_soft)
    penetrations: largest since the frame before [m], (n_frames,)
    stroke: share of its time that each drive has run, (n_frames, n_motions)
    energies: name -> [J], (n_frames,); kinetic and elastic are those of the soft bodies
    soft_positions: [m], (n_recorded, n_vertices, 3), at recorded_times [s], (n_recorded,): empty without recording
    counters: steps, rejected_steps, newton_iterations, line_search_steps, factorisations, cg_iterations, ...
    object_drop: how far the object fell relative to the gripper [m], NaN if unknown
    protocol: constants of the grasp, None for other scenes; timings: name -> seconds, or what `finqd.profiling`
        left there
    effects: of a grasp, name -> since when and why (`finqd.effects.effects_seen`); of other scenes "met", pairs of
        bodies and when they first came within reach of each other [s]
    """

    status: str
    reason: str = ""
    ended: str = ""
    object_name: str = ""
    object_drop: float = math.nan
    times: np.ndarray = _empty(0)
    rigid_positions: np.ndarray = _empty(0, 0, 3)
    rigid_rotations: np.ndarray = _empty(0, 0, 3, 3)
    soft_centres: np.ndarray = _empty(0, 0, 3)
    contact_forces: np.ndarray = _empty(0, 0)
    penetrations: np.ndarray = _empty(0)
    stroke: np.ndarray = _empty(0, 0)
    energies: Mapping[str, np.ndarray] = field(default_factory=dict)
    recorded_times: np.ndarray = _empty(0)
    soft_positions: np.ndarray = _empty(0, 0, 3)
    counters: Mapping[str, int] = field(default_factory=dict)
    timings: Mapping[str, float] = field(default_factory=dict)
    effects: Mapping[str, Any] = field(default_factory=dict)
    protocol: GraspProtocol | None = None

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.times)

    def frame_at(self, time: float) -> int:
        """Return the index of the frame nearest to ``time`` [s]."""
        return int(np.argmin(np.abs(self.times - time)))

    def recorded_at(self, time: float) -> int:
        """Return the index into ``soft_positions`` nearest to ``time`` [s]. Raises InputError without recording."""
        if not len(self.recorded_times):
            raise InputError("the trajectory holds no recorded positions; simulate with record=True")
        return int(np.argmin(np.abs(self.recorded_times - time)))

    def placed(self, surfaces: Sequence[Surface], time: float) -> list[np.ndarray]:
        """Return the vertices [m] of the rigid bodies' ``surfaces`` (body frame) at the frame nearest to ``time``."""
        frame = self.frame_at(time)
        poses = zip(self.rigid_positions[frame], self.rigid_rotations[frame])
        return [vertices @ rotation.T + position for (vertices, _), (position, rotation) in zip(surfaces, poses)]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to ``path``, whole or not at all."""
        header: dict[str, Any] = {"format": FORMAT, "version": VERSION}
        arrays: dict[str, np.ndarray] = {}
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, np.ndarray):
                arrays[entry.name] = value
            elif entry.name == "energies":
                arrays.update({f"energies/{name}": row for name, row in value.items()})
            elif entry.name == "protocol":
                header["protocol"] = None if value is None else value.as_dict()
            else:
                header[entry.name] = dict(value) if isinstance(value, Mapping) else value
        text = json.dumps(header, default=_plain)
        arrays["header"] = np.frombuffer(text.encode(), dtype=np.uint8)
        with replacing(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trajectory:
        """Read a file that `save` wrote. Raises InputError if it is missing, damaged or something else."""
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            header = json.loads(arrays.pop("header").tobytes())
            if header.pop("format") != FORMAT:
                raise InputError("not a finqd trajectory", str(path))
            version = header.pop("version")
        except (FileNotFoundError, IsADirectoryError, PermissionError) as error:
            raise InputError(f"cannot be read: {error.strerror}", str(path)) from error
        except DAMAGE as error:
            raise InputError("damaged, or not a finqd trajectory", str(path)) from error
        if version != VERSION:
            raise InputError(f"format version {version}; this finqd reads version {VERSION}", str(path))
        return cls._from_parts(header, arrays, str(path))

    @classmethod
    def _from_parts(cls, header: dict[str, Any], arrays: dict[str, np.ndarray], where: str) -> Trajectory:
        prefix = "energies/"
        energies = {name.removeprefix(prefix): arrays.pop(name) for name in list(arrays) if name.startswith(prefix)}
        known = {entry.name for entry in fields(cls)}
        if {*header, *arrays} | {"energies"} != known:
            raise InputError("damaged, or written by another version of finqd", where)
        try:
            constants = header.pop("protocol")
            protocol = None if constants is None else GraspProtocol(**constants)
        except TypeError as error:
            raise InputError("damaged, or written by another version of finqd", where) from error
        values: dict[str, Any] = {**header, **arrays}
        return cls(**values, energies=energies, protocol=protocol)


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a file name beside ``path``, with its suffix; the file takes the name ``path`` if nothing was raised."""
    path = Path(path)
    temporary = path.with_name(f".{path.stem[:100]}.{os.getpid()}.part{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _plain(value: Any) -> Any:
    """Return a NumPy scalar or array as JSON knows it."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"a trajectory cannot hold a {type(value).__name__}")
