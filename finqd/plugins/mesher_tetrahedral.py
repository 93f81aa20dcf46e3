"""The tetrahedral mesher: gmsh, for any solid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from finqd.errors import MeshError
from finqd.gmsh_session import gmsh_session
from finqd.gmsh_tetrahedra import collect, enclose
from finqd.mesh import Mesh
from finqd.mesh_sets import with_finger_sets
from finqd.solid import Prism, Solid, ring_area
from finqd.units import MM

_ALGORITHMS = (1, 10, 4)  # Delaunay, HXT, frontal: the next one where one fails
_POOR = 0.02  # scaled Jacobian below which the second optimiser goes over the mesh


@dataclass(frozen=True, kw_only=True)
class Tetrahedral:
    """Tetrahedra in any solid, by gmsh: four nodes (``order`` 1) or ten, with straight edges (``order`` 2).

    ``size_mm``: edge length aimed at; ``optimise``: improve the worst elements after meshing.
    """

    size_mm: Annotated[float, Ge(0.2), Le(50)] = 2.0
    order: Literal[1, 2] = 2
    optimise: bool = True

    def mesh(self, solid: Solid) -> Mesh:
        """Return the mesh of ``solid``; raises ``MeshError`` (``finqd.contracts.Mesher``)."""
        reason = ""
        for algorithm in _ALGORITHMS:
            try:
                mesh = self._attempt(solid, algorithm)
            except MeshError as error:
                reason = str(error)
                continue
            inverted = mesh.quality().inverted
            if inverted == 0:
                return with_finger_sets(mesh, solid.contact_line)
            reason = f"{inverted} elements are inverted"
        raise MeshError(f"the solid could not be filled with tetrahedra: {reason}")

    def _attempt(self, solid: Solid, algorithm: int) -> Mesh:
        with gmsh_session() as gmsh:
            gmsh.option.setNumber("Mesh.Algorithm3D", algorithm)
            gmsh.option.setNumber("Mesh.MeshSizeMax", self.size_mm * MM)
            gmsh.option.setNumber("Mesh.Optimize", int(self.optimise))
            try:
                if isinstance(solid, Prism):
                    _extrude(gmsh, solid, self.size_mm * MM)
                else:
                    enclose(gmsh, *solid.surface())
                gmsh.model.mesh.generate(3)
                if self.optimise and collect(gmsh, 1).quality().scaled_jacobian_min < _POOR:
                    gmsh.model.mesh.optimize("Netgen")  # slow, and adds vertices
                if self.order == 2:
                    gmsh.model.mesh.setOrder(2)
            except Exception as error:  # gmsh raises bare exceptions
                raise MeshError(f"gmsh says: {' '.join(str(error).split())}") from error
            return collect(gmsh, self.order)


def _extrude(gmsh: Any, solid: Prism, size: float) -> None:
    geo, loops = gmsh.model.geo, []
    outer = solid.outer if ring_area(solid.outer) > 0 else solid.outer[::-1]
    for ring in (outer, *solid.holes):
        ids = [geo.addPoint(x, y, -0.5 * solid.thickness, size) for x, y in np.asarray(ring)]
        loops.append(geo.addCurveLoop([geo.addLine(a, b) for a, b in zip(ids, [*ids[1:], ids[0]], strict=True)]))
    geo.extrude([(2, geo.addPlaneSurface(loops))], 0.0, 0.0, solid.thickness)
    geo.synchronize()
