"""The formulas of PPO, for a Gaussian policy of one sigma: each sample's part of the losses."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def gaussian_log_prob(
    action: Tensor, mean: Tensor, sigma: Tensor, noisy: Tensor | None = None
) -> Tensor:
    """(...) log density of action (..., U) under N(mean, sigma^2), float32; of the parts where
    ``noisy`` (U,) is 1, if it is given. (The constant is that of all U: ratios do not see it.)"""
    z = (action - mean) / sigma
    if noisy is not None:
        z = z * noisy
    constant = action.shape[-1] * (sigma.log() + 0.5 * math.log(2.0 * math.pi))
    return -0.5 * z.square().sum(-1) - constant


def gaussian_divergence(
    mean: Tensor, other: Tensor, sigma: Tensor, noisy: Tensor | None = None
) -> Tensor:
    """(...) KL divergence (nats) between N(mean, sigma^2) and N(other, sigma^2), (..., U) each:
    |mean - other|^2 / (2 sigma^2), whichever comes first; of the parts where ``noisy`` is 1."""
    apart = mean - other if noisy is None else (mean - other) * noisy
    return apart.square().sum(-1) / (2.0 * sigma.square())


def surrogate_loss(ratio: Tensor, advantage: Tensor, clip_ratio: float) -> Tensor:
    """(...) -min(ratio A, clip(ratio) A). Source: Schulman et al. 2017, eq. 7."""
    clipped = ratio.clamp(1.0 - clip_ratio, 1.0 + clip_ratio)
    return -torch.minimum(ratio * advantage, clipped * advantage)


def clipped_value_error(
    value: Tensor, target: Tensor, before: Tensor, value_clip: float | None
) -> Tensor:
    """(...) squared error of a value; where it has left ``before`` by more than ``value_clip``, not
    less than at that distance. None for the plain one."""
    error = (value - target).square()
    if value_clip is None:
        return error
    moved = before + (value - before).clamp(-value_clip, value_clip)
    return torch.maximum(error, (moved - target).square())


def bounds_excess(mean: Tensor) -> Tensor:
    """(...) squared excess of |mean| (..., U) over 1, summed over the action."""
    return (mean.abs() - 1.0).clamp(min=0.0).square().sum(-1)
