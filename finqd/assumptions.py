"""What every result of a grasp says of itself: which effects were on, and what was assumed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from finqd.design_schema import DEFAULT_PLUGINS

if TYPE_CHECKING:
    from finqd.design import Design

#: effect -> on or off, and why, with the plugins that a design has by default
EFFECTS = {
    "object_contact": "on: always",
    "friction": "on: always",
    "floor": "on: always",
    "actuator_force_limit": "on: where the actuation has a limit",
    "gravity_on_fingers": "on: always",
    "inertia": "on: always",
    "large_rotation": "on: corotated elements",
    "material_nonlinearity": "off: the corotated law is linear in the strain",
    "damping": "off: only what implicit Euler itself dissipates",
    "self_contact": "on: walls and ribs of one finger touch each other (contact.soft_contact)",
    "finger_to_finger_contact": "on: fingers touch each other (contact.soft_contact)",
    "soft_object": "on for objects whose file makes them soft",
}


def effects_of(design: Design) -> dict[str, str]:
    """Return effect -> on or off, and why, of a design's simulations.

    What other plugins than the default ones do is read off them: an elasticity may declare ``small_rotation = True``, a
    stepper ``inertia = False``, and any of elasticity, stepper and contact a mapping ``effects`` of the same kind as
    `EFFECTS`, which has the last word.
    """
    found = dict(EFFECTS)
    elasticity, stepper = (design.spec(kind)["name"] for kind in ("elasticity", "stepper"))
    if elasticity != DEFAULT_PLUGINS["elasticity"]:
        small = getattr(design.plugin("elasticity"), "small_rotation", False)
        found["large_rotation"] = f"{'off' if small else 'on'}: the elasticity {elasticity}"
        found["material_nonlinearity"] = "off: linear elasticity" if small else f"as in the elasticity {elasticity}"
    if stepper != DEFAULT_PLUGINS["stepper"]:
        if not getattr(design.plugin("stepper"), "inertia", True):
            found["inertia"] = f"off for the fingers: the stepper {stepper}; on for the object"
        found["damping"] = f"off: only what the stepper {stepper} itself dissipates"
    damped = _damping(design)
    if damped:
        found["damping"] = damped
    for kind in ("elasticity", "stepper", "contact"):
        found.update(getattr(design.plugin(kind), "effects", {}))
    return found


def reductions_of(design: Design) -> dict[str, str]:
    """Return reduction -> on or off, and what it does, of a design's simulations: what is left out where nothing is."""
    protocol = design.protocol
    early = "on: a grasp ends where its verdict is certain; `ended` of an object says why (protocol.early_verdict)"
    factor = protocol.calm_step_factor
    return {
        "early_verdict": early if protocol.early_verdict else "off: protocol.early_verdict is false",
        "long_steps": "off: protocol.calm_step_factor is 1" if factor == 1 else
        f"on: up to {factor} time steps at once where nothing happens; what does is gone through in single ones",
    }


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


#: finqd's own choices where the paper gives none
ASSUMPTIONS = (
    "object sizes, density, friction, time step, stroke, lift and hold time are finqd's choices: the paper gives none",
    "finger profile: isosceles triangle unless the design says right, walls measured perpendicular, base plate 2 mm",
    "ribs are clipped by the cavity; N ribs stand at N + 1 equal pitches between the base plate and the tip line",
    "the mount's volume is a 2.75 mm plate over the workspace triangle, chosen to give the paper's benchmark volume",
    "rib centres lie on the line from the base's middle to the apex; a positive tilt lifts a rib's back end",
    "slivers of a hole with less than 1e-4 mm^2 are filled",
    "features are the gripper's as built: the pads that an export adds are in none of them",
    "objects are rigid unless their file makes them soft",
    "a rigid body's inertia is taken at the start of a step, so fast tumbling gains some energy",
    "where fingers touch, sharp edges of objects count as rounded (contact.edge_radius_mm; less, or not, on fine ones)",
    "the mount is rigid: each finger base is driven as a whole",
    "each finger's drive stalls by itself when the sum of the normal contact forces on that finger reaches its limit",
    "the object starts at rest on the floor, centred under the gripper",
    "held: dropped less than the threshold relative to the gripper from the start of the lift to the end of the hold",
)
