"""Effects: the closed list, what a design may force, that what is off costs nothing, and laws of what is left."""

import json
from dataclasses import replace

import numpy as np
import pytest

import finqd.plugins.contact_penalty as contact_penalty
from finqd.data import designs_folder
from finqd.design import Design
from finqd.effects import EFFECTS, effects_of, effects_schema, read_effects, with_effects
from finqd.errors import InputError
from finqd.evaluate import finger_meshes
from finqd.explain import explain
from finqd.grasp import GraspTask, grasp_scene, simulate_grasp
from finqd.mechanics.material import Material
from finqd.mechanics.reach import Reach
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.presets import apply_preset
from finqd.scene import Scene
from finqd.simulate import simulate

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.3, density=1000.0)
#: a whole grasp in a second: coarse, quick motions
QUICK = {
    "mesher.size_mm": 8, "protocol.close_s": 0.3, "protocol.squeeze_s": 0.04, "protocol.lift_s": 0.2,
    "protocol.lift_mm": 5, "protocol.hold_s": 0.1, "actuation.duration_s": 0.3,
}


def benchmark(**overrides) -> Design:
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    return Design.from_json(designs_folder() / "benchmark.json").with_overrides(changes)


def ball(diameter_mm: float = 20.0):
    return load_object({"name": "ball", "shape": {"kind": "sphere", "diameter_mm": diameter_mm}, "mass_g": 5})


def block_over_ball(height: float, *, velocity: float = 0.0, gravity: float = 0.0) -> Scene:
    """Return a block of 20 mm whose lower face is ``height`` [m] over a ball of 20 mm that is held."""
    scene = Scene(gravity=(0, 0, -gravity))
    mesh = box_mesh((0.02, 0.02, 0.02), (2, 2, 2))
    low = mesh.vertices.min(axis=0)
    shift = np.eye(4)
    shift[:3, 3] = [-0.01 - low[0], -0.01 - low[1], height - low[2]]
    scene.add_soft(mesh.transformed(shift), RUBBER, name="block", velocity=(0, 0, velocity))
    scene.add_rigid(ball(), position=(0, 0, -0.01), held=True)
    return scene


# -- what may be asked for ---------------------------------------------------------------------------


@pytest.mark.parametrize(("value", "forced"), [
    ("auto", {}), ({}, {}), ({"friction": "auto"}, {}),
    ({"floor": "off", "friction": "off"}, {"friction": "off", "floor": "off"}),
    (list(EFFECTS), {"material_nonlinearity": "on"}),
])  # fmt: skip
def test_what_is_asked_for_has_one_form(value, forced):
    assert read_effects(value, "effects") == forced and list(read_effects(value, "effects")) == list(forced)


def test_a_list_leaves_out_all_others():
    forced = read_effects(["object_contact", "friction"], "effects")
    assert set(forced) == set(EFFECTS) - {"object_contact", "friction"} and set(forced.values()) == {"off"}


@pytest.mark.parametrize(("value", "sentence"), [
    (3, "effects: must be an object {...}, not 3"),
    ("all", 'effects: must be "auto", a list of effects, or an object, not "all"'),
    ({"frction": "off"}, "effects.frction: unknown key; did you mean friction?"),
    ({"friction": "no"}, 'effects.friction: must be one of "on", "off", "auto", not "no"'),
    ({"friction": ["off"]}, 'effects.friction: must be one of "on", "off", "auto", not ["off"]'),
    ([["friction"]], 'effects[0]: must be the name of an effect, not ["friction"]'),
    (["friction", "friction"], "effects[1]: 'friction' is named twice"),
    (["frction"], "effects.frction: unknown key; did you mean friction?"),
    ({"damping": "on"}, "effects.damping: cannot be forced on: the material has none; give material.rayleigh_mass_per_s"
                        " or material.rayleigh_stiffness_ms"),
    ({"soft_object": "on"}, "effects.soft_object: cannot be forced on: the object's own file makes it soft, by its key"
                            " soft"),
    ({"material_nonlinearity": "on", "large_rotation": "off"},
     "effects.material_nonlinearity: cannot be on while large_rotation is off"),
])  # fmt: skip
def test_what_makes_no_sense_is_refused_in_a_sentence(value, sentence):
    with pytest.raises(InputError) as error:
        benchmark(effects=value)
    assert str(error.value) == f"override: {sentence}"


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"contact": "ipc", "effects.self_contact": "off"}, "effects.self_contact: cannot be off with the contact ipc"),
    ({"stepper": "bdf2", "effects.inertia": "off"}, "effects.inertia: cannot be off with the stepper bdf2"),
    ({"stepper": "quasi_static", "effects.inertia": "on"},
     "effects.inertia: cannot be on with the stepper quasi_static"),
    ({"elasticity": "linear", "effects.large_rotation": "on"},
     "effects.large_rotation: cannot be on with the elasticity linear"),
    ({"elasticity": "neo_hookean", "effects.material_nonlinearity": "off"},
     "effects.material_nonlinearity: cannot be off with the elasticity neo_hookean"),
    ({"contact.soft_contact": False, "effects.self_contact": "on"},
     "effects.self_contact: cannot be on while contact.soft_contact is false"),
])  # fmt: skip
def test_what_contradicts_the_plugins_is_refused(changes, sentence):
    with pytest.raises(InputError) as error:
        benchmark().with_overrides(changes)
    assert str(error.value) == f"override: {sentence}"


