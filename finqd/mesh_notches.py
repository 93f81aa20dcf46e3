"""Notches of a mesh: re-entrant edges of its boundary, and quadratic elements that follow the stress there.

At the tip of a sharp notch the displacement goes with the root of the distance r (exactly for a crack, nearly so for
openings up to 90 degrees), which polynomials meet at first order only, whatever their degree. An element whose mid-edge
nodes stand at a quarter of their edges, seen from the tip, has r = L xi^2 along these edges and so holds the term
sqrt(r) exactly, without one more unknown.
Sources: Henshell and Shaw, Int. J. Numer. Methods Eng. 9 (1975) 495; Barsoum, Int. J. Numer. Methods Eng. 10 (1976) 25.
"""

from __future__ import annotations

import numpy as np

from finqd.mesh import Mesh
from finqd.mesh_reference import MID_EDGES

REENTRANT = np.radians(200.0)  # interior angle between two boundary faces from which their edge counts as a notch
QUARTER = 0.25
SOUND = 0.02  # smallest over largest Jacobian of an element, below which its nodes stay in the middle; usual are 0.05


def notch_vertices(mesh: Mesh, *, angle: float = REENTRANT) -> np.ndarray:
    """Return which vertices lie on boundary edges with an interior angle above ``angle`` [rad], bool (n_vertices,).

    Mid-edge nodes are not among them: the boundary is looked at as flat triangles between corners.
    """
    triangles = mesh.surface_triangles()
    corners = mesh.vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    edges, one, other = _shared_edges(triangles)
    bend = np.arccos(np.clip(np.einsum("ij,ij->i", normals[one // 3], normals[other // 3]), -1.0, 1.0))
    beyond = mesh.vertices[triangles.ravel()[other]] - mesh.vertices[edges[:, 0]]  # to the other triangle's corner
    inwards = np.einsum("ij,ij->i", normals[one // 3], beyond) > 0.0
    found = np.zeros(mesh.n_vertices, dtype=bool)
    found[edges[inwards & (bend > angle - np.pi)]] = True
    return found


def _shared_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the edges (n, 2) that two triangles share, and the corner opposite to each in both, by 3 triangle + k.

    An edge at which more than two meet, where a body touches itself, is not among them.
    """
    sides = np.sort(triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
    edges, which, counts = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(which.ravel(), kind="stable")
    first = (np.cumsum(counts) - counts)[counts == 2]
    return edges[counts == 2], order[first], order[first + 1]


def with_quarter_nodes(mesh: Mesh) -> Mesh:
    """Return a mesh of straight quadratic elements with the mid-edge nodes next to a notch at a quarter of their edge.

    An edge that ends in notches at both sides keeps its node in the middle, as one between two vertices of the same
    notch must, and so do all edges of an element that would be turned inside out, or nearly (a skew one, or one with
    notches at two of its sides). Volume and boundary stay as they are. Sets are not carried over.
    """
    notch = notch_vertices(mesh)
    vertices = mesh.vertices.copy()
    for kind, nodes in mesh.blocks.items():
        sides = np.array(MID_EDGES[kind])
        ends, middle = nodes[:, sides], middle_nodes(mesh, kind)
        for tip, far in ((ends[..., 0], ends[..., 1]), (ends[..., 1], ends[..., 0])):
            moved = notch[tip] & ~notch[far]
            start, end = mesh.vertices[tip[moved]], mesh.vertices[far[moved]]
            vertices[middle[moved]] = start + QUARTER * (end - start)
    while True:  # ends at the latest where all nodes are back in the middle
        spoiled = [middle_nodes(mesh, kind)[jacobian_ratios(kind, vertices[nodes]) < SOUND]
                   for kind, nodes in mesh.blocks.items()]
        back = np.unique(np.concatenate([ids.ravel() for ids in spoiled]))
        if np.array_equal(vertices[back], mesh.vertices[back]):
            return Mesh(vertices, mesh.blocks)
        vertices[back] = mesh.vertices[back]


def middle_nodes(mesh: Mesh, kind: str) -> np.ndarray:
    """Return the mid-edge nodes of the quadratic elements of a block, (n, edges)."""
    return mesh.blocks[kind][:, -len(MID_EDGES[kind]) :]


def jacobian_ratios(kind: str, points: np.ndarray) -> np.ndarray:
    """Return the smallest over the largest Jacobian of each element (n,), at the points of both its quadratures.

    ``points``: its nodes (n, k, 3) [m]; those of the stiffness, and those that are exact
    """
    from finqd.mechanics.element_stiffness import exact_rule
    from finqd.mechanics.elements import element

    shape = element(kind)
    both = np.concatenate([shape.points, exact_rule(shape)[0]])
    found = np.linalg.det(np.einsum("nai,qaj->nqij", points, shape.shape_gradients(both)))
    return found.min(axis=1) / found.max(axis=1)
