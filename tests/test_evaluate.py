"""From a design to its result: real grasps, short and coarse, and everything that can go wrong on the way."""

from __future__ import annotations

import json
import math
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
from numba import njit

from finqd import cli
from finqd import evaluate as module
from finqd.data import designs_folder
from finqd.design import Design
from finqd.effects import EFFECTS
from finqd.errors import InputError, MeshError, MissingLibraryError
from finqd.evaluate import Evaluation, evaluate
from finqd.grasp import compile_clock
from finqd.trajectory import Trajectory
from finqd.workers import TaskFailure

OBJECTS = ("sphere", "disk")
LIFT_MM = 15.0
#: closes in 0.4 s and lifts at once: a grasp that is held, in about two seconds of computing
SHORT = {
    "actuation.duration_s": 0.4, "protocol.close_s": 0.4, "protocol.squeeze_s": 0.06, "protocol.lift_s": 0.2,
    "protocol.lift_mm": LIFT_MM, "protocol.hold_s": 0.1,
}
CRATE = {"name": "crate", "shape": {"kind": "box", "size_mm": [150, 150, 60]}, "mass_g": 500}
ROW = {
    "status", "reason", "held", "drop_mm", "margin", "max_contact_force_N", "max_penetration_mm", "steps",
    "newton_iterations", "seconds",
}


def benchmark() -> Design:
    return Design.from_json(designs_folder() / "benchmark.json")


def run(**changes) -> Evaluation:
    return evaluate(benchmark(), **{"objects": OBJECTS, "preset": "draft", "overrides": SHORT, **changes})


def untimed(result: dict) -> str:
    """Return the JSON of a result without what a clock said."""
    rows = {name: {key: value for key, value in row.items() if key != "seconds"}
            for name, row in result["objects"].items()}
    return json.dumps({**result, "objects": rows, "timings": None}, allow_nan=False)


@pytest.fixture(scope="module")
def result() -> dict:
    return run().to_dict()


def test_the_result_says_everything_and_is_json(result):
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert {"fitness", "margin", "features", "objects", "timings", "effects", "assumptions", "versions", "mesh",
            "design", "digest", "preset", "accuracy", "status", "reason"} <= result.keys()
    assert result["accuracy"]["preset"] == "draft" and result["accuracy"]["sentence"]
    assert set(result["features"]) >= {"workspace_mm2", "volume_mm3", "finger_volume_mm3"}
    assert result["features"]["workspace_mm2"] == pytest.approx(2078.46, abs=0.01)
    assert list(result["objects"]) == list(OBJECTS)
    for row in result["objects"].values():
        assert row.keys() >= ROW and row["status"] == "ok" and row["reason"] == ""
        assert row["newton_iterations"] + row["counters"]["quasi_iterations"] >= row["steps"] > 10
    assert result["mesh"]["elements"]["hex8"] > 100 and result["mesh"]["dofs"] == 3 * result["mesh"]["vertices"]
    assert result["reductions"].keys() == {"early_verdict", "long_steps"}
    assert result["effects"] == {name: effect.plain for name, effect in EFFECTS.items()}
    assert len(set(result["assumptions"])) == len(result["assumptions"]) > 5
    for row in result["objects"].values():
        seen = row["effects"]
        assert 0.0 < seen["object_contact"]["since_s"] < row["simulated_s"] and seen["floor"]["since_s"] == 0.0
    assert result["versions"].keys() >= {"finqd", "numpy", "numba", "gmsh"}
    assert Design.from_json(json.dumps(result["design"])).digest() == result["digest"], "a result can be run again"


