"""The fin ray's polygon against closed forms, an independent boolean and its own symmetries."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import qmc

from finqd.errors import InputError
from finqd.plugins.geometry_fin_ray import FinRay
from finqd.plugins.swept_patches import mesh_patches
from finqd.solid import Prism, SurfaceSolid, ring_area
from finqd.units import DEG, MM

PROFILES = ("isosceles", "right")
BENCHMARK = {
    "length": 94.5 * MM, "width": 37.5 * MM, "thickness": 21.3 * MM, "tip_length": 15 * MM, "contact_wall": 2 * MM,
    "back_wall": 2 * MM, "rib_count": 8, "rib_thickness": 2 * MM, "rib_angle": 0.0,
}
BASE_PLATE = 2 * MM


def sobol_fingers(count: int, seed: int = 1) -> list[dict[str, float]]:
    """Return the fingers of ``count`` (a power of two) designs over the whole 28-dimensional search space."""
    factor = {"mm": MM, "deg": DEG, "": 1}
    found = []
    for unit in qmc.Sobol(28, seed=seed).random(count):
        for values in unit[:27].reshape(3, 9):
            finger = {}
            for p, u in zip(FinRay.finger_parameters, values):
                number = p.low + int(u * (p.high - p.low + 1)) if p.integer else p.low + u * (p.high - p.low)
                finger[p.name] = number * factor[p.unit]
            found.append(finger)
    return found


def independent_area(profile: str, f: dict[str, float]) -> float:
    """Return the profile's area [m^2] from shapely booleans of walls, plate, tip and ribs, each built by itself."""
    from shapely import LineString, Polygon, box, union_all
    from shapely.affinity import rotate

    apex = (0.5 * f["width"] if profile == "isosceles" else 0.0, f["length"])
    base, back = (0.0, 0.0), (f["width"], 0.0)
    triangle = Polygon([base, back, apex])

    def band(a: tuple, b: tuple, width: float) -> Any:
        line = np.array([a, b])
        line = line + np.array([[-1.0], [1.0]]) * (line[1] - line[0])  # far beyond both corners
        return LineString(line).buffer(width, cap_style="flat", single_sided=True)

    tip_line = f["length"] - f["tip_length"]
    frame = [
        band(base, back, BASE_PLATE), band(back, apex, f["back_wall"]), band(apex, base, f["contact_wall"]),
        box(-1, tip_line, 1, 1),
    ]
    pitch = (tip_line - BASE_PLATE) / (f["rib_count"] + 1)
    for i in range(1, int(f["rib_count"]) + 1):
        y = BASE_PLATE + i * pitch
        x = 0.5 * f["width"] + (apex[0] - 0.5 * f["width"]) * y / f["length"]
        strip = box(x - 1, y - 0.5 * f["rib_thickness"], x + 1, y + 0.5 * f["rib_thickness"])
        frame.append(rotate(strip, f["rib_angle"] / DEG, origin=(x, y)))
    return triangle.intersection(union_all(frame)).area


def assert_sound(solid: Prism, profile: str, finger: dict[str, float]) -> None:
    assert solid.polygon.is_valid and solid.polygon.geom_type == "Polygon"
    assert all(ring_area(hole) > 0 for hole in solid.holes)
    assert solid.area == pytest.approx(independent_area(profile, finger), rel=1e-6)


def test_benchmark_volume_is_the_one_of_the_facts() -> None:
    assert 3e9 * FinRay().build(BENCHMARK).volume == pytest.approx(45_427, abs=1)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("rib_count", [0, 1, 8])
def test_untilted_area_by_hand(profile: str, rib_count: int) -> None:
    f = BENCHMARK | {"rib_count": rib_count, "contact_wall": 1.3 * MM, "back_wall": 2.7 * MM}
    slope = f["width"] / f["length"]
    stretch = np.hypot(1, slope / 2) * np.ones(2) if profile == "isosceles" else np.array([1.0, np.hypot(1, slope)])

    def inner_width(y: float) -> float:
        return f["width"] - slope * y - stretch @ [f["contact_wall"], f["back_wall"]]

    low, high = BASE_PLATE, f["length"] - f["tip_length"]
    cavity = 0.5 * (inner_width(low) + inner_width(high)) * (high - low)
    centres = low + np.arange(1, rib_count + 1) * (high - low) / (rib_count + 1)
    ribs = sum(f["rib_thickness"] * inner_width(y) for y in centres)
    area = 0.5 * f["width"] * f["length"] - cavity + ribs
    solid = FinRay(profile=profile).build(f)
    assert solid.area == pytest.approx(area, rel=1e-12)
    assert len(solid.holes) == rib_count + 1
    assert np.allclose(solid.contact_line[1], [0.5 * f["width"] if profile == "isosceles" else 0, f["length"]])


