"""What runs in the meshing process: reads (mesher, solid) from its input, writes the mesh, or what was raised.

A message is eight bytes of length, then that many bytes of pickle.
"""

from __future__ import annotations

import os
import pickle
import sys
import threading
import time
from typing import IO, Any


def read_message(stream: IO[bytes] | None) -> bytes | None:
    """Return the next message, or None at the end of the stream."""
    assert stream is not None
    head = stream.read(8)
    if len(head) < 8:
        return None
    body = stream.read(int.from_bytes(head, "little"))
    return body if len(body) == int.from_bytes(head, "little") else None


def write_message(stream: IO[bytes] | None, body: bytes) -> None:
    """Write one message."""
    assert stream is not None
    stream.write(len(body).to_bytes(8, "little") + body)
    stream.flush()


def main() -> None:
    """Serve until the input ends. What a mesher prints goes to the standard error, away from the answers."""
    _die_with_parent()
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    write_message(answers, b"ready")
    while True:
        request = read_message(sys.stdin.buffer)
        if request is None:
            return
        write_message(answers, pickle.dumps(_result(request), protocol=pickle.HIGHEST_PROTOCOL))


def _result(request: bytes) -> Any:
    """Return the mesh, with its boundary faces worked out, or a ``FinqdError``."""
    from finqd.errors import FinqdError, MeshError

    try:
        mesher, solid = pickle.loads(request)
        mesh = mesher.mesh(solid)
        _ = mesh.faces
    except FinqdError as error:
        return error
    except Exception as error:  # a plugin may raise anything
        return MeshError(f"the mesher failed ({type(error).__name__}: {' '.join(str(error).split())})")
    return mesh


def _die_with_parent() -> None:
    """End this process when its parent has gone, even in the middle of a mesh that never ends."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()
