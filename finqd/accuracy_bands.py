"""How far off a preset has been measured to be, and whether that says anything of a given design.

The numbers are in ``studies/presets.json``, which comes with finqd: what a named study measured, when, with which
versions, how to repeat it, and with which settings of each preset. A number that is null has not been measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from finqd.data import studies_folder
from finqd.errors import FinqdError, InputError
from finqd.json_input import read_json_object
from finqd.presets import PRESETS, departures

if TYPE_CHECKING:
    from finqd.design import Design

#: what is measured of a preset; the study that each comes from
MEASURED = {
    "press_force_error_percent": "press", "press_seconds": "press", "press_fingers_error_percent": "press_fingers",
    "grasp_force_error_percent": "grasp", "drop_error_mm": "grasp", "verdict_flips_percent": "grasp",
    "grasp_seconds": "grasp",
}  # fmt: skip
NOT_MEASURED = "not measured yet"


def accuracy(design: Design, preset: str) -> dict[str, Any]:
    """Return what a result says of its accuracy: the preset's measured errors, and whether they hold for ``design``.

    ``design`` is the one that was simulated, with the preset applied. ``applies`` is False, with the reason in
    ``sentence``, if the design departs from the preset, is of a kind that was not studied, or the preset is not
    measured (or has changed since).
    """
    file, numbers = bands(), measured(preset)
    objection = _unmeasured(preset, numbers) or _objection(design, preset, file["valid_for"])
    studies = {MEASURED[key] for key, value in numbers.items() if value is not None}
    return {
        "preset": preset, "applies": objection is None, "sentence": objection or _summary(preset, numbers), **numbers,
        "grasps_compared": _compared(preset),
        "studies": {name: dict(file["studies"][name]) for name in sorted(studies)},
    }


def measured(preset: str) -> dict[str, float | None]:
    """Return the measured numbers of a preset, None where there is none."""
    row = bands()["presets"].get(preset, {})
    return {key: row.get(key) for key in MEASURED}


def preset_sentence(preset: str) -> str:
    """Return what is measured of a preset where it is used as it is, in one sentence."""
    numbers = measured(preset)
    return _unmeasured(preset, numbers) or _summary(preset, numbers)


@lru_cache(maxsize=1)
def bands() -> Mapping[str, Any]:
    """Return the content of ``studies/presets.json``. Raises ``FinqdError`` if this installation's is damaged."""
    path = studies_folder() / "presets.json"
    try:
        document, _ = read_json_object(path, kind="study")
    except InputError as error:
        raise FinqdError(f"this installation of finqd is damaged; install it again ({error})") from error
    if not {"valid_for", "studies", "presets"} <= document.keys():
        raise FinqdError(f"this installation of finqd is damaged; install it again ({path})")
    return document


def _unmeasured(preset: str, numbers: Mapping[str, Any]) -> str | None:
    """Return why there are no numbers of the preset as it is now, or None."""
    if all(value is None for value in numbers.values()):
        return NOT_MEASURED
    changed = bands()["presets"][preset].get("settings") != PRESETS[preset]
    return f"{NOT_MEASURED}: the preset has changed since its study" if changed else None


def _objection(design: Design, preset: str, valid_for: Mapping[str, Any]) -> str | None:
    """Return why the numbers say nothing of this design, or None."""
    resolved = design.resolved()
    if resolved["geometry"]["name"] != valid_for["geometry"]:
        return f"does not apply: measured on fingers of the type {valid_for['geometry']}"
    if resolved["material"]["poisson_ratio"] != valid_for["poisson_ratio"]:
        return f"does not apply: measured with a Poisson's ratio of {valid_for['poisson_ratio']:g}"
    found = departures(design, preset)
    return f"does not apply: {'; '.join(found)}" if found else None


def _compared(preset: str) -> str | None:
    """Return how many grasps the preset was compared in, and with what; None if in none."""
    return bands()["presets"].get(preset, {}).get("grasps_compared")


def _summary(preset: str, numbers: Mapping[str, Any]) -> str:
    """Return the measured errors as one sentence."""
    parts = [
        text.format(numbers[key])
        for key, text in (
            ("press_force_error_percent", "force of a press {:.2g} % off"),
            ("press_fingers_error_percent", "on 9 of 10 fingers within {:.2g} %"),
            ("grasp_force_error_percent", "force of 9 of 10 grasps within {:.2g} %"),
            ("drop_error_mm", "drop within {:.2g} mm"),
            ("verdict_flips_percent", "{:.2g} % of verdicts flip"),
        )
        if numbers[key] is not None
    ]
    compared = _compared(preset)
    return ", ".join(parts) + (f" ({compared})" if compared else "") or "only its seconds have been measured"
