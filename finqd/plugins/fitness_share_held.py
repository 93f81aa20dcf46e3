"""Fitness: the share of objects held."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from annotated_types import Gt, Le

from finqd.contracts import FitnessResult, Verdict
from finqd.errors import InputError
from finqd.units import si_factor

if TYPE_CHECKING:
    from finqd.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class ShareHeld:
    """Share of objects that drop less than a threshold relative to the gripper, and the mean margin.

    ``drop_threshold_mm``: null takes the protocol's. An object's margin is ``1 - drop / threshold``, limited to -1..1;
    a simulation that failed counts as an object lost, with margin -1.
    """

    drop_threshold_mm: Annotated[float, Gt(0), Le(1000)] | None = None

    def score(self, trajectories: Mapping[str, Trajectory]) -> FitnessResult:
        """Return the share held, the mean margin and the verdict on each object, in the order given.

        Raises ``InputError`` if there is no object, or a trajectory that is no grasp.
        """
        if not trajectories:
            raise InputError("there is no object to score", where="fitness")
        verdicts = {name: self._verdict(name, trajectory) for name, trajectory in trajectories.items()}
        return FitnessResult(
            fitness=sum(verdict.held for verdict in verdicts.values()) / len(verdicts),
            margin=math.fsum(verdict.margin for verdict in verdicts.values()) / len(verdicts),
            verdicts=verdicts,
        )

    def _verdict(self, name: str, trajectory: Trajectory) -> Verdict:
        drop = float(trajectory.object_drop)
        if trajectory.status != "ok" or not math.isfinite(drop):
            return Verdict(held=False, drop=drop, margin=-1.0)
        threshold = self._threshold(name, trajectory)
        return Verdict(held=drop < threshold, drop=drop, margin=min(1.0, max(-1.0, 1.0 - drop / threshold)))

    def _threshold(self, name: str, trajectory: Trajectory) -> float:
        if self.drop_threshold_mm is not None:
            return self.drop_threshold_mm * si_factor("drop_threshold_mm")
        if trajectory.protocol is None:
            raise InputError("this trajectory is no grasp: it has no protocol", where=f"fitness: {name}")
        return trajectory.protocol.si("drop_threshold_mm")
