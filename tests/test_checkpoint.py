"""Checkpoints: a simulation that is stopped and taken up again ends with the same bits."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from finqd.errors import InputError
from finqd.mechanics.linear_backends import available_backends
from finqd.mechanics.material import Material
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.scene import Motion, Scene, Shift
from finqd.simulate import simulate
from finqd.trajectory import Trajectory

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.4, density=1000.0)
CUBE = {"name": "cube", "shape": {"kind": "box", "size_mm": [20, 20, 20]}, "mass_g": 20}


class Stopped(Exception):
    """Stands for whatever ends a process."""


def pads(*, speed: float = 0.004) -> Scene:
    """Two soft pads that close on a cube, friction and all, one of them with a limited force."""
    scene = Scene()
    scene.add_plane(name="floor")
    cube = load_object(CUBE)
    scene.add_rigid(cube, position=(0.0, 0.0, cube.rest_height), rotation=cube.rest_rotation)
    for side in (-1, 1):
        pose = np.eye(4)
        pose[:3, 3] = (side * 0.0105 - (0.006 if side < 0 else 0.0), -0.008, 0.004)
        pad = scene.add_soft(box_mesh((0.006, 0.016, 0.012), (2, 3, 2)).transformed(pose), RUBBER)
        where = "xmin" if side < 0 else "xmax"
        pad.drive(where, Motion(path=Shift(vector=(-side * speed, 0.001, 0.003)), duration=0.3, force_limit=4.0))
    return scene


def kept_run(scene: Scene, path: Path | None = None, *, stop_at: int | None = None, **options) -> Trajectory:
    """Run a scene; ``stop_at``: the step after which the process dies, a checkpoint after every step."""
    steps = 0

    def watch(system, state) -> None:
        nonlocal steps
        steps += 1
        if steps == stop_at:
            raise Stopped

    arguments = {"duration": 0.4, "time_step": 0.04, "record": True, **options}
    if path is not None:
        arguments |= {"checkpoint": path, "checkpoint_every": 0.0}
    return simulate(scene, watch=watch, **arguments)


def assert_same(one: Trajectory, other: Trajectory) -> None:
    for name in ("times", "rigid_positions", "rigid_rotations", "contact_forces", "penetrations", "stroke",
                 "soft_positions"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name
    for name in one.energies:
        assert one.energies[name].tobytes() == other.energies[name].tobytes(), name
    assert (one.status, one.reason, one.counters) == (other.status, other.reason, other.counters)


STEPPERS = [
    *({"name": "implicit_euler", "backend": name} for name in available_backends()),
    {"name": "implicit_euler", "linear_solver": "direct"}, {"name": "implicit_euler", "quasi_newton": False},
    {"name": "implicit_euler", "preconditioner": "jacobi"}, {"name": "implicit_euler", "error_tolerance_mm": 0.05},
    {"name": "bdf2"}, {"name": "quasi_static"},
    pytest.param({"name": "bdf2", "error_tolerance_mm": 0.02}, marks=pytest.mark.slow),
]


@pytest.mark.parametrize("stepper", STEPPERS, ids=lambda s: "-".join(str(v) for v in s.values()))
def test_a_run_that_was_stopped_ends_with_the_same_bits(stepper, tmp_path):
    whole = kept_run(pads(), stepper=stepper)
    assert whole.status == "ok" and whole.contact_forces.max() > 1.0, "nothing is grasped"
    for number, stops in enumerate([(1,), (3, 4)]):
        path = tmp_path / f"{number}.npz"
        for stop in stops:
            with pytest.raises(Stopped):
                kept_run(pads(), path, stop_at=stop, stepper=stepper)
        assert_same(kept_run(pads(), path, stepper=stepper), whole)


@pytest.mark.parametrize("stepper", ["imex", "explicit"])
def test_so_does_one_with_substeps(stepper, tmp_path):
    """A block thrown at the floor; 1 N/mm^3, which needs few substeps."""

    def thrown() -> Scene:
        scene = Scene()
        scene.add_plane(name="floor")
        scene.add_soft(box_mesh((0.02, 0.02, 0.02), (1, 1, 1)), RUBBER, velocity=(0.3, 0.0, -0.1))
        return scene

    options = {"stepper": stepper, "contact": {"name": "penalty", "stiffness_N_mm3": 1.0}, "duration": 0.04,
               "time_step": 0.005}
    whole = kept_run(thrown(), **options)
    assert whole.status == "ok" and whole.soft_positions[-1, :, 2].min() > -1e-4, "the floor does not carry it"
    with pytest.raises(Stopped):
        kept_run(thrown(), tmp_path / "run.npz", stop_at=5, **options)
    assert_same(kept_run(thrown(), tmp_path / "run.npz", **options), whole)


def test_a_checkpoint_changes_nothing_and_a_finished_one_answers_at_once(tmp_path):
    whole = kept_run(pads())
    kept = kept_run(pads(), tmp_path / "run.npz")
    assert_same(kept, whole)
    again = kept_run(pads(), tmp_path / "run.npz", stop_at=1)  # no step is left
    assert_same(again, whole)


def test_without_friction_history_the_bits_would_differ(tmp_path, monkeypatch):
    """The test above would notice a restart that forgets elastic slips."""
    from finqd.plugins.contact_penalty import PenaltyContact

    whole = kept_run(pads())
    with pytest.raises(Stopped):
        kept_run(pads(), tmp_path / "run.npz", stop_at=7)
    restore = PenaltyContact.restore

    def forgetful(self, history):
        restore(self, {**history, "slips": 0.0 * history["slips"]})

    monkeypatch.setattr(PenaltyContact, "restore", forgetful)
    assert kept_run(pads(), tmp_path / "run.npz").soft_positions.tobytes() != whole.soft_positions.tobytes()


def test_a_timeout_goes_on_where_it_was(tmp_path):
    path = tmp_path / "run.npz"
    first = kept_run(pads(), path, wall_clock_limit=1e-9)
    assert first.status == "timeout" and first.counters["steps"] == 1
    assert_same(kept_run(pads(), path), kept_run(pads()))


def test_a_checkpoint_of_another_simulation_is_refused(tmp_path):
    path = tmp_path / "run.npz"
    kept_run(pads(), path)
    before = path.read_bytes()
    slippery = pads()
    slippery.set_friction("soft 0", slippery.rigid_bodies[0].name, 0.1)
    for scene, options in ((pads(speed=0.005), {}), (slippery, {}), (pads(), {"time_step": 0.01}),
                           (pads(), {"stepper": {"name": "implicit_euler", "tolerance_N": 1e-4}})):
        with pytest.raises(InputError, match="another simulation"):
            kept_run(scene, path, **options)
    assert path.read_bytes() == before


def test_a_damaged_checkpoint_is_refused_in_one_sentence(tmp_path):
    path = tmp_path / "run.npz"
    kept_run(pads(), path)
    content = path.read_bytes()
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    header = json.loads(arrays["header"].tobytes())
    for damage in (content[: len(content) // 2], b"", b"nonsense", json.dumps(header).encode()):
        path.write_bytes(damage)
        with pytest.raises(InputError, match="damaged"):
            kept_run(pads(), path)
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match="cannot be read"):
        kept_run(pads(), path)


def test_a_checkpoint_that_cannot_be_written_does_not_end_the_run(tmp_path, monkeypatch):
    def full(self, path):
        raise OSError(28, "No space left on device")

    whole = kept_run(pads())
    monkeypatch.setattr("finqd.checkpoint.Checkpoint.save", full)
    with pytest.warns(RuntimeWarning, match="No space left") as told:
        found = kept_run(pads(), tmp_path / "run.npz")
    assert_same(found, whole)
    assert len(told) == 1
    with pytest.raises(InputError, match="folder does not exist"):
        kept_run(pads(), tmp_path / "nowhere" / "run.npz")


def test_other_libraries_or_another_source_are_another_simulation(tmp_path, monkeypatch):
    """They would not give the same bits; a matrix of one solver library is of no use to another."""
    kept_run(pads(), tmp_path / "run.npz")
    monkeypatch.setattr("finqd.checkpoint.versions", lambda: {"finqd": "0.1.0", "source": "another"})
    with pytest.raises(InputError, match="another simulation"):
        kept_run(pads(), tmp_path / "run.npz")


def test_a_grasp_that_ran_out_of_time_goes_on_from_its_folder(run, tmp_path):
    """From the command line; the result is that of a run that was never stopped."""
    command = ["evaluate", "benchmark", "--objects", "sphere", "--preset", "draft", "--jobs", 1, "--quiet",
               "--set", "mesher.size_mm=12", "--set", "protocol.hold_s=0.1", "--set", "protocol.time_step_ms=50"]
    kept = [*command, "--checkpoints", tmp_path / "kept"]
    assert run(*kept, "--set", "protocol.wall_clock_limit_s=0.01", "--out", tmp_path / "first.json")[0] == 0
    first = json.loads((tmp_path / "first.json").read_text())["objects"]["sphere"]
    assert first["status"] == "timeout" and first["steps"] < 5
    assert run(*kept, "--out", tmp_path / "second.json")[0] == 0
    assert run(*command, "--out", tmp_path / "whole.json")[0] == 0
    second, whole = (json.loads((tmp_path / f"{n}.json").read_text())["objects"]["sphere"] for n in ("second", "whole"))
    assert whole["status"] == "ok"
    assert {k: v for k, v in second.items() if k != "seconds"} == {k: v for k, v in whole.items() if k != "seconds"}
    code, _, said = run(*kept, "--set", "protocol.friction_coefficient=0.5")
    assert code == 2 and "another simulation" in said and "sphere.npz" in said
