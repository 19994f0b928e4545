"""Storage of one rollout, its collection from an environment, and generalised advantages.

Shapes: T steps, N worlds, A agents, M = N A rows (agent fastest), D observation, U action size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor


class Actor(Protocol):
    """What a rollout needs from a learner."""

    device: torch.device

    def act(self, obs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """obs (M, D) raw -> obs as stored, sampled action, mean action (M, U), log-prob (M,)."""
        ...

    def prepare(self, obs: Tensor) -> Tensor:
        """(M, D) raw observations -> as stored: normalised, in the storage type."""
        ...


class Rollout:
    """T steps of M rows at fixed addresses, so that a captured update can read them."""

    def __init__(
        self,
        steps: int,
        rows: int,
        obs_size: int,
        action_size: int,
        device: torch.device,
        obs_dtype: torch.dtype,
    ) -> None:
        def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(steps, rows, *shape, dtype=dtype, device=device)

        self.steps, self.rows = steps, rows
        self.obs = empty(obs_size, dtype=obs_dtype)
        """(T, M, D) normalised"""
        self.final_obs = empty(obs_size, dtype=obs_dtype)
        """(T, M, D) normalised, what the action led to, before any reset"""
        self.action = empty(action_size)
        self.mean = empty(action_size)
        self.log_prob = empty()
        self.reward = empty()
        """(T, M) divided by the task's reward scale"""
        self.terminated = empty(dtype=torch.bool)
        self.truncated = empty(dtype=torch.bool)
        self.valid = empty(dtype=torch.bool)
        self.advantages = empty()
        self.returns = empty()


def collect(
    env: Any,
    actor: Actor,
    rollout: Rollout,
    obs: Tensor,
    gamma: float,
    on_step: Callable[[Any], None] | None = None,
    bonuses: Sequence[Callable[[Any], Tensor]] = (),
) -> Tensor:
    """Plays ``rollout.steps`` control steps into ``rollout`` without waiting for the device.

    Args:
        env: the batched environment (see sports.env.Env); may live on another device.
        actor: the learner.
        rollout: filled in place, but for advantages and returns.
        obs: (N, A, D) observation to begin with.
        gamma: discount, for the steps still paid after a terminal step.
        on_step: called with every StepResult, for statistics.
        bonuses: StepResult -> (N, A) unscaled reward added to the task's: the imitation term, the
            costs of impacts and of torques that jump.

    Returns:
        (N, A, D) observation to go on from.
    """
    device, agents = actor.device, env.num_agents

    def rows(of_worlds: Tensor) -> Tensor:  # (N,) per world -> (M,) per agent
        return of_worlds.to(device)[:, None].expand(-1, agents).reshape(-1)

    for t in range(rollout.steps):
        stored, action, mean, log_prob = actor.act(obs.to(device).flatten(0, 1))
        rollout.obs[t] = stored
        rollout.action[t], rollout.mean[t], rollout.log_prob[t] = action, mean, log_prob
        result = env.step(action.unflatten(0, (-1, agents)).to(env.device))
        valid = rows(result.valid)
        reward = sum((bonus(result) for bonus in bonuses), result.reward)
        reward = reward.to(device).flatten() / env.reward_scale
        terminated = result.terminated.to(device).flatten()
        steps_paid = torch.where(terminated, rows(result.remaining_paid), 0.0)
        rollout.reward[t] = torch.where(valid, pay_remaining(reward, steps_paid, gamma), 0.0)
        rollout.final_obs[t] = actor.prepare(result.final_obs.to(device).flatten(0, 1))
        rollout.terminated[t] = terminated
        rollout.truncated[t] = result.truncated.to(device).flatten()
        rollout.valid[t] = valid
        if on_step is not None:
            on_step(result)
        obs = result.obs
    return obs


def pay_remaining(reward: Tensor, steps: Tensor, gamma: float) -> Tensor:
    """(M,) reward plus the same reward paid for ``steps`` (M,) more steps, discounted.

    r + r (gamma + ... + gamma^n) = r + r (gamma - gamma^(n+1)) / (1 - gamma): the terminal
    value of an outcome that stays as it is until the time limit.
    """
    if gamma == 1.0:
        return reward * (1.0 + steps)
    return reward * (1.0 + (gamma - gamma ** (steps + 1.0)) / (1.0 - gamma))


def generalized_advantages(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    valid: Tensor,
    gamma: float,
    lam: float,
) -> tuple[Tensor, Tensor]:
    """Advantages and returns (value targets), each (T, M).

    Args:
        reward: (T, M)
        value: (T, M) V(obs_t)
        next_value: (T, M) V of the observation that the action led to, before any reset: it
            bootstraps a truncated episode and is ignored after a terminal step.
        terminated: (T, M) bool
        truncated: (T, M) bool
        valid: (T, M) bool; an invalid step gets advantage 0 and cuts the chain, so that the step
            before it falls back on its own bootstrap.
        gamma: discount
        lam: trace decay

    Source: Schulman et al. 2016, eq. 16; time limits as in Pardo et al. 2018.
    """
    bootstrap = torch.where(terminated, 0.0, next_value)
    delta = reward + gamma * bootstrap - value
    going = (~(terminated | truncated)).float() * (gamma * lam)
    advantages = torch.zeros_like(reward)
    following = torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        following = torch.where(valid[t], delta[t] + going[t] * following, 0.0)
        advantages[t] = following
    return advantages, advantages + value
