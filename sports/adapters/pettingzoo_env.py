"""The tasks with several athletes as PettingZoo environments, all acting at once.

::

    from sports.adapters.pettingzoo_env import OlympicsParallelEnv

    env = OlympicsParallelEnv("fencing", strength="human")

Athletes are ``athlete_0``, ``athlete_1``, ...; of a match of two against two the first two are one
team. Observations and actions are those of ``sports.env.Env``, rewards unscaled. A match ends for
all at once: who ended it in the sport is terminated, the others are truncated. The match's metrics
are in every ``info`` of its last step, which also says whether the engine ``diverged``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sports.adapters.episodes import begin, checked, play
from sports.env import make_env


class OlympicsParallelEnv(ParallelEnv[str, np.ndarray, np.ndarray]):
    """One world of a task."""

    def __init__(self, task: str, *, render_mode: None = None, **settings: Any) -> None:
        """``settings`` of ``sports.env.make_env``: engine, strength, limits, options of the task;
        ``training`` for start noise and curriculum, false for the conditions of an evaluation.
        Raises ValueError for what is unknown."""
        self.env = env = make_env(task, num_worlds=1, **settings)
        self.metadata = {
            "name": f"olympics_{task}_v0",
            "render_modes": [],
            "is_parallelizable": True,
        }
        self.render_mode = render_mode
        self.possible_agents = [f"athlete_{i}" for i in range(env.num_agents)]
        self.agents: list[str] = []
        seen = spaces.Box(-np.inf, np.inf, (env.obs_size,), np.float32)
        done = spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)
        self.observation_spaces = dict.fromkeys(self.possible_agents, seen)
        self.action_spaces = dict.fromkeys(self.possible_agents, done)

    def observation_space(self, agent: str) -> spaces.Space[np.ndarray]:
        """Of an athlete. Raises KeyError for a name that is none."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[np.ndarray]:
        """Of an athlete. Raises KeyError for a name that is none."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """A new match; observations (obs,) by athlete."""
        obs = begin(self.env, seed)[0].cpu().numpy()
        self.agents = list(self.possible_agents)
        return dict(zip(self.agents, obs)), {name: {} for name in self.agents}

    def step(
        self, actions: dict[str, np.ndarray]
    ) -> tuple[
        dict[str, np.ndarray],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """One control step (1/30 s) of every athlete's action (act,). Raises ValueError for an
        athlete without an action, an action without an athlete, or an action that is none."""
        if not self.agents:
            raise ValueError("the match is over: call reset() before the next step")
        if set(actions) != set(self.agents):
            raise ValueError(
                f"actions are for {', '.join(sorted(actions)) or 'nobody'}; the match needs one "
                f"for each of {', '.join(self.agents)}"
            )
        size = (self.env.action_size,)
        rows = [checked(actions[name], size, f"the action of {name}") for name in self.agents]
        result = play(self.env, np.stack(rows)[None])
        names, diverged = self.agents, not bool(result.valid[0])
        terminated = result.terminated[0].tolist()
        truncated = [flag or diverged for flag in result.truncated[0].tolist()]
        info: dict[str, Any] = {}
        if diverged or bool(result.ended[0]):
            info["metrics"] = {k: float(v[0]) for k, v in result.metrics.items()}
            info["diverged"] = diverged
            self.agents = []
        obs = result.final_obs[0].cpu().numpy()
        return (
            dict(zip(names, obs)),
            dict(zip(names, result.reward[0].tolist())),
            dict(zip(names, terminated)),
            dict(zip(names, truncated)),
            {name: dict(info) for name in names},
        )

    def close(self) -> None:
        """Frees the engine."""
        self.env.close()
