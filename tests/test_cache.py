"""What is kept on disk is what would have been made, and nothing that happens to it does harm."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import misbehaving_meshers as bad
import numpy as np
import pytest
import trimesh

from finqd import cache, meshing
from finqd.data import designs_folder
from finqd.design import Design
from finqd.errors import MeshError
from finqd.evaluate import evaluate
from finqd.mechanics.rounding import rounded_field
from finqd.mesh import Mesh
from finqd.meshing import close_mesher, mesh_solid
from finqd.objects import GraspObject, load_object
from finqd.plugins.geometry_fin_ray import FinRay
from finqd.plugins.mesher_swept import Swept
from finqd.solid import Prism, SurfaceSolid

BENCHMARK = Design.from_json(designs_folder() / "benchmark.json").finger_si(0)
#: a grasp of six steps, in which fingers begin to close
SHORT = {
    "protocol.settle_s": 0.0, "protocol.close_s": 0.1, "protocol.squeeze_s": 0.0, "protocol.lift_s": 0.1,
    "protocol.hold_s": 0.0, "protocol.calm_step_factor": 1, "mesher.size_mm": 6.0,
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache; returns the folder of its files."""
    monkeypatch.setenv("FINQD_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache" / "made"


class Maker:
    """Counts how often it is asked, and makes the same arrays each time."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, np.ndarray]:
        self.calls += 1
        values = np.random.default_rng(1).random((5, 3))
        return {"values": values, "turned": np.asfortranarray(values), "few": np.zeros((0, 3), dtype=np.int32)}


def asked(make: Maker, *parts: cache.Part, kind: str = "test") -> dict[str, np.ndarray]:
    return cache.remembered(kind, parts, make, pack=dict, unpack=dict)


def same(a: np.ndarray, b: np.ndarray) -> bool:
    layout = a.flags.f_contiguous == b.flags.f_contiguous and a.flags.writeable == b.flags.writeable
    return a.dtype == b.dtype and a.shape == b.shape and layout and a.tobytes() == b.tobytes()


def assert_same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    assert list(one) == list(other) and all(same(one[name], other[name]) for name in one)


# -- keys ------------------------------------------------------------------------------------------------------------


def test_what_was_made_comes_back_to_the_bit_and_only_for_the_same_parts(folder: Path) -> None:
    make, x = Maker(), np.arange(6.0)
    assert_same(asked(make, b"a", x, 1.0), asked(make, b"a", x.copy(), 1.0))
    assert make.calls == 1
    others = ([b"b", x, 1.0], [b"a", x, 2.0], [b"a", x.astype("f4"), 1.0], [b"a", x.reshape(2, 3), 1.0], [b"a", x],
              ["a", x, 1.0], [b"a", x + 1e-16 * x, 1.0])
    for calls, parts in enumerate(others, start=2):
        asked(make, *parts)
        assert make.calls == calls or np.array_equal(parts[1], x) and parts[0] == b"a", parts
    asked(make, b"a", x, 1.0, kind="another")
    assert make.calls >= 8


def test_an_update_of_sources_or_libraries_makes_everything_again(folder: Path, monkeypatch) -> None:
    make = Maker()
    for circumstances in ("before", "after", "before"):
        monkeypatch.setattr(cache, "_circumstances", lambda said=circumstances: said)
        asked(make, 1)
    assert make.calls == 2
    monkeypatch.undo()
    said = cache._circumstances()
    assert all(word in said for word in (cache.versions()["source"], "numpy", "gmsh", "shapely", "trimesh"))


def test_nothing_is_kept_when_sources_have_changed_under_the_process(folder: Path, monkeypatch) -> None:
    make = Maker()
    monkeypatch.setattr(cache, "_BEGUN", 0.0)
    asked(make, 1)
    assert asked(make, 1) and make.calls == 2 and not folder.exists()


# -- places ----------------------------------------------------------------------------------------------------------


def test_where_the_files_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FINQD_CACHE_DIR", str(tmp_path))
    assert cache.cache_folder() == tmp_path / "made"
    monkeypatch.delenv("FINQD_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_folder() == tmp_path / "xdg" / "finqd" / "made"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as for a user without a home
    assert cache.cache_folder() is None


def test_it_can_be_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FINQD_CACHE_DIR", "")
    monkeypatch.setattr(cache, "_keep", None)
    make = Maker()
    asked(make, 1)
    assert asked(make, 1) and make.calls == 2


# -- harm ------------------------------------------------------------------------------------------------------------


def test_a_damaged_file_is_made_again(folder: Path) -> None:
    make = Maker()
    sound = asked(make, 1)
    (path,) = folder.iterdir()
    content = path.read_bytes()
    for place in range(0, len(content), 5):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0x55]) + content[place + 1 :])
        assert_same(asked(make, 1), sound)
    for text in (b"", content[:100], content[:-1], b"no archive", b"\x93NUMPY\x01"):
        path.write_bytes(text)
        calls = make.calls
        assert_same(asked(make, 1), sound)
        assert make.calls == calls + 1 and path.read_bytes() != text
    np.savez(path, other=np.zeros(3))  # somebody else's
    assert_same(asked(make, 1), sound)


def test_what_cannot_be_written_is_said_once_and_does_no_harm(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("FINQD_CACHE_DIR", str(tmp_path / "file" / "below"))
    make = Maker()
    with pytest.warns(RuntimeWarning, match="FINQD_CACHE_DIR names another folder") as said:
        asked(make, 1)
        asked(make, 1)
        asked(make, 2)
    assert len(said) == 1 and make.calls == 3


def test_a_full_disk_leaves_nothing_behind(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(file, **arrays):
        file.write(b"a part of it")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez", full)
    with pytest.warns(RuntimeWarning, match="No space left on device"):
        asked(Maker(), 1)
    assert list(folder.iterdir()) == []
    asked(Maker(), 2)  # a second warning would be an error


def test_what_fails_is_not_kept(folder: Path) -> None:
    for _ in range(2):
        with pytest.raises(MeshError, match="takes prisms only") as raised:
            mesh_solid(Swept(), SurfaceSolid(*prism().surface()))
        assert raised.value.__context__ is None
    assert not folder.exists()


def test_the_least_recently_used_go_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = Maker()
    for number in range(4):
        asked(make, number)
        for path in folder.iterdir():  # seconds later
            os.utime(path, (path.stat().st_atime - 10.0, path.stat().st_mtime - 10.0))
    size = next(folder.iterdir()).stat().st_size
    abandoned, unfinished = folder / ".a.part", folder / ".b.part"
    for path in (abandoned, unfinished):
        path.write_bytes(b"")
    os.utime(abandoned, (0.0, time.time() - 2.0 * cache.ABANDONED_S))
    asked(make, 0)  # used again
    monkeypatch.setattr(cache, "LIMIT", 3 * size)
    monkeypatch.setattr(cache, "LOOK_EVERY", 0)
    asked(make, 4)
    assert make.calls == 5 and not abandoned.exists() and unfinished.exists()
    assert len(list(folder.glob("*.npz"))) == 3
    for number, calls in ((0, 5), (4, 5), (3, 5), (1, 6)):
        asked(make, number)
        assert make.calls == calls, number


ASK_OFTEN = """
import sys
import numpy as np
from finqd.cache import remembered
sys.stdin.readline()
for number in range(50):
    made = remembered("shared", [number], lambda: {"a": np.full(999, number)}, pack=dict, unpack=dict)
    assert made["a"].tolist() == 999 * [number]
"""


def test_processes_share_it_without_harm(folder: Path) -> None:
    command = [sys.executable, "-c", ASK_OFTEN]
    processes = [subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    for process in processes:  # all of them begin when they are ready and told so
        process.stdin.write("go\n")
        process.stdin.flush()
    for process in processes:
        _, said = process.communicate()
        assert process.returncode == 0 and said == ""
    assert len(list(folder.iterdir())) == 50, "one file for each, and nothing unfinished"


# -- what is kept ----------------------------------------------------------------------------------------------------


def prism() -> Prism:
    return FinRay().build(dict(BENCHMARK))


def assert_same_mesh(one: Mesh, other: Mesh) -> None:
    for ours, theirs in ((one.blocks, other.blocks), (one.node_sets, other.node_sets), (one.faces, other.faces),
                         ({"": one.vertices}, {"": other.vertices})):
        assert_same(dict(ours), dict(theirs))
    assert list(one.face_sets) == list(other.face_sets)
    for name in one.face_sets:
        assert_same(dict(one.face_sets[name]), dict(other.face_sets[name]))


def test_a_mesh_comes_back_to_the_bit_without_a_meshing_process(folder: Path, monkeypatch) -> None:
    mesher = Swept(size_mm=6.0, order=2, notch_nodes="quarter")
    made = mesh_solid(mesher, prism())
    close_mesher()
    monkeypatch.setattr(meshing, "_ask", None)
    kept = mesh_solid(mesher, prism())
    assert kept is not made and len(kept.faces) and len(kept.node_sets)
    assert_same_mesh(kept, made)
    close_mesher()


def test_meshes_of_others_are_not_kept(folder: Path) -> None:
    mesh_solid(bad.Box(1.0), prism())
    close_mesher()
    assert not folder.exists()


def test_a_set_without_faces_comes_back(folder: Path) -> None:
    from finqd.mesh import mesh_arrays, mesh_of
    from finqd.mesh_shapes import box_mesh

    box = box_mesh((1.0, 1.0, 1.0), (1, 1, 2))
    mesh = box.with_sets({"a/b": np.array([1, 2])}, {"none": {}, "x/y": {"quad4": np.array([1])}})
    for _ in range(2):
        back = cache.remembered("mesh", [1], lambda: mesh, pack=mesh_arrays, unpack=mesh_of)
    assert back is not mesh and back.face_sets["none"] == {} and list(back.node_sets["a/b"]) == [1, 2]
    assert list(back.face_sets) == list(mesh.face_sets) and list(back.face_sets["x/y"]["quad4"]) == [1]


def assert_same_object(one: GraspObject, other: GraspObject) -> None:
    for name in ("vertices", "triangles", "inertia", "support_points", "rest_rotation"):
        assert same(getattr(one, name), getattr(other, name)), name
    assert (one.rest_height, one.mass, one.volume) == (other.rest_height, other.mass, other.volume)
    assert_same_field(one.distance, other.distance)


def assert_same_field(one, other) -> None:
    for name, mine, theirs in zip(one._fields, one, other):
        alike = same(mine, theirs) if isinstance(mine, np.ndarray) else (type(mine), mine) == (type(theirs), theirs)
        assert alike, name


@pytest.mark.parametrize("source", ["diamond", "cube", "ball.stl"])
def test_an_object_comes_back_to_the_bit(source: str, folder: Path, monkeypatch, tmp_path: Path) -> None:
    if source == "ball.stl":
        ball = trimesh.creation.icosphere(subdivisions=4, radius=20.0)
        ball.apply_scale([1.0, 1.1, 0.9])
        ball.export(tmp_path / source)
        source = str(tmp_path / source)
    made, kept = load_object(source), load_object(source)
    rounded, kept_rounded = (rounded_field(one, 5e-4) for one in (made, kept))
    files = len(list(folder.iterdir()))
    monkeypatch.setenv("FINQD_CACHE_DIR", "")
    plain = load_object(source)
    for one in (made, kept):
        assert_same_object(one, plain)
    for field in (rounded, kept_rounded):
        assert_same_field(field, rounded_field(plain, 5e-4))
    assert files == (4 if source.endswith(".stl") else 1), "surface, field, rounded field and pose; or the pose alone"


def test_a_grasp_is_the_same_to_the_bit_with_and_without(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    design = Design.from_json(designs_folder() / "benchmark.json")
    found = []
    for chosen in (folder.parent, folder.parent, ""):
        monkeypatch.setenv("FINQD_CACHE_DIR", str(chosen))
        close_mesher()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found.append(evaluate(design, objects=["diamond"], preset="draft", overrides=SHORT).trajectories["diamond"])
    filled, kept, without = found
    assert without.status == "ok" and len(without.times) > 5 and len(list(folder.iterdir())) == 2
    for one in (filled, kept):
        for name in ("rigid_positions", "rigid_rotations", "soft_centres", "contact_forces"):
            assert same(getattr(one, name), getattr(without, name)), name
    close_mesher()
