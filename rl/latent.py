"""The latent prior, learned from the motion tracker (PULSE; Luo et al. 2024), read top to bottom.

A conditional variational autoencoder: an encoder that sees body and goal, a prior and a decoder
that see the body alone. The student's mean action drives the worlds, disturbed, while the frozen
tracker says at every state what it would do (DAgger; Ross et al. 2011); the student learns the
PD targets that follow from that, in the action units of every task of the body.
It takes the place of PPO in ``rl.train``: ``olympics-opt train prior --tracker RUN --clips ...``.

Shapes: T steps, M worlds, D observation, S of it the body, Z latent, n hinges.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from rl.annealing import annealed
from rl.graph import GraphedStep
from rl.latent_config import PriorConfig
from rl.latent_terms import awaken, gaussian_kl, hinge_weights, steered
from rl.learned import learned_state, load_learned
from rl.networks import autocast
from rl.policy import Policy
from rl.prior import FORMAT, LatentNets, body_digest, check_layout, self_layout
from rl.ranks import SharedGradients, SharedStep, own_rank
from rl.rollout import Rollout
from rl.tracker import TrackingEnv
from sports.turns import nearest_turn

KEEP = 0.99
"""Of a latent from step to step, in the smoothness term (PULSE)."""
ACTIVE = 0.01
"""Nats of mean KL divergence above which a dimension of the latent carries something."""
STATISTICS = ("loss", "action_error", "kl", "active", "smoothness", "beta", "reach")
"""What ``Distiller.update`` reports."""


class FrozenNormalizer:
    """The teacher's statistics of observations, as they are."""

    def __init__(self, mean: Tensor, std: Tensor, clip: float, count: float) -> None:
        self.mean, self.std, self.clip = mean.clone(), std.clone(), clip
        self.count = count

    def normalize(self, x: Tensor) -> Tensor:
        """(..., D) -> (..., D), clamped."""
        return ((x - self.mean) / self.std).clamp(-self.clip, self.clip)

    def commit(self) -> None:
        """Nothing: it does not learn."""


def absolute_action(env: TrackingEnv, residual: Tensor) -> Tensor:
    """(N, n) actions around the reference, clipped as the tracker's task does -> the actions
    (N, n) of any task that reach the same PD targets, (target - offset) / scale, unclipped.

    Where the clip's hinge angles are of another turn than the athlete's, its own count.
    """
    limited = residual.float().clamp(-1.0, 1.0)[:, None]
    targets = env.tracking.targets(env.view, env.memory, limited)[:, 0]
    targets, _ = nearest_turn(targets, env.physics.qpos[:, 7:])
    return (targets - env.action_offset) / env.action_scale


