"""The flight of a javelin, as the task has it: gravity, drag along and across, no turning."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from sports.humanoid.hold import JAVELIN, JAVELIN_RADIUS
from sports.javelin import END, LINE_X
from sports.physics.base import GRAVITY


def distance(place: np.ndarray, velocity: np.ndarray, nose: np.ndarray, drag: bool = True) -> float:
    """Where a javelin first meets the ground, beyond the line (m).

    ``place`` (3,) and ``velocity`` (3,) of its centre at the release, ``nose`` (3,) unit; without
    ``drag`` in a vacuum.
    """
    assert JAVELIN.drag is not None
    k_along, k_across = (k / JAVELIN.shapes[0].mass for k in JAVELIN.drag)

    def rate(_: float, state: np.ndarray) -> np.ndarray:
        v = state[3:]
        along = float(v @ nose) * nose
        across = v - along
        a = np.array([0.0, 0.0, -GRAVITY])
        if drag:
            a -= k_along * np.linalg.norm(along) * along
            a -= k_across * np.linalg.norm(across) * across
        return np.concatenate([v, a])

    low = END * abs(float(nose[2]))

    def lowest(_: float, state: np.ndarray) -> float:
        return state[2] - low - JAVELIN_RADIUS

    lowest.terminal, lowest.direction = True, -1.0  # type: ignore[attr-defined]
    start = np.concatenate([place, velocity])
    if lowest(0.0, start) <= 0.0:
        end = start
    else:
        end = solve_ivp(rate, (0.0, 20.0), start, events=lowest, rtol=1e-9, atol=1e-9).y[:, -1]
    tip = -np.sign(nose[2]) * END * nose
    return float(end[0] + tip[0] - LINE_X)
