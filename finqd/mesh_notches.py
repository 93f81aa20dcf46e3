"""Notches of a mesh: re-entrant edges of its boundary, and quadratic elements that follow the stress there.

At the tip of a sharp notch the displacement goes with the root of the distance r (exactly for a crack, nearly so for
openings up to 90 degrees), which polynomials meet at first order only, whatever their degree. An element whose mid-edge
nodes stand at a quarter of their edges, seen from the tip, has r = L xi^2 along these edges and so holds the term
sqrt(r) exactly, without one more unknown.
Sources: Henshell and Shaw, Int. J. Numer. Methods Eng. 9 (1975) 495; Barsoum, Int. J. Numer. Methods Eng. 10 (1976) 25.
"""

from __future__ import annotations

import numpy as np
import trimesh

from finqd.mesh import Mesh
from finqd.mesh_reference import MID_EDGES

REENTRANT = np.radians(200.0)  # interior angle between two boundary faces from which their edge counts as a notch
QUARTER = 0.25


def notch_vertices(mesh: Mesh, *, angle: float = REENTRANT) -> np.ndarray:
    """Return which vertices lie on boundary edges with an interior angle above ``angle`` [rad], bool (n_vertices,).

    Mid-edge nodes are not among them: the boundary is looked at as flat triangles between corners.
    """
    surface = trimesh.Trimesh(mesh.vertices, mesh.surface_triangles(), process=False)
    notch = ~surface.face_adjacency_convex & (surface.face_adjacency_angles > angle - np.pi)
    found = np.zeros(mesh.n_vertices, dtype=bool)
    found[surface.face_adjacency_edges[notch]] = True
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
