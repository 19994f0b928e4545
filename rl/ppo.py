"""Proximal policy optimisation (Schulman et al. 2017), read top to bottom.

A Gaussian policy of fixed or scheduled sigma, a critic on normalised returns, clipped surrogate,
a penalty on means outside the action bounds, and a learning rate that follows the KL divergence.
Matrix products run in bf16 on a GPU; log-probabilities, advantages, statistics and the optimiser
stay in float32 or better. Between two ``update`` calls nothing waits for the device, and the
minibatch step is replayed as one CUDA graph. The formulas are in ``rl.ppo_losses``.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace

import torch
import torch.distributed as dist
from torch import Tensor, nn

from rl.annealing import annealed
from rl.graph import GraphedStep
from rl.learned import learned_state, load_learned
from rl.networks import MLP, Activation, autocast
from rl.normalizer import Normalizer
from rl.ppo_losses import (
    bounds_excess,
    clipped_value_error,
    gaussian_divergence,
    gaussian_log_prob,
    surrogate_loss,
)
from rl.ranks import SharedGradients, SharedStep, own_rank
from rl.rollout import Rollout, generalized_advantages


@dataclass(frozen=True)
class PPOConfig:
    """Hyper-parameters of PPO."""

    hidden: tuple[int, ...] = (1024, 512, 256)
    """Hidden layers of actor and critic."""
    activation: Activation = "silu"
    """Nonlinearity of both."""
    steps: int = 24
    """Control steps per world and iteration."""
    minibatches: int = 8
    """Minibatches per epoch."""
    epochs: int = 4
    """Passes over the rollout per iteration."""
    gamma: float = 0.99
    """Discount per control step."""
    lam: float = 0.95
    """Decay of the generalised advantage."""
    clip_ratio: float = 0.2
    """Probability ratios beyond 1 +- this earn nothing."""
    sigma: float = 0.12
    """Standard deviation of the policy in action units (1 = the bound)."""
    sigma_final: float | None = None
    """Standard deviation at the end of the run, reached geometrically; None keeps ``sigma``."""
    learning_rate: float = 1e-4
    """First learning rate of the actor. With the KL control, an actor that begins as another policy
    begins at the least rate of ``learning_rate_limits``: Adam's first steps are of full length
    whatever the gradient's noise, and the control comes only after them."""
    critic_learning_rate: float = 5e-4
    """Learning rate of the critic, constant."""
    kl_band: tuple[float, float] | None = (0.008, 0.03)
    """The actor's rate falls where the KL divergence of a minibatch (nats, summed over the action)
    is above the band and rises where it is below; None keeps it constant."""
    kl_band_final: tuple[float, float] | None = None
    """The band at the end of the run, reached geometrically; None keeps the first one. Where the
    gradient is mostly noise, what is learned at the end is what smaller steps average."""
    learning_rate_limits: tuple[float, float] = (1e-6, 1e-3)
    """The KL control stays between these. The divergence of a step grows with 1 / sigma^2: at sigma
    0.012 and a floor of 1e-5 it stood at twice the band's upper end, and success no longer rose."""
    learning_rate_factor: float = 1.5
    """One step of the KL control."""
    bounds_coefficient: float = 10.0
    """Weight of the squared excess of |mean| over 1, summed over the action."""
    entropy_coefficient: float = 0.0
    """Must be 0: sigma is not learned, so the entropy has no gradient."""
    critic_coefficient: float = 1.0
    """Weight of the squared error of the normalised value."""
    value_clip: float | None = None
    """Values may move this far (normalised) from the rollout's; None for no clipping."""
    grad_norm: float = 1.0
    """Gradients of actor and critic are each scaled down to this norm."""
    observation_clip: float = 5.0
    """Normalised observations are clamped to +- this."""
    moving_statistics: bool = False
    """Whether the statistics of observations go on moving under an actor that began as another
    policy, or was cloned. They move the actor: with a third of new samples and no learning at all a
    thrower of 28 m throws 15 m and a hurdler that always finishes never does."""
    critic_warmup: int = 5
    """Iterations in which only the critic learns, after a start from a policy without one, or with
    one that learned at another discount, with other rewards or with other options of the task."""
    anchor: float = 0.0
    """Cost of each nat by which an actor that began as another policy diverges from that one,
    beside advantages of unit deviation: where they say little it stays what it was, where they say
    much it moves. 0 lets it go."""

    def kl_band_at(self, share: float) -> tuple[float, float] | None:
        """The band in the part of the run that is done, ``share`` in 0..1."""
        if self.kl_band is None or self.kl_band_final is None:
            return self.kl_band
        (low, high), (last_low, last_high) = self.kl_band, self.kl_band_final
        return annealed(low, last_low, share), annealed(high, last_high, share)

    def __post_init__(self) -> None:
        if self.entropy_coefficient != 0.0:
            raise ValueError("entropy_coefficient must be 0: this policy's sigma is not learned")
        if not 0.0 < self.sigma or (self.sigma_final is not None and self.sigma_final <= 0.0):
            raise ValueError(f"sigma must be positive, not {self.sigma}, {self.sigma_final}")
        if self.kl_band_final is not None and self.kl_band is None:
            raise ValueError("kl_band_final needs a kl_band to begin with")
        if min(self.steps, self.minibatches, self.epochs) < 1:
            raise ValueError("steps, minibatches and epochs must be at least 1")
        if self.anchor < 0.0:
            raise ValueError(f"anchor must not be negative: {self.anchor}")
        if self.anchor > 0.0 and self.moving_statistics:
            raise ValueError("moving_statistics would move the anchor too: leave one of them out")