def test_a_design_that_forces_nothing_is_the_same_design():
    plain = benchmark()
    assert benchmark(effects="auto") == plain and benchmark(effects="auto").digest() == plain.digest()
    forced = benchmark(effects={"friction": "off"})
    assert forced.digest() != plain.digest()
    assert Design.from_json(forced.to_json()).forced_effects == {"friction": "off"}
    assert json.loads(json.dumps(effects_schema()))["default"] == "auto"


def test_forced_effects_change_plugins_material_and_protocol():
    design = apply_preset(benchmark(
        effects={"friction": "off", "damping": "off", "inertia": "off", "large_rotation": "off",
                 "actuator_force_limit": "off", "floor": "off"},
        material__rayleigh_mass_per_s=2.0, protocol__friction_finger_object=0.9,
    ), "draft")
    found = with_effects(design)
    assert found.protocol.friction_coefficient == 0.0 and found.protocol.friction_finger_object is None
    assert found.material.rayleigh_mass == 0.0 and found.spec("elasticity")["name"] == "linear"
    assert found.spec("stepper")["name"] == "quasi_static" and found.spec("stepper")["tolerance_share"] == 1e-3
    assert found.plugin("actuation").force_limit_N == 1e6 and found.plugin("actuation").angle_deg == (
        design.plugin("actuation").angle_deg)
    assert found.forced_effects == {"floor": "off"}, "that is for the scene"
    assert with_effects(found) == found
    said = effects_of(design)
    assert said["friction"] == "off: effects.friction is off" and said.keys() == EFFECTS.keys()
    assert said["self_contact"].startswith("on")


# -- what is off costs nothing -----------------------------------------------------------------------


@pytest.fixture
def calls(monkeypatch):
    """Count the calls of the kernels that find contacts of soft bodies with rigid ones, planes and each other."""
    counts = {"find_soft_rigid": 0, "find_soft_plane": 0, "soft_step_limit": 0}
    for name in counts:
        real = getattr(contact_penalty.kernels, name)

        def counted(*arguments, name=name, real=real):
            counts[name] += 1
            return real(*arguments)

        monkeypatch.setattr(contact_penalty.kernels, name, counted)
    return counts


def test_kernels_sleep_until_bodies_are_within_reach(calls):
    far = block_over_ball(0.05, velocity=-1.0)
    run = simulate(far, duration=0.04, time_step=0.002, stepper="implicit_euler")
    assert run.status == "ok" and calls["find_soft_rigid"] == 0
    assert run.effects == {}, "nothing has met"
    run = simulate(far, duration=0.06, time_step=0.002)
    since = {(a, b): time for a, b, time in run.effects["met"]}["block", "ball"]
    assert calls["find_soft_rigid"] > 0 and run.status == "ok"
    # the block falls freely with 1 m/s until it is there, 50 mm away; boxes and balls touch where they do
    assert since == pytest.approx(0.05, abs=0.0021)
    touched = np.flatnonzero(run.contact_forces[:, 0] > 0.0)
    assert len(touched) and run.times[touched[0]] >= since


def test_waking_them_late_changes_no_bit(monkeypatch):
    asleep = simulate(block_over_ball(0.01, velocity=-0.5), duration=0.05, time_step=0.002)
    monkeypatch.setattr(Reach, "any_near_rigid", lambda self, state, r: True)
    awake = simulate(block_over_ball(0.01, velocity=-0.5), duration=0.05, time_step=0.002)
    assert asleep.contact_forces.max() > 0.0
    for name in ("soft_centres", "contact_forces", "penetrations", "times"):
        assert np.array_equal(getattr(asleep, name), getattr(awake, name)), name


