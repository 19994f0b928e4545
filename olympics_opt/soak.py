"""Endurance: a task under random actions for thousands of steps, and everything that goes wrong.

What is looked for: numbers in an observation or reward that are not finite, worlds that diverge,
buffers that overflow, rewards or observations of absurd size, and memory that grows.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from olympics_opt.meter import device_name, resident_gib
from sports.env import Env, make_env

STEPS = 10_000
SIGMA = 0.3
"""Of the random actions: more than a fresh policy's, so that the athletes thrash about."""
ACTIONS = 64
"""Different actions for each world, in turn."""


@dataclass(frozen=True)
class Soak:
    """What became of one task."""

    task: str
    engine: str
    device: str
    worlds: int
    agents: int
    steps: int
    sigma: float
    episodes: int
    bad_observations: int
    """Numbers of an observation that were not finite, in worlds that had not diverged."""
    bad_rewards: int
    largest_observation: float
    largest_reward: float
    """Of one step, unscaled, by size."""
    nan_worlds: int
    overflow: int
    overflows: dict[str, int]
    """Which of the engine's buffers, by its name there, and how often; of a world more than one may
    overflow."""
    steps_per_second: float
    """Control steps of all worlds together."""
    device_memory_gib: tuple[float, float] | None
    """Memory of the GPU in use after a hundredth of the steps and at the end."""
    host_memory_gib: float

    @property
    def clean(self) -> bool:
        """Whether nothing was lost but worlds that diverged and were counted."""
        return self.bad_observations == self.bad_rewards == self.overflow == 0


def soak(
    task: str,
    engine: str,
    *,
    worlds: int,
    steps: int = STEPS,
    seed: int = 0,
    physics_options: dict[str, Any] | None = None,
    on_step: Callable[[int], None] | None = None,
) -> Soak:
    """Plays ``steps`` control steps of random actions in ``worlds`` worlds.

    Args:
        task: name of a task.
        engine: ``mujoco``, ``warp`` or ``drake``.
        worlds: number of worlds.
        steps: control steps of each.
        seed: of actions and starts.
        physics_options: of the engine.
        on_step: called with the number of steps taken, now and then.

    Raises:
        ValueError: unknown task or engine, or counts that are not positive.
        RuntimeError: the engine cannot run here.
    """
    if min(worlds, steps) < 1:
        raise ValueError(f"worlds and steps must be positive, not {worlds} and {steps}")
    env = make_env(
        task, engine=engine, num_worlds=worlds, seed=seed, physics_options=physics_options
    )
    try:
        generator = torch.Generator(env.device).manual_seed(seed)
        shape = (min(ACTIONS, steps), worlds, env.num_agents, env.action_size)
        actions = SIGMA * torch.randn(shape, generator=generator, device=env.device)
        # Of numbers: not finite in features and rewards; of worlds: ended.
        counts = torch.zeros(3, dtype=torch.long, device=env.device)
        largest = torch.zeros(2, device=env.device)
        early, began = _device_gib(env), time.perf_counter()
        for step in range(steps):
            result = env.step(actions[step % len(actions)])
            # The environment removes NaN from its observations; here they are looked for.
            features = torch.cat(tuple(env.task.features(env.view, env.memory).values()), -1)
            counts += torch.stack(
                (
                    (~features.isfinite()).sum(),
                    (~result.reward.isfinite()).sum(),
                    (result.ended | ~result.valid).sum(),
                )
            )
            sizes = torch.stack((result.obs.abs().amax(), result.reward.abs().amax()))
            largest = torch.maximum(largest, sizes)
            if step % max(1, steps // 100) == 0:
                early = _device_gib(env) if step <= steps // 100 else early
                if on_step is not None:
                    on_step(step + 1)
        bad_features, bad_rewards, episodes = counts.tolist()
        seconds = time.perf_counter() - began
        late = _device_gib(env)
        return Soak(
            task=task,
            engine=engine,
            device=device_name(env.device),
            worlds=worlds,
            agents=env.num_agents,
            steps=steps,
            sigma=SIGMA,
            episodes=episodes,
            bad_observations=bad_features,
            bad_rewards=bad_rewards,
            largest_observation=float(largest[0]),
            largest_reward=float(largest[1]),
            nan_worlds=int(env.physics.nan_worlds),
            overflow=int(env.physics.overflow),
            overflows=env.physics.overflows(),
            steps_per_second=worlds * steps / seconds,
            device_memory_gib=None if early is None or late is None else (early, late),
            host_memory_gib=resident_gib(),
        )
    finally:
        env.close()


def _device_gib(env: Env) -> float | None:
    if env.device.type != "cuda":
        return None
    free, total = torch.cuda.mem_get_info(env.device)
    return (total - free) / 2**30
