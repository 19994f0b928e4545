"""What a learner has learned, by name, for checkpoints: weights and the moments of Adam."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def learned_state(
    parameters: dict[str, nn.Parameter], optimizer: torch.optim.Optimizer, prefix: str = ""
) -> dict[str, Tensor]:
    """``PREFIX NAME`` of every parameter, then ``adam.NAME.KEY`` of its moments; no copies.

    Args:
        parameters: by name; all of them the optimiser's.
        optimizer: has moments of those that it has moved.
        prefix: of the weights' names, such as ``net.``.
    """
    state = {f"{prefix}{name}": p.detach() for name, p in parameters.items()}
    for name, p in parameters.items():
        state |= {f"adam.{name}.{key}": x for key, x in optimizer.state[p].items()}
    return state


@torch.no_grad()
def load_learned(
    parameters: dict[str, nn.Parameter],
    optimizer: torch.optim.Optimizer,
    state: dict[str, Tensor],
    prefix: str = "",
    network: str = "network",
) -> None:
    """Takes such a state back, weights in place; ``network`` is its name in the message.

    Raises ValueError where a weight is missing or has another shape.
    """
    for name, p in parameters.items():
        saved = state.get(f"{prefix}{name}")
        if saved is None or saved.shape != p.shape:
            raise ValueError(f"the checkpoint's '{name}' does not fit this {network}")
        p.copy_(saved)
        start = f"adam.{name}."
        moments = {k.removeprefix(start): x for k, x in state.items() if k.startswith(start)}
        if moments:
            optimizer.state[p] = {key: x.clone().to(p.device) for key, x in moments.items()}
