"""What several processes (ranks) of one training share: gradients in one message, and their step.

``torchrun`` starts a process for each GPU; each plays its own worlds. Whatever decides the next
weights is averaged or summed over all of them, so that all hold the same weights and statistics,
bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
import torch.distributed as dist
from torch import Tensor, nn

from rl.graph import GraphedStep

_ALIGNED = 64
"""Each gradient begins at a multiple of so many numbers, as kernels like it."""


def own_rank() -> tuple[int, int]:
    """This process's rank and how many there are; (0, 1) for one alone."""
    if not dist.is_initialized():
        return 0, 1
    return dist.get_rank(), dist.get_world_size()


def gathered(x: Tensor) -> Tensor:
    """(R, ...) what each rank holds as ``x`` (...), bit for bit but for the sign of a zero. As a
    sum, for gloo has no other way between GPUs."""
    rank, ranks = own_rank()
    all_of_them = torch.zeros((ranks, *x.shape), dtype=x.dtype, device=x.device)
    all_of_them[rank] = x
    if ranks > 1:
        dist.all_reduce(all_of_them)
    return all_of_them


class SharedGradients:
    """Gradients of parameters and a few numbers beside them, in one buffer for one message.

    The parameters' ``grad`` are views of the buffer, again after each ``clear``.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], numbers: int = 0) -> None:
        """``numbers``: statistics that are averaged too."""
        shared = list(parameters)
        begins, at = [], _padded(numbers)
        for p in shared:
            begins.append(at)
            at += _padded(p.numel())
        self._flat = torch.zeros(at, device=shared[0].device)
        self.numbers = self._flat[:numbers]
        """(numbers,) float32"""
        self._parts = [
            (p, self._flat[begin : begin + p.numel()].view_as(p))
            for p, begin in zip(shared, begins)
        ]
        self.clear()

    def clear(self) -> None:
        """All zero, before a backward pass adds to them."""
        self._flat.zero_()
        for p, part in self._parts:  # another optimiser may have put its own in their place
            p.grad = part

    def average(self) -> None:
        """Everything becomes its mean over the ranks."""
        dist.all_reduce(self._flat)
        self._flat /= dist.get_world_size()


class SharedStep:
    """A learning step of several ranks: gradients of their own samples, their mean, the descent.

    The message between the ranks stays outside the CUDA graphs: the two halves are recorded, one
    on either side of it.
    """

    def __init__(
        self,
        shared: SharedGradients,
        gradients: Callable[[Tensor], object],
        descend: Callable[[], None],
        wanted: bool,
    ) -> None:
        """Args:
        shared: buffer of the gradients.
        gradients: adds to them for the samples (m,) that it is given.
        descend: uses them.
        wanted: replay both halves as graphs where that is possible.
        """

        def first(rows: Tensor) -> None:
            shared.clear()
            gradients(rows)

        self.shared = shared
        """buffer of the gradients"""
        self._first = GraphedStep(first, shared.clear, wanted)
        self._second = GraphedStep(lambda _: descend(), lambda: None, wanted)
        self._nothing = torch.zeros(0, device=shared.numbers.device)

    @property
    def graph(self) -> torch.cuda.CUDAGraph | None:
        """Of the gradients, once it is recorded."""
        return self._first.graph

    def __call__(self, rows: Tensor) -> None:
        """Runs the step on ``rows`` (m,), always of the same size."""
        self._first(rows)
        self.shared.average()
        self._second(self._nothing)


def over_ranks(sums: Tensor, means: Tensor) -> tuple[list[float], list[float]]:
    """Sums (k,) added up over the ranks and means (m,) averaged, float64, in one message. Waits
    for the device, once."""
    if not dist.is_initialized():
        both = torch.cat((sums, means))
    else:
        both = torch.cat((sums, means / dist.get_world_size()))
        dist.all_reduce(both)
    values = both.tolist()
    return values[: len(sums)], values[len(sums) :]


def _padded(size: int) -> int:
    return -(-size // _ALIGNED) * _ALIGNED
