"""What moves the mean of a latent prior so that an athlete who follows it stays on its feet.

A prior that was distilled has seen the states that its student leads to. Latents drawn from it
lead elsewhere, and there it knows nothing: athletes fall within two seconds. So the prior learns
by falling: a policy of the task ``balance`` (``rl.balance``) draws latents as the prior does and
learns by how many of its standard deviations the mean must move. This network is that policy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from rl.networks import MLP, Activation

BALANCE = "balance"
"""The task in which it is learned."""


class Steady(nn.Module):
    """(..., S) raw observations of the own body -> (..., Z) standard deviations of the prior."""

    mean: Tensor
    std: Tensor

    def __init__(
        self, size: int, hidden: Sequence[int], latent: int, activation: Activation, clip: float
    ) -> None:
        """Args:
        size: S, numbers of the athlete's own body.
        hidden: layers.
        latent: Z.
        activation: of the hidden layers.
        clip: normalised observations are clamped to +- this.
        """
        super().__init__()
        self.hidden, self.activation, self.clip = tuple(hidden), activation, clip
        self.net = MLP(size, hidden, latent, activation)
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    def forward(self, obs: Tensor) -> Tensor:
        """Where the mean lies, in standard deviations from the prior's own."""
        x = (torch.nan_to_num(obs) - self.mean) / self.std
        return self.net(x.clamp(-self.clip, self.clip))

    def card(self) -> dict[str, Any]:
        """As it stands on a prior's card."""
        return {
            "hidden": list(self.hidden),
            "activation": self.activation,
            "observation_clip": self.clip,
        }

    @staticmethod
    def of(card: Mapping[str, Any], size: int, latent: int) -> Steady:
        """From a card, with weights to be loaded. Raises ValueError where it does not hold one."""
        try:
            hidden, clip = [int(n) for n in card["hidden"]], float(card["observation_clip"])
            activation = card["activation"]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"its 'steady' part is not usable ({error})") from None
        if not all(0 < n < 1 << 16 for n in hidden) or len(hidden) > 32 or not clip > 0.0:
            raise ValueError(f"the layer sizes {hidden} of its 'steady' part are impossible")
        return Steady(size, hidden, latent, activation, clip)
