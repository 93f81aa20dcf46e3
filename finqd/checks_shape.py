"""Conformance of geometry plugins and meshers: parameters, solids, meshes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd import registry
from finqd.contracts import Parameter
from finqd.errors import InputError
from finqd.units import FACTORS, si_factor

if TYPE_CHECKING:
    from finqd.solid import Solid

#: what a mesher may lose or gain of a curved solid's volume
MESH_VOLUME_TOLERANCE = 5e-3
SOBOL_DESIGNS = 16
#: a point this close to y = 0 lies in the base [m]
BASE_TOLERANCE = 1e-9


def mid_range(parameters: Sequence[Parameter]) -> dict[str, float]:
    """Return the finger in the middle of every range, in SI, counts rounded down."""
    return _finger(parameters, [0.5] * len(parameters))


def sampled_fingers(parameters: Sequence[Parameter], count: int = SOBOL_DESIGNS) -> Iterator[dict[str, float]]:
    """Yield fingers in SI: the middle, the two corners where all is small or large, and Sobol points of the box."""
    from scipy.stats import qmc

    yield mid_range(parameters)
    yield _finger(parameters, [0.0] * len(parameters))
    yield _finger(parameters, [1.0] * len(parameters))
    for point in qmc.Sobol(len(parameters), rng=np.random.default_rng(0)).random(count):
        yield _finger(parameters, point)


def check_declares_its_parameters(kind: str, name: str) -> None:
    """The search space, the schema of design files and the report follow from the declaration."""
    parameters = registry.load(kind, name).finger_parameters
    assert parameters and all(isinstance(p, Parameter) for p in parameters), "finger_parameters must hold Parameters"
    names = [p.name for p in parameters]
    assert len(set(names)) == len(names), f"a parameter is declared twice: {names}"
    for p in parameters:
        limits = (p.allowed_low, p.low, p.high, p.allowed_high)
        assert all(math.isfinite(limit) for limit in limits), f"{p.key}: a limit is not finite: {limits}"
        assert p.allowed_low <= p.low < p.high <= p.allowed_high, f"{p.key}: limits are out of order: {limits}"
        assert p.unit == "" or p.unit in FACTORS, f"{p.key}: unit {p.unit!r} is none of {', '.join(FACTORS)}"
        assert p.name.isidentifier() and p.description, f"{p.key}: needs a plain name and a description"
        whole = all(float(limit).is_integer() for limit in limits)
        assert whole or not p.integer, f"{p.key}: a whole number has limits that are not: {limits}"


def check_builds_every_design(kind: str, name: str) -> None:
    """Over the whole search space: a closed surface, the right volume, a base in y = 0 - or one sentence why not."""
    geometry = registry.create(kind, name)
    built = 0
    for finger in sampled_fingers(geometry.finger_parameters):
        sentence = geometry.check(finger)
        if sentence is None:
            _assert_sound(geometry.build(finger), finger)
            built += 1
        else:
            _assert_refused(geometry, finger, sentence)
    assert built >= 0.5 * (SOBOL_DESIGNS + 3), f"{name!r} refuses most of its own search space: it builds {built}"


def check_builds_the_middle_twice(kind: str, name: str) -> None:
    """The finger in the middle of all ranges is valid, and the same values give the same solid."""
    geometry = registry.create(kind, name)
    finger = mid_range(geometry.finger_parameters)
    assert geometry.check(finger) is None, f"the middle of all ranges is refused: {geometry.check(finger)}"
    first, second = geometry.build(finger).surface(), geometry.build(dict(finger)).surface()
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True)), "the same values gave another solid"


def check_every_parameter_matters(kind: str, name: str) -> None:
    """A parameter that changes nothing would be searched for nothing."""
    geometry = registry.create(kind, name)
    middle = mid_range(geometry.finger_parameters)
    vertices, _ = geometry.build(middle).surface()
    for p in geometry.finger_parameters:
        changed = {**middle, p.name: p.low * si_factor(p.key)}
        if geometry.check(changed) is None:
            other, _ = geometry.build(changed).surface()
            assert not np.array_equal(vertices, other), f"{p.key} changes nothing"


def check_meshes_a_finger(kind: str, name: str) -> None:
    """A mesh of the default finger: its volume, no inverted element, no loose vertex, a base and a contact face."""
    solid = default_finger()
    mesh = registry.create(kind, name).mesh(solid)
    assert abs(mesh.volume / solid.volume - 1.0) <= MESH_VOLUME_TOLERANCE, (
        f"the mesh has {mesh.volume:.6g} m^3, the solid {solid.volume:.6g} m^3"
    )
    quality = mesh.quality()
    assert quality.inverted == 0 and quality.scaled_jacobian_min > 0.0, f"inverted elements: {quality}"
    used = np.unique(np.concatenate([nodes.ravel() for nodes in mesh.blocks.values()]))
    assert len(used) == mesh.n_vertices, f"{mesh.n_vertices - len(used)} vertices belong to no element"
    _assert_regions(mesh)


def check_meshes_alike_twice(kind: str, name: str) -> None:
    """The same solid gives the same mesh, or no result could be repeated."""
    solid, mesher = default_finger(), registry.create(kind, name)
    first, second = mesher.mesh(solid), mesher.mesh(solid)
    assert np.array_equal(first.vertices, second.vertices), "the vertices differ"
    assert first.blocks.keys() == second.blocks.keys(), "the element types differ"
    for block in first.blocks:
        assert np.array_equal(first.blocks[block], second.blocks[block]), f"the {block} elements differ"


def default_finger() -> Solid:
    """Return the solid of the default geometry's finger in the middle of all ranges."""
    geometry = registry.create("geometry", "fin_ray")
    return geometry.build(mid_range(geometry.finger_parameters))