LESSON = 0.1
"""Weight of the divergence (nats) of parts without noise from their labels. At 1 the lesson's
noise, not the rewards, decides where Adam steps."""

LOSSES = ("kl", "clip_fraction", "policy_loss", "value_loss", "bounds_loss", "anchor_loss")
"""What a minibatch comes to."""
STATISTICS = (*LOSSES, "explained_variance")
"""What ``PPO.update`` reports."""

PAPER = replace(
    PPOConfig(),
    # The table of the SMPLOlympics paper ...
    learning_rate=5e-4,
    critic_learning_rate=5e-4,
    kl_band=None,
    clip_ratio=0.2,
    gamma=0.99,
    sigma=0.05,
    hidden=(2048, 1024, 512),
    minibatches=64,  # of 1024 samples at 2048 worlds
    # ... and what only its released configuration says.
    steps=32,
    epochs=6,
    lam=0.95,
    critic_coefficient=5.0,
    bounds_coefficient=10.0,
    grad_norm=50.0,
    value_clip=0.2,
)
"""Hyper-parameters of the SMPLOlympics paper (arXiv 2407.00187); run it with 2048 worlds."""


def adapted_rate(rate: Tensor, kl: Tensor, config: PPOConfig, band: Tensor | None = None) -> Tensor:
    """() learning rate after a minibatch of divergence ``kl``, on the device; ``band`` (2,) instead
    of the configuration's."""
    if config.kl_band is None:
        return rate
    (low, high), (least, most) = config.kl_band, config.learning_rate_limits
    if band is not None:
        low, high = band.unbind()
    slower = (rate / config.learning_rate_factor).clamp(min=least)
    faster = (rate * config.learning_rate_factor).clamp(max=most)
    return torch.where(kl > high, slower, torch.where(kl < low, faster, rate))


