"""The swept mesher: quadrilaterals in the profile, hexahedra along the thickness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le

from finqd.errors import MeshError
from finqd.mesh import Mesh
from finqd.mesh_notches import with_quarter_nodes
from finqd.mesh_sets import with_finger_sets
from finqd.mesh_shapes import quadratic
from finqd.plugins.swept_patches import PlaneMesh, corner_sines, mesh_patches
from finqd.solid import Patch, Prism, Solid
from finqd.units import MM

_GOOD_ENOUGH = 0.1  # sine of the worst corner above which no second mesh is tried
_MILDER = (0.5, 0.0)  # shares of the grading that are tried where all of it skews elements too much
_AREA = 1e-9  # relative difference that rounding may leave
_LAYER = 1.25  # layers are that much longer than the size: bending leaves the thickness almost straight
_CORNER = np.radians(150.0)  # a profile's corner below this angle is a corner of its patch


@dataclass(frozen=True, kw_only=True)
class Swept:
    """Quadrilaterals in a prism's profile, swept along its thickness: hexahedra, and wedges where triangles remain.

    ``size_mm``: edge length aimed at in the profile; ``layers``: elements along the thickness, null for thickness /
    (1.25 size), at least 2; ``least_edges``: elements through a wall at least; ``grading``: above 1, edges shrink
    towards the notches between walls and ribs, with that exponent (patches only; less where that would skew elements);
    ``notch_nodes``: "quarter" puts mid-edge nodes next to a notch at a quarter of their edge, where they follow its
    stress (order 2 only). A profile that comes in patches, or is one patch itself (a triangle or a quadrilateral
    without holes), is meshed by interpolation, without wedges; any other by gmsh. ``order``: 2 gives quadratic
    hexahedra (hex20, straight edges, a node in the middle of each); there is no quadratic wedge, so that a profile
    whose mesh leaves triangles is meshed twice as coarse then, and all its elements are cut into quadrilaterals.
    ``tetrahedra``: each hexahedron is cut into six, each wedge into three: another family of elements on the same
    nodes, to compare with.
    """

    size_mm: Annotated[float, Ge(0.2), Le(50)] = 4.0
    layers: Annotated[int, Ge(1), Le(200)] | None = None
    least_edges: Annotated[int, Ge(1), Le(20)] = 1
    order: Literal[1, 2] = 1
    grading: Annotated[float, Ge(1), Le(4)] = 1.0
    notch_nodes: Literal["middle", "quarter"] = "middle"
    tetrahedra: bool = False

    def mesh(self, solid: Solid) -> Mesh:
        """Return the mesh of ``solid``; raises ``MeshError`` (``finqd.contracts.Mesher``)."""
        if not isinstance(solid, Prism):
            raise MeshError("the swept mesher takes prisms only; use the mesher 'tetrahedral' for other solids")
        plane = self._plane(solid)
        worst = plane.worst()
        if worst <= 0:
            raise MeshError(f"the profile's best mesh has a turned element (sine of its corner {worst:.2g})")
        if self.tetrahedra:
            plane = _cut(plane)
        mesh = self._sweep(plane, solid.thickness)
        if self.tetrahedra:
            mesh = Mesh(mesh.vertices, {"tet4": _tetrahedra(mesh.blocks["wedge6"])})
        if self.order == 2:
            mesh = quadratic(mesh)
            if self.notch_nodes == "quarter":
                mesh = with_quarter_nodes(mesh)
        return with_finger_sets(mesh, solid.contact_line)

    def _plane(self, solid: Prism) -> PlaneMesh:
        patches = solid.patches or _single_patch(solid)
        first = self._graded(solid, patches) if patches else None
        if first and first.worst() >= _GOOD_ENOUGH:
            return first
        from finqd.plugins.swept_paving import pave, pave_with_quads

        try:
            paving = pave_with_quads if self.order == 2 and not self.tetrahedra else pave  # there is no quadratic wedge
            second = paving(solid, self.size_mm * MM, self.least_edges)
        except MeshError:
            if first is None:
                raise
            return first
        return first if first and first.worst() >= second.worst() else second

    def _graded(self, solid: Prism, patches: tuple[Patch, ...]) -> PlaneMesh | None:
        """Return the mesh of the patches, graded as far as its corners allow; paving would not be graded at all."""
        shares = (1.0, *(_MILDER if self.grading > 1.0 else ()))
        best = None
        for share in shares:
            plane = self._from_patches(solid, patches, 1.0 + share * (self.grading - 1.0))
            if plane and (best is None or plane.worst() > best.worst()):
                best = plane
            if best and best.worst() >= _GOOD_ENOUGH:
                break
        return best

    def _from_patches(self, solid: Prism, patches: tuple[Patch, ...], grading: float) -> PlaneMesh | None:
        """Return the mesh of the patches, or None if they are no partition of the profile or do not fit together."""
        try:
            plane = mesh_patches(patches, self.size_mm * MM, self.least_edges, grading)
        except MeshError:
            return None
        return plane if plane.worst() > 0 and abs(plane.area() - solid.area) <= _AREA * solid.area else None

    def _sweep(self, plane: PlaneMesh, thickness: float) -> Mesh:
        layers = self.layers or max(2, int(thickness / (_LAYER * self.size_mm * MM)))
        levels = np.linspace(-0.5 * thickness, 0.5 * thickness, layers + 1)
        count = len(plane.points)
        vertices = np.empty((count, layers + 1, 3))
        vertices[..., :2] = plane.points[:, None]
        vertices[..., 2] = levels
        blocks = {}
        for kind, elements in (("hex8", plane.quads), ("wedge6", plane.triangles)):
            if len(elements):
                lower = elements[:, None, :] * (layers + 1) + np.arange(layers)[None, :, None]
                blocks[kind] = np.concatenate([lower, lower + 1], axis=-1).reshape(-1, 2 * elements.shape[1])
        return Mesh(vertices.reshape(-1, 3), blocks)


def _cut(plane: PlaneMesh) -> PlaneMesh:
    """Return the mesh with every quadrilateral cut along its shorter diagonal."""
    a, b, c, d = plane.quads.T
    corners = plane.points[plane.quads]
    one, other = (np.linalg.norm(corners[:, i] - corners[:, i + 2], axis=1) for i in (0, 1))
    first = np.where((one <= other)[:, None], np.column_stack([a, b, c]), np.column_stack([b, c, d]))
    second = np.where((one <= other)[:, None], np.column_stack([a, c, d]), np.column_stack([b, d, a]))
    triangles = np.concatenate([first, second, plane.triangles])
    return PlaneMesh(plane.points, np.empty((0, 4), dtype=int), triangles)


def _tetrahedra(wedges: np.ndarray) -> np.ndarray:
    """Return three tetrahedra (3 n, 4) a wedge (n, 6); faces of neighbours match, as the vertex with the smaller id
    decides (Dompierre, Labbe, Vallet and Camarero, Proc. 8th Int. Meshing Roundtable, 1999).

    Holds for `_sweep`'s numbering, in which all vertices of a column are numbered together, from below.
    """
    order = np.argsort(wedges[:, :3], axis=1)
    low, high = (np.take_along_axis(half, order, axis=1) for half in (wedges[:, :3], wedges[:, 3:]))
    rows = [[low[:, 0], low[:, 1], low[:, 2], high[:, 2]], [low[:, 0], low[:, 1], high[:, 2], high[:, 1]],
            [low[:, 0], high[:, 0], high[:, 1], high[:, 2]]]
    found = np.stack([np.stack(row, axis=1) for row in rows], axis=1)
    odd = np.linalg.det(np.eye(3)[order]) < 0.0  # the corners were swapped an odd number of times
    found[odd] = found[odd][:, :, [1, 0, 2, 3]]
    return found.reshape(-1, 4)


def _single_patch(solid: Prism) -> tuple[Patch, ...] | None:
    """Return a profile without holes as one patch, if it has three or four corners."""
    if solid.holes:
        return None
    ring = np.asarray(solid.outer, dtype=float)
    sines = corner_sines(ring)
    after, before = np.roll(ring, -1, axis=0) - ring, np.roll(ring, 1, axis=0) - ring
    angles = np.arctan2(sines, np.sum(after * before, axis=1) / np.linalg.norm(after, axis=1)
                        / np.linalg.norm(before, axis=1))
    corners = np.flatnonzero((angles > 0) & (angles < _CORNER))
    if len(corners) not in (3, 4):
        return None
    ring = np.roll(ring, -corners[0], axis=0)
    stops = [*(corners - corners[0]), len(ring)]
    closed = np.concatenate([ring, ring[:1]])
    return (tuple(closed[a : b + 1] for a, b in zip(stops, stops[1:], strict=False)),)
