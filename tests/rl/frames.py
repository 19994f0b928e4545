"""Sources of motion for tests of AMP, and results of steps that go with them."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor


class Draws:
    """M rows of independent normal numbers as states and features; ``draw`` for the next ones."""

    def __init__(self, rows: int, size: int, seed: int) -> None:
        self.shape, self.state_size = (rows, size), size
        self.generator = torch.Generator().manual_seed(seed)
        self.draw()

    def draw(self) -> None:
        self.now = torch.randn(self.shape, generator=self.generator)

    def state(self) -> Tensor:
        return self.now

    def features(self, state: Tensor) -> Tensor:
        return state


def step_result(
    worlds: int,
    agents: int,
    reward: float = 0.0,
    ended: Tensor | None = None,
    valid: Tensor | None = None,
) -> SimpleNamespace:
    """What AMP reads of a StepResult: by default nothing ends and nothing diverges."""
    no = torch.zeros(worlds, dtype=torch.bool)
    return SimpleNamespace(
        reward=torch.full((worlds, agents), reward),
        ended=no if ended is None else ended,
        valid=~no if valid is None else valid,
    )
