"""A reward for moving like the demonstrations, to begin with; it fades over the run.

The distance of a posture is to the *nearest* reference frame, so no clock has to be kept: root
velocity is part of a posture, hence standing still in a flying pose does not match.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

SPEED_WEIGHT = 0.02
"""Squared distance of 1 m/s of root velocity, in rad^2 of mean squared joint difference."""
HEIGHT_WEIGHT = 1.0
"""Squared distance of 1 m of root height, likewise."""


def posture(qpos: Tensor, qvel: Tensor) -> Tensor:
    """(..., K) features whose squared distance is a mean squared joint difference.

    Args:
        qpos: (..., 7 + n) of one athlete
        qvel: (..., 6 + n)

    Joint angles enter as (cos, sin): |difference|^2 = 2 (1 - cos dq), about dq^2, at any wrap.
    The root's attitude enters as the first two columns of its rotation matrix; it and the
    velocity are in the world frame, as tasks place their demonstrations there.
    """
    joints = qpos[..., 7:]
    w, x, y, z = qpos[..., 3:7].unbind(-1)
    columns = (
        1 - 2 * (y * y + z * z),
        2 * (x * y + w * z),
        2 * (x * z - w * y),
        2 * (x * y - w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z + w * x),
    )
    return torch.cat(
        (
            joints.cos() / joints.shape[-1] ** 0.5,
            joints.sin() / joints.shape[-1] ** 0.5,
            torch.stack(columns, -1) * 0.3,
            qpos[..., 2:3] * HEIGHT_WEIGHT**0.5,
            qvel[..., :3] * SPEED_WEIGHT**0.5,
        ),
        dim=-1,
    )


class Imitation:
    """exp(-sharpness d^2) of agent 0 to the nearest frame, times a weight that training fades."""

    def __init__(self, env: Any, weight: float, sharpness: float) -> None:
        """Args:
        env: environment with ``starts``; its snapshots are switched on.
        weight: reward per step (unscaled) at distance 0.
        sharpness: per rad^2.
        """
        env.keep_snapshot = True
        self.env, self.sharpness = env, sharpness
        self.frames = posture(env.starts.qpos, env.starts.qvel)
        self.weight = torch.tensor(float(weight), device=env.device)
        """() on the device; set it in place."""

    def __call__(self, result: Any) -> Tensor:
        """(N, A) bonus of the step just taken."""
        scene, last = self.env.physics.scene, self.env.final_snapshot
        qpos = last["qpos"][:, scene.agent_qpos(0)]
        qvel = last["qvel"][:, scene.agent_qvel(0)]
        features = torch.nan_to_num(posture(qpos, qvel))
        nearest = torch.cdist(features, self.frames).amin(-1)
        bonus = torch.zeros_like(result.reward)
        bonus[:, 0] = self.weight * torch.exp(-self.sharpness * nearest.square()) * result.valid
        return bonus
