"""Prisms and surface solids: volume and closed, outward surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from finqd.solid import Prism, SurfaceSolid, ring_area

SQUARE = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)])
TRIANGLES = (np.array([(1.0, 1.0), (2.0, 1.0), (2.0, 2.0)]), np.array([(2.5, 1.0), (3.0, 2.0), (3.0, 1.0)]))


def directed_edges_match(triangles: np.ndarray) -> bool:
    """Say whether every directed edge occurs once, with its opposite: closed and consistently ordered."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    forward, back = {tuple(e) for e in edges.tolist()}, {tuple(e) for e in edges[:, ::-1].tolist()}
    return len(forward) == len(edges) and forward == back


@pytest.mark.parametrize("flip", [False, True])
def test_prism_volume_and_surface(flip: bool) -> None:
    holes = tuple(hole[::-1] for hole in TRIANGLES) if flip else TRIANGLES
    solid = Prism(SQUARE, holes, 2.0)
    assert solid.area == pytest.approx(12.0 - 0.5 - 0.25, rel=1e-14)
    assert solid.polygon.area == pytest.approx(solid.area, rel=1e-14)
    vertices, triangles = solid.surface()
    assert directed_edges_match(triangles)
    assert SurfaceSolid(vertices, triangles).volume == pytest.approx(solid.volume, rel=1e-13)
    assert vertices[:, 2].min() == -1.0 and vertices[:, 2].max() == 1.0


def test_surface_solid_volume_does_not_depend_on_its_place() -> None:
    vertices, triangles = Prism(SQUARE, TRIANGLES, 2.0).surface()
    assert SurfaceSolid(vertices + 1e3, triangles).volume == pytest.approx(22.5, rel=1e-12)
    assert SurfaceSolid(vertices, triangles[:, ::-1]).volume == pytest.approx(-22.5, rel=1e-12)


def test_ring_area_sign() -> None:
    assert ring_area(SQUARE) == pytest.approx(12.0)
    assert ring_area(SQUARE[::-1]) == pytest.approx(-12.0)
