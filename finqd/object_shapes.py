"""Shapes of objects: from their JSON (``{"kind": "sphere", "diameter_mm": 40}``) to surface, mass and distance.

Every shape is moved so that its centre of mass is the origin; its axes stay those of the file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from finqd.cache import remembered
from finqd.errors import InputError
from finqd.mechanics.distance import (
    field_arrays,
    field_of,
    revolution_field,
    sphere_field,
    surface_field,
    triangle_neighbours,
)
from finqd.mechanics.distance_kernels import DistanceField
from finqd.mechanics.mass_properties import ball_moments, revolution_moments, surface_moments
from finqd.options import checked, join, refuse_unknown, require_object, shown
from finqd.units import MM

SIZE_LOW, SIZE_HIGH = 1.0, 500.0  # largest extent of an object [mm]: beyond, its unit is probably another
MANY = 1000  # triangles of a surface from which on its distance field is kept on disk: fewer are done in 20 ms
AROUND = 96  # corners of a lathe's surface: for display and overlap tests, not for contact
UNITS = {"mm": MM, "cm": 0.01, "m": 1.0, "in": 0.0254}

Length = Annotated[float, Ge(0.1), Le(SIZE_HIGH)]
Coordinate = Annotated[float, Ge(-SIZE_HIGH), Le(SIZE_HIGH)]
Radius = Annotated[float, Ge(0), Le(SIZE_HIGH)]


@dataclass(frozen=True)
class Shape:
    """A solid with its centre of mass in the origin.

    volume [m^3]; inertia (3, 3): of density 1, about the origin [m^5]; vertices (n, 3) [m] and triangles (m, 3): its
    surface, watertight and outward; distance; profile (r, z) [m] of a solid of revolution or None; ball_radius: 0
    unless it is a ball [m].
    """

    volume: float
    inertia: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray
    distance: DistanceField
    profile: np.ndarray | None = None
    ball_radius: float = 0.0


def shape_from_json(value: Any, where: str, folder: Path) -> Shape:
    """Return the shape that a JSON object describes. Raises ``InputError``.

    ``folder``: where relative file paths start.
    """
    given = dict(require_object(value, where))
    if "kind" not in given:
        raise InputError(f"is missing; known kinds: {', '.join(KINDS)}", join(where, "kind"))
    kind = given.pop("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise InputError(f"must be one of {', '.join(KINDS)}, not {shown(kind)}", join(where, "kind"))
    shape = KINDS[kind](given, where, folder)
    refuse_size(shape.vertices, where)
    return shape


def ball(radius: float) -> Shape:
    """Return a ball of ``radius`` [m]."""
    angles = np.linspace(-np.pi / 2.0, np.pi / 2.0, AROUND // 2 + 1)
    profile = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    profile[[0, -1], 0] = 0.0
    moments = ball_moments(radius)
    surface = turned_surface(profile, n_around=AROUND)
    return Shape(moments.volume, moments.inertia, *surface, sphere_field(radius), ball_radius=radius)


def solid_of_revolution(profile: np.ndarray) -> Shape:
    """Return the solid of revolution about z with a simple, counterclockwise profile (r, z) [m], shape (n, 2)."""
    moments = revolution_moments(profile)
    profile = profile - [0.0, moments.centre[2]]
    return Shape(
        moments.volume,
        moments.inertia,
        *turned_surface(profile, n_around=AROUND),
        revolution_field(profile),
        profile=profile,
    )


def solid_in_surface(vertices: np.ndarray, triangles: np.ndarray) -> Shape:
    """Return the solid inside a watertight, outward surface: vertices [m], shape (n, 3), triangles (m, 3)."""
    moments = surface_moments(vertices, triangles)
    vertices = vertices - moments.centre

    def field() -> DistanceField:
        return surface_field(vertices, triangles, topology=triangle_neighbours(triangles))

    few = len(triangles) < MANY
    distance = field() if few else remembered(
        "surface field", [vertices, triangles], field, pack=field_arrays, unpack=field_of)
    return Shape(moments.volume, moments.inertia, vertices, triangles, distance)


def turned_surface(profile: np.ndarray, *, n_around: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the watertight surface (vertices (n, 3) [m], triangles) of a lathe; profile: counterclockwise (r, z)."""
    angles = 2.0 * np.pi * np.arange(n_around) / n_around
    rings, blocks, count = [], [], 0
    for r, z in profile:
        n = n_around if r > 0.0 else 1
        rings.append(np.arange(count, count + n) if n > 1 else np.full(n_around, count))
        blocks.append(np.column_stack([r * np.cos(angles[:n]), r * np.sin(angles[:n]), np.full(n, z)]))
        count += n
    triangles = []
    for i, here in enumerate(rings):
        there = rings[(i + 1) % len(rings)]
        if profile[i, 0] > 0.0:
            triangles.append(np.column_stack([here, np.roll(here, -1), there]))
        if profile[(i + 1) % len(rings), 0] > 0.0:
            triangles.append(np.column_stack([np.roll(here, -1), np.roll(there, -1), there]))
    return np.concatenate(blocks), np.concatenate(triangles)


