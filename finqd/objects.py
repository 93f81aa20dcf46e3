"""Objects to be grasped, rigid or soft: mass, surface, distance and a pose in which they lie on the floor.

An object is named (``"sphere"``: one of the ten that come with finqd), or comes from a JSON file, a mapping, or a
surface file:

>>> sphere = load_object("sphere")
>>> f"{1000 * sphere.mass:.1f} g, resting with its centre {1000 * sphere.rest_height:.0f} mm above the floor"
'39.2 g, resting with its centre 20 mm above the floor'
>>> plate = load_object({"shape": {"kind": "box", "size_mm": [60, 40, 5]}, "mass_g": 30})
>>> f"{1000 * plate.mass:.0f} g, {len(plate.support_points)} corners"
'30 g, 8 corners'

With ``"soft": {"youngs_modulus_MPa": 0.3}`` in its JSON an object is elastic instead of rigid.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le

from finqd.cache import remembered
from finqd.data import bundled_names, objects_folder
from finqd.errors import InputError
from finqd.json_input import read_json_object
from finqd.mechanics.distance_kernels import DistanceField
from finqd.mesh import Mesh
from finqd.object_rest import rest_pose, revolution_supports, surface_supports
from finqd.object_shapes import KINDS, Shape, refuse_size, shape_from_json, solid_in_surface
from finqd.options import checked, join, nearest, refuse_unknown, shown
from finqd.soft_object import SoftPart, soft_mesh, soft_part
from finqd.surface_files import SUFFIXES, read_surface
from finqd.units import DEG, GRAM, MM

DENSITY = 1170.0  # of a surface file given without a mass, as of the ten objects [kg/m^3]
TOPPLING = 2.0 * DEG  # a pose asked for may be this far from one that rests

KEYS = ("name", "shape", "density_kg_m3", "mass_g", "rest_rotation_deg", "soft", "note")
Mass = Annotated[float, Ge(0.01), Le(50_000)]
Density = Annotated[float, Ge(1), Le(25_000)]
Angle = Annotated[float, Ge(-360), Le(360)]


@dataclass(frozen=True)
class GraspObject:
    """An object, rigid unless it has a ``soft`` part.

    Its body frame has the centre of mass as origin and the axes of its file.

    name; mass [kg]; inertia (3, 3) [kg m^2]: about the centre of mass, in the body frame;
    vertices (n, 3) [m], triangles (m, 3): watertight outward surface in the body frame (a tessellation, if curved);
    distance: `DistanceField` in the body frame (exact: a ball and a solid of revolution are not tessellated);
    profile (n, 2) [m]: (r, z) of a solid of revolution about z, else None;
    support_points (s, 3) [m]: what can touch a plane; empty for a ball;
    rest_rotation (3, 3), rest_height [m]: body to world rotation, and height of the centre of mass, that rest on z = 0;
    ball_radius [m]: above 0 only for a ball; bounding_radius [m]: about the centre of mass;
    volume [m^3]; assumptions: sentences to be printed with every result;
    soft: what makes it elastic, and mesh: of it in the body frame, both None for a rigid one.
    """

    name: str
    mass: float
    inertia: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray
    distance: DistanceField
    profile: np.ndarray | None
    support_points: np.ndarray
    rest_rotation: np.ndarray
    rest_height: float
    ball_radius: float
    bounding_radius: float
    volume: float
    assumptions: tuple[str, ...] = ()
    soft: SoftPart | None = None
    mesh: Mesh | None = None


def object_names() -> tuple[str, ...]:
    """Return the names of the objects that come with finqd."""
    return tuple(bundled_names(objects_folder()))


def load_object(
    source: str | os.PathLike[str] | Mapping[str, Any], *, mass_g: float | None = None, name: str | None = None
) -> GraspObject:
    """Return the object that ``source`` means.

    source: a name (see `object_names`), a JSON file or its content, or a surface file (STL, OBJ, PLY, OFF; in mm);
    mass_g: its mass, instead of what its file says [g]; name: likewise. Raises ``InputError``, one sentence.
    """
    if mass_g is not None:
        mass_g = checked(Mass, mass_g, "mass_g")
    if isinstance(source, Mapping) or (isinstance(source, str) and source.lstrip().startswith("{")):
        document, where = read_json_object(source, kind="object")
        return _from_json(document, where, Path(), mass_g, name)
    path = _path(source)
    if path.suffix.lower() in SUFFIXES:
        return _from_surface_file(path, mass_g, name)
    document, where = read_json_object(path, kind="object")
    return _from_json({"name": _plain_name(path.stem), **document}, where, path.parent, mass_g, name)


def _path(source: str | os.PathLike[str]) -> Path:
    """Return the file that a name or path means."""
    try:
        given = os.fspath(source)
    except TypeError as error:
        raise InputError(f"must be an object's name or file, not {shown(source)}", "object") from error
    known = object_names()
    if given in known:
        return objects_folder() / f"{given}.json"
    suffix = Path(given).suffix.lower()
    if suffix in (".json", *SUFFIXES):
        return Path(given)
    near = nearest(given, known)
    hint = f"did you mean {near}?" if near else f"known: {', '.join(known)}"
    files = ", ".join((".json", *SUFFIXES))
    raise InputError(f"no object has this name; {hint} (or give a file ending in {files})", shown(given))


def _from_surface_file(path: Path, mass_g: float | None, name: str | None) -> GraspObject:
    vertices, triangles = read_surface(path, factor=MM)
    hint = ' (lengths are read in mm; for others write a JSON with "shape": {"kind": "file", "path": ..., "unit": "m"})'
    refuse_size(vertices, str(path), hint)
    shape = solid_in_surface(vertices, triangles)
    assumptions = [f"{path.name}: lengths are taken in mm"]
    if mass_g is None:
        assumptions.append(f"{path.name}: no mass given, taken as solid with {DENSITY:g} kg/m^3")
    mass = DENSITY * shape.volume if mass_g is None else mass_g * GRAM
    return _placed(_plain_name(name or path.stem), shape, mass, np.eye(3), None, assumptions)


def _from_json(
    document: Mapping[str, Any], where: str, folder: Path, mass_g: float | None, name: str | None
) -> GraspObject:
    refuse_unknown(document, KEYS, where)
    if "shape" not in document:
        kinds = ", ".join(KINDS)
        raise InputError(f'is missing, as in "shape": {{"kind": ...}} with one of {kinds}', join(where, "shape"))
    label = document.get("name", "object") if name is None else name
    if not isinstance(label, str) or label != _plain_name(label):
        allowed = "must be a text of 1 to 60 letters, digits, '-', '_' and '.'"
        raise InputError(f"{allowed}, not {shown(label)}", join(where, "name"))
    note = checked(str, document.get("note", ""), join(where, "note"))
    density, own_mass = _mass(document, where)
    place = join(where, "rest_rotation_deg") if "rest_rotation_deg" in document else None
    orientation = np.eye(3) if place is None else _rotation(document["rest_rotation_deg"], place)
    shape = shape_from_json(document["shape"], join(where, "shape"), folder)
    soft = soft_part(document["soft"], join(where, "soft")) if "soft" in document else None
    grams = own_mass if mass_g is None else mass_g
    mass = density * shape.volume if grams is None else grams * GRAM
    rigid = _placed(label, shape, mass, orientation, place, [f"{label}: {note}"] if note else [])
    return rigid if soft is None else _softened(rigid, soft, join(where, "soft"))


def _softened(rigid: GraspObject, soft: SoftPart, where: str) -> GraspObject:
    """Return an object as an elastic one. Raises InputError if it cannot be meshed."""
    mesh = soft_mesh(soft, rigid.vertices, rigid.triangles, where)
    elements = sum(len(nodes) for nodes in mesh.blocks.values())
    said = (
        f"{rigid.name}: elastic, E = {soft.youngs_modulus_MPa:g} MPa, nu = {soft.poisson_ratio:g}, {soft.elasticity}, "
        f"{elements} tetrahedra"
    )
    return replace(rigid, soft=soft, mesh=mesh, assumptions=(*rigid.assumptions, said))


def _mass(document: Mapping[str, Any], where: str) -> tuple[float, float | None]:
    """Return (density [kg/m^3], mass [g] or None) of a JSON object that gives one of them."""
    given = [key for key in ("density_kg_m3", "mass_g") if key in document]
    if len(given) != 1:
        count = "both" if given else "neither"
        raise InputError(f"give density_kg_m3 or mass_g, not {count}", where.rstrip(":"))
    value = checked(Mass if given[0] == "mass_g" else Density, document[given[0]], join(where, given[0]))
    return (DENSITY, value) if given[0] == "mass_g" else (value, None)


def _rotation(value: Any, where: str) -> np.ndarray:
    """Return the rotation by [rx, ry, rz] degrees about the fixed axes x, then y, then z."""
    if not isinstance(value, (list, tuple)) or len(value) != 3:
        raise InputError(f"must be a list of 3 angles [rx, ry, rz], not {shown(value)}", where)
    angles = [checked(Angle, angle, join(where, i)) * DEG for i, angle in enumerate(value)]
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    return about_z @ about_y @ about_x


def _placed(
    name: str, shape: Shape, mass: float, orientation: np.ndarray, place: str | None, assumptions: list[str]
) -> GraspObject:
    """Return the object in its resting pose; ``place``: of the pose in the file, if it was asked for."""
    supports, rotation, height, tilt = np.zeros((0, 3)), orientation, shape.ball_radius, 0.0
    if not shape.ball_radius:
        supports, rotation, height, tilt = _resting(shape, orientation)
    if tilt > TOPPLING:
        if place is not None:
            raise InputError(f"does not rest in this pose, it topples by {tilt / DEG:.0f} degrees", place)
        assumptions.append(f"{name}: does not stand as it is in its file; it lies toppled by {tilt / DEG:.1f} degrees")
    radius = shape.ball_radius or float(np.sqrt(np.einsum("ij,ij->i", shape.vertices, shape.vertices).max()))
    return GraspObject(
        name=name,
        mass=mass,
        inertia=shape.inertia * (mass / shape.volume),
        vertices=shape.vertices,
        triangles=shape.triangles,
        distance=shape.distance,
        profile=shape.profile,
        support_points=supports,
        rest_rotation=rotation,
        rest_height=height,
        ball_radius=shape.ball_radius,
        bounding_radius=radius,
        volume=shape.volume,
        assumptions=tuple(assumptions),
    )


def _resting(shape: Shape, orientation: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return (support points, rotation, height, tilt), kept on disk: 10 to 130 ms for each of the ten objects."""
    points = shape.vertices if shape.profile is None else shape.profile
    return remembered(
        "resting", [points, int(shape.profile is None), orientation], lambda: _come_to_rest(shape, orientation),
        pack=lambda made: dict(zip(("supports", "rotation", "height", "tilt"), map(np.asarray, made))),
        unpack=lambda kept: (kept["supports"], kept["rotation"], kept["height"].item(), kept["tilt"].item()),
    )


def _come_to_rest(shape: Shape, orientation: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return what `_resting` does. A lathe that lies gets finer rims, since it may roll on them."""
    if shape.profile is None:
        supports = surface_supports(shape.vertices)
        return supports, *rest_pose(supports, orientation)
    for n_around in (48, 96):
        supports = revolution_supports(shape.profile, n_around=n_around)
        rotation, height, tilt = rest_pose(supports, orientation)
        if abs(rotation[2, 2]) > 0.9999:
            break
    return supports, rotation, height, tilt


def _plain_name(name: str) -> str:
    """Return ``name`` as it can stand in file names: letters, digits, ``-``, ``_``, ``.``."""
    return re.sub(r"[^\w.-]+", "_", name, flags=re.ASCII).lstrip(".")[:60] or "object"
