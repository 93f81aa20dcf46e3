"""Pictures of recorded simulations, drawn without a screen.

Faces that look at the viewer are shaded, sorted from far to near and painted over each other by matplotlib, with their
shadow on the floor. That needs no graphics library; faces that pierce each other are not resolved.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from finqd.errors import InputError
from finqd.mesh import Mesh
from finqd.trajectory import Surface, Trajectory, replacing

SOFT_COLOUR = (0.24, 0.53, 0.66)
RIGID_COLOUR = (0.93, 0.58, 0.22)
SHADOW_COLOUR = (0.80, 0.80, 0.81)
GRID_COLOUR = (0.86, 0.86, 0.87)
#: towards the light
LIGHT = np.array([-0.25, -0.35, 0.90])
#: shares of the light that comes from everywhere, from the lamp, and from where the viewer stands
AMBIENT, LAMP, HEADLIGHT = 0.40, 0.35, 0.30
#: longest edge of a rigid face as a share of the picture: painting from far to near needs small faces
FACE_SIZE = 0.03

#: the order in which a face's outline runs through corners and mid-edge nodes
_OUTLINE = {
    "quad4": [0, 1, 2, 3],
    "tri3": [0, 1, 2],
    "quad8": [0, 4, 1, 5, 2, 6, 3, 7],
    "tri6": [0, 3, 1, 4, 2, 5],
}


@dataclass(frozen=True)
class View:
    """A parallel projection: the viewer looks down by ``elevation`` from the side ``azimuth`` [rad], z being up."""

    elevation: float
    azimuth: float

    @property
    def axes(self) -> np.ndarray:
        """Rows: right, up, towards the viewer; shape (3, 3)."""
        sin_e, cos_e = np.sin(self.elevation), np.cos(self.elevation)
        sin_a, cos_a = np.sin(self.azimuth), np.cos(self.azimuth)
        return np.array(
            [[-sin_a, cos_a, 0.0], [-sin_e * cos_a, -sin_e * sin_a, cos_e], [cos_e * cos_a, cos_e * sin_a, sin_e]]
        )


def render_frames(
    trajectory: Trajectory,
    meshes: Sequence[Mesh],
    surfaces: Sequence[Surface],
    path: str | os.PathLike[str],
    *,
    times: Sequence[float] | None = None,
    view: tuple[float, float] = (14.0, -80.0),
    floor: float | None = 0.0,
    width_px: int = 1600,
) -> None:
    """Draw frames side by side into a PNG file.

    meshes: of the soft bodies, in the scene's order; surfaces: of the rigid bodies, in their body frames
    times: moments to draw [s], the nearest recorded ones are taken; four evenly spaced if None
    view: elevation and azimuth of the viewer [degrees]; floor: height of the floor [m], None for no floor
    Raises InputError if nothing was recorded or the file cannot be written.
    """
    if times is None:
        recorded = trajectory.recorded_times
        times = np.linspace(recorded[0], recorded[-1], 4).tolist() if len(recorded) else (0.0,)
    frames = [trajectory.recorded_at(time) for time in times]
    moments = [float(trajectory.recorded_times[frame]) for frame in frames]
    axes = View(*np.radians(view)).axes
    rigid = [trajectory.placed(surfaces, time) for time in moments]
    points = np.concatenate([trajectory.soft_positions[frames].reshape(-1, 3), *(p for ps in rigid for p in ps)])
    low, high = _bounds(points, axes)
    size = float(np.max(high - low))
    pictures = []
    for frame, placed in zip(frames, rigid):
        faces = list(_soft_faces(trajectory.soft_positions[frame], meshes))
        for vertices, (_, triangles) in zip(placed, surfaces):
            faces.append(_Faces(_divided(vertices[triangles], FACE_SIZE * size), RIGID_COLOUR, False))
        pictures.append(faces)
    _draw(pictures, moments, axes, (low, high), floor, path, width_px)


@dataclass(frozen=True)
class _Faces:
    """Faces of one kind, (n, k, 3) [m], their colour, and whether their outlines are drawn."""

    corners: np.ndarray
    colour: tuple[float, float, float]
    outlined: bool

    @property
    def normals(self) -> np.ndarray:
        """Unit normals (n, 3), by Newell's method, for any polygon."""
        following = np.roll(self.corners, -1, axis=1)
        area = np.cross(self.corners, following).sum(axis=1)
        return area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), np.finfo(float).tiny)


def _soft_faces(positions: np.ndarray, meshes: Sequence[Mesh]) -> Iterator[_Faces]:
    first = 0
    for mesh in meshes:
        for kind, nodes in mesh.faces.items():
            yield _Faces(positions[first + nodes[:, _OUTLINE[kind]]], SOFT_COLOUR, True)
        first += mesh.n_vertices


