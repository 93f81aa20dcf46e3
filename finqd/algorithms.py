"""The algorithms that a search can use, all from ``ribs``: a small table, over a unit cube of any dimension.

What they share: steps outside the cube are folded back at its faces; the map is elitist (``learning_rate`` 1), so that
what an algorithm does inside does not change what a map is; everything random follows from one seed.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.archive import THRESHOLD_MIN

if TYPE_CHECKING:
    from ribs.archives import GridArchive
    from ribs.schedulers import Scheduler

SIGMA0 = 0.2  # of the unit cube's edge: larger steps mostly leave it
ISO_SIGMA, LINE_SIGMA = 0.02, 0.2  # of MAP-Elites: isotropic noise, and along the line between two elites
LEARNING_RATE = 0.01  # of CMA-MAE: how fast a cell's threshold follows what falls into it


@dataclass(frozen=True)
class Algorithm:
    """One row of the table.

    emitter: makes a ``ribs`` emitter of (archive, batch, seed); learning_rate: of the archive that it searches with,
    which is the map itself where it is 1; restarts: whether it must begin anew while the map is empty
    """

    description: str
    emitter: Callable[[Any, int, np.random.SeedSequence], Any]
    learning_rate: float = 1.0
    restarts: bool = True


def new_scheduler(name: str, archive: GridArchive, batch: int, seed: np.random.SeedSequence) -> Scheduler:
    """Return a scheduler of one emitter that fills ``archive``, an elitist map."""
    from ribs.schedulers import Scheduler

    algorithm, searched = ALGORITHMS[name], archive
    if algorithm.learning_rate != 1.0:
        searched = _softened(archive, algorithm.learning_rate, _child(seed, 0))
    with np.errstate(invalid="ignore"):  # ribs divides 0 by 0 for a batch of one, and never uses the result
        emitter = algorithm.emitter(searched, batch, seed)
    result = {} if searched is archive else {"result_archive": archive}
    # Added one by one: for a batch, a finite threshold_min makes a cell's threshold the mean of all that fell into it,
    # and then a later, worse design replaces its elite.
    return Scheduler(searched, [emitter], add_mode="single", **result)


def reflected(points: np.ndarray) -> np.ndarray:
    """Return points folded into the unit cube at its faces, as often as it takes.

    >>> reflected(np.array([0.3, -0.2, 1.25, 2.5])).round(12).tolist()
    [0.3, 0.2, 0.75, 0.5]
    """
    folded = np.mod(points, 2.0)
    return np.where(folded > 1.0, 2.0 - folded, folded)


def _softened(archive: GridArchive, learning_rate: float, seed: np.random.SeedSequence) -> GridArchive:
    """Return an empty archive of the same cells whose thresholds follow slowly."""
    from ribs.archives import GridArchive

    return GridArchive(
        solution_dim=archive.solution_dim, dims=archive.dims, seed=seed,
        ranges=list(zip(archive.lower_bounds, archive.upper_bounds)), learning_rate=learning_rate,
        threshold_min=THRESHOLD_MIN, extra_fields={"evaluation": ((), np.int64)},
    )  # fmt: skip


def _cma(ranker: str, **options: Any) -> Callable[[Any, int, np.random.SeedSequence], Any]:
    def emitter(archive: Any, batch: int, seed: np.random.SeedSequence) -> Any:
        from ribs.emitters import EvolutionStrategyEmitter

        start = np.full(archive.solution_dim, 0.5)
        return _reflecting(EvolutionStrategyEmitter)(
            archive, x0=start, sigma0=SIGMA0, ranker=ranker, batch_size=batch, seed=seed, **options
        )

    return emitter


def _iso_line(archive: Any, batch: int, seed: np.random.SeedSequence) -> Any:
    """Begin with uniform designs, then vary elites; ribs returns the first ones for as long as the map is empty."""
    from ribs.emitters import IsoLineEmitter

    first = np.random.default_rng(_child(seed, 1)).random((batch, archive.solution_dim))
    return _reflecting(IsoLineEmitter)(
        archive, iso_sigma=ISO_SIGMA, line_sigma=LINE_SIGMA, initial_solutions=first, batch_size=batch, seed=seed
    )


def _sobol(archive: Any, batch: int, seed: np.random.SeedSequence) -> Any:
    from ribs.emitters import EmitterBase
    from scipy.stats import qmc

    points = qmc.Sobol(archive.solution_dim, scramble=True, seed=np.random.default_rng(seed))

    class Sobol(EmitterBase):
        """Asks for a scrambled Sobol sequence, and learns nothing."""

        batch_size = batch

        def ask(self) -> np.ndarray:
            with warnings.catch_warnings():  # scipy tells that only a power of two of points is balanced
                warnings.simplefilter("ignore", UserWarning)
                return points.random(batch)

    return Sobol(archive, solution_dim=archive.solution_dim, bounds=None, lower_bounds=None, upper_bounds=None)


def _reflecting(emitter: type) -> type:
    """Return the emitter folding what lies outside the cube back; ribs' own bounds draw again, without end."""

    class Reflecting(emitter):  # type: ignore[misc]
        """Asks within the cube."""

        def ask(self) -> np.ndarray:
            return reflected(super().ask())

    return Reflecting


def _child(seed: np.random.SeedSequence, number: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, number))


ALGORITHMS: dict[str, Algorithm] = {
    "cma_me": Algorithm("CMA-ME (arXiv:1912.02400): one CMA-ES, two-stage improvement ranking", _cma("2imp")),
    "cma_mae": Algorithm(
        f"CMA-MAE (arXiv:2205.10752): one CMA-ES, improvement ranking, learning rate {LEARNING_RATE}",
        _cma("imp", selection_rule="mu", restart_rule="basic"), learning_rate=LEARNING_RATE,
    ),
    "map_elites": Algorithm("MAP-Elites, iso+line variation (arXiv:1804.03906) of elites", _iso_line),
    "sobol": Algorithm("scrambled Sobol sequence: the baseline, no search at all", _sobol, restarts=False),
}  # fmt: skip
