"""Mesh: vertices, element blocks, boundary faces, named regions; volume and quality.

Node order is VTK's for tetrahedra and hexahedra. A wedge's first triangle is counter-clockwise seen from the second, so
that every element type has a positive Jacobian (as in gmsh and meshio).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from finqd.mesh_reference import CORNERS, FACES, Reference, reference


@dataclass(frozen=True)
class MeshQuality:
    """Shape of a mesh's elements. The scaled Jacobian is 1 for a cube and a regular tetrahedron, 0 if flat."""

    scaled_jacobian_min: float
    scaled_jacobian_median: float
    inverted: int  # elements whose Jacobian is not positive at a corner or a Gauss point
    elements: Mapping[str, int]  # count by type

    @property
    def wedge_share(self) -> float:
        """Wedges among all elements, 0 to 1."""
        return self.elements.get("wedge6", 0) / max(1, sum(self.elements.values()))


@dataclass(frozen=True, eq=False)
class Mesh:
    """Vertices [m], shape (n_vertices, 3), and blocks of elements by type.

    blocks: element type ("hex8", "wedge6", "tet4", "tet10", "hex20") -> (n_elements, nodes) int
    node_sets: name -> vertex ids (n,), sorted
    face_sets: name -> face type ("quad4", "tri3", "tri6", "quad8") -> indices into ``faces[face type]``
    """

    vertices: np.ndarray
    blocks: Mapping[str, np.ndarray]
    node_sets: Mapping[str, np.ndarray] = field(default_factory=dict)
    face_sets: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)

    @property
    def n_vertices(self) -> int:
        """Number of vertices, mid-edge nodes included."""
        return len(self.vertices)

    @property
    def n_elements(self) -> int:
        """Number of elements of all types."""
        return sum(len(nodes) for nodes in self.blocks.values())

    @cached_property
    def faces(self) -> dict[str, np.ndarray]:
        """Boundary faces by type, (n_faces, nodes), outward: ordered by block, local face, element."""
        found: dict[str, list[np.ndarray]] = {}
        for kind, nodes in self.blocks.items():
            for face_kind, local in FACES[kind]:
                found.setdefault(face_kind, []).append(nodes[:, local])
        boundary = {kind: _lonely(np.concatenate(lists), CORNERS[kind]) for kind, lists in found.items()}
        return {kind: faces for kind, faces in boundary.items() if len(faces)}

    @property
    def volume(self) -> float:
        """Volume [m^3], by Gauss quadrature that is exact for the linear types and for straight quadratic ones."""
        references = {kind: reference(kind) for kind in self.blocks}
        return float(sum(np.sum(self._jacobians(kind, ref) @ ref.weights) for kind, ref in references.items()))

    def _jacobians(self, kind: str, ref: Reference) -> np.ndarray:
        """Return det(dx/dxi) at the Gauss points [m^3], shape (n_elements, n_points)."""
        corners = self.vertices[self.blocks[kind]]
        return np.linalg.det(np.einsum("qai,eaj->eqij", ref.gradients, corners))

    def element_quality(self, kind: str) -> np.ndarray:
        """Return the smallest scaled Jacobian over the corners of each element of a block, shape (n_elements,)."""
        ref = reference(kind)
        points = self.vertices[self.blocks[kind]]
        edges = points[:, ref.corner_edges] - points[:, np.arange(len(ref.corner_edges))][:, :, None]
        lengths = np.linalg.norm(edges, axis=-1).prod(axis=-1)
        return (np.linalg.det(edges) / np.maximum(lengths, np.finfo(float).tiny)).min(axis=1) * ref.scale

    def quality(self) -> MeshQuality:
        """Return the mesh's quality: scaled Jacobians at the corners, signs also at the Gauss points."""
        scaled = {kind: self.element_quality(kind) for kind in self.blocks}
        inverted = sum(
            int(np.sum((scaled[kind] <= 0) | (self._jacobians(kind, reference(kind)).min(axis=1) <= 0)))
            for kind in self.blocks
        )
        joined = np.concatenate(list(scaled.values()))
        counts = {kind: len(nodes) for kind, nodes in self.blocks.items()}
        return MeshQuality(float(joined.min()), float(np.median(joined)), inverted, counts)

    def faces_within(self, mask: np.ndarray) -> dict[str, np.ndarray]:
        """Return the boundary faces all of whose nodes are in ``mask`` (n_vertices,) bool, as a face set."""
        found = {kind: np.flatnonzero(mask[nodes].all(axis=1)) for kind, nodes in self.faces.items()}
        return {kind: indices for kind, indices in found.items() if len(indices)}

    def with_sets(
        self, node_sets: Mapping[str, np.ndarray], face_sets: Mapping[str, Mapping[str, np.ndarray]]
    ) -> Mesh:
        """Return the same mesh with these sets added (they replace sets of the same name)."""
        return self._sharing_faces(self.vertices, {**self.node_sets, **node_sets}, {**self.face_sets, **face_sets})

    def transformed(self, matrix: np.ndarray) -> Mesh:
        """Return the mesh moved by a rigid motion ``matrix`` (4, 4)."""
        moved = self.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        return self._sharing_faces(moved, self.node_sets, self.face_sets)

    def _sharing_faces(self, vertices: np.ndarray, node_sets: Mapping, face_sets: Mapping) -> Mesh:
        copy = Mesh(vertices, self.blocks, node_sets, face_sets)
        if "faces" in self.__dict__:
            copy.__dict__["faces"] = self.faces
        return copy

    def surface_triangles(self) -> np.ndarray:
        """Return the boundary as flat triangles between corner vertices, outward, shape (n, 3)."""
        triangles = [np.zeros((0, 3), dtype=np.int64)]
        for kind, faces in self.faces.items():
            triangles.append(faces[:, :3])
            if kind.startswith("quad"):
                triangles.append(faces[:, [0, 2, 3]])
        return np.concatenate(triangles)

    def to_meshio(self) -> Any:
        """Return a ``meshio.Mesh``, with node sets as point sets."""
        import meshio

        names = {"hex8": "hexahedron", "hex20": "hexahedron20", "wedge6": "wedge", "tet4": "tetra", "tet10": "tetra10"}
        cells = [(names[kind], nodes) for kind, nodes in self.blocks.items()]
        return meshio.Mesh(self.vertices, cells, point_sets={k: np.asarray(v) for k, v in self.node_sets.items()})


