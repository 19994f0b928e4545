"""Matches: one policy against another, with sides changed in half of the games.

Both halves begin from the same starts, so that what a side or a start is worth cancels, and a match
of B against A is that of A against B with the results turned. Policies play their mean actions. A
game in which the engine diverged is played for nothing: it is counted and not rated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rl import elo, provenance
from rl.evaluate import DEFAULT_WORLDS, Progress, interval
from rl.host import one_torch_thread
from rl.policy import (
    BASELINES,
    Athlete,
    Policy,
    PolicyError,
    as_trained,
    load_policy,
    read_policy,
)
from sports.env import make_env
from sports.physics import PhysicsState
from sports.registry import get_task
from sports.scene import Scene
from sports.starts import add_noise


class Pair(Policy):
    """Two policies as one for all athletes of a world: the first plays side 0, the second side 1.

    It can be played, recorded and drawn like a policy; its card is the first one's.
    """

    def __init__(self, first: Policy, second: Policy) -> None:
        card = {**first.metadata, "algo": _against(first, second)}
        super().__init__(None, torch.zeros(0), torch.ones(0), card)
        self.sides = (first, second)

    def __call__(self, obs: Tensor) -> Tensor:
        """(N, A, obs) -> (N, A, act)."""
        return torch.cat([p(seen) for p, seen in zip(self.sides, obs.chunk(2, dim=1))], 1)

    def to(self, device: torch.device | str) -> Pair:
        """The same policies on a device (moved in place)."""
        for policy in self.sides:
            policy.to(device)
        return self

    def seed(self, seed: int) -> None:
        """Starts the noise of ``random`` anew, another on either side."""
        for side, policy in enumerate(self.sides):
            policy.seed(seed + side)

    def check(self, env: Any) -> None:
        """Raises PolicyError where one does not fit, ValueError for a task without two sides."""
        if env.num_agents < 2 or env.num_agents % 2:
            raise ValueError(f"task '{env.task.name}' has no two sides: there is no match to play")
        for policy in self.sides:
            policy.check(env)
        if any(policy.own_turns for policy in self.sides):
            sides = torch.tensor([policy.own_turns for policy in self.sides], device=env.device)
            env.own_turns = sides.repeat_interleave(env.num_agents // 2)


def _against(first: Policy, second: Policy) -> str:
    return f"{first.metadata['algo']} against {second.metadata['algo']}"


MakeEnv = Callable[[int, int], Any]
"""(worlds, seed) -> environment."""


class LooseStarts:
    """Standing starts with joint noise of training on every athlete; see ``sports.starts``."""

    def draw(
        self, state: PhysicsState, scene: Scene, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Moves the joints a little; no labels."""
        add_noise(state, scene, generator)
        return {}


@dataclass(frozen=True)
class Games:
    """What games came to, from the view of the first policy."""

    wins: int
    draws: int
    losses: int
    unrated: int
    """Games in which the engine diverged."""
    metrics: tuple[dict[str, np.ndarray], dict[str, np.ndarray]]
    """Metrics of either policy in the games in which it was side 0, each (games / 2,)."""


def task_of(sources: Sequence[str], task: str) -> str:
    """The task to play: as asked, else the one that the first policy with a card was trained on.

    Raises ValueError where nothing says it, for an unknown task and for one without two sides.
    """
    for source in sources if not task else ():
        if source not in BASELINES and not source.startswith("pretrained"):
            task = str(read_policy(source, "").metadata["task"])
            break
    if not task:
        raise ValueError("say which task to play: --task NAME")
    get_task(task)
    return task


