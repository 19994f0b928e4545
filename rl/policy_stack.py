"""Several frozen actors of one shape side by side: one batched product a layer plays all of them.

Shapes: S actors, R rows for each, D observation, U action size.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from rl.networks import MLP


class PolicyStack:
    """S mean actions at once. Weights and statistics stay at their addresses.

    With ``bf16`` hidden layers are kept and multiplied in it, as ``MLP`` does under autocast.
    """

    def __init__(
        self, like: MLP, size: int, clip: float, device: torch.device, bf16: bool = False
    ) -> None:
        """Args:
        like: an actor of the shape of all of them.
        size: S.
        clip: normalised observations are clamped to +- this.
        device: where they live.
        bf16: see above.
        """
        self.clip = clip
        names = [name for name, m in like.named_modules() if isinstance(m, nn.Linear)]
        shapes = {n: p.shape for n, p in like.named_parameters()}
        self._act = like.trunk[1]
        self.dtype = torch.bfloat16 if bf16 else torch.float32
        self.weights: dict[str, Tensor] = {}
        """(S, in, out) by layer; the head's in float32"""
        self.biases: dict[str, Tensor] = {}
        """(S, 1, out)"""
        for name in names:
            dtype = self.dtype if name != names[-1] else torch.float32
            out, inputs = shapes[f"{name}.weight"]
            self.weights[name] = torch.zeros(size, inputs, out, device=device, dtype=dtype)
            self.biases[name] = torch.zeros(size, 1, out, device=device, dtype=dtype)
        inputs = shapes[f"{names[0]}.weight"][1]
        self.mean = torch.zeros(size, 1, inputs, device=device)
        self.std = torch.ones(size, 1, inputs, device=device)

    def write(self, slot: int, actor: Mapping[str, Tensor], mean: Tensor, std: Tensor) -> None:
        """Copies an actor (its ``state_dict``) and its statistics (D,) into a slot."""
        for name in self.weights:
            self.weights[name][slot] = actor[f"{name}.weight"].detach().T
            self.biases[name][slot, 0] = actor[f"{name}.bias"].detach()
        self.mean[slot, 0], self.std[slot, 0] = mean, std

    def read(self, slot: int) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """The actor's ``state_dict`` and statistics (D,) of a slot, float32."""
        return unstacked(self.state_dict(), slot)

    @torch.no_grad()
    def __call__(self, obs: Tensor) -> Tensor:
        """(S, R, D) raw observations -> (S, R, U) mean actions, each by its actor."""
        x = ((torch.nan_to_num(obs) - self.mean) / self.std).clamp(-self.clip, self.clip)
        x = x.to(self.dtype)
        *hidden, head = self.weights
        for name in hidden:
            x = self._act(torch.baddbmm(self.biases[name], x, self.weights[name]))
        return torch.baddbmm(self.biases[head], x.float(), self.weights[head])

    def state_dict(self) -> dict[str, Tensor]:
        """All weights and statistics by name."""
        state = {f"{n}.weight": x for n, x in self.weights.items()}
        state |= {f"{n}.bias": x for n, x in self.biases.items()}
        return state | {"mean": self.mean, "std": self.std}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Takes them back. Raises ValueError where they do not fit."""
        for name, own in self.state_dict().items():
            if name not in state or state[name].shape != own.shape:
                raise ValueError(f"the checkpoint's pool does not fit this run's ('{name}')")
            own.copy_(state[name])


def unstacked(state: Mapping[str, Tensor], slot: int) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """One actor's own ``state_dict`` and statistics (D,), float32, from the ``state_dict`` of a
    stack."""
    actor = {n: x[slot].float().T.contiguous() for n, x in state.items() if n.endswith(".weight")}
    actor |= {n: x[slot, 0].float() for n, x in state.items() if n.endswith(".bias")}
    return actor, state["mean"][slot, 0].clone(), state["std"][slot, 0].clone()
