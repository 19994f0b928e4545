"""A cost of sinking into the ground, for motion that meets it as people do.

The simulated ground yields (docs/physics.md). Under people it yields by up to 2.4 cm
(results/likeness_effort.json), under who lands harder by more. A hard impact sinks in, but so does
a foot that comes down stretched under what running takes: of a hurdler's frames that are deeper
than 2.5 cm two in five have no more than four body weights on a link, and no cost of impacts that
leaves running free sees them.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rl.impact import of_running

CENTIMETRE = 0.01


class SinkingCost:
    """-weight x the centimetres by which the athlete's lowest point is deeper than a limit, up to a
    most."""

    def __init__(self, env: Any, weight: float, limit: float, most: float) -> None:
        """Args:
        env: environment whose athletes are watched.
        weight: unscaled reward per step and centimetre of excess.
        limit: depth (m) that costs nothing.
        most: depth (m) beyond the limit from which on no more costs more.

        Raises ValueError for a ground that is not flat.
        """
        scene = env.physics.scene
        if scene.has_waves:
            raise ValueError("--sinking is measured from a flat ground, and this task's has waves")
        self.env, self.weight, self.limit, self.most = env, weight, limit, most
        self.down = torch.tensor([0.0, 0.0, -1.0], device=env.device)

    def __call__(self, result: Any) -> Tensor:
        """(N, A) bonus, never positive, of the step just taken; 0 where the world was reset."""
        depth = self.env.physics.extent(self.down).amax(-1)  # (N, A)
        excess = (depth - self.limit).clamp(0.0, self.most)
        return of_running(result, -self.weight / CENTIMETRE * excess)
