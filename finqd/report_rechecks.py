"""What rechecks of elites say of a map (`finqd.trust`), as its page shows it."""

from __future__ import annotations

from typing import Any

SHOWN = ("rechecks", "failed", "objective", "success", "keeps", "flips")  # of an elite


def rechecks_of(run: Any) -> dict[str, Any] | None:
    """Return what the rechecks of a run found, of those by the scheme that was used last, or None if there are none.

    ``elites``: index -> what is shown of an elite that was rechecked; ``raw`` and ``corrected``: QD score and coverage
    of those; ``objects``: verdicts of each object, pooled over the elites; ``definition``: what all of that means.
    """
    if not run.rechecks():
        return None
    from finqd.recheck import trust_of
    from finqd.trust import DEFINITION

    found = trust_of(run)
    assert found is not None  # there are rows
    told = found.to_dict()
    return {
        "definition": DEFINITION, "rows": len(run.rechecks()), "count": found.rechecks, "complete": found.complete,
        "ranges": told["scheme"].get("ranges", {}), "raw": told["raw"], "corrected": told["corrected"],
        "elites": {
            str(one["index"]): {key: one[key] for key in SHOWN}
            for one in told["elites"] if one["rechecks"]
        },
        "of": len(told["elites"]), "objects": told["objects"],
    }  # fmt: skip
