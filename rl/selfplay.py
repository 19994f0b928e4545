"""Self-play: a learner for contests whose opponents are itself, as it is and as it was.

``shared``, the better scheme: one network plays both sides (observations are in each athlete's own
heading frame, so that sides look alike). In a part of the worlds it plays itself and learns from
everybody; in the others a frozen snapshot plays one side, and it learns from its own.
``alternate``, the paper's (SMPLOlympics, section 4): two policies, each with its side; one is
frozen with its normalisers while the other learns, and after some iterations they change places.

The worlds with frozen opponents are dealt out evenly to slots, once; a world keeps its slot, and
what is in a slot changes between iterations (``rl.league``). So one batched product a layer plays
all opponents, the number of samples to learn from never changes, and nothing waits for the device
in a rollout. PPO stays as it is; opponents act with its noise, and their samples are left out.

Shapes: N worlds of which P have frozen opponents, A agents in two teams of H = A / 2, M = N A rows
(agent fastest), T steps, S slots.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.distributed as dist
from torch import Tensor

from rl.league import League
from rl.policy_stack import PolicyStack
from rl.ppo import PPO
from rl.ranks import own_rank
from rl.rollout import Rollout


@dataclass(frozen=True)
class SelfPlayConfig:
    """Self-play (``--algo selfplay``)."""

    scheme: Literal["shared", "alternate"] = "shared"
    """shared: one network for both sides and a pool of its snapshots; alternate: the paper's two
    policies that take turns in learning."""
    share: float = 0.5
    """Part of the worlds in which the opponent is frozen (shared; alternate has all of them)."""
    pool: int = 16
    """Frozen opponents at a time, those of the ladder among them; fewer where there are fewer such
    worlds."""
    snapshot_samples: int = 2_000_000
    """A snapshot enters the pool after so many samples ..."""
    snapshot_score: float = 0.7
    """... or after a quarter of them once the latest policy scores this against the pool."""
    ladder: tuple[int, ...] = (5_000_000, 20_000_000, 80_000_000)
    """Samples at which a snapshot is kept for ever, like the first policy: the yardstick."""
    swap: int = 250
    """Iterations after which the policies change places (alternate)."""
    k_factor: float = 0.5
    """Rating points per game and unit of score."""

    def __post_init__(self) -> None:
        if not 0.0 < self.share <= 1.0:
            raise ValueError(f"selfplay: share must lie in (0, 1], not {self.share}")
        if min(self.pool, self.snapshot_samples, self.swap) < 1 or self.k_factor <= 0.0:
            raise ValueError("selfplay: pool, snapshot_samples, swap and k_factor must be positive")
        if not 0.5 <= self.snapshot_score <= 1.0:
            raise ValueError(
                f"selfplay: snapshot_score must lie in [0.5, 1]: {self.snapshot_score}"
            )
        if list(self.ladder) != sorted(set(self.ladder)) or min(self.ladder, default=1) < 1:
            raise ValueError("selfplay: the samples of the ladder must be positive and rising")


STATISTICS = (
    "selfplay/elo",
    "selfplay/elo_ladder",
    "selfplay/score_pool",
    "selfplay/score_ladder",
    "selfplay/score_rival",
    "selfplay/games",
    "selfplay/draws",
    "selfplay/entries",
    "selfplay/side",
)
"""What ``SelfPlay.settle`` reports; None for what a scheme does not have, or without games."""
LEAST_GAMES = 50.0
"""Games against the pool from which their score may call for a snapshot."""


def exchanged(agent: PPO, other: dict[str, Tensor]) -> dict[str, Tensor]:
    """Gives a learner the weights, moments, statistics and rate of another; returns its own.

    Sigma and noise stay with the learner. Moments that the other does not have yet begin at zero.
    Weights and moments are written in place, because a captured update reads them.
    """
    own = {k: v for k, v in agent.state_dict().items() if k not in ("generator", "sigma")}
    before = {k: v.clone() for k, v in own.items()}
    with torch.no_grad():
        for name, x in own.items():
            x.copy_(other[name] if name in other else torch.zeros_like(x))
    for part, norm in (("obs_norm", agent.obs_norm), ("value_norm", agent.value_norm)):
        norm.load_state_dict({key: other[f"{part}.{key}"] for key in ("total", "pending")})
    return before


class SelfPlay:
    """Opponents for a learner: an actor for ``rl.rollout.collect`` around a PPO."""

    def __init__(
        self, env: Any, agent: PPO, config: SelfPlayConfig, steps: int, seed: int = 0
    ) -> None:
        """Args:
        env: the environment; its steps must say the ``outcome``.
        agent: the learner, with the policy that it begins with.
        config: see SelfPlayConfig.
        steps: T of a rollout.
        seed: of the deal of worlds and of the sides (mixed with the rank).

        Raises ValueError for a task without two sides and for too few worlds.
        """
        self.agent, self.config, self.device = agent, config, agent.device
        self.steps, self.agents = steps, env.num_agents
        if self.agents < 2 or self.agents % 2:
            raise ValueError(
                f"self-play needs a task for two sides, and a world of '{env.task.name}' has "
                f"{self.agents} athlete{'s' * (self.agents > 1)}: leave --algo selfplay out"
            )
        self.half, worlds = self.agents // 2, env.num_worlds
        self.alternate = config.scheme == "alternate"
        some = worlds if self.alternate else round(config.share * worlds)
        slots = min(config.pool, some)
        if slots < len(config.ladder) + 2:
            raise ValueError(
                f"self-play needs {len(config.ladder) + 2} opponents at least, for the ladder and "
                f"one more, and pool {config.pool} and {some} worlds give {slots}: use more worlds "
                "or a shorter --selfplay.ladder"
            )
        rank, _ = own_rank()
        deal = torch.Generator().manual_seed(seed + 3 + 1_000_003 * rank)
        order = torch.randperm(worlds, generator=deal)
        self.frozen = some - some % slots
        """P"""
        self.worlds = order[: self.frozen].to(self.device)
        """(P,) worlds with frozen opponents; those of a slot follow each other"""
        alike = order[self.frozen :].to(self.device)
        members = torch.arange(self.agents, device=self.device)
        self._alike: Tensor = (alike[:, None] * self.agents + members).flatten()
        self._team = torch.arange(self.half, device=self.device)
        self.learned_rows = len(self._alike) + self.frozen * self.half
        """Rows of a step that are learned from."""
        self.generator = torch.Generator(self.device).manual_seed(seed + 3 + 1_000_003 * rank)
        self.side = torch.zeros(self.frozen, dtype=torch.long, device=self.device)
        """(P,) team of the learner, 0 or 1"""
        if not self.alternate:
            self.side.copy_(self._draw_sides())
        self.rated = torch.ones(self.frozen, dtype=torch.bool, device=self.device)
        """(P,) the present episode has had this one opponent alone"""
        self.counts = torch.zeros(slots, 3, dtype=torch.float64, device=self.device)
        """Wins, draws and losses of the learner since the last ``settle``"""
        each = self.frozen * self.half
        self._mine = torch.zeros(steps, each, dtype=torch.long, device=self.device)
        self._theirs = torch.zeros_like(self._mine)
        self._step = 0
        clip = agent.config.observation_clip
        self.stack = PolicyStack(agent.actor, slots, clip, self.device, agent.bf16)
        self.league = League(slots, config.k_factor)
        self.rival: dict[str, Tensor] = {}
        """Of the policy that waits for its turn: the tensors of a learner by name."""
        self.turns, self.iterations = 0, 0
        """Changes of places so far, and iterations of learning since the last."""
        self.last_snapshot = 0
        if self.alternate:
            self._keep_rival()
            self._freeze(self.league.enter("rival", 0))
        self._freeze(self.league.enter("ladder", 0))
        self.rated.fill_(True)

    # -- acting ---------------------------------------------------------------------------------

    def _draw_sides(self) -> Tensor:
        draw = torch.rand(self.frozen, device=self.device, generator=self.generator)
        return (draw < 0.5).long()

    def _rows(self) -> tuple[Tensor, Tensor]:
        """(P H,) rows of the learner's and of the frozen opponents' teams in their worlds."""
        first = self.worlds * self.agents

        def rows(side: Tensor) -> Tensor:
            return ((first + side * self.half)[:, None] + self._team).flatten()

        return rows(self.side), rows(1 - self.side)

    def prepare(self, obs: Tensor) -> Tensor:
        """(M, D) raw observations -> as stored; see PPO."""
        return self.agent.prepare(obs)

    @torch.no_grad()
    def act(self, obs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As PPO's, with the actions of frozen opponents in their rows."""
        mine, theirs = self._rows()
        self._mine[self._step], self._theirs[self._step] = mine, theirs
        own = torch.ones(len(obs), device=self.device).index_fill(0, theirs, 0.0)
        stored, action, mean, log_prob = self.agent.act(obs, own)
        seen = obs[theirs].unflatten(0, (len(self.league.slots), -1))
        noise = (action - mean)[theirs]
        action = action.index_copy(0, theirs, self.stack(seen).flatten(0, 1) + noise)
        return stored, action, mean, log_prob

    def watch(self, result: Any) -> None:
        """Counts what ended and draws sides anew; call it with every StepResult."""
        if result.outcome is None:
            raise ValueError("self-play needs a task that says who has won")
        over = (result.ended | ~result.valid).to(self.device)[self.worlds]
        counted = over & result.valid.to(self.device)[self.worlds] & self.rated
        won = result.outcome.to(self.device)[self.worlds] * (1 - 2 * self.side)
        games = torch.stack((won > 0, won == 0, won < 0), -1) & counted[:, None]
        self.counts += games.view(len(self.counts), -1, 3).sum(1)
        self.rated |= over
        if not self.alternate:
            self.side.copy_(torch.where(over, self._draw_sides(), self.side))
        self._step = (self._step + 1) % self.steps

    # -- learning -------------------------------------------------------------------------------

    def learn(self, rollout: Rollout) -> dict[str, Tensor]:
        """``PPO.update`` on the samples that the latest policy acted in."""
        rollout.valid.scatter_(1, self._theirs, False)
        step = torch.arange(self.steps, device=self.device)[:, None] * rollout.rows
        rows = torch.cat((self._alike.expand(self.steps, -1), self._mine), 1)
        return self.agent.update(rollout, (step + rows).flatten())

    def settle(self, samples: int, learned: bool) -> dict[str, float | None]:
        """Between iterations: ratings, snapshots, a change of places. Waits for the device.

        Args:
            samples: learned from so far.
            learned: whether this iteration did; the first one may only show observations, and the
                first opponents then take over what the normaliser has seen.

        Returns STATISTICS. Ranks, which must all call this, decide alike.
        """
        counts, c = self.counts.clone(), self.config
        self.counts.zero_()
        if dist.is_initialized():
            dist.all_reduce(counts)
        games = counts.cpu().tolist()
        self.league.record(games)
        told = self._told(games)
        if not learned:
            if self.alternate:
                self._keep_rival()
            self._freeze(list(range(len(self.league.slots))))
            return told
        before, passed = self.last_snapshot, samples - self.last_snapshot
        if any(before < rung <= samples for rung in c.ladder):
            self._freeze(self.league.enter("ladder", samples))
            self.last_snapshot = samples
        elif not self.alternate:
            score, played = self.league.score("pool")
            won = score is not None and score >= c.snapshot_score and played >= LEAST_GAMES
            if passed >= c.snapshot_samples or (won and 4 * passed >= c.snapshot_samples):
                self._freeze(self.league.enter("pool", samples))
                self.last_snapshot = samples
        self.iterations += 1
        if self.alternate and self.iterations == c.swap:
            self._swap(samples)
        return told

    def _told(self, games: list[list[float]]) -> dict[str, float | None]:
        wins, draws, losses = (sum(column) for column in zip(*games))
        played = wins + draws + losses
        values = (
            self.league.rating,
            self.league.ladder_rating(),
            self.league.score("pool")[0],
            self.league.score("ladder")[0],
            self.league.score("rival")[0],
            played,
            draws / played if played else None,
            float(len(self.league.entries)),
            float(self.turns % 2) if self.alternate else None,
        )
        return dict(zip(STATISTICS, values))

    def _keep_rival(self) -> None:
        own = self.agent.state_dict()
        self.rival = {k: own[k].clone() for k in own if k not in ("generator", "sigma")}

    def _freeze(self, slots: list[int]) -> None:
        """The learner as it is becomes the opponent in some slots."""
        norm, actor = self.agent.obs_norm, self.agent.actor.state_dict()
        for slot in slots:
            self.stack.write(slot, actor, norm.mean, norm.std)
            self.rated.view(len(self.league.slots), -1)[slot] = False

    def _swap(self, samples: int) -> None:
        """The learner becomes the frozen rival, which learns on the other side from now on.

        A rival that has not learned yet takes over the learner's critic.
        """
        entry = next(i for i, e in enumerate(self.league.entries) if e.kind == "rival")
        rival = self.league.entries[entry]
        self._freeze([s for s, i in enumerate(self.league.slots) if i == entry])
        self.league.rating, rival.rating = rival.rating, self.league.rating
        rival.samples, rival.results = samples, [0.0, 0.0, 0.0]
        if self.turns == 0:
            critic = ("critic.", "value_norm.", "adam.critic.")
            own = self.agent.state_dict().items()
            self.rival |= {k: v.clone() for k, v in own if k.startswith(critic)}
        self.rival = exchanged(self.agent, self.rival)
        self.side.copy_(1 - self.side)
        self.rated.zero_()
        self.turns, self.iterations = self.turns + 1, 0

    # -- state ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """The host's part of the state, as plain JSON."""
        names = ("turns", "iterations", "last_snapshot")
        return {"league": self.league.state()} | {name: getattr(self, name) for name in names}

    def state_dict(self) -> dict[str, Tensor]:
        """The tensors: opponents, sides, the rival, noise."""
        state = {f"stack.{k}": v for k, v in self.stack.state_dict().items()}
        state |= {f"rival.{k}": v for k, v in self.rival.items()}
        state |= {"worlds": self.worlds, "alike": self._alike}
        state |= {"side": self.side, "rated": self.rated}
        return state | {"generator": self.generator.get_state()}

    def load(self, state: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        """Takes both back. Raises ValueError where they do not fit."""

        def part(prefix: str) -> dict[str, Tensor]:
            return {k[len(prefix) :]: v for k, v in tensors.items() if k.startswith(prefix)}

        self.league.load(state["league"])
        for name in ("turns", "iterations", "last_snapshot"):
            setattr(self, name, int(state[name]))
        self.stack.load_state_dict(part("stack."))
        self.rival = {k: v.to(self.device) for k, v in part("rival.").items()}
        own = {"worlds": self.worlds, "alike": self._alike, "side": self.side, "rated": self.rated}
        for name, x in own.items():
            if tensors[name].shape != x.shape:
                raise ValueError("the checkpoint deals out another number of worlds than this run")
            x.copy_(tensors[name])
        self.generator.set_state(tensors["generator"].cpu())
