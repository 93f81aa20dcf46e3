"""The table of algorithms: each keeps to the unit cube, repeats itself by its seed, and survives failures."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from finqd import archive as qd
from finqd.algorithms import ALGORITHMS, new_scheduler

RANGES = {"x": (0.0, 1.0), "y": (0.0, 1.0)}


def searched(name, objective, *, rounds, batch, n, seed=0):
    """Run a search of a function of the unit vector whose first two entries are the features; return all it asked."""
    archive = qd.new_archive(n, RANGES, cells=6, seed=np.random.SeedSequence(seed, spawn_key=(0,)))
    scheduler = new_scheduler(name, archive, batch, np.random.SeedSequence(seed, spawn_key=(1,)))
    asked = []
    for number in range(rounds):
        units = scheduler.ask()
        assert units.shape == (batch, n) and np.all((units >= 0.0) & (units <= 1.0))
        asked.append(units)
        records = [
            {"index": batch * number + i, "status": "ok", "objective": objective(u), "unit": u,
             "features": {"x": u[0], "y": u[1]}} for i, u in enumerate(units)
        ]  # fmt: skip
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".* was empty before adding solutions")
            qd.tell(scheduler, records, RANGES)
    return np.concatenate(asked), archive


def hill(unit):
    return 1.0 - float(np.mean((unit[2:] - 0.8) ** 2))


@pytest.mark.parametrize("name", list(ALGORITHMS))
def test_it_keeps_to_the_cube_and_repeats_itself(name):
    one, archive = searched(name, hill, rounds=12, batch=6, n=5, seed=3)
    same, _ = searched(name, hill, rounds=12, batch=6, n=5, seed=3)
    other, _ = searched(name, hill, rounds=12, batch=6, n=5, seed=4)
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other) and len(np.unique(one, axis=0)) == len(one) and len(archive) > 8


def test_searching_beats_sampling_on_a_smooth_hill():
    """By the mean objective of the elites; else something is wired wrongly.

    Which of them fills a map best is for benchmarks to say: by QD score, on the stand-in, not all of them do.
    """
    scores = {
        name: float(searched(name, hill, rounds=40, batch=20, n=10)[1].stats.obj_mean) for name in ALGORITHMS
    }
    assert min(scores[name] for name in ("cma_me", "cma_mae", "map_elites")) > scores["sobol"], scores


@pytest.mark.parametrize("name", list(ALGORITHMS))
def test_the_map_keeps_of_each_cell_the_best_and_of_equal_ones_the_first(name):
    units, archive = searched(name, lambda unit: round(hill(unit), 1), rounds=20, batch=8, n=4)
    best: dict[int, tuple[float, int]] = {}
    for index, unit in enumerate(units):
        cell = int(archive.index_of_single(unit[:2]))
        if cell not in best or round(hill(unit), 1) > best[cell][0]:
            best[cell] = (round(hill(unit), 1), index)
    data = archive.data(["index", "evaluation"])
    found = dict(zip(data["index"].tolist(), data["evaluation"].tolist()))
    assert found == {cell: index for cell, (_, index) in best.items()}
