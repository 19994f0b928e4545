"""Running mean and variance of observations and returns, merged over steps and ranks."""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor

from rl.ranks import gathered


class Normalizer:
    """Running moments in float64; normalising happens in float32 with the last committed ones.

    ``collect`` adds a batch to this rank's pending moments; ``commit`` merges the pending moments
    of all ranks into the statistics in use. Between two commits every observation is therefore
    normalised alike, in the rollout as in the update. Nothing waits for the device.
    """

    def __init__(
        self,
        size: int,
        device: torch.device | str = "cpu",
        clip: float = 5.0,
        epsilon: float = 1e-4,
    ) -> None:
        """Args:
        size: features D.
        device: where the statistics live.
        clip: normalised values are clamped to +-clip.
        epsilon: added to the variance, in squared units of the feature.
        """
        self.clip, self.epsilon = clip, epsilon
        # One row of count, then D means, then D sums of squared deviations.
        self._total = torch.zeros(1 + 2 * size, dtype=torch.float64, device=device)
        self._pending = torch.zeros_like(self._total)
        self._kept = torch.zeros(size, dtype=torch.bool, device=device)
        self.mean = torch.zeros(size, device=device)
        """(D,) float32 in use; 0 before the first commit."""
        self.std = torch.ones(size, device=device)
        """(D,) float32 in use; 1 before the first commit."""

    @property
    def count(self) -> Tensor:
        """() samples behind the statistics in use, float64 on the device."""
        return self._total[0]

    def collect(self, x: Tensor, weight: Tensor | None = None) -> None:
        """Adds x (..., D), float, with optional weights (...) of 0 or 1, to the pending moments."""
        x = x.detach().reshape(-1, self.mean.numel()).double()
        if weight is None:
            count = torch.full((), float(len(x)), dtype=torch.float64, device=x.device)
            mean = x.mean(0)
            squares = (x - mean).square().sum(0)
        else:
            w = weight.reshape(-1, 1).double()
            count = w.sum()
            mean = (w * x).sum(0) / count.clamp(min=1.0)
            squares = (w * (x - mean).square()).sum(0)
        self._pending = merge(self._pending, torch.cat((count[None], mean, squares)))

    def commit(self) -> None:
        """Merges the pending moments of every rank into the statistics in use."""
        before = self._total
        self._total = reduce(merge, gathered(self._pending), before)
        self._hold(before)
        self._pending = torch.zeros_like(self._pending)
        self._refresh()

    def keep(self, columns: Tensor) -> None:
        """From now on the mean and the deviation of some features (D,) bool, beside those kept
        already, stay as they are, whatever is committed: what reads them was made for these."""
        self._kept |= columns.to(self._kept)

    def _hold(self, before: Tensor) -> None:
        """Gives the features that are kept the moments that they had ``before`` (1 + 2 D,), as if
        all samples since had been like those."""
        count, mean, squares = _split(self._total)
        old_count, old_mean, old_squares = _split(before)
        grown = old_squares * (count / old_count.clamp(min=1.0))
        mean = torch.where(self._kept, old_mean, mean)
        squares = torch.where(self._kept, grown, squares)
        self._total = torch.cat((count[None], mean, squares))

    def adopt(self, columns: Tensor) -> None:
        """Gives some features (D,) bool, of which nothing is known yet, the moments that are now
        pending in all ranks, as if every sample in use had shown them. Call it before ``commit``.
        """
        count, mean, squares = _split(self._total)
        shown, new_mean, new_squares = _split(reduce(merge, gathered(self._pending)))
        new_squares = new_squares * (count / shown.clamp(min=1.0))
        mean = torch.where(columns, new_mean, mean)
        squares = torch.where(columns, new_squares, squares)
        self._total = torch.cat((count[None], mean, squares))

    def normalize(self, x: Tensor) -> Tensor:
        """(..., D) -> (..., D) of zero mean, unit variance, clamped; float32."""
        return ((x - self.mean) / self.std).clamp(-self.clip, self.clip)

    def denormalize(self, x: Tensor) -> Tensor:
        """(..., D) inverse of ``normalize``, unclamped."""
        return x * self.std + self.mean

    def state_dict(self) -> dict[str, Tensor]:
        """Total and pending moments, each (1 + 2 D,) float64, and (D,) bool which features are
        kept."""
        state = {"total": self._total, "pending": self._pending, "kept": self._kept}
        return {name: x.clone() for name, x in state.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes the moments back, and which features are kept, where the state says so.

        Raises ValueError for another number of features.
        """
        if state["total"].shape != self._total.shape:
            raise ValueError(
                f"normaliser statistics of {(state['total'].numel() - 1) // 2} features do not fit "
                f"{self.mean.numel()} features"
            )
        self._total = state["total"].to(self._total)
        self._pending = state["pending"].to(self._total)
        if "kept" in state:
            self._kept = state["kept"].to(self._kept)
        self._refresh()

    def set_moments(self, count: float, mean: Tensor, std: Tensor) -> None:
        """Starts from known statistics, as if ``count`` samples had shown them."""
        variance = (std.double().square() - self.epsilon).clamp(min=0.0)
        count_ = torch.tensor([float(count)], dtype=torch.float64)
        row = torch.cat((count_, mean.double().cpu(), count * variance.cpu()))
        self.load_state_dict({"total": row, "pending": torch.zeros_like(row)})

    def _refresh(self) -> None:
        count, mean, squares = _split(self._total)
        known = count > 0
        variance = squares / count.clamp(min=1.0) + self.epsilon
        # In place: a captured graph may read these.
        self.mean.copy_(torch.where(known, mean, 0.0))
        self.std.copy_(torch.where(known, variance.sqrt(), 1.0))


def _split(row: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    size = (row.numel() - 1) // 2
    return row[0], row[1 : 1 + size], row[1 + size :]


def merge(a: Tensor, b: Tensor) -> Tensor:
    """Moments of the union of two samples, each (1 + 2 D,): count, means, squared deviations.

    Source: Chan, Golub, LeVeque 1979, pairwise update.
    """
    count_a, mean_a, squares_a = _split(a)
    count_b, mean_b, squares_b = _split(b)
    count = count_a + count_b
    share = count_b / count.clamp(min=1.0)
    delta = mean_b - mean_a
    mean = mean_a + delta * share
    squares = squares_a + squares_b + delta.square() * count_a * share
    return torch.cat((count[None], mean, squares))
