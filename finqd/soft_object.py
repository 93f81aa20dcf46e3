"""Soft objects: the elastic part of an object's JSON, ``"soft": {"youngs_modulus_MPa": 0.3}``, and its mesh.

>>> part = soft_part({"youngs_modulus_MPa": 0.3}, "soft")
>>> part.youngs_modulus_MPa, part.poisson_ratio, part.elasticity
(0.3, 0.4, 'corotated')
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Any, get_type_hints

import numpy as np
from annotated_types import Ge, Le

from finqd.errors import InputError, MeshError
from finqd.gmsh_session import gmsh_session
from finqd.gmsh_tetrahedra import collect, enclose
from finqd.mechanics.material import Material
from finqd.mesh import Mesh
from finqd.meshing import mesh_solid
from finqd.options import checked, join, refuse_unknown, require_object
from finqd.units import MM, MPA

ACROSS = 6.0  # elements across the smallest extent of an object whose file gives no size


@dataclass(frozen=True, kw_only=True)
class SoftPart:
    """What makes an object elastic.

    youngs_modulus_MPa, poisson_ratio: of an isotropic material; element_size_mm: edge length of its tetrahedra of ten
    nodes, None for a sixth of the smallest extent; elasticity: name of the law
    """

    youngs_modulus_MPa: Annotated[float, Ge(1e-4), Le(1e5)]
    poisson_ratio: Annotated[float, Ge(0), Le(0.4999)] = 0.4
    element_size_mm: Annotated[float, Ge(0.2), Le(100)] | None = None
    elasticity: str = "corotated"

    def material(self, density: float) -> Material:
        """Return the material, of ``density`` [kg/m^3]."""
        return Material(
            youngs_modulus=self.youngs_modulus_MPa * MPA, poisson_ratio=self.poisson_ratio, density=density
        )


def soft_part(value: Any, where: str) -> SoftPart:
    """Return the soft part that a JSON object describes. Raises ``InputError``."""
    from finqd import registry

    given = require_object(value, where)
    hints = get_type_hints(SoftPart, include_extras=True)
    refuse_unknown(given, [field.name for field in fields(SoftPart)], where)
    if "youngs_modulus_MPa" not in given:
        raise InputError("is missing, as in \"soft\": {\"youngs_modulus_MPa\": 0.3}", join(where, "youngs_modulus_MPa"))
    part = SoftPart(**{key: checked(hints[key], given[key], join(where, key)) for key in given})
    try:
        registry.load("elasticity", part.elasticity)
    except InputError as error:
        raise InputError(error.message, join(where, "elasticity")) from error
    return part


@dataclass(frozen=True, eq=False)
class _Surface:
    """A closed surface, as a mesher of `meshing.mesh_solid` takes it."""

    vertices: np.ndarray
    triangles: np.ndarray


@dataclass(frozen=True, kw_only=True)
class _Filler:
    """Fills a surface with tetrahedra of ten nodes."""

    size: float

    def mesh(self, solid: _Surface) -> Mesh:
        """Return the mesh; raises ``MeshError``."""
        with gmsh_session() as gmsh:
            gmsh.option.setNumber("Mesh.MeshSizeMax", self.size)
            gmsh.option.setNumber("Mesh.MeshSizeMin", 0.5 * self.size)
            try:
                enclose(gmsh, solid.vertices, solid.triangles)
                gmsh.model.mesh.generate(3)
                gmsh.model.mesh.setOrder(2)
            except Exception as error:  # gmsh raises bare exceptions
                raise MeshError(f"gmsh says: {' '.join(str(error).split())}") from error
            mesh = collect(gmsh, 2)
        inverted = mesh.quality().inverted
        if inverted:
            raise MeshError(f"{inverted} elements are inverted")
        return mesh


def soft_mesh(part: SoftPart, vertices: np.ndarray, triangles: np.ndarray, where: str) -> Mesh:
    """Return the mesh of the solid in a closed surface [m]. Raises InputError if it cannot be filled."""
    size = float(np.ptp(vertices, axis=0).min()) / ACROSS
    if part.element_size_mm is not None:
        size = part.element_size_mm * MM
    try:
        return mesh_solid(_Filler(size=size), _Surface(vertices, triangles))  # type: ignore[arg-type]
    except MeshError as error:
        raise InputError(f"the object cannot be filled with tetrahedra: {error}", where) from error
