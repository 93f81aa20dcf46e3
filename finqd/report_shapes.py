"""The shapes on the page of a search: grippers as triangles, packed into as few bytes as a look needs.

A shape is base64 of: vertices, three little-endian int16 each, in steps of ``step_mm``; then triangles, three uint16
each. Beside it stand how many of each there are and which triangles belong to which part.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from finqd.errors import FinqdError
from finqd.export import gripper_parts
from finqd.units import MM

MAX_SHAPES = 300  # each takes 20 to 30 ms to build
BUDGET = 12_000_000  # [bytes] of all shapes together, as they stand on the page
STEP_MM = 0.01  # of coordinates; coarser for what is larger than 655 mm
_INT16, _UINT16 = 32767, 65535


def shapes_of(
    designs: Iterable[tuple[int, Callable[[], Any]]], *, limit: int = MAX_SHAPES, budget: int = BUDGET
) -> dict[str, Any]:
    """Return the shapes of designs: ``{"shapes": {index: shape}, "missing": {index: why}}``.

    designs: index and a function that makes the design, the most wanted first; limit: shapes at most; budget: bytes of
    all together. A shape that there is no room for, or that cannot be built, is missing with the reason.
    """
    shapes: dict[str, Any] = {}
    missing: dict[str, str] = {}
    used = 0
    for index, make in designs:
        if len(shapes) >= limit:
            missing[str(index)] = f"the page holds the shapes of the best {limit} designs only (--shapes)"
            continue
        try:
            shape = packed(gripper_parts(make()))
        except FinqdError as error:
            missing[str(index)] = f"the shape could not be built: {error}"
            continue
        if shape is None:
            missing[str(index)] = f"the shape has more than {_UINT16} corners"
        elif used + len(shape["data"]) > budget:
            missing[str(index)] = f"better designs' shapes fill the {budget / 1e6:.3g} MB that the page has for them"
        else:
            shapes[str(index)] = shape
            used += len(shape["data"])
    return {"shapes": shapes, "missing": missing}


def packed(parts: Iterable[tuple[str, np.ndarray, np.ndarray]]) -> dict[str, Any] | None:
    """Return parts, each a name, vertices (n, 3) [m] and triangles (m, 3), as one shape; None if it is too large."""
    names, vertices, triangles, start = [], [], [], 0
    for name, points, corners in parts:
        names.append([name, len(corners)])
        vertices.append(np.asarray(points) / MM)
        triangles.append(np.asarray(corners) + start)
        start += len(points)
    points, corners = np.concatenate(vertices), np.concatenate(triangles)
    if len(points) > _UINT16:
        return None
    step = max(STEP_MM, float(np.abs(points).max()) / _INT16)
    data = np.round(points / step).astype("<i2").tobytes() + corners.astype("<u2").tobytes()
    return {"step_mm": step, "vertices": len(points), "triangles": len(corners), "parts": names,
            "data": base64.b64encode(data).decode()}  # fmt: skip


def unpacked(shape: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) [mm] and triangles (m, 3) of a shape, as the page's script reads them."""
    data = base64.b64decode(shape["data"])
    split = 6 * shape["vertices"]
    points = np.frombuffer(data[:split], dtype="<i2").reshape(-1, 3) * shape["step_mm"]
    return points, np.frombuffer(data[split:], dtype="<u2").reshape(-1, 3).astype(np.int64)
