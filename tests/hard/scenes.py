"""Bodies and scenes that several families of hard cases share."""

from __future__ import annotations

from typing import Any

import numpy as np

from finqd.mechanics.material import Material
from finqd.mesh_shapes import box_mesh
from finqd.objects import GraspObject, load_object
from finqd.scene import Scene, SoftBody

CONTACTS = ("penalty", "ipc")
STEPPERS = ("implicit_euler", "bdf2")
#: slip a step [m] at which a contact model's friction is full: one that calls for the share f of it creeps by
#: 1 - sqrt(1 - f) of this a step (`finqd.plugins.contact_ipc.Ipc`)
CREEP = {"penalty": 0.0, "ipc": 1e-6}


def rubber(*, youngs_modulus: float = 1e6, poisson_ratio: float = 0.4) -> Material:
    """Return the material that cases vary around."""
    return Material(youngs_modulus=youngs_modulus, poisson_ratio=poisson_ratio, density=1000.0)


def thing(kind: str, *, mass_g: float = 20.0, **size: Any) -> GraspObject:
    """Return a rigid object."""
    return load_object({"name": "thing", "shape": {"kind": kind, **size}, "mass_g": mass_g})


def block(
    scene: Scene, *, height: float, scale: float = 1.0, material: Material | None = None, elasticity: str = "corotated"
) -> SoftBody:
    """Add a soft block of 20 x 20 x 10 mm times ``scale`` whose underside is at ``height`` [m]."""
    pose = np.eye(4)
    pose[2, 3] = height
    mesh = box_mesh((0.02 * scale, 0.02 * scale, 0.01 * scale), (3, 3, 2)).transformed(pose)
    return scene.add_soft(mesh, rubber() if material is None else material, elasticity=elasticity)
