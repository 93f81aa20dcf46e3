"""Where the fingers of a gripper stand: finger frame to gripper frame.

The gripper's axis is z, up; the fingers hang down around it, evenly, their contact faces towards the axis.
"""

from __future__ import annotations

import numpy as np


def placement(index: int, count: int, spacing: float, base_height: float = 0.0) -> np.ndarray:
    """Return the (4, 4) rigid motion that takes finger ``index`` of ``count`` to its place.

    The finger's x becomes the outward radius e_r at azimuth 2 pi index / count, y (base to tip) becomes -z, and z
    the tangent e_phi. Its origin lands at radius ``spacing`` [m], height ``base_height`` [m].

    >>> np.round(placement(0, 3, 0.04, 0.1) @ [0.0, 0.09, 0.0, 1.0], 12)  # a point 90 mm down the contact side
    array([0.04, 0.  , 0.01, 1.  ])
    """
    azimuth = 2.0 * np.pi * index / count
    radial = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    matrix = np.eye(4)
    matrix[:3, 0] = radial
    matrix[:3, 1] = (0.0, 0.0, -1.0)
    matrix[:3, 2] = (-np.sin(azimuth), np.cos(azimuth), 0.0)
    matrix[:3, 3] = spacing * radial + (0.0, 0.0, base_height)
    return matrix
