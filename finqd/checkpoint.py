"""A simulation on its way, on disk: enough to go on with the same bits, friction and lagged matrices included.

The file is a NumPy archive (``.npz``, no pickles): the state, the histories of contact and solvers, the frames so far,
and an entry ``header`` with the rest as JSON. It names the simulation that it belongs to by a fingerprint.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.errors import InputError
from finqd.mechanics.state import State
from finqd.provenance import versions
from finqd.trajectory import DAMAGE, replacing

if TYPE_CHECKING:
    from finqd.scene import Scene

FORMAT = "finqd checkpoint"
VERSION = 3


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A simulation between two steps.

    fingerprint: of the simulation, see `fingerprint`; state: with ``previous``, if it has one
    history: of contact and solvers, name -> array, see `finqd.mechanics.system.System.history`
    rows: what has been recorded of the frames so far, name -> array; header: counters, step control, numbers
    """

    fingerprint: str
    state: State
    history: Mapping[str, np.ndarray]
    rows: Mapping[str, np.ndarray]
    header: Mapping[str, Any]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to ``path``, whole or not at all."""
        arrays = {f"state/{name}": value for name, value in _state_arrays(self.state)}
        if self.state.previous is not None:
            arrays |= {f"previous/{name}": value for name, value in _state_arrays(self.state.previous)}
        arrays |= {f"history/{name}": value for name, value in self.history.items()}
        arrays |= {f"rows/{name}": value for name, value in self.rows.items()}
        header = {"format": FORMAT, "version": VERSION, "fingerprint": self.fingerprint, **self.header}
        names = list(arrays)  # those of solvers are no file names
        header["arrays"] = names
        stored = {f"a{i}": arrays[name] for i, name in enumerate(names)}
        stored["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
        with replacing(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, **stored)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, fingerprint: str) -> Checkpoint:
        """Read a file that `save` wrote. Raises InputError if it is damaged or of another simulation."""
        where = str(path)
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
                header = json.loads(archive["header"].tobytes())
                if header.pop("format") != FORMAT or header.pop("version") != VERSION:
                    raise InputError("not a checkpoint of this version of finqd", where)
                arrays = {name: archive[f"a{i}"] for i, name in enumerate(header.pop("arrays"))}
            parts: dict[str, dict[str, np.ndarray]] = {"state": {}, "previous": {}, "history": {}, "rows": {}}
            for name, value in arrays.items():
                part, _, rest = name.partition("/")
                parts[part][rest] = value
            state = _state(parts["state"])
            if parts["previous"]:
                state = replace(state, previous=_state(parts["previous"]))
            found = header.pop("fingerprint")
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror or error}", where) from error
        except DAMAGE as error:
            raise InputError("damaged, or not a checkpoint of finqd", where) from error
        if found != fingerprint:
            raise InputError("is of another simulation: its scene, steps, plugins, libraries or source differ", where)
        return cls(fingerprint=found, state=state, history=parts["history"], rows=parts["rows"], header=header)


def _state_arrays(state: State) -> Iterator[tuple[str, np.ndarray]]:
    for entry in fields(state):
        if entry.name != "previous":
            yield entry.name, np.asarray(getattr(state, entry.name))


def _state(arrays: Mapping[str, np.ndarray]) -> State:
    values: dict[str, Any] = dict(arrays)
    return State(**{**values, **{name: float(values[name]) for name in ("time", "step")}})


def fingerprint(scene: Scene, **settings: Any) -> str:
    """Return a digest of everything that decides how ``scene`` moves under ``settings``, to the last bit.

    Versions of libraries and the state of finqd's source are among it: with others the bits would differ.
    """
    digest = hashlib.sha256()
    friction = {tuple(sorted(pair)): value for pair, value in scene.pair_friction.items()}
    ignored = sorted(tuple(sorted(pair)) for pair in scene.ignored)
    parts = (
        versions(), scene.gravity, scene.friction, friction, ignored, scene.soft_bodies, scene.rigid_bodies,
        scene.planes, settings,
    )
    for piece in _pieces(parts):
        digest.update(piece)
    return digest.hexdigest()[:32]


def _pieces(value: Any) -> Iterator[bytes]:
    """Yield the bytes of a nested value: arrays by content, dataclasses field by field, the rest by ``repr``."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif is_dataclass(value) and not isinstance(value, type):
        yield f"{type(value).__module__}.{type(value).__qualname__}".encode()
        for entry in fields(value):
            yield entry.name.encode()
            yield from _pieces(getattr(value, entry.name))
    elif isinstance(value, Mapping):
        for key in sorted(value, key=repr):
            yield repr(key).encode()
            yield from _pieces(value[key])
    elif isinstance(value, (list, tuple)):
        yield f"{len(value)} of".encode()
        for item in value:
            yield from _pieces(item)
    else:
        yield repr(value).encode()
