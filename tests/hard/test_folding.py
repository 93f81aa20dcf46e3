"""Fingers that touch themselves and each other."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.presets import apply_preset
from finqd.scene import Motion, Scene, Shift, Turn

from .grippers import design, finger_mesh
from .scenes import thing
from .sound import sound

STEPS_MS = [50, *(pytest.param(step, marks=pytest.mark.slow) for step in (1, 2, 5, 10, 20))]
CONTACTS = ["penalty", pytest.param("ipc", marks=pytest.mark.slow)]


def finger_scene(**finger):
    """Return a scene without gravity, the design and the mesh of one of its fingers: x across, y from base to tip."""
    chosen = apply_preset(design(**finger), "draft")
    return Scene(gravity=(0.0, 0.0, 0.0)), chosen, finger_mesh(chosen)


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", STEPS_MS)
def test_ribs_pressed_into_each_other(step, contact):
    """Ten ribs 1 mm thick that lean by 40 degrees: a bar 20 mm deep in the contact face lays them on each other."""
    scene, chosen, mesh = finger_scene(rib_count=10, rib_thickness_mm=1.0, rib_angle_deg=40.0)
    finger = scene.add_soft(mesh, chosen.material, name="finger")
    into = contact_normal(mesh)
    middle = mesh.vertices[contact_vertices(mesh)].mean(axis=0)
    finger.drive("base", Motion(path=Shift(vector=-0.02 * into), duration=0.8))
    bar = scene.add_rigid(thing("box", size_mm=[16, 16, 60]), position=middle - 0.0085 * into, rotation=facing(into))
    bar.held = True
    found, course = sound(scene, duration=1.0, time_step_ms=step, contact=contact, driven=True)
    assert found.contact_forces[-1].max() > 1.0
    assert not touch_themselves(course, 0) and touch_themselves(course, -1), "the ribs come to touch"


@pytest.mark.slow  # three minutes; ribs pressed into each other are the fast twin
@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", STEPS_MS)
def test_a_finger_folded_back_on_itself(step, contact):
    """The last 12 mm are turned back by 150 degrees, about an axis through the finger's middle."""
    scene, chosen, mesh = finger_scene()
    finger = scene.add_soft(mesh, chosen.material, name="finger")
    finger.fix("base")
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    tip = y > y.max() - 0.012
    pivot = (float(x[tip].mean()), 0.5 * float(y.max()), 0.0)
    finger.drive(tip, Motion(path=Turn(point=pivot, axis=(0.0, 0.0, 1.0), angle=np.radians(150.0)), duration=0.8))
    _, course = sound(scene, duration=1.0, time_step_ms=step, contact=contact, driven=True)
    assert not touch_themselves(course, 0) and touch_themselves(course, -1), "it comes to touch itself"


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("step", STEPS_MS)
def test_fingers_that_start_a_millimetre_apart(step, contact):
    """Two of them face to face; one is turned about the near end of its base, by 20 degrees into the other."""
    scene, chosen, mesh = finger_scene()
    into = contact_normal(mesh)
    opposite = np.diag([-1.0, 1.0, -1.0, 1.0])
    other = mesh.transformed(opposite)
    turned = opposite[:3, :3] @ into
    lean = np.arctan2(into[1], into[0]) - np.arctan2(-turned[1], -turned[0])
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(lean), -np.sin(lean)], [np.sin(lean), np.cos(lean)]]
    other = other.transformed(pose)
    shift = np.eye(4)
    shift[:3, 3] = mesh.vertices[contact_vertices(mesh)].mean(axis=0) - other.vertices[contact_vertices(other)].mean(0)
    shift[:3, 3] -= 1e-3 * into
    other = other.transformed(shift)
    one = scene.add_soft(mesh, chosen.material, name="one")
    two = scene.add_soft(other, chosen.material, name="two")
    face = mesh.vertices[contact_vertices(mesh)]
    hinge = face[np.argmin(face[:, 1])] + 2e-3 * into
    angle = np.radians(20.0) * np.sign(into[0])
    one.drive("base", Motion(path=Turn(point=hinge, axis=(0.0, 0.0, 1.0), angle=angle), duration=0.8))
    two.fix("base")
    found, course = sound(scene, duration=1.0, time_step_ms=step, contact=contact, driven=True)
    forces = found.contact_forces[-1]
    assert forces.min() > 1.0 and forces[0] == pytest.approx(forces[1], rel=1e-6)


def contact_vertices(mesh):
    """Return the vertices of a finger's contact face."""
    faces = [mesh.faces[kind][ids] for kind, ids in mesh.face_sets["contact"].items()]
    return np.unique(np.concatenate([f.ravel() for f in faces]))


def contact_normal(mesh):
    """Return the direction into the finger across its contact face, a unit vector in its plane."""
    points = mesh.vertices[contact_vertices(mesh)][:, :2]
    centred = points - points.mean(axis=0)
    across = np.linalg.svd(centred, full_matrices=False)[2][1]
    inwards = mesh.vertices[:, :2].mean(axis=0) - points.mean(axis=0)
    return np.append(across * np.sign(across @ inwards), 0.0)


def facing(into):
    """Return the rotation about z that turns x along ``into``."""
    return np.array([[into[0], -into[1], 0.0], [into[1], into[0], 0.0], [0.0, 0.0, 1.0]])


def touch_themselves(course, when):
    """Tell whether soft faces touch each other in the state number ``when``, as the contact model finds it."""
    contact, state = course.system.contact, course.states[when]
    if hasattr(contact, "soft"):
        contact.soft.find(state.positions)
        return contact.soft.rows.count > 0
    vertices = np.asfortranarray(contact.points.at(state)[: contact.surface.n_vertices])
    rows = contact.pairs.rows(contact.pairs.at(vertices), vertices)
    soft = rows.bodies < len(contact.scene.soft_bodies)
    return bool((soft.all(axis=1) & (rows.force > 0.0)).any())
