"""Numbers of all contacts that a scene may have, by which history is kept, and the friction of each."""

from __future__ import annotations

import numpy as np

from finqd.mechanics.contact_rows import Rows
from finqd.mechanics.contact_surface import ContactSurface
from finqd.scene import Scene


class ContactPairs:
    """The keys of possible contacts: soft sample and rigid body or plane, rigid support point and plane.

    first_key: of each pair, by kind and numbers: ("rigid", r), ("plane", p), ("support", r, p); ("soft", 0) is where
    samples in touch with other soft faces begin
    """

    def __init__(self, scene: Scene, surface: ContactSurface) -> None:
        self.surface = surface
        self.first_key: dict[tuple, int] = {}
        starts, self._friction = [], []
        count = 0
        for kind, others in (("rigid", scene.rigid_bodies), ("plane", scene.planes)):
            for i, other in enumerate(others):
                self.first_key[kind, i] = count
                starts.append(count)
                self._friction.append([scene.friction_between(b.name, other.name) for b in scene.soft_bodies])
                count += surface.n_samples
        for r, rigid in enumerate(scene.rigid_bodies):
            for p, plane in enumerate(scene.planes):
                self.first_key["support", r, p] = count
                starts.append(count)
                self._friction.append([scene.friction_between(rigid.name, plane.name)])
                count += max(len(rigid.shape.support_points), 1)
        self.first_key["soft", 0] = count
        self._starts = np.array(starts, dtype=np.int64)

    def coefficients(self, rows: Rows) -> np.ndarray:
        """Return Coulomb's coefficient of each row, shape (count,)."""
        face, found = rows.face[: rows.count], np.zeros(rows.count)
        body = np.where(face >= 0, self.surface.face_body[face], 0) if len(self.surface.faces) else face + 1
        pair = np.searchsorted(self._starts, rows.key[: rows.count], side="right") - 1
        for p in np.unique(pair):
            mine = pair == p
            found[mine] = np.array(self._friction[p])[body[mine]]
        return found