def test_both_objects_are_squeezed_lifted_and_held(result):
    design = Design.from_json(json.dumps(result["design"]))
    for name, row in result["objects"].items():
        assert row["held"] and 0 < row["drop_mm"] < 2, name
        assert row["margin"] == pytest.approx(1 - row["drop_mm"] / design.protocol.drop_threshold_mm, abs=1e-9)
        assert 1 < row["max_contact_force_N"] < 10, "stalls at about 5 N a finger"
        assert 0 < row["max_penetration_mm"] <= 0.1
        assert len(row["final_contact_force_N"]) == 3 and min(row["final_contact_force_N"]) > 0.1
    assert 20 + LIFT_MM - 2 < result["objects"]["sphere"]["final_height_mm"] < 20 + LIFT_MM
    assert result["fitness"] == 1.0
    assert result["margin"] == pytest.approx(np.mean([row["margin"] for row in result["objects"].values()]))


def test_a_run_in_two_processes_gives_the_same_bytes(result):
    assert untimed(run(jobs=2).to_dict()) == untimed(result)


@pytest.mark.slow
def test_a_second_run_gives_the_same_bytes(result):
    assert untimed(run().to_dict()) == untimed(result)


def test_the_timings_add_up_and_know_what_compiling_took(result):
    timings = result["timings"]
    parts = timings["geometry"] + timings["mesh"] + timings["simulation"]
    assert parts <= timings["total"] <= parts + 1.0
    assert 0 <= timings["compile"] <= timings["simulation"]
    assert sum(row["seconds"] for row in result["objects"].values()) <= timings["simulation"]


def test_the_compile_clock_runs_while_numba_compiles_and_stands_still_afterwards():
    @njit
    def cube(x):
        return x * x * x

    with compile_clock() as compiled:
        assert compiled() == 0.0
        assert cube(2.0) == 8.0
        first = compiled()
        assert cube(3.0) == 27.0
        assert compiled() == first
    assert (first > 0.0) == hasattr(cube, "signatures"), "with NUMBA_DISABLE_JIT there is nothing to compile"


def test_a_mesh_that_fails_is_a_result_with_reasons(monkeypatch):
    def fail(mesher, solid):
        raise MeshError("the mesher gave up")

    monkeypatch.setattr(module, "mesh_solid", fail)
    evaluation = run()
    failed = evaluation.to_dict()
    assert json.loads(json.dumps(failed, allow_nan=False)) == failed
    assert (evaluation.status, evaluation.reason) == ("mesh_failed", "the mesher gave up")
    assert (evaluation.fitness, evaluation.margin) == (0.0, -1.0)
    assert failed["features"]["volume_mm3"] > 4e4, "what needs no simulation is there all the same"
    for name in OBJECTS:
        row = failed["objects"][name]
        assert row.keys() >= ROW and not row["held"]
        assert (row["status"], row["reason"]) == ("mesh_failed", "the mesher gave up")


def test_an_object_too_big_for_the_gripper_finds_no_room_and_the_others_do_not_mind(result):
    mixed = run(objects=[*map(module.load_object, (CRATE, "sphere"))]).to_dict()
    crate = mixed["objects"]["crate"]
    assert (crate["status"], crate["held"], crate["margin"], crate["steps"]) == ("no_room", False, -1.0, 0)
    assert "crate does not fit" in crate["reason"] and "finger" in crate["reason"]
    assert crate["drop_mm"] is None and crate["max_contact_force_N"] is None
    sphere, alone = mixed["objects"]["sphere"], result["objects"]["sphere"]
    assert {**sphere, "seconds": 0} == {**alone, "seconds": 0}
    assert mixed["fitness"] == 0.5


def test_a_simulation_that_diverges_is_a_row_with_a_reason():
    hopeless = {**SHORT, "stepper.max_iterations": 1, "stepper.tolerance_N": 1e-300}
    evaluation = run(objects=["sphere"], overrides=hopeless)
    row = json.loads(json.dumps(evaluation.to_dict(), allow_nan=False))["objects"]["sphere"]
    assert row["status"] == "diverged" and not row["held"] and row["drop_mm"] is None and row["margin"] == -1.0
    assert "t = 0.0000 s" in row["reason"] and "no equilibrium after" in row["reason"]
    assert row["counters"]["rejected_steps"] == 9, "halved eight times"
    assert evaluation.status == "ok" and evaluation.fitness == 0.0


