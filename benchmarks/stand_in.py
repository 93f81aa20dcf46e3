"""A stand-in for the evaluation of a gripper, for benchmarks of the search alone: no geometry, no simulation.

It has of a gripper what a search meets: 28 parameters with whole numbers among them, features that follow from the
parameters alone, ten objects with verdicts and margins, a ridge along which good designs of different features lie, and
verdicts that `draft` sees differently once in a while. It has none of a gripper's mechanics, and is smooth where those
jump: what it says of algorithms holds for problems like it.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from finqd.design import Design

NAMES = ("cube", "cylinder", "diablo", "diamond", "disk", "flan", "hourglass", "pasta", "sphere", "triangle")
RANGES = {"workspace_mm2": (1169.0, 2079.0), "volume_mm3": (35.9e3, 93.6e3)}
FLIPS = 0.03  # share of verdicts of `draft` that differ


@dataclass(frozen=True)
class StandIn:
    """What an evaluation returns."""

    fitness: float
    margin: float
    features: dict[str, float]
    objects: dict[str, dict[str, Any]]

    def to_dict(self) -> dict[str, Any]:
        """Return what a search keeps."""
        return {"objects": self.objects, "accuracy": {"sentence": "a stand-in"}}


def evaluate(design: Design, *, objects: Any, preset: str, jobs: int, progress: Any) -> StandIn:
    """Return the score of a design: each object asks for its own compromise of stiffness, and all for light tips."""
    unit = design.to_unit_vector()
    fingers = unit[:27].reshape(3, 9)
    stiffness, spread, spacing = fingers[:, [4, 5, 7]].mean(), float(np.std(fingers.mean(axis=1))), float(unit[27])
    bits = np.random.default_rng(int(hashlib.sha256(design.digest().encode()).hexdigest()[:12], 16)).random(len(NAMES))
    rows = {}
    for k, name in enumerate(NAMES):
        wanted = 0.25 + 0.06 * k
        miss = (stiffness - wanted) ** 2 + 0.5 * (spacing - 0.3 - 0.05 * k) ** 2 + 2.0 * spread**2
        miss += 0.15 * float(np.mean((fingers[:, [0, 1, 2, 3, 6, 8]] - 0.6) ** 2))
        margin = math.tanh(6.0 * (0.09 - miss) / 0.09)
        if preset == "draft" and bits[k] < FLIPS:
            margin = -margin
        row = {"held": margin > 0.0, "margin": margin, "drop_mm": 10.0 - 9.0 * margin}
        rows[name] = {"status": "ok", "reason": "", **row}
    held = sum(row["held"] for row in rows.values()) / len(rows)
    features = {
        "workspace_mm2": 1e6 * design.workspace,
        "volume_mm3": 35.9e3 + 57.7e3 * float(0.7 * stiffness + 0.3 * fingers[:, 0].mean()),
    }
    return StandIn(held, float(np.mean([row["margin"] for row in rows.values()])), features, rows)
