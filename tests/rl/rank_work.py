"""Run by torchrun in test_distributed.py: each rank does its part and writes what it holds."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import torch
import torch.distributed as dist
from safetensors.torch import save_file
from torch import Tensor

from rl.amp import AMP, AMPConfig
from rl.charges import Charge, ChargeLimit
from rl.clip_sampling import ClipSampling
from rl.normalizer import Normalizer
from rl.ppo import PPO, PPOConfig, gaussian_log_prob
from rl.ranks import over_ranks
from rl.style_features import Demonstrations
from rl.train import TrainConfig, train
from tests.rl.motions_made import tables
from tests.rl.toy import toy_config, toy_env
from tests.warmstart.clips_made import random_clip

CONFIG = PPOConfig(hidden=(16, 8), steps=6, minibatches=1, epochs=1, grad_norm=1e9)
ROWS = 24
VISITS = 40


def share(rank: int, ranks: int) -> slice:
    """Rows of a rank."""
    return slice(rank * ROWS // ranks, (rank + 1) * ROWS // ranks)


def gradient(rows: slice) -> dict[str, Tensor]:
    """Gradient of the first minibatch, and the statistics of an agent that was fed by hand."""
    agent = PPO(5, 3, CONFIG, seed=1)
    g = torch.Generator().manual_seed(0)
    shape = (CONFIG.steps, ROWS)
    raw, after = (torch.randn(*shape, 5, generator=g)[:, rows] * 2.0 + 1.0 for _ in range(2))
    noise = torch.randn(*shape, 3, generator=g)[:, rows]
    reward, kind = torch.randn(shape, generator=g)[:, rows], torch.rand(shape, generator=g)[:, rows]
    r = agent.new_rollout(raw.shape[1])
    with torch.no_grad():
        agent.obs_norm.collect(raw)
        agent.obs_norm.commit()
        r.obs.copy_(agent.prepare(raw))
        r.final_obs.copy_(agent.prepare(after))
        # As if an older policy had acted: ratios differ from 1, some are clipped.
        r.mean.copy_(agent.actor(r.obs) + 0.1 * noise.flip(0))
        r.action.copy_(r.mean + agent.sigma * noise)
        r.log_prob.copy_(gaussian_log_prob(r.action, r.mean, agent.sigma))
    r.reward.copy_(reward)
    r.terminated.copy_(kind < 0.1)
    r.truncated.copy_((kind > 0.1) & (kind < 0.2))
    r.valid.copy_(kind < 0.9)
    agent.actor.zero_grad(set_to_none=True)  # as another optimiser of the actor may do
    agent.update(r)
    grads = {k: p.grad for k, p in agent._named_parameters().items()}
    found = {f"gradient/{k}": g.clone() for k, g in grads.items() if g is not None}
    norms = {"obs": agent.obs_norm, "value": agent.value_norm}
    return found | {f"norm/{k}": n.state_dict()["total"] for k, n in norms.items()}


def normaliser(rows: slice) -> dict[str, Tensor]:
    """Moments after two commits of unlike parts of one data set far from zero."""
    norm = Normalizer(4)
    data = torch.randn(2, ROWS, 4, generator=torch.Generator().manual_seed(3)) * 3.0 + 100.0
    data[:, ROWS // 2 :] += 50.0
    for part in data:
        norm.collect(part[rows])
        norm.commit()
    return {"total": norm.state_dict()["total"]}


def sampling(rank: int, ranks: int) -> dict[str, Tensor]:
    """Failure rates after two rounds of visits, of which each rank sees its part in two steps."""
    s = ClipSampling(tables(random_clip(0, 40), random_clip(1, 20)))
    g = torch.Generator().manual_seed(5)
    for _ in range(2):
        frame = torch.randint(0, 60, (VISITS,), generator=g)
        failed = torch.rand(VISITS, generator=g) < 0.4
        passed = ~failed & (torch.rand(VISITS, generator=g) < 0.7)
        mine = torch.arange(VISITS) % ranks == rank
        if ranks == 1:
            s.update(frame, failed, passed)
            continue
        for half in (torch.arange(VISITS) < 10, torch.arange(VISITS) >= 10):
            now = mine & half
            s.update(frame[now], failed[now], passed[now])
        s.merge_ranks()
    return {"failure": s.failure}


class Drift:
    """Motion of one number a row: its demonstrations go up, the agent's stands still."""

    state_size = 1

    def __init__(self, rows: int, seed: int) -> None:
        self.rows, self.generator = rows, torch.Generator().manual_seed(seed)

    def state(self) -> Tensor:
        return torch.randn(self.rows, 1, generator=self.generator)

    def features(self, state: Tensor) -> Tensor:
        return state


