"""The named regions that every finger mesh has: ``base`` and ``contact``."""

from __future__ import annotations

import numpy as np

from finqd.errors import MeshError
from finqd.mesh import Mesh

_TOLERANCE = 1e-8  # [m]


def with_finger_sets(mesh: Mesh, contact_line: np.ndarray | None) -> Mesh:
    """Return the mesh with node and face sets ``base`` (the plane y = 0) and ``contact``.

    contact_line: base point and tip point of the contact face in the x-y plane [m], shape (2, 2); the contact faces
    are those that lie on it. None: those whose normal points towards -x, within 60 degrees, outside the base.
    Raises ``MeshError`` if either region is empty.
    """
    base = np.abs(mesh.vertices[:, 1]) <= _TOLERANCE
    base_faces = mesh.faces_within(base)
    if contact_line is None:
        contact_faces = _facing_inwards(mesh, base)
    else:
        contact_faces = mesh.faces_within(_on_line(mesh.vertices, np.asarray(contact_line, dtype=float)))
    if not base_faces:
        raise MeshError("the solid has no face in the plane y = 0 to clamp it by")
    if not contact_faces:
        raise MeshError("no face of the mesh lies on the solid's contact line")
    face_sets = {"base": base_faces, "contact": contact_faces}
    node_sets = {
        name: np.unique(np.concatenate([mesh.faces[kind][indices].ravel() for kind, indices in faces.items()]))
        for name, faces in face_sets.items()
    }
    return mesh.with_sets(node_sets, face_sets)


def _on_line(vertices: np.ndarray, line: np.ndarray) -> np.ndarray:
    start, end = line
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    offset = vertices[:, :2] - start
    distance = np.abs(offset @ np.array([-along[1], along[0]]))
    reach = offset @ along
    return (distance <= _TOLERANCE) & (reach >= -_TOLERANCE) & (reach <= length + _TOLERANCE)


def _facing_inwards(mesh: Mesh, base: np.ndarray) -> dict[str, np.ndarray]:
    found = {}
    for kind, faces in mesh.faces.items():
        corners = mesh.vertices[faces[:, :4 if kind.startswith("quad") else 3]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, -1] - corners[:, 0])
        inwards = -normals[:, 0] >= 0.5 * np.linalg.norm(normals, axis=1)
        indices = np.flatnonzero(inwards & ~base[faces].all(axis=1))
        if len(indices):
            found[kind] = indices
    return found
