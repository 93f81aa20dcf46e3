"""The closed list of effects: what a simulation may take into account, when that is needed, and what leaves it out.

A design's ``effects`` is ``"auto"`` (the default), a list of those that are on, or an object that forces single ones:

>>> read_effects({"friction": "off", "inertia": "auto"}, "effects")
{'friction': 'off'}
>>> len(read_effects(["object_contact", "friction", "floor"], "effects"))  # all others are off
9

Those between bodies cost nothing until bodies come within reach of each other; a result says when that was. All others
are known from the design, before the first step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from finqd.errors import InputError
from finqd.options import join, refuse_unknown, require_object, shown

if TYPE_CHECKING:
    from finqd.design import Design

STATES = ("on", "off", "auto")


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One effect.

    what: it is; needed: when (of contacts, a bound that is looked at all the time); plain: on or off and why, with the
    plugins that a design has by default; fixed: why it cannot be forced on, if it cannot
    """

    what: str
    needed: str
    plain: str
    fixed: str = ""


EFFECTS: dict[str, Effect] = {
    "object_contact": Effect(
        what="fingers press on the object",
        needed="a finger's box reaches the ball that the object fits into",
        plain="on: as soon as a finger comes within reach of the object",
    ),
    "friction": Effect(
        what="Coulomb friction of all that touches", needed="bodies touch, and a coefficient is above 0",
        plain="on: wherever bodies touch",
    ),
    "floor": Effect(
        what="object and fingers lie on the floor", needed="a body is within reach of the floor",
        plain="on: as soon as a body is within reach of it",
    ),
    "self_contact": Effect(
        what="walls and ribs of one finger touch each other",
        needed="faces of one finger come nearer than their gap and a margin",
        plain="on: as soon as walls and ribs of one finger come near each other (contact.soft_contact)",
    ),
    "finger_to_finger_contact": Effect(
        what="fingers touch each other", needed="faces of two fingers come nearer than their gap and a margin",
        plain="on: as soon as fingers come near each other (contact.soft_contact)",
    ),
    "inertia": Effect(
        what="masses of the fingers resist acceleration; the object's own always do",
        needed="always",
        plain="on: always",
    ),
    "damping": Effect(
        what="Rayleigh damping of the material", needed="the material has any",
        plain="off: only what implicit Euler itself dissipates",
        fixed="the material has none; give material.rayleigh_mass_per_s or material.rayleigh_stiffness_ms",
    ),
    "gravity_on_fingers": Effect(
        what="the fingers' own weight", needed="there is gravity", plain="on: always",
    ),
    "large_rotation": Effect(
        what="elements turn without stretching", needed="always in a grasp: drives turn the fingers",
        plain="on: corotated elements",
    ),
    "material_nonlinearity": Effect(
        what="stress is not linear in the strain (Neo-Hooke)", needed="only if asked for",
        plain="off: the corotated law is linear in the strain",
    ),
    "soft_object": Effect(
        what="the object is elastic", needed="its file makes it soft",
        plain="on for objects whose file makes them soft", fixed="the object's own file makes it soft, by its key soft",
    ),
    "actuator_force_limit": Effect(
        what="drives stall at a contact force", needed="the actuation has a limit",
        plain="on: where the actuation has a limit", fixed="give the actuation a limit (actuation.force_limit_N)",
    ),
}  # fmt: skip


def read_effects(value: Any, where: str) -> dict[str, str]:
    """Return effect -> "on" or "off" of those that are forced, in the order of `EFFECTS`. Raises ``InputError``."""
    if value == "auto":
        return {}
    if isinstance(value, (list, tuple)):
        for i, name in enumerate(value):
            if not isinstance(name, str):
                raise InputError(f"must be the name of an effect, not {shown(name)}", join(where, i))
            refuse_unknown([name], EFFECTS, where)
            if name in value[:i]:
                raise InputError(f"{name!r} is named twice", join(where, i))
        asked = {"material_nonlinearity": "on"} if "material_nonlinearity" in value else {}
        return {name: asked.get(name, "off") for name in EFFECTS if name in asked or name not in value}
    if isinstance(value, str):
        raise InputError(f'must be "auto", a list of effects, or an object, not {shown(value)}', where)
    given = require_object(value, where)
    refuse_unknown(given, EFFECTS, where)
    for name, state in given.items():
        if state not in STATES:
            raise InputError(f'must be one of "on", "off", "auto", not {shown(state)}', join(where, name))
    return {name: given[name] for name in EFFECTS if given.get(name, "auto") != "auto"}


