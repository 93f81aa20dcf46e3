"""Pictures: what is in front hides what is behind, moves show, colours tell bodies apart."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.errors import InputError
from finqd.mesh_shapes import box_mesh
from finqd.render import FACE_SIZE, View, _divided, render_frames
from finqd.trajectory import Trajectory

CUBE_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
CUBE = (
    0.01 * CUBE_CORNERS,
    np.array(
        [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4)]
        + [(1, 5, 7), (1, 7, 3)]
    ),
)
KINDS = ["hex8", "wedge6", "tet4", "tet10", "hex20"]


def trajectory(mesh, rigid_positions) -> Trajectory:
    frames = len(rigid_positions)
    times = 0.1 * np.arange(frames)
    return Trajectory(
        status="ok",
        times=times,
        recorded_times=times,
        soft_positions=np.repeat(mesh.vertices[None], frames, axis=0),
        rigid_positions=np.array(rigid_positions, dtype=float)[:, None],
        rigid_rotations=np.tile(np.eye(3), (frames, 1, 1, 1)),
    )


def picture(path) -> np.ndarray:
    from matplotlib.image import imread

    return imread(path)[:, :, :3]


def shares(image: np.ndarray) -> tuple[float, float]:
    """Return which share of the pixels is bluish (soft) and which orange (rigid)."""
    red, blue = image[:, :, 0], image[:, :, 2]
    return float(np.mean(blue > red + 0.1)), float(np.mean(red > blue + 0.1))


@pytest.mark.parametrize("kind", KINDS)
def test_bodies_are_seen_in_their_colours(tmp_path, kind):
    mesh = box_mesh((0.04, 0.02, 0.03), (3, 2, 2), kind)
    moving = trajectory(mesh, [(0.07, 0.0, 0.01), (0.07, 0.0, 0.03)])
    path = tmp_path / "frames.png"
    render_frames(moving, [mesh], [CUBE], path, times=[0.0, 0.1], width_px=800)
    image = picture(path)
    assert image.shape[1] == 800
    soft, rigid = shares(image)
    assert soft > 0.05 and rigid > 0.03
    left, right = image[:, :400], image[:, 400:]
    assert abs(shares(left)[0] - shares(right)[0]) < 0.01
    rows = [np.flatnonzero((half[:, :, 0] > half[:, :, 2] + 0.1).any(axis=1)).mean() for half in (left, right)]
    assert rows[1] < rows[0] - 5  # the cube has risen
    assert [p.name for p in tmp_path.iterdir()] == ["frames.png"]


def test_what_is_in_front_hides_what_is_behind(tmp_path):
    mesh = box_mesh((0.04, 0.04, 0.04), (4, 4, 4))
    middle = np.array([0.02, 0.02, 0.02])
    for side, visible in ((1.0, True), (-1.0, False)):
        view = (10.0, 30.0)
        towards = View(*np.radians(view)).axes[2]
        moving = trajectory(mesh, [middle + side * 0.08 * towards])
        render_frames(moving, [mesh], [CUBE], tmp_path / "frames.png", times=[0.0], view=view, floor=None, width_px=400)
        assert (shares(picture(tmp_path / "frames.png"))[1] > 0.02) == visible


def test_four_moments_are_drawn_unless_others_are_asked_for(tmp_path):
    mesh = box_mesh((0.04, 0.02, 0.03), (2, 1, 1))
    moving = trajectory(mesh, [(0.07, 0.0, 0.01 + 0.005 * i) for i in range(7)])
    render_frames(moving, [mesh], [CUBE], tmp_path / "frames.png", width_px=800)
    image = picture(tmp_path / "frames.png")
    assert all(shares(image[:, 200 * i : 200 * (i + 1)])[1] > 0.02 for i in range(4))


def test_the_view_is_a_rotation():
    for elevation, azimuth in ((0.0, 0.0), (0.3, -1.2), (1.5, 2.0), (-0.4, 0.7)):
        axes = View(elevation, azimuth).axes
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(View(0.0, -np.pi / 2).axes, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-15)


def test_division_keeps_area_and_orientation():
    triangles = CUBE[0][CUBE[1]]
    small = _divided(triangles, 0.1 * FACE_SIZE)
    edges = np.linalg.norm(np.roll(small, -1, axis=1) - small, axis=2)
    assert edges.max() <= 0.1 * FACE_SIZE
    areas = [0.5 * np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]) for t in (triangles, small)]
    np.testing.assert_allclose(np.linalg.norm(areas[1], axis=1).sum(), 6 * 0.02**2)
    volumes = [np.einsum("ti,ti->", t[:, 0], a) / 3 for t, a in zip((triangles, small), areas, strict=True)]
    np.testing.assert_allclose(volumes, 0.02**3)


def test_what_cannot_be_drawn_is_refused(tmp_path):
    mesh = box_mesh((0.04, 0.02, 0.03), (2, 1, 1))
    with pytest.raises(InputError, match="record=True"):
        render_frames(Trajectory(status="ok"), [mesh], [], tmp_path / "frames.png")
    with pytest.raises(InputError, match="cannot be written"):
        render_frames(trajectory(mesh, [(0, 0, 0)]), [mesh], [CUBE], tmp_path / "nowhere" / "frames.png")
