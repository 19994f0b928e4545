"""The one heading frame: origin at the root, z up, x along the athlete's yaw.

Proprioception and goal features both use it, so a policy sees the same world whatever its
place and direction on the field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from sports.physics.base import Physics


class Heading:
    """Rotates world vectors into the heading frames of the athletes."""

    def __init__(self, root_rot: Tensor) -> None:
        """``root_rot`` (N, A, 3, 3) R_WB."""
        angle = torch.atan2(root_rot[..., 1, 0], root_rot[..., 0, 0])
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


def fill_proprioception(
    rows: Tensor, cos: Tensor, sin: Tensor, pos: Tensor, rot: Tensor, linvel: Tensor, angvel: Tensor
) -> None:
    """Writes :func:`proprioception` of one athlete into ``rows`` (15 B - 2, N), from its heading
    ``cos`` and ``sin`` (N), its links' positions and velocities (3, B, N) and R_WB (3, 3, B, N).

    Components come first and worlds last: a row for each number is quick on a CPU, three numbers
    for each row are not.
    """
    rows[0] = pos[2, 0]
    at = 1
    for vectors in (pos[:, 1:] - pos[:, :1], rot[:, :2].swapaxes(1, 2), linvel, angvel):
        x, y, z = vectors[0], vectors[1], vectors[2]  # (..., N)
        size = 3 * math.prod(x.shape[:-1])
        block = rows[at : at + size].reshape(*x.shape[:-1], 3, x.shape[-1])
        block[..., 0, :] = cos * x + sin * y
        block[..., 1, :] = cos * y - sin * x
        block[..., 2, :] = z
        at += size


def proprioception(physics: Physics, heading: Heading, more: Sequence[Tensor] = ()) -> Tensor:
    """(N, A, 15 B - 2) what an athlete feels of its own body: SMPL 358, SMPL-X 778.

    Order: root height; link positions relative to the root; link rotations in 6-D (first two
    columns of the rotation matrix, Zhou et al. 2019); linear and angular velocities; all but
    the height in the heading frame. ``more``: (N, A, k) features to append.
    """
    n, agents, links = physics.body_pos.shape[:3]
    at = 15 * links - 2
    obs = physics.body_pos.new_empty(n, agents, at + sum(f.shape[-1] for f in more))
    felt = physics.felt
    if felt is None:
        pos, linvel, angvel = (
            v.permute(1, 3, 2, 0)
            for v in (physics.body_pos, physics.body_linvel, physics.body_angvel)
        )
        rot = physics.body_rot.permute(1, 3, 4, 2, 0)
        rows = physics.body_pos.new_empty(agents, at, n)
        for a in range(agents):
            cos, sin = heading.cos[:, a], heading.sin[:, a]
            fill_proprioception(rows[a], cos, sin, pos[a], rot[a], linvel[a], angvel[a])
        felt = rows.permute(2, 0, 1)
    obs[..., :at] = felt
    for features in more:
        obs[..., at : at + features.shape[-1]] = features
        at += features.shape[-1]
    return obs
