"""`finqd.perturbations` and `finqd.trust`: what a recheck varies, and what its rows say of a map."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from finqd.archive import new_archive, objective
from finqd.data import designs_folder
from finqd.design import Design
from finqd.errors import InputError
from finqd.perturbations import ADDED, ALLOWED, NORMAL, PATHS, RANGES, Scheme, interval, perturbed
from finqd.trust import Share, trust

NAMES = ("a", "b", "c", "d")
AXES = {"x": (0.0, 1.0), "y": (0.0, 1.0)}


@pytest.fixture(scope="module")
def benchmark():
    return Design.from_json(designs_folder() / "benchmark.json")


# what is varied -------------------------------------------------------------------------------------------------------


def test_every_quantity_has_a_range_within_what_is_allowed_around_what_changes_nothing():
    assert set(RANGES) == set(ALLOWED) == set(PATHS)
    for name, (low, high) in RANGES.items():
        assert ALLOWED[name][0] <= low <= (0.0 if name in ADDED else 1.0) <= high <= ALLOWED[name][1]


@settings(deadline=None)
@given(st.integers(1, 40), st.integers(0, 3))
def test_more_rechecks_go_on_where_fewer_ended(count, seed):
    assert Scheme(seed=seed).draw(64)[:count] == Scheme(seed=seed).draw(count)


def test_draws_follow_their_declared_laws():
    points = Scheme(seed=3).draw(1024)
    for name, (low, high) in RANGES.items():
        column = np.sort([point[name] for point in points])
        assert low <= column[0] and column[-1] <= high
        share = (column - low) / (high - low)
        expected = (ndtr(4 * share - 2) - ndtr(-2)) / (ndtr(2) - ndtr(-2)) if name in NORMAL else share
        np.testing.assert_allclose(expected, (np.arange(1024) + 0.5) / 1024, atol=2 / 1024)


def test_seeds_differ_and_what_is_left_out_changes_nothing_else():
    assert Scheme(seed=0).draw(4) != Scheme(seed=1).draw(4)
    fewer = Scheme(seed=0, ranges={"friction": None, "mesh_size": (0.9, 1.1)}).draw(4)
    for all_of_it, some in zip(Scheme(seed=0).draw(4), fewer):
        assert "friction" not in some and some["stiffness"] == all_of_it["stiffness"]
        assert some["mesh_size"] != all_of_it["mesh_size"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"seed": -1}, "seed: must be a whole number from 0 upwards, got -1"),
        ({"ranges": {"mu": (1, 2)}}, "ranges.mu: nothing of this name is varied; known: friction, offset_x_mm,"),
        ({"ranges": {"friction": (1.2, 0.8)}}, "must be a low and a high number within 0.01 to 10, not 1.2 to 0.8"),
        ({"ranges": {"turn_deg": (0, 500)}}, "must be a low and a high number within -360 to 360, not 0 to 500"),
        ({"ranges": {"time_step": (float("nan"), 1)}}, "must be a low and a high number within 0.01 to 10, not nan"),
    ],
)
def test_a_bad_scheme_gets_one_sentence(options, sentence):
    with pytest.raises(InputError) as error:
        Scheme(**options)
    assert sentence in str(error.value)


def test_a_perturbation_of_nothing_is_the_very_same_design(benchmark):
    assert perturbed(benchmark, {}, preset="draft") is benchmark
    nothing = {name: 0.0 if name in ADDED else 1.0 for name in RANGES}
    assert perturbed(benchmark, nothing, preset="draft") is benchmark
    still = Scheme(ranges={name: (value, value) for name, value in nothing.items()})
    assert still.draw(3) == [nothing] * 3


@pytest.mark.parametrize("preset", ["draft", "standard", "paper"])
def test_each_quantity_changes_its_values_and_nothing_else(benchmark, preset):
    from finqd.presets import apply_preset

    design = benchmark.with_overrides({"protocol.friction_finger_floor": 0.2})
    before = apply_preset(design, preset).resolved()
    change = {"friction": 1.1, "offset_x_mm": 2.0, "offset_y_mm": -1.0, "turn_deg": 5.0, "stiffness": 0.9,
              "time_step": 0.5, "mesh_size": 1.1}
    after = apply_preset(perturbed(design, change, preset=preset), preset).resolved()
    expected = {"protocol.friction_coefficient": 0.6 * 1.1, "protocol.friction_finger_floor": 0.2 * 1.1,
                "protocol.object_offset_x_mm": 2.0, "protocol.object_offset_y_mm": -1.0,
                "protocol.object_turn_deg": 5.0, "material.youngs_modulus_MPa": 11.6 * 0.9,
                "protocol.time_step_ms": before["protocol"]["time_step_ms"] * 0.5,
                "mesher.size_mm": before["mesher"]["size_mm"] * 1.1}
    for path, value in expected.items():
        section, key = path.split(".")
        assert after[section].pop(key) == pytest.approx(value)
        before[section].pop(key)
    assert after == before


def test_a_perturbation_out_of_what_a_design_may_hold_is_one_sentence(benchmark):
    slippery = benchmark.with_overrides({"protocol.friction_coefficient": 5.0})
    with pytest.raises(InputError, match="recheck of benchmark: protocol.friction_coefficient: must be a number"):
        perturbed(slippery, {"friction": 1.1}, preset="draft")


def test_intervals_are_wilsons():
    z, n, k = 1.959963984540054, 20, 7
    centre = (k + z * z / 2) / (n + z * z)
    half = z / (n + z * z) * (k * (n - k) / n + z * z / 4) ** 0.5
    assert interval(k, n) == pytest.approx((centre - half, centre + half), abs=1e-12)
    assert interval(0, 0) == (0.0, 1.0) and interval(0, 5)[0] == 0.0 and interval(5, 5)[1] == 1.0


# what rows say --------------------------------------------------------------------------------------------------------

SCHEME = Scheme(seed=0).to_dict()


def record(index, held, x, y=0.55, **more):
    fitness, margin = sum(held) / len(NAMES), 0.5
    return {"index": index, "status": "ok", "fitness": fitness, "margin": margin, "features": {"x": x, "y": y},
            "objective": objective(fitness, margin, len(NAMES)),
            "objects": {name: {"held": bool(one)} for name, one in zip(NAMES, held)}, **more}


def row(index, number, held, x, **more):
    return {**record(index, held, x), "number": number, "scheme": SCHEME, **more}


def told(elites, rows, count=2):
    archive = new_archive(3, AXES, cells=10, seed=np.random.SeedSequence(0))
    cells = archive.int_to_grid_index(archive.index_of([list(one["features"].values()) for one in elites])).tolist()
    places = [(tuple(cell), one) for cell, one in zip(cells, elites)]
    return trust(places, rows, archive=archive, features=tuple(AXES), scheme=SCHEME, count=count)


def test_rechecks_that_give_the_same_give_the_raw_numbers_to_the_last_bit():
    elites = [record(i, [1, 1, i % 2, 0], x=0.1 + 0.1 * i) for i in range(7)]
    found = told(elites, [row(one["index"], k, [1, 1, one["index"] % 2, 0], one["features"]["x"])
                          for one in elites for k in range(3)], count=3)
    assert found.complete and found.raw == found.corrected
    assert found.raw == {"qd_score": pytest.approx(sum(one["objective"] for one in elites)), "coverage": 0.07}
    assert all(one.corrected == one.raw and one.success.rate == one.fitness for one in found.elites)
    assert all(one.keeps.rate == 1.0 and one.flips.rate == 0.0 for one in found.elites)


def test_scores_flips_and_success_by_hand():
    elites = [record(0, [1, 1, 0, 0], x=0.15), record(1, [1, 1, 1, 1], x=0.35)]
    rows = [row(0, 0, [1, 0, 0, 0], 0.15), row(0, 1, [1, 1, 1, 0], 0.15),
            row(1, 0, [1, 1, 1, 0], 0.35), row(1, 1, [0, 0, 0, 0], 0.35, status="timeout")]
    found = told(elites, rows)
    first, second = found.elites
    assert first.keeps == Share(part=1, whole=2) and first.success == Share(part=4, whole=8)
    assert first.flips == Share(part=2, whole=8)
    assert first.corrected == pytest.approx((objective(0.25, 0.5, 4) + objective(0.75, 0.5, 4)) / 2)
    assert (first.fitness, second.fitness, second.failed) == (0.5, 0.375, 1)
    assert second.keeps == Share(part=0, whole=2) and second.success == Share(part=3, whole=8)
    assert second.flips == Share(part=5, whole=8)
    assert {one.name: one.held.part for one in found.objects} == {"a": 3, "b": 2, "c": 2, "d": 0}
    assert {one.name: one.flips.part for one in found.objects} == {"a": 1, "b": 2, "c": 2, "d": 2}
    assert found.corrected["qd_score"] == pytest.approx(first.corrected + second.corrected)
    assert found.raw["coverage"] == found.corrected["coverage"] == 0.02


def test_elites_move_with_their_mean_features_and_the_better_mean_stays():
    elites = [record(0, [1, 1, 1, 0], x=0.15), record(1, [1, 1, 0, 0], x=0.25), record(2, [1, 0, 0, 0], x=0.85)]
    rows = [row(0, 0, [1, 1, 0, 0], 0.25), row(0, 1, [1, 1, 0, 0], 0.25),  # both in the second cell now
            row(1, 0, [1, 0, 0, 0], 0.21), row(1, 1, [1, 0, 0, 0], 0.29),
            row(2, 0, [0] * 4, 0.85, status="crash"), row(2, 1, [0] * 4, 0.85, status="timeout")]
    found = told(elites, rows)
    assert found.raw["coverage"] == 0.03 and found.corrected["coverage"] == 0.01
    assert found.corrected["qd_score"] == pytest.approx(objective(0.5, 0.5, 4))
    assert found.elites[2].failed == 2 and found.elites[2].corrected == 0.0


def test_rows_of_another_scheme_or_beyond_the_count_are_not_counted_and_what_is_missing_is_said():
    elites = [record(0, [1, 1, 1, 0], x=0.15), record(1, [1, 1, 0, 0], x=0.25)]
    rows = [row(0, 0, [1, 1, 1, 0], 0.15), row(0, 5, [0] * 4, 0.15),
            row(1, 0, [0] * 4, 0.25, scheme=Scheme(seed=1).to_dict())]
    found = told(elites, rows)
    assert not found.complete and [one.rechecks for one in found.elites] == [1, 0]
    assert found.raw == found.corrected and found.raw["coverage"] == 0.01  # of the same elites: those rechecked
    assert found.elites[1].success.rate is None and found.elites[1].success.interval == (0.0, 1.0)


def test_rows_come_in_any_order():
    elites = [record(0, [1, 1, 1, 0], x=0.15)]
    rng = np.random.default_rng(0)
    rows = [row(0, k, rng.integers(0, 2, 4), 0.15 + 0.001 * rng.random()) for k in range(16)]
    assert told(elites, rows, 16).to_dict() == told(elites, rows[::-1], 16).to_dict()


def test_a_known_rate_of_flips_lies_within_its_interval_as_often_as_it_should():
    """A stand-in whose verdicts flip with probability 0.2: 200 intervals, of 60 trials each: 96.6 % should hold it."""
    rng, raw = np.random.default_rng(7), [1, 0, 1, 0]
    elites = [record(i, raw, x=0.05 + 0.018 * i) for i in range(50)]
    rows = [row(one["index"], k, np.array(raw) ^ (rng.random(4) < 0.2), one["features"]["x"])
            for one in elites for k in range(60)]
    found = told(elites, rows, 60)
    flips = [one.flips.interval for elite in found.elites for one in elite.objects]
    held = [(one.held.interval, 0.8 if one.raw else 0.2) for elite in found.elites for one in elite.objects]
    assert 0.92 < np.mean([low < 0.2 < high for low, high in flips]) < 1.0
    assert 0.92 < np.mean([low < rate < high for (low, high), rate in held]) < 1.0
    assert all(one.flips.whole == 3000 and one.flips.rate == pytest.approx(0.2, abs=0.03) for one in found.objects)
