"""Batched unit quaternions (w, x, y, z) in torch. Every function broadcasts over leading axes.

Results have their components first and the first axis (the worlds) last in memory: what follows
then runs over long rows, which a CPU does several times faster.
"""

from __future__ import annotations

import torch
from torch import Tensor


def stack(parts: tuple[Tensor, ...]) -> Tensor:
    """(..., k) of k tensors (...); laid out as the module says."""
    if parts[0].dim() == 0:
        return torch.stack(parts)
    return torch.stack([p.movedim(0, -1) for p in parts]).movedim((0, -1), (-1, 0))


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """(..., 4) Hamilton product: the rotation ``b`` first, then ``a``."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
    )


def conjugate(q: Tensor) -> Tensor:
    """(..., 4) inverse of a unit quaternion."""
    return torch.cat((q[..., :1], -q[..., 1:]), dim=-1)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """(..., 3) cross product; several times faster than torch's own on a CPU."""
    ax, ay, az = a.unbind(-1)
    bx, by, bz = b.unbind(-1)
    return stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """(..., 3) vector ``v`` rotated by ``q``."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * cross(u, v)
    return v + w * t + cross(u, t)


def matrix(q: Tensor) -> Tensor:
    """(..., 3, 3) rotation matrix of a unit quaternion."""
    w, x, y, z = q.unbind(-1)
    x2, y2, z2 = 2 * x, 2 * y, 2 * z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz = x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    rows = (
        1 - (yy + zz),
        xy - wz,
        xz + wy,
        xy + wz,
        1 - (xx + zz),
        yz - wx,
        xz - wy,
        yz + wx,
        1 - (xx + yy),
    )
    return stack(rows).unflatten(-1, (3, 3))