@pytest.mark.parametrize("bend", [0.0, 0.3, 1.0])
def test_no_point_of_a_curved_face_lies_farther_out_than_its_bulge(bend):
    mesh = box_mesh((0.02, 0.02, 0.02), (1, 1, 1), "hex20")
    scene = Scene()
    scene.add_soft(mesh, RUBBER, name="block")
    scene.add_rigid(ball(), position=(0, 0, -0.1), held=True)
    contact = System(scene, contact=contact_penalty.Penalty()).contact
    rng = np.random.default_rng(0)
    for _ in range(50):
        x = mesh.vertices + bend * 0.01 * rng.normal(size=mesh.vertices.shape)
        middles = [0.5 * x[f[4:8]].sum(axis=0) - 0.25 * x[f[:4]].sum(axis=0) for f in contact.surface.faces]
        out = np.maximum(np.maximum(x.min(axis=0) - middles, np.asarray(middles) - x.max(axis=0)), 0.0)
        assert np.linalg.norm(out, axis=1).max() <= contact.reach.bulge(x) + 1e-12
    assert bend == 0.0 or contact.reach.bulge(x) > 0.0


def test_what_is_ignored_allocates_nothing_and_calls_nothing(calls):
    scene = block_over_ball(0.001, velocity=-1.0)
    scene.add_plane(point=(0, 0, -0.01), name="floor")
    for pair in (("block", "ball"), ("block", "block"), ("block", "floor")):
        scene.ignore(*pair)
    contact = System(scene, contact=contact_penalty.Penalty()).contact
    assert contact.soft is None and contact.sights == {} and contact.fields[0] is scene.rigid_bodies[0].shape.distance
    assert [pair[3:] for pair in contact.reach._pairs] == [("ball", "floor")]
    run = simulate(scene, duration=0.04, time_step=0.002)
    assert run.status == "ok" and run.contact_forces.max() == 0.0 and set(calls.values()) == {0}
    assert run.soft_centres[-1, 0, 2] == pytest.approx(0.011 - 0.04, rel=1e-6), "it has fallen through, undisturbed"


def test_a_scene_says_what_is_wrong_with_what_it_is_to_ignore():
    scene = block_over_ball(0.01)
    with pytest.raises(InputError, match="no body is called 'bal'"):
        scene.ignore("block", "bal")
    scene.add_soft(box_mesh((0.01, 0.01, 0.01), (1, 1, 1)).transformed(np.diag([1.0, 1, 1, 1])), RUBBER, name="other")
    scene.ignore("other", "ball")
    with pytest.raises(InputError, match="^ball: either all soft bodies touch it or none, with the contact penalty"):
        System(scene, contact=contact_penalty.Penalty())


# -- laws of what is left ----------------------------------------------------------------------------


def test_a_weightless_body_keeps_its_momentum():
    scene = block_over_ball(0.05, velocity=0.2, gravity=9.81)
    scene.soft_bodies[0].weightless = True
    run = simulate(scene, duration=0.05, time_step=0.005)
    rise = run.soft_centres[-1, 0, 2] - run.soft_centres[0, 0, 2]
    assert rise == pytest.approx(0.2 * 0.05, rel=1e-6), "no gravity, all of its inertia"


def test_soft_bodies_that_ignore_each_other_pass_through():
    scene = Scene(gravity=(0, 0, 0))
    for i, speed in enumerate((0.0, 1.0)):
        shift = np.eye(4)
        shift[0, 3] = -0.015 * i
        mesh = box_mesh((0.01, 0.01, 0.01), (1, 1, 1)).transformed(shift)
        scene.add_soft(mesh, RUBBER, name=f"block {i}", velocity=(speed, 0, 0))
    scene.ignore("block 0", "block 1")
    run = simulate(scene, duration=0.03, time_step=0.002)
    ways = run.soft_centres[-1] - run.soft_centres[0]
    assert ways[0] == pytest.approx(0.0, abs=1e-9) and ways[1, 0] == pytest.approx(0.03, rel=1e-6)


# -- grasps ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def task() -> GraspTask:
    design = apply_preset(benchmark(), "draft", overrides=QUICK)
    solids = [design.plugin("geometry").build(design.finger_si(i)) for i in range(3)]
    return GraspTask(design=design, meshes=finger_meshes(design, solids), grasped=load_object("sphere"))


def forced(task: GraspTask, **states: str) -> GraspTask:
    return replace(task, design=task.design.with_overrides({f"effects.{name}": s for name, s in states.items()}))


def test_scenes_of_grasps_leave_out_what_is_off(task):
    scene = grasp_scene(forced(task, floor="off", object_contact="off", self_contact="off",
                               finger_to_finger_contact="off", gravity_on_fingers="off"))
    fingers = [body.name for body in scene.soft_bodies]
    assert not scene.planes and all(body.weightless for body in scene.soft_bodies)
    assert not any(scene.touches(a, b) for a in fingers for b in (*fingers, "sphere"))
    plain = grasp_scene(task)
    assert len(plain.planes) == 1 and not plain.ignored and not any(body.weightless for body in plain.soft_bodies)


