"""Quadrilaterals in any polygon with holes, by gmsh: frontal triangles, recombined; some triangles may remain."""

from __future__ import annotations

import numpy as np

from finqd.errors import MeshError
from finqd.gmsh_session import gmsh_session
from finqd.plugins.swept_patches import PlaneMesh
from finqd.solid import Prism, ring_area

#: gmsh's 2-D algorithm and recombination algorithm (0: triangles stay), in the order in which they are tried
_WAYS = ((8, 1), (6, 1), (8, 2), (5, 3), (6, 0))
_POOR = 0.02  # sine of the worst corner
_AREA = 1e-9  # relative difference that rounding may leave


def pave(solid: Prism, size: float, least: int) -> PlaneMesh:
    """Return a mesh of the prism's profile with edges of about ``size`` [m]; the best of several attempts.

    Raises ``MeshError`` if gmsh fails in every way.
    """
    best: PlaneMesh | None = None
    reason = ""
    for algorithm, recombination in _WAYS:
        if recombination == 0 and best is not None and best.worst() > _POOR:
            break  # poor quadrilaterals bend better than good wedges
        try:
            plane = _attempt(solid, size / least, algorithm, recombination)
            if abs(plane.area() - solid.area) > _AREA * solid.area:
                raise MeshError("elements overlap")
        except MeshError as error:
            reason = str(error)
            continue
        if best is None or plane.worst() > best.worst():
            best = plane
        if best.worst() > 0.2:
            break
    if best is None:
        raise MeshError(f"the profile could not be meshed: {reason}")
    return best


def pave_with_quads(solid: Prism, size: float, least: int) -> PlaneMesh:
    """Return a mesh as `pave`, but if triangles remain, one of twice the size with each element cut into quads."""
    plane = pave(solid, size, least)
    return cut_into_quads(pave(solid, 2.0 * size, least)) if len(plane.triangles) else plane


def cut_into_quads(plane: PlaneMesh) -> PlaneMesh:
    """Return the mesh with each element cut into quadrilaterals from its middle to the middles of its edges."""
    points, quads, count = [plane.points], [], len(plane.points)
    kinds = [elements for elements in (plane.quads, plane.triangles) if len(elements)]
    edges = np.concatenate([np.stack([e, np.roll(e, -1, axis=1)], axis=2).reshape(-1, 2) for e in kinds])
    ends, edge_of = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    points.append(plane.points[ends].mean(axis=1))
    middle_of, count = count + edge_of.ravel(), count + len(ends)
    for elements in kinds:
        after = middle_of[: elements.size].reshape(elements.shape)
        middle_of = middle_of[elements.size :]
        centre = count + np.arange(len(elements))
        points.append(plane.points[elements].mean(axis=1))
        count += len(elements)
        corners = (elements, after, np.broadcast_to(centre[:, None], elements.shape), np.roll(after, 1, axis=1))
        quads.append(np.stack(corners, axis=2).reshape(-1, 4))
    return PlaneMesh(np.concatenate(points), np.concatenate(quads), np.empty((0, 3), dtype=int))


def _attempt(solid: Prism, size: float, algorithm: int, recombination: int) -> PlaneMesh:
    outer = solid.outer if ring_area(solid.outer) > 0 else solid.outer[::-1]
    with gmsh_session() as gmsh:
        gmsh.option.setNumber("Mesh.Algorithm", algorithm)
        geo, loops = gmsh.model.geo, []
        for ring in (outer, *solid.holes):
            ids = [geo.addPoint(x, y, 0.0, size) for x, y in np.asarray(ring)]
            lines = [geo.addLine(a, b) for a, b in zip(ids, [*ids[1:], ids[0]], strict=True)]
            lengths = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
            for line, length in zip(lines, lengths, strict=True):
                geo.mesh.setTransfiniteCurve(line, max(1, round(length / size)) + 1)
            loops.append(geo.addCurveLoop(lines))
        surface = geo.addPlaneSurface(loops)
        if recombination:
            gmsh.option.setNumber("Mesh.RecombinationAlgorithm", recombination)
            geo.mesh.setRecombine(2, surface)
        geo.synchronize()
        try:
            gmsh.model.mesh.generate(2)
        except Exception as error:  # gmsh raises bare exceptions
            raise MeshError(f"gmsh says: {error}") from error
        return _collect(gmsh)


def _collect(gmsh: object) -> PlaneMesh:
    tags, coordinates, _ = gmsh.model.mesh.getNodes()  # type: ignore[attr-defined]
    index = np.zeros(int(tags.max()) + 1, dtype=int)
    index[tags.astype(int)] = np.arange(len(tags))
    points = coordinates.reshape(-1, 3)[:, :2].copy()
    found = {}
    for kind, nodes in ((3, 4), (2, 3)):
        _, connectivity = gmsh.model.mesh.getElementsByType(kind)  # type: ignore[attr-defined]
        elements = index[connectivity.astype(int)].reshape(-1, nodes)
        turned = np.array([ring_area(points[e]) < 0 for e in elements], dtype=bool)
        elements[turned] = elements[turned][:, ::-1]
        found[nodes] = elements
    used = np.unique(np.concatenate([found[4].ravel(), found[3].ravel()]))
    place = np.zeros(len(points), dtype=int)
    place[used] = np.arange(len(used))
    return PlaneMesh(points[used], place[found[4]], place[found[3]])
