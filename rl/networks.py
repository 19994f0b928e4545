"""Multilayer perceptrons of the learners."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

Activation = Literal["silu", "relu", "elu", "tanh"]

_ACTIVATIONS: dict[str, type[nn.Module]] = {
    "silu": nn.SiLU,
    "relu": nn.ReLU,
    "elu": nn.ELU,
    "tanh": nn.Tanh,
}


def autocast(device: torch.device, bf16: bool) -> torch.autocast:
    """How a learner's networks multiply: in bf16 where that was asked for."""
    # Without the cache: casts made inside a captured graph must not outlive it.
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=bf16, cache_enabled=False)


class MLP(nn.Module):
    """(..., inputs) -> (..., outputs), float32.

    Under autocast the hidden layers multiply in bf16; the last layer always works in float32, so
    that a mean action is not rounded to bf16's 8 bits (0.004 near 1, a thirtieth of sigma).
    Weights start orthogonal, gain sqrt(2), and ``head_gain`` in the last layer; biases at zero.
    """

    def __init__(
        self,
        inputs: int,
        hidden: Sequence[int],
        outputs: int,
        activation: Activation = "silu",
        head_gain: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if activation not in _ACTIVATIONS:
            raise ValueError(f"activation '{activation}' is none of {', '.join(_ACTIVATIONS)}")
        sizes = [inputs, *hidden]
        layers: list[nn.Module] = []
        for n_in, n_out in itertools.pairwise(sizes):
            layers += [nn.Linear(n_in, n_out), _ACTIVATIONS[activation]()]
        self.trunk = nn.Sequential(*layers)
        self.head = nn.Linear(sizes[-1], outputs)
        for module in self.trunk:
            if isinstance(module, nn.Linear):
                nn.init.orthogonal_(module.weight, math.sqrt(2.0), generator=generator)
                nn.init.zeros_(module.bias)
        nn.init.orthogonal_(self.head.weight, head_gain, generator=generator)
        nn.init.zeros_(self.head.bias)

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) -> (..., outputs)."""
        hidden = self.trunk(x)
        with torch.autocast(x.device.type, enabled=False):
            return self.head(hidden.float())