def play_games(
    first: Policy,
    second: Policy,
    make: MakeEnv,
    trials: int,
    seed: int = 0,
    worlds: int = 250,
    progress: Progress | None = None,
) -> Games:
    """Plays ``trials`` games, half of them with ``first`` on side 0.

    Args:
        first: a policy.
        second: its opponent.
        make: (worlds, seed) -> environment in evaluation mode.
        trials: an even number of games.
        seed: of the starts, the same for both halves.
        worlds: at a time, at most.
        progress: called with (games done, games).

    Raises ValueError for an odd number of games or a task without two sides, PolicyError for a
    policy that does not fit.
    """
    if trials < 2 or trials % 2:
        raise ValueError(f"trials must be even, so that sides can change, not {trials}")
    results: list[np.ndarray] = []
    metrics: list[dict[str, np.ndarray]] = []
    for part, pair in enumerate(((first, second), (second, first))):

        def report(done: int, before: int = part * trials // 2) -> None:
            if progress is not None:
                progress(before + done, trials)

        outcome, figures = _half(pair, make, trials // 2, seed, worlds, report)
        results.append(outcome if part == 0 else -outcome)
        metrics.append(figures)
    outcome = np.concatenate(results)
    return Games(
        wins=int((outcome > 0).sum()),
        draws=int((outcome == 0).sum()),
        losses=int((outcome < 0).sum()),
        unrated=int(np.isnan(outcome).sum()),
        metrics=(metrics[0], metrics[1]),
    )


def _half(
    pair: tuple[Policy, Policy],
    make: MakeEnv,
    games: int,
    seed: int,
    worlds: int,
    report: Callable[[int], None],
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(games,) outcome for side 0, NaN where the engine diverged, and side 0's metrics."""
    episodes = math.ceil(games / worlds)
    env = make(math.ceil(games / episodes), seed)
    try:
        players = Pair(*pair)
        players.check(env)
        players.to(env.device).seed(seed)
        names = tuple(env.metric_names)
        outcome = np.full((episodes, env.num_worlds), np.nan)
        table = {n: np.full((episodes, env.num_worlds), np.nan) for n in names}
        episode, done = np.zeros(env.num_worlds, dtype=int), 0
        with one_torch_thread(env.device):
            obs = env.reset()
            while (episode < episodes).any():
                result = env.step(players(obs))
                obs = result.obs
                valid = result.valid.cpu().numpy()
                ended = result.ended.cpu().numpy() | ~valid
                if not ended.any():
                    continue
                if result.outcome is None:
                    raise ValueError(f"task '{env.task.name}' does not say who has won")
                won = result.outcome.double().cpu().numpy()
                figures = {n: result.metrics[n].double().cpu().numpy() for n in names}
                for w in np.flatnonzero(ended & (episode < episodes)).tolist():
                    if valid[w]:
                        outcome[episode[w], w] = won[w]
                        for n in names:
                            table[n][episode[w], w] = figures[n][w]
                    done += 1
                episode += ended
                report(min(done, games))
    finally:
        env.close()
    return outcome.flatten()[:games], {n: x.flatten()[:games] for n, x in table.items()}


@dataclass(frozen=True)
class Setting:
    """Where and how long policies meet."""

    task: str
    trials: int = 100
    engine: str = "mujoco"
    seed: int = 0
    worlds: int | None = None
    """At a time; None for the engine's default."""
    strength: str | None = None
    """None for that of the first policy."""
    limits: str | None = None
    options: dict[str, Any] | None = None
    """Of the task; what the first policy must see comes from its card."""


def play_match(
    first: str | Path | Policy,
    second: str | Path | Policy,
    setting: Setting,
    *,
    make: MakeEnv | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """A match as a result of the schema of ``evaluate``.

    ``metrics`` are the first policy's: wins, draws, losses and score (shares of the rated games),
    elo_difference, and the task's own of the games in which it was side 0; ``opponent`` says who
    the second one is and ``opponent_metrics`` its. ``make`` is for tests.

    Raises as ``play_games`` does, PolicyError for policies that cannot be used, and RuntimeError
    for an engine that cannot run here.
    """
    a, b = (_loaded(source, setting.task) for source in (first, second))
    worlds = setting.worlds or DEFAULT_WORLDS.get(setting.engine, DEFAULT_WORLDS["mujoco"])
    make, played = make or maker(setting, a), _athlete(setting, a)
    games = play_games(a, b, make, setting.trials, setting.seed, worlds, progress)
    return {
        "kind": "match",
        "task": setting.task,
        "algo": _against(a, b),
        "policy": _name(first),
        "policy_sha256": a.metadata["sha256"],
        "opponent": {
            "policy": _name(second),
            "algo": b.metadata["algo"],
            "policy_sha256": b.metadata["sha256"],
        },
        "engine": setting.engine,
        "strength": played.strength,
        "limits": played.limits,
        "options": played.options,
        "trials": setting.trials,
        "seed": setting.seed,
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "hardware": provenance.hardware(),
        "metrics": _contest(games) | _figures(games.metrics[0], setting.task),
        "opponent_metrics": _figures(games.metrics[1], setting.task),
        "unrated": games.unrated,
    }


def play_ladder(
    sources: Sequence[str | Path | Policy],
    setting: Setting,
    *,
    make: MakeEnv | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """A round robin: every pair plays a match; ratings by maximum likelihood, the first one's 0.

    Returns {"kind": "ladder", "task", "players": [{"policy", "algo", "elo": {"mean", "ci95"},
    "score", "wins", "draws", "losses"}] from strongest to weakest, "matches", ...}.
    Raises ValueError for fewer than two policies, and as ``play_match`` does.
    """
    if len(sources) < 2:
        raise ValueError("a ladder needs two policies at least")
    size = len(sources)
    pairs = [(i, j) for i in range(size) for j in range(i + 1, size)]
    scores, games = np.zeros((size, size)), np.zeros((size, size))
    tally, matches = np.zeros((size, 3), dtype=int), []
    policies = [_loaded(source, setting.task) for source in sources]
    if setting.strength is None:  # all meet as the same athlete
        setting = Setting(**{**vars(setting), "strength": _athlete(setting, policies[0]).strength})
    for k, (i, j) in enumerate(pairs):

        def report(done: float, total: int, before: int = k * setting.trials) -> None:
            if progress is not None:
                progress(before + done, len(pairs) * setting.trials)

        match = play_match(policies[i], policies[j], setting, make=make, progress=report)
        match |= {"policy": _name(sources[i])}
        match["opponent"]["policy"] = _name(sources[j])
        matches.append(match)
        rated = match["metrics"]["score"]["n"]
        wins, draws, losses = (
            round((match["metrics"][n]["mean"] or 0.0) * rated) for n in ("wins", "draws", "losses")
        )
        scores[i, j], scores[j, i] = wins + 0.5 * draws, losses + 0.5 * draws
        games[i, j] = games[j, i] = rated
        tally[i] += (wins, draws, losses)
        tally[j] += (losses, draws, wins)
    ratings, half = elo.fit(scores, games)
    players = [
        {
            "policy": _name(source),
            "algo": policies[i].metadata["algo"],
            "policy_sha256": policies[i].metadata["sha256"],
            "elo": {
                "mean": float(ratings[i]),
                "ci95": [float(ratings[i] - half[i]), float(ratings[i] + half[i])],
                "n": int(games[i].sum()),
                "unit": "Elo",
            },
            "score": float(scores[i].sum() / max(games[i].sum(), 1.0)),
            **dict(zip(("wins", "draws", "losses"), tally[i].tolist())),
        }
        for i, source in enumerate(sources)
    ]
    common = ("task", "engine", "strength", "limits", "options", "trials", "seed", "commit")
    return {
        "kind": "ladder",
        **{name: matches[0][name] for name in (*common, "versions", "hardware")},
        "players": sorted(players, key=lambda p: -p["elo"]["mean"]),
        "matches": matches,
    }


def maker(setting: Setting, first: Policy) -> MakeEnv:
    """Environments of a setting."""
    played = _athlete(setting, first)

    def make(worlds: int, seed: int) -> Any:
        env = make_env(
            setting.task,
            engine=setting.engine,
            num_worlds=worlds,
            seed=seed,
            strength=played.strength,  # type: ignore[arg-type]
            limits=played.limits,  # type: ignore[arg-type]
            training=False,
            options=played.options,
        )
        env.starts = LooseStarts()  # type: ignore[assignment]
        return env

    return make


def _athlete(setting: Setting, first: Policy) -> Athlete:
    asked = setting.strength, setting.limits, setting.options
    return as_trained(first, setting.task, *asked)


def _loaded(source: str | Path | Policy, task: str) -> Policy:
    return source if isinstance(source, Policy) else load_policy(source, task)


def _name(source: str | Path | Policy) -> str:
    return "" if isinstance(source, Policy) else str(source)


def _contest(games: Games) -> dict[str, Any]:
    """Shares, score and Elo difference with 95 % intervals, as metrics."""
    rated = games.wins + games.draws + games.losses
    if not rated:
        raise PolicyError("the engine diverged in every game: nothing can be rated")
    found = {}
    for name in ("wins", "draws", "losses"):
        count = getattr(games, name)
        values = np.concatenate((np.ones(count), np.zeros(rated - count)))
        found[name] = interval(values, "fraction")
    score = elo.score(games.wins, games.draws, games.losses)
    found["score"] = {
        "mean": score.mean,
        "ci95": [score.low, score.high],
        "n": rated,
        "unit": "fraction",
    }
    mean, low, high = score.elo  # infinite where nothing or everything was won: null in JSON
    found["elo_difference"] = {"mean": mean, "ci95": [low, high], "n": rated, "unit": "Elo"}
    return found


def _figures(metrics: dict[str, np.ndarray], task: str) -> dict[str, Any]:
    try:
        units = dict(get_task(task).metrics)
    except ValueError:  # a toy of the tests
        units = {}
    return {name: interval(values, units.get(name, "")) for name, values in metrics.items()}
