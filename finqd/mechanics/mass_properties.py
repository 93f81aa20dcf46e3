"""Volume, centre of mass and inertia of solids, from their surface by the divergence theorem."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Moments(NamedTuple):
    """Of a solid of density 1: volume [m^3], centre (3,) [m], inertia (3, 3) about the centre [m^5]."""

    volume: float
    centre: np.ndarray
    inertia: np.ndarray


def surface_moments(vertices: np.ndarray, triangles: np.ndarray) -> Moments:
    """Return the moments of the solid inside a watertight surface (negative volume: it is inside out).

    Sums over the tetrahedra that each triangle makes with a common apex, whose second moments are those of a simplex,
    V/20 (sum_i x_i x_i^T + (sum_i x_i) (sum_i x_i)^T) with one corner at the origin.
    """
    apex = vertices[triangles[:, 0]].mean(axis=0)  # near the solid, or else large terms cancel
    points = vertices[triangles] - apex
    volumes = np.einsum("ij,ij->i", points[:, 0], np.cross(points[:, 1], points[:, 2])) / 6.0
    volume = volumes.sum()
    sums = points.sum(axis=1)
    first = volumes @ sums / 4.0
    squares = np.einsum("i,ikj,ikl->jl", volumes, points, points, optimize=True)
    second = (squares + np.einsum("i,ij,il->jl", volumes, sums, sums, optimize=True)) / 20.0
    offset = first / volume if volume != 0.0 else np.zeros(3)
    second -= volume * np.outer(offset, offset)
    return Moments(float(volume), apex + offset, np.trace(second) * np.eye(3) - second)


def revolution_moments(profile: np.ndarray) -> Moments:
    r"""Return the moments of a solid of revolution about z; profile: counterclockwise polygon (r, z), shape (n, 2).

    .. math:: V = \pi \oint r^2 dz, \quad S_z = \pi \oint r^2 z\, dz, \quad S_{zz} = \pi \oint r^2 z^2 dz,
              \quad I_{zz} = \frac{\pi}{2} \oint r^4 dz

    by Gauss's rule of three points on each edge, which is exact for these integrands.
    """
    nodes, weights = np.polynomial.legendre.leggauss(3)
    ends = np.roll(profile, -1, axis=0)
    share = (nodes + 1.0) / 2.0
    r, z = (profile[:, i, None] * (1.0 - share) + ends[:, i, None] * share for i in range(2))
    dz = (ends[:, 1] - profile[:, 1])[:, None] * weights / 2.0
    volume, first, second = (np.pi * float(np.sum(r**2 * z**k * dz)) for k in range(3))
    polar = np.pi / 2.0 * float(np.sum(r**4 * dz))
    height = first / volume if volume != 0.0 else 0.0
    across = polar / 2.0 + second - volume * height**2
    return Moments(volume, np.array([0.0, 0.0, height]), np.diag([across, across, polar]))


def ball_moments(radius: float) -> Moments:
    """Return the moments of a ball about the origin."""
    volume = 4.0 / 3.0 * np.pi * radius**3
    return Moments(volume, np.zeros(3), 0.4 * volume * radius**2 * np.eye(3))


def thickness(vertices: np.ndarray, triangles: np.ndarray, volume: float) -> float:
    """Return six volumes over the surface [m]: a ball's diameter, a cube's edge, three radii of a long wire.

    vertices [m] (n, 3), triangles (m, 3): of a watertight surface around ``volume`` [m^3].
    """
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return 6.0 * volume / (0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()))
