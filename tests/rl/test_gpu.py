"""On a GPU only: the captured update is the plain one, and nothing waits for the device."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest
import torch

from rl.ppo import PPO, PPOConfig, gaussian_log_prob
from rl.rollout import Rollout, collect

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


class Noise:
    """An environment on the GPU that reports random numbers."""

    num_agents, reward_scale = 1, 10.0

    def __init__(self, worlds: int, obs: int) -> None:
        self.device, self.shape = torch.device("cuda"), (worlds, 1, obs)

    def observe(self) -> torch.Tensor:
        return torch.randn(self.shape, device=self.device)

    def step(self, action: torch.Tensor) -> SimpleNamespace:
        n = self.shape[0]
        kind = torch.rand(n, device=self.device)
        return SimpleNamespace(
            obs=self.observe(),
            final_obs=self.observe(),
            reward=action.square().sum(-1),
            terminated=(kind < 0.01)[:, None],
            truncated=((kind > 0.01) & (kind < 0.02))[:, None],
            valid=kind < 0.999,
            remaining_paid=torch.zeros(n, device=self.device),
        )


def fill(agent: PPO, rollout: Rollout, seed: int) -> None:
    g = torch.Generator("cuda").manual_seed(seed)

    def normal(x: torch.Tensor) -> torch.Tensor:
        return torch.randn(x.shape, generator=g, device="cuda")

    with torch.no_grad():
        rollout.obs.copy_(normal(rollout.obs))
        rollout.final_obs.copy_(normal(rollout.obs))
        rollout.mean.copy_(0.1 * normal(rollout.mean))
        rollout.action.copy_(rollout.mean + agent.sigma * normal(rollout.mean))
        rollout.log_prob.copy_(gaussian_log_prob(rollout.action, rollout.mean, agent.sigma))
        rollout.reward.copy_(normal(rollout.reward))
        rollout.valid.fill_(True)


def test_captured_update_is_the_plain_update():
    config = PPOConfig(hidden=(64, 32), steps=8, minibatches=4, epochs=3)
    agents = [PPO(20, 7, config, "cuda", seed=1, cuda_graph=graph) for graph in (True, False)]
    for update in range(3):
        for agent in agents:
            rollout = agent.new_rollout(256) if update == 0 else agent.kept  # type: ignore
            agent.kept = rollout  # type: ignore[attr-defined]
            fill(agent, rollout, update)
            stats = agent.update(rollout)
            assert all(torch.isfinite(x) for x in stats.values())
    assert agents[0]._step.graph is not None
    assert agents[1]._step.graph is None
    assert agents[0].learning_rate == agents[1].learning_rate
    for a, b in zip(agents[0].actor.parameters(), agents[1].actor.parameters()):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)


def test_rollout_and_update_never_wait_for_the_device():
    config = PPOConfig(hidden=(64, 32), steps=8, minibatches=4, epochs=3)
    agent, env = PPO(20, 7, config, "cuda"), Noise(128, 20)
    rollout, obs = agent.new_rollout(128), env.observe()
    for _ in range(2):  # captures, allocations, first calls
        obs = collect(env, agent, rollout, obs, 0.99)
        agent.update(rollout)
    torch.cuda.set_sync_debug_mode("error")
    try:
        obs = collect(env, agent, rollout, obs, 0.99)
        agent.update(rollout)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_prints_what_learning_costs():
    agent, env = PPO(364, 69, PPOConfig(), "cuda"), Noise(8192, 364)
    rollout, obs = agent.new_rollout(8192), env.observe()
    for turn in range(5):
        torch.cuda.synchronize()
        began = time.perf_counter()
        obs = collect(env, agent, rollout, obs, 0.99)
        torch.cuda.synchronize()
        middle = time.perf_counter()
        agent.update(rollout)
        torch.cuda.synchronize()
        end = time.perf_counter()
        print(f"turn {turn}: acting {middle - began:.4f} s, learning {end - middle:.4f} s")
    print(f"memory {torch.cuda.max_memory_allocated() / 2**30:.1f} GiB")
