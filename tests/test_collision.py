"""Overlap and distance of surfaces, against cases with a known answer."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.collision import distance, may_touch_pairs, overlaps
from finqd.objects import load_object


def pose(x=0.0, y=0.0, z=0.0, *, about_z_deg=0.0):
    matrix = np.eye(4)
    c, s = np.cos(np.deg2rad(about_z_deg)), np.sin(np.deg2rad(about_z_deg))
    matrix[:2, :2] = [[c, -s], [s, c]]
    matrix[:3, 3] = x, y, z
    return matrix


def box(size_mm, where):
    item = load_object({"shape": {"kind": "box", "size_mm": list(size_mm)}, "mass_g": 10})
    return item.vertices, item.triangles, where


def test_distance_of_boxes_by_face_edge_and_corner():
    still = box((20, 20, 20), pose())
    assert distance(still, box((20, 20, 20), pose(x=0.025))) == pytest.approx(0.005, abs=1e-12)
    assert distance(still, box((20, 20, 20), pose(0.023, 0.024))) == pytest.approx(0.005, abs=1e-9)
    assert distance(still, box((20, 20, 20), pose(0.022, 0.023, 0.026))) == pytest.approx(0.007, abs=1e-9)


def test_distance_counts_the_pose_once():
    still = box((20, 20, 20), pose(0.1, 0.2, -0.3))
    turned = box((20, 20, 20), pose(0.13, 0.2, -0.3, about_z_deg=45))
    assert distance(still, turned) == pytest.approx(0.02 - 0.01 * np.sqrt(2), abs=1e-9)
    assert distance(turned, still) == pytest.approx(0.02 - 0.01 * np.sqrt(2), abs=1e-9)


@pytest.mark.parametrize(("offset", "expected"), [(0.0199, True), (0.0201, False)])
def test_overlap_turns_at_contact(offset, expected):
    a, b = box((20, 20, 20), pose()), box((20, 20, 20), pose(offset))
    assert overlaps(a, b) is expected
    assert (distance(a, b) == 0.0) is expected


def test_a_body_inside_another_overlaps_it_although_no_triangles_meet():
    outer, inner = box((40, 40, 40), pose()), box((5, 5, 5), pose(0.01))
    assert overlaps(outer, inner)
    assert overlaps(inner, outer)
    assert may_touch_pairs([outer, inner], 0.0) == [(0, 1)]


def test_a_body_in_the_bore_of_a_tube_does_not_overlap_it():
    tube = load_object("pasta")
    assert distance((tube.vertices, tube.triangles, pose()), box((5, 5, 5), pose())) == pytest.approx(
        0.01 - 0.0025 * np.sqrt(2), rel=2e-3
    )


def test_pairs_that_may_touch_are_those_within_reach():
    row = [box((10, 10, 10), pose(x)) for x in (0.0, 0.02, 0.05)]  # gaps of 10, 20 and 40 mm
    assert may_touch_pairs(row, 0.0049) == []
    assert may_touch_pairs(row, 0.0051) == [(0, 1)]
    assert may_touch_pairs(row, [0.0, 0.011, 0.01]) == [(0, 1), (1, 2)]
    assert may_touch_pairs(row, 0.0201) == [(0, 1), (0, 2), (1, 2)]


def test_diagonal_neighbours_are_judged_by_true_distance_not_by_boxes():
    """Two thin bars at 45 degrees: their boxes overlap, the bars are 20 mm apart."""
    a = box((60, 1, 1), pose(about_z_deg=45))
    b = box((60, 1, 1), pose(0.021 / np.sqrt(2), -0.021 / np.sqrt(2), about_z_deg=45))
    assert distance(a, b) == pytest.approx(0.02, abs=1e-9)
    assert may_touch_pairs([a, b], 0.0099) == []
    assert may_touch_pairs([a, b], 0.0101) == [(0, 1)]
