"""What a policy observes in episodes of its own task: what its weights are rounded for."""

from __future__ import annotations

import torch
from torch import Tensor

from rl.policy import Policy, as_trained
from rl.trials import Share, opened
from sports.registry import get_task

WORLDS = 64
STEPS = 600
"""At most; shorter tasks are played to their end."""
ROWS = 20_000
"""Observations kept, evenly over the time, or a few more."""
SEED = 20_261_126
"""Not one that policies are evaluated with."""


def observed(policy: Policy) -> Tensor:
    """(M, obs) observations of a policy in its own task, on MuJoCo's threads, from the starts of an
    evaluation and in the episodes that follow. Raises PolicyError for a policy that does not fit
    its task any more, ValueError for an unknown task."""
    name = str(policy.metadata["task"])
    share = Share(
        task=name,
        engine="mujoco",
        trials=WORLDS,
        worlds=WORLDS,
        seed=SEED,
        **as_trained(policy, name)._asdict(),
    )
    steps = min(get_task(name).max_steps, STEPS)
    with opened(policy, share) as env:
        stride = max(1, steps * WORLDS * env.num_agents // ROWS)
        kept, obs = [], env.reset()
        for step in range(steps):
            if step % stride == 0:
                kept.append(obs.flatten(0, 1).clone())
            obs = env.step(policy(obs)).obs
    return torch.cat(kept)
