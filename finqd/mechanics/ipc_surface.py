"""The surface of a scene as the IPC Toolkit sees it: triangles of soft and rigid bodies, and which of them may meet."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from finqd.errors import MissingLibraryError
from finqd.mechanics.ipc_points import Points

if TYPE_CHECKING:
    from finqd.scene import Scene, SoftBody

#: a face as triangles between its nodes: a quadratic one counts as pieces between neighbouring nodes
TRIANGLES = {
    "tri3": ((0, 1, 2),),
    "quad4": ((0, 1, 2), (0, 2, 3)),
    "tri6": ((0, 3, 5), (1, 4, 3), (2, 5, 4), (3, 4, 5)),
    "quad8": ((0, 4, 7), (1, 5, 4), (2, 6, 5), (3, 7, 6), (4, 5, 6), (4, 6, 7)),
}


def toolkit() -> Any:
    """Return the module `ipctk`, set to one thread: sums must not depend on who is faster."""
    try:
        import ipctk
    except ImportError as error:
        raise MissingLibraryError("the contact model ipc needs the IPC Toolkit: pip install ipctk") from error
    ipctk.set_num_threads(1)
    return ipctk


class IpcSurface:
    """Vertices, edges and triangles of all bodies of a scene.

    Bodies are numbered soft ones first, then rigid ones, then planes (which have no vertices).

    points: the vertices, and after them the centres of those rigid bodies that are balls
    n_vertices: how many are vertices; triangles (n_triangles, 3), edges (n_edges, 2): of these
    body: of each point, held: whether nothing can move it, both of shape (n_points,)
    areas: a third of the triangles around each vertex, at rest [m^2], 0 for centres, shape (n_points,)
    edge_lengths: mean of each body's edges [m]
    mesh: all that, as an `ipctk.CollisionMesh`
    """

    def __init__(self, scene: Scene, *, gap: float) -> None:
        """gap [m]: parts of one soft body that are this near at rest never touch each other."""
        self._collect(scene)
        ipctk = toolkit()
        faces = np.asfortranarray(self.triangles.astype(np.int32))
        self.edges = ipctk.edges(faces) if len(faces) else np.zeros((0, 2), dtype=np.int32)
        self.mesh = ipctk.CollisionMesh(np.asfortranarray(self._rest), np.asfortranarray(self.edges), faces)
        self.mesh.can_collide = ipctk.make_vertex_patches_filter(self._patches())
        excluded = self._near_at_rest(len(scene.soft_bodies), gap)
        if excluded:
            self.mesh.can_collide &= ipctk.make_sparse_filter(dict.fromkeys(sorted(excluded), False), True)
        lengths = np.linalg.norm(self._rest[self.edges[:, 0]] - self._rest[self.edges[:, 1]], axis=1)
        ends = self.body[self.edges[:, 0]]
        self.edge_lengths = np.bincount(ends, lengths) / np.maximum(np.bincount(ends), 1)
        self.areas = np.zeros(len(self.points.soft))
        self.areas[: self.n_vertices] = self.mesh.vertex_areas

    def _collect(self, scene: Scene) -> None:
        """Number the vertices: those of soft faces that are not held, then all of the rigid bodies."""
        soft, rigid, arms, body, held, rest, triangles = [], [], [], [], [], [], []
        n_soft, first = len(scene.soft_bodies), 0
        for number, one in enumerate(scene.soft_bodies):
            used, faces = np.unique(soft_triangles(one), return_inverse=True)
            soft.append(used + one.first_vertex)
            rigid.append(np.full(len(used), -1))
            arms.append(np.zeros((len(used), 3)))
            rest.append(one.mesh.vertices[used])
            held.append(one.fixed.all(axis=1)[used])
            body.append(np.full(len(used), number))
            triangles.append(faces.reshape(-1, 3) + first)
            first += len(used)
        for number, one in enumerate(scene.rigid_bodies):
            points = one.shape.vertices
            soft.append(np.full(len(points), -1))
            rigid.append(np.full(len(points), number))
            arms.append(points)
            rest.append(points @ one.rotation.T + one.position)
            held.append(np.full(len(points), one.held))
            body.append(np.full(len(points), n_soft + number))
            triangles.append(np.asarray(one.shape.triangles) + first)
            first += len(points)
        balls = [r for r, one in enumerate(scene.rigid_bodies) if one.shape.ball_radius > 0.0]
        held.append(np.array([scene.rigid_bodies[r].held for r in balls], dtype=bool))
        body.append(n_soft + np.array(balls, dtype=np.int64))
        vertices = Points(soft=_ids(soft), rigid=_ids(rigid), arms=np.concatenate([np.zeros((0, 3)), *arms]))
        self.points = vertices.with_rigid(np.array(balls, dtype=np.int64), np.zeros((len(balls), 3)))
        self.n_vertices, self.triangles = first, _ids(triangles).reshape(-1, 3)
        self.body, self.held = _ids(body), np.concatenate(held)
        self._rest = np.concatenate([np.zeros((0, 3)), *rest])

    def _patches(self) -> np.ndarray:
        """Return a number of each vertex; those with the same one never meet: of one rigid body, or held."""
        own = 1 + np.arange(self.n_vertices)
        patches = np.where(self.points.soft[: self.n_vertices] >= 0, own, -1 - self.body[: self.n_vertices])
        return np.where(self.held[: self.n_vertices], 0, patches).astype(np.int32)

    def _near_at_rest(self, n_soft: int, gap: float) -> set[tuple[int, int]]:
        """Return the pairs of vertices, in order, of all edges and faces of one soft body nearer than ``gap``."""
        ipctk, found = toolkit(), set()
        for number in range(n_soft):
            mine = np.flatnonzero(self.body[: self.n_vertices] == number)  # a run of numbers
            if not len(mine):
                continue
            rest = np.asfortranarray(self._rest[mine])
            own = self.triangles[self.body[self.triangles[:, 0]] == number] - mine[0]
            faces = np.asfortranarray(own.astype(np.int32))
            edges = ipctk.edges(faces)
            mesh, near, touching = ipctk.CollisionMesh(rest, edges, faces), ipctk.Candidates(), ipctk.NormalCollisions()
            near.build(mesh, rest, 0.5 * gap)
            touching.build(near, mesh, rest, gap)
            if not len(touching):  # few meshes have any, and only then is each candidate worth a look
                continue
            for sides in _sides(near, edges, faces):
                distance = ipctk.point_triangle_distance if len(sides[0]) == 1 else ipctk.edge_edge_distance
                if distance(*rest[[*sides[0], *sides[1]]]) < gap**2:
                    found |= {(min(a, b), max(a, b)) for a in mine[list(sides[0])] for b in mine[list(sides[1])]}
        return found


def soft_triangles(body: SoftBody) -> np.ndarray:
    """Return the triangles (n, 3) of the faces of ``body`` that are not held all over, in its own numbering."""
    held, found = body.fixed.all(axis=1), [np.zeros((0, 3), dtype=np.int64)]
    for kind in sorted(body.mesh.faces):
        faces = body.mesh.faces[kind]
        if len(faces):
            faces = faces[~held[faces].all(axis=1)]
            found.append(faces[:, np.array(TRIANGLES[kind])].reshape(-1, 3))
    return np.concatenate(found)


def _sides(candidates: Any, edges: np.ndarray, faces: np.ndarray) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Return the vertices of both sides of each candidate: vertex and face, or edge and edge."""
    found = [((c.vertex_id,), tuple(int(v) for v in faces[c.face_id])) for c in candidates.fv_candidates]
    for c in candidates.ee_candidates:
        found.append((tuple(int(v) for v in edges[c.edge0_id]), tuple(int(v) for v in edges[c.edge1_id])))
    return found


def _ids(parts: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0, dtype=np.int64), *(np.asarray(p).reshape(-1) for p in parts)]).astype(np.int64)
