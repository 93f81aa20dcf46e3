"""What a recheck varies: friction, the object's pose, stiffness, time step and mesh size, each within a declared range.

A scheme is a seed and its ranges, and gives perturbation number 0, 1, 2, ...: points of a Sobol sequence that the seed
scrambles, so that a larger number of rechecks goes on where a smaller one ended. What is uncertain in the world follows
a normal law about the middle of its range, truncated at the ends, which are two standard deviations away; what is a
choice of the numerics is uniform. Every elite meets the same perturbations: elites then differ by their design, not by
their luck.

>>> scheme = Scheme(seed=1)
>>> scheme.draw(2)[0] == scheme.draw(8)[0], sorted(scheme.draw(1)[0]) == sorted(RANGES)
(True, True)
>>> Scheme(seed=1, ranges=dict.fromkeys(RANGES)).draw(1)
[{}]
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.errors import InputError

if TYPE_CHECKING:
    from finqd.design import Design

#: name -> its range: factors of the nominal value (1 changes nothing), or for the pose what is added to it (0)
RANGES: Mapping[str, tuple[float, float]] = {
    "friction": (0.8, 1.2),  # factor of all coefficients of friction
    "offset_x_mm": (-3.0, 3.0),  # of the object off the gripper's axis, to the first finger
    "offset_y_mm": (-3.0, 3.0),  # across that
    "turn_deg": (-10.0, 10.0),  # of the object about the vertical
    "stiffness": (0.85, 1.15),  # factor of the fingers' Young's modulus; soft objects keep theirs
    "time_step": (0.5, 1.0),  # factor of the largest time step
    "mesh_size": (0.85, 1.15),  # factor of the mesher's size_mm
}
#: what lies in the world: normal; the others are uniform
NORMAL = ("friction", "offset_x_mm", "offset_y_mm", "turn_deg", "stiffness")
#: name -> what may be asked for
ALLOWED: Mapping[str, tuple[float, float]] = {
    "friction": (0.01, 10.0), "offset_x_mm": (-100.0, 100.0), "offset_y_mm": (-100.0, 100.0),
    "turn_deg": (-360.0, 360.0), "stiffness": (0.01, 100.0), "time_step": (0.01, 10.0), "mesh_size": (0.1, 10.0),
}
ADDED = ("offset_x_mm", "offset_y_mm", "turn_deg")
PATHS = {
    "friction": ("protocol.friction_coefficient", "protocol.friction_finger_object",
                 "protocol.friction_finger_finger", "protocol.friction_finger_floor",
                 "protocol.friction_object_floor"),
    "offset_x_mm": ("protocol.object_offset_x_mm",), "offset_y_mm": ("protocol.object_offset_y_mm",),
    "turn_deg": ("protocol.object_turn_deg",), "stiffness": ("material.youngs_modulus_MPa",),
    "time_step": ("protocol.time_step_ms",), "mesh_size": ("mesher.size_mm",),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """A seed, and the range of each quantity that is varied; ``ranges``: what differs from `RANGES`, None: not varied.

    Raises InputError for an unknown name and for a range that is none or not allowed.
    """

    seed: int = 0
    ranges: Mapping[str, tuple[float, float] | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise InputError(f"must be a whole number from 0 upwards, got {self.seed!r}", where="seed")
        for name, given in self.ranges.items():
            if name not in RANGES:
                raise InputError(f"nothing of this name is varied; known: {', '.join(RANGES)}", where=f"ranges.{name}")
            low, high = ALLOWED[name]
            if given is not None and not low <= given[0] <= given[1] <= high:
                told = f"{given[0]:g} to {given[1]:g}"
                raise InputError(f"must be a low and a high number within {low:g} to {high:g}, not {told}",
                                 where=f"ranges.{name}")

    @property
    def varied(self) -> dict[str, tuple[float, float]]:
        """The range of each quantity that is varied."""
        return {name: one for name, one in {**RANGES, **self.ranges}.items() if one is not None}

    def to_dict(self) -> dict[str, Any]:
        """Return the scheme as the log holds it."""
        laws = {name: "normal" if name in NORMAL else "uniform" for name in self.varied}
        return {
            "sampler": "scrambled Sobol; normal: two standard deviations from the middle to each end, truncated there",
            "seed": self.seed,
            "ranges": {name: [*map(float, one), laws[name]] for name, one in self.varied.items()},
        }

    def draw(self, count: int) -> list[dict[str, float]]:
        """Return the first ``count`` perturbations, name -> factor or what is added."""
        from scipy.stats import qmc

        varied = self.varied
        if not varied:
            return [{} for _ in range(count)]
        # all quantities have their dimension, varied or not: leaving one out does not change the others
        sampler = qmc.Sobol(len(RANGES), scramble=True, seed=np.random.default_rng(self.seed))
        points = sampler.random_base2(max(count - 1, 0).bit_length())[:count]
        return [
            {name: _value(name, varied[name], u) for name, u in zip(RANGES, point) if name in varied}
            for point in points.tolist()
        ]


def _value(name: str, ends: tuple[float, float], u: float) -> float:
    """Return a quantity at the share ``u`` of its law."""
    from scipy.special import ndtr, ndtri

    low, high = map(float, ends)
    if name not in NORMAL:
        return low + u * (high - low)
    below = ndtr(-2.0)
    return float(np.clip((low + high) / 2 + (high - low) / 4 * ndtri(below + u * (1.0 - 2.0 * below)), low, high))


def perturbed(design: Design, perturbation: Mapping[str, float], *, preset: str) -> Design:
    """Return a design under other conditions; the very same one if the perturbation changes nothing.

    What the preset sets is taken from there first. A mesher without ``size_mm`` keeps its mesh. A value outside of what
    a design may hold raises InputError.
    """
    from finqd.presets import apply_preset

    neutral = {name: 0.0 if name in ADDED else 1.0 for name in RANGES}
    changing = {name: value for name, value in perturbation.items() if value != neutral[name]}
    if not changing:
        return design
    applied = apply_preset(design, preset)
    nominal, overrides = applied.resolved(), {}
    for name, value in changing.items():
        for path in PATHS[name]:
            section, key = path.split(".")
            old = nominal[section].get(key)
            if old is not None:
                overrides[path] = old + value if name in ADDED else old * value
    return applied.with_overrides(overrides, source=f"recheck of {design.name}:")


def interval(successes: int, count: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a probability (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927), (0, 1) of nothing.

    It is made for independent trials. Sobol points are spread more evenly than those, so it is rather too wide.

    >>> [round(end, 3) for end in interval(9, 10)]
    [0.596, 0.982]
    """
    if count == 0:
        return 0.0, 1.0
    from scipy.stats import binomtest

    found = binomtest(successes, count).proportion_ci(method="wilson")
    assert math.isfinite(found.low + found.high)
    return float(found.low), float(found.high)
