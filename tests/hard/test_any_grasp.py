"""Whatever the design, the object, the protocol and the material: a grasp ends with a status and sound numbers.

`benchmarks/fuzz_grasps.py` does the same a thousand times.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from finqd.design import Design, design_parameters
from finqd.evaluate import evaluate
from finqd.objects import object_names

STATUSES = {"ok", "no_room"}  # all others are faults here
PENETRATION_MM = 0.2


@st.composite
def grasps(draw: st.DrawFn) -> tuple[list[float], str, dict[str, object]]:
    """Return a point of the design space, an object and overrides of everything else."""

    def value(low: float, high: float) -> float:
        return draw(st.floats(low, high))

    unit = [value(0.0, 1.0) for _ in design_parameters()]
    overrides = {
        "protocol.friction_coefficient": value(0.0, 2.0), "protocol.gravity_m_s2": value(0.0, 30.0),
        "protocol.close_s": value(0.1, 0.4), "protocol.squeeze_s": value(0.0, 0.1), "protocol.lift_s": value(0.05, 0.2),
        "protocol.hold_s": value(0.0, 0.1), "protocol.lift_mm": value(0.0, 50.0),
        "protocol.tip_clearance_mm": value(0.0, 20.0), "protocol.time_step_ms": value(10.0, 50.0),
        "material.youngs_modulus_MPa": 10.0 ** value(-0.5, 2.5), "material.poisson_ratio": value(0.0, 0.4999),
        "actuation.angle_deg": value(0.0, 45.0), "actuation.force_limit_N": 10.0 ** value(-1.0, 3.0),
        "elasticity.name": draw(st.sampled_from(["corotated", "neo_hookean"])),
    }
    return unit, draw(st.sampled_from(sorted(object_names()))), overrides


def check(unit: list[float], name: str, overrides: dict[str, object]) -> None:
    """Run a grasp, and look at what it says."""
    design = Design.from_unit_vector(unit)
    result = evaluate(design, objects=[name], preset="draft", overrides=overrides).to_dict()
    json.dumps(result, allow_nan=False)
    row = result["objects"][name]
    assert row["status"] in STATUSES, row["reason"]
    assert bool(row["reason"]) == (row["status"] != "ok")
    if row["status"] == "ok":
        numbers = [row[key] for key in ("drop_mm", "final_height_mm", "max_contact_force_N", "max_penetration_mm")]
        assert np.isfinite([*numbers, *row["final_contact_force_N"]]).all()
        assert row["max_penetration_mm"] <= PENETRATION_MM
        assert row["held"] == (row["drop_mm"] < 10.0)


SETTINGS = {"deadline": None, "derandomize": True, "suppress_health_check": list(HealthCheck), "print_blob": False}


@settings(max_examples=4, **SETTINGS)
@given(grasps())
def test_a_few_grasps(given_grasp):
    check(*given_grasp)


@pytest.mark.slow
@settings(max_examples=100, **SETTINGS)
@given(grasps())
def test_many_grasps(given_grasp):
    check(*given_grasp)
