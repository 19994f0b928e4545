"""Adversarial motion priors (Peng et al. 2021): a reward for moving like demonstrations.

A discriminator learns to tell windows of the agent's motion from windows of demonstrations; what
it takes for a demonstration is paid. PPO stays as it is: this module watches the rollout, adds the
style to its rewards, and trains the discriminator after the policy. Nothing waits for the device
in the rollout, and the discriminator's step is replayed as a CUDA graph.

Shapes: T steps, M rows (worlds x agents), H frames of a window, F features of a frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
import torch.distributed as dist
from torch import Tensor, nn

from rl.discriminator import Replay, discriminator_losses, style_reward
from rl.graph import GraphedStep
from rl.learned import learned_state, load_learned
from rl.networks import MLP, autocast
from rl.normalizer import Normalizer
from rl.ranks import SharedGradients, SharedStep, own_rank
from rl.rollout import Rollout
from rl.style_features import Athletes, Demonstrations, load_demonstrations


@dataclass(frozen=True)
class AMPConfig:
    """Adversarial motion prior (``--algo amp``)."""

    combine: Literal["multiplicative", "additive"] = "multiplicative"
    """multiplicative pays task x (1 + ``style`` x style reward) where the task's reward is
    positive, so that prolonging an episode never pays by itself; additive pays task + ``style`` x
    style reward (unscaled, per step), with 1 as in the paper's equal parts."""
    style: float = 0.2
    """Weight of the style reward."""
    frames: int = 10
    """Control steps that the discriminator sees at once; 2 for short clips."""
    optimised_share: float = 0.5
    """Share of demonstration windows that come from optimised clips, where there are captured ones
    too: otherwise seconds of the former would be lost in minutes of the latter."""
    mirror: bool = False
    """Show the mirror image of each clip as well."""
    hidden: tuple[int, ...] = (1024, 512)
    """Hidden layers of the discriminator (ReLU)."""
    learning_rate: float = 1e-4
    """Of the discriminator (Adam), constant."""
    steps: int = 8
    """Gradient steps of the discriminator per iteration."""
    ceiling: float = 0.95
    """Shares of windows, of the agent's and of the demonstrations', above both of which the
    discriminator is right often enough: it learns nothing from that batch. One that is always right
    pays nothing for moving a little more like the demonstrations. 1 for no ceiling."""
    batch: int = 2048
    """Windows of the rollout, of the replay and of the demonstrations in a step, each."""
    gradient_penalty: float = 5.0
    """Weight of the squared gradient at demonstrations."""
    logit_decay: float = 0.01
    """Weight of the squared weights of the last layer."""
    weight_decay: float = 1e-4
    """Weight of the squared weights of all layers."""
    replay: int = 200_000
    """Windows of earlier rollouts that are kept."""
    replay_share: float = 0.02
    """Part of each rollout that enters the replay."""

    def __post_init__(self) -> None:
        if self.frames < 1 or min(self.steps, self.batch, self.replay) < 1:
            raise ValueError("amp: frames, steps, batch and replay must be at least 1")
        if min(self.style, self.learning_rate, self.gradient_penalty) < 0.0:
            raise ValueError("amp: style, learning_rate and gradient_penalty must not be negative")
        if min(self.logit_decay, self.weight_decay) < 0.0:
            raise ValueError("amp: logit_decay and weight_decay must not be negative")
        if not 0.5 < self.ceiling <= 1.0:
            raise ValueError(f"amp: ceiling must lie in (0.5, 1], not {self.ceiling}")
        if not 0.0 <= self.optimised_share <= 1.0 or not 0.0 < self.replay_share <= 1.0:
            raise ValueError("amp: optimised_share must lie in [0, 1], replay_share in (0, 1]")


STATISTICS = (
    "style/loss",
    "style/gradient",
    "style/accuracy_agent",
    "style/accuracy_demonstration",
    "style/reward",
    "style/share",
    "style/masked",
)
"""What ``AMP.update`` reports."""
ABSURD = 1e6
"""No feature is larger."""