def refuse_size(vertices: np.ndarray, where: str, hint: str = "") -> None:
    """Raise ``InputError`` if the largest extent is not that of a thing that a gripper handles."""
    size = float(np.ptp(vertices, axis=0).max()) / MM
    if not SIZE_LOW <= size <= SIZE_HIGH:
        raise InputError(f"must be {SIZE_LOW:g} to {SIZE_HIGH:g} mm across, not {size:.4g} mm{hint}", where)


def _sphere(given: Mapping[str, Any], where: str, folder: Path) -> Shape:
    fields = _fields(given, where, required={"diameter_mm": Length})
    return ball(fields["diameter_mm"] / 2.0 * MM)


def _box(given: Mapping[str, Any], where: str, folder: Path) -> Shape:
    _fields(given, where, required={"size_mm": None})
    size = _row(given["size_mm"], join(where, "size_mm"), (Length,) * 3) * MM
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    return solid_in_surface(*convex_hull(corners, where))


def _cosine_waist(given: Mapping[str, Any], where: str, folder: Path) -> Shape:
    """Radius r(z) = (R_end + R_waist) / 2 - (R_end - R_waist) / 2 cos(2 pi z / height), |z| <= height / 2."""
    lengths = {"end_diameter_mm": Length, "waist_diameter_mm": Length, "height_mm": Length}
    fields = _fields(given, where, required=lengths, optional={"segments": Annotated[int, Ge(8), Le(400)]})
    end, waist, height = (fields[key] * MM for key in lengths)
    share = np.linspace(-0.5, 0.5, fields.get("segments", 48) + 1)
    radius = (end + waist) / 4.0 - (end - waist) / 4.0 * np.cos(2.0 * np.pi * share)
    side = np.column_stack([radius, share * height])
    return solid_of_revolution(np.concatenate([[[0.0, -height / 2.0]], side, [[0.0, height / 2.0]]]))


def _revolution(given: Mapping[str, Any], where: str, folder: Path) -> Shape:
    _fields(given, where, required={"profile_mm": None})
    where = join(where, "profile_mm")
    profile = _rows(given["profile_mm"], where, (Radius, Coordinate), at_least=3, at_most=2000)
    if np.array_equal(profile[0], profile[-1]):
        profile = profile[:-1]
    return solid_of_revolution(_checked_profile(profile, where) * MM)


def _polyhedron(given: Mapping[str, Any], where: str, folder: Path) -> Shape:
    _fields(given, where, required={"vertices_mm": None}, optional={"faces": None})
    place = join(where, "vertices_mm")
    vertices = _rows(given["vertices_mm"], place, (Coordinate,) * 3, at_least=4, at_most=20_000) * MM
    if "faces" not in given:
        return solid_in_surface(*convex_hull(vertices, place))
    from finqd.surface_files import checked_surface

    triangles = _fans(given["faces"], join(where, "faces"), len(vertices))
    return solid_in_surface(*checked_surface(vertices, triangles, join(where, "faces")))


def _file(given: Mapping[str, Any], where: str, folder: Path) -> Shape:
    from finqd.surface_files import read_surface

    fields = _fields(
        given,
        where,
        required={"path": str},
        optional={"unit": Literal["mm", "cm", "m", "in"], "scale": Annotated[float, Ge(1e-6), Le(1e6)]},
    )
    unit = fields.get("unit", "mm")
    vertices, triangles = read_surface(folder / fields["path"], factor=UNITS[unit] * fields.get("scale", 1.0))
    refuse_size(vertices, fields["path"], f" (read in {unit}; a shape of kind file takes \"unit\": {', '.join(UNITS)})")
    return solid_in_surface(vertices, triangles)


