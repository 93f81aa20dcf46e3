"""finqd beside its peers (`benchmarks/peers.py`): the rule for the time step, the tasks, what is typed wrongly."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
import peer_cases  # noqa: E402
import peer_finqd  # noqa: E402
import peers  # noqa: E402

VARIANT = peer_cases.Variant(program="finqd", mesh="tet4 4x1x1", stepper=peer_cases.IMPLICIT)


def sag_task(mesh: str = "tet4 6x2x2") -> dict:
    task = peer_cases.CASES["sag_0.3"].task(mesh)
    return {**task, "stepper": peer_cases.IMPLICIT, "limit_s": 60.0, "repeats": 1, "time_step": 0.04}


def laddered(monkeypatch, results: dict) -> dict:
    """Return what the ladder makes of programs that answer ``results``: time step -> sag [mm], or why there is none."""

    def answer(program, python, task, **rest):
        found = results.get(task["time_step"], "blew up")
        if isinstance(found, str):
            return {"failed": found}
        return {"failed": "", "displacement": [0.0, 0.0, -1e-3 * found]}

    monkeypatch.setattr(peers, "ask", answer)
    return peers.down_the_ladder(peer_cases.CASES["sag_0.3"], VARIANT, "python", 1.0)


def test_the_largest_step_that_the_next_one_confirms_is_taken(monkeypatch):
    found = laddered(monkeypatch, {0.04: 5.0, 0.02: 7.0, 0.01: 7.05, 0.005: 7.06})
    assert found["time_step"] == 0.02
    assert found["value"] == pytest.approx(7.0)
    assert list(found["ladder"]) == ["40", "20", "10"]
    assert "note" not in found


def test_steps_too_large_to_run_are_passed_over(monkeypatch):
    assert laddered(monkeypatch, {0.005: 7.0, 0.002: 7.0})["time_step"] == 0.005


def test_a_step_that_nothing_confirms_says_so(monkeypatch):
    found = laddered(monkeypatch, {0.04: 7.0, 0.02: "not done after 1 s"})
    assert found["time_step"] == 0.04
    assert found["note"] == "20 ms: not done after 1 s"
    assert "may change it" in laddered(monkeypatch, {step: 1 / step for step in peers.LADDER})["note"]


def test_a_program_that_never_runs_is_a_row_with_the_reason(monkeypatch):
    found = laddered(monkeypatch, {})
    assert found["failed"] == "blew up"
    row = {"case": "sag_0.3", "asked": "mujoco", "mesh": "tet4 4x1x1", **found}
    assert "blew up" in peers.line(row, "mm")


def test_a_cold_run_has_a_cache_of_its_own_and_is_reported_beside_the_warm_one(monkeypatch):
    caches = []

    def answer(program, python, task, *, timeout, **more):
        caches.append(more.get("NUMBA_CACHE_DIR"))
        return {
            "failed": "", "displacement": [0.0, 0.0, -7e-3], "first_s": 80.0, "seconds": 1.0, "set_up_s": 0.1,
            "solver": "implicit_euler", "program": "finqd",
        }

    monkeypatch.setattr(peers, "ask", answer)
    row = peers.measured("sag_0.3", VARIANT, "python", reference=(10.0, "made up"), limit=1.0, cold=True)
    assert caches[:2] == [None, None] and len(caches) == 3 and caches[2]
    assert row["cold_s"] == 80.0 and row["error"] == pytest.approx(-0.3)
    assert "| 1.10 | 80 | 7 mm | -30.0 % |" in peers.line(row, "mm")


@pytest.mark.parametrize("name", ["sag_0.49", "weight"])
def test_linear_tetrahedra_of_a_task_are_those_of_its_blocks(name):
    task = peer_cases.CASES[name].task("tet4 4x2x2")
    vertices = np.array(task["vertices"])
    inside = (vertices - task["clamp_point"]) @ np.array(task["clamp_normal"]) < 0.0
    assert task["tetrahedra"] == task["blocks"]["tet4"]
    assert np.array_equal(np.flatnonzero(inside), np.sort(task["clamped"]))
    assert 0 < inside.sum() < len(vertices)


def test_finqd_runs_a_task_to_rest_and_quadratic_bricks_sag_more():
    found = {mesh: peer_finqd.run(sag_task(mesh)) for mesh in ("tet4 6x2x2", "hex20 4x1x1")}
    sags = {mesh: -1e3 * outcome["displacement"][2] for mesh, outcome in found.items()}
    assert all(outcome["last_move"] < 1e-7 for outcome in found.values())
    assert 3.0 < sags["tet4 6x2x2"] < 6.0  # locks
    assert sags["hex20 4x1x1"] == pytest.approx(7.03, rel=0.04)  # the converged sag


@pytest.mark.parametrize("program", ["mujoco", "drake"])
def test_a_peer_of_the_same_element_agrees_with_finqd(program):
    if importlib.util.find_spec(peers.MODULES[program]) is None:
        pytest.skip(f"{program} is not installed")
    task = sag_task()
    found = peers.ask(program, sys.executable, task, timeout=120)
    assert found["failed"] == ""
    np.testing.assert_allclose(found["displacement"], peer_finqd.run(task)["displacement"], rtol=0.02, atol=2e-5)


def test_a_missing_peer_is_left_out_with_one_sentence(monkeypatch):
    monkeypatch.setitem(peers.MODULES, "mujoco", "no_such_module_anywhere")
    reason = peers.missing("mujoco", sys.executable)
    assert "pip install mujoco" in reason and reason.count("\n") == 0
    assert peers.missing("finqd", sys.executable) == ""


def test_what_goes_wrong_in_a_peer_is_one_sentence():
    found = peers.ask("finqd", sys.executable, {"repeats": 1}, timeout=60)
    assert found["failed"] == "KeyError: 'gravity'"


@pytest.mark.parametrize("typed", [
    ["--cases", "sagging"], ["--programs", "abaqus"], ["--limit-s", "0"], ["--report"],
    ["--python", "no/such/python", "--programs", "mujoco"],
])
def test_nonsense_is_one_sentence_and_status_2(typed, capsys):
    assert peers.main(typed) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1


def test_the_runner_reads_and_writes_json():
    command = [sys.executable, str(BENCHMARKS / "peer_finqd.py")]
    done = subprocess.run(
        command, input=json.dumps(sag_task("tet4 4x1x1")), capture_output=True, text=True,
        env=peers.environment("finqd"),
    )
    found = json.loads(done.stdout)
    assert found["failed"] == "" and found["steps"] == 25 and found["first_s"] > 0.0
