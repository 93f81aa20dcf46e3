"""Fingers from the corners of the design space: nothing in it may break a grasp."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.design import Design, design_parameters
from finqd.errors import InputError
from finqd.evaluate import evaluate

from .grippers import THINGS, design, gripper
from .sound import sound

FINGERS = {
    "ten thick ribs that lean": {"rib_count": 10, "rib_thickness_mm": 3.0, "rib_angle_deg": 40.0},
    "walls of 1 mm": {"contact_wall_mm": 1.0, "back_wall_mm": 1.0, "rib_thickness_mm": 1.0},
    "one rib": {"rib_count": 1},
}
STEPS_MS = [50, *(pytest.param(step, marks=pytest.mark.slow) for step in (1, 2, 5, 10, 20))]
PENETRATION_MM = 0.2


@pytest.mark.parametrize("contact", ["penalty", pytest.param("ipc", marks=pytest.mark.slow)])
@pytest.mark.parametrize("step", STEPS_MS)
@pytest.mark.parametrize("finger", FINGERS)
def test_fingers_that_hardly_bend_and_that_hardly_resist(finger, step, contact):
    scene = gripper(THINGS["sphere"], given=design(**FINGERS[finger]))
    found, _ = sound(scene, duration=1.1, time_step_ms=step, contact=contact, driven=True)
    assert found.contact_forces[-1].min() > 0.1


def corner(number: int) -> Design:
    """Return the design at a random corner of the search space, or the nearest to it whose walls leave room."""
    unit = np.random.default_rng([28, number]).integers(0, 2, len(design_parameters())).astype(float)
    for share in np.linspace(0.0, 0.5, 6):
        try:
            return Design.from_unit_vector(np.clip(unit, share, 1.0 - share))
        except InputError:
            continue  # its values contradict each other
    raise AssertionError(f"nothing can be built near corner {number}")


CORNERS = [2, *(pytest.param(n, marks=pytest.mark.slow) for n in range(200) if n != 2)]


@pytest.mark.parametrize("number", CORNERS)
def test_corners_of_the_design_space(number):
    check_corner(number, "penalty")


@pytest.mark.slow
@pytest.mark.parametrize("number", range(0, 200, 9))  # with each of the four objects; `ipc` takes several times as long
def test_corners_of_the_design_space_with_ipc(number):
    check_corner(number, "ipc")


def check_corner(number: int, contact: str) -> None:
    """Run the grasp of a corner's gripper."""
    name = ("cube", "sphere", "triangle", "cylinder")[number % 4]
    result = evaluate(corner(number), objects=[name], preset="draft", overrides={"contact.name": contact}).to_dict()
    row = result["objects"][name]
    assert row["status"] in ("ok", "no_room"), row["reason"]
    if row["status"] == "ok":
        assert np.isfinite([row["drop_mm"], *row["final_contact_force_N"]]).all()
        assert row["max_penetration_mm"] <= PENETRATION_MM