def mesh_arrays(mesh: Mesh) -> dict[str, np.ndarray]:
    """Return a mesh, its boundary faces with it, as named arrays from which `mesh_of` makes it again."""
    arrays = {"vertices": mesh.vertices, "face_sets": np.array(list(mesh.face_sets), dtype=str)}
    for name, group in (("blocks", mesh.blocks), ("faces", mesh.faces), ("node_sets", mesh.node_sets)):
        arrays |= {f"{name}/{key}": np.asarray(value) for key, value in group.items()}
    for name, by_kind in mesh.face_sets.items():
        arrays |= {f"face_set/{name}/{kind}": np.asarray(value) for kind, value in by_kind.items()}
    return arrays


def mesh_of(arrays: Mapping[str, np.ndarray]) -> Mesh:
    """Return the mesh that `mesh_arrays` took apart. Raises KeyError if something is missing."""
    def group(prefix: str) -> dict[str, np.ndarray]:
        return {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}

    face_sets = {str(name): group(f"face_set/{name}/") for name in arrays["face_sets"]}
    mesh = Mesh(arrays["vertices"], group("blocks/"), group("node_sets/"), face_sets)
    mesh.__dict__["faces"] = group("faces/")
    return mesh


def _lonely(faces: np.ndarray, corners: int) -> np.ndarray:
    """Return the faces (n, nodes) that no other one shares its corners with, in their order."""
    keys = np.sort(faces[:, :corners], axis=1)
    _, inverse, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    return faces[counts[inverse.ravel()] == 1]