@pytest.mark.parametrize("effect", ["object_contact", "self_contact", "finger_to_finger_contact"])
def test_a_contact_that_is_off_is_not_watched(task, effect):
    scene = grasp_scene(forced(task, **{effect: "off"}))
    contact = System(scene, contact=contact_penalty.Penalty()).contact
    watched = {watch.bodies for watch in contact.soft.near.watches}
    own, pairs = {(i, i) for i in range(3)}, {(0, 1), (0, 2), (1, 2)}
    assert watched == {"self_contact": pairs, "finger_to_finger_contact": own}.get(effect, own | pairs)
    assert contact.met == ([] if effect == "object_contact" else [0])
    state = System(scene, contact=contact_penalty.Penalty()).initial_state()
    contact.begin_step(state)
    contact.commit(state)
    assert not contact.soft_forces.any(), "fingers start open"


def test_a_soft_object_is_rigid_if_its_softness_is_off(task):
    soft = load_object({"name": "pad", "shape": {"kind": "box", "size_mm": [20, 20, 10]}, "mass_g": 5,
                        "soft": {"youngs_modulus_MPa": 0.3, "element_size_mm": 8}})
    both = [grasp_scene(replace(forced(task, **states), grasped=soft)) for states in ({}, {"soft_object": "off"})]
    assert [len(scene.soft_bodies) for scene in both] == [4, 3]
    assert [body.name for body in both[1].rigid_bodies] == ["pad"]


def test_without_contact_the_object_stays_on_the_floor(task):
    run = simulate_grasp(forced(task, object_contact="off"))
    assert run.status == "ok" and run.contact_forces.max() == 0.0
    assert run.rigid_positions[-1, 0, 2] == pytest.approx(task.grasped.rest_height, abs=2e-5)
    assert run.effects["object_contact"] == {"since_s": None, "why": "never within reach"}


@pytest.mark.slow
def test_without_a_limit_drives_press_harder(task):
    limited = replace(task, design=task.design.with_overrides({"actuation.force_limit_N": 2.0}))
    weak, strong = simulate_grasp(limited), simulate_grasp(forced(limited, actuator_force_limit="off"))
    assert weak.status == strong.status == "ok"
    assert strong.contact_forces.max() > 1.3 * weak.contact_forces.max() > 0.0
    assert weak.effects["object_contact"]["since_s"] > 0.0 and weak.effects["friction"]["since_s"] == 0.0


@pytest.mark.slow
def test_what_if_says_what_each_effect_changes(task):
    found, = explain(task.design, objects=["sphere"], preset="draft", what_if=True, jobs=2)
    effects = found.to_dict()["effects"]
    without = effects["object_contact"]["what_if"]
    assert (without["state"], without["force_N"]) == ("off", 0.0)
    assert without["drop_mm"] == pytest.approx(QUICK["protocol.lift_mm"], abs=0.05), "it stays where it is"
    assert effects["material_nonlinearity"]["what_if"]["state"] == "on"
    assert effects["damping"]["what_if"] == {
        "state": None, "reason": f"cannot be forced on: {EFFECTS['damping'].fixed}"}
    assert "what_if" not in effects["soft_object"]


def test_the_command_line_explains_what_each_effect_did(run, tmp_path):
    settings = [part for key, value in QUICK.items() for part in ("--set", f"{key}={value}")]
    out = tmp_path / "why.json"
    code, printed, _ = run("explain", "benchmark", "--objects", "sphere", "--preset", "draft", "--jobs", "1",
                           "--out", str(out), *settings)
    assert code == 0 and "self_contact" in printed and "came within reach of sphere" in printed
    row = json.loads(out.read_text())["sphere"]
    assert row["effects"].keys() == EFFECTS.keys() and row["status"] == "ok"
    assert row["effects"]["object_contact"]["since_s"] > 0.0 and "sphere" in row["effects"]["object_contact"]["why"]
    assert row["effects"]["damping"] == {
        "state": "off", "since_s": None, "seconds": None, "why": "only what implicit Euler itself dissipates"}
    costs = {name: line["seconds"] for name, line in row["effects"].items()}
    assert costs["object_contact"] == costs["friction"] == costs["floor"] > 0.0 and costs["self_contact"] > 0.0
    assert costs["large_rotation"] > 0.0 and costs["material_nonlinearity"] is None and costs["inertia"] is None
    assert costs["object_contact"] + costs["self_contact"] + costs["large_rotation"] < row["seconds"]
    assert row["effects"]["soft_object"]["state"] == "off"
    code, _, said = run("explain", "benchmark", "--objects", "spere")
    assert code == 2 and said.count("\n") <= 2 and "spere" in said
