"""The profile of a fin ray: a triangle with a cavity, and ribs as parallel strips clipped by the cavity.

Every hole is the convex polygon that the cavity and the gap between two neighbouring ribs have in common; it is clipped
half-plane by half-plane, so that each edge knows what it belongs to. Two rules keep features finite: a hole below
``SMALLEST_HOLE`` is filled, and a hole's edge below ``SHORTEST_EDGE`` gives way to the corner in which its neighbours
meet. Either changes a finger's area by less than 1e-6 of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from finqd.solid import ring_area

SMALLEST_HOLE = 1e-10  # [m^2]
SHORTEST_EDGE = 5e-6  # [m]

#: what an edge belongs to: the sides of the cavity, counter-clockwise, and the rib above or below a hole
BASE, BACK, TIP, CONTACT, RIB_BELOW, RIB_ABOVE = range(6)


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The numbers of a fin ray's profile [m, rad]; ``apex_x``: 0 in the right profile, width / 2 in the isosceles."""

    length: float
    width: float
    apex_x: float
    base_plate: float
    tip_length: float
    contact_wall: float
    back_wall: float
    rib_count: int
    rib_thickness: float
    rib_angle: float

    @property
    def outer(self) -> np.ndarray:
        """The triangle: contact base, back base, apex, shape (3, 2)."""
        return np.array([(0.0, 0.0), (self.width, 0.0), (self.apex_x, self.length)])

    @property
    def pitch(self) -> float:
        """Distance between the centres of neighbouring ribs along the finger."""
        return (self.length - self.tip_length - self.base_plate) / (self.rib_count + 1)

    @property
    def rib_normal(self) -> np.ndarray:
        """Unit vector across the ribs, towards the tip. A positive angle lifts the ribs' back end."""
        return np.array([-np.sin(self.rib_angle), np.cos(self.rib_angle)])

    def rib_offsets(self) -> np.ndarray:
        """Positions of the ribs' centre lines along `rib_normal`; the centres lie on the triangle's median."""
        y = self.base_plate + self.pitch * np.arange(1, self.rib_count + 1)
        x = 0.5 * self.width + (self.apex_x - 0.5 * self.width) * y / self.length
        return np.column_stack([x, y]) @ self.rib_normal


@dataclass(frozen=True, eq=False)
class Hole:
    """A convex polygon, counter-clockwise (n, 2); edge i runs from point i to point i + 1 and belongs to ``labels[i]``.

    ``sides[i]``: the cavity's sides that point i lies on; two make it a corner of the cavity.
    """

    points: np.ndarray
    labels: tuple[int, ...]
    sides: tuple[frozenset[int], ...]


def cavity(shape: Shape) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the cavity's corners (n, 2) and its edges' labels; empty where the walls leave no room."""
    contact_base, back_base, apex = shape.outer
    points, labels = shape.outer, (BASE, BACK, CONTACT)
    for start, end, offset, label in (
        (contact_base, back_base, shape.base_plate, BASE),
        (back_base, apex, shape.back_wall, BACK),
        (apex, contact_base, shape.contact_wall, CONTACT),
    ):
        direction = (end - start) / np.linalg.norm(end - start)
        inward = np.array([-direction[1], direction[0]])
        points, labels = clip(points, labels, -inward, -float(inward @ start) - offset, label)
    cut, cut_labels = clip(points, labels, np.array([0.0, 1.0]), shape.length - shape.tip_length, TIP)
    if TIP in cut_labels:
        i = cut_labels.index(TIP)
        if np.linalg.norm(cut[i] - cut[(i + 1) % len(cut)]) < SHORTEST_EDGE:
            return points, labels  # the walls as good as meet at the tip line
    return cut, cut_labels


def clip(
    points: np.ndarray, labels: tuple[int, ...], normal: np.ndarray, bound: float, label: int
) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the part of a convex polygon with normal . x <= bound; the new edge belongs to ``label``."""
    if len(points) == 0:
        return points, labels
    excess = points @ normal - bound
    kept: list[np.ndarray] = []
    owners: list[int] = []
    for i, here in enumerate(points):
        j = (i + 1) % len(points)
        crossing = here + (points[j] - here) * (excess[i] / (excess[i] - excess[j])) if excess[i] != excess[j] else here
        if excess[i] <= 0:
            kept.append(here)
            owners.append(labels[i])
            if excess[j] > 0:
                kept.append(crossing)
                owners.append(label)
        elif excess[j] < 0:
            kept.append(crossing)
            owners.append(labels[i])
    return (np.array(kept), tuple(owners)) if len(kept) > 2 else (np.empty((0, 2)), ())


def holes(shape: Shape) -> tuple[Hole, ...]:
    """Return the holes between the ribs, in order towards the tip."""
    normal, half = shape.rib_normal, 0.5 * shape.rib_thickness
    offsets = shape.rib_offsets()
    found = []
    for k in range(shape.rib_count + 1):
        points, labels = cavity(shape)
        if k > 0:
            points, labels = clip(points, labels, -normal, -(offsets[k - 1] + half), RIB_BELOW)
        if k < shape.rib_count:
            points, labels = clip(points, labels, normal, offsets[k] - half, RIB_ABOVE)
        hole = _without_slivers(points, labels)
        if hole is not None:
            found.append(hole)
    return tuple(found)


def _without_slivers(points: np.ndarray, labels: tuple[int, ...]) -> Hole | None:
    """Apply the two rules of the module: None for a hole that is too small."""
    corners = list(points)
    edges = list(labels)
    sides = [frozenset({edges[i - 1], edges[i]} & {BASE, BACK, TIP, CONTACT}) for i in range(len(edges))]
    while len(corners) > 3:
        lengths = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        i = int(np.argmin(lengths))
        if lengths[i] >= SHORTEST_EDGE:
            break
        j, n = (i + 1) % len(corners), len(corners)
        meeting = _meet(corners[i - 1], corners[i], corners[j], corners[(i + 2) % n])
        if meeting is None or np.linalg.norm(meeting - corners[i]) > 10.0 * SHORTEST_EDGE:
            break
        corners[j], sides[j] = meeting, sides[i] | sides[j]
        del corners[i], edges[i], sides[i]
    if len(corners) < 3 or ring_area(np.array(corners)) < SMALLEST_HOLE:
        return None
    return Hole(np.array(corners), tuple(edges), tuple(sides))


def _meet(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray | None:
    """Return where the lines a-b and d-c meet beyond b and c, or None if they do not."""
    first, second = b - a, c - d
    cross = first[0] * second[1] - first[1] * second[0]
    gap = c - b
    if abs(cross) < 1e-6 * np.linalg.norm(first) * np.linalg.norm(second):
        return None
    along = (gap[0] * second[1] - gap[1] * second[0]) / cross
    return b + along * first if along >= 0 else None
