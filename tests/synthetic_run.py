"""A run to report on, without simulation: real designs of the fin ray, invented fitness."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from finqd import archive as qd
from finqd.design import Design, design_parameters
from finqd.errors import InputError

OBJECTS = ("cube", "cylinder", "diablo", "diamond", "disk", "flan", "hourglass", "pasta", "sphere", "triangle")
RANGES = {"workspace_mm2": (1169.0, 2079.0), "volume_mm3": (35.9e3, 93.6e3)}
PARAMETERS = design_parameters("fin_ray")


@dataclass
class SyntheticRun:
    """What `finqd.runlog.read_run` returns, held in memory."""

    told: list[dict[str, Any]]
    cells: int = 10
    checked: tuple[dict[str, Any], ...] = ()
    base: dict[str, Any] = field(default_factory=dict)
    ranges: dict[str, tuple[float, float]] = field(default_factory=lambda: dict(RANGES))
    parameters: Any = PARAMETERS
    confirm: str | None = None

    @property
    def settings(self):
        presets = {"screen": "draft", "confirm": self.confirm} if self.confirm else {"preset": "standard"}
        return {"algorithm": "cma_me", "seed": 0, "batch": 15, "cells": self.cells, "objects": None, **presets}

    def records(self):
        return tuple(self.told)

    def rechecks(self):
        return self.checked

    def archive(self):
        archive = qd.new_archive(len(self.parameters), self.ranges, cells=self.cells, seed=np.random.SeedSequence(0))
        for record in self.told:
            if record["status"] == "ok":
                measures = [record["features"][name] for name in self.ranges]
                archive.add_single(np.array(record["unit"]), record["objective"], measures, evaluation=record["index"])
        return archive

    def elites(self):
        return qd.elites(self.archive(), self.records())


def synthetic_record(index: int, unit: np.ndarray, *, batch: int = 15, measured: bool = True) -> dict[str, Any]:
    """Return the record of a design at ``unit``; not ``measured``: with features near the real ones, in no time."""
    record: dict[str, Any] = {
        "index": index, "iteration": index // batch, "emitter": 0, "seed": 0, "unit": unit.tolist(), "parameters": {},
        "design_digest": None, "status": "invalid", "reason": "", "details": "", "fitness": None, "margin": None,
        "objective": qd.PENALTY, "features": {}, "objects": {}, "accuracy": None, "seconds": None, "host": "here",
        "preset": "standard", "versions": {}, "finished_at": 31.0 * (index + 1), "screen": None, "attempts": 1,
    }  # fmt: skip
    try:
        design = Design.from_unit_vector(unit)
        features = qd.measure_features(design) if measured else guessed_features(design)
    except InputError as error:
        return {**record, "reason": str(error)}
    values = design.to_vector().tolist()
    record["parameters"] = {path: value for (path, _), value in zip(PARAMETERS, values)}
    record["seconds"] = 50.0 + index % 13
    random = np.random.default_rng(index)
    if random.random() < 0.04:
        return {**record, "status": "timeout", "reason": f"stopped after its time limit of {600 + index} s"}
    return {**record, **invented(unit, random), "features": features, "design_digest": f"{index:064x}"}


def guessed_features(design: Design) -> dict[str, float]:
    fingers = sum(
        f["thickness_mm"] * (f["length_mm"] * (f["contact_wall_mm"] + f["back_wall_mm"])
                             + f["rib_count"] * f["rib_thickness_mm"] * 0.4 * f["width_mm"]
                             + 0.2 * f["tip_length_mm"] * f["width_mm"]) for f in design.fingers
    )  # fmt: skip
    workspace = 1e6 * design.workspace
    return {"workspace_mm2": workspace, "volume_mm3": fingers + 2.75 * workspace, "finger_volume_mm3": fingers}


def invented(unit: np.ndarray, random: np.random.Generator) -> dict[str, Any]:
    """Return a score that falls off from a point of the cube, with stiff and light designs better, and noise."""
    walls = unit[[4, 13, 22]].mean()
    quality = 1.2 - 1.6 * (walls - 0.55) ** 2 - 0.5 * (unit[27] - 0.4) ** 2 - 0.9 * abs(unit[8] - 0.5) - 0.25 * unit[0]
    rows = {}
    for k, name in enumerate(OBJECTS):
        margin = float(np.clip(3.0 * (quality - 0.5 - 0.06 * k) + 0.25 * random.normal(), -1.0, 1.0))
        held = margin > 0.0
        rows[name] = {
            "status": "ok", "reason": "", "held": held, "margin": margin,
            "drop_mm": 10.0 * (1.0 - margin) if held else 29.9,
            "max_contact_force_N": 11.0 + 4.0 * margin, "max_penetration_mm": 0.02, "simulated_s": 1.9, "steps": 140,
            "final_contact_force_N": [3.0, 3.0, 3.0], "final_height_mm": 40.0, "newton_iterations": 500, "counters": {},
            "ended": "" if held else "at t = 1.880 s everything is at rest, in a stable equilibrium", "seconds": 5.0,
            "effects": {"friction": {"since_s": 0.0, "why": "object came within reach of floor"},
                        "self_contact": {"since_s": 0.4 if k % 3 else None, "why": "never within reach"}},
        }  # fmt: skip
    if random.random() < 0.03:
        rows["triangle"] |= {"status": "diverged", "held": False, "margin": -1.0, "reason": "at 0.52 s: no convergence"}
    fitness = sum(row["held"] for row in rows.values()) / len(rows)
    margin = float(np.mean([row["margin"] for row in rows.values()]))
    return {"status": "ok", "fitness": fitness, "margin": margin, "objective": qd.objective(fitness, margin, len(rows)),
            "objects": rows, "accuracy": "not measured"}  # fmt: skip


def synthetic_run(
    count: int, *, cells: int = 10, rechecked: int = 0, measured: bool = True, seed: int = 0
) -> SyntheticRun:
    """Return a run of ``count`` designs, drawn ever closer to what is good; ``rechecked``: elites with rechecks."""
    random = np.random.default_rng(seed)
    best, records = np.full(28, 0.5), []
    top = -1.0
    for index in range(count):
        spread = 0.30 if index < count / 3 else 0.22
        unit = random.random(28) if index % 2 else np.clip(best + spread * random.normal(size=28), 0.0, 1.0)
        records.append(synthetic_record(index, unit, measured=measured))
        if records[-1]["objective"] > top:
            best, top = unit, records[-1]["objective"]
    run = SyntheticRun(records, cells=cells)
    run.checked = tuple(row for _, record in run.elites()[:rechecked] for row in recheck_rows(record))
    return run


def recheck_rows(record: dict[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for k, friction in enumerate((0.5, 0.6, 0.7)):
        objects = {name: {**row, "held": row["margin"] > 0.25 - 0.2 * k} for name, row in record["objects"].items()}
        fitness = sum(row["held"] for row in objects.values()) / len(objects)
        margin = record["margin"] + 0.1 * (k - 1)
        rows.append({
            "index": record["index"], "number": k, "perturbation": {"friction": friction}, "preset": "standard",
            "scheme": {"seed": 0, "ranges": {"friction": [0.5, 0.7, "uniform"]}}, "fitness": fitness, "margin": margin,
            "objective": qd.objective(fitness, margin, len(objects)), "features": record["features"],
            "objects": objects, "status": "ok", "reason": "", "seconds": 40.0,
        })  # fmt: skip
    return rows
