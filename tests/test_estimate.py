"""The error estimate of one result: extrapolation and flags on made-up trajectories, and one real estimate."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from finqd import evaluate as pipeline
from finqd.data import designs_folder
from finqd.design import Design
from finqd.effects import EFFECTS, effects_of
from finqd.errors import InputError, MeshError
from finqd.estimate import (
    LEAST_RATIO,
    Companion,
    estimate_error,
    estimate_object,
    mesh_settings,
    richardson,
    step_settings,
)
from finqd.evaluate import evaluate
from finqd.plugins.fitness_share_held import ShareHeld
from finqd.plugins.mesher_swept import Swept
from finqd.plugins.mesher_tetrahedral import Tetrahedral
from finqd.protocol import GraspProtocol
from finqd.trajectory import Trajectory

MM = 1e-3
#: far too coarse, and over at once: what counts here is that everything runs
TINY = {
    "actuation.duration_s": 0.1, "protocol.close_s": 0.1, "protocol.squeeze_s": 0.0, "protocol.lift_s": 0.04,
    "protocol.lift_mm": 2.0, "protocol.hold_s": 0.0, "protocol.time_step_ms": 10.0, "mesher.size_mm": 5.0,
    "mesher.layers": 2,
}


def grasp(drop_mm: float = 1.0, forces=(2.0, 3.0, 5.0), *, status: str = "ok", steps: int = 100, **rest) -> Trajectory:
    return Trajectory(
        status=status, object_drop=drop_mm * MM, contact_forces=np.array([[0.0, 0.0, 0.0], forces]),
        times=np.array([0.0, 1.0]), counters={"steps": steps}, protocol=GraspProtocol(), **rest,
    )


def mesh(trajectory: Trajectory, ratio: float = 1.5) -> Companion:
    return Companion(level="coarser_mesh", trajectory=trajectory, ratio=ratio, order=1.0)


def step(trajectory: Trajectory, ratio: float = 2.0) -> Companion:
    return Companion(level="longer_step", trajectory=trajectory, ratio=ratio, order=1.0)


def estimated(base: Trajectory, *companions: Companion, fitness=None):
    return estimate_object("cube", base, companions, fitness or ShareHeld())


# -- extrapolation ---------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("ratio", [1.2, 1.5, 2.0, 1 / 1.5])
def test_the_extrapolation_is_exact_where_the_error_is_a_power(order, ratio):
    def value(size):
        return 7.0 + 0.3 * size**order

    difference = abs(value(4.0 * ratio) - value(4.0))
    assert richardson(ratio, order) * difference == pytest.approx(value(4.0) - 7.0, rel=1e-12)


def test_a_higher_order_than_assumed_makes_the_estimate_too_large_never_too_small():
    for true_order in (1.0, 1.5, 2.0, 4.0):
        assert richardson(1.5, 1.0) * (1.5**true_order - 1.0) >= 1.0 - 1e-12
        assert richardson(1 / 1.5, 1.0) * (1.0 - 1.5**-true_order) >= 1.0 - 1e-12


def test_levels_that_are_no_two_levels_give_no_number():
    assert all(math.isnan(richardson(ratio, 1.0)) for ratio in (1.0, 1.1, 1 / 1.1, math.nan))


def test_the_spread_is_the_sum_of_both_differences_extrapolated():
    found = estimated(grasp(1.0), mesh(grasp(1.5, (2.0, 2.0, 5.0))), step(grasp(0.8, (2.0, 3.0, 5.5))))
    assert found.force == pytest.approx((10.0, 1.0 / 0.5 + 0.5))
    assert found.drop == pytest.approx((1.0 * MM, (0.5 / 0.5 + 0.2) * MM))
    assert found.verdicts == {"base": "held", "coarser_mesh": "held", "longer_step": "held"}
    assert (found.uncertain, found.reason) == (False, "")
    assert found.to_dict()["drop_mm"] == pytest.approx([1.0, 1.2])
    assert found.to_dict()["force_N"] == pytest.approx([10.0, 2.5])


def test_differences_of_opposite_sign_do_not_cancel():
    layers = Companion(level="fewer_layers", trajectory=grasp(0.7), ratio=2.0, order=1.0)
    found = estimated(grasp(1.0), mesh(grasp(1.5), ratio=2.0), layers, step(grasp(0.5)))
    assert found.drop[1] == pytest.approx(1.3 * MM)


# -- what makes a verdict uncertain ----------------------------------------------------------------


def test_runs_that_agree_far_from_the_threshold_are_certain():
    assert not estimated(grasp(0.0), mesh(grasp(0.1)), step(grasp(0.1))).uncertain
    lost = estimated(grasp(30.0), mesh(grasp(30.2)), step(grasp(29.9)))
    assert not lost.uncertain and set(lost.verdicts.values()) == {"lost"}


@pytest.mark.parametrize("which", ["coarser mesh", "longer step"])
@pytest.mark.parametrize("ours, theirs", [("held", "lost"), ("lost", "held")])
def test_a_verdict_that_differs_is_uncertain(which, ours, theirs):
    drops = {"held": 1.0, "lost": 30.0}
    same, other = grasp(drops[ours]), grasp(drops[theirs])
    found = estimated(same, mesh(other if "mesh" in which else same), step(other if "step" in which else same))
    assert found.uncertain and found.reason.startswith(f"{ours}, but {theirs} with the {which}")


@pytest.mark.parametrize("drop, spread_says", [(9.0, True), (9.9, True), (10.5, True), (5.0, False), (20.0, False)])
def test_a_drop_whose_spread_reaches_over_the_threshold_is_uncertain(drop, spread_says):
    towards = 0.4 if drop < 10 else -0.4  # away from the threshold: the verdicts agree, the spread counts both ways
    found = estimated(grasp(drop), mesh(grasp(drop - towards), ratio=1.25), step(grasp(drop)))
    assert found.drop[1] == pytest.approx(1.6 * MM)
    assert len(set(found.verdicts.values())) == 1 and found.uncertain is spread_says
    assert not spread_says or "1.60 mm reaches over the threshold" in found.reason


def test_the_threshold_is_the_fitness_plugin_s_own():
    runs = grasp(9.0), mesh(grasp(8.6), ratio=1.25), step(grasp(9.0))
    assert estimated(*runs).uncertain
    assert not estimated(*runs, fitness=ShareHeld(drop_threshold_mm=20.0)).uncertain


def test_a_companion_that_failed_leaves_the_verdict_uncertain_and_no_number():
    found = estimated(grasp(1.0), mesh(grasp(1.0)), step(grasp(math.nan, status="diverged", reason="at t = 0.4 s")))
    assert found.uncertain and found.reason == "longer step: at t = 0.4 s"
    assert found.verdicts["longer_step"] == "diverged"
    assert found.to_dict()["drop_mm"] == [pytest.approx(1.0), None]
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False)) == found.to_dict()


def test_a_level_that_could_not_be_made_is_uncertain():
    missing = Trajectory(status="not_run", reason="no other mesh could be made: it failed")
    found = estimated(grasp(1.0), mesh(missing, ratio=math.nan), step(grasp(1.0)))
    assert found.uncertain and found.reason == "coarser mesh: no other mesh could be made: it failed"


def test_steps_that_did_not_get_longer_say_nothing():
    found = estimated(grasp(1.0), mesh(grasp(1.0)), step(grasp(1.0), ratio=1.02))
    assert found.uncertain and "longer step: is no other level" in found.reason and 1.02 < LEAST_RATIO


def test_a_result_that_failed_is_uncertain_but_no_room_is_no_room():
    failed = estimated(grasp(math.nan, status="timeout"))
    assert failed.uncertain and failed.verdicts == {"base": "timeout"} and failed.to_dict()["force_N"] == [None, None]
    assert not estimated(Trajectory(status="no_room")).uncertain


# -- the levels ------------------------------------------------------------------------------------


def test_every_number_of_elements_of_a_mesher_goes_with_its_size():
    assert mesh_settings(Swept(size_mm=4.0), 1.5) == {"mesher.size_mm": 6.0}
    full = mesh_settings(Swept(size_mm=2.0, layers=9, least_edges=3), 1.5)
    assert full == {"mesher.size_mm": 3.0, "mesher.least_edges": 2}, "layers are a level of their own"
    assert mesh_settings(Swept(layers=1), 1.5) == {"mesher.size_mm": 6.0}
    assert mesh_settings(Tetrahedral(size_mm=2.0), 2.0) == {"mesher.size_mm": 4.0}
    with pytest.raises(InputError, match="^the mesher has no option size_mm$"):
        mesh_settings(object(), 1.5)


@pytest.fixture(scope="module")
def plain():
    return evaluate(benchmark(), objects=["sphere", "disk"], overrides=TINY)


def benchmark() -> Design:
    return Design.from_json(designs_folder() / "benchmark.json")


def untimed(result: dict) -> str:
    rows = {name: {key: value for key, value in row.items() if key not in ("seconds", "estimate")}
            for name, row in result["objects"].items()}
    return json.dumps({**result, "objects": rows, "timings": None, "estimate": None}, allow_nan=False)


@pytest.mark.slow  # minutes; stand-ins say the same of all but the simulation
def test_a_real_estimate_leaves_the_result_alone_and_says_what_it_cost(plain):
    told: list[str] = []
    found = evaluate(
        benchmark(), objects=["sphere", "disk"], overrides=TINY, estimate_error=True,
        progress=lambda name, share: told.append(name),
    )
    result = found.to_dict()
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert "estimate" not in plain.to_dict() and "estimate" not in plain.to_dict()["objects"]["sphere"]
    assert untimed({**plain.to_dict(), "estimate": None}) == untimed({key: result[key] for key in
                                                                     [*plain.to_dict(), "estimate"]})
    whole = result["estimate"]
    assert whole["objects"] == 2 and whole["uncertain"] == sum(
        row["estimate"]["uncertain"] for row in result["objects"].values())
    name = next(iter(whole["levels"]))
    assert list(whole["levels"]) == [name, "fewer_layers", "longer_step"]
    assert whole["levels"]["fewer_layers"]["settings"] == {"mesher.layers": 1}
    level = whole["levels"][name]
    assert level["elements"] != sum(result["mesh"]["elements"].values())
    assert max(level["ratio"], 1 / level["ratio"]) >= LEAST_RATIO and (level["ratio"] > 1) == (name == "coarser_mesh")
    assert whole["levels"]["longer_step"]["settings"] == {"protocol.time_step_ms": 20.0}
    assert whole["seconds"].keys() == {"base", *whole["levels"]} and min(whole["seconds"].values()) > 0
    assert {"sphere", "disk", "sphere (longer step)", f"disk ({name.replace('_', ' ')})"} <= set(told)
    for row in result["objects"].values():
        estimate = row["estimate"]
        assert estimate["verdicts"].keys() == {"base", *whole["levels"]}
        assert estimate["force_N"][0] == pytest.approx(sum(row["final_contact_force_N"]))
        assert estimate["drop_mm"][0] == pytest.approx(row["drop_mm"])
        assert 0 < estimate["drop_mm"][1] < math.inf and estimate["force_N"][1] > 0


def test_an_estimate_of_an_evaluation_runs_each_companion_once_and_in_one_go(plain, monkeypatch):
    calls = []

    def run_grasps(tasks, **options):
        calls.append(list(tasks))
        return [replace(plain.trajectories[task.grasped.name], counters={"steps": 4}) for task in tasks]

    monkeypatch.setattr(pipeline, "run_grasps", run_grasps)
    estimate = estimate_error(plain, jobs=2)
    (tasks,) = calls
    assert len(tasks) == 6 and {task.grasped.name for task in tasks} == {"sphere", "disk"}
    of_sphere = [task for task in tasks if task.grasped.name == "sphere"]
    numbers = [(t.design.protocol.time_step_ms, t.design.plugin("mesher").size_mm, t.design.plugin("mesher").layers,
                sum(m.n_vertices for m in t.meshes) == plain.mesh["vertices"]) for t in of_sphere]
    (size,) = {n[1] for n in numbers} - {TINY["mesher.size_mm"]}
    assert numbers == [(10.0, size, 2, False), (10.0, 5.0, 1, False), (20.0, 5.0, 2, True)], "each in one thing only"
    assert estimate.objects["disk"].drop[1] == 0.0, "what does not change has no spread"


def test_a_mesh_that_cannot_be_made_coarser_or_finer_leaves_all_uncertain(plain, monkeypatch):
    mesh_solid = pipeline.mesh_solid

    def only_this_size(mesher, solid):
        if mesher.size_mm != TINY["mesher.size_mm"] or mesher.layers != TINY["mesher.layers"]:
            raise MeshError("the mesher gave up")
        return mesh_solid(mesher, solid)

    monkeypatch.setattr(pipeline, "mesh_solid", only_this_size)
    monkeypatch.setattr(pipeline, "run_grasps", lambda tasks, **_: [plain.trajectories[t.grasped.name] for t in tasks])
    estimate = estimate_error(plain)
    assert estimate.levels["coarser_mesh"]["reason"] == "no other mesh could be made: the mesher gave up"
    assert estimate.levels["fewer_layers"]["reason"] == "no other layers could be made: the mesher gave up"
    for one in estimate.objects.values():
        assert one.uncertain and "the mesher gave up" in one.reason and one.to_dict()["drop_mm"][1] is None


def test_a_mesh_that_failed_is_uncertain_and_runs_nothing(monkeypatch):
    def fail(mesher, solid):
        raise MeshError("flat")

    monkeypatch.setattr(pipeline, "mesh_solid", fail)
    found = evaluate(benchmark(), objects=["sphere"], overrides=TINY, estimate_error=True).to_dict()
    assert found["estimate"]["levels"] == {} and found["estimate"]["uncertain"] == 1
    assert found["objects"]["sphere"]["estimate"]["verdicts"] == {"base": "mesh_failed"}


def test_a_tolerance_of_the_stepper_is_loosened_with_the_step(plain, monkeypatch):
    seen = []
    monkeypatch.setattr(pipeline, "run_grasps", lambda tasks, **_: seen.extend(tasks) or
                        [plain.trajectories[t.grasped.name] for t in tasks])
    adaptive = replace(plain, design=plain.design.with_overrides({"stepper.error_tolerance_mm": 0.1}))
    estimate_error(adaptive)
    tolerances = {task.design.protocol.time_step_ms: task.design.plugin("stepper").error_tolerance_mm for task in seen}
    assert tolerances == {10.0: 0.1, 20.0: pytest.approx(0.4)}


def test_where_stability_sets_the_steps_they_are_halved():
    explicit = benchmark().with_overrides({"stepper": "explicit", "protocol.time_step_ms": 10})
    level, settings = step_settings(explicit)
    safety = explicit.plugin("stepper").safety
    assert level == "shorter_step" and settings == {"protocol.time_step_ms": 5.0, "stepper.safety": safety / 2}
    assert step_settings(benchmark())[0] == "longer_step"
    explicit.with_overrides(settings)


def test_objects_that_are_not_the_evaluation_s_are_refused(plain):
    with pytest.raises(InputError, match="^objects: these are not the objects of the evaluation$"):
        estimate_error(plain, objects=["cube"])


# -- effects ---------------------------------------------------------------------------------------


def effects(**plugins) -> dict[str, str]:
    return effects_of(benchmark().with_overrides(plugins))


def test_the_effects_are_those_of_the_plugins_in_use(monkeypatch):
    assert effects() == effects(stepper="implicit_euler", elasticity="corotated") == {
        name: effect.plain for name, effect in EFFECTS.items()
    }
    small = effects(elasticity="linear")
    assert small["large_rotation"] == "off: the elasticity linear"
    assert small["material_nonlinearity"] == "off: linear elasticity"
    assert effects(elasticity="neo_hookean")["large_rotation"] == "on: the elasticity neo_hookean"
    assert "corotated" not in effects(elasticity="neo_hookean")["material_nonlinearity"]
    still = effects(stepper="quasi_static")
    assert still["inertia"].startswith("off for the fingers") and "quasi_static" in still["damping"]
    second = effects(stepper="bdf2")
    assert second["inertia"] == EFFECTS["inertia"].plain and "Euler" not in second["damping"]
    monkeypatch.setattr(type(benchmark().plugin("contact")), "effects", {"friction": "off: oiled"}, raising=False)
    assert effects()["friction"] == "off: oiled" and effects().keys() == EFFECTS.keys()