def _finger(parameters: Sequence[Parameter], unit: Sequence[float]) -> dict[str, float]:
    finger = {}
    for p, u in zip(parameters, unit, strict=True):
        value = p.low + u * (p.high - p.low)
        if p.integer:
            value = min(p.low + math.floor(u * (p.high - p.low + 1)), p.high)
        finger[p.name] = float(value) * si_factor(p.key)
    return finger


def _assert_sound(solid: Solid, finger: Mapping[str, float]) -> None:
    vertices, triangles = solid.surface()
    assert np.isfinite(vertices).all(), f"a vertex is not finite at {finger}"
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    directed, back = ({tuple(edge) for edge in e.tolist()} for e in (edges, edges[:, ::-1]))
    assert len(directed) == len(edges) and directed == back, f"the surface is not closed and oriented at {finger}"
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0
    assert volume > 0.0, f"the surface encloses {volume:.4g} m^3 (inside out?) at {finger}"
    assert abs(volume / solid.volume - 1.0) < 1e-6, f"volume {solid.volume:.9g}, surface {volume:.9g} m^3 at {finger}"
    assert vertices[:, 1].min() > -BASE_TOLERANCE, f"the solid reaches below y = 0 at {finger}"
    flat = (np.abs(np.stack([a, b, c])[..., 1]) <= BASE_TOLERANCE).all(axis=0)
    base = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)[flat].sum()
    assert base > 0.0, f"no part of the surface lies in y = 0: there is no base, at {finger}"
    extent = vertices[:, 2].min() + vertices[:, 2].max()
    assert abs(extent) < BASE_TOLERANCE, f"the finger is not symmetric about z = 0, by {extent:.3g} m at {finger}"


def _assert_refused(geometry: Any, finger: Mapping[str, float], sentence: str) -> None:
    assert sentence.strip() and "\n" not in sentence, f"not one sentence: {sentence!r}"
    try:
        geometry.build(finger)
    except InputError:
        return
    raise AssertionError(f"`check` says {sentence!r}, but `build` builds it")


def _assert_regions(mesh: Any) -> None:
    base = mesh.node_sets.get("base", ())
    assert len(base) >= 3, "the node set 'base' is missing or empty"
    assert np.abs(mesh.vertices[base, 1]).max() <= BASE_TOLERANCE, "a node of 'base' lies off y = 0"
    on_plane = np.flatnonzero(np.abs(mesh.vertices[:, 1]) <= BASE_TOLERANCE)
    assert set(on_plane) == set(base), "a node on y = 0 is not in 'base'"
    contact = mesh.face_sets.get("contact", {})
    assert sum(len(indices) for indices in contact.values()), "the face set 'contact' is missing or empty"
    for face_type, indices in contact.items():
        assert len(np.unique(indices)) == len(indices), "a face is in 'contact' twice"
        assert np.asarray(indices).max() < len(mesh.faces[face_type]), "'contact' names a face that is not there"


GEOMETRY = (
    check_declares_its_parameters, check_builds_every_design, check_builds_the_middle_twice,
    check_every_parameter_matters,
)
MESHER = (check_meshes_a_finger, check_meshes_alike_twice)
