"""The fin ray finger: a triangle of thin walls with ribs across."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Le

from finqd.contracts import Parameter
from finqd.errors import InputError
from finqd.plugins.fin_ray_patches import patches
from finqd.plugins.fin_ray_profile import BACK, BASE, CONTACT, Shape, cavity, holes
from finqd.solid import Prism, ring_area
from finqd.units import MM

_NARROWEST_GAP = 0.2 * MM  # between two ribs
_SMALLEST_CAVITY = 1e-6  # [m^2]


@dataclass(frozen=True, kw_only=True)
class FinRay:
    """Fin ray finger: contact wall, back wall, base plate, solid tip and ribs that cross the cavity between them.

    ``profile``: ``isosceles`` (both walls lean) or ``right`` (the contact face is perpendicular to the base).
    Wall thickness is measured perpendicular to the wall. Ribs are strips of ``rib_thickness`` around centres at
    rib_count + 1 equal pitches between the base plate and the tip line, on the line from the base's middle to the apex;
    ``rib_angle`` turns each about its centre (positive: back end towards the tip), and the cavity clips it. Where the
    walls meet below the tip line, the cavity ends there, and with it the ribs.
    """

    profile: Literal["isosceles", "right"] = "isosceles"
    base_plate_mm: Annotated[float, Ge(0.5), Le(20)] = 2.0

    finger_parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(name="length", unit="mm", low=90, high=120, allowed_low=40, allowed_high=300, symbol="H",
                  description="from the base to the apex"),
        Parameter(name="width", unit="mm", low=28, high=40, allowed_low=10, allowed_high=150, symbol="L",
                  description="base of the triangle"),
        Parameter(name="thickness", unit="mm", low=20, high=35, allowed_low=5, allowed_high=100, symbol="W",
                  description="depth of the extrusion"),
        Parameter(name="tip_length", unit="mm", low=20, high=30, allowed_low=5, allowed_high=60, symbol="L_tip",
                  description="solid part below the apex"),
        Parameter(name="contact_wall", unit="mm", low=1, high=3, allowed_low=0.4, allowed_high=10, symbol="t_flex",
                  description="thickness of the wall that touches the object"),
        Parameter(name="back_wall", unit="mm", low=1, high=3, allowed_low=0.4, allowed_high=10, symbol="t_back",
                  description="thickness of the wall behind"),
        Parameter(name="rib_count", unit="", low=1, high=10, allowed_low=0, allowed_high=30, integer=True, symbol="N",
                  description="number of ribs"),
        Parameter(name="rib_thickness", unit="mm", low=1, high=3, allowed_low=0.4, allowed_high=10, symbol="t_rib",
                  description="thickness of a rib"),
        Parameter(name="rib_angle", unit="deg", low=-40, high=40, allowed_low=-60, allowed_high=60, symbol="D_angle",
                  description="tilt of the ribs; positive lifts their back end"),
    )

    def check(self, finger: Mapping[str, float]) -> str | None:
        """Return None, or one sentence saying which values contradict each other (``finqd.contracts.Geometry``)."""
        shape = self._shape(finger)
        room = shape.length - shape.base_plate - shape.tip_length
        if room < MM:
            limit = (shape.length - shape.base_plate) / MM - 1.0
            return f"tip_length_mm must stay below {limit:.4g} for this length_mm, got {shape.tip_length / MM:.4g}"
        corners, labels = cavity(shape)
        if not {BASE, BACK, CONTACT} <= set(labels) or ring_area(corners) < _SMALLEST_CAVITY:
            return (
                f"contact_wall_mm {shape.contact_wall / MM:.4g} and back_wall_mm {shape.back_wall / MM:.4g} "
                f"leave no cavity in a finger of width_mm {shape.width / MM:.4g}"
            )
        widest = shape.pitch * np.cos(shape.rib_angle) - _NARROWEST_GAP
        if shape.rib_count and shape.rib_thickness > widest:
            return (
                f"rib_thickness_mm must stay below {widest / MM:.4g} for rib_count {shape.rib_count} "
                f"at this rib_angle_deg, got {shape.rib_thickness / MM:.4g}"
            )
        return None

    def build(self, finger: Mapping[str, float]) -> Prism:
        """Return the finger's solid in the finger frame [m]; raises ``InputError`` where `check` has a sentence."""
        problem = self.check(finger)
        if problem:
            raise InputError(problem)
        shape = self._shape(finger)
        found = holes(shape)
        return Prism(
            outer=shape.outer,
            holes=tuple(hole.points for hole in found),
            thickness=float(finger["thickness"]),
            contact_line=shape.outer[[0, 2]],
            patches=patches(shape, found),
        )

    def _shape(self, finger: Mapping[str, float]) -> Shape:
        width = float(finger["width"])
        return Shape(
            length=float(finger["length"]),
            width=width,
            apex_x=0.5 * width if self.profile == "isosceles" else 0.0,
            base_plate=self.base_plate_mm * MM,
            tip_length=float(finger["tip_length"]),
            contact_wall=float(finger["contact_wall"]),
            back_wall=float(finger["back_wall"]),
            rib_count=round(finger["rib_count"]),
            rib_thickness=float(finger["rib_thickness"]),
            rib_angle=float(finger["rib_angle"]),
        )
