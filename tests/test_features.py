"""Features: closed forms, scaling laws and the paper's numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from finqd import registry
from finqd.data import designs_folder
from finqd.design import Design
from finqd.solid import Prism


@pytest.fixture(scope="module")
def benchmark() -> Design:
    return Design.from_json(designs_folder() / "benchmark.json")


def measured(design: Design) -> dict[str, float]:
    geometry = design.plugin("geometry")
    solids = [geometry.build(design.finger_si(i)) for i in range(3)]
    values: dict[str, float] = {}
    for plugin in design.plugin("features"):
        values |= plugin.measure(design, solids)
    return values


def brick(*sides_mm: float) -> Prism:
    a, b, c = (side * 1e-3 for side in sides_mm)
    return Prism(outer=np.array([[0, 0], [a, 0], [a, b], [0, b]]), holes=(), thickness=c, contact_line=None)


@pytest.mark.parametrize("name", registry.names("features"))
def test_names_are_what_is_measured(benchmark, name):
    plugin = registry.create("features", name)
    values = plugin.measure(benchmark, [brick(10, 20, 30)] * 3)
    assert tuple(values) == plugin.names
    assert all(math.isfinite(value) and isinstance(value, float) for value in values.values())


def test_benchmark_has_the_papers_features(benchmark):
    features = measured(benchmark)
    assert features["workspace_mm2"] == pytest.approx(2078.46, abs=0.01)
    assert features["finger_volume_mm3"] == pytest.approx(45_427, abs=30)
    assert features["volume_mm3"] == pytest.approx(51_139.59, abs=40)


@pytest.mark.parametrize("spacing", [15.0, 30.0, 35.0, 40.0, 120.0])
def test_workspace_is_the_area_between_three_points_on_the_circle(benchmark, spacing):
    angles = np.radians([90, 210, 330])
    x, y = spacing * np.cos(angles), spacing * np.sin(angles)
    area = 0.5 * abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]))
    design = benchmark.with_overrides({"spacing_mm": spacing})
    assert measured(design)["workspace_mm2"] == pytest.approx(area, rel=1e-13)


def test_volume_is_fingers_and_plate(benchmark):
    volume = registry.create("features", {"name": "volume", "plate_mm": 10})
    values = volume.measure(benchmark, [brick(10, 20, 30), brick(1, 1, 1), brick(5, 5, 5)])
    assert values["finger_volume_mm3"] == pytest.approx(6000 + 1 + 125, rel=1e-13)
    assert values["volume_mm3"] - values["finger_volume_mm3"] == pytest.approx(20784.609690826527, rel=1e-12)
    bare = registry.create("features", {"name": "volume", "plate_mm": 0})
    assert bare.measure(benchmark, [brick(10, 20, 30)] * 3)["volume_mm3"] == pytest.approx(18000, rel=1e-13)


def test_thickness_scales_the_fingers_alone(benchmark):
    once, twice = measured(benchmark), measured(benchmark.with_overrides({"finger.thickness_mm": 42.6}))
    assert twice["finger_volume_mm3"] == pytest.approx(2 * once["finger_volume_mm3"], rel=1e-12)
    assert twice["volume_mm3"] - once["volume_mm3"] == pytest.approx(once["finger_volume_mm3"], rel=1e-11)


def test_order_of_fingers_does_not_matter():
    design = Design.from_json(designs_folder() / "three_different.json")
    document = design.to_dict()
    document["fingers"] = document["fingers"][::-1]
    assert measured(Design.from_json(document)) == measured(design)
