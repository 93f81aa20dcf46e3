"""Which effects a grasp calls for, since when and why, what they cost, and what would change without them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.effects import effects_of
from finqd.errors import InputError
from finqd.evaluate import finger_meshes, load_objects, run_grasps
from finqd.grasp import GraspTask
from finqd.presets import apply_preset
from finqd.profiling import effect_seconds
from finqd.units import MM

if TYPE_CHECKING:
    from finqd.design import Design
    from finqd.objects import GraspObject
    from finqd.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of one grasp: status, verdict, drop [m] and final force, summed over the fingers [N], and seconds."""

    status: str
    held: bool
    drop: float
    force: float
    seconds: float

    @classmethod
    def of(cls, design: Design, name: str, trajectory: Trajectory) -> Outcome:
        """Read it off a trajectory."""
        verdict = design.plugin("fitness").score({name: trajectory}).verdicts[name]
        forces = trajectory.contact_forces
        return cls(
            status=trajectory.status, held=verdict.held, drop=verdict.drop,
            force=float(np.sum(forces[-1])) if len(forces) else math.nan,
            seconds=sum(trajectory.timings.get(part, 0.0) for part in ("set_up", "steps")),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON holds it: lengths in millimetres."""
        return {
            "status": self.status, "held": self.held, "drop_mm": _finite(self.drop / MM),
            "force_N": _finite(self.force), "seconds": self.seconds,
        }


@dataclass(frozen=True, kw_only=True)
class Line:
    """One effect in one grasp.

    state: "on" or "off"; why: one sentence; since: when it was needed first [s], None if it never was or is not known
    seconds: what it cost; effects that the same kernels look after have one figure together. None where it is off,
        was never needed, or has no kernels of its own
    other: the state of the grasp ``what_if`` with the other one, where that was simulated, or why it cannot be
    """

    name: str
    state: str
    why: str
    since: float | None = None
    seconds: float | None = None
    other: str = ""
    what_if: Outcome | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        row: dict[str, Any] = {
            "state": self.state, "since_s": self.since, "seconds": self.seconds, "why": self.why,
        }
        if self.what_if is not None:
            row["what_if"] = {"state": self.other, **self.what_if.to_dict()}
        elif self.other:
            row["what_if"] = {"state": None, "reason": self.other}
        return row


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """The effects of one grasp, with what came of it."""

    object_name: str
    outcome: Outcome
    reason: str
    lines: tuple[Line, ...] = field(default=())

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        return {
            **self.outcome.to_dict(), "reason": self.reason,
            "effects": {line.name: line.to_dict() for line in self.lines},
        }


def explain(
    design: Design, *, objects: Sequence[str | Path | GraspObject] | None = None, preset: str = "standard",
    what_if: bool = False, jobs: int = 1, progress: Callable[[str, float], None] | None = None,
) -> list[Explanation]:
    """Simulate grasps of ``objects`` (default: all that come with finqd), and say of each effect what it did.

    what_if: simulate each grasp again with each effect that can be switched the other way. Raises InputError as
    `finqd.evaluate.evaluate` does, MeshError for a design that cannot be meshed.
    """
    chosen, grasped = apply_preset(design, preset), load_objects(objects)
    solids = [chosen.plugin("geometry").build(chosen.finger_si(i)) for i in range(len(chosen.fingers))]
    meshes = finger_meshes(chosen, solids)
    others = _others(chosen) if what_if else {}
    tasks, labels = [], []
    for thing in grasped:
        for name, other in (("", chosen), *_changed(others, thing)):
            tasks.append(GraspTask(design=other, meshes=meshes, grasped=thing, profile=True))
            labels.append(f"{thing.name}, {name} {other.forced_effects[name]}" if name else thing.name)
    found = iter(run_grasps(tasks, labels=labels, jobs=jobs, progress=progress))
    return [
        _explanation(chosen, thing, others, next(found), [next(found) for _ in _changed(others, thing)])
        for thing in grasped
    ]


def _changed(others: Mapping[str, Design | str], thing: GraspObject) -> list[tuple[str, Design]]:
    """Return the effects that can be the other way round in a grasp of ``thing``, each with that design."""
    return [
        (name, other) for name, other in others.items()
        if not isinstance(other, str) and (name != "soft_object" or thing.soft is not None)
    ]


def _others(design: Design) -> dict[str, Design | str]:
    """Return the design with each effect the other way round, or why that cannot be."""
    found: dict[str, Design | str] = {}
    for name, sentence in effects_of(design).items():
        other = "off" if _is_on(sentence) else "on"
        try:
            found[name] = design.with_overrides({f"effects.{name}": other}, source="")
        except InputError as error:
            found[name] = str(error).partition(": ")[2]
    return found


def _explanation(
    design: Design, thing: GraspObject, others: Mapping[str, Design | str], base: Trajectory, rest: Sequence[Trajectory]
) -> Explanation:
    changed = _changed(others, thing)
    outcomes = {name: Outcome.of(other, thing.name, run) for (name, other), run in zip(changed, rest, strict=True)}
    seconds = {name: cost for names, cost in effect_seconds(base.timings).items() for name in names}
    lines = []
    for name, sentence in effects_of(design).items():
        state, why = ("on" if _is_on(sentence) else "off"), sentence.partition(": ")[2] or sentence
        if name == "soft_object":
            state, why = ("on", "its file makes it soft") if thing.soft is not None else ("off", "the object is rigid")
        seen = base.effects.get(name, {})
        since = seen.get("since_s") if seen else (0.0 if state == "on" and name not in SEEN else None)
        if seen and state == "on":
            why = seen["why"]
        other = others.get(name, "")
        useless = name == "soft_object" and thing.soft is None
        lines.append(Line(
            name=name, state=state, why=why, since=since if state == "on" else None,
            seconds=seconds.get(name) if state == "on" and since is not None else None,
            other="" if useless else other if isinstance(other, str) else other.forced_effects[name],
            what_if=None if useless else outcomes.get(name),
        ))
    return Explanation(
        object_name=thing.name, outcome=Outcome.of(design, thing.name, base), reason=base.reason, lines=tuple(lines)
    )


#: effects whose start the contact model finds in the grasp
SEEN = ("object_contact", "friction", "floor", "self_contact", "finger_to_finger_contact")


def _is_on(sentence: str) -> bool:
    return not sentence.startswith("off")


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
