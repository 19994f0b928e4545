"""What flies from a hand: a javelin with drag, as its task has it, and a ball into a basket."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from sports.hoop import APEX, RING_RADIUS
from sports.humanoid.hold import JAVELIN, JAVELIN_RADIUS
from sports.javelin import END, LINE_X
from sports.physics.base import GRAVITY


def distance(place: np.ndarray, velocity: np.ndarray, nose: np.ndarray, drag: bool = True) -> float:
    """Where a javelin first meets the ground, beyond the line (m): gravity, drag along and across,
    no turning.

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


def shot(place: np.ndarray, rim: np.ndarray, apex: float = APEX) -> np.ndarray:
    """(3,) velocity (m/s) with which a ball at ``place`` (3,) rises to ``apex`` (m) above the rim
    and falls through the rim's middle ``rim`` (3,): the shot v* of ``sports/hoop.py``.

    Raises ValueError for a place above the apex.
    """
    rise = float(rim[2] + apex - place[2])
    if rise < 0.0:
        raise ValueError(f"a ball at {place[2]:.2f} m is above the apex asked for")
    time = np.sqrt(2 * rise / GRAVITY) + np.sqrt(2 * apex / GRAVITY)
    across = (rim[:2] - place[:2]) / time
    return np.array([across[0], across[1], np.sqrt(2 * GRAVITY * rise)])


def inside(there: np.ndarray, rim: np.ndarray) -> bool:
    """Whether a ball that is at ``there`` in the plane of a rim is inside its ring."""
    return float(np.linalg.norm(there[:2] - rim[:2])) < RING_RADIUS


def fall(place: np.ndarray, velocity: np.ndarray, rim: np.ndarray) -> dict[str, float]:
    """What becomes of a ball in flight, by the parabola of its centre.

    ``apex``: of its path above the rim (m); ``miss``: from the rim's middle to where it comes down
    through the rim's plane, or to its apex where it stays below (m); ``basket``: 1 where it comes
    down inside the ring, else 0; ``entry``: its angle below the horizontal there (degrees, 0 where
    it stays below). Board and ring are not there.
    """
    up = float(velocity[2])
    if up > 0.0:
        apex = float(place[2]) + up**2 / (2 * GRAVITY) - float(rim[2])
        top = up / GRAVITY
    else:
        apex, top = float(place[2] - rim[2]), 0.0
    reached = apex > 0.0
    down = max(apex, 0.0)
    # Downward speed in the plane; a ball thrown downward from above has one at once.
    speed = np.sqrt(2 * GRAVITY * down + (0.0 if up > 0.0 else up**2))
    time = top + (speed - (0.0 if up > 0.0 else -up)) / GRAVITY
    there = place[:2] + velocity[:2] * time
    miss = float(np.linalg.norm(there - rim[:2]))
    angle = np.degrees(np.arctan2(speed, np.linalg.norm(velocity[:2]))) if reached else 0.0
    return {
        "apex": apex,
        "miss": miss,
        "basket": float(reached and inside(there, rim)),
        "entry": float(angle),
    }
