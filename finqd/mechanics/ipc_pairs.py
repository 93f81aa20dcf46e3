"""The barrier between primitives of one surface, by the IPC Toolkit (whose distances are squared ones)."""

from __future__ import annotations

from typing import Any

import numpy as np

from finqd.mechanics.ipc_friction import ContactRows
from finqd.mechanics.ipc_motion import Motion
from finqd.mechanics.ipc_surface import IpcSurface, toolkit

TOUCHING = 1e-9  # [m] distance at which bodies count as touching: there is no energy to start from


class PairBarrier:
    """Pairs of primitives nearer than a gap, each with the area that it stands for.

    What the toolkit gives for one pair is not to be kept: it lives no longer than the set that it belongs to.
    """

    def __init__(
        self, surface: IpcSurface, motion: Motion, *, gap: float, pressure: float, supports: np.ndarray
    ) -> None:
        """gap [m]; pressure: kappa [Pa]; supports: by body, an area that holds its weight [m^2], 0 for soft ones."""
        self.surface, self.motion, self.gap, self.supports = surface, motion, gap, supports
        self.potential = toolkit().BarrierPotential(gap, pressure, True)
        self.edges, self.faces = surface.mesh.edges, surface.mesh.faces
        self.body = surface.body[: surface.n_vertices]
        self.hard = surface.points.rigid[: surface.n_vertices] >= 0
        self.several = len(np.unique(self.body[self.hard])) > 1

    def at(self, vertices: np.ndarray) -> Any:
        """Return the pairs nearer than the gap at ``vertices`` (n_vertices, 3) [m], a `NormalCollisions`."""
        pairs = toolkit().NormalCollisions()
        pairs.use_area_weighting = True
        pairs.build(self.motion.near(vertices), self.surface.mesh, vertices, self.gap)
        if self.several:
            self._reinforce(pairs)
        return pairs

    def _reinforce(self, pairs: Any) -> None:
        """Let one pair of two rigid bodies hold the heavier one at half the gap: stiffness follows weight."""
        for i in range(len(pairs)):
            ids = self._ids(pairs[i])
            if self.hard[ids].all():
                pairs[i].weight = max(pairs[i].weight, float(self.supports[self.body[ids]].max()))

    def energy(self, pairs: Any, vertices: np.ndarray) -> float:
        """Return the energy of the barrier [J]."""
        return float(self.potential(pairs, self.surface.mesh, vertices)) if len(pairs) else 0.0

    def gradient(self, pairs: Any, vertices: np.ndarray) -> np.ndarray:
        """Return the derivatives of the energy [N], shape (n_vertices, 3)."""
        if not len(pairs):
            return np.zeros((len(vertices), 3))
        return self.potential.gradient(pairs, self.surface.mesh, vertices).reshape(-1, 3)

    def hessian(self, pairs: Any, vertices: np.ndarray, *, projected: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs of vertices (k, 2), both ways, and their second derivatives (k, 3, 3) [N/m]."""
        if not len(pairs):
            return np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3, 3))
        methods = toolkit().PSDProjectionMethod
        method = methods.CLAMP if projected else methods.NONE
        matrix = self.potential.hessian(pairs, self.surface.mesh, vertices, method).tobsr((3, 3))
        rows = np.repeat(np.arange(len(vertices)), np.diff(matrix.indptr))
        return np.stack([rows, matrix.indices], axis=1).astype(np.int64), matrix.data

    def least(self, pairs: Any, vertices: np.ndarray) -> float:
        """Return the smallest distance of two primitives [m], at most the gap."""
        if not len(pairs):
            return self.gap
        return min(self.gap, float(np.sqrt(pairs.compute_minimum_distance(self.surface.mesh, vertices))))

    def rows(self, pairs: Any, vertices: np.ndarray) -> ContactRows:
        """Return the contacts with their normal forces, the mollified ones of nearly parallel edges included."""
        n = len(pairs)
        points, weights, push = np.zeros((n, 4), dtype=np.int64), np.zeros((n, 4)), np.zeros((n, 3))
        for i in range(n):
            ids = self._ids(pairs[i])
            places = vertices[ids].ravel()
            own = np.asarray(pairs[i].compute_coefficients(places))
            points[i, : len(ids)], weights[i, : len(ids)] = ids, own
            push[i] = (own <= 0.0) @ np.asarray(self.potential.gradient(pairs[i], places)).reshape(-1, 3)
        normal = np.einsum("mk,mkx->mx", weights, vertices[points])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        each = np.arange(n)
        sides = points[each, np.argmax(weights, axis=1)], points[each, np.argmin(weights, axis=1)]
        return ContactRows(
            points=points, weights=weights, normal=normal, bodies=np.stack([self.body[side] for side in sides], axis=1),
            force=np.maximum(np.einsum("mx,mx->m", push, normal), 0.0),
        )

    def crossing(self, vertices: np.ndarray) -> tuple[int, int] | None:
        """Return the numbers of two bodies whose surfaces intersect or touch at ``vertices``; None: there are none."""
        ipctk, mesh = toolkit(), self.surface.mesh
        if ipctk.has_intersections(mesh, vertices, ipctk.LBVH()):
            broad = ipctk.LBVH()
            broad.can_vertices_collide = mesh.can_collide
            broad.build(vertices, self.edges, self.faces, 0.0)
            for found in broad.detect_edge_face_candidates():
                edge, face = self.edges[found.edge_id], self.faces[found.face_id]
                if ipctk.is_edge_intersecting_triangle(*vertices[edge], *vertices[face]):
                    return int(self.body[edge[0]]), int(self.body[face[0]])
        near = ipctk.NormalCollisions()
        near.build(mesh, vertices, TOUCHING, 0.0, ipctk.LBVH())
        if len(near):
            ids = self._ids(near[0])
            return int(self.body[ids[0]]), int(self.body[ids[-1]])
        return None

    def near_vertices(self, vertices: np.ndarray, reach: float) -> np.ndarray:
        """Return the pairs of vertices (k, 2) of all primitives nearer than ``reach`` [m] to each other."""
        ipctk = toolkit()
        near = ipctk.NormalCollisions()
        near.build(self.surface.mesh, vertices, reach, 0.0, ipctk.LBVH())
        found = [np.zeros((0, 2), dtype=np.int64)]
        for i in range(len(near)):
            ids = self._ids(near[i])
            found.append(np.stack(np.meshgrid(ids, ids, indexing="ij"), axis=-1).reshape(-1, 2))
        return np.concatenate(found)

    def _ids(self, pair: Any) -> np.ndarray:
        return np.array([i for i in pair.vertex_ids(self.edges, self.faces) if i >= 0])
