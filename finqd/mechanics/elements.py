"""Reference elements and faces: node order (VTK), shape functions, quadrature.

Every element is one row of a table: reference nodes and the monomials that span its shape functions; the coefficients
follow from nodality, N_a(xi_b) = delta_ab. Reference domains: hexahedra and quadrilaterals [-1, 1]^d, triangles and
tetrahedra the unit simplex, wedges unit triangle x [-1, 1] (nodes 0 1 2 at t = -1, counter-clockwise seen from 3 4 5).

>>> ELEMENTS["tet4"].shape(np.array([[0.25, 0.25, 0.25]]))
array([[0.25, 0.25, 0.25, 0.25]])
>>> face_shape("quad4", np.zeros((1, 2)))
array([[0.25, 0.25, 0.25, 0.25]])
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from itertools import product

import numpy as np

from finqd.errors import InputError

Rule = tuple[np.ndarray, np.ndarray]  # points (q, d), weights (q,)


@dataclass(frozen=True, eq=False)
class Element:
    """A reference element or face: ``nodes`` (k, d), monomial ``exponents`` (k, d), quadrature ``points``, ``weights``.

    The quadrature is the one for stiffness, by ``rule``, which is called when it is first asked for; `element_rule`
    gives exact ones of any degree. ``faces``: (face type, local nodes, counter-clockwise seen from outside) of each
    face. ``corners``: how many nodes are corners.
    """

    name: str
    nodes: np.ndarray
    exponents: np.ndarray
    rule: Callable[[], Rule]
    corners: int
    faces: tuple[tuple[str, tuple[int, ...]], ...] = ()
    coefficients: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", np.linalg.inv(_monomials(self.nodes, self.exponents)))

    @cached_property
    def _quadrature(self) -> Rule:
        return self.rule()

    @property
    def points(self) -> np.ndarray:
        return self._quadrature[0]

    @property
    def weights(self) -> np.ndarray:
        return self._quadrature[1]

    @property
    def n_nodes(self) -> int:
        return len(self.nodes)

    @property
    def quadratic(self) -> bool:
        return self.n_nodes > self.corners

    def shape(self, xi: np.ndarray) -> np.ndarray:
        """Return N_a at local points ``xi`` (m, d), shape (m, k)."""
        return _monomials(xi, self.exponents) @ self.coefficients

    def shape_gradients(self, xi: np.ndarray) -> np.ndarray:
        """Return dN_a/dxi_i at local points ``xi`` (m, d), shape (m, k, d)."""
        columns = []
        for axis in range(self.exponents.shape[1]):
            lowered = self.exponents.copy()
            lowered[:, axis] = np.maximum(lowered[:, axis] - 1, 0)
            columns.append((self.exponents[:, axis] * _monomials(xi, lowered)) @ self.coefficients)
        return np.stack(columns, axis=-1)


def _monomials(xi: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """Return prod_i xi_i^e_i, shape (m, k)."""
    return np.prod(np.asarray(xi, dtype=float)[:, None, :] ** exponents[None], axis=2)


def box_rule(n: int, dimension: int) -> Rule:
    """Return the n^d point Gauss rule of [-1, 1]^d, exact to degree 2n - 1 in each variable."""
    x, w = np.polynomial.legendre.leggauss(n)
    points = np.array(list(product(x, repeat=dimension)))
    return points, np.prod(np.array(list(product(w, repeat=dimension))), axis=1)


def simplex_rule(n: int, dimension: int) -> Rule:
    """Return the n^d point conical product rule of the unit simplex, exact to total degree 2n - 1, positive weights.

    Source: Stroud, Approximate calculation of multiple integrals, 1971 (Gauss-Jacobi in collapsed coordinates).
    """
    from scipy.special import roots_jacobi  # takes longer to import than all the rest here, and bricks need none

    points, weights, rest = np.zeros((1, 0)), np.ones(1), np.ones(1)
    for axis in range(dimension):
        power = dimension - 1 - axis
        x, w = roots_jacobi(n, power, 0)
        x, w = (1 + x) / 2, w / 2 ** (power + 1)
        points = np.column_stack([np.repeat(points, n, axis=0), np.outer(rest, x).ravel()])
        weights, rest = np.outer(weights, w).ravel(), np.outer(rest, 1 - x).ravel()
    return points, weights


def wedge_rule(n: int) -> Rule:
    """Return simplex rule x Gauss rule on the reference wedge, n^3 points."""
    (tri, tri_weights), (line, line_weights) = simplex_rule(n, 2), box_rule(n, 1)
    points = np.column_stack([np.repeat(tri, n, axis=0), np.tile(line, (len(tri), 1))])
    return points, np.outer(tri_weights, line_weights).ravel()


def _symmetric_simplex_rule(dimension: int) -> Rule:
    """Return the d + 1 point rule of degree 2 that treats all corners alike.

    Source: Hammer and Stroud, Math. Tables Aids Comput. 10 (1956) 137; midway points for the triangle are (1/6, 2/3).
    """
    n = dimension + 1
    small = (1 - 1 / np.sqrt(dimension + 2)) / n
    barycentric = np.full((n, n), small) + np.eye(n) * (1 - n * small)
    volume = 1 / 2 if dimension == 2 else 1 / 6
    return barycentric[:, 1:], np.full(n, volume / n)


def _between(nodes: Iterable[Iterable[float]], edges: Iterable[tuple[int, int]]) -> np.ndarray:
    """Return the corner nodes with the midpoints of ``edges`` appended."""
    corners = np.array(list(nodes), dtype=float)
    return np.vstack([corners, [(corners[i] + corners[j]) / 2 for i, j in edges]])


def _powers(dimension: int, highest: int, keep: Callable[[tuple[int, ...]], bool]) -> np.ndarray:
    return np.array([e for e in product(range(highest + 1), repeat=dimension) if keep(e)])


def _superlinear(e: tuple[int, ...]) -> int:
    return sum(p for p in e if p > 1)


_QUAD = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
_HEX = [(x, y, z) for z in (-1, 1) for x, y in _QUAD]
_TRI = [(0, 0), (1, 0), (0, 1)]
_WEDGE = [(x, y, z) for z in (-1, 1) for x, y in _TRI]
_TET = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
_QUAD_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0)]
_HEX_EDGES = _QUAD_EDGES + [(4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
_TRI_EDGES = [(0, 1), (1, 2), (2, 0)]
_TET_EDGES = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
_HEX_FACES = ((0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (3, 7, 6, 2), (0, 3, 2, 1), (4, 5, 6, 7))
_TET_FACES = ((0, 1, 3), (1, 2, 3), (0, 3, 2), (0, 2, 1))


def _with_edge_nodes(
    faces: Sequence[tuple[int, ...]], edges: Sequence[tuple[int, int]], corners: int
) -> tuple[tuple[int, ...], ...]:
    number = {frozenset(edge): corners + i for i, edge in enumerate(edges)}
    return tuple(
        face + tuple(number[frozenset((face[i], face[(i + 1) % len(face)]))] for i in range(len(face)))
        for face in faces
    )


def _faces(face_type: str, faces: Sequence[tuple[int, ...]]) -> tuple[tuple[str, tuple[int, ...]], ...]:
    return tuple((face_type, tuple(f)) for f in faces)


_WEDGE_FACES = _faces("tri3", ((0, 2, 1), (3, 4, 5))) + _faces("quad4", ((0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)))

#: volume elements by name
ELEMENTS: dict[str, Element] = {
    e.name: e
    for e in (
        Element("hex8", np.array(_HEX, float), _powers(3, 1, lambda e: True), partial(box_rule, 2, 3), 8,
                _faces("quad4", _HEX_FACES)),
        Element("hex20", _between(_HEX, _HEX_EDGES), _powers(3, 2, lambda e: _superlinear(e) <= 2),
                partial(box_rule, 2, 3), 8, _faces("quad8", _with_edge_nodes(_HEX_FACES, _HEX_EDGES, 8))),
        Element("wedge6", np.array(_WEDGE, float), _powers(3, 1, lambda e: e[0] + e[1] <= 1), partial(wedge_rule, 2), 6,
                _WEDGE_FACES),
        Element("tet4", np.array(_TET, float), _powers(3, 1, lambda e: sum(e) <= 1), partial(simplex_rule, 1, 3), 4,
                _faces("tri3", _TET_FACES)),
        Element("tet10", _between(_TET, _TET_EDGES), _powers(3, 2, lambda e: sum(e) <= 2),
                partial(_symmetric_simplex_rule, 3), 4, _faces("tri6", _with_edge_nodes(_TET_FACES, _TET_EDGES, 4))),
    )
}

#: boundary faces by name
FACES: dict[str, Element] = {
    e.name: e
    for e in (
        Element("quad4", np.array(_QUAD, float), _powers(2, 1, lambda e: True), partial(box_rule, 2, 2), 4),
        Element("quad8", _between(_QUAD, _QUAD_EDGES), _powers(2, 2, lambda e: _superlinear(e) <= 2),
                partial(box_rule, 3, 2), 4),
        Element("tri3", np.array(_TRI, float), _powers(2, 1, lambda e: sum(e) <= 1),
                partial(_symmetric_simplex_rule, 2), 3),
        Element("tri6", _between(_TRI, _TRI_EDGES), _powers(2, 2, lambda e: sum(e) <= 2),
                partial(simplex_rule, 3, 2), 3),
    )
}


@cache
def element_rule(name: str, n: int) -> Rule:
    """Return a quadrature with ``n`` points a direction for an element or face, exact to degree 2n - 1."""
    if name.startswith("hex"):
        return box_rule(n, 3)
    if name.startswith("quad"):
        return box_rule(n, 2)
    if name.startswith("wedge"):
        return wedge_rule(n)
    return simplex_rule(n, 3 if name.startswith("tet") else 2)


def element(name: str) -> Element:
    """Return the element called ``name``; raises InputError with the known names."""
    if name not in ELEMENTS:
        raise InputError(f"element type {name!r} is not known; known are {', '.join(sorted(ELEMENTS))}")
    return ELEMENTS[name]


def face_shape(face_type: str, xi: np.ndarray) -> np.ndarray:
    """Return the shape functions of a face at local points ``xi`` (m, 2), shape (m, k); raises InputError."""
    return _face(face_type).shape(xi)


def face_shape_gradients(face_type: str, xi: np.ndarray) -> np.ndarray:
    """Return dN_a/dxi_i of a face at local points ``xi`` (m, 2), shape (m, k, 2); raises InputError."""
    return _face(face_type).shape_gradients(xi)


def _face(face_type: str) -> Element:
    if face_type not in FACES:
        raise InputError(f"face type {face_type!r} is not known; known are {', '.join(sorted(FACES))}")
    return FACES[face_type]
