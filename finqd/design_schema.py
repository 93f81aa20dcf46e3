"""What a design file may hold: its sections and their ranges, checked value by value, and the same as JSON Schema.

The finger's part follows from the geometry plugin's declared parameters, the plugins' parts from their fields, the
protocol and the material from the dataclasses here: nothing is written down twice.
"""

from __future__ import annotations

import numbers
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le

from finqd import registry
from finqd.contracts import Parameter
from finqd.effects import effects_schema, read_effects
from finqd.errors import InputError, PluginError
from finqd.mechanics.material import Material
from finqd.options import checked_fields, in_words, join, option_schemas, refuse_unknown, require_object, shown
from finqd.protocol import GraspProtocol
from finqd.units import si_factor

FINGER_COUNT = 3

#: radius of the circle on which the three finger bases are mounted; the paper calls it the distance between fingers
SPACING = Parameter(
    name="spacing", unit="mm", low=30, high=40, allowed_low=15, allowed_high=120, symbol="d_mount",
    description="distance of each finger's base from the gripper's axis",
)

#: kind -> plugin (a list for features) where a design file names none; a geometry must be named
DEFAULT_PLUGINS: dict[str, Any] = {
    "mesher": "swept", "elasticity": "corotated", "stepper": "implicit_euler", "contact": "penalty",
    "actuation": "rotate", "fitness": "share_held", "features": ["workspace", "volume"],
}

#: keys of a design file, in the order in which they are written
KEYS = (
    "name", "description", "geometry", "finger", "fingers", "spacing_mm", "material", *DEFAULT_PLUGINS, "effects",
    "protocol",
)  # fmt: skip

#: texts that a design file may hold, and how long they may be; they change nothing
TEXTS = {"name": 100, "description": 1000}


def _constant(default: float, description: str) -> Any:
    return field(default=default, metadata={"description": description})


@dataclass(frozen=True, kw_only=True)
class MaterialSection:
    """The fingers' material in JSON units; the defaults are the paper's (Shore 85A), the density ours."""

    youngs_modulus_MPa: Annotated[float, Gt(0), Le(1e6)] = _constant(11.6, "Young's modulus")
    poisson_ratio: Annotated[float, Ge(0), Le(0.4999)] = _constant(0.49, "Poisson's ratio")
    density_kg_m3: Annotated[float, Gt(0), Le(30000)] = _constant(1150.0, "density")
    rayleigh_mass_per_s: Annotated[float, Ge(0), Le(1e5)] = _constant(
        0.0, "Rayleigh damping by the mass (alpha): rate at which momentum decays; brakes motion as a whole too"
    )
    rayleigh_stiffness_ms: Annotated[float, Ge(0), Le(1e4)] = _constant(
        0.0, "Rayleigh damping by the stiffness (beta): stress against the rate of strain; brakes no rigid motion"
    )

    def material(self) -> Material:
        """Return the material in SI."""
        return Material(
            youngs_modulus=self.youngs_modulus_MPa * si_factor("youngs_modulus_MPa"),
            poisson_ratio=self.poisson_ratio,
            density=self.density_kg_m3 * si_factor("density_kg_m3"),
            rayleigh_mass=self.rayleigh_mass_per_s * si_factor("rayleigh_mass_per_s"),
            rayleigh_stiffness=self.rayleigh_stiffness_ms * si_factor("rayleigh_stiffness_ms"),
        )


def read_document(document: Mapping[str, Any], place: str) -> tuple[dict[str, Any], list[str]]:
    """Return a design document checked and in its one canonical form, and warnings.

    Only what the document sets is in it, keys in the order of `KEYS`, numbers as floats (or ints where they count),
    three equal fingers as one ``finger``. ``place`` is put in front of what is wrong. Raises ``InputError``.
    """
    document = {key: value for key, value in document.items() if key != "$schema"}
    refuse_unknown(document, KEYS, place)
    read: dict[str, Any] = {}
    for key, length in TEXTS.items():
        if key in document:
            read[key] = _read_text(document[key], length, join(place, key))
    if "geometry" not in document:
        known = ", ".join(registry.names("geometry"))
        raise InputError(f"missing; must name a geometry plugin (known: {known})", join(place, "geometry"))
    geometry = registry.create("geometry", document["geometry"], where=join(place, "geometry"))
    read["geometry"] = _written(document["geometry"], geometry)
    fingers, warnings = _read_fingers(document, geometry, place)
    read.update(fingers)
    where = join(place, "spacing_mm")
    read["spacing_mm"] = read_number(SPACING, document.get("spacing_mm", _MISSING), where)
    warnings += _range_warning(SPACING, read["spacing_mm"], "spacing_mm")
    for key, owner in (("material", MaterialSection), ("protocol", GraspProtocol)):
        if key in document:
            read[key] = checked_fields(owner, document[key], join(place, key))
    for kind in DEFAULT_PLUGINS:
        if kind in document:
            read[kind] = _read_plugins(kind, document[kind], join(place, kind))
    if "effects" in document:
        forced = read_effects(document["effects"], join(place, "effects"))
        if forced:  # "auto" is what a design without them has
            read["effects"] = forced
    _check_damping(read, join(join(place, "material"), "rayleigh_stiffness_ms"))
    return {key: read[key] for key in KEYS if key in read}, warnings


