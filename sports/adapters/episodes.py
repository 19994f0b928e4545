"""What adapters share: whole episodes of an environment, begun by a seed, stepped with arrays."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sports.env import Env, StepResult


def title(task: str) -> str:
    """``HighJump`` for ``high_jump``."""
    return task.title().replace("_", "")


def begin(env: Env, seed: int | None) -> Tensor:
    """(N, A, obs) after a reset of every world; a seed decides all that follows."""
    if seed is not None:
        env.generator.manual_seed(seed)
        if env.task.curriculum is not None:
            env.view.curriculum = env.task.curriculum(env.config, env.num_worlds, env.device)
    obs = env.reset()
    env.age.zero_()  # ages that differ are for training in many worlds: here episodes are whole
    return obs


def checked(action: np.ndarray, shape: tuple[int, ...], what: str = "the action") -> np.ndarray:
    """``action`` as float32. Raises ValueError for another shape or what is not finite."""
    action = np.asarray(action, np.float32)
    if action.shape != shape:
        raise ValueError(f"{what} has shape {action.shape}, expected {shape}")
    if not np.isfinite(action).all():
        raise ValueError(f"{what} has a number that is not finite")
    return action


def play(env: Env, actions: np.ndarray) -> StepResult:
    """A control step with actions (N, A, act)."""
    return env.step(torch.from_numpy(actions).to(env.device))
