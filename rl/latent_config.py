"""Options of the distillation of the tracker into a latent prior."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal

from rl.prior import Shape


@dataclass(frozen=True)
class PriorConfig:
    """Options of the distillation."""

    split: Literal["train", "held_out", "all"] = "train"
    """Clips of the library to learn from, as of the tracker."""
    latent: int = 32
    """Numbers of a latent; 48 suits the athlete with fingers."""
    encoder: tuple[int, ...] = (1024, 512)
    """Hidden layers. Those of the paper are 1536 1024 512, and 3096 2048 1024 for the decoder; the
    defaults are 4 M weights, enough for an hour of motion."""
    prior: tuple[int, ...] = (512, 512)
    """Hidden layers."""
    decoder: tuple[int, ...] = (1024, 1024, 512)
    """Hidden layers."""
    pose: bool = True
    """The decoder says how far PD targets are from the pose, and the encoder sees how far the
    reference's pose is from the athlete's; else they learn hinge angles from rotations."""
    stiffness: float = 0.5
    """The error of a hinge counts by this power of its servo's stiffness; 0 for all alike."""
    nats: tuple[float, float] = (60.0, 28.0)
    """KL divergence of the posterior from the prior to which beta is steered, first and last; 0 0
    for a beta that falls as ``beta`` says."""
    nats_share: float = 0.6
    """Part of the run over which that falls, geometrically."""
    steer: float = 0.1
    """Largest change of log beta in an iteration."""
    beta: tuple[float, float] = (0.0001, 0.001)
    """Weight of the KL divergence (nats), first and, where it is not steered, last. PULSE: 0.01
    0.001, where a latent carries nothing before the encoder has learned what would be worth it."""
    beta_share: float = 0.7
    """Part of the run over which beta goes from first to last, geometrically."""
    start_sigma: float = 0.22
    """Of the posterior at first; below 1, that of the prior, a latent is no mere noise."""
    smooth: float = 0.0005
    """Weight of |mu_t - 0.99 mu_(t-1)|; PULSE: 0.005."""
    steps: int = 24
    """Control steps per world and iteration."""
    minibatches: int = 32
    """Minibatches (of worlds) per epoch."""
    epochs: int = 4
    """Passes over the rollout per iteration."""
    learning_rate: float = 1e-3
    """Of Adam, at first."""
    learning_rate_final: float = 1e-4
    """At the end of the run, reached geometrically."""
    grad_norm: float = 10.0
    """Gradients are scaled down to this norm."""
    noise: float = 0.02
    """Standard deviation (action units, 1 = pi rad) of noise on the actions of noisy worlds."""
    noisy: float = 0.5
    """Share of the worlds with noise."""
    alone: float = 0.1
    """Share of the worlds that act by latents drawn from the prior, whatever their clip; the
    tracker's answer is the way back from where the prior leads."""
    push_seconds: float = 2.0
    """Mean time between pushes of a world; 0 for none."""
    push: float = 0.7
    """Largest change of the root's velocity by a push (m/s), in each horizontal direction."""
    fallen: float = 0.05
    """Share of episodes that start with a fall."""
    tolerance: float = 0.5
    """Distance (m) of any link but the feet from the reference at which an episode ends."""

    def __post_init__(self) -> None:
        sizes = (self.latent, *self.encoder, *self.prior, *self.decoder)
        if min(*sizes, self.steps - 1, self.minibatches, self.epochs) < 1:
            raise ValueError("sizes, minibatches and epochs must be at least 1, steps at least 2")
        rates = (self.learning_rate, self.learning_rate_final)
        if min(*self.beta, *rates, self.tolerance, self.start_sigma, self.steer) <= 0.0:
            raise ValueError(
                "beta, learning rates, tolerance, start_sigma and steer must be positive"
            )
        if min(self.smooth, self.noise, self.push_seconds, self.push, self.stiffness) < 0.0:
            raise ValueError("smooth, noise, pushes and stiffness must not be negative")
        if min(self.nats) <= 0.0 and self.nats != (0.0, 0.0):
            raise ValueError("nats must be positive, or 0 0 for a beta that is not steered")
        parts = (self.beta_share, self.nats_share)
        if not all(0.0 <= s <= 1.0 for s in (self.noisy, self.alone, self.fallen)) or not all(
            0.0 < s <= 1.0 for s in parts
        ):
            raise ValueError(
                "noisy, alone and fallen must lie in [0, 1], beta_share and nats_share in (0, 1]"
            )

    def shape(self, obs_size: int, self_size: int, action_size: int) -> Shape:
        """The networks' sizes for an athlete."""
        hidden = (self.encoder, self.prior, self.decoder)
        return Shape(obs_size, self_size, action_size, self.latent, *hidden, pose=self.pose)


def options_of(options: dict[str, Any]) -> PriorConfig:
    """A PriorConfig from the options of a run, lists of JSON or tuples. Raises ValueError."""
    known = {f.name for f in fields(PriorConfig)}
    if unknown := sorted(set(options) - known):
        raise ValueError(f"the distillation has no option '{unknown[0]}'")
    plain: Any = {k: tuple(v) if isinstance(v, list) else v for k, v in options.items()}
    return PriorConfig(**plain)
