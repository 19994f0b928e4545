"""Polishes a trained policy by its whole episodes.

The noise of PPO is drawn anew in every step, and each step is blamed for what comes after it. Where
a race is lost by the rhythm of its strides, nearly all of that blame is noise: a hurdler that won
96 races of 100 forgot how in five such trainings. Here a candidate is the policy with its weights
moved a little, the same way for a whole episode. It plays its mean action, as in an evaluation, and
what counts is what its episodes come to. The search is CMA-ES (Hansen 2016, arXiv:1604.00772) over
a few directions in the space of the weights (``rl/directions.py``): towards other states of the
same training, and shifts of the actions in step with the phases of the motion. Its middle is the
result.

Under ``torchrun`` every process (rank) plays the same candidates from starts of its own, and what
counts is what they come to in all of them.

Shapes: C candidates besides the middle, E episodes of each, K directions.
"""

from __future__ import annotations

import fnmatch
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from rl import provenance
from rl.directions import (
    Directions,
    Phases,
    Weights,
    moved,
    phases,
    phases_of_part,
    scaled,
    shifts,
    towards,
    weights_of,
)
from rl.host import RANK_STEP, among_ranks, local_ranks, threads_of_each
from rl.policy import Policy, as_trained, load_policy, packed_weights, write_policy
from rl.policy_stack import PolicyStack
from rl.polish_config import Polish
from rl.ranks import gathered, own_rank
from rl.runlog import KINDS, Row, RunLog
from rl.trials import Share, opened, play_episodes
from rl.worlds import engine_options, in_own_worlds
from sports.env import Env, Starts
from sports.humanoid.body import load_body
from sports.physics.variation import Variation
from sports.registry import get_task
from sports.starts import ELAPSED
from warmstart.evolution import strategy
from warmstart.npz import read_npz, write_npz

T = TypeVar("T")
Trials = dict[str, np.ndarray]
"""What each of several episodes came to, by metric."""
STATE, POLICY = "search.npz", "policy.safetensors"
WATCHED_EVERY = 7
"""Steps between those whose observations tell how the last hidden layer varies: no divisor of a
stride."""
WATCHED_ROWS = 20_000
GENERATOR_STEP = 1_000_003
SEED_OFFSET = 500_009
"""Added to the seed of the starts, so that those of an evaluation with the same seed are others."""


@dataclass(frozen=True)
class Aim:
    """A metric of an episode and what it is worth."""

    metric: str
    weight: float
    zero: float
    """The value that is worth nothing."""


def aims(text: str, task: str) -> list[Aim]:
    """``success=1 time=-0.3@18.2`` -> a point for success and 0.3 for each second below 18.2.

    Names are those of the task's metrics and ``return``. A metric that an episode does not have
    (the time of a race that was not finished) is worth nothing. Raises ValueError.
    """
    spec = get_task(task)
    found = []
    for word in text.split() or [f"{spec.main_metric}=1"]:
        metric, _, numbers = word.partition("=")
        weight, _, zero = numbers.partition("@")
        try:
            aim = Aim(metric, float(weight), float(zero or 0.0))
        except ValueError:
            text = f"'{word}' is no aim: write METRIC=WEIGHT or METRIC=WEIGHT@ZERO"
            raise ValueError(text) from None
        if not math.isfinite(aim.weight) or not math.isfinite(aim.zero):
            raise ValueError(f"an aim takes finite numbers, not '{word}'")
        if aim.metric not in (*spec.metrics, "return"):
            known = ", ".join((*spec.metrics, "return"))
            raise ValueError(f"'{task}' has no metric '{aim.metric}'; it has: {known}")
        found.append(aim)
    return found


def worth(trials: Mapping[str, np.ndarray], wanted: Sequence[Aim]) -> np.ndarray:
    """(trials,) what each is worth."""
    return sum(np.nan_to_num(a.weight * (trials[a.metric] - a.zero)) for a in wanted)  # type: ignore[return-value]


class Crowd:
    """Plays several policies of one network at once, each in its own block of worlds."""

    def __init__(self, policy: Policy, size: int) -> None:
        assert policy.actor is not None
        self.policy = policy
        clip = policy.metadata["observation_clip"]
        self.stack = PolicyStack(policy.actor, size, clip, policy.mean.device)

    def write(self, slot: int, weights: Weights) -> None:
        """Who plays in a block."""
        self.stack.write(slot, weights, self.policy.mean, self.policy.std)

    def __call__(self, obs: Tensor) -> Tensor:
        """(N, A, D) -> (N, A, action); worlds in blocks, one after another."""
        blocks = obs.reshape(len(self.stack.mean), -1, obs.shape[-1])
        action = self.stack(blocks).view(*obs.shape[:-1], -1)
        return action if self.policy.layer is None else self.policy.layer(obs, action)


