"""The benchmark finger's compliance, against the table of independent reference values (`benchmarks/compliance.py`)."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from finqd import registry


def _script() -> ModuleType:
    path = Path(__file__).parents[1] / "benchmarks" / "compliance.py"
    spec = importlib.util.spec_from_file_location("compliance_benchmark", path)
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


benchmark = _script()


@pytest.mark.parametrize("profile", benchmark.PROFILES)
def test_the_default_mesh_has_the_right_compliance(profile):
    row = benchmark.measure(profile, "hex8 4")
    assert row.dofs < 4000
    assert row.within == 0.05
    assert row.passed, row


@pytest.mark.parametrize("profile", benchmark.PROFILES)
def test_linear_tetrahedra_lock_as_much_as_they_should(profile):
    row = benchmark.measure(profile, "tet4 2")
    assert row.within == 0.10
    assert row.passed, row


def test_nodes_at_a_quarter_follow_the_notches_where_nodes_in_the_middle_do_not():
    quarter, middle = (benchmark.measure("isosceles", f"hex20 2.5 {kind}") for kind in ("quarter", "even"))
    assert quarter.passed and quarter.dofs == middle.dofs
    assert middle.compliance_mm / quarter.reference_mm < 0.94


def test_the_load_does_not_depend_on_the_mesh():
    solid = benchmark.benchmark_finger("isosceles")
    along = solid.contact_line[1] - solid.contact_line[0]
    along /= np.linalg.norm(along)
    outward = np.array([-along[1], along[0]])  # the finger lies at larger x
    for case in ("hex8 4", "hex8 2", "tet4 4"):
        mesh = registry.create("mesher", benchmark.CASES[case][0]).mesh(solid)
        forces = benchmark.contact_load(mesh, solid.contact_line)
        total = forces.sum(axis=0)
        np.testing.assert_allclose(total, [*(-benchmark.FORCE * outward), 0.0], atol=1e-9)
        distance = (mesh.vertices[:, :2] - solid.contact_line[0]) @ along
        centre = np.linalg.norm(forces, axis=1) @ distance / np.linalg.norm(forces, axis=1).sum()
        assert centre == pytest.approx(0.0475, abs=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("case", benchmark.CASES)
@pytest.mark.parametrize("profile", benchmark.PROFILES)
def test_the_full_table(profile, case):
    row = benchmark.measure(profile, case)
    assert row.passed is not False, row
    assert row.deviation is None or abs(row.deviation) < 0.06, row
