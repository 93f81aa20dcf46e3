"""Rotations as matrices and rotation vectors."""

import math

import numpy as np

from finqd.mechanics.compiled import njit


@njit(cache=True)
def skew(v, out):
    """Write the matrix of the cross product, ``out @ w = v x w``; ``v`` shape (3,), ``out`` shape (3, 3)."""
    out[0, 0] = out[1, 1] = out[2, 2] = 0.0
    out[0, 1], out[0, 2] = -v[2], v[1]
    out[1, 0], out[1, 2] = v[2], -v[0]
    out[2, 0], out[2, 1] = -v[1], v[0]


@njit(cache=True)
def rotation_matrix(v):
    r"""Return exp([v]) of a rotation vector v [rad], shape (3, 3).

    Rodrigues: R = I + a [v] + b [v]^2 with a = sin(t)/t, b = (1 - cos t)/t^2, t = |v|.
    """
    t2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    t = math.sqrt(t2)
    if t < 1e-4:
        a, b = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0
    else:
        a, b = math.sin(t) / t, (1.0 - math.cos(t)) / t2
    k = np.empty((3, 3))
    skew(v, k)
    r = b * (k @ k) + a * k
    for i in range(3):
        r[i, i] += 1.0
    return r


@njit(cache=True)
def rotation_vector(r):
    """Return the rotation vector [rad], |v| <= pi, of a rotation matrix ``r``; the inverse of `rotation_matrix`.

    The vector is read off the quaternion, whose largest component is taken first (Shepperd 1978), so that neither
    small angles nor angles near pi lose digits.
    """
    q = np.empty(4)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    d = np.array([trace, r[0, 0], r[1, 1], r[2, 2]])
    i = np.argmax(d)
    if i == 0:
        q[0] = 1.0 + trace
        q[1], q[2], q[3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    else:
        a = i - 1
        b, c = (a + 1) % 3, (a + 2) % 3
        q[0] = r[c, b] - r[b, c]
        q[1 + a] = 1.0 + r[a, a] - r[b, b] - r[c, c]
        q[1 + b] = r[b, a] + r[a, b]
        q[1 + c] = r[c, a] + r[a, c]
    norm = math.sqrt(np.sum(q * q))
    if q[0] < 0.0:
        norm = -norm
    q /= norm
    s = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    factor = 2.0 if s < 1e-9 else 2.0 * math.atan2(s, q[0]) / s
    return factor * q[1:]


@njit(cache=True)
def inverse_left_jacobian(v):
    r"""Return T^-1 with d v = T^-1 d phi, where exp([v]) changes to exp([d phi]) exp([v]); shape (3, 3).

    T^-1 = I - [v]/2 + (1/t^2 - (1 + cos t)/(2 t sin t)) [v]^2, t = |v| (Barfoot, State Estimation for Robotics, 7.1).
    """
    t2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    t = math.sqrt(t2)
    c = 1.0 / 12.0 + t2 / 720.0 if t < 1e-3 else 1.0 / t2 - (1.0 + math.cos(t)) / (2.0 * t * math.sin(t))
    k = np.empty((3, 3))
    skew(v, k)
    out = c * (k @ k) - 0.5 * k
    for i in range(3):
        out[i, i] += 1.0
    return out
