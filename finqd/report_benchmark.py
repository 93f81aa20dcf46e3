"""The paper's benchmark gripper on the page of a search: what it holds, and where it lies on the map."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from finqd import archive as qd
from finqd.data import designs_folder
from finqd.design import Design
from finqd.errors import FinqdError, InputError

_FIELDS = ("status", "reason", "held", "margin", "drop_mm", "max_contact_force_N", "max_penetration_mm")


def benchmark_of(run: Any, path: Path | None, objects: Sequence[str], archive: Any) -> dict[str, Any] | None:
    """Return the design that the page compares with, or None if there is none to compare.

    path: a result file, as ``finqd evaluate DESIGN --out FILE.json`` writes it. Without one, it is the benchmark that
    comes with finqd, with its features (from its shape alone) and no verdicts, if the run searched its finger type.
    Raises ``InputError`` if the file is no result.
    """
    if path is not None:
        return _from_result(run, read_result(path), objects, archive)
    design = _bundled(run)
    if design is None:
        return None
    preset = run.settings.get("confirm") or run.settings.get("preset") or "standard"
    command = f"finqd evaluate benchmark --preset {preset} --objects {','.join(objects)} --out benchmark.json"
    features = qd.measure_features(design)
    return {
        "name": design.name, "fitness": None, "margin": None, "features": features, "objects": {}, "notes": [],
        "command": command, "parameters": design.to_vector().tolist(), "cell": _cell(run, features, archive),
    }


def read_result(path: Path) -> dict[str, Any]:
    """Return the content of a result file. Raises ``InputError``."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", str(path)) from error
    except ValueError as error:  # no JSON, no UTF-8
        raise InputError("is no JSON file", str(path)) from error
    score = (int, float, type(None))
    needed = {"fitness": score, "margin": score, "features": dict, "objects": dict}
    if not isinstance(content, dict) or content.get("format") != "finqd result" or not all(
        isinstance(content.get(key, ...), kind) for key, kind in needed.items()
    ) or not all(isinstance(row, dict) for row in content["objects"].values()):
        raise InputError("is no result of finqd evaluate (one made with --out FILE.json)", str(path))
    return content


def _from_result(run: Any, result: Mapping[str, Any], objects: Sequence[str], archive: Any) -> dict[str, Any]:
    notes = []
    preset = run.settings.get("confirm") or run.settings.get("preset")
    if preset and result.get("preset") != preset:
        notes.append(f"simulated with the preset {result.get('preset')}, the search with {preset}")
    missing = [name for name in objects if name not in result["objects"]]
    others = [name for name in result["objects"] if name not in objects]
    if missing or others:
        notes.append("on other objects than the search: its fitness is not comparable")
    rows = {name: {k: row.get(k) for k in _FIELDS if k in row} for name, row in result["objects"].items()}
    return {
        "name": str(result.get("design", {}).get("name", "benchmark")), "fitness": result["fitness"],
        "margin": result["margin"], "features": result["features"], "objects": rows, "notes": notes, "command": None,
        "parameters": _parameters(run, result), "cell": _cell(run, result["features"], archive),
    }


def _parameters(run: Any, result: Mapping[str, Any]) -> list[float] | None:
    try:
        design = Design.from_json(dict(result["design"]))
    except (FinqdError, KeyError, TypeError, ValueError):  # of another version, or of another finger type
        return None
    same = [path for path, _ in design.parameters] == [path for path, _ in run.parameters]
    return design.to_vector().tolist() if same else None


def _bundled(run: Any) -> Design | None:
    design = Design.from_json(designs_folder() / "benchmark.json")
    if [path for path, _ in design.parameters] != [path for path, _ in run.parameters]:
        return None
    settings = {key: value for key, value in run.base.items() if key not in ("name", "description", "geometry")}
    return Design({**design.to_dict(), **settings})


def _cell(run: Any, features: Mapping[str, Any], archive: Any) -> list[int] | None:
    """Return the cell that a design with these features falls into; None outside the map or where one is missing."""
    values = [features.get(name) for name in run.ranges]
    for value, (low, high) in zip(values, run.ranges.values()):
        if not isinstance(value, (int, float)) or not low - 1e-6 * abs(low) <= value <= high + 1e-6 * abs(high):
            return None
    return [int(i) for i in archive.int_to_grid_index([archive.index_of_single(values)])[0]]
