"""Factors from the units that JSON keys name to SI; inside finqd everything is SI (m, kg, s, N, Pa, rad).

>>> 94.5 * MM
0.0945
>>> si_factor("length_mm"), si_factor("rib_count")
(0.001, 1.0)
"""

import math

MM = 1e-3  # millimetre [m]
MM2 = 1e-6  # square millimetre [m^2]
MM3 = 1e-9  # cubic millimetre [m^3]
MPA = 1e6  # megapascal [Pa]
DEG = math.pi / 180.0  # degree [rad]
MS = 1e-3  # millisecond [s]
GRAM = 1e-3  # gram [kg]

#: unit suffix of a JSON key -> factor to SI
FACTORS = {
    "mm": MM, "mm2": MM2, "mm3": MM3, "m": 1.0, "deg": DEG, "ms": MS, "s": 1.0, "g": GRAM, "kg": 1.0,
    "N": 1.0, "MPa": MPA, "Pa": 1.0, "kg_m3": 1.0, "m_s2": 1.0, "N_mm3": 1e9,
}


def unit_of(key: str) -> str:
    """Return the unit suffix of a JSON key (``"length_mm"`` -> ``"mm"``), or ``""`` if it has none."""
    for suffix in sorted(FACTORS, key=len, reverse=True):
        if key.endswith("_" + suffix):
            return suffix
    return ""


def si_factor(key: str) -> float:
    """Return what the value under a JSON key is multiplied with to become SI."""
    return FACTORS.get(unit_of(key), 1.0)
