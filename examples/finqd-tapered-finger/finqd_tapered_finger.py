"""A finger for finqd that is not a fin ray: a solid wedge, wide at its base and narrow at its tip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Le

from finqd.contracts import Parameter
from finqd.errors import InputError
from finqd.solid import Prism
from finqd.units import MM


@dataclass(frozen=True, kw_only=True)
class Tapered:
    """Solid tapered finger; its contact face is perpendicular to the base.

    thickness_mm: along the direction in which the profile is extruded, the same for all fingers
    """

    thickness_mm: Annotated[float, Ge(5), Le(50)] = 20.0

    finger_parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(name="length", unit="mm", low=60, high=120, allowed_low=20, allowed_high=200,
                  description="from the base to the tip"),
        Parameter(name="base_width", unit="mm", low=8, high=25, allowed_low=4, allowed_high=60,
                  description="of the profile where it is clamped"),
        Parameter(name="tip_width", unit="mm", low=2, high=8, allowed_low=1, allowed_high=60,
                  description="of the profile at its free end"),
    )

    def check(self, finger: Mapping[str, float]) -> str | None:
        """Return None, or one sentence if the finger widens towards its tip."""
        if finger["tip_width"] > finger["base_width"]:
            return "tip_width_mm must not exceed base_width_mm"
        return None

    def build(self, finger: Mapping[str, float]) -> Prism:
        """Return the finger: base in y = 0, contact face in x = 0."""
        if sentence := self.check(finger):
            raise InputError(sentence)
        length, base, tip = finger["length"], finger["base_width"], finger["tip_width"]
        return Prism(
            outer=np.array([(0.0, 0.0), (base, 0.0), (tip, length), (0.0, length)]),
            holes=(),
            thickness=self.thickness_mm * MM,
            contact_line=np.array([(0.0, 0.0), (0.0, length)]),
        )
