"""What people read in the place of a JSON key: its name in words, and its unit as it is written."""

from __future__ import annotations

from finqd.units import unit_of

UNIT_NAMES = {"mm2": "mm²", "mm3": "mm³", "m2": "m²", "m3": "m³", "deg": "°", "kg_m3": "kg/m³"}


def name_and_unit(key: str) -> tuple[str, str]:
    """Return name and unit of a JSON key.

    >>> name_and_unit("volume_mm3"), name_and_unit("slenderness")
    (('volume', 'mm³'), ('slenderness', ''))
    """
    unit = next((u for u in UNIT_NAMES if key.endswith(f"_{u}")), unit_of(key))
    name = key.removesuffix(f"_{unit}") if unit else key
    return name.replace("_", " "), UNIT_NAMES.get(unit, unit)


def label(key: str) -> str:
    """Return the axis label of a JSON key.

    >>> label("volume_mm3"), label("slenderness")
    ('volume [mm³]', 'slenderness')
    """
    name, unit = name_and_unit(key)
    return f"{name} [{unit}]" if unit else name
