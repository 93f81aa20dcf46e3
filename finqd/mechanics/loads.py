"""Consistent nodal forces of surface tractions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from finqd.errors import InputError
from finqd.mechanics.elements import Rule, element_rule, face_shape, face_shape_gradients

if TYPE_CHECKING:
    from finqd.mesh import Mesh

Traction = np.ndarray | tuple[float, float, float] | Callable[[np.ndarray, np.ndarray], np.ndarray]
Region = Callable[[np.ndarray], np.ndarray]


def face_tractions(
    mesh: Mesh, face_set: str | Mapping[str, np.ndarray], traction: Traction, *, region: Region | None = None,
    subdivisions: int = 1,
) -> np.ndarray:
    """Return the nodal forces [N], shape (n_vertices, 3), of a traction on faces at rest: f_a = int N_a t dA.

    face_set: name of a face set of the mesh, or face type -> indices into ``mesh.faces[face type]``
    traction: vector [Pa], or function of points (m, 3) [m] and outward unit normals (m, 3) -> (m, 3) [Pa]
    region: function of points (m, 3) -> bool (m,): only that part of the faces is loaded. Its edge may cut through
    faces: each face is integrated in ``subdivisions`` squared cells, which bounds the error.
    Raises InputError for an unknown face set.
    """
    forces = np.zeros((len(mesh.vertices), 3))
    for face_type, indices in _faces_of(mesh, face_set).items():
        nodes = np.asarray(mesh.faces[face_type])[indices]
        points, weights = _subdivided_rule(face_type, subdivisions)
        shape = face_shape(face_type, points)
        tangents = face_shape_gradients(face_type, points)
        for face in nodes:
            corners = mesh.vertices[face]
            across = np.einsum("ak,qai->iqk", corners, tangents)
            area = np.cross(across[0], across[1])
            size = np.linalg.norm(area, axis=1)
            position = shape @ corners
            value = traction(position, area / size[:, None]) if callable(traction) else np.asarray(traction, float)
            weight = size * weights
            if region is not None:
                weight = weight * region(position)
            forces[face] += shape.T @ (np.broadcast_to(value, position.shape) * weight[:, None])
    return forces


def _faces_of(mesh: Mesh, face_set: str | Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
    if not isinstance(face_set, str):
        return face_set
    if face_set not in mesh.face_sets:
        known = ", ".join(sorted(mesh.face_sets)) or "none"
        raise InputError(f"face set {face_set!r} is not in the mesh; known are {known}")
    return mesh.face_sets[face_set]


def _subdivided_rule(face_type: str, subdivisions: int) -> Rule:
    """Return the face's 3 x 3 rule repeated in subdivisions^2 equal cells of the reference face."""
    points, weights = element_rule(face_type, 3)
    n, cells = subdivisions, []
    if face_type.startswith("quad"):
        for i, j in product(range(n), repeat=2):
            cells.append((points + 1) / n + np.array([2 * i, 2 * j]) / n - 1)
    else:
        for i, j in product(range(n), repeat=2):
            if i + j < n:
                cells.append((points + [i, j]) / n)
            if i + j < n - 1:
                cells.append(([i + 1, j + 1] - points) / n)
    return np.concatenate(cells), np.tile(weights / n**2, n**2)