class Distiller:
    """The student, its optimiser, and the teacher that labels what it sees."""

    def __init__(
        self,
        env: TrackingEnv,
        teacher: Policy,
        config: PriorConfig,
        device: torch.device | str = "cpu",
        seed: int = 0,
        cuda_graph: bool = True,
        bf16: bool | None = None,
    ) -> None:
        """Args:
        env: worlds of ``rl.distillation``, with absolute PD targets for actions.
        teacher: a tracker.
        config: see PriorConfig.
        device: where networks and rollouts live.
        seed: of the first weights (equal on all ranks) and of the noise (mixed with the rank).
        cuda_graph: replay the minibatch step as a graph where that is possible.
        bf16: multiply in bf16; None for on a GPU only.

        Raises PolicyError for a teacher that does not fit, PriorError for observations that do
        not begin with the athlete's own body.
        """
        teacher.check(env)
        assert teacher.actor is not None
        self.env, self.config, self.device = env, config, torch.device(device)
        body = env.physics.scene.body
        layout = self_layout(body.num_links)
        check_layout(layout, env.obs_slices)
        self.self_size = layout["body_angvel"][1]
        teacher.to(self.device)
        self._teacher = teacher.actor
        clip, count = (teacher.metadata[k] for k in ("observation_clip", "obs_count"))
        self.obs_norm = FrozenNormalizer(teacher.mean, teacher.std, clip, count)
        weights = torch.Generator().manual_seed(seed)
        shape = config.shape(env.obs_size, self.self_size, env.action_size)
        self.nets = LatentNets(shape, weights).to(self.device)
        awaken(self.nets, config.start_sigma)
        self.nets.see_pose(body, teacher.mean, teacher.std)
        stiffness = torch.as_tensor(body.array("kp"), device=self.device)
        self._weights = hinge_weights(stiffness, config.stiffness)
        self.card: dict[str, Any] = {
            "format": FORMAT,
            "algo": "distillation",
            **shape.card(),
            "layout": layout,
            "body_digest": body_digest(body),
            "strength": body.strength,
            "limits": body.limits,
            "teacher": {
                k: teacher.metadata.get(k) for k in ("sha256", "samples", "library", "commit")
            },
        }
        """What a prior says about itself, beside what every run says."""
        rank, self.world_size = own_rank()
        self.generator = torch.Generator(self.device).manual_seed(seed + 1 + 1_000_003 * rank)

        def scalar(value: float) -> Tensor:
            return torch.tensor(value, dtype=torch.float32, device=self.device)

        self.learning_rate, self.beta = scalar(config.learning_rate), scalar(config.beta[0])
        self._steered = config.nats[0] > 0.0
        self.target = config.nats[0]
        """Nats to which beta is steered."""
        self.sigma = scalar(config.noise)
        """Of the noise on actions."""
        self.actor_weight = scalar(1.0)
        """Of no meaning here; the loop sets it."""
        cuda = self.device.type == "cuda"
        self.bf16 = cuda if bf16 is None else bf16
        self.obs_dtype = torch.bfloat16 if cuda and self.bf16 else torch.float32
        self.optimizer = torch.optim.Adam(
            self.nets.parameters(), lr=self.learning_rate, fused=True, capturable=cuda
        )
        self._stats = torch.zeros(3, device=self.device)
        self._divergence = torch.zeros(config.latent, device=self.device)
        self._batch: dict[str, Tensor] = {}
        wanted = cuda_graph and cuda
        self._step: GraphedStep | SharedStep
        if self.world_size == 1:
            self._step = GraphedStep(self._minibatch, self.optimizer.zero_grad, wanted)
        else:
            shared = SharedGradients(self.nets.parameters())
            self._step = SharedStep(shared, self._backward, self._descend, wanted)

    def new_rollout(self, rows: int) -> Rollout:
        """Storage for ``rows`` worlds. Raises ValueError if they are too few for minibatches."""
        c, shape = self.config, self.nets.shape
        if rows < c.minibatches:
            raise ValueError(
                f"{rows} worlds cannot be cut into {c.minibatches} minibatches: use more worlds or "
                "fewer minibatches"
            )
        sizes = (shape.obs_size, shape.action_size)
        return Rollout(c.steps, rows, *sizes, self.device, self.obs_dtype)

    def schedule(self, share: float) -> None:
        """Sets beta, or the divergence that it is steered to, and the learning rate for the part of
        the run that is done."""
        c = self.config
        if self._steered:
            self.target = annealed(*c.nats, share / c.nats_share)
        else:
            self.beta.fill_(annealed(*c.beta, share / c.beta_share))
        self.learning_rate.fill_(annealed(c.learning_rate, c.learning_rate_final, share))

    # -- acting ---------------------------------------------------------------------------------

    def _autocast(self) -> torch.autocast:
        return autocast(self.device, self.bf16)

    def prepare(self, obs: Tensor) -> Tensor:
        """(M, D) raw observations -> normalised, in the storage type. NaN becomes 0."""
        return self.obs_norm.normalize(torch.nan_to_num(obs)).to(self.obs_dtype)

    @torch.no_grad()
    def act(self, obs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """obs (M, D) raw, of the worlds as they are -> stored obs (M, D), the student's disturbed
        action (M, n), the action that the teacher would take (M, n), whether one can reach its
        targets or not, zeros (M,). Of the worlds that play alone the student's follows no clip."""
        stored = self.prepare(obs)
        with self._autocast():
            residual = self._teacher(stored)
            latent, _ = self.nets.posterior(stored)
            if self.config.alone > 0.0:
                mean, logvar = self.nets.expected(stored[:, : self.self_size])
                drawn = torch.randn(mean.shape, device=self.device, generator=self.generator)
                row = torch.arange(len(mean), device=self.device)
                # The last ones: noise is of the first.
                alone = row >= (1.0 - self.config.alone) * len(mean)
                drawn = mean + (0.5 * logvar).exp() * drawn
                latent = torch.where(alone[:, None], drawn, latent)
            action = self.nets.decode(stored[:, : self.self_size], latent)
        label = absolute_action(self.env, residual.to(self.env.device)).to(self.device)
        if self.nets.part is not None:
            label = self.nets.part.as_seen(stored, label)
        label = torch.nan_to_num(label)  # of a world that diverges, which counts for nothing
        noisy = torch.arange(len(action), device=self.device) < self.config.noisy * len(action)
        noise = torch.randn(action.shape, device=self.device, generator=self.generator)
        action = action + self.sigma * noisy[:, None] * noise
        return stored, action, label, torch.zeros(len(action), device=self.device)

    # -- learning -------------------------------------------------------------------------------

    def update(self, rollout: Rollout) -> dict[str, Tensor]:
        """Learns from a rollout; the next one may overwrite it. Returns () statistics.

        loss; action_error: L2 norm of the reconstructed action's error (action units, hinges by
        weight); kl: nats of the posterior from the prior; active: dimensions of the latent with
        more than ACTIVE nats; smoothness; beta, of this update; reach: share of the teacher's
        targets that no action reaches.
        """
        c = self.config
        self._prepare_batch(rollout)
        self._stats.zero_()
        self._divergence.zero_()
        for _ in range(c.epochs):
            noise = self._batch["noise"]
            noise.normal_(generator=self.generator)
            order = torch.randperm(rollout.rows, device=self.device, generator=self.generator)
            for rows in order.split(rollout.rows // c.minibatches)[: c.minibatches]:
                self._step(rows)
        beyond = (rollout.mean.abs() > 1.0).float().mean(-1)
        beyond = (beyond * rollout.valid).sum() / rollout.valid.sum().clamp(min=1)
        whole = torch.cat((self._stats, self._divergence)) / (c.epochs * c.minibatches)
        whole = torch.cat((whole, beyond[None]))
        if self.world_size > 1:
            dist.all_reduce(whole)
            whole /= self.world_size
        loss, error, smoothness = whole[:3].unbind()
        divergence, beyond = whole[3:-1], whole[-1]
        active = (divergence > ACTIVE).sum().float()
        numbers = (loss, error, divergence.sum(), active, smoothness, self.beta.clone(), beyond)
        if self._steered:
            self.beta.copy_(steered(self.beta, divergence.sum(), self.target, c.steer))
        return dict(zip(STATISTICS, numbers))

    def _prepare_batch(self, r: Rollout) -> None:
        """What every minibatch reads, (T, M, ...), always at the same addresses."""
        if self._step.graph is not None and self._batch["obs"].data_ptr() != r.obs.data_ptr():
            raise ValueError("the captured update reads the first rollout: fill that one again")
        weight = r.valid.float()
        going = weight[:-1] * weight[1:] * ~(r.terminated | r.truncated)[:-1]
        latent = self.config.latent
        noise = self._batch.get("noise")
        if noise is None:
            noise = torch.zeros(*r.obs.shape[:2], latent, device=self.device)
            self._batch = {"obs": r.obs, "label": r.mean, "noise": noise}
            self._batch |= {"weight": weight, "going": going}
        else:
            self._batch["weight"].copy_(weight)
            self._batch["going"].copy_(going)

    def losses(self, obs: Tensor, label: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(T, m, D) normalised, (T, m, n), (T, m, Z) -> error (T, m), KL divergence (T, m, Z),
        smoothness (T - 1, m)."""
        body = obs[..., : self.self_size]
        with self._autocast():
            mean, logvar = self.nets.posterior(obs)
            mean_p, logvar_p = self.nets.expected(body)
            action = self.nets.decode(body, mean + (0.5 * logvar).exp() * noise)
        off = self._weights * (action - label.clamp(-1.0, 1.0))
        error = torch.linalg.vector_norm(off, dim=-1)
        divergence = gaussian_kl(mean, logvar, mean_p, logvar_p)
        moved = torch.linalg.vector_norm(mean[1:] - KEEP * mean[:-1], dim=-1)
        return error, divergence, moved

    def _minibatch(self, rows: Tensor) -> None:
        """One gradient step on all steps of worlds ``rows`` (m,)."""
        self.optimizer.zero_grad(set_to_none=True)
        self._backward(rows)
        self._descend()

    def _backward(self, rows: Tensor) -> None:
        """Adds the gradients of worlds ``rows`` (m,) and their statistics."""
        c = self.config
        b = {name: x[:, rows] for name, x in self._batch.items()}
        error, divergence, moved = self.losses(b["obs"], b["label"], b["noise"])

        def mean(x: Tensor, weight: Tensor) -> Tensor:
            return (weight * x).sum() / weight.sum().clamp(min=1.0)

        weight = b["weight"]
        parts = torch.stack((mean(error, weight), mean(moved, b["going"])))
        each = (weight[..., None] * divergence).sum((0, 1)) / weight.sum().clamp(min=1.0)
        loss = parts[0] + self.beta * each.sum() + c.smooth * parts[1]
        loss.backward()
        with torch.no_grad():
            self._stats += torch.cat((loss[None], parts))
            self._divergence += each

    def _descend(self) -> None:
        nn.utils.clip_grad_norm_(self.nets.parameters(), self.config.grad_norm, foreach=True)
        self.optimizer.step()

    # -- state ----------------------------------------------------------------------------------

    def _digest(self) -> Tensor:
        return torch.tensor(list(str(self.card["teacher"]["sha256"]).encode()), dtype=torch.uint8)

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that decides the next update, by name, and the normaliser."""
        state = learned_state(dict(self.nets.named_parameters()), self.optimizer, "nets.")
        norm = {f"normalizer.{k}": getattr(self.obs_norm, k) for k in ("mean", "std")}
        own = {"teacher": self._digest(), "generator": self.generator.get_state()}
        own["beta"] = self.beta.clone()
        return state | norm | own

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes a state back. Raises ValueError where it or the teacher does not fit."""
        if "teacher" not in state or not torch.equal(state["teacher"], self._digest()):
            raise ValueError("the run learned from another tracker: resume it with that one")
        load_learned(dict(self.nets.named_parameters()), self.optimizer, state, "nets.")
        self.generator.set_state(state["generator"].cpu())
        if "beta" in state:  # not of runs before beta was steered
            self.beta.copy_(state["beta"])
