"""Named trades of accuracy against time: ``draft``, ``standard``, ``fine``, ``reference``, and ``paper``.

A preset sets what a design leaves open. Of each kind of plugin it may choose one, and give options to it and to others
of that kind: a design that names another plugin keeps it, and takes only that plugin's options. A value that a design
file (or ``--set``) gives always wins. How far off each preset is, `finqd.accuracy_bands` says.

>>> from finqd.data import designs_folder
>>> design = Design.from_json(designs_folder() / "benchmark.json")
>>> apply_preset(design, "paper").spec("mesher")
{'name': 'tetrahedral', 'size_mm': 2.0, 'order': 1}
>>> departures(apply_preset(design, "paper", overrides={"mesher.size_mm": 1}), "paper")
('mesher.size_mm is 1, not 2',)
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from finqd.design import Design
from finqd.errors import InputError

DEFAULT = "standard"

#: Quadratic bricks whose nodes follow the stress of the notches; with as many unknowns, linear ones are further off in
#: the press by far
_QUARTER: dict[str, Any] = {"order": 2, "notch_nodes": "quarter"}

#: Linear bricks, one across the finger: too soft across it, and too stiff beside notches, which cancels at this size.
#: Ten presses are off by 3.2 % in the median and by less than 5.7 % in nine (at 3 mm 5.3 and 12.4 %, at 2 mm 2.4 and
#: 7.6 %; quadratic bricks of 4 mm, with twice as many unknowns and three to four times the time, 6.2 and 11.9 %)
_THIN: dict[str, Any] = {"size_mm": 2.5, "layers": 1}

#: solved to 1 mN at 5 N; steps that stall are better halved (counted on four grasps with `draft`)
_RELAXED: dict[str, Any] = {
    "implicit_euler": {"tolerance_share": 2e-4, "stall_iterations": 10, "contact_curvature": False},
}

#: Contact no sharper than a coarse mesh deserves. In ten grasps of the benchmark gripper fingers press within 3 % of
#: what they do with the contact's own defaults, and drops change by 0.2 mm at most, 0.11 mm in nine; a grasp takes 0.7
#: of the time. In 22 grasps of the fuzz 28 % fewer iterations, and the same verdicts
_SOFT: dict[str, Any] = {
    "penalty": {
        "stiffness_N_mm3": 100.0, "smoothing_mm": 0.03, "friction_stiffness_ratio": 0.1, "sample_spacing_mm": 0.6,
    },
}  # fmt: skip

#: preset -> section -> options by plugin, of which the preset chooses the first; the protocol has no plugin
PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "draft": {
        "mesher": {"swept": _THIN, "tetrahedral": {"size_mm": 6.0}},
        "contact": _SOFT,
        "stepper": {"implicit_euler": {**_RELAXED["implicit_euler"], "tolerance_share": 1e-3}},
        "protocol": {"time_step_ms": 20.0, "calm_step_factor": 4},
    },
    # 20 ms: forces of five grasps of the benchmark gripper within 0.6 %, drops within 0.02 mm of those at 10 ms
    "standard": {
        "mesher": {
            "swept": {"size_mm": 2.5, "layers": 2, "grading": 1.5, **_QUARTER}, "tetrahedral": {"size_mm": 4.0},
        },
        "stepper": _RELAXED,
        "protocol": {"time_step_ms": 20.0, "calm_step_factor": 4},
    },
    "fine": {
        "mesher": {
            "swept": {"size_mm": 2.0, "layers": 2, "grading": 1.5, **_QUARTER}, "tetrahedral": {"size_mm": 2.0},
        },
        "stepper": _RELAXED,
        "protocol": {"time_step_ms": 10.0, "calm_step_factor": 4},
    },
    "reference": {
        "mesher": {
            "swept": {"size_mm": 1.5, "layers": 2, "grading": 1.5, **_QUARTER}, "tetrahedral": {"size_mm": 1.5},
        },
        "protocol": {"time_step_ms": 2.5},
    },
    # what the paper says of its solver; the time step is that of public scenes of the simulator it used
    "paper": {
        "mesher": {"tetrahedral": {"size_mm": 2.0, "order": 1}, "swept": {"size_mm": 2.0}},
        "elasticity": {"corotated": {}},
        "stepper": {
            "implicit_euler": {
                "linear_solver": "cg", "preconditioner": "jacobi", "linear_iterations": 1000, "linear_tolerance": 1e-6,
            },
        },
        "protocol": {"time_step_ms": 10.0},
    },
}  # fmt: skip

#: sections that decide how exact a result is; of the protocol only its steps do
NUMERICS = ("mesher", "elasticity", "stepper", "contact")
TIME_STEP = "time_step_ms"
TIMES = (TIME_STEP, "calm_step_factor")
HARMLESS = ("backend",)  # options that change how long a result takes, and not the result


def apply_preset(
    design: Design, name: str = DEFAULT, *, overrides: Mapping[str, Any] | None = None, source: str = "override:"
) -> Design:
    """Return the design with what it leaves open set by a preset.

    overrides: values by JSON path, stronger than design and preset; ``mesher.size_mm`` is an option of the mesher in
    use, which may be the preset's. ``source`` is put in front of what is wrong with them. Raises ``InputError`` for
    them and for an unknown name.
    """
    filled = _filled(design, preset_table(name))
    if not overrides:
        return filled
    return _filled(filled.with_overrides(overrides, source=source), preset_table(name))


def preset_table(name: str) -> dict[str, dict[str, Any]]:
    """Return what a preset sets, a row of `PRESETS`. Raises ``InputError`` for an unknown name."""
    if name not in PRESETS:
        raise InputError(f"there is no preset {name!r}; known: {', '.join(PRESETS)}", where="--preset")
    return PRESETS[name]


def departures(design: Design, name: str) -> tuple[str, ...]:
    """Return in what a design (with the preset applied) departs from what the preset alone would give, in words.

    Looked at are all options of mesher, elasticity, stepper and contact, and the time steps.
    """
    shape = ("geometry", "finger", "fingers", "spacing_mm")
    bare = {key: value for key, value in design.to_dict().items() if key in shape}
    plain, actual = apply_preset(Design(bare), name).resolved(), design.resolved()
    found = []
    for kind in NUMERICS:
        wanted, given = plain[kind], actual[kind]
        if wanted["name"] != given["name"]:
            found.append(f"{kind} is {given['name']}, not {wanted['name']}")
            continue
        found += [f"{kind}.{key} is {_shown(given[key])}, not {_shown(wanted[key])}"
                  for key in wanted if given[key] != wanted[key] and key not in HARMLESS]
    for key in TIMES:
        wanted, given = plain["protocol"][key], actual["protocol"][key]
        if wanted != given:
            found.append(f"protocol.{key} is {_shown(given)}, not {_shown(wanted)}")
    return tuple(found)


def _filled(design: Design, table: Mapping[str, Mapping[str, Any]]) -> Design:
    """Return the design with the values of ``table`` where it has none."""
    document = design.to_dict()
    for section, values in table.items():
        if section == "protocol":
            document[section] = {**values, **document.get(section, {})}
        else:
            spec = design.spec(section) if section in document else {"name": next(iter(values))}
            document[section] = {**values.get(spec["name"], {}), **spec}
    return Design(document, design.source)


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
