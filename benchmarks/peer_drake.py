"""One motion of one soft body by Drake's deformable bodies: a task as JSON comes in, the outcome as JSON goes out.

Started by `peers.py`, in an interpreter that can import ``pydrake``; what a task holds is told in `peer_cases`.
Elements are linear tetrahedra of linear corotated elasticity; SAP solves contact, as deformable bodies know no other.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version
from typing import Any

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import (
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Cylinder,
    GeometryInstance,
    InMemoryMesh,
    Mesh,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.fem import DeformableBodyConfig, MaterialModel
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

CARRIED = 1e6  # [kg] mass of what is carried along: contact does not change its course in a step
EDGE = 0.1  # [radii] edges of the rigid body's triangles: curved surfaces are tessellated for contact


def vtk(task: dict[str, Any]) -> str:
    """Return the mesh as a legacy VTK file."""
    points, cells = task["vertices"], task["tetrahedra"]
    lines = ["# vtk DataFile Version 3.0", "mesh", "ASCII", "DATASET UNSTRUCTURED_GRID", f"POINTS {len(points)} double"]
    lines += [" ".join(f"{x:.17g}" for x in point) for point in points]
    lines += [f"CELLS {len(cells)} {5 * len(cells)}", *(f"4 {a} {b} {c} {d}" for a, b, c, d in cells)]
    lines += [f"CELL_TYPES {len(cells)}", *("10" for _ in cells), ""]
    return "\n".join(lines)


def contact_properties(friction: float) -> ProximityProperties:
    """Return what both bodies are made of as far as contact goes."""
    properties = ProximityProperties()
    AddContactMaterial(properties=properties, friction=CoulombFriction(friction, friction))
    return properties


def add_soft(plant: MultibodyPlant, task: dict[str, Any]) -> Any:
    """Register the soft body, clamped."""
    config = DeformableBodyConfig()
    config.set_youngs_modulus(task["youngs_modulus"])
    config.set_poissons_ratio(task["poisson_ratio"])
    config.set_mass_density(task["density"])
    config.set_stiffness_damping_coefficient(task["damping_s"])
    config.set_material_model(MaterialModel.kLinearCorotated)
    mesh = Mesh(InMemoryMesh(mesh_file=MemoryFile(vtk(task), ".vtk", "soft")))
    shape = GeometryInstance(RigidTransform(), mesh, "soft")
    shape.set_proximity_properties(contact_properties(task["friction"]))
    model = plant.mutable_deformable_model()
    body = model.RegisterDeformableBody(shape, config, 1.0)
    model.SetWallBoundaryCondition(body, np.array(task["clamp_point"]), np.array(task["clamp_normal"]))
    return body


def add_rigid(plant: MultibodyPlant, rigid: dict[str, Any] | None, friction: float) -> Any:
    """Add the rigid body of a task, free or on a slide that carries it along; return the slide, if any."""
    if rigid is None:
        return None
    r = rigid["radius"]
    if rigid["shape"] == "sphere":
        shape, inertia = Sphere(r), UnitInertia.SolidSphere(r)
    else:
        shape = Cylinder(r, 2.0 * rigid["half_length"])
        inertia = UnitInertia.SolidCylinder(r, 2.0 * rigid["half_length"], [0.0, 0.0, 1.0])
    held = "path" in rigid
    body = plant.AddRigidBody("rigid", SpatialInertia(CARRIED if held else rigid["mass"], np.zeros(3), inertia))
    properties = contact_properties(friction)
    AddRigidHydroelasticProperties(EDGE * r, properties)
    plant.RegisterCollisionGeometry(body, RigidTransform(), shape, "rigid", properties)
    start = RigidTransform(np.array(rigid["position"]))
    if not held:
        plant.SetDefaultFloatingBaseBodyPose(body, start)
        return None
    axis = np.array(rigid["path"]["vector"])
    frame = plant.AddFrame(FixedOffsetFrame("start", plant.world_frame(), start))
    return plant.AddJoint(PrismaticJoint("slide", frame, body.body_frame(), axis / np.linalg.norm(axis)))


def eased(share: float) -> tuple[float, float]:
    """Return the minimum-jerk course that all programs follow, and its slope."""
    s = min(max(share, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0)), 30.0 * s * s * (1.0 - s) ** 2


def carry(slide: Any, context: Any, path: dict[str, Any], time_step: float, step: int) -> None:
    """Let the body begin a step where it was to end the last one, at the speed that this one takes."""
    way, h = float(np.linalg.norm(path["vector"])), time_step
    now, _ = eased(step * h / path["duration"])
    then, _ = eased((step + 1) * h / path["duration"])
    slide.set_translation(context, way * now)
    slide.set_translation_rate(context, way * (then - now) / h)


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Step through the motion."""
    begun = time.process_time()
    rigid, h = task["rigid"], task["time_step"]
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(
        MultibodyPlantConfig(time_step=h, discrete_contact_approximation="sap", use_sampled_output_ports=False), builder
    )
    soft = add_soft(plant, task)
    slide = add_rigid(plant, rigid, task["friction"])
    plant.mutable_gravity_field().set_gravity_vector(np.array(task["gravity"]))
    plant.Finalize()
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context, model = plant.GetMyMutableContextFromRoot(root), plant.deformable_model()
    rest = before = model.GetPositions(context, soft).T.copy()
    set_up = time.process_time() - begun
    steps, limit = round(task["duration"] / h), time.process_time() + task["limit_s"]
    simulator = Simulator(diagram, root)
    simulator.Initialize()
    for i in range(steps):
        if slide is not None:
            carry(slide, context, rigid["path"], h, i)
        before = model.GetPositions(context, soft).T.copy() if i == steps - 1 else before
        simulator.AdvanceTo((i + 1) * h)
        if time.process_time() > limit:
            return {"failed": f"not done after {task['limit_s']:g} s ({i + 1} of {steps} steps)", "steps": i + 1}
    seconds = time.process_time() - begun - set_up
    now = model.GetPositions(context, soft).T
    if not np.isfinite(now).all():
        return {"failed": "numbers that are not finite", "steps": steps}
    results = plant.get_contact_results_output_port().Eval(context)
    contacts = [results.deformable_contact_info(i) for i in range(results.num_deformable_contacts())]
    forces = [contact.F_Ac_W().translational() for contact in contacts]
    place = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("rigid")).translation() if rigid else np.zeros(3)
    return {
        "failed": "", "seconds": seconds, "set_up_s": set_up, "steps": steps,
        "displacement": (now - rest)[task["watched"]].mean(axis=0).tolist(),
        "last_move": float(np.abs(now - before).max()),
        "force": (-np.sum(forces, axis=0)).tolist() if forces else [0.0] * 3,
        "rigid_displacement": (place - np.array(rigid["position"])).tolist() if rigid else [0.0] * 3,
    }


def main() -> None:
    """Read a task, print the outcome."""
    task = json.load(sys.stdin)
    about = {
        "program": f"Drake {version('drake')}", "element": "tet4", "law": "linear corotated", "solver": "SAP",
    }
    json.dump({**about, **run(task)}, sys.stdout)


if __name__ == "__main__":
    main()
