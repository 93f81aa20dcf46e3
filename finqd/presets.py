"""Named trades of accuracy against time: ``draft``, ``standard`` and ``fine``.

A preset sets what a design leaves open: a value that a design file (or ``--set``) gives wins over it, and options of a
plugin are taken only where that plugin is the one in use. How large the error of each preset is has not been measured
yet; that is a later issue, and until then the names only say which is coarser.
"""

from __future__ import annotations

from typing import Any

from finqd.design import Design
from finqd.errors import InputError

DEFAULT = "standard"

#: preset -> section -> what it sets; sections of plugins by the plugin's name
PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "draft": {
        "mesher": {"swept": {"size_mm": 6.0}, "tetrahedral": {"size_mm": 6.0}},
        "protocol": {"time_step_ms": 20.0},
    },
    "standard": {
        "mesher": {"swept": {"size_mm": 4.0}, "tetrahedral": {"size_mm": 4.0}},
        "protocol": {"time_step_ms": 10.0},
    },
    "fine": {
        "mesher": {"swept": {"size_mm": 2.0}, "tetrahedral": {"size_mm": 2.0}},
        "protocol": {"time_step_ms": 5.0},
    },
}


def apply_preset(design: Design, name: str = DEFAULT) -> Design:
    """Return the design with what it leaves open set by a preset. Raises ``InputError`` for an unknown name."""
    if name not in PRESETS:
        raise InputError(f"there is no preset {name!r}; known: {', '.join(PRESETS)}", where="--preset")
    document = design.to_dict()
    for section, values in PRESETS[name].items():
        if section == "protocol":
            document[section] = {**values, **document.get(section, {})}
        else:
            spec = design.spec(section)
            document[section] = {**values.get(spec["name"], {}), **spec}
    return Design(document, design.source)
