"""Solids that geometry plugins build and meshers fill: a prism over a polygon, or any closed surface.

Both live in the finger frame of `finqd.contracts` [m]; the part in the plane y = 0 is the base.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from shapely import Polygon

#: sides of one patch of a profile, counter-clockwise; each (k, 2) [m], from a corner to the next one
Patch = tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class Prism:
    """A polygon with holes in the x-y plane, swept along z over [-thickness/2, thickness/2].

    outer: corners of the outline [m], counter-clockwise, shape (n, 2)
    holes: one array (m, 2) each [m], either orientation
    thickness: length along z [m]
    contact_line: base point and tip point of the contact face in the profile [m], shape (2, 2), or None
    patches: a hint that a swept mesher may follow: a partition of the profile into three- and four-sided patches.
        A patch is a tuple of three or four sides, counter-clockwise; a side is a polyline whose inner points
        (corners of neighbours, on a straight or a gently bent side) become mesh vertices. Neighbours share whole
        segments, end points equal to within 1e-9 m. None: the mesher finds its own way.
    """

    outer: np.ndarray
    holes: tuple[np.ndarray, ...]
    thickness: float
    contact_line: np.ndarray | None = None
    patches: tuple[Patch, ...] | None = field(default=None, repr=False)

    @cached_property
    def polygon(self) -> Polygon:
        """The profile as a shapely polygon."""
        from shapely import Polygon

        return Polygon(self.outer, self.holes)

    @property
    def area(self) -> float:
        """Area of the profile [m^2]."""
        return abs(ring_area(self.outer)) - sum(abs(ring_area(hole)) for hole in self.holes)

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        return self.area * self.thickness

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the closed surface: vertices [m], shape (n, 3), and triangles (m, 3), ordered outwards."""
        rings = [_oriented(self.outer, 1.0), *(_oriented(hole, -1.0) for hole in self.holes)]
        flat = np.concatenate(rings)
        cap = _triangulate(self.polygon, flat)
        count, half = len(flat), 0.5 * self.thickness
        vertices = np.concatenate([np.column_stack([flat, np.full(count, z)]) for z in (-half, half)])
        start, walls = 0, []
        for ring in rings:
            here = start + np.arange(len(ring))
            after = start + (np.arange(len(ring)) + 1) % len(ring)
            walls.append(np.column_stack([here, after, after + count]))
            walls.append(np.column_stack([here, after + count, here + count]))
            start += len(ring)
        return vertices, np.concatenate([cap[:, ::-1], cap + count, *walls])


@dataclass(frozen=True, eq=False)
class SurfaceSolid:
    """Any solid, given by its closed surface.

    vertices: [m], shape (n, 3); triangles: (m, 3), watertight, ordered outwards
    contact_line: base point and tip point of a flat contact face, in the profile [m], shape (2, 2): a surface point
        belongs to the contact face if its x and y lie on that line. None: all that points towards -x belongs to it.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    contact_line: np.ndarray | None = None

    @property
    def volume(self) -> float:
        """Volume [m^3], from the divergence theorem."""
        a, b, c = np.moveaxis(self.vertices[self.triangles] - self.vertices.mean(axis=0), 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the closed surface: vertices [m], shape (n, 3), and triangles (m, 3), ordered outwards."""
        return self.vertices, self.triangles


Solid = Prism | SurfaceSolid


def ring_area(ring: np.ndarray) -> float:
    """Return the signed area of a closed polygon (n, 2): positive if counter-clockwise (shoelace formula)."""
    x, y = (np.asarray(ring, dtype=float) - ring[0]).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _oriented(ring: np.ndarray, sign: float) -> np.ndarray:
    ring = np.asarray(ring, dtype=float)
    return ring if ring_area(ring) * sign > 0 else ring[::-1]


def _triangulate(polygon: Polygon, points: np.ndarray) -> np.ndarray:
    """Return counter-clockwise triangles (m, 3) of ``polygon`` that use its own corners ``points`` (n, 2) only."""
    import shapely

    pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    corners = shapely.get_coordinates(pieces).reshape(-1, 4, 2)[:, :3]
    order = np.lexsort(points.T[::-1])
    lookup = {point.tobytes(): index for index, point in zip(order.tolist(), points[order], strict=True)}
    triangles = np.array([[lookup[c.tobytes()] for c in triangle] for triangle in corners], dtype=np.int64)
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    turned = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    triangles[turned] = triangles[turned][:, ::-1]
    return triangles
