"""The surface of all soft bodies as contact sees it: faces, sample points and flat triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from finqd.mechanics.elements import face_shape
from finqd.scene import SoftBody


@dataclass(frozen=True, kw_only=True)
class ContactSurface:
    """Faces, samples and triangles of all soft bodies, in scene numbering.

    faces: vertex ids, -1 pads, shape (n_faces, k); face_body, face_corners: soft body and number of corners (3 or 4) of
        each face, shape (n_faces,)
    first_sample: samples first_sample[f] to first_sample[f + 1] lie on face f, shape (n_faces + 1,)
    sample_face, sample_weight (n_samples, k), sample_area [m^2]: points that are finer than the mesh; points that
        neighbouring faces share are merged, but not across a sharp edge, where each side needs its own normal
    triangle_face, triangle_weight (n_triangles, 3, k): faces cut into flat triangles, corners as weights on the face
    """

    faces: np.ndarray
    face_body: np.ndarray
    face_corners: np.ndarray
    first_sample: np.ndarray
    sample_face: np.ndarray
    sample_weight: np.ndarray
    sample_area: np.ndarray
    triangle_face: np.ndarray
    triangle_weight: np.ndarray

    @property
    def sample_body(self) -> np.ndarray:
        """Soft body of each sample, shape (n_samples,)."""
        return self.face_body[self.sample_face]

    @property
    def triangle_body(self) -> np.ndarray:
        """Soft body of each triangle, shape (n_triangles,)."""
        return self.face_body[self.triangle_face]


#: corners of the flat triangles of a face in its local coordinates; a quadrilateral gets its middle as a fourth
#: corner pair, so that the split has the face's own symmetry
_TRIANGLES = {
    "tri3": [[(0, 0), (1, 0), (0, 1)]],
    "tri6": [
        [(0, 0), (0.5, 0), (0, 0.5)], [(0.5, 0), (1, 0), (0.5, 0.5)],
        [(0, 0.5), (0.5, 0.5), (0, 1)], [(0.5, 0), (0.5, 0.5), (0, 0.5)],
    ],
    "quad4": [
        [(-1, -1), (1, -1), (0, 0)], [(1, -1), (1, 1), (0, 0)], [(1, 1), (-1, 1), (0, 0)], [(-1, 1), (-1, -1), (0, 0)],
    ],
}
_TRIANGLES["quad8"] = [
    [edge, corner, (0, 0)]
    for ring in ([(-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0)],)
    for edge, corner in zip(ring, ring[1:] + ring[:1], strict=True)
]


def lattice(face_type: str, n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return local points (p, 2) of a lattice with n by m cells (n by n for a triangle) and their shares of the area.

    The lattice includes the face's edges, since a face's rim is what touches first; the shares are the trapezoidal
    rule's and sum to 1.
    """
    if face_type.startswith("quad"):
        u, v = np.linspace(-1, 1, n + 1), np.linspace(-1, 1, m + 1)
        wu, wv = np.full(n + 1, 1.0 / n), np.full(m + 1, 1.0 / m)
        wu[[0, -1]] *= 0.5
        wv[[0, -1]] *= 0.5
        points = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
        return points, np.outer(wu, wv).ravel()
    index = {(i, j): None for i in range(n + 1) for j in range(n + 1 - i)}
    order = {key: p for p, key in enumerate(index)}
    share = np.zeros(len(order))
    for i, j in order:
        for cell in ([(i, j), (i + 1, j), (i, j + 1)], [(i + 1, j), (i + 1, j + 1), (i, j + 1)]):
            if all(corner in order for corner in cell):
                for corner in cell:
                    share[order[corner]] += 1.0 / (3 * n * n)
    return np.array(list(order), dtype=float) / n, share


def contact_shape(face_type: str, xi: np.ndarray) -> np.ndarray:
    """Return the weights of a face's nodes at local points ``xi`` (m, 2), as contact sees the face, shape (m, k).

    They are never negative: a quadratic face counts as its linear pieces between neighbouring nodes, with the mean of
    the mid-edge nodes in a quadrilateral's middle. The quadratic functions would pull corners back where a point in
    the middle is pushed in, and an edge would find ripples.
    """
    if face_type == "quad8":
        u, v = xi[:, 0], xi[:, 1]
        (lu, mu, hu), (lv, mv, hv) = ((np.maximum(-x, 0.0), 1.0 - np.abs(x), np.maximum(x, 0.0)) for x in (u, v))
        middle = 0.25 * mu * mv
        return np.stack(
            [lu * lv, hu * lv, hu * hv, lu * hv,
             mu * lv + middle, hu * mv + middle, mu * hv + middle, lu * mv + middle], axis=1,
        )
    if face_type == "tri6":
        share = np.column_stack([1.0 - xi.sum(axis=1), xi])
        corners = np.maximum(2.0 * share - 1.0, 0.0)
        inner = corners.sum(axis=1) == 0.0
        mids = []
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            near = np.where(share[:, i] > 0.5, 2.0 * share[:, j], np.where(share[:, j] > 0.5, 2.0 * share[:, i], 0.0))
            mids.append(np.where(inner, 1.0 - 2.0 * share[:, k], near))
        return np.column_stack([corners, *mids])
    return face_shape(face_type, xi)


