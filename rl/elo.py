"""Elo ratings: what a difference is expected to score, and what scores say about differences.

A rating difference d is worth an expected score of 1 / (1 + 10^(-d / 400)); a draw scores 1/2.
Source: Elo 1978; fitted by maximum likelihood as Bradley and Terry 1952.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

SCALE = 400.0
"""Of the difference that is expected to score 10 to 1."""
_RATE = math.log(10.0) / SCALE


def expected(difference: float) -> float:
    """Score in (0, 1) that a rating difference is expected to bring."""
    return 1.0 / (1.0 + 10.0 ** (-difference / SCALE))


def difference(score: float) -> float:
    """Rating difference that is expected to score so: infinite at 0 and 1."""
    if score <= 0.0:
        return -math.inf
    return math.inf if score >= 1.0 else SCALE * math.log10(score / (1.0 - score))


def performance(scores: Sequence[float], games: Sequence[float], ratings: Sequence[float]) -> float:
    """The rating that is expected to score what was scored against opponents of known ratings.

    ``scores`` are sums over ``games`` with each opponent. Each opponent met is given one more game,
    a draw, so that there is such a rating. Raises ValueError without games.
    """
    met = [(s + 0.5, n + 1.0, r) for s, n, r in zip(scores, games, ratings) if n > 0]
    if not met:
        raise ValueError("there are no games to rate")
    wanted = sum(s for s, _, _ in met)
    low, high = min(ratings) - 10.0 * SCALE, max(ratings) + 10.0 * SCALE
    for _ in range(60):  # bisection, to far below a point
        middle = 0.5 * (low + high)
        got = sum(n * expected(middle - r) for _, n, r in met)
        low, high = (middle, high) if got < wanted else (low, middle)
    return 0.5 * (low + high)


@dataclass(frozen=True)
class Score:
    """A mean score with its 95 % interval, and the same as a rating difference."""

    mean: float
    low: float
    high: float

    @property
    def elo(self) -> tuple[float, float, float]:
        """Difference, lower and upper end; infinite where nothing or everything was won."""
        return difference(self.mean), difference(self.low), difference(self.high)


def score(wins: int, draws: int, losses: int) -> Score:
    """Mean score of games, with Wilson's interval. Raises ValueError without games.

    The interval is that of as many games without draws: a draw varies less than a win or a loss,
    so it is too wide where there are draws, never too narrow.
    """
    games = wins + draws + losses
    if games < 1:
        raise ValueError("there are no games to rate")
    mean = (wins + 0.5 * draws) / games
    z2 = float(ndtri(0.975)) ** 2
    middle = (mean + z2 / (2 * games)) / (1 + z2 / games)
    half = math.sqrt(z2 * (mean * (1 - mean) / games + z2 / (4 * games * games))) / (1 + z2 / games)
    low = 0.0 if mean == 0.0 else max(0.0, middle - half)
    return Score(mean, low, 1.0 if mean == 1.0 else min(1.0, middle + half))


def fit(scores: np.ndarray, games: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ratings of P players from a round robin, player 0's being 0, and half 95 % intervals.

    Args:
        scores: (P, P) sum of the scores of the player of the row against that of the column.
        games: (P, P) games between them, symmetric.

    Each pair that met is given one more game, a draw, so that who won everything has a rating.
    Raises ValueError where the results do not connect all players.
    """
    met = games > 0
    reach = np.linalg.matrix_power(np.eye(len(games)) + met, len(games)) > 0
    if not reach.all():
        raise ValueError("the games do not connect all players: nothing compares their ratings")
    games = games + met
    scores = scores + 0.5 * met
    ratings = np.zeros(len(games))
    information = np.eye(len(games) - 1)
    for _ in range(100):  # Newton's method: the likelihood is concave
        chance = 1.0 / (1.0 + np.exp(-_RATE * (ratings[:, None] - ratings[None])))
        slope = _RATE * (scores - games * chance).sum(1)
        curve = _RATE**2 * games * chance * (1.0 - chance)
        information = (np.diag(curve.sum(1)) - curve)[1:, 1:]
        step = np.linalg.solve(information, slope[1:]) if len(games) > 1 else np.zeros(0)
        ratings[1:] += np.clip(step, -SCALE, SCALE)
        if not len(step) or np.abs(step).max() < 1e-9:
            break
    half = np.zeros(len(games))
    half[1:] = ndtri(0.975) * np.sqrt(np.diag(np.linalg.inv(information)))
    return ratings, half