def _divided(triangles: np.ndarray, longest: float) -> np.ndarray:
    """Halve the longest edge of triangles (n, 3, 3) until none is longer than ``longest``; keeps the orientation."""
    done = []
    while len(triangles):
        lengths = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        large = lengths.max(axis=1) > longest
        done.append(triangles[~large])
        triangles, lengths = triangles[large], lengths[large]
        order = (lengths.argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles, order[:, :, None], axis=1), 1, 0)
        middle = 0.5 * (a + b)
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(done) if done else triangles


def _bounds(points: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest picture coordinates (2,) of points (n, 3), with a margin."""
    flat = points @ axes[:2].T
    margin = 0.08 * np.max(np.ptp(flat, axis=0))
    return flat.min(axis=0) - margin, flat.max(axis=0) + margin


def _shadow(points: np.ndarray, floor: float) -> np.ndarray:
    """Return where the light throws ``points`` (..., 3) onto the floor."""
    return points - ((points[..., 2:] - floor) / LIGHT[2]) * LIGHT


def _draw(
    pictures: Sequence[Sequence[_Faces]],
    moments: Sequence[float],
    axes: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    floor: float | None,
    path: str | os.PathLike[str],
    width_px: int,
) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    low, high = bounds
    dpi = 200
    width = width_px / dpi
    panel = width / len(pictures)
    height = panel * float((high - low)[1] / (high - low)[0])
    figure = Figure(figsize=(width, height + 0.2), dpi=dpi)
    FigureCanvasAgg(figure)
    for column, (faces, moment) in enumerate(zip(pictures, moments)):
        plot = figure.add_axes((column / len(pictures), 0.0, 1.0 / len(pictures), height / (height + 0.2)))
        plot.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        plot.axis("off")
        if floor is not None:
            _draw_floor(plot, faces, axes, bounds, floor)
        plot.add_collection(_painted(faces, axes))
        plot.set_title(f"{moment:.2f} s", fontsize=7, pad=2.0)
    try:
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png")
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", str(path)) from error


def _painted(faces: Sequence[_Faces], axes: np.ndarray) -> Any:
    """Return the faces that look at the viewer, shaded, the farthest first."""
    from matplotlib.collections import PolyCollection

    polygons: list[np.ndarray] = []
    colours, outlines, depths = [], [], []
    for group in faces:
        seen = group.normals @ axes[2] > 0.0
        corners, normals = group.corners[seen], group.normals[seen]
        lamp = np.maximum(normals @ (LIGHT / np.linalg.norm(LIGHT)), 0.0)
        shade = AMBIENT + LAMP * lamp + HEADLIGHT * (normals @ axes[2])
        colour = np.clip(shade[:, None] * np.array(group.colour), 0.0, 1.0)
        colours.append(colour)
        outlines.append(0.6 * colour if group.outlined else colour)
        polygons.extend(corners @ axes[:2].T)
        depths.append(np.mean(corners, axis=1) @ axes[2])
    order = np.argsort(np.concatenate(depths), kind="stable")
    return PolyCollection(
        [polygons[i] for i in order],
        facecolors=np.concatenate(colours)[order],
        edgecolors=np.concatenate(outlines)[order],
        linewidths=0.15,
        joinstyle="round",
    )


def _draw_floor(
    plot: Any, faces: Sequence[_Faces], axes: np.ndarray, bounds: tuple[np.ndarray, np.ndarray], floor: float
) -> None:
    """Draw a grid of 20 mm on the floor and the shadows of the faces."""
    from matplotlib.collections import LineCollection, PolyCollection

    if axes[2, 2] <= 0.0:
        return  # seen from below the floor would hide everything
    shadows = [polygon for group in faces for polygon in _shadow(group.corners, floor) @ axes[:2].T]
    reach = 0.02 * np.ceil(2.0 * np.max(np.ptp(np.array(bounds), axis=0)) / 0.02)
    ticks = np.arange(-reach, reach + 0.01, 0.02)
    ends = np.stack([np.full(len(ticks), -reach), np.full(len(ticks), reach)], axis=1)
    along_x = np.stack([ends, np.repeat(ticks[:, None], 2, axis=1), np.full_like(ends, floor)], axis=2)
    grid = np.concatenate([along_x, along_x[:, :, [1, 0, 2]]])
    plot.add_collection(LineCollection(list(grid @ axes[:2].T), colors=[GRID_COLOUR], linewidths=0.4, zorder=0.1))
    dark = [SHADOW_COLOUR]
    plot.add_collection(PolyCollection(shadows, facecolors=dark, edgecolors=dark, linewidths=0.3, zorder=0.2))
