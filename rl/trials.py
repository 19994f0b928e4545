"""Plays a share of an evaluation's trials in one process, and keeps the episodes worth seeing.

Every world plays the same number of episodes, one after another, with the policy's mean action.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rl.host import one_torch_thread
from rl.policy import Policy
from rl.recording import Recording, Tape
from sports.env import Env, Starts, StepResult, make_env
from sports.registry import get_task
from sports.starts import START_NOISE

KEEP_ALL = 64
"""A share of more trials keeps its best and its median only."""
REPORT_STEPS = 30
"""Control steps after which a trial under way is told of again: a game in Drake takes minutes."""

Report = Callable[[float], None]
"""Called with the number of trials done. One under way counts as the steps it has come to, as a
share of the longest."""


@dataclass(frozen=True)
class Share:
    """A share of the trials, for one process."""

    task: str
    engine: str
    trials: int
    worlds: int
    """At once, at most."""
    seed: int
    strength: str
    limits: str
    options: dict[str, Any]
    physics_options: dict[str, Any] = field(default_factory=dict)
    timestep_divisor: int = 1
    start_noise: float = START_NOISE
    record: bool = False
    """Keep what may turn out to be the best or the median."""
    worlds_recorded: tuple[int, ...] = ()
    """Whose first episodes are kept."""
    blocks: int = 1
    """Worlds in so many blocks with the same starts."""


@dataclass
class Played:
    """What a share came to. Trials in the order of their episodes, then of their worlds."""

    trials: dict[str, np.ndarray]
    recordings: dict[int, Recording]
    """By trial; all that may turn out best or median."""
    overflow: int
    nan_worlds: int
    timestep: float
    """Of the engine (s): Drake may take more of them than the scene asks for."""
    substeps: int


def play_share(policy: Policy, share: Share, report: Report | None = None) -> Played:
    """Plays one in this process."""
    with opened(policy, share) as env:
        return play_episodes(policy, share, env, report)


@contextmanager
def opened(policy: Policy, share: Share) -> Iterator[Env]:
    """The worlds of a share, for as long as they are played in. Raises PolicyError for a policy
    that does not fit them."""
    worlds = math.ceil(share.trials / math.ceil(share.trials / share.worlds))
    env = make_env(
        share.task,
        engine=share.engine,
        num_worlds=worlds,
        seed=share.seed,
        strength=share.strength,  # type: ignore[arg-type]
        limits=share.limits,  # type: ignore[arg-type]
        training=False,
        options=share.options,
        physics_options=share.physics_options,
        timestep_divisor=share.timestep_divisor,
    )
    try:
        policy.check(env)
        policy.to(env.device)
        policy.seed(share.seed)
        if share.start_noise > 0.0:
            env.starts = standing_starts(env, share.start_noise)
            env.starts.blocks = share.blocks
        with one_torch_thread(env.device):
            yield env
    finally:
        env.close()


def standing_starts(env: Env, noise: float) -> Starts:
    """All standing, with joint noise +-``noise`` (rad) that is another in every episode."""
    scene = env.physics.scene
    qpos = torch.tensor(scene.default_qpos()[None, scene.agent_qpos(0)], dtype=torch.float32)
    qvel = torch.zeros(1, 6 + scene.body.num_dofs)
    return Starts(qpos, qvel, {}, probability=1.0, noise=noise).to(env.device)


def ranked(task: str, values: Mapping[str, np.ndarray], of: Iterable[int]) -> list[int]:
    """Trials from worst to best: by the task's main metric, then by the error, where the task has
    one (of golf strokes nearly all are legal), then by return."""
    reward = values["return"]
    main, miss = values[get_task(task).main_metric], values.get("error", np.zeros_like(reward))
    rank, aim = (np.where(np.isnan(x), -np.inf, x) for x in (main, -miss))
    return sorted(of, key=lambda t: (rank[t], aim[t], reward[t]))


class _Episodes:
    """Which episode each world is in, and what those that have ended came to."""

    def __init__(self, env: Env, task: str, episodes: int) -> None:
        """``episodes``: of each world."""
        worlds, self.episodes = env.num_worlds, episodes
        self.names, self.units = env.metric_names, get_task(task).metrics
        self.current = np.zeros(worlds, dtype=int)
        self.began = np.zeros(worlds, dtype=int)
        self.returns, self.step = np.zeros(worlds), 0
        columns = (*self.names, "return", "episode_steps")
        self.table = {n: np.full((episodes, worlds), np.nan) for n in columns}
        """(episodes, N) each"""
        self.spans: dict[tuple[int, int], tuple[int, int]] = {}
        """First step and end of (episode, world)."""

    @property
    def over(self) -> bool:
        """Whether every world has played its episodes."""
        return bool((self.current >= self.episodes).all())

    def done(self, longest: int) -> float:
        """Episodes that ended, and the shares of ``longest`` (steps) that the others have come to;
        it never falls."""
        playing = self.current < self.episodes
        return len(self.spans) + float(((self.step - self.began[playing]) / longest).sum())

    def add(self, result: StepResult) -> bool:
        """Takes a step in; whether anything ended with it."""
        self.step += 1
        bad = (~result.valid).cpu().numpy()
        ended = result.ended.cpu().numpy() | bad
        self.returns += np.where(bad, 0.0, result.reward.mean(-1).cpu().numpy())
        if not ended.any():
            return False
        metrics = {n: result.metrics[n].double().cpu().numpy() for n in self.names}
        for w in np.flatnonzero(ended).tolist():
            e, began = int(self.current[w]), self.began[w]
            if e < self.episodes:
                for n in self.names:
                    value, unit = metrics[n][w], self.units.get(n, "")
                    self.table[n][e, w] = _settled(value, bad[w], unit)
                self.table["return"][e, w] = self.returns[w]
                self.table["episode_steps"][e, w] = self.step - began
                self.spans[e, w] = (began, self.step)
            self.current[w], self.began[w], self.returns[w] = e + 1, self.step, 0.0
        return True


def play_episodes(
    policy: Callable[[Tensor], Tensor],
    share: Share,
    env: Env,
    report: Report | None = None,
) -> Played:
    """Plays a share in worlds that are ``opened`` already; played again, its starts are others.
    ``policy`` maps observations (N, A, D) to actions."""
    played = _Episodes(env, share.task, math.ceil(share.trials / env.num_worlds))
    tape = Tape(env, share.record or bool(share.worlds_recorded))
    obs = env.reset()
    while not played.over:
        action = policy(obs)
        result = env.step(action)
        obs = result.obs
        tape.add(action, result)
        if (played.add(result) or played.step % REPORT_STEPS == 0) and report is not None:
            report(min(played.done(env.max_steps), share.trials))
    # The last round may be one too many in the last worlds: left out by index, not by outcome.
    trials = {n: x.flatten()[: share.trials] for n, x in played.table.items()}
    physics = env.physics
    return Played(
        trials,
        _recordings(share, env, played.spans, trials, tape),
        int(physics.overflow),
        int(physics.nan_worlds),
        timestep=getattr(physics, "timestep", physics.scene.timestep),
        substeps=getattr(physics, "substeps", physics.scene.substeps),
    )


def _recordings(
    share: Share,
    env: Env,
    spans: dict[tuple[int, int], tuple[int, int]],
    trials: dict[str, np.ndarray],
    tape: Tape,
) -> dict[int, Recording]:
    """Of the trials that are asked for, or may turn out to be: by trial."""
    taped = {
        e * env.num_worlds + w: (w, start, end)
        for (e, w), (start, end) in spans.items()
        if e * env.num_worlds + w < share.trials and end <= len(tape.steps)
    }
    keep = {w for w in share.worlds_recorded if w in taped}  # trial w is world w's first episode
    if share.record and taped:
        order = ranked(share.task, trials, taped)
        keep |= set(order if len(order) <= KEEP_ALL else (order[-1], order[len(order) // 2]))
    common = ("task", "options", "seed", "engine", "strength", "limits", "timestep_divisor")
    facts = {name: getattr(share, name) for name in common}
    names = env.metric_names
    return {
        trial: tape.cut(*taped[trial], {n: float(trials[n][trial]) for n in names}, facts)
        for trial in sorted(keep)
    }


def _settled(value: float, bad: bool, unit: str) -> float:
    """A metric of an ended episode: one that diverged has failed, and achieved nothing else."""
    if not bad or math.isnan(value):
        return float(value)
    return 0.0 if unit == "fraction" else math.nan
