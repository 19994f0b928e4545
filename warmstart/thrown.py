"""What flies from a hand: a javelin with drag, as its task has it, and a ball into a basket."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from sports.hoop import APEX, RING_RADIUS
from sports.humanoid.hold import JAVELIN, JAVELIN_RADIUS
from sports.javelin import END, LINE_X
from sports.physics.base import GRAVITY

FLIGHT_STEP, LONGEST_FLIGHT = 1.0 / 120.0, 960
"""Time step of a flight (s), and how many of them are followed at most."""


def _drag(v: np.ndarray, nose: np.ndarray) -> np.ndarray:
    """(..., 3) deceleration (m/s^2) of a javelin at velocity ``v`` (m/s) that points along
    ``nose``."""
    assert JAVELIN.drag is not None
    k_along, k_across = (k / JAVELIN.shapes[0].mass for k in JAVELIN.drag)
    along = (v * nose).sum(-1, keepdims=True) * nose
    across = v - along
    out = k_along * np.linalg.norm(along, axis=-1, keepdims=True) * along
    return out + k_across * np.linalg.norm(across, axis=-1, keepdims=True) * across


def distance(place: np.ndarray, velocity: np.ndarray, nose: np.ndarray, drag: bool = True) -> float:
    """Where a javelin first meets the ground, beyond the line (m): gravity, drag along and across,
    no turning.

    ``place`` (3,) and ``velocity`` (3,) of its centre at the release, ``nose`` (3,) unit; without
    ``drag`` in a vacuum.
    """

    def rate(_: float, state: np.ndarray) -> np.ndarray:
        v, a = state[3:], np.array([0.0, 0.0, -GRAVITY])
        return np.concatenate([v, a - _drag(v, nose) if drag else a])

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


@dataclass(frozen=True)
class Landing:
    """Where N javelins come down; all (N,)."""

    far: np.ndarray
    """Beyond the line (m); NaN where the state was not finite or it flies too long."""
    aside: np.ndarray
    """y (m)"""
    elevation: np.ndarray
    """Of the nose (rad)."""


def fly(place: np.ndarray, velocity: np.ndarray, nose: np.ndarray, turning: np.ndarray) -> Landing:
    """Where javelins come down that turn in flight, as symmetric tops do: the nose goes about the
    angular momentum.

    Args:
        place: (N, 3) their centres (m).
        velocity: (N, 3) of these (m/s).
        nose: (N, 3) unit.
        turning: (N, 3) angular momentum over the moment of inertia across the shaft (rad/s): for a
            shaft without spin its angular velocity.

    Velocity Verlet at ``FLIGHT_STEP``; gravity and drag are those of :func:`distance`.
    """
    finite = np.isfinite(np.hstack([place, velocity, nose, turning]))
    going = np.asarray(finite.all(axis=1))
    x, v, n, turning = (np.where(going[:, None], a, 0.0) for a in (place, velocity, nose, turning))
    rate = np.linalg.norm(turning, axis=1, keepdims=True)
    axis = turning / np.maximum(rate, 1e-9)
    lengthwise = (n * axis).sum(1, keepdims=True) * axis
    first, second = n - lengthwise, np.cross(axis, n)

    def pull(v: np.ndarray, n: np.ndarray) -> np.ndarray:
        return -_drag(v, n) - (0.0, 0.0, GRAVITY)

    def ends(x: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(N, 3) the lower end."""
        low = x - END * np.where(n[:, 2:] > 0.0, 1.0, -1.0) * n
        return low - (0.0, 0.0, JAVELIN_RADIUS)

    out = np.full((3, len(place)), np.nan)
    low = ends(x, n)
    a = pull(v, n)
    for k in range(1, LONGEST_FLIGHT):
        angle = k * FLIGHT_STEP * rate
        n = lengthwise + np.cos(angle) * first + np.sin(angle) * second
        x = x + FLIGHT_STEP * v + 0.5 * FLIGHT_STEP**2 * a
        later = pull(v + FLIGHT_STEP * a, n)
        v, a = v + 0.5 * FLIGHT_STEP * (a + later), later
        before, low = low, ends(x, n)
        lands = np.flatnonzero(going & (low[:, 2] <= 0.0))
        if len(lands):
            drop = np.maximum(before[lands, 2] - low[lands, 2], 1e-12)
            share = np.clip(before[lands, 2] / drop, 0.0, 1.0)[:, None]
            met = before[lands] + share * (low[lands] - before[lands])
            tip = np.arcsin(np.clip(n[lands, 2], -1.0, 1.0))
            out[:, lands] = met[:, 0] - LINE_X, met[:, 1], tip
            going[lands] = False
            if not going.any():
                break
    return Landing(*out)


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
