r"""The barrier of incremental potential contact, on planes; the IPC Toolkit has the same one between triangles.

.. math:: E = A \\kappa \\hat d\\, b(d^2/\\hat d^2), \\qquad b(z) = -(z - 1)^2 \\ln z \\text{ for } z < 1,
    \\text{ else } 0

with the gap d, the area A that a vertex stands for and a pressure kappa. It is twice continuously differentiable,
nothing at d^ and infinite at 0. Source: Li et al., Incremental Potential Contact, ACM Trans. Graph. 39 (2020) 49,
equation 6; scaled to a pressure as in Li et al., Convergent Incremental Potential Contact, arXiv 2307.15908 (2023).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from finqd.scene import Plane

#: pressure at half the gap, as a multiple of kappa: -2 y b'(y^2) at y = 1/2
HALF_GAP = 2.25 + 1.5 * float(np.log(4.0))


def barrier(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return b and its first two derivatives at squared relative gaps ``z``; infinite where z <= 0."""
    active, inside = z < 1.0, z > 0.0
    y = np.where(active & inside, z, 1.0)
    log, off = np.log(y), y - 1.0
    value = np.where(inside, -(off**2) * log, np.inf)
    return value, -2.0 * off * log - off**2 / y, -2.0 * log - 4.0 * off / y + (off / y) ** 2


@dataclass(frozen=True, kw_only=True)
class PlaneContacts:
    """Points within the reach of a plane, m of them.

    point: which, plane: of which plane, both (m,); normal: of that plane (m, 3); depth: below its surface [m], (m,)
    energy: of all [J]; force: each is pushed with, along the normal [N]; stiffness: its derivative [N/m], both (m,)
    """

    point: np.ndarray
    plane: np.ndarray
    normal: np.ndarray
    depth: np.ndarray
    energy: float
    force: np.ndarray
    stiffness: np.ndarray


class PlaneBarrier:
    """Infinite half spaces that points must not enter.

    The barrier sets in at the surface of the plane and is infinite at a depth of ``gap`` [m]: what is placed on a floor
    touches it to the last digit or not, and must be neither refused nor thrown up.
    """

    def __init__(
        self, planes: Sequence[Plane], *, which: np.ndarray, radii: np.ndarray, areas: np.ndarray, gap: float,
        pressure: float,
    ) -> None:
        """which: points that can touch, radii: of the balls whose centres they are [m], both (m,).

        areas: that each point stands for [m^2], (n_points,); pressure: kappa [Pa]
        """
        self.planes, self.which, self.radii, self.areas = planes, which, radii, areas
        self.gap, self.pressure = gap, pressure

    def heights(self, places: np.ndarray, plane: Plane) -> np.ndarray:
        """Return how far points at ``places`` (n_points, 3) are above a plane [m], shape (m,)."""
        return (places[self.which] - plane.point) @ plane.normal - self.radii

    def contacts(self, places: np.ndarray) -> PlaneContacts:
        """Return the contacts of points at ``places`` (n_points, 3); the energy is inf if one is too deep."""
        parts = []
        for number, plane in enumerate(self.planes):
            room = self.gap + self.heights(places, plane)
            near = np.flatnonzero(room < self.gap)
            parts.append((near, np.full(len(near), number), np.tile(plane.normal, (len(near), 1)), room[near]))
        if not parts:
            parts.append((np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros((0, 3)), np.zeros(0)))
        near, plane_ids, normal, room = (np.concatenate(column) for column in zip(*parts, strict=True))
        value, slope, bend = barrier(np.where(room > 0.0, (room / self.gap) ** 2, -1.0))
        scale = self.areas[self.which[near]] * self.pressure * self.gap
        inner = 2.0 * room / self.gap**2
        return PlaneContacts(
            point=self.which[near], plane=plane_ids, normal=normal, depth=self.gap - room,
            energy=float(np.sum(scale * value)),
            force=-scale * slope * inner, stiffness=scale * (bend * inner**2 + slope * 2.0 / self.gap**2),
        )

    def is_free(self, places: np.ndarray) -> bool:
        """Tell whether no point at ``places`` (n_points, 3) is too deep."""
        return all(bool(np.all(self.heights(places, plane) > -self.gap)) for plane in self.planes)

    def limit(self, places: np.ndarray, moved: np.ndarray, share: float) -> float:
        """Return which share of straight ways to ``moved`` (n_points, 3) leaves ``1 - share`` of all room at least."""
        limit = 1.0
        for plane in self.planes:
            room, then = self.gap + self.heights(places, plane), self.gap + self.heights(moved, plane)
            sinking = then < (1.0 - share) * room
            limit = min(limit, float(np.min(share * room[sinking] / (room - then)[sinking], initial=1.0)))
        return limit
