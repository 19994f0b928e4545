"""The one heading frame: origin at the root, z up, x along the athlete's yaw.

Proprioception and goal features both use it, so a policy sees the same world whatever its
place and direction on the field.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sports import quaternion
from sports.physics.base import Physics


class Heading:
    """Rotates world vectors into the heading frames of the athletes."""

    def __init__(self, root_quat: Tensor) -> None:
        """``root_quat`` (N, A, 4)."""
        angle = quaternion.yaw(root_quat)
        self.cos, self.sin = torch.cos(angle), torch.sin(angle)

    def local(self, v: Tensor) -> Tensor:
        """(N, A, ..., 3) world vectors seen from the heading frame."""
        shape = self.cos.shape + (1,) * (v.dim() - self.cos.dim() - 1)
        c, s = self.cos.view(shape), self.sin.view(shape)
        x, y, z = v.unbind(-1)
        ahead, left = torch.addcmul(c * x, s, y), torch.addcmul(c * y, s, x, value=-1)
        return torch.stack((ahead, left, z), dim=-1)


def proprioception_slices(num_links: int) -> dict[str, slice]:
    """Named layout of :func:`proprioception` for a body with ``num_links`` links."""
    sizes = {
        "root_height": 1,
        "body_pos": 3 * (num_links - 1),
        "body_rot": 6 * num_links,
        "body_linvel": 3 * num_links,
        "body_angvel": 3 * num_links,
    }
    slices, at = {}, 0
    for name, size in sizes.items():
        slices[name] = slice(at, at + size)
        at += size
    return slices


def proprioception(physics: Physics, heading: Heading, more: Sequence[Tensor] = ()) -> Tensor:
    """(N, A, 15 B - 2) what an athlete feels of its own body: SMPL 358, SMPL-X 778.

    Order: root height; link positions relative to the root; link rotations in 6-D (first two
    columns of the rotation matrix, Zhou et al. 2019); linear and angular velocities; all but
    the height in the heading frame. ``more``: (N, A, k) features to append.
    """
    n, a, b = physics.body_pos.shape[:3]
    root = physics.body_pos[:, :, :1]
    # A row for each number, over the worlds: long rows are quick on a CPU.
    size = 15 * b - 2 + sum(x.shape[-1] for x in more)
    rows = physics.body_pos.new_empty(a, size, n)
    rows[:, 0] = root[:, :, 0, 2].T
    parts = (
        physics.body_pos[:, :, 1:] - root,
        physics.body_rot.transpose(-1, -2)[:, :, :, :2],
        physics.body_linvel,
        physics.body_angvel,
    )
    at = 1
    for part in parts:  # (N, A, ..., 3)
        x, y, z = part.movedim((-1, 0), (0, -1))  # (A, ..., N)
        block = rows[:, at : at + part[0, 0].numel()].view(*x.shape[:-1], 3, n)
        c, s = (v.T.view(a, *[1] * (x.dim() - 2), n) for v in (heading.cos, heading.sin))
        torch.addcmul(c * x, s, y, out=block[..., 0, :])
        torch.addcmul(c * y, s, x, value=-1, out=block[..., 1, :])
        block[..., 2, :] = z
        at += part[0, 0].numel()
    for features in more:
        rows[:, at : at + features.shape[-1]] = features.permute(1, 2, 0)
        at += features.shape[-1]
    return rows.flatten(0, 1).T.contiguous().unflatten(1, (a, -1))
