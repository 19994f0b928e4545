"""Run by torchrun in test_train.py: each rank learns from its half of one batch, then trains."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch
import torch.distributed as dist

from rl.ppo import PPO, PPOConfig, gaussian_log_prob
from rl.train import train
from tests.rl.toy import toy_config, toy_env

CONFIG = PPOConfig(hidden=(16, 8), steps=6, minibatches=1, epochs=4, learning_rate=1e-4)
ROWS = 24


def learn(out: Path, rows: slice) -> None:
    """Two updates of an agent on some of the rows of a made-up batch; writes its numbers."""
    agent = PPO(5, 3, CONFIG, seed=1)
    for update in range(2):
        g = torch.Generator().manual_seed(update)
        shape = (CONFIG.steps, ROWS)
        raw = torch.randn(*shape, 5, generator=g)[:, rows] * 2.0 + 1.0
        after = torch.randn(*shape, 5, generator=g)[:, rows]
        noise = torch.randn(*shape, 3, generator=g)[:, rows]
        reward = torch.randn(shape, generator=g)[:, rows]
        kind = torch.rand(shape, generator=g)[:, rows]
        r = agent.new_rollout(raw.shape[1])
        with torch.no_grad():
            agent.obs_norm.collect(raw)
            r.obs.copy_(agent.prepare(raw))
            r.final_obs.copy_(agent.prepare(after))
            r.mean.copy_(agent.actor(r.obs))
            r.action.copy_(r.mean + agent.sigma * noise)
            r.log_prob.copy_(gaussian_log_prob(r.action, r.mean, agent.sigma))
        r.reward.copy_(reward)
        r.terminated.copy_(kind < 0.1)
        r.truncated.copy_((kind > 0.1) & (kind < 0.2))
        r.valid.copy_(kind < 0.9)
        statistics = agent.update(r)
    numbers = {k: v for k, v in agent.state_dict().items() if k != "generator"}
    numbers |= {k: v for k, v in statistics.items() if k != "explained_variance"}
    out.write_text(json.dumps({k: v.tolist() for k, v in numbers.items()}))


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    torch.set_num_threads(1)
    dist.init_process_group("gloo")
    rank = dist.get_rank()
    half = ROWS // 2
    learn(folder / f"rank{rank}.json", slice(rank * half, (rank + 1) * half))
    train(toy_config(folder / "run", samples=4096), environment=toy_env)
    train(toy_config(folder / "run", samples=8192, resume=True), environment=toy_env)
    dist.destroy_process_group()
