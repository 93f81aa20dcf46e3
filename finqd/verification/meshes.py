"""Meshes of verification cases: bricks mapped onto curved shapes.

>>> round(cook_mesh(2).volume * 1e9, 6)  # mm^3
7200.0
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from finqd.mesh import Mesh
from finqd.mesh_shapes import box_mesh
from finqd.units import MM

COOK_THICKNESS = 5 * MM

Mapping = Callable[[np.ndarray], np.ndarray]


def mapped_box(divisions: Sequence[int], element: str, mapping: Mapping, *, straight: bool = False) -> Mesh:
    """Return the unit cube's mesh, of ``element``, moved by ``mapping`` (n, 3) -> (n, 3) [m], with the cube's sets.

    ``straight``: mid-edge nodes stay in the middle of their edges, for shapes with flat sides.
    """
    corners = box_mesh((1.0, 1.0, 1.0), divisions, element)
    if not straight:
        return Mesh(mapping(corners.vertices), corners.blocks, corners.node_sets, corners.face_sets)
    from finqd.mechanics.elements import element as reference_element

    kind = reference_element(element)
    nodes = corners.blocks[element]
    vertices = mapping(corners.vertices)
    if kind.quadratic:
        linear = {"hex20": "hex8", "tet10": "tet4"}[element]
        weights = reference_element(linear).shape(kind.nodes)
        vertices[nodes] = np.einsum("ak,ekd->ead", weights, vertices[nodes[:, : kind.corners]])
    return Mesh(vertices, corners.blocks, corners.node_sets, corners.face_sets)


def cook_mesh(n: int, element: str = "hex8") -> Mesh:
    """Return Cook's membrane, n by n by 1 bricks [m]: corners (0, 0) (48, 44) (48, 60) (0, 44) mm, 5 mm thick.

    Sets: ``xmin`` is clamped, ``xmax`` loaded, ``zmin`` and ``zmax`` the faces.
    """
    def mapping(unit: np.ndarray) -> np.ndarray:
        a, b, c = unit.T
        low, high = 44.0 * a, 44.0 + 16.0 * a
        return np.column_stack([48.0 * a * MM, (low + b * (high - low)) * MM, c * COOK_THICKNESS])

    return mapped_box((n, n, 1), element, mapping, straight=True)


def quarter_ball(radius: float, n: int, element: str = "hex8", *, grading: float = 4.0) -> Mesh:
    """Return a quarter of the lower half of a ball, centre at the origin, graded towards its lowest point.

    n bricks along each axis. Flat faces: ``xmin`` and ``ymin`` (symmetry) and ``zmax`` (the equator); the curved face
    consists of ``zmin``, ``xmax`` and ``ymax``. The cube is mapped as by Nowell (2005): x' = x sqrt(1 - y^2/2 -
    z^2/2 + y^2 z^2/3); ``grading`` g moves its points by s = sinh(g t) / sinh(g), finest at the pole.
    """
    def mapping(unit: np.ndarray) -> np.ndarray:
        graded = np.sinh(grading * unit) / np.sinh(grading)
        x, y, z = graded[:, 0], graded[:, 1], graded[:, 2] - 1.0
        squares = [x * x, y * y, z * z]

        def factor(p: np.ndarray, q: np.ndarray) -> np.ndarray:
            return np.sqrt(1.0 - p / 2.0 - q / 2.0 + p * q / 3.0)

        return radius * np.column_stack([
            x * factor(squares[1], squares[2]), y * factor(squares[2], squares[0]), z * factor(squares[0], squares[1]),
        ])

    return mapped_box((n, n, n), element, mapping)
