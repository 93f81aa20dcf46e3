"""The benchmark grasp at steps of 1 to 50 ms: one verdict, one height."""

from __future__ import annotations

from functools import cache

import pytest

from finqd.evaluate import evaluate

from .grippers import design

FINE = 20  # step that all others are compared with [ms]
HEIGHT_MM = 1.0


@cache
def grasp(step: float, contact: str):
    overrides = {"protocol.time_step_ms": step, "contact.name": contact}
    return evaluate(design(), objects=["sphere"], preset="draft", overrides=overrides).to_dict()["objects"]["sphere"]


@pytest.mark.parametrize("contact", ["penalty", pytest.param("ipc", marks=pytest.mark.slow)])
@pytest.mark.parametrize("step", [50, *(pytest.param(step, marks=pytest.mark.slow) for step in (1, 2, 5, 10))])
def test_the_verdict_does_not_depend_on_the_step(step, contact):
    row, other = grasp(step, contact), grasp(FINE, contact)
    assert row["status"] == other["status"] == "ok", row["reason"] or other["reason"]
    assert row["held"] == other["held"]
    assert abs(row["final_height_mm"] - other["final_height_mm"]) < HEIGHT_MM
    assert row["max_penetration_mm"] <= 0.2
