"""The grasp protocol: what is done with every object, as named constants that a design file may change.

Object on the floor under the gripper; fingers close; the gripper lifts, and holds; an object that has dropped less than
the threshold relative to the gripper is held. The values are finqd's own choices unless a source is named.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le

from finqd.units import si_factor

Friction = Annotated[float, Ge(0), Le(5)] | None
Offset = Annotated[float, Ge(-100), Le(100)]

#: constants that came when digests of designs were in use already; at their defaults they are not part of them
LATER = ("object_offset_x_mm", "object_offset_y_mm", "object_turn_deg")


def _constant(default: float | None, description: str) -> Any:
    return field(default=default, metadata={"description": description})


@dataclass(frozen=True, kw_only=True)
class GraspProtocol:
    """Constants of a grasp, named as in JSON, in the unit that each name ends in; `si` returns them in SI.

    A new constant is one line here: file format, schema, ranges and ``--set`` follow.
    """

    gravity_m_s2: Annotated[float, Ge(0), Le(100)] = _constant(9.81, "acceleration of gravity, downwards")
    friction_coefficient: Annotated[float, Ge(0), Le(5)] = _constant(
        0.6, "Coulomb's mu of every pair of surfaces that has none of its own below"
    )
    friction_finger_object: Friction = _constant(None, "mu of fingers and object, if it is another")
    friction_finger_finger: Friction = _constant(None, "mu of fingers, each other's and their own, if it is another")
    friction_finger_floor: Friction = _constant(None, "mu of fingers and floor, if it is another")
    friction_object_floor: Friction = _constant(None, "mu of object and floor, if it is another")
    tip_clearance_mm: Annotated[float, Ge(0), Le(200)] = _constant(
        3.0, "gap between the longest finger's tip and the floor at the start"
    )
    object_offset_x_mm: Offset = _constant(0.0, "how far the object lies off the gripper's axis, to the first finger")
    object_offset_y_mm: Offset = _constant(0.0, "how far it lies off the axis across that")
    object_turn_deg: Annotated[float, Ge(-360), Le(360)] = _constant(
        0.0, "how far the object is turned about the vertical, seen from above against the clock"
    )
    settle_s: Annotated[float, Ge(0), Le(60)] = _constant(0.0, "the object settles on the floor before fingers close")
    close_s: Annotated[float, Gt(0), Le(60)] = _constant(1.0, "time the actuator is given for its stroke")
    squeeze_s: Annotated[float, Ge(0), Le(60)] = _constant(0.2, "pause between closing and the lift")
    lift_mm: Annotated[float, Ge(0), Le(1000)] = _constant(30.0, "how far the gripper is lifted")
    lift_s: Annotated[float, Gt(0), Le(60)] = _constant(0.6, "duration of the lift")
    hold_s: Annotated[float, Ge(0), Le(600)] = _constant(1.0, "how long the gripper holds after the lift")
    drop_threshold_mm: Annotated[float, Gt(0), Le(1000)] = _constant(
        10.0, "an object that drops less than this relative to the gripper is held"
    )
    time_step_ms: Annotated[float, Ge(0.001), Le(1000)] = _constant(10.0, "largest time step")
    calm_step_factor: Annotated[int, Ge(1), Le(16)] = _constant(
        1, "time steps that one may span where nothing happens: what does in it is gone through in single ones"
    )
    early_verdict: bool = _constant(True, "a grasp whose verdict is certain in the hold is not simulated to its end")
    wall_clock_limit_s: Annotated[float, Gt(0), Le(1e6)] = _constant(600.0, "a simulation is given up after this time")

    def si(self, key: str) -> float:
        """Return a constant in SI units, by its JSON key.

        >>> GraspProtocol().si("lift_mm"), GraspProtocol().si("lift_s")
        (0.03, 0.6)
        """
        return getattr(self, key) * si_factor(key)

    def as_dict(self) -> dict[str, float | None]:
        """Return all constants under their JSON keys."""
        return asdict(self)
