"""Failures begun again: some training episodes go on from a moment before another one failed.

A policy that fails once in hundreds of episodes sees too few failures to learn from. Where a share
of the episodes begins in a state of the last seconds before a failure, with the rules' memory of
it, whatever is left to learn comes again and again, each time with other noise. Resets to states
of the way there are those of Florensa et al. 2017 and of Salimans and Chen 2018; here they are
the policy's own failures, and new ones replace the old.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sports.task import Memory

EVERY = 10
"""Control steps between two moments that are kept of every world."""
SIZE = 1024
"""Moments before failures that are kept; the next one replaces the oldest."""


@dataclass(frozen=True)
class Retries:
    """Training episodes that begin shortly before another one failed."""

    share: float = 0.0
    """Share of episodes that begin so, as soon as there are failures; 0 for none. Of samples it is
    less: they are short. For policies that rarely fail, with one athlete in a world."""
    seconds: tuple[float, float] = (0.5, 3.0)
    """How long before the failure, drawn evenly, and no longer than the episode had lasted. One
    that itself began so must have lasted for more than the longest: what fails once more where it
    did is no new lesson."""
    even: bool = False
    """Draw all moments alike. Else those more often that are saved now and then, by the variance
    of that outcome, p (1 - p): from where nobody can be saved, or anybody, little is learned."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.share < 1.0:
            raise ValueError(f"the share of retries must lie in [0, 1), not {self.share}")
        first, last = self.seconds
        if not 0.0 <= first <= last:
            raise ValueError(f"retries begin 0 s or more before a failure, not {first} to {last}")


_KEPT = ("past", "since", "retried", "bank", "count", "number", "tries", "saves", "place", "begun")


