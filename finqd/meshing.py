"""Runs a mesher in a process of its own that can be killed.

The child is started once and reused, by every thread and for every finger of this process; it is an ordinary
subprocess, so that a worker of a process pool may have one too. What it has meshed is kept: identical fingers are
meshed once. What finqd's own meshers make is kept across runs too (`finqd.cache`); what others depend on is not known.
"""

from __future__ import annotations

import atexit
import dataclasses
import hashlib
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections import OrderedDict
from typing import Any

from finqd.cache import remembered
from finqd.contracts import Mesher
from finqd.errors import MeshError
from finqd.mesh import Mesh, mesh_arrays, mesh_of
from finqd.meshing_child import read_message, write_message
from finqd.solid import Solid

_START_LIMIT_S = 120.0  # a loaded machine may take long to import numpy; that is no fault of the solid's
_KEPT = 32  # meshes


def mesh_solid(mesher: Mesher, solid: Solid, *, time_limit_s: float = 60.0, in_process: bool = False) -> Mesh:
    """Return ``mesher.mesh(solid)``, worked out in a child process that is killed after ``time_limit_s`` [s].

    The mesher's class must be importable by name. Equal calls return the same object: do not write to its arrays.
    ``in_process``: mesh here, without a limit. Raises ``MeshError`` (one sentence) for a failure, a crash or the time
    limit, and what else of ``finqd.errors`` the mesher raises.
    """
    if in_process:
        return mesher.mesh(solid)
    payload = pickle.dumps((mesher, dataclasses.replace(solid)), protocol=pickle.HIGHEST_PROTOCOL)
    key = hashlib.sha256(payload).digest()
    with _lock:
        if key in _meshes:
            _meshes.move_to_end(key)
            return _meshes[key]
        mesh = _made(mesher, payload, time_limit_s)
        _meshes[key] = mesh
        while len(_meshes) > _KEPT:
            _meshes.popitem(last=False)
        return mesh


def close_mesher() -> None:
    """End this process's child, if there is one, and forget its meshes; the next call starts another."""
    global _child
    with _lock:
        if _child is not None:
            _child.kill()
            _child = None
        _meshes.clear()


class _Child:
    """The child process, and a thread that reads its answers."""

    def __init__(self) -> None:
        paths = [os.path.abspath(path) for path in sys.path]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
        self.owner = os.getpid()
        self.process = subprocess.Popen(
            [sys.executable, "-c", "from finqd.meshing_child import main; main()"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, start_new_session=True,
        )
        self.answers: queue.Queue[Any] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()
        self.answer(_START_LIMIT_S)

    def _read(self) -> None:
        while True:
            try:
                message = read_message(self.process.stdout)
            except (OSError, ValueError):  # closed from this side
                message = None
            self.answers.put(message)
            if message is None:
                return

    def answer(self, time_limit_s: float) -> bytes | None:
        """Return the next message, None if the child is gone; raises ``queue.Empty`` after ``time_limit_s``."""
        return self.answers.get(timeout=time_limit_s)

    def ask(self, payload: bytes) -> None:
        write_message(self.process.stdin, payload)

    def usable(self) -> bool:
        """Say whether the child lives and is this process's own (a forked copy must not talk to it)."""
        return self.owner == os.getpid() and self.process.poll() is None

    def kill(self) -> None:
        if self.owner != os.getpid():
            return
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            try:
                pipe.close()  # type: ignore[union-attr]
            except OSError:  # what was not yet written is of no use to a killed child
                continue


def _made(mesher: Mesher, payload: bytes, time_limit_s: float) -> Mesh:
    def make() -> Mesh:
        return _ask(payload, time_limit_s, type(mesher).__name__)

    if type(mesher).__module__.partition(".")[0] != __package__:
        return make()
    return remembered("mesh", [payload], make, pack=mesh_arrays, unpack=mesh_of)


def _ask(payload: bytes, time_limit_s: float, name: str) -> Mesh:
    global _child
    if _child is None or not _child.usable():
        if _child is not None:
            _child.kill()
        _child = None
        try:
            _child = _Child()
        except (OSError, queue.Empty) as error:
            raise MeshError(f"the meshing process did not start ({type(error).__name__})") from error
    child, answer = _child, None
    try:
        child.ask(payload)
        answer = child.answer(time_limit_s)
    except queue.Empty:
        raise MeshError(f"{name} did not finish within {time_limit_s:g} s and was stopped") from None
    except OSError:  # a broken pipe: the child has gone, which the lines below report
        answer = None
    finally:
        if answer is None:
            child.kill()
            _child = None
    if answer is None:
        raise MeshError(f"{name} crashed (exit code {child.process.returncode})")
    result = pickle.loads(answer)
    if isinstance(result, BaseException):
        raise result
    return result


def _after_fork() -> None:
    """A forked process starts with its own lock: another thread may have held the old one."""
    global _lock
    _lock = threading.RLock()


_lock = threading.RLock()
_child: _Child | None = None
_meshes: OrderedDict[bytes, Mesh] = OrderedDict()
atexit.register(close_mesher)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
