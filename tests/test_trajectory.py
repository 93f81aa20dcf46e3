"""The trajectory's file: what is written comes back, and nothing else is taken for one."""

from __future__ import annotations

import io
import json
import math
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finqd.errors import InputError
from finqd.protocol import GraspProtocol
from finqd.trajectory import Trajectory


def grasp(frames: int = 4, rigid: int = 1, soft: int = 3, vertices: int = 5, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(
        status="ok",
        object_name="sphere",
        object_drop=np.float64(0.0012),
        times=np.linspace(0.0, 1.0, frames),
        rigid_positions=rng.normal(size=(frames, rigid, 3)),
        rigid_rotations=rng.normal(size=(frames, rigid, 3, 3)),
        contact_forces=rng.normal(size=(frames, soft)),
        penetrations=rng.uniform(size=frames),
        stroke=rng.uniform(size=(frames, soft)),
        energies={"kinetic": rng.normal(size=frames), "elastic": rng.normal(size=frames)},
        recorded_times=np.linspace(0.0, 1.0, frames),
        soft_positions=rng.normal(size=(frames, vertices, 3)),
        counters={"steps": 12, "newton_iterations": np.int64(31)},
        timings={"steps": 0.25},
        effects={"self_contact": {"on": False, "reason": "never nearer than 2 mm: ribs 3 and 4"}},
        protocol=GraspProtocol(lift_mm=20.0),
    )


def assert_same(first: Trajectory, second: Trajectory) -> None:
    for entry in fields(Trajectory):
        a, b = getattr(first, entry.name), getattr(second, entry.name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes(), entry.name
        elif entry.name == "energies":
            assert list(a) == list(b)
            assert all(np.array_equal(a[name], b[name]) for name in a)
        else:
            assert a == b or (math.isnan(a) and math.isnan(b)), entry.name


@settings(deadline=None, max_examples=20)
@given(
    frames=st.integers(0, 4),
    rigid=st.integers(0, 2),
    soft=st.integers(0, 3),
    vertices=st.integers(0, 4),
    seed=st.integers(0, 99),
)
def test_a_file_returns_every_bit(tmp_path_factory, frames, rigid, soft, vertices, seed):
    path = tmp_path_factory.mktemp("trajectory") / "grasp.npz"
    trajectory = grasp(frames, rigid, soft, vertices, seed)
    trajectory.save(path)
    assert_same(trajectory, Trajectory.load(path))
    assert [p.name for p in path.parent.iterdir()] == ["grasp.npz"]


def test_a_failed_simulation_is_kept_too(tmp_path):
    failed = Trajectory(status="mesh_failed", reason="finger 2: walls meet below the tip")
    failed.save(tmp_path / "failed.npz")
    back = Trajectory.load(tmp_path / "failed.npz")
    assert_same(failed, back)
    assert math.isnan(back.object_drop) and back.protocol is None and back.n_frames == 0


def test_the_same_trajectory_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        grasp().save(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_saving_replaces_a_file_whole_or_not_at_all(tmp_path):
    path = tmp_path / "grasp.npz"
    grasp(seed=1).save(path)
    before = path.read_bytes()
    with pytest.raises(TypeError, match="set"):
        Trajectory(status="ok", effects={"bad": {1, 2}}).save(path)
    with pytest.raises(ValueError, match="[Oo]bject arrays"):
        Trajectory(status="ok", times=np.array([{}])).save(path)
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_cut_file_is_refused(tmp_path, share):
    path = tmp_path / "grasp.npz"
    grasp().save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match="grasp.npz"):
        Trajectory.load(path)


@settings(deadline=None, max_examples=60)
@given(place=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
def test_a_flipped_byte_is_refused_or_harmless(tmp_path_factory, place, flip):
    path = tmp_path_factory.mktemp("trajectory") / "grasp.npz"
    grasp().save(path)
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= flip
    path.write_bytes(bytes(content))
    try:
        back = Trajectory.load(path)
    except InputError as error:
        assert str(path) in str(error)
    else:
        assert_same(grasp(), back)


def foreign(**arrays) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def header(**entries) -> np.ndarray:
    return np.frombuffer(json.dumps(entries).encode(), dtype=np.uint8)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "damaged"),
        (b"solid stl\n", "damaged"),
        (foreign(x=np.zeros(3)), "not a finqd trajectory"),
        (foreign(header=header(format="other", version=1)), "not a finqd trajectory"),
        (foreign(header=header(format="finqd trajectory", version=9)), "format version 9"),
        (foreign(header=header(format="finqd trajectory", version=3)), "another version"),
        (foreign(header=np.frombuffer(b"[1, 2]", dtype=np.uint8)), "not a finqd trajectory"),
    ],
)
def test_a_foreign_file_is_refused_in_one_sentence(tmp_path, content, match):
    path = tmp_path / "foreign.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=match) as caught:
        Trajectory.load(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        Trajectory.load(tmp_path / "nothing.npz")
    with pytest.raises(InputError, match="cannot be read"):
        Trajectory.load(tmp_path)


def test_a_pickle_is_never_opened(tmp_path):
    path = tmp_path / "pickled.npz"
    np.savez(path, header=header(format="finqd trajectory", version=1), times=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="damaged"):
        Trajectory.load(path)
