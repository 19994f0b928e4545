"""Tells that a run's divergence control has nothing left to turn down."""

from __future__ import annotations

from rl.ppo import PPOConfig
from rl.runlog import Row

ITERATIONS = 20
"""In a row, before anything is said."""


class InARow:
    """Counts how often in a row something was so."""

    def __init__(self) -> None:
        self._times = 0

    def __call__(self, so: bool) -> bool:
        """Takes an iteration in; True once, when it has been so for ITERATIONS of them."""
        if self._times == ITERATIONS:
            return False
        self._times = self._times + 1 if so else 0
        return self._times == ITERATIONS


class RateWatch:
    """Looks at the rows of a run with PPO's KL control."""

    def __init__(self, config: PPOConfig) -> None:
        self.config = config
        self._long = InARow()

    def __call__(self, row: Row, share: float) -> str | None:
        """One sentence, once, where the divergence has stayed above its band at the least learning
        rate: the updates are then larger than was asked for, and what they learn is mostly noise.
        ``share`` of the run is done, 0..1."""
        band, least = self.config.kl_band_at(share), self.config.learning_rate_limits[0]
        kl, rate = row.get("kl"), row.get("learning_rate")
        if band is None or kl is None or rate is None:
            return None
        most = band[1]
        if not self._long(kl > most and rate <= least * 1.001):
            return None
        return (
            f"the divergence has been above {most:.3g} for {ITERATIONS} iterations at the least "
            f"learning rate, {least:.3g}: lower --ppo.learning-rate-limits, or take --precision "
            "float32 where sigma is small"
        )
