"""How a run is put together: environment, starts, learner, first policy, and the parts beside them.

Nothing is played or written here. Every rank puts its own together, with worlds of its own and the
same first weights.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from rl import latent_run
from rl.charges import CHARGES, charges
from rl.checkpoint import checkpoints
from rl.config import (
    APART,
    BALANCE,
    PRIOR,
    TRACKING,
    TrainConfig,
    load_placed_starts,
    load_starts,
    usual_options,
)
from rl.host import RANK_STEP, local_ranks, pick_device, threads_of_each
from rl.meter import EpisodeMeter
from rl.parts import ImitationReward, Lesson, Opponents, Part, Style
from rl.policy import read_policy
from rl.ppo import PPO, STATISTICS
from rl.ranks import own_rank
from rl.rollout import Actor, Rollout
from rl.warm_start import load_start
from rl.worlds import engine_options, in_own_worlds
from sports.env import Env, Starts, make_env

MakeEnv = Callable[[TrainConfig, int], Any]
"""(config, seed) -> environment."""


class Learner(Actor, Protocol):
    """What the loop needs of a learner: a PPO, or the Distiller of the task ``prior``."""

    obs_norm: Any
    """Normaliser of observations."""
    sigma: Tensor
    learning_rate: Tensor
    actor_weight: Tensor
    """() set to 0 while the actor rests, else to 1."""

    def new_rollout(self, rows: int) -> Rollout:
        """Storage for ``rows`` = worlds x agents. Raises ValueError for too few."""
        ...

    def schedule(self, share: float) -> None:
        """Sets its hyper-parameters for the part of the run that is done, 0..1."""
        ...

    def update(self, rollout: Rollout) -> dict[str, Tensor]:
        """Learns from a rollout; returns () statistics."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that decides the next update, by name."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes a state back. Raises ValueError where it does not fit."""
        ...


@dataclass
class Assembly:
    """What a run is made of, in one process."""

    config: TrainConfig
    """As asked for, with the network of the first policy."""
    rank: int
    ranks: int
    device: torch.device
    """Of the learner."""
    env: Any
    agent: Learner
    rollout: Rollout
    meter: EpisodeMeter
    parts: list[Part]
    samples_each: int
    """Samples of an iteration that are learned from, of all ranks."""
    columns: tuple[str, ...]
    """Of the log, empty in rows of iterations that do not learn."""
    resumed: bool
    """Whether there is a checkpoint to go on from."""
    warmup: int
    """Iterations in which only the critic learns."""
    first_learning: int
    """Iterations before anything learns: they show observations to the normaliser."""
    unseen: Tensor | None
    """(D,) bool features that the first policy, of another task, has never seen."""


def assemble(config: TrainConfig, starts: Starts | None, make: MakeEnv) -> Assembly:
    """Puts a run together. ``starts``: in the place of the clips' frames.

    Raises ValueError for settings that cannot be, PolicyError for ``init``.
    """
    rank, ranks = own_rank()
    device = pick_device(config.device)
    resumed = config.resume and bool(checkpoints(config.out))
    first = None if resumed else config.init
    if first:
        config = _shaped_like(config, first)
    env = make(of_rank(config, rank, ranks), config.seed + RANK_STEP * rank)
    if starts is None:
        starts = _starts_of_clips(config)
    if starts is not None:
        env.starts = starts.to(env.device)
    if config.retries.share > 0.0:
        env.retry(config.retries)
    parts: list[Part] = []
    if config.imitation > 0.0:
        if starts is None:
            raise ValueError("the imitation reward needs demonstrations: give --clips")
        parts.append(ImitationReward(config, env))
    parts.extend(charges(config, env))
    if config.prior is not None:
        latent_run.act_through_prior(env, config)
    agent = _learner(config, env, device)
    learned = env.num_worlds * env.num_agents
    rollout = agent.new_rollout(learned)
    if config.styled:
        parts.append(Style(config, env, agent))
    if config.clone > 0:
        parts.append(Lesson(config, env, agent))
    # Without any statistics the first rollout is for the observation normaliser only.
    first_learning = 0 if config.init or config.task == PRIOR else 1
    warmup, unseen = 0, None
    if first:
        warmup, unseen = _begin_from(first, config, env, agent)
        first_learning = 0 if unseen is None else 1
    if config.contested:
        opponents = Opponents(config, env, agent)
        parts.append(opponents)
        learned = opponents.play.learned_rows
    columns = () if config.task == PRIOR else STATISTICS
    return Assembly(
        config=config,
        rank=rank,
        ranks=ranks,
        device=device,
        env=env,
        agent=agent,
        rollout=rollout,
        meter=EpisodeMeter(env),
        parts=parts,
        samples_each=rollout.steps * learned * ranks,
        columns=(*columns, *(name for part in parts for name in part.columns)),
        resumed=resumed,
        warmup=warmup,
        first_learning=first_learning,
        unseen=unseen,
    )


def of_rank(config: TrainConfig, rank: int, ranks: int) -> TrainConfig:
    """What a rank's worlds are made of: those of the last ``own_ranks`` are the task's own. Raises
    ValueError where that leaves no other."""
    if config.own_ranks >= ranks:
        raise ValueError(
            f"--own-ranks {config.own_ranks} leaves none of {ranks} processes for the other "
            "worlds: start more with torchrun"
        )
    if not plays_own(config, rank, ranks):
        return config
    return in_own_worlds(config, own_ranks=0)


def plays_own(config: TrainConfig, rank: int, ranks: int) -> bool:
    """Whether a rank is one of the last ``own_ranks``."""
    return rank >= ranks - config.own_ranks


def default_env(config: TrainConfig, seed: int) -> Env:
    """The config's task on its engine, in training mode."""
    physics_options = threads_of_each(config.engine, local_ranks()) | config.physics_options
    physics_options |= engine_options(config, seed)
    if config.task == PRIOR:
        from rl.distillation import make_distillation_env

        return make_distillation_env(config, seed, physics_options)
    if config.task == BALANCE:
        from rl.balance import make_balance_env

        return make_balance_env(config, seed, physics_options)
    if config.task == TRACKING:
        from rl.tracker import TrackingConfig, make_tracking_env

        return make_tracking_env(
            config.clips,
            engine=config.engine,
            num_worlds=config.num_worlds,
            seed=seed,
            strength=config.strength,
            limits=config.limits,
            config=TrackingConfig(**config.options),
            physics_options=physics_options,
            timestep_divisor=config.timestep_divisor,
        )
    return make_env(
        config.task,
        engine=config.engine,
        num_worlds=config.num_worlds,
        seed=seed,
        strength=config.strength,
        limits=config.limits,
        training=True,
        options=config.options,
        physics_options=physics_options,
        timestep_divisor=config.timestep_divisor,
    )