@dataclass
class Search:
    """CMA-ES with independent spreads, which may stop after any generation and go on.

    Numbers are in units of their first spread. What goes on is the middle and the spreads; the
    paths that the spreads have come by begin anew.
    """

    middle: np.ndarray
    """(K,)"""
    spreads: np.ndarray
    """(K,)"""
    candidates: int
    seed: int
    generation: int = 0

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng((self.seed, self.generation))
        largest = float(self.spreads.max())  # a single one must be 1 to the package
        self._strategy = strategy(
            self.middle,
            largest,
            self.candidates,
            lambda: self._rng,
            CMA_diagonal=True,
            CMA_stds=self.spreads / largest,
            maxiter=np.inf,
        )

    def advance(self, judge: Callable[[np.ndarray], tuple[np.ndarray, T]]) -> tuple[np.ndarray, T]:
        """One generation; ``judge`` maps the middle and the candidates (1 + C, K) to their worth
        (1 + C,) and something more; both are returned."""
        self._rng = np.random.default_rng((self.seed, self.generation))
        asked = self._strategy.ask()
        values, more = judge(np.vstack((self.middle, asked)))
        self._strategy.tell(asked, (-values[1:]).tolist())
        self.middle = np.array(self._strategy.mean)
        self.spreads = np.array(self._strategy.result.stds)  # pyright: ignore[reportAttributeAccessIssue]
        self.generation += 1
        return values, more


@dataclass
class Spent:
    """What a search has taken, over all calls."""

    minutes: float = 0.0
    samples: int = 0
    """Control steps of episodes that counted."""
    stages: list[dict[str, Any]] = field(default_factory=list)
    """Episodes and the worlds that they were played in; another one where a call goes on in other
    worlds."""

    @property
    def episodes(self) -> int:
        """Of all stages."""
        return sum(stage["episodes"] for stage in self.stages)

    def enter(self, worlds: dict[str, Any]) -> None:
        """What comes is played in these."""
        if not self.stages or self.stages[-1]["worlds"] != worlds:
            self.stages.append({"episodes": 0, "worlds": worlds})

    def add(self, minutes: float, samples: int, episodes: int) -> None:
        """A generation."""
        self.minutes += minutes
        self.samples += samples
        self.stages[-1]["episodes"] += episodes


COLUMNS = ("iteration", "samples", "minutes", "episodes", "middle", "candidates", "spread")
"""Of progress.csv, with the metrics: a generation a row. ``middle`` is the worth of the middle that
the candidates were drawn around, ``candidates`` the mean of theirs, ``spread`` the geometric mean
of the spreads in units of the first; metrics are means over all episodes of the generation."""


def polish(config: Polish, options: dict[str, Any] | None = None, quiet: bool = False) -> list[Row]:
    """Searches; after every generation writes the middle, ``policy.safetensors``, and a row of
    ``progress.csv`` into the folder, and shows it unless ``quiet``.

    The same call goes on where one was stopped. ``options`` are the task's. Returns the rows of
    this call. Under ``torchrun`` the processes share it, and the first one writes. Raises
    PolicyError and ValueError for what does not fit, before anything is written.
    """
    with among_ranks("auto" if config.engine == "warp" else "cpu"):
        return _polish(config, options, quiet)


