"""A toy for AMP: a double integrator that should move like a damped spring.

The demonstrations obey the law a = -K (x - REST) - C v from starts all over the square, and there
is no other reward: the law is the known optimum.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rl.style_features import Demonstrations
from sports.env import StepResult
from tests.rl.toy import DT, PUSH, Integrator

K, C, REST = 0.8, 0.9, 0.3
STEPS = 25
"""Of an episode and of a demonstration: 2.5 s, of which the spring needs about 2."""


def law(state: Tensor) -> Tensor:
    """(..., 2) -> (...) the demonstrations' action."""
    return -K * (state[..., 0] - REST) - C * state[..., 1]


def moved(state: Tensor, action: Tensor) -> Tensor:
    """(..., 2) the state a step later under an action (...)."""
    x, v = state.unbind(-1)
    return torch.stack((x + DT * v, v + PUSH * DT * action), -1)


def starts(count: int, generator: torch.Generator) -> Tensor:
    """(count, 2) places and speeds within +-0.7."""
    return 1.4 * torch.rand(count, 2, generator=generator) - 0.7


def demonstrations(frames: int, count: int = 64) -> Demonstrations:
    """All windows of ``count`` motions of the law, the start itself not among them."""
    states, begins = [], []
    state = starts(count, torch.Generator().manual_seed(99))
    for _ in range(STEPS):
        state = moved(state, law(state))
        states.append(state)
    for clip in range(count):
        begins.append(clip * STEPS + torch.arange(STEPS - frames + 1))
    rows = torch.cat(begins)
    all_states = torch.stack(states, 1).flatten(0, 1)
    return Demonstrations(all_states, rows, torch.ones(len(rows), dtype=torch.bool))


class Spring(Integrator):
    """Pays nothing; shows its states as a source of AMP."""

    state_size = 2

    def __init__(self, num_worlds: int, seed: int) -> None:
        super().__init__(num_worlds, seed, STEPS)
        self.final = torch.zeros(num_worlds, 2)

    def _draw(self) -> Tensor:
        return starts(self.num_worlds, self.generator)

    def step(self, action: Tensor) -> StepResult:
        result = super().step(action)
        self.final = result.final_obs[:, 0].clone()
        result.reward = torch.zeros_like(result.reward)
        return result

    def state(self) -> Tensor:
        return self.final

    def features(self, state: Tensor) -> Tensor:
        return state
