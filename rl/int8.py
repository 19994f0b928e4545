"""Weights in eight bits: a matrix's rows, each scaled to its largest element.

An actor of 0.7 MB in fp16 takes half of that. Rounded each by itself, weights are off by at most
1/254 of the largest of their row; that does not average out where inputs have means and go
together, as those of an athlete do. ``fitted`` rounds them one column after the other, that of the
largest input first, each column's errors made good by the columns still to come, so that the
layer's outputs change least for given inputs; what comes of the layers before is made good first,
by least squares; and biases keep the outputs' means. Source: Frantar and others, "GPTQ: accurate
post-training quantization for generative pre-trained transformers" (2023); Hassibi and Stork,
"Second order derivatives for network pruning" (1993), for the update. Of a table tennis player the
outputs of the first layer are off by 0.002 (rms) instead of 0.020, and its balls land where those
of the float32 weights do. What a policy comes to is measured like that of any other
(``evaluate``). The last layer is not rounded: its errors are those of the action, and it is a
hundredth of the weights.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rl.networks import MLP

LEVELS = 127
DAMPING = 0.003
"""Of the mean square of the inputs, added to each one's: for inputs that never change."""
RIDGE = 1e-3
"""The same where weights are moved to make good what the layers before do."""
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
        name, weight = f"trunk.{index}", layer.weight.double()
        wanted = exact @ weight.T
        weight = _nearest(weight, approximate, wanted)
        scale = _scale(weight.float())
        levels = _levels(weight, scale.double(), approximate)
        exact = wanted + layer.bias.double()
        approximate = approximate @ (levels * scale.double()[:, None]).T
        bias = (exact - approximate).mean(0).half()
        approximate = approximate + bias.double()
        out[f"{name}.weight"] = levels.to(torch.int8)
        out[f"{name}.weight{SCALE}"] = scale
        out[f"{name}.bias"] = bias
    weight = actor.head.weight.double()
    wanted = exact @ weight.T
    head = _nearest(weight, approximate, wanted).half()
    left = (wanted - approximate @ head.double().T).mean(0)
    out[f"{LAST}weight"] = head
    out[f"{LAST}bias"] = (actor.head.bias.double() + left).half()
    return {name: weight.contiguous() for name, weight in out.items()}


def _scale(rows: Tensor) -> Tensor:
    """(M,) of a level in each row. A row of zeros has any."""
    return rows.abs().amax(dim=1).clamp(min=torch.finfo(torch.float32).tiny) / LEVELS


def _nearest(weight: Tensor, inputs: Tensor, wanted: Tensor) -> Tensor:
    """(M, n) weights near ``weight`` whose products with the inputs, less their means, are next to
    the outputs ``wanted``, less theirs."""
    centred = inputs - inputs.mean(0)
    missing = wanted - inputs @ weight.T  # its means are nothing to centred inputs
    moments = _damped(centred, RIDGE)
    return weight + torch.linalg.solve(moments, centred.T @ missing / len(inputs)).T


def _levels(weight: Tensor, scale: Tensor, inputs: Tensor) -> Tensor:
    """(M, n) whole numbers whose products with the inputs are next to those of the weights."""
    moments = _damped(inputs, DAMPING)
    order = moments.diagonal().argsort(descending=True)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(moments[order][:, order]))
    factor = torch.linalg.cholesky(inverse, upper=True)
    left, levels = weight[:, order], torch.empty_like(weight)
    for column, row in enumerate(factor):
        rounded = (left[:, column] / scale).round().clamp(-LEVELS, LEVELS)
        error = (left[:, column] - rounded * scale) / row[column]
        left[:, column:] -= torch.outer(error, row[column:])
        levels[:, order[column]] = rounded
    return levels


def _damped(inputs: Tensor, share: float) -> Tensor:
    """(n, n) second moments of (M, n) inputs, with a share of their mean square on the diagonal."""
    moments = inputs.T @ inputs / len(inputs)
    moments.diagonal().add_(share * moments.diagonal().mean().clamp(min=1e-12))
    return moments


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