def _polish(config: Polish, options: dict[str, Any] | None, quiet: bool) -> list[Row]:
    """In one of the processes."""
    rank, ranks = own_rank()
    wanted = aims(config.objective, config.name)
    policy = load_policy(config.policy, config.name)
    weights_of(policy)  # a baseline has none
    others = [load_policy(name, config.name) for name in config.others]
    ways, about = [towards(policy, other) for other in others], _about(config, policy, others)
    shares = [_share(config, policy, options)]
    if config.own_worlds:
        shares.append(_share(in_own_worlds(config, own_worlds=False), policy, options))
    rows: list[Row] = []
    with ExitStack() as stack:
        grounds = [(share, stack.enter_context(opened(policy, share))) for share in shares]
        share, env = grounds[0]
        search, found, spent = _begin(
            config, policy, about, lambda: _seek(config, policy, share, env)
        )
        changes = [moved(scaled(way, config.share), env.device) for way in ways]
        if found is not None:
            actions = _actions(config, policy)
            changes += shifts(policy, found, config.shift, actions, config.part is None)
        directions, crowd = Directions(weights_of(policy), changes), Crowd(policy, config.blocks)
        spent.enter(_worlds(config, options, ranks))
        if config.begin is not None:
            starts = met(policy, share, env, config.begin, wanted, config.worst)
            for _, each in grounds:
                each.starts = starts

        def judge(numbers: np.ndarray) -> tuple[np.ndarray, list[Trials]]:
            for slot, row in enumerate(numbers):
                crowd.write(slot, directions.at(torch.from_numpy(row)))
            played = [
                _of_all_ranks(play_episodes(crowd, *ground).trials, config.blocks, env.device)
                for ground in grounds
            ]
            values = [worth(x, wanted).reshape(config.blocks, -1).mean(1) for x in played]
            return np.mean(values, 0), played

        names = [f"{kind}/{name}" for kind in _kinds(config) for name in env.metric_names]
        for _, each in grounds:
            # What went on must not meet the starts of its beginning again.
            each.generator.manual_seed(GENERATOR_STEP * search.generation + share.seed)
        log = None
        if rank == 0:
            logged = RunLog(config.out, [*COLUMNS, *names], search.generation, quiet)
            log = stack.enter_context(closing(logged))
        began = time.monotonic()
        while not config.over(search.generation, spent.minutes):
            values, played = search.advance(judge)
            now = time.monotonic()
            steps = sum(int(trials["episode_steps"].sum()) for trials in played)
            # The first process's clock, so that all of them stop together.
            minutes = gathered(torch.tensor([(now - began) / 60.0], device=env.device).double())
            spent.add(float(minutes[0]), steps, ranks * config.played)
            began = now
            rows.append(
                {
                    "iteration": search.generation,
                    "samples": spent.samples,
                    "minutes": spent.minutes,
                    "episodes": spent.episodes,
                    "middle": float(values[0]),
                    "candidates": float(values[1:].mean()),
                    "spread": float(np.exp(np.log(search.spreads).mean())),
                    **_told(config, played, env.metric_names),
                }
            )
            if log is not None:
                _save(config, policy, about, directions, search, found, spent)
                log.write(rows[-1], config.done(search.generation, spent.minutes))
    return rows


def _of_all_ranks(trials: Trials, blocks: int, device: torch.device) -> Trials:
    """Those of every rank, together block by block. ``trials``: this rank's."""
    if own_rank()[1] == 1:
        return trials
    own = torch.from_numpy(np.stack(list(trials.values()))).to(device)
    every = gathered(own.unflatten(1, (blocks, -1)))  # (R, M, C + 1, E)
    together = every.permute(1, 2, 0, 3).flatten(1).cpu().numpy()
    return dict(zip(trials, together))


def _share(config: Polish, policy: Policy, options: dict[str, Any] | None) -> Share:
    """The episodes of a generation."""
    athlete = as_trained(policy, config.name, config.strength, config.limits, options)
    seed = config.seed + RANK_STEP * own_rank()[0]
    physics = threads_of_each(config.engine, local_ranks()) | engine_options(config, seed)
    if "variation" in physics:
        physics["variation_blocks"] = config.blocks
    return Share(
        task=config.name,
        engine=config.engine,
        trials=config.blocks * config.episodes,
        worlds=config.blocks * config.episodes,
        seed=seed + SEED_OFFSET,
        strength=athlete.strength,
        limits=athlete.limits,
        options=athlete.options,
        physics_options=physics,
        timestep_divisor=config.timestep_divisor,
        start_noise=config.start_noise,
        blocks=config.blocks,
    )


def _actions(config: Polish, policy: Policy) -> list[int]:
    """The actions to be shifted. Raises ValueError for joints that there are not."""
    size = int(policy.metadata["action_size"])
    if not config.joints:
        return list(range(size))
    if policy.prior is not None:
        raise ValueError("a policy in latents does not move single joints: leave --joints out")
    body = load_body(get_task(config.name).body)
    names = [dof.name for dof in body.dofs]
    chosen: set[str] = set()
    for pattern in config.joints:
        found = fnmatch.filter(names, pattern)
        if not found:
            raise ValueError(f"no joint is called '{pattern}'; there are {', '.join(names)}")
        chosen.update(found)
    return [i for i, name in enumerate(names) if name in chosen]


def _kinds(config: Polish) -> tuple[str, ...]:
    """Of columns that a metric has."""
    return ("metrics", *KINDS) if config.own_worlds else ("metrics",)


