"""Cuts a fin ray's profile into three- and four-sided patches: walls, ribs, corners and tip.

The cavity's perimeter, counter-clockwise, is a ring of nodes: the corners of the holes and of the cavity. What lies
outwards of the ring is wall, cut across at every node, with a kite at each base corner and a triangle for the tip; what
lies inwards and is not a hole is rib. A cavity corner that a rib covers is no corner of the solid: it may give way to a
hole's corner near by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from finqd.plugins.fin_ray_profile import BACK, BASE, CONTACT, RIB_ABOVE, RIB_BELOW, TIP, Hole, Shape, cavity
from finqd.solid import Patch, ring_area

_NEAR = 0.25  # of the thinnest member: how far a covered cavity corner may move to a hole's corner


@dataclass(eq=False)
class _Node:
    point: np.ndarray
    sides: frozenset[int]  # of the cavity; two of them: a corner
    corner_of: tuple[int, int] | None  # index of a hole and of its corner


def patches(shape: Shape, found: tuple[Hole, ...]) -> tuple[Patch, ...] | None:
    """Return the profile's partition, or None where the ribs meet the cavity's corners in a way not provided for."""
    ring = _ring(shape, found)
    if ring is None:
        return None
    ribs = _rib_patches(ring, found)
    if ribs is None:
        return None
    everything = (*_wall_patches(shape, ring), *ribs)
    outlines = [np.concatenate([side[:-1] for side in patch]) for patch in everything]
    areas = np.array([ring_area(outline) for outline in outlines])
    area = ring_area(shape.outer) - sum(ring_area(hole.points) for hole in found)
    complete = np.all(areas > 0) and abs(areas.sum() - area) <= 1e-10 * area
    return everything if complete else None


def _ring(shape: Shape, found: tuple[Hole, ...]) -> list[_Node] | None:
    """Return the nodes around the cavity, from the corner between contact wall and base; None if a corner is lost."""
    corners, labels = cavity(shape)
    nodes = [
        _Node(point, hole.sides[i], (k, i)) for k, hole in enumerate(found) for i, point in enumerate(hole.points)
    ]
    owned = {node.sides for node in nodes if len(node.sides) == 2}
    start = labels.index(BASE)
    ring: list[_Node] = []
    for i in range(len(corners)):
        here = (start + i) % len(corners)
        corner, label = corners[here], labels[here]
        both = frozenset({labels[here - 1], label})
        ring += [node for node in nodes if node.sides == both] if both in owned else [_Node(corner, both, None)]
        along = corners[(here + 1) % len(corners)] - corner
        inner = [node for node in nodes if node.sides == frozenset({label})]
        ring += sorted(inner, key=lambda node, along=along: float(node.point @ along))
    if len({node.sides for node in ring if len(node.sides) == 2}) != len(corners):
        return None
    return _merged(ring, _NEAR * min(shape.contact_wall, shape.back_wall, shape.base_plate, shape.rib_thickness))


def _merged(ring: list[_Node], near: float) -> list[_Node]:
    """Let each covered corner give way to the nearer of its neighbours, where that is near."""
    kept = list(ring)
    for corner in [node for node in ring if node.corner_of is None]:
        i = kept.index(corner)
        around = [kept[i - 1], kept[(i + 1) % len(kept)]]
        distances = [float(np.linalg.norm(node.point - corner.point)) for node in around]
        chosen = around[int(np.argmin(distances))]
        if min(distances) < near and len(chosen.sides) == 1:
            chosen.sides = corner.sides
            del kept[i]
    first = next(i for i, node in enumerate(kept) if node.sides == frozenset({CONTACT, BASE}))
    return kept[first:] + kept[:first]


def _wall_patches(shape: Shape, ring: list[_Node]) -> list[Patch]:
    contact_base, back_base, apex = shape.outer
    lines = {BASE: (contact_base, back_base), BACK: (back_base, apex), CONTACT: (apex, contact_base)}
    outer_corner = {frozenset({CONTACT, BASE}): contact_base, frozenset({BASE, BACK}): back_base}

    def foot(node: _Node, side: int) -> np.ndarray:
        start, end = lines[side]
        along = end - start
        return start + along * (float((node.point - start) @ along) / float(along @ along))

    made: list[Patch] = []
    tip_chain: list[np.ndarray] = []
    previous = CONTACT
    for node, after in zip(ring, [*ring[1:], ring[0]], strict=True):
        side = _side_between(node, after, previous)
        if node.sides in outer_corner:
            rim = [node.point, foot(node, previous), outer_corner[node.sides], foot(node, side), node.point]
            made.append(tuple(np.array(rim[i : i + 2]) for i in range(4)))
        elif len(node.sides) == 2 or TIP in node.sides:
            if BACK in node.sides:
                tip_chain.append(foot(node, BACK))
            tip_chain.append(node.point)
            if CONTACT in node.sides:
                tip_chain.append(foot(node, CONTACT))
        if side != TIP:
            rim = [node.point, foot(node, side), foot(after, side), after.point, node.point]
            made.append(tuple(np.array(rim[i : i + 2]) for i in range(4)))
        previous = side
    bottom = np.array(tip_chain[::-1])
    made.append((np.array([bottom[-1], apex]), np.array([apex, bottom[0]]), bottom))
    return made


def _side_between(node: _Node, after: _Node, previous: int) -> int:
    """Return the side of the cavity that two neighbours in the ring share."""
    shared = node.sides & after.sides
    if len(shared) == 1:
        return next(iter(shared))
    following = {CONTACT: BASE, BASE: BACK, BACK: TIP if TIP in node.sides else CONTACT, TIP: CONTACT}
    return following[previous] if len(node.sides) == 2 else previous


def _rib_patches(ring: list[_Node], found: tuple[Hole, ...]) -> list[Patch] | None:
    """Return the patches inwards of the ring, one a rib; None for a rib with two corners at one end."""
    made: list[Patch] = []
    for k in range(len(found) + 1):
        below = _edge(ring, k - 1, found[k - 1], RIB_ABOVE) if k > 0 else None
        above = _edge(ring, k, found[k], RIB_BELOW) if k < len(found) else None
        if below and above:
            patch = _strip(_arc(ring, below[0], above[1]), _arc(ring, above[0], below[1]))
        elif below or above:
            start, end = below or above  # type: ignore[misc]
            patch = _gusset(_arc(ring, start, end))
        else:
            continue
        if patch is None:
            return None
        if patch:
            made.append(patch)
    return made


def _edge(ring: list[_Node], k: int, hole: Hole, label: int) -> tuple[int, int] | None:
    """Return the ring indices of the start and end of the hole's edge along a rib."""
    if label not in hole.labels:
        return None
    i = hole.labels.index(label)
    owners = [node.corner_of for node in ring]
    return owners.index((k, i)), owners.index((k, (i + 1) % len(hole.points)))


