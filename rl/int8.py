"""Weights in eight bits: a matrix's rows, each scaled to its largest element.

An actor of 0.7 MB in fp16 takes half of that. Rounding errors are at most 1/254 of the largest
weight of a row, uniform and independent, so what they do to a neuron's input averages out; what a
policy comes to with them is measured like that of any other (``evaluate``). The last layer stays as
it is: its errors are those of the action, and it is a hundredth of the weights.
"""

from __future__ import annotations

import torch
from torch import Tensor

LEVELS = 127
SCALE = ".scale"
LAST = "head."
"""First part of the names of an actor's last layer."""


def packed(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Matrices (M, N) but the last layer's as int8, with ``NAME.scale`` (M,) in float32; whatever
    else as it is."""
    out: dict[str, Tensor] = {}
    for name, weight in weights.items():
        if weight.dim() != 2 or name.startswith(LAST):
            out[name] = weight
            continue
        rows = weight.float()
        # A row of zeros has any scale.
        scale = rows.abs().amax(dim=1).clamp(min=torch.finfo(torch.float32).tiny) / LEVELS
        out[name] = (rows / scale[:, None]).round().to(torch.int8).contiguous()
        out[name + SCALE] = scale
    return out


def unpacked(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The inverse, up to rounding. Raises ValueError where scales do not fit their matrices."""
    out: dict[str, Tensor] = {}
    for name, weight in weights.items():
        if name.endswith(SCALE):
            of = weights.get(name.removesuffix(SCALE))
            if of is None or of.dtype != torch.int8:
                raise ValueError(f"'{name}' is the scale of nothing")
        elif weight.dtype != torch.int8:
            out[name] = weight
        else:
            scale = weights.get(name + SCALE)
            if scale is None or weight.dim() != 2 or scale.shape != weight.shape[:1]:
                raise ValueError(f"'{name}' lacks a scale for each of its rows")
            out[name] = weight.float() * scale.float()[:, None]
    return out