def _starts_of_clips(config: TrainConfig) -> Starts | None:
    """Frames of the clips, where they are demonstrations of the task and not motions to follow."""
    if not config.clips or config.task in APART:
        return None
    load = load_placed_starts if config.styled else load_starts
    return load(config.clips, config.start_probability[0])


def _learner(config: TrainConfig, env: Any, device: torch.device) -> Any:
    """A PPO in all runs that have parts or a first policy; a Learner at least."""
    if config.task == PRIOR:
        return latent_run.make_distiller(config, env, device, config.bf16)
    sizes = (env.obs_size, env.action_size)
    return PPO(*sizes, config.hyper, device, config.seed, config.cuda_graph, config.bf16)


def _shaped_like(config: TrainConfig, source: str) -> TrainConfig:
    """The config with the network of the policy to begin from, unless the paper's is asked for."""
    card = read_policy(source, config.task).metadata
    if "hidden" not in card or config.paper:
        return config
    shape = {n: card[n] for n in ("hidden", "activation", "observation_clip")}
    shape["hidden"] = tuple(shape["hidden"])
    return replace(config, ppo=replace(config.ppo, **shape))


def _begin_from(
    source: str, config: TrainConfig, env: Any, agent: PPO
) -> tuple[int, Tensor | None]:
    """Takes the networks and statistics of another policy. Returns for how many iterations only the
    critic learns, and (D,) bool the features that the policy has never seen, None without any."""
    policy, unseen = load_start(source, env, config.task)
    if policy.layer is not None:
        raise ValueError("--init is a latent policy: give --prior as well")
    assert policy.actor is not None
    count = policy.metadata["obs_count"]
    agent.load_policy(policy.actor, policy.mean, policy.std, count, seen=~unseen)
    knows = agent.load_critic(policy.extra) and pays_alike(policy.metadata, config)
    warmup = 0 if knows else config.hyper.critic_warmup
    return warmup, unseen.to(agent.device) if bool(unseen.any()) else None


def pays_alike(card: dict[str, Any], config: TrainConfig) -> bool:
    """Whether a critic that came with a policy knows what is paid now: the same discount, rewards
    and options of the same task."""
    then = card.get("config") or {}
    was = [then.get("ppo", {}).get("gamma"), *(then.get(name) for name in ("task", "algo"))]
    if was != [config.hyper.gamma, config.task, config.algo]:
        return False
    without = {f.name: f.default for f in fields(TrainConfig)}
    for name in ("imitation", *CHARGES):
        # A card that is older than a setting was paid as without it.
        if then.get(name, without[name]) != getattr(config, name):
            return False
    usual, own = usual_options(config.task), json.loads(json.dumps(config.options, default=str))
    return usual | (then.get("options") or {}) == usual | own
