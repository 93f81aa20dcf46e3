"""How often screening and confirmation disagree: what a search with two presets found out about the cheaper one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Counts over the designs that were screened and confirmed.

    screened, confirmed: designs; verdicts, flips: objects that both simulated, and those held in one only; entered:
    confirmed designs that did enter the map, as their screening had promised of all; lost: that failed in
    confirmation. What screening rejects is not confirmed, so nothing is known of good designs that it missed.
    """

    screened: int
    confirmed: int
    verdicts: int
    flips: int
    entered: int
    lost: int

    def sentence(self) -> str:
        """Return that in words."""
        share = f"{100 * self.flips / self.verdicts:.1f} %" if self.verdicts else "none"
        return (
            f"screening: {self.confirmed} of {self.screened} designs confirmed; {self.flips} of {self.verdicts} "
            f"verdicts on objects differ ({share}); {self.entered} of {self.confirmed} entered the map as screening "
            f"promised, {self.lost} failed; what screening rejects is not confirmed, so what it misses is not known"
        )


def agreement(records: Sequence[dict[str, Any]], entered: Sequence[int]) -> Agreement | None:
    """Return how screening and confirmation agree, None without screening; ``entered``: indices that entered."""
    pairs = [record for record in records if record["screen"] is not None]
    verdicts = flips = 0
    for record in pairs:
        for name, row in record["objects"].items():
            other = record["screen"]["objects"].get(name, {})
            if row.get("status") == other.get("status") == "ok":
                verdicts += 1
                flips += row["held"] != other["held"]
    inside = set(entered)
    return Agreement(
        screened=len(records), confirmed=len(pairs), verdicts=verdicts, flips=flips,
        entered=sum(record["index"] in inside for record in pairs), lost=sum(r["status"] != "ok" for r in pairs),
    )  # fmt: skip
