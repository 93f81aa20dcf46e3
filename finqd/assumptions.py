"""What every result of a grasp says of itself beside its effects: reductions, and what was assumed."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from finqd.design import Design

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
    "the object starts at rest on the floor, centred under the gripper unless the protocol moves or turns it",
    "held: dropped less than the threshold relative to the gripper from the start of the lift to the end of the hold",
)
