"""Meshes of simple bodies, for verification scenes and tests.

>>> mesh = box_mesh((0.1, 0.03, 0.03), (10, 3, 3))
>>> mesh.n_vertices, len(mesh.node_sets["xmin"])
(176, 16)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from finqd.mesh import Mesh
from finqd.mesh_reference import MID_EDGES

#: six tetrahedra of a brick that all share its diagonal 0-6: they match from brick to brick (Freudenthal, Kuhn)
_KUHN = np.array([(0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6)])
_WEDGES = np.array([(0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7)])


def box_mesh(
    size: Sequence[float],
    divisions: Sequence[int],
    element: str = "hex8",
    *,
    distort: float = 0.0,
    seed: int = 0,
) -> Mesh:
    """Return a mesh of the box [0, size] [m] with ``divisions`` bricks along each axis.

    element: "hex8", "hex20", "wedge6" (two a brick), "tet4" or "tet10" (six a brick).
    distort: the inner corner nodes move by up to this share of a brick's edges, at random from ``seed``.
    Node and face sets are ``xmin``, ``xmax``, ``ymin``, ``ymax``, ``zmin``, ``zmax``.
    """
    lengths, counts = np.asarray(size, dtype=float), np.asarray(divisions, dtype=int)
    axes = [np.linspace(0.0, length, count + 1) for length, count in zip(lengths, counts, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    if distort:
        moves = np.random.default_rng(seed).uniform(-1.0, 1.0, grid.shape) * distort * lengths / counts
        grid[1:-1, 1:-1, 1:-1] += moves[1:-1, 1:-1, 1:-1]
    vertices, bricks = grid.reshape(-1, 3), _bricks(counts)
    if element in ("tet4", "tet10"):
        mesh = Mesh(vertices, {"tet4": bricks[:, _KUHN].reshape(-1, 4)})
    elif element == "wedge6":
        mesh = Mesh(vertices, {"wedge6": bricks[:, _WEDGES].reshape(-1, 6)})
    elif element in ("hex8", "hex20"):
        mesh = Mesh(vertices, {"hex8": bricks})
    else:
        raise ValueError(f"unknown element type {element!r}: hex8, hex20, wedge6, tet4 or tet10")
    if element in MID_EDGES:
        mesh = quadratic(mesh)
    return _with_plane_sets(mesh, lengths)


def quadratic(mesh: Mesh) -> Mesh:
    """Return the mesh with mid-edge nodes: tet4 becomes tet10, hex8 becomes hex20; sets are not carried over."""
    vertices, blocks = mesh.vertices, {}
    for kind, nodes in mesh.blocks.items():
        target = {"tet4": "tet10", "hex8": "hex20"}[kind]
        pairs = np.sort(nodes[:, np.array(MID_EDGES[target])], axis=-1)
        edges, inverse = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
        blocks[target] = np.hstack([nodes, len(vertices) + inverse.reshape(len(nodes), -1)])
        vertices = np.concatenate([vertices, 0.5 * (vertices[edges[:, 0]] + vertices[edges[:, 1]])])
    return Mesh(vertices, blocks)


def _bricks(counts: np.ndarray) -> np.ndarray:
    """Return the hexahedra (n, 8) of a grid of ``counts`` bricks, vertices numbered with z fastest."""
    ids = np.arange(np.prod(counts + 1)).reshape(counts + 1)
    corner = [(0, 0), (1, 0), (1, 1), (0, 1)]
    nx, ny, nz = counts
    return np.stack(
        [ids[i : i + nx, j : j + ny, k : k + nz].ravel() for k in (0, 1) for i, j in corner],
        axis=1,
    )


def _with_plane_sets(mesh: Mesh, size: np.ndarray) -> Mesh:
    node_sets, face_sets = {}, {}
    for axis, name in enumerate("xyz"):
        for end, value in (("min", 0.0), ("max", size[axis])):
            mask = np.abs(mesh.vertices[:, axis] - value) <= 1e-9 * size.max()
            node_sets[name + end] = np.flatnonzero(mask)
            face_sets[name + end] = mesh.faces_within(mask)
    return mesh.with_sets(node_sets, face_sets)
