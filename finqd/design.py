"""A gripper design: JSON <-> Design <-> vector, and the only place where units become SI.

>>> from finqd.data import designs_folder
>>> design = Design.from_json(designs_folder() / "benchmark.json")
>>> design.fingers[0]["length_mm"], design.finger_si(0)["length"], design.spacing
(94.5, 0.0945, 0.04)
>>> design.warnings
('finger.tip_length_mm: 15 lies outside the search range 20 to 30',)
>>> len(design.to_vector())
28
>>> design.with_overrides({"protocol.hold_s": 2}).protocol.hold_s
2.0
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from finqd import registry
from finqd.contracts import Parameter
from finqd.design_overrides import apply_override
from finqd.design_schema import (
    DEFAULT_PLUGINS,
    FINGER_COUNT,
    KEYS,
    SPACING,
    TEXTS,
    MaterialSection,
    constants,
    design_schema,
    finger_si,
    plugin_options,
    read_document,
    read_number,
)
from finqd.effects import refuse_contradictions
from finqd.errors import InputError
from finqd.json_input import read_json_object
from finqd.mechanics.material import Material
from finqd.protocol import LATER, GraspProtocol
from finqd.units import si_factor

__all__ = ["Design", "GraspProtocol", "design_parameters", "parse_setting"]


@dataclass(frozen=True)
class Design:
    """Three fingers, their spacing and material, the plugins with their options, and the protocol.

    ``document`` is what a design file holds: only what it sets, in JSON units; it is checked, and from then on
    canonical and read-only, so every Design is valid. Everything else has a default. ``warnings`` names values that a
    file may hold but a search would not try. Usually made by one of the ``from_`` methods. Raises ``InputError``.
    """

    document: Mapping[str, Any]
    source: str = field(default="design:", compare=False, repr=False)
    warnings: tuple[str, ...] = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        document, warnings = read_document(self.document, self.source)
        object.__setattr__(self, "document", _frozen(document))
        object.__setattr__(self, "warnings", tuple(warnings))
        refuse_contradictions(self, self.source)

    def __hash__(self) -> int:
        return hash(self.to_json())

    def __reduce__(self) -> tuple[Any, ...]:  # read-only mappings do not pickle; workers get the plain document
        return Design, (self.to_dict(), self.source)

    # -- JSON -------------------------------------------------------------------------------------------------------

    @classmethod
    def from_json(cls, source: str | os.PathLike[str] | Mapping[str, Any]) -> Design:
        """Return the design in a file, in a text (that starts with ``{``) or in a mapping.

        A file without a ``name`` is named after itself. Raises ``InputError``: one sentence with file, JSON path,
        what is wrong and what is allowed.
        """
        document, place = read_json_object(source, kind="design")
        if place != "design:" and "name" not in document:
            document["name"] = Path(os.fspath(source)).stem  # type: ignore[arg-type]
        return cls(document, place)

    def to_dict(self) -> dict[str, Any]:
        """Return ``document`` as plain dictionaries and lists, which the caller may change."""
        return json.loads(json.dumps(self.document, default=dict))

    def to_json(self) -> str:
        """Return the canonical text: reading and writing it again gives the same text."""
        return json.dumps(self.document, default=dict, indent=2, ensure_ascii=False) + "\n"

    def resolved(self) -> dict[str, Any]:
        """Return the document with every default written out, options of all plugins included."""
        full = {**self.to_dict(), "name": self.name, "geometry": _options_of(self.spec("geometry"), "geometry")}
        full["material"] = constants(self._material_section)
        full["protocol"] = self.protocol.as_dict()
        for kind in DEFAULT_PLUGINS:
            spec = self.spec(kind)
            full[kind] = [_options_of(s, kind) for s in spec] if kind == "features" else _options_of(spec, kind)
        return {key: full[key] for key in KEYS if key in full}

    def digest(self) -> str:
        """Return a hash (SHA-256, hex) of all that is simulated: of `resolved`, without name and description."""
        return self._digest

    @cached_property
    def _digest(self) -> str:
        content = {key: value for key, value in self.resolved().items() if key not in TEXTS}
        content["protocol"] = {key: value for key, value in content["protocol"].items() if value or key not in LATER}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    @staticmethod
    def json_schema(geometry: str = "fin_ray") -> dict[str, Any]:
        """Return the JSON Schema (draft 2020-12) of design files of one geometry."""
        return design_schema(geometry)

    def with_overrides(self, overrides: Mapping[str, Any], *, source: str = "override:") -> Design:
        """Return a design in which some values are others: ``{"protocol.hold_s": 2, "fingers[1].rib_count": 5}``.

        ``finger.rib_count`` means all three fingers, ``mesher.size_mm`` an option of the plugin in use. ``source`` is
        put in front of what is wrong. Raises ``InputError`` as `from_json` does.
        """
        document = self.to_dict()
        for key, value in overrides.items():
            apply_override(document, key, value, place=source)
        return Design(document, source)

    # -- vectors ----------------------------------------------------------------------------------------------------

    @classmethod
    def from_vector(cls, vector: Any, *, geometry: str | Mapping[str, Any] = "fin_ray", **settings: Any) -> Design:
        """Return the design with these values, in JSON units: those of three fingers, then the spacing.

        ``vector``: shape (3 * parameters + 1,), as in `parameters` (28 for a fin ray). ``settings``: other keys of a
        design file (``name=..., protocol={...}``; `Design.settings` of another design). Raises ``InputError``, naming
        the entry.
        """
        parameters = design_parameters(geometry)
        values = _read_vector(vector, parameters)
        read = [
            read_number(p, value, f"vector: entry {i} ({path})")
            for i, ((path, p), value) in enumerate(zip(parameters, values))
        ]
        per_finger = len(parameters) // FINGER_COUNT
        keys = [p.key for _, p in parameters[:per_finger]]
        fingers = [dict(zip(keys, read[i * per_finger :])) for i in range(FINGER_COUNT)]
        for key in settings.keys() & {"finger", "fingers", "spacing_mm"}:
            raise InputError(f"{key} comes from the vector; do not give it beside", where="vector")
        return cls({"geometry": geometry, **settings, "fingers": fingers, "spacing_mm": read[-1]}, "vector:")

    def to_vector(self) -> np.ndarray:
        """Return the values in JSON units, shape (3 * parameters + 1,), in the order of `parameters`."""
        values = [value for finger in self.fingers for value in finger.values()]
        return np.array([*values, self.spacing_mm], dtype=float)

    @classmethod
    def from_unit_vector(cls, unit: Any, *, geometry: str | Mapping[str, Any] = "fin_ray", **settings: Any) -> Design:
        """Return the design at a point of the unit cube over the search ranges; whole numbers by uniform bins.

        ``unit``: shape (3 * parameters + 1,), each in [0, 1]. Otherwise as `from_vector`.
        """
        parameters = design_parameters(geometry)
        values = _read_vector(unit, parameters)
        for i, ((path, _), u) in enumerate(zip(parameters, values)):
            if not 0.0 <= u <= 1.0:
                raise InputError(f"must be a number from 0 to 1, not {u:g}", where=f"unit vector: entry {i} ({path})")
        decoded = [_from_unit(p, u) for (_, p), u in zip(parameters, values)]
        return cls.from_vector(decoded, geometry=geometry, **settings)

    def to_unit_vector(self, *, clip: bool = False) -> np.ndarray:
        """Return the point of the unit cube, shape (3 * parameters + 1,); whole numbers at the centre of their bin.

        A value outside its search range has no such point: ``InputError``, or the nearest one with ``clip``.
        """
        units = np.array([_to_unit(p, value) for (_, p), value in zip(self.parameters, self.to_vector())])
        for (path, p), u, value in zip(self.parameters, units, self.to_vector()):
            if not clip and not 0.0 <= u <= 1.0:
                raise InputError(f"{value:g} lies outside the search range {p.low:g} to {p.high:g}", where=path)
        return np.clip(units, 0.0, 1.0)

    @property
    def parameters(self) -> tuple[tuple[str, Parameter], ...]:
        """JSON path and `Parameter` of every entry of the vector."""
        return _with_paths(type(self._geometry).finger_parameters)

    # -- values -----------------------------------------------------------------------------------------------------

    @property
    def name(self) -> str:
        """The design's name; it changes nothing."""
        return self.document.get("name", "unnamed")

    @cached_property
    def fingers(self) -> tuple[Mapping[str, float], ...]:
        """The three fingers' values under their JSON keys, in JSON units."""
        return self.document.get("fingers") or (self.document["finger"],) * FINGER_COUNT

    @property
    def spacing_mm(self) -> float:
        """Distance of each finger's base from the gripper's axis [mm]."""
        return self.document["spacing_mm"]

    @property
    def spacing(self) -> float:
        """Distance of each finger's base from the gripper's axis [m]."""
        return self.spacing_mm * si_factor(SPACING.key)

    @property
    def workspace(self) -> float:
        """Area of the triangle between the finger bases [m^2]: 3 sqrt(3)/4 spacing^2, the paper's first feature."""
        return 3.0 * math.sqrt(3.0) / 4.0 * self.spacing**2

    def finger_si(self, index: int) -> dict[str, float]:
        """Return a finger's values in SI, under the geometry's parameter names (``length``, without unit)."""
        return finger_si(self._geometry.finger_parameters, self.fingers[index])

    @cached_property
    def material(self) -> Material:
        """The fingers' material, in SI."""
        return self._material_section.material()

    @cached_property
    def protocol(self) -> GraspProtocol:
        """The constants of a grasp."""
        return GraspProtocol(**self.document.get("protocol", {}))

    @property
    def forced_effects(self) -> Mapping[str, str]:
        """Effect -> "on" or "off", of those that are not left to themselves (see `finqd.effects`)."""
        return self.document.get("effects", {})

    @property
    def settings(self) -> dict[str, Any]:
        """What the design sets besides fingers and spacing: ``Design.from_vector(vector, **design.settings)``."""
        return {key: value for key, value in self.to_dict().items() if key not in ("finger", "fingers", "spacing_mm")}

    def spec(self, kind: str) -> Any:
        """Return name and set options of the plugin of a kind, ``{"name": ...}``; for features a list of them."""
        spec: Any = json.loads(json.dumps(self.document.get(kind, DEFAULT_PLUGINS.get(kind)), default=dict))
        return [_named(one) for one in spec] if kind == "features" else _named(spec)

    def plugin(self, kind: str) -> Any:
        """Return the plugin of a kind with the design's options; for ``features`` a tuple. Raises ``PluginError``."""
        if kind == "geometry":
            return self._geometry
        if kind == "features":
            return tuple(registry.create(kind, spec, where=kind) for spec in self.spec(kind))
        return registry.create(kind, self.spec(kind) if kind in DEFAULT_PLUGINS else kind, where=kind)

    @cached_property
    def _geometry(self) -> Any:
        return registry.create("geometry", self.spec("geometry"), where="geometry")

    @property
    def _material_section(self) -> MaterialSection:
        return MaterialSection(**self.document.get("material", {}))


def design_parameters(geometry: str | Mapping[str, Any] = "fin_ray") -> tuple[tuple[str, Parameter], ...]:
    """Return JSON path and `Parameter` of every entry of a design vector of a geometry: the search space."""
    return _with_paths(type(registry.create("geometry", geometry, where="geometry")).finger_parameters)


def parse_setting(text: str) -> tuple[str, Any]:
    """Return key and value of ``key=value``; the value is read as JSON, else taken as a text.

    >>> parse_setting("protocol.hold_s=2"), parse_setting("mesher=tetrahedral")
    (('protocol.hold_s', 2), ('mesher', 'tetrahedral'))
    """
    key, equals, value = text.partition("=")
    if not (equals and key.strip()):
        raise InputError(f"must be key=value, as in protocol.hold_s=2, not {text!r}", where="--set")
    try:
        return key.strip(), json.loads(value)
    except (ValueError, RecursionError):
        return key.strip(), value.strip()


def _with_paths(finger_parameters: Sequence[Parameter]) -> tuple[tuple[str, Parameter], ...]:
    paths = [(f"fingers[{i}].{p.key}", p) for i in range(FINGER_COUNT) for p in finger_parameters]
    return (*paths, (SPACING.key, SPACING))


def _read_vector(vector: Any, parameters: Sequence[tuple[str, Parameter]]) -> list[float]:
    """Return the entries of a vector of the right length, finite."""
    try:
        values = np.asarray(vector, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"must be {len(parameters)} numbers", where="vector") from error
    if values.shape != (len(parameters),):
        shape = " x ".join(map(str, values.shape)) or "one number"
        raise InputError(f"must be {len(parameters)} numbers, not {shape}", where="vector")
    for i, (path, _) in enumerate(parameters):
        if not np.isfinite(values[i]):
            raise InputError(f"must be a finite number, not {values[i]}", where=f"vector: entry {i} ({path})")
    return values.tolist()


def _from_unit(parameter: Parameter, u: float) -> float:
    low, high = parameter.low, parameter.high
    if parameter.integer:
        return min(low + int(u * (high - low + 1)), high)
    return min(low + u * (high - low), high)


def _to_unit(parameter: Parameter, value: float) -> float:
    if parameter.integer:
        return (value - parameter.low + 0.5) / (parameter.high - parameter.low + 1)
    return (value - parameter.low) / (parameter.high - parameter.low)


def _named(spec: Any) -> dict[str, Any]:
    return {"name": spec} if isinstance(spec, str) else spec


def _options_of(spec: Mapping[str, Any], kind: str) -> dict[str, Any]:
    return {"name": spec["name"], **plugin_options(registry.create(kind, spec, where=kind))}


def _frozen(value: Any) -> Any:
    if isinstance(value, Mapping):
        return MappingProxyType({key: _frozen(one) for key, one in value.items()})
    return tuple(_frozen(one) for one in value) if isinstance(value, list) else value