def _check_damping(read: Mapping[str, Any], where: str) -> None:
    """Raise ``InputError`` for a stiffness damping that the stepper does not know."""
    given = read.get("material", {}).get("rayleigh_stiffness_ms", 0.0)
    if given:
        spec = read.get("stepper", DEFAULT_PLUGINS["stepper"])
        name = spec if isinstance(spec, str) else spec["name"]
        if not getattr(registry.load("stepper", name), "stiffness_damping", True):
            raise InputError(f"must be 0 with the stepper {name}, which has no damping by the stiffness", where)


def read_number(parameter: Parameter, value: Any, where: str) -> float:
    """Return a parameter's value in JSON units; raise ``InputError`` unless it is a number in its allowed range."""
    number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    # the comparison refuses NaN too, and takes ints of any size
    fits = number and parameter.allowed_low <= value <= parameter.allowed_high
    if not fits or (parameter.integer and value != int(value)):
        must = f"must be {in_words(parameter_schema(parameter))}"
        raise InputError(f"missing; {must}" if value is _MISSING else f"{must}, not {shown(value)}", where)
    return int(value) if parameter.integer else float(value) + 0.0  # -0.0 becomes 0.0: one spelling for each value


def finger_si(parameters: Sequence[Parameter], finger: Mapping[str, float]) -> dict[str, float]:
    """Return a finger's values (keys as in JSON) under their parameters' names, in SI."""
    return {p.name: finger[p.key] if p.integer else finger[p.key] * si_factor(p.key) for p in parameters}


def plugin_options(plugin: Any) -> dict[str, Any]:
    """Return all options of a plugin, as JSON values."""
    from pydantic_core import to_jsonable_python

    return {f.name: to_jsonable_python(getattr(plugin, f.name)) for f in fields(plugin) if f.init}


def constants(owner: MaterialSection | GraspProtocol) -> dict[str, float]:
    """Return a section with its defaults filled in, under its JSON keys."""
    return asdict(owner)


def _read_text(value: Any, length: int, where: str) -> str:
    if not (isinstance(value, str) and 0 < len(value) <= length and value.isprintable() and value.strip()):
        raise InputError(f"must be a text of 1 to {length} printable characters, not {shown(value)}", where)
    return value


def _read_fingers(document: Mapping[str, Any], geometry: Any, place: str) -> tuple[dict[str, Any], list[str]]:
    """Return ``{"finger": ...}`` or ``{"fingers": [...]}``, and warnings."""
    if "finger" in document and "fingers" in document:
        raise InputError('give either "finger" or "fingers", not both', join(place, "fingers"))
    if "finger" in document:
        where = {join(place, "finger"): document["finger"]}
    elif "fingers" in document:
        given = document["fingers"]
        if not isinstance(given, (list, tuple)) or len(given) != FINGER_COUNT:
            count = f"{len(given)} given" if isinstance(given, (list, tuple)) else f"not {shown(given)}"
            text = f'must be a list of exactly {FINGER_COUNT} fingers, {count} (or "finger" once, for equal ones)'
            raise InputError(text, join(place, "fingers"))
        where = {join(join(place, "fingers"), i): finger for i, finger in enumerate(given)}
    else:
        raise InputError(f'missing; give it once, or "fingers" as a list of {FINGER_COUNT}', join(place, "finger"))
    fingers = [_read_finger(geometry, finger, path) for path, finger in where.items()]
    if all(finger == fingers[0] for finger in fingers):
        read: dict[str, Any] = {"finger": fingers[0]}
        paths = ["finger"]
    else:
        read, paths = {"fingers": fingers}, [f"fingers[{i}]" for i in range(FINGER_COUNT)]
    warnings = []
    for path, finger in zip(paths, fingers):
        for parameter in geometry.finger_parameters:
            warnings += _range_warning(parameter, finger[parameter.key], f"{path}.{parameter.key}")
    return read, warnings


