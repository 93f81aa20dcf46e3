"""Where the protocol puts the object: off the axis, turned; and nothing changes for those who ask for neither."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from finqd.data import designs_folder
from finqd.design import Design
from finqd.errors import InputError
from finqd.evaluate import finger_meshes
from finqd.grasp import GraspTask, grasp_scene, object_pose, simulate_grasp
from finqd.objects import load_object
from finqd.presets import apply_preset
from finqd.protocol import GraspProtocol

BENCHMARK = "898af5462fa879c691ecee2ac1d7b8b0e1e922d9f8779d2c9b67d0f50c84a19e"  # before there were these constants


@pytest.fixture(scope="module")
def benchmark():
    return Design.from_json(designs_folder() / "benchmark.json")


@pytest.fixture(scope="module")
def task(benchmark):
    design = apply_preset(benchmark, "draft")
    solids = [design.plugin("geometry").build(design.finger_si(i)) for i in range(3)]
    return GraspTask(design=design, meshes=finger_meshes(design, solids), grasped=load_object("cube"))


def moved(task, **values):
    changes = {f"protocol.{key}": value for key, value in values.items()}
    return replace(task, design=task.design.with_overrides(changes))


def test_digests_are_those_of_before_and_tell_a_moved_object_apart(benchmark):
    zero = {"protocol.object_offset_x_mm": 0.0, "protocol.object_offset_y_mm": -0.0, "protocol.object_turn_deg": 0}
    assert benchmark.digest() == benchmark.with_overrides(zero).digest() == BENCHMARK
    others = [benchmark.with_overrides({key: 1.0}).digest() for key in zero]
    assert len({BENCHMARK, *others}) == 4


def test_without_a_turn_the_pose_is_the_resting_one_to_the_last_bit(task):
    (body,) = grasp_scene(task).rigid_bodies
    assert body.rotation.tobytes() == np.ascontiguousarray(task.grasped.rest_rotation).tobytes()
    assert body.rotation.flags.c_contiguous and tuple(body.position) == (0.0, 0.0, task.grasped.rest_height)


def test_the_object_is_turned_about_its_own_centre_and_put_aside(task):
    (body,) = grasp_scene(
        moved(task, object_offset_x_mm=2, object_offset_y_mm=-1.5, object_turn_deg=30)
    ).rigid_bodies
    np.testing.assert_allclose(body.position, [0.002, -0.0015, task.grasped.rest_height])
    turned = body.rotation @ task.grasped.rest_rotation.T
    np.testing.assert_allclose(turned, [[0.75**0.5, -0.5, 0], [0.5, 0.75**0.5, 0], [0, 0, 1]], atol=1e-12)


def test_a_soft_object_goes_along(task):
    soft = load_object({"name": "pad", "shape": {"kind": "box", "size_mm": [20, 20, 10]}, "mass_g": 5,
                        "soft": {"youngs_modulus_MPa": 0.3, "element_size_mm": 8}})
    plain, aside = (grasp_scene(replace(one, grasped=soft)).soft_bodies[-1].mesh.vertices
                    for one in (task, moved(task, object_offset_x_mm=3, object_turn_deg=90)))
    np.testing.assert_allclose(aside, np.column_stack([-plain[:, 1] + 0.003, plain[:, 0], plain[:, 2]]), atol=1e-12)


def test_an_object_put_into_a_finger_has_no_room(task):
    found = simulate_grasp(moved(task, object_offset_x_mm=40))
    assert found.status == "no_room" and "does not fit between the open fingers" in found.reason


def test_a_pose_out_of_range_gets_one_sentence(benchmark):
    with pytest.raises(InputError, match="object_offset_x_mm: must be a number from -100 to 100, not 101"):
        benchmark.with_overrides({"protocol.object_offset_x_mm": 101})
    assert GraspProtocol().object_turn_deg == 0.0


@pytest.mark.slow
def test_a_sphere_off_the_axis_is_grasped_and_carried_to_the_middle(task):
    off = replace(moved(task, object_offset_x_mm=3.0), grasped=load_object("sphere"))
    found = simulate_grasp(off)
    start, end = found.rigid_positions[[0, -1], 0]
    assert found.status == "ok" and start[0] == pytest.approx(0.003) and abs(end[0]) < 0.002
    assert object_pose(off.grasped, off.design.protocol)[0, 3] == pytest.approx(0.003)
