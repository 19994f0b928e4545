"""A contest with a known optimum, with the interface of sports.env.Env.

Each athlete is shown a number x and says a number; who is nearer to ``law(x)`` in an episode, all
steps together, has won. What one gains the other loses, and saying law(x) is the best against
everybody. A team of two says its mean. Run as a script it trains, so that tests can kill it:
``contest.py OUT SAMPLES [--resume]``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from rl.networks import MLP
from rl.policy import Policy
from rl.ppo import PPOConfig
from rl.selfplay import SelfPlayConfig
from rl.train import TrainConfig, train
from sports.env import StepResult


def law(x: Tensor) -> Tensor:
    return 0.8 * x - 0.1


class Contest:
    """N worlds, 2 ``half`` agents; obs (x, clock); no randomness but x."""

    def __init__(self, num_worlds: int, seed: int = 0, half: int = 1, max_steps: int = 4) -> None:
        self.num_worlds, self.half, self.num_agents = num_worlds, half, 2 * half
        self.obs_size, self.action_size = 2, 1
        self.reward_scale, self.max_steps = 1.0, max_steps
        self.device = torch.device("cpu")
        self.metric_names = ("success",)
        self.obs_slices = {"x": slice(0, 1), "clock": slice(1, 2)}
        self.curriculum: dict[str, Tensor] = {}
        self.starts = None
        self.task = SimpleNamespace(name="contest", body="none", metrics={"success": "fraction"})
        self.generator = torch.Generator().manual_seed(seed)
        self.x = torch.zeros(num_worlds, self.num_agents)
        self.age = torch.zeros(num_worlds, dtype=torch.long)
        self.margin = torch.zeros(num_worlds)

    def reset(self) -> Tensor:
        self.x = self._draw()
        self.age = torch.arange(self.num_worlds) % self.max_steps
        self.margin.zero_()
        return self._obs()

    def _draw(self) -> Tensor:
        """The same numbers for both sides."""
        x = torch.rand(self.num_worlds, self.half, generator=self.generator) * 2.0 - 1.0
        return x.repeat(1, 2)

    def _obs(self) -> Tensor:
        clock = (self.age / self.max_steps)[:, None].expand_as(self.x)
        return torch.stack((self.x, clock), -1)

    def step(self, action: Tensor) -> StepResult:
        off = (action[..., 0] - law(self.x)).unflatten(1, (2, self.half)).mean(-1).abs()  # (N, 2)
        gain = off[:, 1] - off[:, 0]
        self.margin = self.margin + gain
        self.age = self.age + 1
        ended = self.age >= self.max_steps
        self.x = self._draw()
        final = self._obs()
        metrics = {"success": (self.margin > 0).float()}
        outcome = self.margin.sign()
        self.age = torch.where(ended, 0, self.age)
        self.margin = torch.where(ended, 0.0, self.margin)
        reward = torch.stack((gain, -gain), 1).repeat_interleave(self.half, 1)
        no = torch.zeros(self.num_worlds, dtype=torch.bool)
        return StepResult(
            obs=self._obs(),
            final_obs=final,
            reward=reward,
            terms={"margin": reward},
            terminated=ended[:, None].expand(-1, self.num_agents),
            truncated=no[:, None].expand(-1, self.num_agents),
            valid=~no,
            remaining_paid=torch.zeros(self.num_worlds),
            metrics=metrics,
            outcome=outcome,
        )

    def state_dict(self) -> dict[str, Tensor]:
        state = {"x": self.x, "age": self.age, "margin": self.margin}
        return state | {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> Tensor:
        self.x, self.age, self.margin = state["x"], state["age"], state["margin"]
        self.generator.set_state(state["generator"])
        return self._obs()

    def close(self) -> None:
        pass


def speaker(bias: float, name: str = "contest", seed: int = 0) -> Policy:
    """A policy that always says nearly ``bias``; a little off, so that no two are equal."""
    actor = MLP(2, (4,), 1, "tanh", 0.01, torch.Generator().manual_seed(seed))
    torch.nn.init.constant_(actor.head.bias, bias)
    card: dict[str, Any] = {
        "task": name,
        "algo": "ppo",
        "sha256": f"{bias}",
        "obs_size": 2,
        "action_size": 1,
        "observation_clip": 5.0,
    }
    return Policy(actor.requires_grad_(False), torch.zeros(2), torch.ones(2), card)


SMALL = PPOConfig(
    hidden=(16,),
    steps=8,
    minibatches=4,
    epochs=4,
    gamma=0.9,
    sigma=0.2,
    learning_rate=3e-3,
    critic_learning_rate=3e-3,
    kl_band=None,
)
FEW = SelfPlayConfig(pool=6, snapshot_samples=2000, ladder=(4000, 12000), swap=4)


def contest_config(out: Path, **changes: Any) -> TrainConfig:
    defaults: dict[str, Any] = {
        "task": "contest",
        "algo": "selfplay",
        "worlds": 48,
        "samples": 8 * 576,
        "quiet": True,
        "ppo": SMALL,
        "selfplay": FEW,
    }
    return TrainConfig(out=out, **{**defaults, **changes})


def contest_env(config: TrainConfig, seed: int) -> Contest:
    return Contest(config.num_worlds, seed)


if __name__ == "__main__":
    torch.set_num_threads(1)
    run = contest_config(
        Path(sys.argv[1]),
        samples=int(sys.argv[2]),
        resume="--resume" in sys.argv,
        checkpoint_iterations=1,
    )
    print("stopped by", train(run, environment=contest_env).stopped_by)