def _read_finger(geometry: Any, finger: Any, where: str) -> dict[str, float]:
    parameters = geometry.finger_parameters
    require_object(finger, where)
    refuse_unknown(finger, [p.key for p in parameters], where)
    read = {p.key: read_number(p, finger.get(p.key, _MISSING), join(where, p.key)) for p in parameters}
    contradiction = geometry.check(finger_si(parameters, read))
    if contradiction:
        raise InputError(contradiction, where)
    return read


def _range_warning(parameter: Parameter, value: float, path: str) -> list[str]:
    if parameter.low <= value <= parameter.high:
        return []
    return [f"{path}: {value:g} lies outside the search range {parameter.low:g} to {parameter.high:g}"]


def _read_plugins(kind: str, spec: Any, where: str) -> Any:
    if kind != "features":
        return _written(spec, registry.create(kind, spec, where=where))
    if not isinstance(spec, (list, tuple)):
        raise PluginError(f"must be a list of features plugins, not {shown(spec)}", where)
    read = [_written(one, registry.create(kind, one, where=join(where, i))) for i, one in enumerate(spec)]
    names = [one if isinstance(one, str) else one["name"] for one in read]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise PluginError(f"{name!r} is named twice", join(where, i))
    return read


def _written(spec: Any, plugin: Any) -> Any:
    """Return a checked plugin specification in its canonical form: the options it sets, as the plugin took them."""
    if isinstance(spec, str) or len(spec) == 1:
        return spec if isinstance(spec, str) else spec["name"]
    options = plugin_options(plugin)
    return {"name": spec["name"], **{key: options[key] for key in options if key in spec}}


class _Missing:
    """Stands for a key that a document lacks, where null is a value of its own."""


_MISSING = _Missing()


def parameter_schema(parameter: Parameter) -> dict[str, Any]:
    """Return the JSON Schema of one parameter: its allowed range, and in words its search range."""
    words = [parameter.description, f"{parameter.symbol} in the paper" if parameter.symbol else ""]
    words.append(f"search range {parameter.low:g} to {parameter.high:g}")
    return {
        "type": "integer" if parameter.integer else "number",
        "minimum": parameter.allowed_low, "maximum": parameter.allowed_high,
        "description": "; ".join(filter(None, words)),
    }


def design_schema(geometry: str = "fin_ray") -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of design files of one geometry, with all registered plugins' options.

    What it cannot say (walls thicker than the finger, a key given twice) only the check of a file says.
    """
    parameters = registry.load("geometry", geometry).finger_parameters  # type: ignore[attr-defined]
    finger = _object_schema({p.key: parameter_schema(p) for p in parameters}, required=[p.key for p in parameters])
    properties: dict[str, Any] = {
        "$schema": {"type": "string"},
        **{key: {"type": "string", "minLength": 1, "maxLength": n, "pattern": "\\S"} for key, n in TEXTS.items()},
        "geometry": _plugin_schema("geometry", [geometry]),
        "finger": {"$ref": "#/$defs/finger"},
        "fingers": {
            "type": "array", "minItems": FINGER_COUNT, "maxItems": FINGER_COUNT, "items": {"$ref": "#/$defs/finger"}
        },
        "spacing_mm": parameter_schema(SPACING),
        "material": _object_schema(option_schemas(MaterialSection)),
        "effects": effects_schema(),
        "protocol": _object_schema(option_schemas(GraspProtocol)),
    }
    for kind, default in DEFAULT_PLUGINS.items():
        one = _plugin_schema(kind, registry.names(kind))
        many = {"type": "array", "items": one, "uniqueItems": True}
        properties[kind] = {**(many if kind == "features" else one), "default": default}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"finqd design ({geometry})",
        **_object_schema({key: properties[key] for key in ("$schema", *KEYS)}, required=["geometry", "spacing_mm"]),
        "oneOf": [{"required": ["finger"]}, {"required": ["fingers"]}],
        "$defs": {"finger": finger},
    }


def _object_schema(properties: dict[str, Any], required: Sequence[str] = ()) -> dict[str, Any]:
    schema = {"type": "object", "properties": properties, "additionalProperties": False}
    return {**schema, "required": list(required)} if required else schema


def _plugin_schema(kind: str, names: Sequence[str]) -> dict[str, Any]:
    choices: list[dict[str, Any]] = [{"enum": list(names)}]
    for name in names:
        options = option_schemas(registry.load(kind, name))
        choices.append(_object_schema({"name": {"const": name}, **options}, required=["name"]))
    return {"oneOf": choices}
