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


def notch_vertices(mesh: Mesh, *, angle: float = REENTRANT) -> np.ndarray:
    """Return which vertices lie on boundary edges with an interior angle above ``angle`` [rad], bool (n_vertices,).

    Mid-edge nodes are not among them: the boundary is looked at as flat triangles between corners.
    """
    triangles = mesh.surface_triangles()
    corners = mesh.vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    owner = np.tile(np.arange(len(triangles)), 3)
    _, which, counts = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    order = np.argsort(which, kind="stable")
    order = order[counts[which[order]] == 2]  # an edge at which four faces meet belongs to no one notch
    one, other = order[::2], order[1::2]
    along = mesh.vertices[edges[one, 1]] - mesh.vertices[edges[one, 0]]
    along /= np.linalg.norm(along, axis=1)[:, None]
    turn = np.cross(normals[owner[one]], normals[owner[other]])
    cosine = np.sum(normals[owner[one]] * normals[owner[other]], axis=1)
    interior = np.pi - np.arctan2(np.sum(turn * along, axis=1), cosine)
    found = np.zeros(mesh.n_vertices, dtype=bool)
    found[edges[one[interior > angle]]] = True
    return found


def with_quarter_nodes(mesh: Mesh) -> Mesh:
    """Return a mesh of straight quadratic elements with the mid-edge nodes next to a notch at a quarter of their edge.

    An edge that ends in notches at both sides keeps its node in the middle, as one between two vertices of the same
    notch must. Volume and boundary stay as they are. Sets are not carried over.
    """
    notch = notch_vertices(mesh)
    vertices = mesh.vertices.copy()
    for kind, nodes in mesh.blocks.items():
        sides = np.array(MID_EDGES[kind])
        ends, middle = nodes[:, sides], nodes[:, -len(sides) :]
        for tip, far in ((ends[..., 0], ends[..., 1]), (ends[..., 1], ends[..., 0])):
            moved = notch[tip] & ~notch[far]
            start, end = mesh.vertices[tip[moved]], mesh.vertices[far[moved]]
            vertices[middle[moved]] = start + QUARTER * (end - start)
    return Mesh(vertices, mesh.blocks)
