"""A closed surface into gmsh, and tetrahedra out of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from finqd.errors import MeshError
from finqd.mesh import Mesh
from finqd.mesh_reference import MID_EDGES

_SHARP = np.radians(30.0)  # a surface is cut into faces along edges sharper than that


def enclose(gmsh: Any, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Make a volume of the closed surface ``vertices`` (n, 3) [m], ``triangles`` (m, 3); faces may be remeshed."""
    model = gmsh.model
    surface = model.addDiscreteEntity(2)
    model.mesh.addNodes(2, surface, np.arange(1, len(vertices) + 1), np.asarray(vertices, dtype=float).ravel())
    model.mesh.addElementsByType(surface, 2, [], np.asarray(triangles).ravel() + 1)
    model.mesh.classifySurfaces(_SHARP, True, True, np.pi)
    model.mesh.createGeometry()
    model.geo.addVolume([model.geo.addSurfaceLoop([tag for _, tag in model.getEntities(2)])])
    model.geo.synchronize()


def collect(gmsh: Any, order: int) -> Mesh:
    """Return the tetrahedra of a gmsh model, of ``order`` 1 or 2 with straight edges. Raises MeshError without any."""
    kind, code, count = ("tet4", 4, 4) if order == 1 else ("tet10", 11, 10)
    _, connectivity = gmsh.model.mesh.getElementsByType(code)
    if len(connectivity) == 0:
        raise MeshError("gmsh made no tetrahedra")
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    used, elements = np.unique(connectivity, return_inverse=True)
    order_of_tags = np.argsort(tags)
    places = order_of_tags[np.searchsorted(tags, used, sorter=order_of_tags)]
    vertices = coordinates.reshape(-1, 3)[places]
    elements = elements.reshape(-1, count)
    if order == 2:
        elements = elements[:, [*range(8), 9, 8]]  # gmsh numbers the last two edges the other way round
        for i, (a, b) in enumerate(MID_EDGES[kind]):  # straight edges, to the last digit
            vertices[elements[:, 4 + i]] = 0.5 * (vertices[elements[:, a]] + vertices[elements[:, b]])
    return Mesh(vertices, {kind: elements})
