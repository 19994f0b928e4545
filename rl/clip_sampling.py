"""Which frame an episode starts from: more often where tracking fails.

Clips are cut into bins of half a second. Each bin keeps the running share of visits that ended in
a failure; episodes start in a bin in proportion to it and to that of the bin behind it (the way to
a difficulty must be practised too), but a part of them anywhere. Fixed shapes, no waiting for the
device.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from rl.motion import MotionTables
from warmstart.library import FPS

LEAST = 1e-3
"""Failure rate that a bin counts at least: without any failure starts are uniform."""


class ClipSampling:
    """Draws start frames and learns from what became of them."""

    def __init__(
        self,
        tables: MotionTables,
        uniform: float = 0.2,
        mirror: bool = True,
        bin_seconds: float = 0.5,
        rate: float = 0.05,
    ) -> None:
        """Args:
        tables: the motions.
        uniform: share of starts drawn from all frames alike.
        mirror: half of the starts are in the mirrored motions.
        bin_seconds: length of a bin (s).
        rate: weight of a new visit in the running failure rate of its bin.

        Raises ValueError for a share or rate outside [0, 1], or bins shorter than a frame.
        """
        size = round(bin_seconds * FPS)
        if not (0.0 <= uniform <= 1.0 and 0.0 < rate <= 1.0):
            raise ValueError(f"uniform and rate must lie in [0, 1], not {uniform}, {rate}")
        if size < 1:
            raise ValueError(f"bins of {bin_seconds} s are shorter than a frame")
        self.uniform, self.mirror, self.rate = uniform, mirror, rate
        self.num_frames = tables.num_frames
        first, count, following = [], [], []
        bin_of = np.zeros(tables.num_frames, int)
        for begin, length in zip(tables.first.tolist(), tables.lengths.tolist()):
            starts = np.arange(begin, begin + length - 1, size)  # never from the last frame
            ids = len(first) + np.arange(len(starts))
            bin_of[begin : begin + length + 1] = ids[
                np.minimum(np.arange(length + 1) // size, len(ids) - 1)
            ]
            first += starts.tolist()
            count += np.diff(np.append(starts, begin + length - 1)).tolist()
            following += np.minimum(ids + 1, ids[-1]).tolist()
        device = tables.device

        def tensor(values: list[int] | np.ndarray) -> Tensor:
            return torch.as_tensor(np.asarray(values), device=device)

        self.bin_of = tensor(np.concatenate([bin_of, bin_of]))
        """(2 F,) bin of each frame; mirrored frames share those of the others."""
        self.first, self.following = tensor(first), tensor(following)
        """(K,) first frame of each bin; the next bin of the clip, itself for the last."""
        self.count = tensor(count).double()
        """(K,) frames of each bin from which episodes start."""
        self.failure = torch.ones(len(first), dtype=torch.float64, device=device)
        """(K,) running failure rates; 1 before the first visit, so that all are tried."""
        # For several ranks: the rates all had last, and this rank's failures and visits since.
        self._agreed = self.failure.clone()
        self._news = torch.zeros(2, len(first), dtype=torch.float64, device=device)

    def probabilities(self) -> Tensor:
        """(K,) chance of each bin, float64."""
        share = self.count / self.count.sum()
        rate = 0.5 * (self.failure + self.failure[self.following])
        weight = self.count * rate.clamp(min=LEAST)
        return self.uniform * share + (1.0 - self.uniform) * weight / weight.sum()

    def draw(self, number: int, generator: torch.Generator) -> Tensor:
        """(number,) frames to start from."""
        draws = torch.rand(3, number, generator=generator, device=self.count.device)
        edges = self.probabilities().cumsum(0)
        chosen = torch.searchsorted(edges, draws[0].double() * edges[-1], right=True)
        chosen = chosen.clamp(max=len(self.count) - 1)
        within = torch.minimum(draws[1] * self.count[chosen], self.count[chosen] - 1).long()
        frame = self.first[chosen] + within
        if self.mirror:
            frame = frame + self.num_frames * (draws[2] < 0.5)
        return frame

    def update(self, frame: Tensor, failed: Tensor, passed: Tensor) -> None:
        """Takes in what became of worlds in frames (N,): ``failed`` (N,) there, or ``passed`` (N,)
        the bin's end without failing. Several visits count as one after the other of their mean:
        f <- m + (1 - rate)^visits (f - m)."""
        bins = self.bin_of[frame]
        zero = torch.zeros_like(self.failure)
        fails = zero.index_add(0, bins, failed.double())
        visits = zero.index_add(0, bins, (failed | passed).double())
        self.failure.copy_(self._taken_in(self.failure, fails, visits))
        if dist.is_initialized():
            self._news += torch.stack((fails, visits))

    def merge_ranks(self) -> None:
        """Every rank takes in what happened on all of them since the last call, as one visit after
        the other of their mean: then all have the same rates."""
        dist.all_reduce(self._news)
        self.restore(self._taken_in(self._agreed, *self._news))

    def restore(self, failure: Tensor) -> None:
        """Goes on from known failure rates (K,)."""
        self.failure.copy_(failure)
        self._agreed.copy_(failure)
        self._news.zero_()

    def _taken_in(self, failure: Tensor, fails: Tensor, visits: Tensor) -> Tensor:
        """Rates (K,) after so many failures and visits (K,) of each bin."""
        mean = fails / visits.clamp(min=1.0)
        kept = torch.pow(1.0 - self.rate, visits)
        return mean + kept * (failure - mean)