@pytest.mark.parametrize("profile", PROFILES)
def test_sobol_designs_are_sound(profile: str) -> None:
    for finger in sobol_fingers(64):
        solid = FinRay(profile=profile).build(finger)
        assert_sound(solid, profile, finger)
        assert solid.volume == pytest.approx(solid.area * finger["thickness"], rel=1e-14)


def test_closed_surface_has_the_volume_of_the_polygon() -> None:
    for finger in sobol_fingers(8):
        solid = FinRay().build(finger)
        assert SurfaceSolid(*solid.surface()).volume == pytest.approx(solid.volume, rel=1e-12)


@pytest.mark.parametrize("profile", PROFILES)
def test_walls_may_meet_below_the_tip_line(profile: str) -> None:
    finger = BENCHMARK | {
        "length": 120 * MM, "width": 28 * MM, "tip_length": 20 * MM, "contact_wall": 3 * MM, "back_wall": 3 * MM,
        "rib_count": 10, "rib_angle": -35 * DEG,
    }
    solid = FinRay(profile=profile).build(finger)
    assert_sound(solid, profile, finger)
    assert max(hole[:, 1].max() for hole in solid.holes) < 98 * MM
    assert solid.patches is not None


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("width", [-1e-5, -1e-7, 0.0, 1e-9, 1e-6, 4e-6, 6e-6, 1e-5, 1e-4])
def test_walls_that_meet_at_the_tip_line(profile: str, width: float) -> None:
    """The cavity is ``width`` [m] wide at the tip line; negative: the walls meet below it."""
    slope = BENCHMARK["width"] / BENCHMARK["length"]
    stretch = 2 * np.hypot(1, slope / 2) if profile == "isosceles" else 1 + np.hypot(1, slope)
    wall = (slope * 20 * MM - width) / stretch
    finger = BENCHMARK | {"tip_length": 20 * MM, "contact_wall": wall, "back_wall": wall, "rib_angle": -0.45}
    solid = FinRay(profile=profile).build(finger)
    assert_sound(solid, profile, finger)
    assert solid.patches is not None
    assert mesh_patches(solid.patches, 4 * MM, 1).worst() > 0.1


@pytest.mark.parametrize("wall", ["contact_wall", "back_wall"])
@pytest.mark.parametrize("edge", ["lower", "upper"])
@pytest.mark.parametrize("miss", [0.0, 1e-12, 1e-9, 1e-7, 1e-6, 5e-6, 1e-5, 1e-4, 3e-4])
def test_ribs_that_just_miss_a_corner(wall: str, edge: str, miss: float) -> None:
    """The edge of the first rib passes ``miss`` [m] to either side of the cavity's base corner."""
    sign = 1.0 if wall == "contact_wall" else -1.0
    tangent = 0.5 * BENCHMARK["width"] / BENCHMARK["length"]
    corner = np.array([BENCHMARK["contact_wall"] * np.hypot(1, tangent) + BASE_PLATE * tangent, BASE_PLATE])
    if sign < 0:
        corner[0] = BENCHMARK["width"] - corner[0]
    pitch = (BENCHMARK["length"] - BENCHMARK["tip_length"] - BASE_PLATE) / 7
    centre = np.array([0.5 * BENCHMARK["width"], BASE_PLATE + pitch])
    half = (0.5 if edge == "upper" else -0.5) * BENCHMARK["rib_thickness"]

    def distance(angle: float) -> float:
        return float((corner - centre) @ [-np.sin(angle), np.cos(angle)]) - half

    for side in (-1.0, 1.0):
        angle = brentq(lambda a, side=side: distance(a) - side * miss, *sorted((0.05 * sign, 0.95 * sign)), xtol=1e-15)
        finger = BENCHMARK | {"rib_count": 6, "rib_angle": angle}
        solid = FinRay().build(finger)
        assert_sound(solid, "isosceles", finger)
        assert solid.patches is not None
        plane = mesh_patches(solid.patches, 4 * MM, 1)
        assert plane.worst() > 0.1
        area = sum(ring_area(plane.points[quad]) for quad in plane.quads)
        assert area == pytest.approx(solid.area, rel=1e-9)


