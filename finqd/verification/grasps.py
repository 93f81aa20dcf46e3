"""Whole grasps: a sphere held for 10 s, and the job that three other simulators ran."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from finqd.data import designs_folder
from finqd.objects import GraspObject, load_object
from finqd.trajectory import Trajectory
from finqd.verification.cases import checked


def grasp(design: str, grasped: str | GraspObject, overrides: dict[str, Any] | None = None) -> tuple[Trajectory, bool]:
    """Return the trajectory of one grasp of a design file that comes with finqd, and whether the object was held."""
    from finqd.design import Design
    from finqd.evaluate import evaluate

    done = evaluate(Design.from_json(designs_folder() / design), objects=[grasped], overrides=overrides)
    (found,), (verdict,) = done.trajectories.values(), done.result.verdicts.values()
    return checked(found), verdict.held


def creep() -> float:
    """Return by how much [m] the sphere moves in the last 8 of 10 s in which the benchmark gripper holds it."""
    found, held = grasp("benchmark.json", "sphere", {"protocol.hold_s": 10.0})
    late = found.rigid_positions[found.times >= found.times[-1] - 8.0, 0, 2]
    return float(np.ptp(late)) if held else math.inf


def cross_check_height() -> float:
    """Return the final height [m] of the sphere's centre in the job that three other simulators ran."""
    ball = load_object({"name": "sphere50", "shape": {"kind": "sphere", "diameter_mm": 50}, "mass_g": 50})
    found, held = grasp("cross_check.json", ball)
    return float(found.rigid_positions[-1, 0, 2]) if held else 0.0
