"""The cross-entropy method (Rubinstein 1999): a search that needs nothing but costs of candidates.

Numbers are in units in which a step of 1 is worth trying; a search starts around 0, or
near what was found before.
"""

from __future__ import annotations

import numpy as np

SPREAD = 0.5
"""Of the candidates at the start, in units."""
FORGET = 0.2
"""How much of the old middle stays."""
KEPT = 0.3
"""How much of the old spread stays..."""
LEAST_SPREAD = 0.02
"""... and what is added to it, so that a search never stands still (units)."""


class CrossEntropy:
    """Draws candidates, is told their costs, and moves to where the good ones are.

    The best candidate and the middle of the distribution are among those of the next round.
    """

    def __init__(
        self,
        size: int,
        candidates: int,
        seed: int = 0,
        near: np.ndarray | None = None,
        *,
        spread: float = SPREAD,
        noisy: bool = False,
    ) -> None:
        """Args:
        size: of a candidate.
        candidates: of a round.
        seed: of what is drawn.
        near: (size,) where to begin; None for 0.
        spread: of the candidates at the start, in units.
        noisy: costs differ from round to round, so that a lucky one must not stay: the best is
            the middle, whatever it cost.
        """
        self.rng = np.random.default_rng(seed)
        self.mean = np.zeros(size) if near is None else near.copy()
        self.spread = np.full(size, spread)
        self.best, self.least, self.noisy = self.mean.copy(), np.inf, noisy
        self.drawn = np.zeros((candidates, size))
        elites = max(4, candidates // 6)
        weight = np.log(elites + 0.5) - np.log(np.arange(1, elites + 1))
        self.weight = weight / weight.sum()

    def ask(self) -> np.ndarray:
        """(N, P) candidates."""
        self.drawn = self.mean + self.spread * self.rng.standard_normal(self.drawn.shape)
        self.drawn[0], self.drawn[1] = self.best, self.mean
        return self.drawn

    def tell(self, cost: np.ndarray) -> int | None:
        """Takes the costs (N,) of what was asked for; the index of the best, None when none is
        better than the best before."""
        order = np.argsort(cost, kind="stable")[: len(self.weight)]
        better = bool(cost[order[0]] < self.least)
        if better:
            self.best, self.least = self.drawn[order[0]].copy(), float(cost[order[0]])
        middle = self.weight @ self.drawn[order]
        width = np.sqrt(self.weight @ (self.drawn[order] - middle) ** 2)
        self.mean = FORGET * self.mean + (1.0 - FORGET) * middle
        self.spread = KEPT * self.spread + (1.0 - KEPT) * width + LEAST_SPREAD
        if self.noisy:
            self.best = self.mean
        return int(order[0]) if better else None
