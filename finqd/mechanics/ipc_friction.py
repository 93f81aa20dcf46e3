r"""Friction of incremental potential contact: Coulomb's law at lagged normal forces, smooth about no slip.

.. math:: E = \\mu N f_0(|s|), \\quad f_0' = f_1(y) = 2 y/\\epsilon - y^2/\\epsilon^2 \\text{ for } y < \\epsilon,
    \\text{ else } 1

with the tangential slip s since the start of the step. Source: Li et al., Incremental Potential Contact, ACM Trans.
Graph. 39 (2020) 49, equations 10 to 15, where epsilon is a speed times the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class ContactRows:
    """Contacts at one state, m of them: between up to four points, of which weights sum to 0 (to 1 on a plane).

    points: their numbers, 0 where there are fewer, whose weight is 0, shape (m, 4)
    weights: of the points in the distance vector from the second body to the first, shape (m, 4)
    normal: unit vector out of the second body, shape (m, 3); force: normal force [N], shape (m,)
    bodies: numbers of both, shape (m, 2)
    """

    points: np.ndarray
    weights: np.ndarray
    normal: np.ndarray
    force: np.ndarray
    bodies: np.ndarray

    @classmethod
    def empty(cls) -> ContactRows:
        """Return no contacts."""
        ids, numbers = np.zeros((0, 4), dtype=np.int64), np.zeros((0, 4))
        return cls(points=ids, weights=numbers, normal=numbers[:, :3], force=numbers[:, 0], bodies=ids[:, :2])

    def joined(self, other: ContactRows) -> ContactRows:
        """Return these contacts and ``other`` ones after them."""
        names = ("points", "weights", "normal", "force", "bodies")
        return ContactRows(**{name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names})

    def shares(self, values: np.ndarray, n_points: int) -> np.ndarray:
        """Return what each point takes of the contacts' ``values`` (m,), (n_points,): steady when they slide."""
        found = np.zeros(n_points)
        np.add.at(found, self.points, np.abs(self.weights) * values[:, None])
        return found

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the mean of ``values`` (n_points,) over the points of each contact, by their weights, (m,)."""
        weights = np.abs(self.weights)
        return np.sum(weights * values[self.points], axis=1) / np.sum(weights, axis=1)


class Friction:
    """Friction of ``rows`` of contacts at fixed bounds mu N.

    bound: mu N of each row [N], shape (m,); start: points at the start of the step [m], (n_points, 3)
    slip: below which friction is not full yet [m]
    """

    def __init__(self, rows: ContactRows, bound: np.ndarray, *, start: np.ndarray, slip: float) -> None:
        used = bound > 0.0
        self.points, self.weights, self.bound = rows.points[used], rows.weights[used], bound[used]
        self.bases = tangents(rows.normal[used])
        self.start, self.slip = start, slip

    def energy(self, places: np.ndarray) -> float:
        """Return the friction energy [J] with points at ``places`` (n_points, 3); nothing without slip."""
        y, e = self._slips(places)[1], self.slip
        inside = np.minimum(y, e)
        return float(np.sum(self.bound * (inside**2 / e - inside**3 / (3.0 * e**2) + y - inside)))

    def gradient(self, places: np.ndarray) -> np.ndarray:
        """Return the derivatives of the energy [N], shape (n_points, 3)."""
        slips, y = self._slips(places)
        force = np.einsum("mxt,mt->mx", self.bases, (self.bound * self._rate(y))[:, None] * slips)
        found = np.zeros_like(places)
        np.add.at(found, self.points, self.weights[:, :, None] * force[:, None, :])
        return found

    def hessian(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs of points (k, 2) and their second derivatives (k, 3, 3) [N/m]; it is positive semidefinite."""
        slips, y = self._slips(places)
        rate, e = self._rate(y), self.slip
        # f_2 - f_1 / y, over y^2: -1 / (y e^2) inside, -1 / y^3 outside
        bend = np.where(y < e, -1.0 / (np.maximum(y, 1e-9 * e) * e**2), -1.0 / np.maximum(y, e) ** 3)
        flat = rate[:, None, None] * np.eye(2) + bend[:, None, None] * slips[:, :, None] * slips[:, None, :]
        matrix = self.bases @ (self.bound[:, None, None] * flat) @ self.bases.transpose(0, 2, 1)
        products = self.weights[:, :, None] * self.weights[:, None, :]
        blocks = products[:, :, :, None, None] * matrix[:, None, None]
        pairs = np.stack(np.broadcast_arrays(self.points[:, :, None], self.points[:, None, :]), axis=-1)
        used = products.reshape(-1) != 0.0
        return pairs.reshape(-1, 2)[used], blocks.reshape(-1, 3, 3)[used]

    def _slips(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return tangential slips [m], (m, 2), and their lengths."""
        moves = (places - self.start)[self.points]
        slips = np.einsum("mxt,mk,mkx->mt", self.bases, self.weights, moves)
        return slips, np.linalg.norm(slips, axis=1)

    def _rate(self, y: np.ndarray) -> np.ndarray:
        """Return f_1(y) / y [1/m]."""
        e = self.slip
        return np.where(y < e, (2.0 - y / e) / e, 1.0 / np.maximum(y, e))


def tangents(normals: np.ndarray) -> np.ndarray:
    """Return two unit vectors across each of ``normals`` (m, 3), as columns, shape (m, 3, 2)."""
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)] if len(normals) else normals
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], axis=2)