class PPO:
    """Actor, critic, their normalisers and their optimiser."""

    def __init__(
        self,
        obs_size: int,
        action_size: int,
        config: PPOConfig,
        device: torch.device | str = "cpu",
        seed: int = 0,
        cuda_graph: bool = True,
        bf16: bool | None = None,
    ) -> None:
        """Args:
        obs_size: features D of an observation.
        action_size: numbers U in an action.
        config: hyper-parameters.
        device: where networks and rollouts live.
        seed: of the first weights (equal on all ranks) and of the noise (mixed with the rank).
        cuda_graph: replay the minibatch step as a graph where that is possible.
        bf16: multiply in bf16; None for on a GPU only.
        """
        self.config, self.device = config, torch.device(device)
        weights = torch.Generator().manual_seed(seed)
        self.actor = MLP(obs_size, config.hidden, action_size, config.activation, 0.01, weights)
        self.critic = MLP(obs_size, config.hidden, 1, config.activation, 1.0, weights)
        self.actor.to(self.device)
        self.critic.to(self.device)
        self.obs_norm = Normalizer(obs_size, self.device, clip=config.observation_clip)
        self.value_norm = Normalizer(1, self.device, clip=math.inf)
        rank, self.world_size = own_rank()
        self.generator = torch.Generator(self.device).manual_seed(seed + 1 + 1_000_003 * rank)

        def scalar(value: float) -> Tensor:
            return torch.tensor(value, dtype=torch.float32, device=self.device)

        self.sigma = scalar(config.sigma)
        self.learning_rate = scalar(config.learning_rate)
        self.kl_band = torch.tensor(config.kl_band or (0.0, 0.0), device=self.device)
        """(2,) of the present part of the run."""
        self.actor_weight = scalar(1.0)
        """0 while only the critic learns."""
        self.noisy = torch.ones(action_size, device=self.device)
        """(U,) 1 where the action has noise and the policy gradient counts; 0 elsewhere."""
        self.labels: Tensor | None = None
        """(T, M, U) what the parts without noise are to be in the rollout's states; None: nothing.
        To be set before the first update and filled in place: graphs read it."""
        cuda = self.device.type == "cuda"
        self.bf16 = cuda if bf16 is None else bf16
        self.obs_dtype = torch.bfloat16 if cuda and self.bf16 else torch.float32
        critic_rate = scalar(config.critic_learning_rate)
        groups = [
            {"params": list(self.actor.parameters()), "lr": self.learning_rate},
            {"params": list(self.critic.parameters()), "lr": critic_rate},
        ]
        self.optimizer = torch.optim.Adam(groups, fused=True, capturable=cuda)
        self.anchor: MLP | None = None
        """What the actor began as, if the configuration holds it there."""
        self._stats = torch.zeros(len(LOSSES), device=self.device)
        self._batch: dict[str, Tensor] = {}
        wanted = cuda_graph and cuda
        self._step: GraphedStep | SharedStep
        if self.world_size == 1:
            self._step = GraphedStep(self._minibatch, self.optimizer.zero_grad, wanted)
        else:
            shared = SharedGradients(self._named_parameters().values(), self._stats.numel())
            self._step = SharedStep(
                shared,
                lambda rows: shared.numbers.copy_(self._backward(rows)),
                lambda: self._descend(shared.numbers),
                wanted,
            )

    def new_rollout(self, rows: int) -> Rollout:
        """Storage for ``rows`` = worlds x agents. Raises ValueError if too few for minibatches."""
        c = self.config
        if c.steps * rows < c.minibatches:
            raise ValueError(
                f"{c.steps} steps of {rows} worlds x agents cannot be cut into {c.minibatches} "
                "minibatches: use more worlds or fewer minibatches"
            )
        sizes = (self.obs_norm.mean.numel(), self.actor.head.out_features)
        return Rollout(c.steps, rows, *sizes, self.device, self.obs_dtype)

    def schedule(self, share: float) -> None:
        """Sets sigma and the KL band for the part of the run that is done, 0..1."""
        c = self.config
        if c.kl_band_final is not None:
            for i, end in enumerate(c.kl_band_at(share) or ()):
                self.kl_band[i] = end
        if c.sigma_final is not None:
            self.sigma.fill_(annealed(c.sigma, c.sigma_final, share))

    # -- acting ---------------------------------------------------------------------------------

    def autocast(self) -> torch.autocast:
        """How the networks multiply: in bf16 where that was asked for."""
        return autocast(self.device, self.bf16)

    def prepare(self, obs: Tensor) -> Tensor:
        """(M, D) raw observations -> normalised, in the storage type. NaN becomes 0."""
        return self.obs_norm.normalize(torch.nan_to_num(obs)).to(self.obs_dtype)

    @torch.no_grad()
    def act(
        self, obs: Tensor, weight: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """obs (M, D) raw -> stored obs (M, D), action (M, U), mean (M, U), log-prob (M,).

        ``weight`` (M,) of 0 or 1: which rows the observation statistics take in; None for all.
        """
        self.obs_norm.collect(torch.nan_to_num(obs), weight)
        stored = self.prepare(obs)
        with self.autocast():
            mean = self.actor(stored)
        noise = torch.randn(mean.shape, device=self.device, generator=self.generator)
        action = mean + self.sigma * self.noisy * noise
        return stored, action, mean, self.log_prob(action, mean)

    def log_prob(self, action: Tensor, mean: Tensor) -> Tensor:
        """(...) log density of those parts of action (..., U) that have noise.

        Of a part without noise the action is the mean that it was drawn at: any step of that mean
        would lower its density, after good actions and bad ones alike.
        """
        return gaussian_log_prob(action, mean, self.sigma, self.noisy)

    @torch.no_grad()
    def value(self, stored: Tensor) -> Tensor:
        """(..., D) stored observations -> (...) discounted return expected (scaled reward)."""
        with self.autocast():
            return self.value_norm.denormalize(self.critic(stored)).squeeze(-1)

    # -- learning -------------------------------------------------------------------------------

    def update(self, rollout: Rollout, picks: Tensor | None = None) -> dict[str, Tensor]:
        """Learns from a rollout; the next one may overwrite it. Returns () statistics.

        ``picks``: of its T M samples the indices of those to learn from, always as many (the others
        must not be ``valid``); None for all.

        kl, clip_fraction, policy_loss, value_loss, bounds_loss, and anchor_loss, the divergence
        from what the actor began as (nats; 0 without an anchor): means over all minibatches;
        explained_variance: of the returns by the critic before the update.
        """
        c = self.config
        value = self._compute_advantages(rollout)
        self.value_norm.collect(rollout.returns, rollout.valid)
        self.value_norm.commit()
        size = rollout.steps * rollout.rows if picks is None else len(picks)
        self._prepare_batch(rollout, value, size)
        self._stats.zero_()
        for _ in range(c.epochs):
            order = torch.randperm(size, device=self.device, generator=self.generator)
            order = order if picks is None else picks[order]
            for rows in order.split(size // c.minibatches)[: c.minibatches]:
                self._step(rows)
        self.obs_norm.commit()
        unexplained = (rollout.returns - value).var() / rollout.returns.var().clamp(min=1e-8)
        means = self._stats / (c.epochs * c.minibatches)
        return dict(zip(STATISTICS, (*means.unbind(), 1.0 - unexplained)))

    def _compute_advantages(self, r: Rollout) -> Tensor:
        """Fills advantages and returns of the rollout; returns its values (T, M)."""
        value, next_value = self.value(r.obs), self.value(r.final_obs)
        c, ends = self.config, (r.terminated, r.truncated, r.valid)
        advantages, returns = generalized_advantages(
            r.reward, value, next_value, *ends, c.gamma, c.lam
        )
        r.advantages.copy_(advantages)
        r.returns.copy_(returns)
        return value

    def _prepare_batch(self, r: Rollout, value: Tensor, size: int) -> None:
        """Flat views (T M, ...) and the quantities that every minibatch of ``size`` picked samples
        needs."""
        if self._step.graph is not None and self._batch["obs"].data_ptr() != r.obs.data_ptr():
            raise ValueError("the captured update reads the first rollout: fill that one again")
        valid = r.valid.double()
        a = r.advantages.double()
        sums = torch.stack((valid.sum(), (valid * a).sum(), (valid * a * a).sum()))
        total = float(size * self.world_size)
        if self.world_size > 1:
            dist.all_reduce(sums)
        count = sums[0].clamp(min=1.0)
        mean = sums[1] / count
        std = (sums[2] / count - mean.square()).clamp(min=0.0).sqrt()
        batch = {
            "obs": r.obs,
            "action": r.action,
            "mean": r.mean,
            "log_prob": r.log_prob,
            "advantage": (a - mean) / (std + 1e-8),
            "target": self.value_norm.normalize(r.returns),
            "value": self.value_norm.normalize(value),
            # Averages over a minibatch of these weights are averages over its valid samples.
            "weight": valid * (total / count),
        }
        if self.labels is not None:
            batch["label"] = self.labels
        if self.anchor is not None:
            with torch.no_grad(), self.autocast():
                batch["first_mean"] = self.anchor(r.obs)
        for name, x in batch.items():
            flat = x.flatten(0, 1)
            if name in ("obs", "action", "mean", "log_prob", "label"):
                self._batch[name] = flat  # views of the rollout: the addresses stay
            elif name in self._batch:
                self._batch[name].copy_(flat)
            else:
                self._batch[name] = flat.float()

    def _minibatch(self, rows: Tensor) -> None:
        """One gradient step of actor and critic on the samples ``rows`` (m,) of the batch."""
        self.optimizer.zero_grad(set_to_none=True)
        self._descend(self._backward(rows))

    def _backward(self, rows: Tensor) -> Tensor:
        """Adds the gradients of the samples ``rows`` (m,). Returns their statistics: (6,), in the
        order of ``LOSSES``."""
        c, b = self.config, {name: x[rows] for name, x in self._batch.items()}
        weight = b["weight"]
        with self.autocast():
            mean = self.actor(b["obs"])
            value = self.critic(b["obs"]).squeeze(-1)
        ratio = (self.log_prob(b["action"], mean) - b["log_prob"]).exp()
        policy_loss = (weight * surrogate_loss(ratio, b["advantage"], c.clip_ratio)).mean()
        bounds_loss = (weight * bounds_excess(mean)).mean()
        error = clipped_value_error(value, b["target"], b["value"], c.value_clip)
        value_loss = (weight * error).mean()
        actor_loss = policy_loss + c.bounds_coefficient * bounds_loss
        anchor_loss = torch.zeros_like(policy_loss)
        if self.anchor is not None:
            left = gaussian_divergence(mean, b["first_mean"], self.sigma, self.noisy)
            anchor_loss = (weight * left).mean()
            actor_loss = actor_loss + c.anchor * anchor_loss
        if self.labels is not None:
            taught = gaussian_divergence(mean, b["label"], self.sigma, 1.0 - self.noisy)
            actor_loss = actor_loss + LESSON * (weight * taught).mean()
        (self.actor_weight * actor_loss + c.critic_coefficient * value_loss).backward()
        with torch.no_grad():
            divergence = gaussian_divergence(mean, b["mean"], self.sigma, self.noisy)
            kl = (weight * divergence).mean()
            clipped = (weight * ((ratio - 1.0).abs() > c.clip_ratio)).mean()
            losses = (policy_loss, value_loss, bounds_loss, anchor_loss)
            return torch.stack((kl, clipped, *losses))

    @torch.no_grad()
    def _descend(self, stats: Tensor) -> None:
        """Steps along the gradients; ``stats`` (6,) of the samples decide the actor's rate."""
        c = self.config
        adapted = adapted_rate(self.learning_rate, stats[0], c, self.kl_band)
        # A resting actor diverges from nothing: its rate must not climb meanwhile.
        self.learning_rate.copy_(torch.lerp(self.learning_rate, adapted, self.actor_weight))
        self._stats += stats
        nn.utils.clip_grad_norm_(self.actor.parameters(), c.grad_norm, foreach=True)
        nn.utils.clip_grad_norm_(self.critic.parameters(), c.grad_norm, foreach=True)
        self.optimizer.step()

    # -- state ----------------------------------------------------------------------------------

    def _named_parameters(self) -> dict[str, nn.Parameter]:
        return {
            f"{part}.{name}": p
            for part, module in (("actor", self.actor), ("critic", self.critic))
            for name, p in module.named_parameters()
        }

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that decides the next update, by name: weights, moments, rates, noise."""
        state = learned_state(self._named_parameters(), self.optimizer)
        for part, norm in (("obs_norm", self.obs_norm), ("value_norm", self.value_norm)):
            state |= {f"{part}.{key}": x for key, x in norm.state_dict().items()}
        if self.anchor is not None:
            state |= {f"anchor.{name}": x for name, x in self.anchor.state_dict().items()}
        state |= {"sigma": self.sigma, "learning_rate": self.learning_rate}
        return state | {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes a state back. Raises ValueError where it does not fit."""
        load_learned(self._named_parameters(), self.optimizer, state)
        first = {k.removeprefix("anchor."): x for k, x in state.items() if k.startswith("anchor.")}
        if first:
            self._hold_to(first)
        for part, norm in (("obs_norm", self.obs_norm), ("value_norm", self.value_norm)):
            keys = [k for k in ("total", "pending", "kept") if f"{part}.{k}" in state]
            norm.load_state_dict({key: state[f"{part}.{key}"] for key in keys})
        self.sigma.copy_(state["sigma"])
        self.learning_rate.copy_(state["learning_rate"])
        self.generator.set_state(state["generator"].cpu())

    def load_policy(
        self, actor: nn.Module, mean: Tensor, std: Tensor, count: float, seen: Tensor | None = None
    ) -> None:
        """Starts from another policy's actor and observation statistics, which stay as they are for
        the features (D,) bool that it has ``seen``; None for all. Raises ValueError."""
        try:
            self.actor.load_state_dict(actor.state_dict())
        except RuntimeError as error:
            raise ValueError(f"the policy's network does not fit the run's: {error}") from error
        if self.config.anchor > 0.0:
            self._hold_to(self.actor.state_dict())
        self.obs_norm.set_moments(count, mean, std)
        self.keep_statistics(torch.ones_like(mean, dtype=torch.bool) if seen is None else seen)
        if self.config.kl_band is not None:
            self.learning_rate.clamp_(max=self.config.learning_rate_limits[0])

    def _hold_to(self, weights: dict[str, Tensor]) -> None:
        self.anchor = copy.deepcopy(self.actor).requires_grad_(False)
        self.anchor.load_state_dict(weights)

    def keep_statistics(self, seen: Tensor) -> None:
        """Observation statistics of the features ``seen`` (D,) bool stay as they are, unless the
        configuration lets them move."""
        if not self.config.moving_statistics:
            self.obs_norm.keep(seen)

    def load_critic(self, extra: dict[str, Tensor]) -> bool:
        """Takes a critic and its statistics where ``extra`` has one that fits; whether it did."""
        weights = {k.removeprefix("critic."): v for k, v in extra.items() if "critic." in k}
        own = self.critic.state_dict()
        if {k: v.shape for k, v in weights.items()} != {k: v.shape for k, v in own.items()}:
            return False
        self.critic.load_state_dict(weights)
        keys = ("total", "pending")
        self.value_norm.load_state_dict({key: extra[f"value_norm.{key}"] for key in keys})
        return True
