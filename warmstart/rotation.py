"""Quaternions (w, x, y, z) and hinge triples in numpy float64, batched over leading axes.

Motions are worked on in float64 on the host; the tensors of the tasks have their own functions in
:mod:`sports.quaternion`.
"""

from __future__ import annotations

import numpy as np


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(..., 4) Hamilton product: the rotation ``b`` first, then ``a``."""
    w = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    v = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([w, v], axis=-1)


def conjugate(a: np.ndarray) -> np.ndarray:
    """(..., 4) inverse of a unit quaternion."""
    return a * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """(..., 3) vector rotated by a unit quaternion."""
    w, u = quat[..., :1], quat[..., 1:]
    t = 2.0 * np.cross(u, vector)
    return vector + w * t + np.cross(u, t)


def exp(phi: np.ndarray) -> np.ndarray:
    """(..., 4) quaternion of a rotation vector (..., 3), rad."""
    half = 0.5 * np.linalg.norm(phi, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * phi * np.sinc(half / np.pi)], axis=-1)


def log(quat: np.ndarray) -> np.ndarray:
    """(..., 3) rotation vector (rad), of length at most pi, of a unit quaternion."""
    quat = np.where(quat[..., :1] < 0, -quat, quat)
    norm = np.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(norm, quat[..., :1])
    return quat[..., 1:] * np.where(norm > 1e-9, angle / np.maximum(norm, 1e-12), 2.0)


def from_hinges(angles: np.ndarray) -> np.ndarray:
    """(..., 4) rotation of a joint with hinges x, y, z (intrinsic X-Y-Z) at ``angles`` (..., 3)."""
    half = 0.5 * angles
    quat = None
    for axis in range(3):
        one = np.zeros((*angles.shape[:-1], 4))
        one[..., 0], one[..., 1 + axis] = np.cos(half[..., axis]), np.sin(half[..., axis])
        quat = one if quat is None else multiply(quat, one)
    assert quat is not None
    return quat


def hinge_rates(angles: np.ndarray, spin: np.ndarray, damping: float = 0.02) -> np.ndarray:
    """(..., 3) hinge rates (rad/s) that give a joint the angular velocity ``spin``.

    ``spin`` (..., 3) is that of the child link against its parent, in the child's frame. At the
    singular pose (second hinge at 90 degrees) the first and third hinge turn about one axis: the
    ``damping`` (cosine of the second hinge at which it acts) keeps the rates bounded there.
    """
    cb, sb = np.cos(angles[..., 1]), np.sin(angles[..., 1])
    cz, sz = np.cos(angles[..., 2]), np.sin(angles[..., 2])
    wx, wy, wz = spin[..., 0], spin[..., 1], spin[..., 2]
    keep = np.abs(cb) > 0.1
    inverse = np.where(keep, 1.0 / np.where(keep, cb, 1.0), cb / (cb * cb + damping**2))
    first = (cz * wx - sz * wy) * inverse
    return np.stack([first, sz * wx + cz * wy, wz - sb * first], axis=-1)


def hinge_spin(angles: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """(..., 3) angular velocity of a joint's child against its parent (rad/s, child's frame) from
    its hinges' ``angles`` and ``rates`` (..., 3): what ``hinge_rates`` inverts."""
    cb, sb = np.cos(angles[..., 1]), np.sin(angles[..., 1])
    cz, sz = np.cos(angles[..., 2]), np.sin(angles[..., 2])
    first, second, third = rates[..., 0], rates[..., 1], rates[..., 2]
    return np.stack(
        [cz * cb * first + sz * second, cz * second - sz * cb * first, sb * first + third], axis=-1
    )


def spin(quat: np.ndarray, fps: float) -> np.ndarray:
    """(T, ..., 3) angular velocity (rad/s, in the rotating frame) of (T, ..., 4) quaternions.

    Central differences of rotations, second order; at both ends extrapolated. T is at least 2.
    """
    step = log(multiply(conjugate(quat[:-1]), quat[1:])) * fps  # at the midpoints
    if len(step) == 1:
        return np.concatenate([step, step])
    middle = log(multiply(conjugate(quat[:-2]), quat[2:])) * (0.5 * fps)
    # Half turns within two frames would be taken the short way round: then use the neighbours.
    fast = np.linalg.norm(step[:-1] + step[1:], axis=-1, keepdims=True) > np.pi * fps
    middle = np.where(fast, 0.5 * (step[:-1] + step[1:]), middle)
    first, last = 1.5 * step[:1] - 0.5 * step[1:2], 1.5 * step[-1:] - 0.5 * step[-2:-1]
    return np.concatenate([first, middle, last])


def right_jacobian(phi: np.ndarray) -> np.ndarray:
    """(..., 3, 3) maps the rate of a rotation vector to angular velocity in the rotating frame.

    Source: Chirikjian, Stochastic Models, Information Theory, and Lie Groups 2 (2011), 10.86.
    """
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    one = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    two = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    cross = np.zeros((*phi.shape[:-1], 3, 3))
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -phi[..., 2], phi[..., 1], -phi[..., 0]
    cross = cross - np.swapaxes(cross, -1, -2)
    return np.eye(3) - one * cross + two * (cross @ cross)
