"""CMA-ES (Hansen 2016, arXiv:1604.00772) that takes all of its chance from a generator of ours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cma
import numpy as np


def strategy(
    start: np.ndarray,
    spread: float,
    candidates: int,
    rng: Callable[[], np.random.Generator],
    **more: Any,
) -> cma.CMAEvolutionStrategy:
    """A quiet search around ``start`` (K,), with ``candidates`` in a round and the normal numbers
    of the generator that ``rng()`` gives at the time. ``more``: options of the package."""
    options = {
        "popsize": candidates,
        "randn": lambda *shape: rng().standard_normal(shape),
        "seed": np.nan,  # leaves NumPy's own generator alone
        "verbose": -9,
        **more,
    }
    return cma.CMAEvolutionStrategy(start, spread, options)