def _face_vectors(points: np.ndarray, face_type: str) -> np.ndarray:
    """Return area times unit normal of each face [m^2], shape (n_faces, 3)."""
    corners = points[:, : 4 if face_type.startswith("quad") else 3]
    if corners.shape[1] == 3:
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    else:
        cross = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    return 0.5 * cross


def _cells(points: np.ndarray, face_type: str, spacing: float) -> np.ndarray:
    """Return the lattice cells of each face in its two directions, shape (n_faces, 2)."""
    def edge(a: int, b: int) -> np.ndarray:
        return np.linalg.norm(points[:, a] - points[:, b], axis=1)

    if face_type.startswith("quad"):
        u, v = np.maximum(edge(0, 1), edge(3, 2)), np.maximum(edge(0, 3), edge(1, 2))
    else:
        u = v = np.maximum(np.maximum(edge(0, 1), edge(1, 2)), edge(2, 0))
    return np.maximum(np.ceil(np.stack([u, v], axis=1) / spacing - 1e-6), 1).astype(int)


def _samples(
    points: np.ndarray, face_type: str, first_face: int, spacing: float, width: int
) -> tuple[np.ndarray, ...]:
    """Return (face, weight, area, position, normal) of all samples of one block of faces."""
    cells, vectors = _cells(points, face_type, spacing), _face_vectors(points, face_type)
    areas = np.linalg.norm(vectors, axis=1)
    normals = vectors / areas[:, None]
    found: list[tuple[np.ndarray, ...]] = []
    for n, m in np.unique(cells, axis=0):
        local, share = lattice(face_type, int(n), int(m))
        shape = contact_shape(face_type, local)
        which = np.flatnonzero((cells == (n, m)).all(axis=1))
        weight = np.zeros((len(which) * len(local), width))
        weight[:, : shape.shape[1]] = np.tile(shape, (len(which), 1))
        found.append(
            (
                np.repeat(which + first_face, len(local)), weight, np.outer(areas[which], share).ravel(),
                np.einsum("pk,fkx->fpx", shape, points[which]).reshape(-1, 3),
                np.repeat(normals[which], len(local), axis=0),
            )
        )
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))


def _merged(parts: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Merge samples of one body that coincide at rest (to 1 nm) on faces of like direction, adding their areas."""
    face, weight, area, position, normal = parts
    key = np.concatenate([np.round(position, 9), np.round(2.0 * normal)], axis=1)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return face[first], weight[first], np.bincount(inverse.ravel(), area)


def contact_surface(bodies: Sequence[SoftBody], *, spacing: float) -> ContactSurface:
    """Return the surface of ``bodies`` with samples at most ``spacing`` [m] apart; faces that are held are left out."""
    kinds = [(body, kind) for body in bodies for kind, faces in sorted(body.mesh.faces.items()) if len(faces)]
    width = max((body.mesh.faces[kind].shape[1] for body, kind in kinds), default=4)
    faces, face_body, face_corners, samples, triangles = [], [], [], [], []
    first_face = 0
    for number, body in enumerate(bodies):
        parts = []
        for kind in sorted(body.mesh.faces):
            block = body.mesh.faces[kind]
            block = block[~body.fixed.all(axis=1)[block].all(axis=1)] if len(block) else block
            if not len(block):
                continue
            padded = np.full((len(block), width), -1, dtype=np.int64)
            padded[:, : block.shape[1]] = block + body.first_vertex
            faces.append(padded)
            face_body.append(np.full(len(block), number))
            face_corners.append(np.full(len(block), 4 if kind.startswith("quad") else 3))
            parts.append(_samples(body.mesh.vertices[block], kind, first_face, spacing, width))
            local = np.array(_TRIANGLES[kind], dtype=float).reshape(-1, 2)
            corners = contact_shape(kind, local).reshape(-1, 3, block.shape[1])
            weight = np.zeros((len(block) * len(corners), 3, width))
            weight[:, :, : block.shape[1]] = np.tile(corners, (len(block), 1, 1))
            triangles.append((np.repeat(np.arange(len(block)) + first_face, len(corners)), weight))
            first_face += len(block)
        if parts:
            samples.append(_merged(tuple(np.concatenate(p) for p in zip(*parts, strict=True))))
    if not faces:
        empty = np.zeros(0, dtype=np.int64)
        return ContactSurface(
            faces=np.zeros((0, width), dtype=np.int64), face_body=empty, face_corners=empty,
            first_sample=np.zeros(1, dtype=np.int64), sample_face=empty,
            sample_weight=np.zeros((0, width)), sample_area=np.zeros(0), triangle_face=empty,
            triangle_weight=np.zeros((0, 3, width)),
        )
    sample_face, sample_weight, sample_area = (np.concatenate(p) for p in zip(*samples, strict=True))
    order = np.argsort(sample_face, kind="stable")
    sample_face, sample_weight, sample_area = sample_face[order], sample_weight[order], sample_area[order]
    triangle_face, triangle_weight = (np.concatenate(p) for p in zip(*triangles, strict=True))
    return ContactSurface(
        faces=np.concatenate(faces), face_body=np.concatenate(face_body), face_corners=np.concatenate(face_corners),
        first_sample=np.searchsorted(sample_face, np.arange(first_face + 1)), sample_face=sample_face,
        sample_weight=sample_weight, sample_area=sample_area, triangle_face=triangle_face,
        triangle_weight=triangle_weight,
    )
