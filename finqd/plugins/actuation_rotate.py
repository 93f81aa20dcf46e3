"""Actuation ``rotate``: every finger base turns about its inner edge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le

from finqd.scene import Motion, Turn
from finqd.units import DEG


@dataclass(frozen=True, kw_only=True)
class Rotate:
    """Turns each finger towards the axis about the inner edge of its base, eased, and stalls at a contact force.

    angle_deg: stroke; duration_s: of the unhindered stroke; force_limit_N: sum of the normal contact forces on one
    finger at which its drive stalls (a drive slows down linearly over the last fifth before it, and never runs back)
    """

    angle_deg: Annotated[float, Ge(-90), Le(90)] = 30.0
    duration_s: Annotated[float, Gt(0), Le(60)] = 1.0
    force_limit_N: Annotated[float, Gt(0), Le(1e6)] = 5.0

    def motions(self, placements: Sequence[np.ndarray]) -> list[Motion]:
        """Return one drive a finger; see `finqd.contracts.Actuation`."""
        return [
            Motion(
                path=Turn(point=pose[:3, 3], axis=pose[:3, 2], angle=self.angle_deg * DEG), duration=self.duration_s,
                force_limit=self.force_limit_N,
            )
            for pose in placements
        ]
