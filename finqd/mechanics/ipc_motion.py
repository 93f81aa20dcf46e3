"""Which triangles are near each other, and how far vertices may go until some of them meet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from finqd.mechanics.ipc_surface import IpcSurface, toolkit

NEAR = 5.0  # gaps within which candidates are kept: they hold until vertices have moved by two gaps
KEPT = 0.1  # share of the distance of any two triangles that a step leaves at least,
CHECKED = 0.02  # and that a way is checked for: what a step may reach must not be refused for rounding
SAFE = 0.9  # share of the smallest distance that may be used up by motion without any look at triangles
REACH = 2.0  # mean edges, of the coarser one, that bodies may move relative to each other once their boxes meet,
FREE = 10.0  # or so many gaps: beyond, swept boxes meet too many others
PATIENCE = 10_000  # iterations of a pair's collision search, after which the share found so far is taken


@dataclass(frozen=True, kw_only=True)
class _Way:
    """A share of ``moves`` (n, 3) [m] from ``start`` that has been found free, with ``room`` [m] beside it."""

    start: np.ndarray
    moves: np.ndarray
    share: float
    room: float

    def has(self, moves: np.ndarray) -> bool:
        """Tell whether ``moves`` (n, 3) lead to a point of the way, or so near it that nothing can be between."""
        share = min(float(np.vdot(moves, self.moves)) / float(np.vdot(self.moves, self.moves)), self.share)
        return share >= 0.0 and _longest(moves - share * self.moves) <= self.room


class Motion:
    """Collision detection on one surface, discrete and continuous, with candidates that are kept from call to call.

    Nothing depends on what is common to all vertices' motion; a lifted gripper keeps its candidates.
    """

    def __init__(self, surface: IpcSurface, *, gap: float) -> None:
        self.surface, self.gap = surface, gap
        body = surface.body[: surface.n_vertices]
        numbers = np.unique(body)
        self.members = [np.flatnonzero(body == number) for number in numbers]
        self.reach = [max(REACH * surface.edge_lengths[number], FREE * gap) for number in numbers]
        toolkit_ = toolkit()
        self._ccd = toolkit_.AdditiveCCD(PATIENCE, 1.0 - KEPT)
        self._check = toolkit_.AdditiveCCD(PATIENCE, 1.0 - CHECKED)
        self.forget()

    def forget(self) -> None:
        """Drop the candidates: what follows must not depend on what was before."""
        self._anchor: np.ndarray | None = None
        self._candidates: Any = None
        self._way: _Way | None = None

    def near(self, vertices: np.ndarray) -> Any:
        """Return candidates that hold all pairs nearer than the gap at ``vertices`` (n_vertices, 3) [m]."""
        if not self._holds(vertices):
            self._candidates, self._anchor = self._built(vertices, 0.5 * NEAR * self.gap), vertices
        return self._candidates

    def limit(self, start: np.ndarray, end: np.ndarray, least: float) -> float:
        """Return the share (0, 1] of the straight ways from ``start`` to ``end`` that brings no triangles together.

        least: no larger than the smallest distance of two triangles at ``start`` [m].
        """
        moves = _apart(end - start)
        farthest = _longest(moves)
        if 2.0 * farthest <= SAFE * least:
            return 1.0
        share = self._far(start, end - start)
        end = np.asfortranarray(start + share * moves)
        candidates = self._along(start, end)
        share *= candidates.compute_collision_free_stepsize(self.surface.mesh, start, end, 0.0, self._ccd)
        self._way = _Way(start=start, moves=moves, share=share, room=0.5 * SAFE * KEPT * least)
        return share

    def is_free(self, start: np.ndarray, end: np.ndarray, least: float) -> bool:
        """Tell whether straight ways from ``start`` to ``end`` bring no triangles together; ``least`` as in `limit`."""
        moves = _apart(end - start)
        if 2.0 * _longest(moves) <= SAFE * least:
            return True
        if self._way is not None and self._way.start is start and self._way.has(moves):
            return True
        if self._far(start, end - start) < 1.0:
            return False
        end = np.asfortranarray(start + moves)
        return bool(self._along(start, end).is_step_collision_free(self.surface.mesh, start, end, 0.0, self._check))

    def _along(self, start: np.ndarray, end: np.ndarray) -> Any:
        """Return candidates that hold all pairs that may meet on straight ways from ``start`` to ``end``."""
        if self._holds(start) and self._holds(end):
            return self._candidates
        ipctk = toolkit()
        found = ipctk.Candidates()
        found.build(
            self.surface.mesh, np.asfortranarray(start), np.asfortranarray(end), 0.1 * self.gap, ipctk.LBVH()
        )
        return found

    def _built(self, vertices: np.ndarray, inflation: float) -> Any:
        ipctk = toolkit()
        found = ipctk.Candidates()
        found.build(self.surface.mesh, vertices, inflation, ipctk.LBVH())
        return found

    def _holds(self, vertices: np.ndarray) -> bool:
        """Tell whether the candidates kept hold all pairs nearer than the gap at ``vertices``."""
        if self._anchor is None:
            return False
        return 2.0 * _longest(_apart(vertices - self._anchor)) <= (NEAR - 1.0) * self.gap

    def _far(self, start: np.ndarray, moves: np.ndarray) -> float:
        """Return a share of ``moves`` after which swept triangles are not too many pairs, in (0, 1].

        Bodies fly freely until their boxes meet, and by `REACH` from there on: otherwise a wild direction would sweep
        every triangle across all others, whose pairs fill the memory.
        """
        low, high, mean, bend = [], [], [], []
        for mine in self.members:
            mean.append(moves[mine].mean(axis=0))
            bend.append(_longest(moves[mine] - mean[-1]))
            low.append(start[mine].min(axis=0) - self.gap)
            high.append(start[mine].max(axis=0) + self.gap)
        share = 1.0
        for i in range(len(mean)):
            share = min(share, self.reach[i] / max(bend[i], self.reach[i]))
            for j in range(i):
                wide, relative, reach = bend[i] + bend[j], mean[i] - mean[j], max(self.reach[i], self.reach[j])
                path = float(np.linalg.norm(relative)) + wide
                if path > reach:
                    meets = _box_entry(low[i] - wide, high[i] + wide, low[j], high[j], relative)
                    share = min(share, meets + reach / path)
        return share


def _box_entry(
    low: np.ndarray, high: np.ndarray, other_low: np.ndarray, other_high: np.ndarray, move: np.ndarray
) -> float:
    """Return the share of ``move`` (3,) after which a box first meets another one; inf: never on the way."""
    first, last = 0.0, 1.0
    for a in range(3):
        ahead, behind = other_low[a] - high[a], other_high[a] - low[a]
        if move[a] == 0.0:
            if ahead > 0.0 or behind < 0.0:
                return np.inf
            continue
        enters, leaves = sorted((ahead / move[a], behind / move[a]))
        first, last = max(first, enters), min(last, leaves)
    return first if first <= last else np.inf


def _apart(moves: np.ndarray) -> np.ndarray:
    """Return ``moves`` (n, 3) without what is common to all: distances do not know of that."""
    if not len(moves):
        return moves
    return moves - 0.5 * (moves.min(axis=0) + moves.max(axis=0))


def _longest(moves: np.ndarray) -> float:
    return float(np.sqrt(np.max(np.einsum("ij,ij->i", moves, moves), initial=0.0)))
