"""A third party's finger type: installed by itself, conforming, evaluated, with no change to finqd."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "finqd-tapered-finger"


def test_it_takes_at_most_sixty_lines():
    assert len((EXAMPLE / "finqd_tapered_finger.py").read_text().splitlines()) <= 60


def test_it_is_listed_with_its_distribution_beside_the_built_ins(example_environment, tmp_path):
    listed = example_environment.finqd("plugins", "--kind", "geometry", cwd=tmp_path).stdout
    assert "geometry tapered (finqd-tapered-finger 0.1.0): Solid tapered finger" in listed
    assert "thickness_mm = 20.0: a number from 5 to 50" in listed
    assert "geometry fin_ray (finqd " in listed


def test_its_schema_follows_from_its_parameters(example_environment, tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(example_environment.finqd("schema", "--geometry", "tapered", cwd=tmp_path).stdout)
    design = json.loads((EXAMPLE / "designs" / "tapered.json").read_text())
    jsonschema.validate(design, schema)
    design["finger"]["rib_count"] = 3
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(design, schema)


def test_its_own_suite_runs_the_conformance_checks_on_it_alone(example_environment, tmp_path):
    shutil.copytree(EXAMPLE / "tests", tmp_path / "tests", ignore=shutil.ignore_patterns("__pycache__"))
    done = example_environment.run("python", "-m", "pytest", "-v", "-p", "no:cacheprovider", "tests", cwd=tmp_path)
    assert "geometry-tapered-builds_every_design" in done.stdout
    assert "fin_ray" not in done.stdout and " passed" in done.stdout


def test_the_installed_wheel_evaluates_from_an_empty_folder(wheel_environment, tmp_path):
    """Here, and not beside the package's other tests: both evaluations then load what one of them has compiled."""
    done = wheel_environment.run(
        "finqd", "evaluate", "benchmark", "--objects", "sphere", "--preset", "draft", "--out", "result.json",
        cwd=tmp_path,
    )
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["objects"]["sphere"]["status"] == "ok", result["objects"]
    assert abs(result["features"]["workspace_mm2"] - 2078.46) < 0.01
    assert "sphere" in done.stdout and "Traceback" not in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]


def test_its_design_is_evaluated(example_environment, tmp_path):
    design = tmp_path / "tapered.json"
    shutil.copy(EXAMPLE / "designs" / "tapered.json", design)
    example_environment.finqd(
        "evaluate", str(design), "--objects", "sphere", "--preset", "draft", "--out", "result.json", cwd=tmp_path
    )
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["objects"]["sphere"]["status"] == "ok", result["objects"]
    assert abs(result["features"]["finger_volume_mm3"] - 3 * 90 * 9 * 20) < 1e-6


def test_a_contradiction_is_told_in_its_own_words(example_environment, tmp_path):
    done = example_environment.finqd(
        "evaluate", str(EXAMPLE / "designs" / "tapered.json"), "--set", "finger.tip_width_mm=15",
        cwd=tmp_path, check=False,
    )
    assert done.returncode == 2 and "tip_width_mm must not exceed base_width_mm" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