def effects_schema() -> dict[str, Any]:
    """Return the JSON Schema of a design's ``effects``."""
    return {
        "oneOf": [
            {"const": "auto"},
            {"type": "array", "items": {"enum": list(EFFECTS)}, "uniqueItems": True,
             "description": "those that are on; all others are off"},
            {"type": "object", "additionalProperties": False,
             "properties": {
                 name: {"enum": list(STATES), "default": "auto",
                        "description": f"{effect.what}; needed: {effect.needed}"}
                 for name, effect in EFFECTS.items()
             }},
        ],
        "default": "auto",
    }


def effects_of(design: Design) -> dict[str, str]:
    """Return effect -> on or off, and why, of a design's simulations.

    What other plugins than the default ones do is read off them: an elasticity may declare ``small_rotation = True``, a
    stepper ``inertia = False``, and any of elasticity, stepper and contact a mapping ``effects`` of the same kind as
    this one. What the design forces has the last word.
    """
    forced = {name: f"{state}: effects.{name} is {state}" for name, state in design.forced_effects.items()}
    design = with_effects(design)
    found = {name: effect.plain for name, effect in EFFECTS.items()}
    elasticity, stepper = (design.spec(kind)["name"] for kind in ("elasticity", "stepper"))
    if elasticity != "corotated":
        small = getattr(design.plugin("elasticity"), "small_rotation", False)
        found["large_rotation"] = f"{'off' if small else 'on'}: the elasticity {elasticity}"
        found["material_nonlinearity"] = "off: linear elasticity" if small else f"as in the elasticity {elasticity}"
    if stepper != "implicit_euler":
        if not getattr(design.plugin("stepper"), "inertia", True):
            found["inertia"] = f"off for the fingers: the stepper {stepper}; on for the object"
        found["damping"] = f"off: only what the stepper {stepper} itself dissipates"
    found["damping"] = _damping(design) or found["damping"]
    for kind in ("elasticity", "stepper", "contact"):
        found.update(getattr(design.plugin(kind), "effects", {}))
    return {**found, **forced}


def _damping(design: Design) -> str:
    """Return what the material's damping does, or nothing if it has none."""
    material = design.resolved()["material"]
    parts = [
        text.format(material[key])
        for key, text in (("rayleigh_mass_per_s", "{:g} per s by the mass"),
                          ("rayleigh_stiffness_ms", "{:g} ms by the stiffness")) if material[key]
    ]
    if not parts:
        return ""
    stepper = design.spec("stepper")["name"]
    if not getattr(design.plugin("stepper"), "inertia", True):
        return f"off: the stepper {stepper} takes no notice of the material's damping ({' and '.join(parts)})"
    return f"on: of the material, {' and '.join(parts)}; besides what the stepper {stepper} itself dissipates"


def effects_seen(
    met: Mapping[tuple[str, str], float], *, fingers: Sequence[str], grasped: str, floor: str,
    rubs: Callable[[str, str], bool],
) -> dict[str, dict[str, Any]]:
    """Return since when [s] each effect between bodies was needed, and why: ``{"since_s": ..., "why": ...}``.

    met: when pairs of bodies first were within reach of each other [s], by name; rubs: whether two have friction
    """
    of = {
        "object_contact": lambda a, b: {a, b} & set(fingers) and grasped in (a, b),
        "floor": lambda a, b: floor in (a, b),
        "self_contact": lambda a, b: a == b and a in fingers,
        "finger_to_finger_contact": lambda a, b: a != b and a in fingers and b in fingers,
        "friction": rubs,
    }
    found: dict[str, dict[str, Any]] = {}
    for name, is_of in of.items():
        times = {pair: time for pair, time in met.items() if is_of(*pair)}
        if not times:
            found[name] = {"since_s": None, "why": "never within reach"}
            continue
        (a, b), since = min(times.items(), key=lambda entry: entry[1])
        who = f"faces of {a} came near each other" if a == b else f"{a} came within reach of {b}"
        found[name] = {"since_s": since, "why": who}
    return found


def refuse_contradictions(design: Design, where: str) -> None:
    """Raise ``InputError`` for an effect that is forced to what the design's plugins or material cannot be."""
    for name, state in design.forced_effects.items():
        reason = _contradiction(design, name, state)
        if reason:
            raise InputError(reason, join(join(where, "effects"), name))