def style_bonus(task: Tensor, style: Tensor, config: AMPConfig) -> Tensor:
    """(...) what is added to the task's reward ``task`` (...) of a step, both unscaled.

    A multiplied cost would punish style, and one that style divides would pay for idling: costs
    stay as they are.
    """
    if config.combine == "additive":
        return config.style * style
    return config.style * style * task.clamp(min=0.0)


class Source(Protocol):
    """Where motion comes from: rl.style_features.Athletes, or a toy."""

    state_size: int

    def state(self) -> Tensor:
        """(M, S) states after the last step, before any reset."""
        ...

    def features(self, state: Tensor, /) -> Tensor:
        """(..., S) -> (..., F), for the agent and the demonstrations alike."""
        ...


class AMP:
    """Discriminator, its normaliser, its optimiser, the replay, and the watch over the rollout."""

    def __init__(
        self,
        source: Source,
        demonstrations: Demonstrations,
        rows: int,
        steps: int,
        config: AMPConfig,
        device: torch.device | str = "cpu",
        seed: int = 0,
        cuda_graph: bool = True,
        bf16: bool = False,
    ) -> None:
        """Args:
        source: of the agent's motion.
        demonstrations: windows of ``config.frames`` states.
        rows: M worlds x agents.
        steps: T of a rollout.
        config: see AMPConfig.
        device: of the learner.
        seed: of the first weights (equal on all ranks) and of the draws (mixed with the rank).
        cuda_graph: replay the step as a graph where that is possible.
        bf16: multiply, and keep frames, in bf16.
        """
        self.source, self.config, self.device = source, config, torch.device(device)
        self.rows, self.steps, self.bf16 = rows, steps, bf16
        rank, self.world_size = own_rank()
        self.generator = torch.Generator(self.device).manual_seed(seed + 2 + 1_000_003 * rank)
        dtype = torch.bfloat16 if bf16 else torch.float32
        shown = source.features(demonstrations.states.to(self.device))
        size, h = shown.shape[-1], config.frames
        self.norm = Normalizer(size, self.device)
        self.norm.collect(shown)
        self.norm.commit()
        self.demonstrations = shown.to(dtype)
        """(D, F)"""
        kinds = (demonstrations.optimised, ~demonstrations.optimised)
        self._begins = [demonstrations.begins[k].to(self.device) for k in kinds]
        self.frames = torch.zeros(steps + h - 1, rows, size, device=self.device, dtype=dtype)
        """(T + H - 1, M, F): the last H - 1 frames of the rollout before, then this one's"""
        self.whole = torch.zeros(steps, rows, dtype=torch.bool, device=self.device)
        """(T, M) the window that ends with a step lies inside one episode, after its reset"""
        self.replay = Replay(config.replay, steps, h, size, self.device, dtype)
        self._states = torch.zeros(steps, rows, source.state_size, device=self.device)
        self._task = torch.zeros(steps, rows, device=self.device)
        self._age = torch.zeros(rows, dtype=torch.long, device=self.device)
        self._step = 0
        self._span = torch.arange(h, device=self.device)
        weights = torch.Generator().manual_seed(seed + 2)
        self.net = MLP(h * size, config.hidden, 1, "relu", 1.0, weights).to(self.device)
        cuda = self.device.type == "cuda"
        rate = torch.tensor(config.learning_rate, dtype=torch.float32, device=self.device)
        self.optimizer = torch.optim.Adam(
            self.net.parameters(), lr=rate, fused=True, capturable=cuda
        )
        self._stats = torch.zeros(4, device=self.device)
        self._paid: tuple[Tensor, ...] = ()
        wanted = cuda_graph and cuda
        self._train: GraphedStep | SharedStep
        if self.world_size == 1:
            self._train = GraphedStep(self._minibatch, self.optimizer.zero_grad, wanted)
        else:
            shared = SharedGradients(self.net.parameters())
            self._train = SharedStep(shared, self._backward, self._descend, wanted)

    # -- watching -------------------------------------------------------------------------------

    def watch(self, result: Any) -> None:
        """Keeps what a step of the environment did; call it with every StepResult."""

        def rows(of_worlds: Tensor) -> Tensor:  # (N,) -> (M,)
            agents = result.reward.shape[1]
            return of_worlds.to(self.device)[:, None].expand(-1, agents).reshape(-1)

        t, valid = self._step, rows(result.valid)
        self._states[t] = self.source.state().to(self.device)
        self._task[t] = torch.where(valid, result.reward.to(self.device).flatten(), 0.0)
        # Frames at and before a reset are another episode's, or a demonstration's own.
        age = torch.where(valid, self._age + 1, 0)
        self.whole[t] = age >= self.config.frames
        self._age.copy_(torch.where(rows(result.ended), 0, age))
        self._step = (t + 1) % self.steps

    @torch.no_grad()
    def pay(self, rollout: Rollout, scale: float) -> None:
        """Adds the style to the rewards of a rollout that was watched; ``scale`` is the task's."""
        h = self.config.frames
        self.frames[: h - 1] = self.frames[self.steps :].clone()
        features = self.source.features(self._states)
        # Of a world that diverged anything may come; such frames are in no window that counts.
        self.frames[h - 1 :] = torch.nan_to_num(features).clamp(-ABSURD, ABSURD)
        seen = self.norm.normalize(self.frames.float())
        style = torch.stack([self._style(seen[t : t + h]) for t in range(self.steps)])
        style = torch.where(self.whole, style, 0.0)
        bonus = style_bonus(self._task, style, self.config)
        rollout.reward += bonus / scale
        whole, spent = self.whole.float().mean(), bonus.abs().mean()
        share = spent / (spent + self._task.abs().mean()).clamp(min=1e-8)
        self._paid = (style.mean() / whole.clamp(min=1e-8), share, 1.0 - whole)

    def _style(self, window: Tensor) -> Tensor:
        """(H, M, F) normalised frames -> (M,) style reward."""
        with self._autocast():
            return style_reward(self.net(window.transpose(0, 1).flatten(1)).squeeze(-1))

    def _normalized(self, windows: Tensor) -> Tensor:
        """(m, H, F) windows -> (m, H F) input of the discriminator, float32."""
        return self.norm.normalize(windows.float()).flatten(1)

    def _autocast(self) -> torch.autocast:
        return autocast(self.device, self.bf16)

    # -- learning -------------------------------------------------------------------------------

    def update(self) -> dict[str, Tensor]:
        """Trains the discriminator on the rollout that was paid. Returns () statistics.

        style/loss (both cross entropies, halved), style/gradient and the accuracies: means over
        the steps; style/reward: of the windows that count; style/share: of the style in all that
        was paid, by size; style/masked: share of windows across or just after a reset.
        """
        c = self.config
        k = min(max(1, round(c.replay_share * self.rows)), self.replay.pieces)
        chosen = torch.randperm(self.rows, device=self.device, generator=self.generator)[:k]
        self.replay.add(self.frames[:, chosen], self.whole[:, chosen])
        self._stats.zero_()
        size = (c.batch,)
        for _ in range(c.steps):
            now = torch.randint(
                self.whole.numel(), size, device=self.device, generator=self.generator
            )
            past = self.replay.draw(c.batch, self.generator)
            self._train(torch.cat((now, past, self.draw_demonstrations(c.batch))))
        self._collect()
        stats = torch.cat((self._stats / c.steps, torch.stack(self._paid)))
        if self.world_size > 1:
            dist.all_reduce(stats)
            stats /= self.world_size
        return dict(zip(STATISTICS, stats.unbind()))

    def draw_demonstrations(self, count: int) -> Tensor:
        """(count,) first rows of demonstration windows: by kind, then every window alike."""
        kind, place = torch.rand(2, count, device=self.device, generator=self.generator)
        drawn = [
            begins[(place * len(begins)).long().clamp(max=len(begins) - 1)]
            for begins in self._begins
            if len(begins)
        ]
        if len(drawn) == 1:
            return drawn[0]
        return torch.where(kind < self.config.optimised_share, *drawn)

    def _minibatch(self, picks: Tensor) -> None:
        """One gradient step on windows (3 B,): of the rollout, the replay, the demonstrations."""
        self.optimizer.zero_grad(set_to_none=True)
        self._backward(picks)
        self._descend()

    def _backward(self, picks: Tensor) -> None:
        """Adds the gradients of windows (3 B,) and their statistics."""
        c = self.config
        now, past, begin = picks.view(3, -1)
        t, row = now // self.rows, now % self.rows
        fresh = self.frames[t[:, None] + self._span, row[:, None]]
        kept, counts = self.replay.windows(past, self._span)
        agent = self._normalized(torch.cat((fresh, kept)))
        weight = torch.cat((self.whole[t, row], counts)).float()
        shown = self._normalized(self.demonstrations[begin[:, None] + self._span])
        with self._autocast():
            losses = discriminator_losses(self.net, agent, weight, shown)
        entropy = 0.5 * (losses.agent + losses.demonstration)
        layers = [m.weight for m in self.net.modules() if isinstance(m, nn.Linear)]
        decay = torch.stack([w.square().sum() for w in layers]).sum()
        loss = (
            entropy
            + c.gradient_penalty * losses.gradient
            + c.logit_decay * self.net.head.weight.square().sum()
            + c.weight_decay * decay
        )
        # Without a single window of the agent there is nothing to tell apart yet.
        learns = weight.sum() > 0.0
        if c.ceiling < 1.0:
            worse = torch.minimum(losses.accuracy_agent, losses.accuracy_demonstration)
            learns = learns & (worse <= c.ceiling)
        loss = loss * learns
        loss.backward()
        with torch.no_grad():
            accuracies = (losses.accuracy_agent, losses.accuracy_demonstration)
            self._stats += torch.stack((entropy, losses.gradient, *accuracies))

    def _descend(self) -> None:
        self.optimizer.step()

    def _collect(self) -> None:
        """Statistics of features: as many frames of demonstrations as of the agent."""
        rows = self.draw_demonstrations(self.rows)
        self.norm.collect(self.demonstrations[rows].float())
        self.norm.collect(self.frames[-1].float(), self.whole[-1])
        self.norm.commit()

    # -- state ----------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that decides the next rewards and updates, by name."""
        state = learned_state(dict(self.net.named_parameters()), self.optimizer, "net.")
        state |= {f"norm.{key}": x for key, x in self.norm.state_dict().items()}
        state |= {f"replay.{key}": x for key, x in self.replay.state_dict().items()}
        tail = self.frames[self.steps :]
        return state | {"tail": tail, "age": self._age, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes a state back. Raises ValueError where it does not fit."""

        def part(prefix: str) -> dict[str, Tensor]:
            return {k[len(prefix) :]: v for k, v in state.items() if k.startswith(prefix)}

        own = dict(self.net.named_parameters())
        load_learned(own, self.optimizer, state, "net.", "discriminator")
        self.norm.load_state_dict(part("norm."))
        self.replay.load_state_dict(part("replay."))
        self.frames[self.steps :] = state["tail"].to(self.frames)
        self._age.copy_(state["age"])
        self.generator.set_state(state["generator"].cpu())


def of_athletes(
    env: Any,
    clips: Sequence[Path],
    steps: int,
    config: AMPConfig,
    device: torch.device,
    seed: int = 0,
    cuda_graph: bool = True,
    bf16: bool = False,
) -> AMP:
    """AMP for the athletes of an environment and demonstrations from files; the rest as for AMP.

    Raises ValueError for clips that cannot serve, see rl.style_features.load_demonstrations.
    """
    shown = load_demonstrations(clips, env, config.frames, config.mirror)
    rows = env.num_worlds * env.num_agents
    source = Athletes(env, device)
    return AMP(source, shown, rows, steps, config, device, seed, cuda_graph, bf16)
