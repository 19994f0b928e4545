"""A cost of hard impacts with the ground, for motion that holds in every engine and time step.

A hard impact is where a coarse time step errs most (docs/physics.md): athletes whose strength
allows it learn to live on that error, bouncing from impacts of ten and more body weights, and then
hold in no other engine. People sprint at 3 to 5 body weights and jump off at about 10.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sports.physics.base import GRAVITY

MOST = 30.0
"""Body weights counted for one link: beyond, an impact is as bad as it can be."""


class ImpactCost:
    """-weight x the body weights by which each link's ground force exceeds a limit, summed."""

    def __init__(self, env: Any, weight: float, limit: float) -> None:
        """Args:
        env: environment whose athletes' ground forces are read.
        weight: unscaled reward per step and body weight of excess.
        limit: body weights that cost nothing.
        """
        self.env, self.weight, self.limit = env, weight, limit
        body = env.physics.scene.body
        self.unit = GRAVITY * body.mass
        """One body weight (N)."""

    def __call__(self, result: Any) -> Tensor:
        """(N, A) bonus, never positive, of the step just taken; 0 where the world was reset."""
        force = self.env.physics.ground_force.norm(dim=-1) / self.unit  # (N, A, B)
        excess = (force - self.limit).clamp(0.0, MOST)
        return of_running(result, -self.weight * excess.sum(-1))


def of_running(result: Any, bonus: Tensor) -> Tensor:
    """(N, A) bonus of a step, 0 where the world was reset or diverged: what is measured there may
    be no numbers, and must not reach any mean."""
    running = ~result.ended & result.valid
    return torch.where(running[:, None], bonus, 0.0)
