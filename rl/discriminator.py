"""The parts of an adversarial motion prior that know nothing of policies: the reward of a logit,
the losses of a discriminator, and the replay of what the agent did before.

Shapes: T steps, M rows (worlds x agents), H frames of a window, F features of a frame, K = H F.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

MOST = -math.log(1e-4)
"""Half of the largest style reward."""


def style_reward(logit: Tensor) -> Tensor:
    """(...) -2 log(max(1 - sigmoid(logit), 1e-4)): 1.39 where nothing can be told, 18.4 at most.

    Source: Peng et al. 2021 with the log reward of the SMPLOlympics release.
    """
    return 2.0 * softplus(logit).clamp(max=MOST)


@dataclass(frozen=True)
class Losses:
    """Of one batch; each () and differentiable but for the accuracies."""

    agent: Tensor
    """Cross entropy of windows of the agent, weighted."""
    demonstration: Tensor
    """Cross entropy of windows of demonstrations."""
    gradient: Tensor
    """Mean squared norm of the logit's gradient at the demonstrations (normalised input)."""
    accuracy_agent: Tensor
    accuracy_demonstration: Tensor


def discriminator_losses(
    net: nn.Module, agent: Tensor, weight: Tensor, demonstration: Tensor
) -> Losses:
    """Losses of a discriminator ``net``: (..., K) -> (..., 1) logit, positive for a demonstration.

    Args:
        net: the discriminator.
        agent: (B, K) normalised windows of the agent.
        weight: (B,) 0 for a window that does not count.
        demonstration: (B', K) normalised windows of demonstrations.
    """
    shown = demonstration.detach().requires_grad_()
    against, of = net(agent).squeeze(-1), net(shown).squeeze(-1)
    (gradient,) = torch.autograd.grad(of.sum(), shown, create_graph=True)
    count = weight.sum().clamp(min=1.0)
    return Losses(
        agent=(weight * softplus(against)).sum() / count,
        demonstration=softplus(-of).mean(),
        gradient=gradient.square().sum(-1).mean(),
        accuracy_agent=(weight * (against < 0.0)).sum() / count,
        accuracy_demonstration=(of > 0.0).float().mean(),
    )


class Replay:
    """Pieces of earlier rollouts, the oldest replaced first; each holds T windows.

    Frames are kept, not windows, of which each frame would be in H: a tenth of the memory.
    """

    def __init__(
        self,
        windows: int,
        steps: int,
        frames: int,
        size: int,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        """Args: windows to keep, T, H, F, and where and as what frames are kept."""
        self.steps = steps
        self.pieces = max(1, windows // steps)
        self.frames = torch.zeros(self.pieces, steps + frames - 1, size, device=device, dtype=dtype)
        """(C, T + H - 1, F)"""
        self.whole = torch.zeros(self.pieces, steps, dtype=torch.bool, device=device)
        """(C, T) which windows count"""
        self.filled, self._next = 0, 0

    def add(self, frames: Tensor, whole: Tensor) -> None:
        """Takes pieces: frames (T + H - 1, k, F) and whole (T, k), k at most C."""
        k = frames.shape[1]
        slots = (self._next + torch.arange(k, device=frames.device)) % self.pieces
        self.frames[slots] = frames.transpose(0, 1)
        self.whole[slots] = whole.T
        self._next = (self._next + k) % self.pieces
        self.filled = min(self.filled + k, self.pieces)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """(count,) indices of windows, every one that is kept equally likely."""
        most = self.filled * self.steps
        return torch.randint(most, (count,), device=self.frames.device, generator=generator)

    def windows(self, picks: Tensor, span: Tensor) -> tuple[Tensor, Tensor]:
        """(m, H, F) windows of indices (m,), and (m,) whether they count. ``span`` = 0 .. H - 1."""
        piece, t = picks // self.steps, picks % self.steps
        return self.frames[piece[:, None], t[:, None] + span], self.whole[piece, t]

    def state_dict(self) -> dict[str, Tensor]:
        """What is kept and where the next piece goes."""
        return {
            "frames": self.frames[: self.filled],
            "whole": self.whole[: self.filled],
            "next": torch.tensor([self._next]),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes a state back. Raises ValueError where it does not fit."""
        filled = len(state["frames"])
        if filled > self.pieces or state["frames"].shape[1:] != self.frames.shape[1:]:
            raise ValueError("the checkpoint's replay does not fit this discriminator")
        self.frames[:filled] = state["frames"].to(self.frames)
        self.whole[:filled] = state["whole"].to(self.whole)
        self.filled, self._next = filled, int(state["next"])
