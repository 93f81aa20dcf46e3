"""Feature: the area that the three finger bases span."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from finqd.units import MM2

if TYPE_CHECKING:
    from finqd.design import Design
    from finqd.solid import Solid


@dataclass(frozen=True, kw_only=True)
class Workspace:
    """Area of the triangle between the three finger bases (the paper's first feature).

    Its value for the benchmark, 2078.46 mm^2 at 40 mm, shows that the paper's distance between fingers is a
    circumradius.
    """

    names: ClassVar[tuple[str, ...]] = ("workspace_mm2",)

    def measure(self, design: Design, solids: Sequence[Solid]) -> dict[str, float]:
        """Return the area [mm^2]; the solids do not matter."""
        return {"workspace_mm2": design.workspace / MM2}