def _arc(ring: list[_Node], start: int, end: int) -> list[np.ndarray]:
    """Return the points from ring index ``start`` on to ``end``, both included."""
    count = (end - start) % len(ring)
    return [ring[(start + i) % len(ring)].point for i in range(count + 1)]


def _gusset(arc: list[np.ndarray]) -> Patch | None:
    """Return the patch between an arc around cavity corners and the straight edge of a hole; () if there is none."""
    if len(arc) == 2:
        return ()
    if len(arc) > 4:
        return None
    rim = [*arc, arc[0]]
    return tuple(np.array(rim[i : i + 2]) for i in range(len(arc)))


def _strip(right: list[np.ndarray], left: list[np.ndarray]) -> Patch | None:
    """Return a rib's patch between its ends, the arcs ``right`` and ``left``; None if one has two cavity corners."""
    if len(right) > 3 or len(left) > 3:
        return None
    rim = [*right, *left]
    passed = {i for i in (_passed(rim, 0, len(right)), _passed(rim, len(right), len(left))) if i is not None}
    corners = [i for i in range(len(rim)) if i not in passed]
    if len(corners) != 4:
        return None
    # the first side is an end of the rib; the order of the others follows
    closed = rim + rim
    ends = [*corners, corners[0] + len(rim)]
    return tuple(np.array(closed[ends[i] : ends[i + 1] + 1]) for i in range(4))


def _passed(rim: list[np.ndarray], start: int, count: int) -> int | None:
    """Return which of the three points of a rib's end is to be no corner of the patch: its two angles come out best."""
    if count == 2:
        return None
    points = np.array(rim)
    steps = np.roll(points, -1, axis=0) - points
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    turn = (heading - np.roll(heading, 1) + np.pi) % (2 * np.pi) - np.pi
    inner = np.pi - turn
    candidates = range(start, start + 3)
    scores = []
    for i in candidates:
        score = min(np.sin(inner[i] / 2), *(np.sin(inner[j]) for j in candidates if j != i))
        if i == start + 1:  # the corner stays in the middle of the end: both halves get a row of elements
            first, second = (float(np.linalg.norm(steps[j])) for j in (start, start + 1))
            score *= 0.8 * min(1.0, 3.0 * min(first, second) / (first + second))
        scores.append(score)
    return start + int(np.argmax(scores))