@pytest.mark.parametrize("angle", [0.0, 25.0, -40.0, 60.0])
def test_a_mirrored_isosceles_finger_is_the_finger_with_the_other_tilt(angle: float) -> None:
    finger = BENCHMARK | {"rib_angle": angle * DEG, "contact_wall": 1 * MM, "back_wall": 3 * MM, "rib_count": 5}
    mirrored = finger | {"rib_angle": -angle * DEG, "contact_wall": 3 * MM, "back_wall": 1 * MM}
    one, other = FinRay().build(finger).polygon, FinRay().build(mirrored).polygon
    from shapely.affinity import scale

    flipped = scale(other, -1.0, 1.0, origin=(0.5 * finger["width"], 0))
    assert one.symmetric_difference(flipped).area < 1e-12 * one.area


def test_positive_tilt_lifts_the_back_end() -> None:
    solid = FinRay().build(BENCHMARK | {"rib_count": 1, "rib_angle": 20 * DEG, "contact_wall": MM, "back_wall": MM})
    lower = solid.holes[0]
    top = lower[lower[:, 1] > 20 * MM]
    assert top[np.argmax(top[:, 0]), 1] > top[np.argmin(top[:, 0]), 1] + 5 * MM


@pytest.mark.parametrize("profile", PROFILES)
def test_patches_are_a_conforming_partition(profile: str) -> None:
    for finger in sobol_fingers(16, seed=7):
        solid = FinRay(profile=profile).build(finger)
        assert solid.patches is not None
        outlines = [np.concatenate([side[:-1] for side in patch]) for patch in solid.patches]
        assert sum(map(ring_area, outlines)) == pytest.approx(solid.area, rel=1e-10)
        seen: dict[tuple, int] = {}
        for outline in outlines:
            for a, b in zip(outline, np.roll(outline, -1, axis=0)):
                key = tuple(sorted((tuple(np.round(a, 8)), tuple(np.round(b, 8)))))
                seen[key] = seen.get(key, 0) + 1
        lone = sum(np.linalg.norm(np.subtract(*key)) for key, times in seen.items() if times == 1)
        rings = (solid.outer, *solid.holes)
        boundary = sum(np.linalg.norm(r - np.roll(r, -1, axis=0), axis=1).sum() for r in rings)
        assert max(seen.values()) == 2
        assert lone == pytest.approx(boundary, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"tip_length": 60 * MM, "length": 60 * MM}, "tip_length_mm must stay below 57 for this length_mm, got 60"),
        ({"contact_wall": 10 * MM, "back_wall": 10 * MM, "width": 20 * MM}, "leave no cavity in a finger of width_mm"),
        ({"rib_count": 30, "rib_thickness": 3 * MM}, "rib_thickness_mm must stay below 2.3 for rib_count 30"),
        ({"rib_angle": 60 * DEG, "rib_thickness": 5 * MM}, "rib_thickness_mm must stay below 4.106"),
    ],
)
def test_contradictions_get_one_sentence(change: dict[str, float], sentence: str) -> None:
    finger = BENCHMARK | change
    problem = FinRay().check(finger)
    assert problem is not None and sentence in problem
    with pytest.raises(InputError) as caught:
        FinRay().build(finger)
    assert str(caught.value) == problem


def test_allowed_ranges_give_a_sound_solid_or_a_sentence() -> None:
    factor = {"mm": MM, "deg": DEG, "": 1}
    built = 0
    for unit in qmc.Sobol(9, seed=3).random(256):
        finger = {}
        for p, u in zip(FinRay.finger_parameters, unit):
            number = p.allowed_low + u * (p.allowed_high - p.allowed_low)
            finger[p.name] = (round(number) if p.integer else number) * factor[p.unit]
        if FinRay().check(finger) is None:
            assert_sound(FinRay().build(finger), "isosceles", finger)
            built += 1
    assert built > 60


def test_base_plate_is_an_option_and_wrong_areas_are_seen() -> None:
    thick = FinRay(base_plate_mm=4.0).build(BENCHMARK)
    assert thick.area != pytest.approx(independent_area("isosceles", BENCHMARK), rel=1e-4)
    with pytest.raises(AssertionError):
        assert_sound(replace(thick, patches=None), "isosceles", BENCHMARK)
