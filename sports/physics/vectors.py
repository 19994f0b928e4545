"""Vectors and quaternions in numpy, components first: (3, ...) and (4, ...)."""

from __future__ import annotations

import numpy as np


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(3, ...) cross product; ``a`` broadcasts to ``b``."""
    out = np.empty_like(b)
    (x, y, z), (u, v, w) = a, b
    out[0] = y * w - z * v
    out[1] = z * u - x * w
    out[2] = x * v - y * u
    return out


def rotation(quat: np.ndarray) -> np.ndarray:
    """(3, 3, ...) matrices of unit quaternions (4, ...)."""
    w, x, y, z = quat
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz = x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    out = np.empty((3, 3, *quat.shape[1:]), quat.dtype)
    out[0, 0], out[0, 1], out[0, 2] = 1 - (yy + zz), xy - wz, xz + wy
    out[1, 0], out[1, 1], out[1, 2] = xy + wz, 1 - (xx + zz), yz - wx
    out[2, 0], out[2, 1], out[2, 2] = xz - wy, yz + wx, 1 - (xx + yy)
    return out