def _contradiction(design: Design, name: str, state: str) -> str:
    """Return why an effect cannot be forced to ``state`` in this design, or nothing."""
    elasticity, stepper, contact = (design.spec(kind)["name"] for kind in ("elasticity", "stepper", "contact"))
    if state == "on" and EFFECTS[name].fixed and not (name == "damping" and _damped(design)):
        return f"cannot be forced on: {EFFECTS[name].fixed}"
    if (name, state) == ("material_nonlinearity", "on") and design.forced_effects.get("large_rotation") == "off":
        return "cannot be on while large_rotation is off"
    if name in SOFT and state == "on" and not design.spec("contact").get("soft_contact", True):
        return "cannot be on while contact.soft_contact is false"
    wanted = {
        ("inertia", "off"): (stepper, ("implicit_euler", "quasi_static")),
        ("inertia", "on"): (stepper, tuple({"implicit_euler", stepper} - {"quasi_static"})),
        ("large_rotation", "off"): (elasticity, ("corotated", "linear")),
        ("large_rotation", "on"): (elasticity, tuple({"corotated", elasticity} - {"linear"})),
        ("material_nonlinearity", "off"): (elasticity, tuple({"corotated", elasticity} - {"neo_hookean"})),
        ("material_nonlinearity", "on"): (elasticity, tuple({"corotated", elasticity} - {"linear"})),
        **{(pair, "off"): (contact, tuple({"penalty", contact} - {"ipc"})) for pair in BETWEEN},
    }
    if (name, state) in wanted:
        has, may = wanted[name, state]
        if has not in may:
            return f"cannot be {state} with the {_kind(name)} {has}"
    return ""


#: effects that are contacts of fingers; they are left out of the scene
SOFT = ("self_contact", "finger_to_finger_contact")
BETWEEN = ("object_contact", *SOFT)


def _kind(name: str) -> str:
    return {"inertia": "stepper"}.get(name, "contact" if name in BETWEEN else "elasticity")


def _damped(design: Design) -> bool:
    material = design.resolved()["material"]
    return bool(material["rayleigh_mass_per_s"] or material["rayleigh_stiffness_ms"])


def with_effects(design: Design) -> Design:
    """Return the design whose plugins, material and protocol do what its forced effects say.

    What is left of its ``effects`` are those that are left out of the scene (`finqd.grasp`).
    """
    document = design.to_dict()
    kept = {}
    for name, state in design.forced_effects.items():
        change = _CHANGES.get((name, state))
        if change is None:
            kept[name] = state
        else:
            change(document, design)
    document.pop("effects", None)
    if kept:
        document["effects"] = kept
    return type(design)(document, design.source)


def _without_friction(document: dict[str, Any], design: Design) -> None:
    own = {key for key in document.get("protocol", {}) if key.startswith("friction_")}
    protocol = {key: value for key, value in document.get("protocol", {}).items() if key not in own}
    document["protocol"] = {**protocol, "friction_coefficient": 0.0}


def _without_damping(document: dict[str, Any], design: Design) -> None:
    damping = ("rayleigh_mass_per_s", "rayleigh_stiffness_ms")
    document["material"] = {key: value for key, value in document.get("material", {}).items() if key not in damping}


def _without_inertia(document: dict[str, Any], design: Design) -> None:
    from dataclasses import fields

    from finqd import registry

    known = {field.name for field in fields(registry.load("stepper", "quasi_static"))} - {"max_iterations"}
    options = {key: value for key, value in design.spec("stepper").items() if key in known}
    document["stepper"] = {"name": "quasi_static", **options}


def _with_elasticity(name: str) -> Callable[[dict[str, Any], Design], None]:
    def change(document: dict[str, Any], design: Design) -> None:
        if design.spec("elasticity")["name"] == "corotated":
            document["elasticity"] = name

    return change


def _without_limit(document: dict[str, Any], design: Design) -> None:
    spec = design.plugin("actuation")
    if hasattr(spec, "force_limit_N"):
        document["actuation"] = {**design.spec("actuation"), "force_limit_N": NO_LIMIT}


NO_LIMIT = 1e6  # [N]: no drive ever reaches it

_CHANGES: Mapping[tuple[str, str], Callable[[dict[str, Any], Design], None]] = {
    ("friction", "off"): _without_friction,
    ("damping", "off"): _without_damping,
    ("inertia", "off"): _without_inertia,
    ("large_rotation", "off"): _with_elasticity("linear"),
    ("material_nonlinearity", "on"): _with_elasticity("neo_hookean"),
    ("actuator_force_limit", "off"): _without_limit,
}
