"""How fitness goes with each parameter, over all designs of a search that were evaluated.

Two numbers a parameter, both on ranks, so that any steady rise or fall counts whatever its shape:

- Spearman's rank correlation: how far the order by this parameter is the order by fitness;
- the coefficient in a linear regression of the fitness ranks on the ranks of all parameters, each in standard
  deviations (SRRC): the same with the other parameters held, as far as a linear model can.

Ranked is the objective, which is the fitness with the margin as tie-breaker: fitness alone has few levels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

METHOD = (
    "Spearman's rank correlation of each parameter with the fitness (ties broken by the margin), over all designs that "
    "were evaluated; and standardised rank regression coefficients (SRRC): the same in one linear model of all "
    "parameters together."
)
NOTES = (
    "A value near 0 does not mean that the parameter is without effect: what first helps and then harms, or acts only "
    "together with another parameter, is not seen.",
    "A search does not sample evenly: it crowds around what is good, and there parameters move together. Only a run by "
    "sobol, whose designs are spread evenly, speaks for the whole space.",
    "It says what goes together in this run, not what causes what.",
)
#: designs a coefficient, from which on a regression is worth looking at
DESIGNS_A_COEFFICIENT = 3


def sensitivity(records: Sequence[Mapping[str, Any]], paths: Sequence[str]) -> dict[str, Any]:
    """Return the sensitivity of fitness to each parameter (``paths``), the strongest correlation first.

    A row has ``rank_correlation`` and ``regression`` in [-1, 1] (the latter nearly), None where there is none to give.
    ``chance``: a correlation of unrelated numbers stays within +-chance in 95 of 100 cases; ``explained``: the share of
    the ranks' variance that the regression explains (R^2, adjusted for the number of coefficients). ``missing`` says in
    one sentence why there is nothing to see.
    """
    usable = [r for r in records if r["status"] == "ok" and len(r["parameters"]) == len(paths)]
    found: dict[str, Any] = {"method": METHOD, "notes": list(NOTES), "designs": len(usable), "rows": [],
                             "chance": None, "explained": None, "missing": ""}  # fmt: skip
    values = np.array([list(r["parameters"].values()) for r in usable], dtype=float).reshape(len(usable), len(paths))
    objective = np.array([r["objective"] for r in usable], dtype=float)
    if len(usable) < 4:
        return {**found, "missing": f"{len(usable)} designs were evaluated; a correlation needs at least 4"}
    if np.ptp(objective) == 0.0:
        return {**found, "missing": "all designs are equally good, so that nothing can go with the fitness"}
    ranks, target = _standard_ranks(values), _standard_ranks(objective[:, None])[:, 0]
    correlation = ranks.T @ target / len(usable)
    regression, explained = _regression(ranks, target)
    varies = np.ptp(values, axis=0) > 0.0
    found["rows"] = [
        {"path": path, "rank_correlation": float(c) if moves else None,
         "regression": float(b) if moves and b is not None else None}
        for path, c, b, moves in zip(paths, correlation, regression, varies, strict=True)
    ]  # fmt: skip
    found["rows"].sort(key=lambda row: -abs(row["rank_correlation"] or 0.0))
    return {**found, "chance": 1.96 / np.sqrt(len(usable) - 1), "explained": explained}


def _standard_ranks(columns: np.ndarray) -> np.ndarray:
    """Return the ranks of each column (equal values share theirs), shifted and scaled to mean 0 and variance 1."""
    from scipy.stats import rankdata

    ranks = rankdata(columns, axis=0)
    ranks -= ranks.mean(axis=0)
    spread = ranks.std(axis=0)
    return np.divide(ranks, spread, out=np.zeros_like(ranks), where=spread > 0.0)


def _regression(ranks: np.ndarray, target: np.ndarray) -> tuple[Sequence[float | None], float | None]:
    """Return a coefficient for each column and the adjusted R^2; nothing where there are too few designs."""
    varies = ranks.any(axis=0)
    n, k = len(target), int(varies.sum())
    if k == 0 or n < DESIGNS_A_COEFFICIENT * (k + 1):
        return [None] * ranks.shape[1], None
    solved, _, rank, _ = np.linalg.lstsq(ranks[:, varies], target, rcond=None)
    if rank < k:  # parameters that moved as one cannot be told apart
        return [None] * ranks.shape[1], None
    coefficients = np.zeros(ranks.shape[1])
    coefficients[varies] = solved
    unexplained = float(np.mean((target - ranks @ coefficients) ** 2))
    return coefficients.tolist(), 1.0 - unexplained * (n - 1) / (n - k - 1)
