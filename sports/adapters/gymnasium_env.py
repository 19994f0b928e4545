"""The tasks with one athlete as Gymnasium environments, one world or many.

::

    import gymnasium
    import sports.adapters.gymnasium_env  # registers olympics/LongJump-v0 and the others

    env = gymnasium.make("olympics/LongJump-v0", strength="human")
    envs = gymnasium.make_vec("olympics/LongJump-v0", num_envs=256)

Observations and actions are those of ``sports.env.Env``, rewards unscaled. An episode's metrics are
in the ``info`` of its last step. A world in which the engine diverged is truncated; its ``info``
says ``diverged``.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from sports.adapters.episodes import begin, checked, play, title
from sports.env import Env, make_env
from sports.registry import num_agents, task_names


def _make(task: str, num_worlds: int, settings: dict[str, Any]) -> Env:
    env = make_env(task, num_worlds=num_worlds, **settings)
    if env.num_agents != 1:
        env.close()
        raise ValueError(
            f"task '{task}' has {env.num_agents} athletes, Gymnasium knows one: use "
            "sports.adapters.pettingzoo_env"
        )
    return env


def _spaces(env: Env) -> tuple[spaces.Box, spaces.Box]:
    return (
        spaces.Box(-np.inf, np.inf, (env.obs_size,), np.float32),
        spaces.Box(-1.0, 1.0, (env.action_size,), np.float32),
    )


class OlympicsEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One world of a task."""

    metadata = {"render_modes": [], "render_fps": 30}

    def __init__(self, task: str, *, render_mode: None = None, **settings: Any) -> None:
        """``settings`` of ``sports.env.make_env``: engine, strength, limits, options of the task;
        ``training`` for start noise and curriculum, false for the conditions of an evaluation.
        Raises ValueError for what is unknown."""
        self.env = _make(task, 1, settings)
        self.observation_space, self.action_space = _spaces(self.env)
        self.render_mode = render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode; observation (obs,)."""
        super().reset(seed=seed)
        return begin(self.env, seed)[0, 0].cpu().numpy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step (1/30 s). Raises ValueError for an action that is none."""
        result = play(self.env, checked(action, (self.env.action_size,))[None, None])
        diverged = not bool(result.valid[0])
        terminated, truncated = bool(result.terminated[0, 0]), bool(result.truncated[0, 0])
        truncated |= diverged
        info: dict[str, Any] = {}
        if terminated or truncated:
            info["metrics"] = {k: float(v[0]) for k, v in result.metrics.items()}
            info["diverged"] = diverged
        obs = result.final_obs[0, 0].cpu().numpy()
        return obs, float(result.reward[0, 0]), terminated, truncated, info

    def close(self) -> None:
        """Frees the engine."""
        self.env.close()


class OlympicsVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many worlds of a task on one engine. A world whose episode ends begins the next one in the
    same step; what it showed last is in ``info["final_obs"]``."""

    metadata = {"render_modes": [], "render_fps": 30, "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self, task: str, num_envs: int = 256, *, render_mode: None = None, **settings: Any
    ) -> None:
        """As for :class:`OlympicsEnv`."""
        self.env = _make(task, num_envs, settings)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space, self.single_action_space = _spaces(self.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """New episodes in all worlds; observations (N, obs). Raises ValueError for a list of seeds:
        one seed decides all worlds."""
        if isinstance(seed, (list, tuple)):
            raise ValueError("one seed decides all worlds: give a number, not a list")
        super().reset(seed=seed)
        return begin(self.env, seed)[:, 0].cpu().numpy(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step (1/30 s) of actions (N, act). Raises ValueError for what is none."""
        result = play(self.env, checked(actions, (self.num_envs, self.env.action_size))[:, None])
        diverged = ~result.valid.cpu().numpy()
        terminated = result.terminated[:, 0].cpu().numpy()
        truncated = result.truncated[:, 0].cpu().numpy() | diverged
        ended, infos = terminated | truncated, {}
        if ended.any():
            final_obs = np.full(self.num_envs, None, dtype=object)
            last = result.final_obs[:, 0].cpu().numpy()
            for world in np.flatnonzero(ended):
                final_obs[world] = last[world]
            metrics: dict[str, Any] = {}
            for name, value in result.metrics.items():
                metrics[name], metrics[f"_{name}"] = value.cpu().numpy(), ended
            final_info = {"metrics": metrics, "_metrics": ended}
            final_info |= {"diverged": diverged, "_diverged": ended}
            infos = {"final_obs": final_obs, "_final_obs": ended}
            infos |= {"final_info": final_info, "_final_info": ended}
        obs, reward = result.obs[:, 0].cpu().numpy(), result.reward[:, 0].cpu().numpy()
        return obs, reward.astype(np.float64), terminated, truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the engine."""
        self.env.close()


def _register() -> None:
    module = __name__
    for task in task_names():
        if num_agents(task) != 1:
            continue
        gymnasium.register(
            id=f"olympics/{title(task)}-v0",
            entry_point=f"{module}:OlympicsEnv",
            vector_entry_point=f"{module}:OlympicsVectorEnv",
            kwargs={"task": task},
        )


_register()