def _told(config: Polish, played: Sequence[Trials], names: Sequence[str]) -> Row:
    """Means over the episodes of a generation: of all, and of each kind of worlds where there are
    two (the task's own were played last)."""
    told: Row = {}
    for kind, some in zip(_kinds(config), (played, played[1:], played[:1])):
        for name in names:
            told[f"{kind}/{name}"] = _mean(np.concatenate([trials[name] for trials in some]))
    return told


def _mean(values: np.ndarray) -> float | None:
    """Of the trials that have one."""
    return None if np.isnan(values).all() else float(np.nanmean(values))


def watched(policy: Policy, share: Share, env: Env) -> tuple[Tensor, Tensor]:
    """(M, D) observations of the policy at play, from all phases of its episodes, and (M,) how much
    of the longest episode had gone by."""
    seen: list[tuple[Tensor, Tensor]] = []
    steps = 0

    def probe(obs: Tensor) -> Tensor:
        nonlocal steps
        if steps % WATCHED_EVERY == 0:
            gone = env.view.clock / env.max_steps
            seen.append((obs.flatten(0, -2).clone(), gone.repeat_interleave(obs.shape[1])))
        steps += 1
        return policy(obs)

    play_episodes(probe, share, env)
    rows, gone = (torch.cat(x) for x in zip(*seen, strict=True))
    return _thinned(rows, WATCHED_ROWS), _thinned(gone, WATCHED_ROWS)


