"""Run by torchrun in test_distributed_gpu.py: captured and plain updates of two processes, and what
each says of the moments of both."""

from __future__ import annotations

import sys
from pathlib import Path

import torch
import torch.distributed as dist
from safetensors.torch import save_file

from rl.host import join_ranks
from rl.normalizer import Normalizer
from rl.ppo import PPO, PPOConfig
from tests.rl.test_gpu import fill

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    join_ranks(share=True)
    apart = torch.cuda.device_count() >= dist.get_world_size()
    rank = dist.get_rank()
    device = torch.device("cuda", torch.cuda.current_device())
    config = PPOConfig(hidden=(64, 32), steps=8, minibatches=4, epochs=3)
    found: dict[str, torch.Tensor] = {}
    for graph in (True, False):
        agent = PPO(20, 7, config, device, seed=1, cuda_graph=graph)
        rollout = agent.new_rollout(256)
        for update in range(3):
            fill(agent, rollout, 10 * update + rank)
            stats = agent.update(rollout)
        assert (agent._step.graph is not None) == graph
        kind = "captured" if graph else "plain"
        state = {k: v for k, v in agent.state_dict().items() if k != "generator"}
        found |= {f"{kind}/{k}": v.clone().cpu() for k, v in state.items()}
        if graph and apart:  # gloo waits for the device
            torch.cuda.set_sync_debug_mode("error")
            agent.update(rollout)
            torch.cuda.set_sync_debug_mode("default")
    moments = Normalizer(3, device)
    moments.collect(torch.arange(6.0, device=device).view(2, 3) + 10.0 * rank)
    moments.commit()
    found |= {f"moments/{k}": v.cpu() for k, v in moments.state_dict().items()}
    save_file(found, folder / f"{rank}.safetensors")
    dist.destroy_process_group()
