"""Worlds that differ a little, so that a policy cannot live on one engine's numbers.

Violent motion on the ground depends on the time step of every engine: a policy trained on one
world alone won 91 % of its long jumps at 1/120 s and none at 1/240 s or in Drake; one that had seen
half the step and a narrow range of contacts cleared the high bar at 1/120, 1/240 and 1/480 s but
fell in Drake within 1 s (measured). In training each world may have its own friction, gains,
contact softness and damping, and time step; the ranges reach from MuJoCo's ground past Drake's.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

_RANGES = ("friction", "stiffness", "damping", "contact_time", "contact_damping")
DEFAULT_SOLREF = (0.02, 1.0)
"""MuJoCo's contact time constant (s) and damping ratio."""


@dataclass(frozen=True)
class Variation:
    """Ranges drawn once per world, uniformly."""

    friction: tuple[float, float] = (0.6, 1.6)
    """Factor of every friction coefficient."""
    stiffness: tuple[float, float] = (0.9, 1.1)
    """Factor of every servo stiffness."""
    damping: tuple[float, float] = (0.9, 1.1)
    """Factor of every joint damping."""
    contact_time: tuple[float, float] = (0.006, 0.03)
    """Time constant of contacts (s; 0.02 is MuJoCo's default), of geometries that state none of
    their own. MuJoCo does not go below two time steps."""
    contact_damping: tuple[float, float] = (0.6, 1.8)
    """Damping ratio of the same contacts (1 is MuJoCo's default)."""
    coarse_share: float = 0.5
    """Share of worlds that take two substeps in one, where the scene has an even number: with
    ``timestep_divisor=2`` they run at the usual time step and the others at half of it."""

    def __post_init__(self) -> None:
        for name in _RANGES:
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
    contact_damping: np.ndarray
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

    values = [uniform(getattr(variation, name)) for name in _RANGES]
    coarse = rng.random(num_worlds) < variation.coarse_share
    return Draw(*values, coarse=coarse & (substeps % 2 == 0) & (substeps > 4))


def contact_softness(solref: np.ndarray, drawn: Draw) -> np.ndarray:
    """(N, geoms, 2) ``solref`` of every world: the drawn time constant and damping ratio wherever
    the model's (geoms, 2) are MuJoCo's own, else the model's."""
    worlds = np.stack((drawn.contact_time, drawn.contact_damping), axis=-1)[:, None]
    own = np.any(solref != DEFAULT_SOLREF, axis=-1)[None, :, None]
    return np.where(own, solref[None], worlds)
