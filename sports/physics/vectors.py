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


def rotation(quat: np.ndarray, out: np.ndarray) -> np.ndarray:
    """Writes the (3, 3, ...) matrices of unit quaternions (4, ...) to ``out`` and returns it."""
    w, vector = quat[0], quat[1:]
    twice = vector + vector
    xx, yy, zz = vector * twice
    wx, wy, wz = w * twice
    xy, yz, zx = vector * twice[[1, 2, 0]]
    np.subtract(1, yy + zz, out=out[0, 0])
    np.subtract(1, xx + zz, out=out[1, 1])
    np.subtract(1, xx + yy, out=out[2, 2])
    np.subtract(xy, wz, out=out[0, 1])
    np.add(xy, wz, out=out[1, 0])
    np.add(zx, wy, out=out[0, 2])
    np.subtract(zx, wy, out=out[2, 0])
    np.subtract(yz, wx, out=out[1, 2])
    np.add(yz, wx, out=out[2, 1])
    return out
