"""Reference elements as a mesh needs them: nodes, faces, Gauss points and shape gradients.

Shape functions are those of `finqd.mechanics.elements`; nodes are in the same order there.
"""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np

#: corners of each face type
CORNERS = {"quad4": 4, "quad8": 4, "tri3": 3, "tri6": 3}

_HEX_FACES = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
_TET_FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3))
_WEDGE_FACES = ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5))
_HEX_SIDES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
_TET_SIDES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))

#: edges that carry the mid-edge nodes of the quadratic types, in VTK's order
MID_EDGES = {"tet10": _TET_SIDES, "hex20": _HEX_SIDES}


def _quadratic_faces(kind: str, faces: tuple) -> tuple:
    first = {"tet10": 4, "hex20": 8}[kind]
    middle = {frozenset(edge): first + i for i, edge in enumerate(MID_EDGES[kind])}
    return tuple((*f, *(middle[frozenset((f[i], f[(i + 1) % len(f)]))] for i in range(len(f)))) for f in faces)


def _named(faces: tuple) -> tuple[tuple[str, list[int]], ...]:
    names = {3: "tri3", 4: "quad4", 6: "tri6", 8: "quad8"}
    return tuple((names[len(face)], list(face)) for face in faces)


#: faces of each element type: (face type, local nodes), outward and counter-clockwise
FACES = {
    "hex8": _named(_HEX_FACES),
    "hex20": _named(_quadratic_faces("hex20", _HEX_FACES)),
    "wedge6": _named(_WEDGE_FACES),
    "tet4": _named(_TET_FACES),
    "tet10": _named(_quadratic_faces("tet10", _TET_FACES)),
}


class Reference(NamedTuple):
    """A reference element."""

    gradients: np.ndarray  # dN/dxi at the Gauss points, shape (n_points, nodes, 3)
    weights: np.ndarray  # Gauss weights, shape (n_points,)
    corner_edges: np.ndarray  # the three neighbours of each corner, right-handed, shape (corners, 3)
    scale: float  # makes the scaled Jacobian 1 for the ideal element


@cache
def reference(kind: str) -> Reference:
    """Return the reference element of a type."""
    from finqd.mechanics.elements import element  # brings scipy, which a mesh that is only carried about does not need

    points, weights = _gauss(kind)
    gradients = element(kind).shape_gradients(points)
    scale = {"hex": 1.0, "wed": 2.0 / np.sqrt(3.0), "tet": np.sqrt(2.0)}[kind[:3]]
    return Reference(gradients, weights, _corner_edges(kind), scale)


def _gauss(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) and weights (n,) that integrate the Jacobian of a straight-sided element exactly."""
    if kind.startswith("tet"):
        a, b = (5.0 - np.sqrt(5.0)) / 20.0, (5.0 + 3.0 * np.sqrt(5.0)) / 20.0
        points = np.full((4, 3), a)
        points[:3] += (b - a) * np.eye(3)
        return points, np.full(4, 1.0 / 24.0)
    line, weight = np.polynomial.legendre.leggauss(3 if kind == "hex20" else 2)
    if kind == "wedge6":
        plane = np.array([(1, 1), (4, 1), (1, 4)]) / 6.0
        points = np.array([(r, s, t) for r, s in plane for t in line])
        return points, np.full(6, 1.0 / 6.0)
    points = np.array(list(product(line, repeat=3)))
    return points, np.array([np.prod(w) for w in product(weight, repeat=3)])


def _corner_edges(kind: str) -> np.ndarray:
    if kind.startswith("tet"):
        return np.array([(1, 2, 3), (2, 0, 3), (0, 1, 3), (1, 0, 2)])
    n = 4 if kind.startswith("hex") else 3
    lower = [((i + 1) % n, (i - 1) % n, i + n) for i in range(n)]
    upper = [(n + (i - 1) % n, n + (i + 1) % n, i) for i in range(n)]
    return np.array(lower + upper)
