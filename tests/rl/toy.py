"""A double integrator with the interface of sports.env.Env, whose optimum is known.

Run as a script it trains, so that tests can kill it: ``toy.py OUT SAMPLES [--resume]``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from rl.ppo import PPOConfig
from rl.train import TrainConfig, train
from sports.env import StepResult

DT, PUSH = 0.1, 4.0
A = np.array([[1.0, DT], [0.0, 1.0]])
B = np.array([[0.0], [PUSH * DT]])
Q, R = np.diag([1.0, 0.1]), np.array([[0.2]])


def optimal_cost(gamma: float) -> tuple[np.ndarray, np.ndarray]:
    """P and K of the discounted problem: cost x' P x under a = -K x (Riccati equation)."""
    root = gamma**0.5
    P = scipy.linalg.solve_discrete_are(root * A, root * B, Q, R)
    K = np.linalg.solve(R / gamma + B.T @ P @ B, B.T @ P @ A)
    return P, K


class Integrator:
    """N worlds; state (position, velocity), action (push); reward = -cost; only truncation."""

    def __init__(self, num_worlds: int = 64, seed: int = 0, max_steps: int = 40) -> None:
        self.num_worlds, self.num_agents = num_worlds, 1
        self.obs_size, self.action_size = 2, 1
        self.reward_scale, self.max_steps = 1.0, max_steps
        self.device = torch.device("cpu")
        self.metric_names = ("final_distance",)
        self.obs_slices = {"state": slice(0, 2)}
        self.curriculum: dict[str, Tensor] = {}
        self.starts = None
        self.task = SimpleNamespace(name="toy", body="none")
        self.generator = torch.Generator().manual_seed(seed)
        self.x = torch.zeros(num_worlds, 2)
        self.age = torch.zeros(num_worlds, dtype=torch.long)
        self.A, self.B = (torch.tensor(m, dtype=torch.float32) for m in (A, B))

    def reset(self) -> Tensor:
        self.x = self._draw()
        self.age = torch.randint(self.max_steps, (self.num_worlds,), generator=self.generator)
        return self.x[:, None].clone()

    def _draw(self) -> Tensor:
        return torch.rand(self.num_worlds, 2, generator=self.generator) * 2.0 - 1.0

    def step(self, action: Tensor) -> StepResult:
        a = action[:, 0]
        cost = self.x.square() @ torch.tensor([1.0, 0.1]) + 0.2 * a.square().sum(-1)
        self.x = self.x @ self.A.T + a @ self.B.T
        self.age = self.age + 1
        truncated = self.age >= self.max_steps
        final = self.x.clone()
        self.x = torch.where(truncated[:, None], self._draw(), self.x)
        self.age = torch.where(truncated, 0, self.age)
        no = torch.zeros(self.num_worlds, dtype=torch.bool)
        return StepResult(
            obs=self.x[:, None].clone(),
            final_obs=final[:, None],
            reward=-cost[:, None],
            terms={"cost": -cost[:, None]},
            terminated=no[:, None],
            truncated=truncated[:, None],
            valid=~no,
            remaining_paid=torch.zeros(self.num_worlds),
            metrics={"final_distance": final[:, 0].abs()},
        )

    def state_dict(self) -> dict[str, Tensor]:
        return {"x": self.x, "age": self.age, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> Tensor:
        self.x, self.age = state["x"], state["age"]
        self.generator.set_state(state["generator"])
        return self.x[:, None].clone()

    def close(self) -> None:
        pass


SMALL = PPOConfig(hidden=(32, 32), steps=16, minibatches=4, epochs=4, gamma=0.95, sigma=0.3)


def toy_config(out: Path, **changes: object) -> TrainConfig:
    defaults = {"task": "toy", "worlds": 64, "samples": 4 * 64 * 16, "quiet": True, "ppo": SMALL}
    return TrainConfig(out=out, **{**defaults, **changes})  # type: ignore[arg-type]


def toy_env(config: TrainConfig, seed: int) -> Integrator:
    return Integrator(config.num_worlds, seed)


if __name__ == "__main__":
    torch.set_num_threads(1)
    run = toy_config(
        Path(sys.argv[1]),
        samples=int(sys.argv[2]),
        resume="--resume" in sys.argv,
        checkpoint_iterations=1,
    )
    summary = train(run, environment=toy_env)
    print("stopped by", summary.stopped_by, summary.iterations)