#: kind in JSON -> what makes the shape of (the other keys, the place, the folder)
KINDS: dict[str, Callable[[Mapping[str, Any], str, Path], Shape]] = {
    "sphere": _sphere, "box": _box, "revolution": _revolution, "cosine_waist": _cosine_waist,
    "polyhedron": _polyhedron, "file": _file,
}  # fmt: skip


def convex_hull(points: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface (vertices, triangles) of the hull of ``points`` [m], shape (n, 3). Raises ``InputError``."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except QhullError as error:
        raise InputError("these points lie in one plane and enclose no volume", where) from error
    triangles = hull.simplices.astype(np.int64)
    a, b, c = (points[triangles[:, i]] for i in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    triangles[inward] = triangles[inward, ::-1]
    used, renumbered = np.unique(triangles, return_inverse=True)
    return points[used], renumbered.reshape(-1, 3)


def _checked_profile(profile: np.ndarray, where: str) -> np.ndarray:
    """Return a profile [mm] as a simple, counterclockwise polygon. Raises ``InputError``."""
    from shapely import Polygon
    from shapely.validation import explain_validity

    steps = np.linalg.norm(np.roll(profile, -1, axis=0) - profile, axis=1)
    if np.any(steps < 1e-6):
        second = (int(np.argmin(steps)) + 1) % len(profile)
        raise InputError("this point repeats the one before it", join(where, second))
    polygon = Polygon(profile)
    if not polygon.is_valid or polygon.area < 1e-4:
        reason = explain_validity(polygon) if not polygon.is_valid else "it encloses no area"
        raise InputError(f"must be a closed polygon [r, z] that does not cross itself ({reason})", where)
    if not polygon.exterior.is_ccw:
        profile = profile[::-1]
    on_axis = profile[:, 0] == 0.0
    alone = on_axis & ~np.roll(on_axis, 1) & ~np.roll(on_axis, -1)
    if alone.any():
        raise InputError("touches the axis in a single point, where the solid would have no thickness", where)
    return profile


def _fans(faces: Any, where: str, n_vertices: int) -> np.ndarray:
    """Return polygons (lists of vertex numbers, counterclockwise from outside) as triangles, shape (m, 3)."""
    if not isinstance(faces, list) or not 4 <= len(faces) <= 50_000:
        raise InputError(f"must be a list of 4 to 50000 faces, not {shown(faces)}", where)
    number = Annotated[int, Ge(0), Le(n_vertices - 1)]
    triangles = []
    for i, face in enumerate(faces):
        place = join(where, i)
        if not isinstance(face, list) or not 3 <= len(face) <= 1000:
            raise InputError(f"must be a list of 3 or more vertex numbers, not {shown(face)}", place)
        corners = [checked(number, corner, join(place, k)) for k, corner in enumerate(face)]
        if len(set(corners)) < len(corners):
            raise InputError(f"must not name a vertex twice, not {shown(face)}", place)
        triangles += [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]
    return np.array(triangles, dtype=np.int64)


def _fields(
    given: Mapping[str, Any], where: str, *, required: Mapping[str, Any], optional: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the values of a shape's keys, checked against their types; a type of None is checked elsewhere."""
    types = {**required, **(optional or {})}
    refuse_unknown(given, [*types, "kind"], where)
    for key in required:
        if key not in given:
            raise InputError(f"is missing; this kind of shape takes {', '.join(types)}", join(where, key))
    return {
        key: checked(kind, given[key], join(where, key))
        for key, kind in types.items()
        if key in given and kind is not None
    }


def _row(value: Any, where: str, columns: tuple[Any, ...]) -> np.ndarray:
    if not isinstance(value, (list, tuple)) or len(value) != len(columns):
        raise InputError(f"must be a list of {len(columns)} numbers, not {shown(value)}", where)
    return np.array([checked(kind, item, join(where, i)) for i, (kind, item) in enumerate(zip(columns, value))])


def _rows(value: Any, where: str, columns: tuple[Any, ...], *, at_least: int, at_most: int) -> np.ndarray:
    if not isinstance(value, (list, tuple)) or not at_least <= len(value) <= at_most:
        count = f", with {len(value)} in it" if isinstance(value, (list, tuple)) else f", not {shown(value)}"
        raise InputError(f"must be a list of {at_least} to {at_most} points{count}", where)
    return np.array([_row(item, join(where, i), columns) for i, item in enumerate(value)])
