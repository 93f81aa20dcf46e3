"""Actuation ``translate``: every finger base moves towards the axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le

from finqd.scene import Motion, Shift
from finqd.units import MM


@dataclass(frozen=True, kw_only=True)
class Translate:
    """Shifts each finger towards the axis, eased, and stalls at a contact force; options as those of ``rotate``."""

    stroke_mm: Annotated[float, Ge(-100), Le(100)] = 10.0
    duration_s: Annotated[float, Gt(0), Le(60)] = 1.0
    force_limit_N: Annotated[float, Gt(0), Le(1e6)] = 5.0

    def motions(self, placements: Sequence[np.ndarray]) -> list[Motion]:
        """Return one drive a finger; see `finqd.contracts.Actuation`."""
        return [
            Motion(
                path=Shift(vector=-self.stroke_mm * MM * pose[:3, 0]), duration=self.duration_s,
                force_limit=self.force_limit_N,
            )
            for pose in placements
        ]