def style(rank: int) -> dict[str, Tensor]:
    """Two updates of a discriminator on each rank's own motion."""
    rows, steps = 8, 4
    config = AMPConfig(frames=2, hidden=(8,), batch=16, steps=3, replay=64, replay_share=0.5)
    states = torch.arange(40.0)[:, None] / 10.0
    shown = Demonstrations(states, torch.arange(38), torch.zeros(38, dtype=torch.bool))
    amp = AMP(Drift(rows, rank), shown, rows, steps, config, seed=2)
    no = torch.zeros(rows, dtype=torch.bool)
    for _ in range(2):
        for _ in range(steps):
            amp.watch(SimpleNamespace(reward=torch.ones(rows, 1), valid=~no, ended=no))
        amp.pay(SimpleNamespace(reward=torch.zeros(steps, rows)), 1.0)  # type: ignore[arg-type]
        amp.update()
    state = amp.state_dict()
    kept = {k: v for k, v in state.items() if k.startswith(("net.", "adam.", "norm.total"))}
    return kept | {"own": state["tail"]}


def charged(rank: int) -> dict[str, Tensor]:
    """An iteration of each rank in worlds that pay 2 in the first and 6 in the second, where a
    charge asks for 1 and 5; what the next takes of it, and what the log tells."""
    held = ChargeLimit(
        SimpleNamespace(charge_limit=0.5),  # type: ignore[arg-type]
        SimpleNamespace(device=torch.device("cpu")),
    )
    charge = Charge(lambda result: torch.full((3, 1), -1.0 - 4.0 * rank), held)
    result = SimpleNamespace(
        reward=torch.full((3, 1), 2.0 + 4.0 * rank), valid=torch.ones(3, dtype=torch.bool)
    )
    for _ in range(4):
        charge.bonus(result)
        held.watch(result)
    told = held.learn(None, 0)  # type: ignore[arg-type]
    held.schedule(0.0)
    return {"factor": held.factor, "share": told["cost/share"], "own": charge.bonus(result)}


def work(rank: int, ranks: int, folder: Path) -> None:
    """Everything but the runs; writes RANK.safetensors."""
    found = {
        "learn": gradient(share(rank, ranks)),
        "normaliser": normaliser(share(rank, ranks)),
        "sampling": sampling(rank, ranks),
        "style": style(rank),
        "charges": charged(rank),
    }
    sums, means = over_ranks(torch.tensor([1.0 + rank, 2.0]), torch.tensor([4.0 * rank]))
    found["message"] = {"sums": torch.tensor(sums), "means": torch.tensor(means)}
    flat = {
        f"{a}/{b}": x.clone().contiguous() for a, part in found.items() for b, x in part.items()
    }
    save_file(flat, folder / f"{rank}.safetensors")


if __name__ == "__main__":
    out = Path(sys.argv[1])
    torch.set_num_threads(1)
    dist.init_process_group("gloo")
    work(dist.get_rank(), dist.get_world_size(), out)

    # A signal to one rank alone stops all of them.
    def after_three(row: dict) -> None:
        if row["iteration"] == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    heard = train(
        toy_config(out / "run", samples=10**7), environment=toy_env, on_iteration=after_three
    )
    (out / f"stopped{dist.get_rank()}").write_text(f"{heard.stopped_by} {heard.iterations}")
    train(toy_config(out / "run", samples=6 * 2048, resume=True), environment=toy_env)
    timed = train(toy_config(out / "timed", samples=None, minutes=0.02), environment=toy_env)
    (out / f"timed{dist.get_rank()}").write_text(f"{timed.stopped_by} {timed.iterations}")
    hyper = PPOConfig(hidden=(16,), steps=48, minibatches=1, epochs=1)
    kinds = TrainConfig(
        "hurdling",
        out / "both",
        worlds=8,
        samples=2 * 16 * hyper.steps,
        like_drake=True,
        own_ranks=1,
        quiet=True,
        ppo=hyper,
    )
    train(kinds)
    dist.destroy_process_group()