class Failures:
    """Moments of all worlds, those of them that came before failures, and who begins from them.

    Nothing here waits for the device. Rows are (N, K) numbers: the tensors of a moment, flat.
    """

    def __init__(self, how: Retries, moment: Memory, control_timestep: float) -> None:
        """Args:
        how: which episodes begin so.
        moment: (N, ...) tensors by name, as ``watch`` will get them.
        control_timestep: seconds of a step.

        Raises ValueError where no moment lies between those seconds.
        """
        self.how = how
        first, last = (round(s / control_timestep) for s in how.seconds)
        self.first, self.last = max(first, 1), last
        """Control steps before a failure."""
        if self.last - self.first < EVERY - 1:
            raise ValueError(
                f"a moment is kept every {EVERY * control_timestep:.2g} s, and one must lie "
                f"{how.seconds[0]:g} to {how.seconds[1]:g} s before any failure: say more"
            )
        self._layout = {k: (v.shape[1:], v.dtype) for k, v in moment.items()}
        rows = self._pack(moment)
        worlds, device = rows.shape[0], rows.device
        self.past = rows.new_zeros(self.last // EVERY + 2, *rows.shape)
        """(T, N, K) moments, the last at ``step // EVERY`` modulo T."""
        self.step = 0
        self.since = torch.zeros(worlds, dtype=torch.long, device=device)
        """(N,) steps since the world's episode began, wherever."""
        self.retried = torch.zeros(worlds, dtype=torch.bool, device=device)
        """(N,) whether it began before a failure."""
        self.bank = rows.new_zeros(SIZE + 1, rows.shape[1])
        """(SIZE + 1, K) moments before failures; the last row is for those that are none."""
        self.count = torch.zeros((), dtype=torch.long, device=device)
        """() how many have been put there."""
        self.number = torch.zeros(SIZE + 1, dtype=torch.long, device=device)
        """(SIZE + 1,) which of these each is, from 1 on."""
        self.tries = torch.zeros(SIZE + 1, device=device)
        """(SIZE + 1,) episodes that began from it and are over."""
        self.saves = torch.zeros(SIZE + 1, device=device)
        """(SIZE + 1,) those of them that did not fail."""
        self.place = torch.zeros(worlds, dtype=torch.long, device=device)
        """(N,) the row that a world's episode began from, where it did."""
        self.begun = torch.zeros(worlds, dtype=torch.long, device=device)
        """(N,) and its number then."""

    def watch(
        self, ended: Tensor, failed: Tensor, moment: Memory, generator: torch.Generator
    ) -> None:
        """After every step: which episodes ``ended`` and which of them ``failed``, (N,) bool, and
        what is now, before anything is reset."""
        self.step += 1
        self.since += 1
        slots, (now, ago) = len(self.past), divmod(self.step, EVERY)
        if ago == 0:
            self.past[now % slots] = self._pack(moment)
        # The k-th moment before the last one lies ago + EVERY k steps back.
        first = max(-((ago - self.first) // EVERY), 0)
        last = ((self.since - 1).clamp(max=self.last) - ago) // EVERY
        found = failed & (last >= first) & (~self.retried | (self.since > self.last))
        draw = torch.rand(len(failed), device=failed.device, generator=generator)
        back = first + (draw * (last - first + 1)).long()
        rows = self.past[(now - back) % slots, torch.arange(len(failed), device=failed.device)]
        tried = self.retried & ended & (self.number[self.place] == self.begun)
        self.tries.index_add_(0, self.place, tried.float())
        self.saves.index_add_(0, self.place, (tried & ~failed).float())
        number = self.count + found.cumsum(0)
        at = ((number - 1) % SIZE).masked_fill(~found, SIZE)
        self.bank.index_copy_(0, at, rows)
        self.number.index_copy_(0, at, number)
        self.tries.index_fill_(0, at, 0.0)
        self.saves.index_fill_(0, at, 0.0)
        self.count += found.sum()

    def draw(self, mask: Tensor, generator: torch.Generator) -> tuple[Tensor, Memory]:
        """For the worlds of a ``mask`` (N,) that begin anew: (N,) bool, which do so before a
        failure, and (N, ...) the moments by name, of all worlds."""
        draw = torch.rand(2, len(mask), device=mask.device, generator=generator)
        again = mask & (draw[0] < self.how.share) & (self.count > 0)
        below = self._weights().cumsum(0)
        place = torch.searchsorted(below, draw[1] * below[-1], right=True)
        place = torch.minimum(place, self.count.clamp(1, SIZE) - 1)
        self.place = torch.where(mask, place, self.place)
        self.begun = torch.where(mask, self.number[place], self.begun)
        self.retried = torch.where(mask, again, self.retried)
        self.since = self.since.masked_fill(mask, 0)
        return again, self._unpack(self.bank[place])

    def _weights(self) -> Tensor:
        """(SIZE,) how often each row is drawn. Of its chance p to be saved the mean over what is
        possible after its tries, if all were alike before them: (saves + 1) / (tries + 2)."""
        rows = torch.arange(SIZE, device=self.count.device)
        there = rows < self.count
        if self.how.even:
            return there.float()
        p = (self.saves[:SIZE] + 1.0) / (self.tries[:SIZE] + 2.0)
        return p * (1.0 - p) * there

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that decides how it goes on."""
        return {name: getattr(self, name).clone() for name in _KEPT} | {
            "step": torch.tensor(self.step)
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes it back. Raises ValueError for that of other worlds or of another task."""
        if "past" not in state or state["past"].shape != self.past.shape:
            raise ValueError("the failures are of another task or number of worlds")
        self.step = int(state["step"])
        for name in _KEPT:
            setattr(self, name, state[name].to(self.past.device).clone())

    def _pack(self, moment: Memory) -> Tensor:
        """(N, K) floats: whole numbers among them are steps, far below 2^24."""
        return torch.cat([moment[k].reshape(len(moment[k]), -1).float() for k in self._layout], -1)

    def _unpack(self, rows: Tensor) -> Memory:
        sizes = [shape.numel() for shape, _ in self._layout.values()]
        parts = zip(self._layout.items(), rows.split(sizes, -1))
        return {k: part.reshape(len(rows), *shape).to(dtype) for (k, (shape, dtype)), part in parts}
