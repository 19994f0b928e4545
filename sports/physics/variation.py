"""Worlds that differ a little, so that a policy cannot live on one engine's numbers.

Violent motion on the ground depends on the time step of every engine: a policy trained on one
world alone won 91 % of its long jumps at 1/120 s and none at 1/240 s or in Drake (measured). In
training each world may have its own friction, gains, contact softness and time step.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class Variation:
    """Ranges drawn once per world, uniformly."""

    friction: tuple[float, float] = (0.8, 1.2)
    """Factor of every friction coefficient."""
    stiffness: tuple[float, float] = (0.9, 1.1)
    """Factor of every servo stiffness."""
    damping: tuple[float, float] = (0.9, 1.1)
    """Factor of every joint damping."""
    contact_time: tuple[float, float] = (0.012, 0.024)
    """Time constant of contacts (s; 0.02 is MuJoCo's default)."""
    coarse_share: float = 0.5
    """Share of worlds that take two substeps in one, where the scene has an even number: with
    ``timestep_divisor=2`` they run at the usual time step and the others at half of it."""

    def __post_init__(self) -> None:
        for name in ("friction", "stiffness", "damping", "contact_time"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high:
                raise ValueError(f"variation: {name} must be 0 < low <= high, not {low}, {high}")
        if not 0.0 <= self.coarse_share <= 1.0:
            raise ValueError(f"variation: coarse_share must be in [0, 1], not {self.coarse_share}")


@dataclass(frozen=True)
class Draw:
    """What each world got; all (N,)."""

    friction: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    contact_time: np.ndarray
    coarse: np.ndarray
    """bool"""

    def of(self, worlds: slice) -> Draw:
        """That of some worlds."""
        return Draw(*(getattr(self, field.name)[worlds] for field in fields(self)))


def draw(variation: Variation, num_worlds: int, substeps: int, seed: int) -> Draw:
    """One draw for each world. Coarse worlds need an even number of substeps: else there are
    none."""
    rng = np.random.default_rng(seed)

    def uniform(span: tuple[float, float]) -> np.ndarray:
        return rng.uniform(*span, size=num_worlds)

    values = [
        uniform(getattr(variation, name))
        for name in ("friction", "stiffness", "damping", "contact_time")
    ]
    coarse = rng.random(num_worlds) < variation.coarse_share
    return Draw(*values, coarse=coarse & (substeps % 2 == 0) & (substeps > 4))
