"""The surface of all soft bodies as contact sees it: faces and sample points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from finqd.mechanics.elements import face_shape
from finqd.scene import SoftBody


@dataclass(frozen=True, kw_only=True)
class ContactSurface:
    """Faces and sample points of all soft bodies, in scene numbering.

    faces: vertex ids, -1 pads, shape (n_faces, k); face_body: soft body of each face, face_area: at rest [m^2], both of
        shape (n_faces,)
    face_lattice: which lattice of samples a face has, shape (n_faces,); lattice l has the rows lattice_first[l] to
        lattice_first[l + 1] of lattice_weight (n, k), a sample's weights of the face's vertices, and of lattice_share
        (n,), the part of the face's area that it stands for: exact where the face's own coordinates stretch evenly, not
        beside quarter nodes
    first_sample: numbers of the samples of face f, first_sample[f] to first_sample[f + 1], shape (n_faces + 1,)
    """

    faces: np.ndarray
    face_body: np.ndarray
    face_area: np.ndarray
    face_lattice: np.ndarray
    lattice_first: np.ndarray
    lattice_weight: np.ndarray
    lattice_share: np.ndarray
    first_sample: np.ndarray

    @property
    def n_samples(self) -> int:
        """Number of samples of all faces."""
        return int(self.first_sample[-1])

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """What kernels take, in their order."""
        return (
            self.faces, self.face_area, self.face_lattice, self.lattice_first, self.lattice_weight, self.lattice_share,
            self.first_sample,
        )

    @property
    def lattices(self) -> tuple[np.ndarray, ...]:
        """What kernels take that need no more than where samples are."""
        return self.faces, self.face_lattice, self.lattice_first, self.lattice_weight


class Sight:
    """How far the samples of a surface are from a rigid body at least, so that few have to be looked at again.

    It saves time and changes no result. Arrays as `finqd.mechanics.contact_kernels.find_soft_rigid` takes them.
    """

    def __init__(self, surface: ContactSurface, n_vertices: int) -> None:
        self.local = np.zeros((n_vertices, 3))
        self.travel, self.face_clear = np.zeros(len(surface.faces)), np.full(len(surface.faces), -1.0)
        self.clear = np.full(surface.n_samples, -1.0)

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """What kernels take, in their order."""
        return self.local, self.travel, self.face_clear, self.clear


def lattice(face_type: str, n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return local points (p, 2) in the middles of n by m equal cells (n by n for a triangle), and their equal shares.

    None lies on the face's rim: where a body stands on a face, the faces beside that one would push along.
    """
    if face_type.startswith("quad"):
        u, v = ((2.0 * np.arange(cells) + 1.0) / cells - 1.0 for cells in (n, m))
        return np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2), np.full(n * m, 1.0 / (n * m))
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(n) for j in range(n - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(n - 1) for j in range(n - 1 - i)]
    return np.array(upright + turned) / n, np.full(n * n, 1.0 / (n * n))


def closed_lattice(face_type: str, n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of n by m equal cells (n by n for a triangle) as local points (p, 2), and their shares (p,).

    Those on the rim share an edge with the faces beside, so that they stand for half as much, or less.
    """
    if face_type.startswith("quad"):
        u, v = (np.linspace(-1.0, 1.0, cells + 1) for cells in (n, m))
        along = [np.where(np.abs(w) == 1.0, 0.5, 1.0) / cells for w, cells in ((u, n), (v, m))]
        points = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
        return points, np.outer(*along).ravel()
    place = {(i, j): k for k, (i, j) in enumerate((i, j) for i in range(n + 1) for j in range(n + 1 - i))}
    share = np.zeros(len(place))
    for i, j in place:
        upright, turned = [(i, j), (i + 1, j), (i, j + 1)], [(i + 1, j + 1), (i + 1, j), (i, j + 1)]
        for cell in (upright, turned):
            if all(corner in place for corner in cell):
                share[[place[corner] for corner in cell]] += 1.0 / (3.0 * n * n)
    return np.array(list(place)) / n, share


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


def _areas(points: np.ndarray, face_type: str) -> np.ndarray:
    """Return the area of each face, from its corners [m^2], shape (n_faces,)."""
    corners = points[:, : 4 if face_type.startswith("quad") else 3]
    if corners.shape[1] == 3:
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    else:
        cross = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    return 0.5 * np.linalg.norm(cross, axis=1)


def _cells(points: np.ndarray, face_type: str, spacing: float) -> np.ndarray:
    """Return the lattice cells of each face in its two directions, shape (n_faces, 2)."""
    def edge(a: int, b: int) -> np.ndarray:
        return np.linalg.norm(points[:, a] - points[:, b], axis=1)

    if face_type.startswith("quad"):
        u, v = np.maximum(edge(0, 1), edge(3, 2)), np.maximum(edge(0, 3), edge(1, 2))
    else:
        u = v = np.maximum(np.maximum(edge(0, 1), edge(1, 2)), edge(2, 0))
    return np.maximum(np.ceil(np.stack([u, v], axis=1) / spacing - 1e-6), 1).astype(int)


def contact_surface(
    bodies: Sequence[SoftBody], *, spacing: float, most_cells: int | None = None, rims: bool = False
) -> ContactSurface:
    """Return the surface of ``bodies`` with samples about ``spacing`` [m] apart, at most on faces that stretch evenly.

    Faces that are held are left out. ``most_cells``: cells along an edge of a face are no more than that; ``rims``:
    samples are the corners of cells, on edges and corners of the bodies too, instead of their middles.
    """
    width = max((f.shape[1] for body in bodies for f in body.mesh.faces.values() if len(f)), default=4)
    lattices: dict[tuple[str, int, int], int] = {}
    weights, shares = [np.zeros((0, width))], [np.zeros(0)]
    faces, owner, area, which = [np.zeros((0, width), dtype=np.int64)], [], [], []
    for number, body in enumerate(bodies):
        for kind in sorted(body.mesh.faces):
            block = body.mesh.faces[kind]
            block = block[~body.fixed.all(axis=1)[block].all(axis=1)] if len(block) else block
            if not len(block):
                continue
            corners = body.mesh.vertices[block]
            faces.append(_padded(block + body.first_vertex, width, -1))
            owner.append(np.full(len(block), number))
            area.append(_areas(corners, kind))
            for n, m in np.minimum(_cells(corners, kind, spacing), most_cells or np.iinfo(int).max):
                if (kind, n, m) not in lattices:
                    lattices[kind, n, m] = len(lattices)
                    points, share = (closed_lattice if rims else lattice)(kind, int(n), int(m))
                    weights.append(_padded(contact_shape(kind, points), width, 0.0))
                    shares.append(share)
                which.append(lattices[kind, n, m])
    first = np.cumsum([len(rows) for rows in weights])
    face_lattice = np.array(which, dtype=np.int64)
    return ContactSurface(
        faces=np.concatenate(faces), face_body=np.concatenate([np.zeros(0, dtype=np.int64), *owner]),
        face_area=np.concatenate([np.zeros(0), *area]), face_lattice=face_lattice, lattice_first=first,
        lattice_weight=np.concatenate(weights), lattice_share=np.concatenate(shares),
        first_sample=np.concatenate([[0], np.cumsum(np.diff(first)[face_lattice])]).astype(np.int64),
    )


def _padded(rows: np.ndarray, width: int, filler: float) -> np.ndarray:
    """Return ``rows`` with columns of ``filler`` up to ``width``."""
    return np.pad(rows, ((0, 0), (0, width - rows.shape[1])), constant_values=filler)