def _thinned(rows: Tensor, most: int) -> Tensor:
    """Every k-th of them: fewer than twice ``most``."""
    return rows[:: max(1, len(rows) // most)]


def met(
    policy: Policy,
    share: Share,
    env: Env,
    part: tuple[float, float],
    wanted: Sequence[Aim] = (),
    worst: float | None = None,
) -> Starts:
    """States that the policy comes to in this part of its episodes (shares of the longest), as
    starts with the share's noise of the joints; with ``worst`` from this share of the episodes
    alone, those worth least, and for each of them a whole episode. Raises ValueError where no
    episode lasts so long, and for more than one athlete.
    """
    if env.num_agents > 1:
        raise ValueError("who has an opponent begins with it: leave --begin out")
    scene = env.physics.scene
    q, v, free = scene.agent_qpos(0), scene.agent_qvel(0), len(scene.free_objects)
    low, high = (round(x * env.max_steps) for x in part)
    seen: list[tuple[Tensor, ...]] = []
    if env.starts is not None:
        env.starts.blocks = 1  # nobody searches yet: every world has a start of its own
    trial = torch.arange(env.num_worlds, device=env.device)
    before = torch.zeros_like(trial)

    def probe(obs: Tensor) -> Tensor:
        clock = env.view.clock
        trial.add_(env.num_worlds * (clock < before))
        before.copy_(clock)
        here = (clock >= low) & (clock <= high) & (trial < share.trials)
        seconds = clock[here] * env.view.control_timestep
        seen.append((env.physics.qpos[here], env.physics.qvel[here], seconds, trial[here]))
        return policy(obs)

    trials = play_episodes(probe, share, env).trials
    qpos, qvel, seconds, of = (torch.cat(x) for x in zip(*seen, strict=True))
    if not len(of):
        raise ValueError(f"no episode lasts until {part[0]:.0%} of the longest: begin earlier")
    if worst is not None:
        order = np.argsort(worth(trials, wanted), kind="stable")
        lost = torch.from_numpy(order[: math.ceil(worst * len(order))]).to(of.device)
        some = torch.isin(of, lost)
        if not some.any():
            raise ValueError(f"the worst episodes end before {part[0]:.0%}: begin earlier")
        qpos, qvel, seconds = qpos[some], qvel[some], seconds[some]
    qpos, qvel, seconds = (_thinned(x, WATCHED_ROWS) for x in (qpos, qvel, seconds))
    if worst is not None:  # as many whole episodes: NaN is what a start of the rules has
        default = torch.tensor(scene.default_qpos(), dtype=qpos.dtype, device=qpos.device)
        default[len(default) - 7 * free :] = torch.nan
        nothing = torch.full_like(qvel, torch.nan)
        nothing[:, v] = 0.0
        qpos = torch.cat((qpos, default.expand_as(qpos)))
        qvel = torch.cat((qvel, nothing))
        seconds = torch.cat((seconds, torch.full_like(seconds, torch.nan)))
    return Starts(
        qpos[:, q],
        qvel[:, v],
        {ELAPSED: seconds},
        probability=1.0,
        object_qpos=qpos[:, -7 * free :] if free else None,
        object_qvel=qvel[:, -6 * free :] if free else None,
        blocks=share.blocks,
        noise=share.start_noise,
    )


def _seek(config: Polish, policy: Policy, share: Share, env: Env) -> Phases:
    """The phases to shift in; the first rank's, as every rank must shift in the same."""
    obs, gone = watched(policy, share, env)
    if config.part is None:
        found = phases(policy, obs, config.components)
    else:
        begin, end = config.part
        within = (gone >= begin) & (gone <= end)
        found = phases_of_part(policy, obs, within, config.components)
    return Phases(gathered(found.middle)[0], gathered(found.axes)[0])


def _begin(
    config: Polish, policy: Policy, about: dict[str, Any], seek: Callable[[], Phases]
) -> tuple[Search, Phases | None, Spent]:
    """A new search with the phases that it shifts actions in, or what ``out`` holds of one. Raises
    ValueError for another one's."""
    path = config.out / STATE
    device = policy.mean.device
    if path.exists():
        needed = ("middle", "spreads")
        arrays, meta = read_npz(path, needed, ("phase_middle", "phase_axes"), what="search")
        if meta.get("about") != about or "stages" not in meta:
            raise ValueError(f"'{config.out}' holds another search: give another folder")
        kept = [arrays.get(name) for name in ("phase_middle", "phase_axes")]
        found = None
        if kept[0] is not None and kept[1] is not None:
            found = Phases(*(torch.tensor(x, dtype=torch.float32, device=device) for x in kept))
        middle, spreads, generation = arrays["middle"], arrays["spreads"], int(meta["generation"])
        spent = Spent(float(meta["minutes"]), int(meta["samples"]), meta["stages"])
    else:
        found = None if config.components < 0 else seek()
        each = config.components + (config.part is None)
        size = len(config.others) + len(_actions(config, policy)) * each
        middle, spreads, generation, spent = np.zeros(size), np.ones(size), 0, Spent()
    return Search(middle, spreads, config.candidates, config.seed, generation), found, spent


def _about(config: Polish, policy: Policy, others: Sequence[Policy]) -> dict[str, Any]:
    """What a search that goes on must have been about: policies by their sha256."""
    names = ("components", "joints", "objective", "shift", "share")
    said: dict[str, Any] = {"others": [other.metadata["sha256"] for other in others]}
    said |= {name: getattr(config, name) for name in names}
    if config.part is not None:
        said["part"] = config.part
    return json.loads(json.dumps(said | {"of": policy.metadata["sha256"]}))


def _worlds(config: Polish, options: dict[str, Any] | None, ranks: int) -> dict[str, Any]:
    """What the episodes of a call are played in, where it is not the task's own, and by how many
    processes."""
    names = ("start_noise", "timestep_divisor", "felt_damping", "vary", "like_drake", "own_worlds")
    told = {name: getattr(config, name) for name in ("engine", *names)} | {"task": options or {}}
    given, usual = vars(config.variation), vars(Variation())
    told["variation"] = {name: x for name, x in given.items() if x != usual[name]}
    told |= {"processes": ranks if ranks > 1 else None}
    told |= {"begin": config.begin, "worst": config.worst}
    return json.loads(json.dumps({name: x for name, x in told.items() if x}))


def _save(
    config: Polish,
    policy: Policy,
    about: dict[str, Any],
    directions: Directions,
    search: Search,
    found: Phases | None,
    spent: Spent,
) -> None:
    """Writes the middle as a policy, then the search."""
    middle = directions.at(torch.from_numpy(search.middle))
    told = {
        "episodes": spent.episodes,
        "stages": spent.stages,
        "commit": provenance.commit(),
        "hardware": provenance.hardware(),
    }
    before = {key: x for key, x in policy.metadata.items() if key != "polish"}
    card = {
        **before,
        "precision": "float16",
        "polish": about | told,  # behind what was done before
        "metrics": {},
    }
    write_policy(packed_weights(moved(middle, "cpu")), card, config.out / POLICY)
    arrays = {"middle": search.middle, "spreads": search.spreads}
    if found is not None:
        arrays |= {
            "phase_middle": found.middle.cpu().numpy(),
            "phase_axes": found.axes.cpu().numpy(),
        }
    meta = {"about": about, "generation": search.generation}
    write_npz(config.out / STATE, arrays, meta | asdict(spent))
