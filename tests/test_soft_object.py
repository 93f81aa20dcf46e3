"""Soft objects: what their JSON may say, their mesh, and a grasp of one; friction by pair, fingers without room."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.data import designs_folder
from finqd.design import Design
from finqd.errors import InputError
from finqd.evaluate import evaluate, finger_meshes
from finqd.grasp import GraspTask, grasp_scene
from finqd.objects import load_object
from finqd.presets import apply_preset
from finqd.scene import Scene
from finqd.simulate import simulate

BALL = {"name": "ball", "shape": {"kind": "sphere", "diameter_mm": 30}, "mass_g": 20}
SOFT = {"youngs_modulus_MPa": 0.3, "element_size_mm": 8}
BRIEF = {
    "protocol.close_s": 0.04, "protocol.squeeze_s": 0, "protocol.lift_s": 0.04, "protocol.hold_s": 0,
    "protocol.time_step_ms": 20,
}


def benchmark(**overrides) -> Design:
    changed = {key.replace("__", "."): value for key, value in overrides.items()}
    return apply_preset(Design.from_json(designs_folder() / "benchmark.json"), "draft", overrides=changed)


@pytest.mark.parametrize("soft, said", [
    ({}, "soft.youngs_modulus_MPa: is missing"),
    ({"youngs_modulus_MPa": 0}, "soft.youngs_modulus_MPa"),
    ({"youngs_modulus_MPa": 0.3, "poisson_ratio": 0.5}, "soft.poisson_ratio"),
    ({"youngs_modulus_MPa": 0.3, "stiffness": 1}, "soft"),
    ({"youngs_modulus_MPa": 0.3, "elasticity": "jelly"}, "soft.elasticity"),
    (True, "soft"),
])
def test_what_makes_no_sense_is_refused_in_one_sentence(soft, said) -> None:
    with pytest.raises(InputError) as told:
        load_object({**BALL, "soft": soft})
    assert said in str(told.value) and "\n" not in str(told.value)


@pytest.mark.parametrize("shape", [{"kind": "sphere", "diameter_mm": 30}, {"kind": "box", "size_mm": [20, 30, 10]}])
def test_the_mesh_fills_the_shape_and_has_its_mass(shape) -> None:
    thing = load_object({**BALL, "shape": shape, "soft": SOFT})
    assert thing.mesh is not None and thing.soft is not None
    assert thing.mesh.volume == pytest.approx(thing.volume, rel=0.06)  # straight edges cut a ball's corners
    scene = Scene()
    body = scene.add_soft(thing.mesh, thing.soft.material(thing.mass / thing.mesh.volume))
    found = simulate(scene, duration=0.01, time_step=0.01)
    assert np.abs(found.soft_centres[0, 0]).max() < 1e-3 * thing.bounding_radius
    assert body.mesh.volume * body.material.density == pytest.approx(0.02)
    assert any("elastic, E = 0.3 MPa" in sentence for sentence in thing.assumptions)


def test_a_grasp_of_a_soft_object_is_a_result_like_any_other() -> None:
    found = evaluate(benchmark(**{key.replace(".", "__"): value for key, value in BRIEF.items()}),
                     objects=[load_object({**BALL, "soft": SOFT})], preset="draft")
    row = found.to_dict()["objects"]["ball"]
    assert row["status"] == "ok" and len(row["final_contact_force_N"]) == 3
    assert row["final_height_mm"] == pytest.approx(15.0, abs=0.5)


def test_friction_is_set_by_pairs_of_materials() -> None:
    design = benchmark(protocol__friction_finger_finger=0.9, protocol__friction_object_floor=0.1)
    solids = [design.plugin("geometry").build(design.finger_si(i)) for i in range(3)]
    scene = grasp_scene(GraspTask(design=design, meshes=finger_meshes(design, solids), grasped=load_object(BALL)))
    assert scene.friction_between("finger 1", "finger 2") == scene.friction_between("finger 3", "finger 3") == 0.9
    assert scene.friction_between("ball", "floor") == 0.1
    assert scene.friction_between("finger 1", "ball") == scene.friction_between("finger 2", "floor") == 0.6


def test_fingers_that_overlap_at_the_start_have_no_room() -> None:
    found = evaluate(benchmark(spacing_mm=15, finger__thickness_mm=80), objects=["sphere"], preset="draft")
    row = found.to_dict()["objects"]["sphere"]
    assert row["status"] == "no_room" and "the open fingers overlap each other" in row["reason"]