def test_a_simulation_that_takes_too_long_is_a_row_with_a_reason():
    hasty = {**SHORT, "protocol.wall_clock_limit_s": 1e-3}
    row = run(objects=["sphere"], overrides=hasty).to_dict()["objects"]["sphere"]
    assert row["status"] == "timeout" and "0.001 s" in row["reason"] and row["drop_mm"] is None


@pytest.mark.parametrize("raised", [InputError("no", "design"), MissingLibraryError("install fcl")])
def test_what_is_no_fault_of_the_design_is_raised(raised):
    with pytest.raises(type(raised), match=str(raised)):
        module._as_trajectory(TaskFailure(kind="error", reason="", exception=raised), benchmark(), "cube")


@pytest.mark.parametrize("raised", [MeshError("flat"), ValueError("a bug"), None])
def test_every_other_failure_of_a_task_is_a_row(raised):
    failure = TaskFailure(kind="crash", reason="its process died", exception=raised)
    trajectory = module._as_trajectory(failure, benchmark(), "cube")
    assert (trajectory.status, trajectory.reason, trajectory.object_name) == ("crash", "its process died", "cube")
    assert math.isnan(trajectory.object_drop)


def test_what_was_assumed_of_an_object_is_in_the_result(tmp_path):
    import trimesh

    trimesh.creation.box((150, 150, 60)).export(tmp_path / "crate.stl")
    sentences = run(objects=[tmp_path / "crate.stl"]).to_dict()["assumptions"]
    assert "crate.stl: lengths are taken in mm" in sentences
    assert any(sentence.startswith("crate.stl: no mass given") for sentence in sentences)
    assert any("pads" in sentence for sentence in sentences) and any("slivers" in sentence for sentence in sentences)


def test_objects_are_taken_once_each_and_at_least_one():
    with pytest.raises(InputError, match="^objects: each object once, please: sphere$"):
        run(objects=["sphere", "disk", "sphere"])
    with pytest.raises(InputError, match="^objects: no object$"):
        run(objects=[])


def test_progress_is_told_for_each_object_and_never_runs_back():
    told: list[tuple[str, float]] = []
    short = {**SHORT, "protocol.close_s": 0.1, "protocol.squeeze_s": 0.0, "protocol.lift_s": 0.04, "protocol.hold_s": 0}
    run(overrides=short, progress=lambda name, share: told.append((name, share)))
    for name in OBJECTS:
        shares = [share for who, share in told if who == name]
        assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) >= 5


def test_record_leaves_files_for_paraview_behind(tmp_path, capsys):
    settings = [word for key, value in SHORT.items() for word in ("--set", f"{key}={value}")]
    with pytest.raises(SystemExit) as ended:
        cli.main(["evaluate", "benchmark", "--objects", "sphere", "--preset", "draft", "--jobs", "1", *settings,
                  "--record", str(tmp_path / "film"), "--out", str(tmp_path / "result.json")])
    assert ended.value.code == 0
    table = capsys.readouterr().out
    assert "sphere" in table and "fitness 1.000 (1 of 1 held)" in table
    trajectory = Trajectory.load(tmp_path / "film" / "sphere" / "trajectory.npz")
    steps = json.loads((tmp_path / "result.json").read_text())["objects"]["sphere"]["steps"]
    assert 1 < trajectory.n_frames <= steps + 1 and trajectory.status == "ok"
    (pvd,) = (tmp_path / "film").rglob("*.pvd")
    files = [entry.attrib["file"] for entry in ElementTree.parse(pvd).getroot().iter("DataSet")]
    assert len(files) == 2 * trajectory.n_frames, "fingers and object, frame by frame"
    last = [meshio.read(pvd.parent / file) for file in files[-2:]]
    fingers, sphere = sorted(last, key=lambda mesh: "triangle" in mesh.cells_dict)
    np.testing.assert_allclose(fingers.points, trajectory.soft_positions[-1], atol=1e-6)
    assert sphere.points[:, 2].min() == pytest.approx(trajectory.rigid_positions[-1, 0, 2] - 0.02, abs=5e-4)
