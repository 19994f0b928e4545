"""Hinge angles that an observation shows: what a latent prior's PD targets are offsets from.

A servo pulls by the difference of its target and its hinge's angle, and a person's targets are
near the pose. Observations show rotations of links in the heading frame, of which angles are a
known but crooked function: a decoder that has to learn it spends its weights and its time on that.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rl.tracking_terms import wrapped
from sports.humanoid.body import Body
from sports.turns import nearest_turn

SHOWN = 10.0
"""Differences of angles, in action units, are shown to the encoder times this: near unit size."""


def rotations(columns: Tensor) -> Tensor:
    """(..., 6) first two columns of a rotation matrix, roughly -> (..., 3, 3), by Gram-Schmidt
    (Zhou et al. 2019)."""
    first, second = columns.float().unflatten(-1, (2, 3)).unbind(-2)
    first = first / torch.linalg.vector_norm(first, dim=-1, keepdim=True).clamp(min=1e-6)
    second = second - (first * second).sum(-1, keepdim=True) * first
    second = second / torch.linalg.vector_norm(second, dim=-1, keepdim=True).clamp(min=1e-6)
    return torch.stack((first, second, torch.linalg.cross(first, second, dim=-1)), -1)


def joint_angles(rot: Tensor, parents: Tensor) -> Tensor:
    """(..., B, 3, 3) rotations of links in one frame -> (..., 3 (B - 1)) hinge angles (rad) of
    R_parent^T R_link = Rx(a) Ry(b) Rz(c), of two triples the one nearer to zero.

    ``parents`` (B,): of each link; that of the first, the root, is not read.
    """
    above = rot[..., parents[1:], :, :]
    # Sums of products, not a matrix product: autocast must not round it to bf16.
    local = (above[..., :, :, None] * rot[..., 1:, :, None, :]).sum(-3)
    b = torch.asin(local[..., 0, 2].clamp(-1.0, 1.0))
    a = torch.atan2(-local[..., 1, 2], local[..., 2, 2])
    c = torch.atan2(-local[..., 0, 1], local[..., 0, 0])
    angles = torch.stack((a, b, c), -1).flatten(-2)
    return nearest_turn(angles, torch.zeros_like(angles))[0]


class PosePart(nn.Module):
    """Pose of the athlete, and of the reference against it, from normalised observations.

    Its buffers are no part of a state: body and normaliser are kept elsewhere.
    """

    parents: Tensor
    scale: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, body: Body, own: slice, mean: Tensor, std: Tensor) -> None:
        """Args:
        body: whose links the observations show.
        own: where in them the rotations of its links stand; those of a reference come last.
        mean: (D,) or (S,) of the normaliser.
        std: likewise.

        Raises ValueError unless every link but the root hangs on three hinges.
        """
        super().__init__()
        if [dof.link for dof in body.dofs] != [n for n in body.link_names[1:] for _ in range(3)]:
            raise ValueError(f"body '{body.name}' has joints of other than three hinges")
        self.own = own
        self.size = own.stop - own.start
        self.register_buffer("parents", torch.as_tensor(body.parents()), persistent=False)
        scale = torch.tensor(body.action_scale(), dtype=torch.float32)
        self.register_buffer("scale", scale, persistent=False)
        self.register_buffer("mean", mean.detach().float().cpu().clone(), persistent=False)
        self.register_buffer("std", std.detach().float().cpu().clone(), persistent=False)

    def _angles(self, obs: Tensor, where: slice) -> Tensor:
        raw = obs[..., where].float() * self.std[where] + self.mean[where]
        return joint_angles(rotations(raw.unflatten(-1, (-1, 6))), self.parents)

    @torch.no_grad()
    def pose(self, obs: Tensor) -> Tensor:
        """(..., >= S) normalised -> hinge angles (..., n) over the action scale, float32."""
        return self._angles(obs, self.own) / self.scale

    @torch.no_grad()
    def as_seen(self, obs: Tensor, action: Tensor) -> Tensor:
        """(..., >= S) normalised, actions (..., n) -> actions with targets of the same rotations,
        on the turn of the pose that the observation shows."""
        near = self._angles(obs, self.own)
        return nearest_turn(action * self.scale, near)[0] / self.scale

    @torch.no_grad()
    def difference(self, obs: Tensor) -> Tensor:
        """(..., D) normalised -> (..., n): hinge angles of the reference less the athlete's, the
        short way round, over the action scale and times ``SHOWN``."""
        end = obs.shape[-1]
        own = self._angles(obs, self.own)
        goal = self._angles(obs, slice(end - self.size, end))
        goal, _ = nearest_turn(goal, own)
        return SHOWN * wrapped(goal - own) / self.scale
