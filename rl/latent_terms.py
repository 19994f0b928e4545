"""Terms of the distillation's loss, and what keeps its latents in use."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rl.prior import HEAD_GAIN, LatentNets

BETA = (1e-7, 0.1)
"""Where a steered beta stays."""


def gaussian_kl(mean: Tensor, logvar: Tensor, mean_p: Tensor, logvar_p: Tensor) -> Tensor:
    """(..., Z) KL divergence (nats) of N(mean, exp logvar) from N(mean_p, exp logvar_p), float32.

    0.5 (log s_p^2 - log s^2 + (s^2 + (m - m_p)^2) / s_p^2 - 1).
    """
    mean, logvar, mean_p, logvar_p = (x.float() for x in (mean, logvar, mean_p, logvar_p))
    apart = (logvar.exp() + (mean - mean_p).square()) * (-logvar_p).exp()
    return 0.5 * (logvar_p - logvar + apart - 1.0)


def awaken(nets: LatentNets, sigma: float) -> None:
    """Prepares new networks for latents that carry something from the first step on: posterior
    means of unit size, posteriors of width ``sigma``, the prior near a unit Gaussian.

    A posterior as wide as the prior is noise to the decoder, which learns to do without; then the
    divergence has nothing to hold against it, and it stays so (posterior collapse).
    """
    latent, head = nets.shape.latent, nets.encoder.head
    with torch.no_grad():
        head.weight[:latent] *= 1.0 / HEAD_GAIN
        head.bias[latent:] = 2.0 * math.log(sigma)


def hinge_weights(stiffness: Tensor, power: float) -> Tensor:
    """(n,) servos' stiffnesses -> weights of hinges in the error, k^power of unit mean square: an
    error alike in all hinges counts as without weights. Of power 0.5 the squared error is the
    energy of the servos' wrong springs."""
    weight = stiffness.float() ** power
    return weight / weight.square().mean().sqrt()


def steered(beta: Tensor, nats: Tensor, target: float, most: float) -> Tensor:
    """() beta for the next iteration: more where the divergence was above ``target``, less where
    it was below, by e^most at most."""
    off = (nats / target - 1.0).clamp(-1.0, 1.0)
    return (beta * (most * off).exp()).clamp(*BETA)
