"""What a hand did at its moment: strikes and throws measured on frames, no optimiser is asked.

A strike counts where its point comes nearest to the place of the impact, whenever that is: who is
a millisecond late at 20 m/s is 2 cm away at the planned time and yet meets the ball. A throw
counts at the planned time, at which the hand opens.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from sports.humanoid.body import Body
from warmstart import rotation
from warmstart.outcome import link_poses
from warmstart.replay import FEEDBACK, Replayed, replay_all
from warmstart.solution import Solution

AROUND = 0.06
"""A strike is looked for this long (s) before and after its planned time."""
FINE = 1e-4
"""Resolution of that search (s)."""


@dataclass(frozen=True)
class Moment:
    """What a point of a link did, in the world."""

    time: float
    """s from the first frame."""
    miss: float
    """Distance from the asked place (m)."""
    place: np.ndarray
    velocity: np.ndarray
    """m/s"""
    rotation: np.ndarray
    """(3, 3) R_world_link."""
    normal: np.ndarray
    """The direction of the link that was asked to point somewhere."""

    def speed_off(self, event: dict[str, Any]) -> float:
        """Difference of the speed from the asked one, over it."""
        asked = float(np.linalg.norm(event["velocity"]))
        return abs(float(np.linalg.norm(self.velocity)) - asked) / asked

    def angle_off(self, event: dict[str, Any]) -> float:
        """Between the velocity and the asked one (degrees)."""
        return _angle(self.velocity, event["velocity"])

    def face_off(self, event: dict[str, Any]) -> float:
        """Between the normal and the asked one (degrees)."""
        return _angle(self.normal, event["normal"])


def _angle(a: Any, b: Any) -> float:
    a, b = np.asarray(a, float), np.asarray(b, float)
    sine = np.linalg.norm(np.cross(a, b))
    return float(np.degrees(np.arctan2(sine, np.dot(a, b))))


def moment(
    body: Body, event: dict[str, Any], times: np.ndarray, qpos: np.ndarray, nearest: bool = True
) -> Moment:
    """The moment of a strike (where it is ``nearest`` to its place) or of a throw (at its time).

    ``event``: ``time, link, point, axis, place, velocity, normal`` as in a solution's stats;
    ``times`` (T,) s, ``qpos`` (T, >= 7 + n), at least 100 frames a second. Raises ValueError where
    the frames do not cover the event.
    """
    at = float(event["time"])
    near = np.flatnonzero(np.abs(times - at) <= AROUND + 0.02)
    if len(near) < 5 or times[-1] < at - 1e-9:
        raise ValueError(f"the frames do not cover the event at {at:.3f} s")
    width = 7 + body.num_dofs
    pos, quat = link_poses(body, qpos[near, :width])
    link = body.link_index(event["link"])
    point = np.broadcast_to(np.array(event["point"], float), (len(near), 3))
    path = CubicSpline(times[near], pos[:, link] + rotation.rotate(quat[:, link], point))
    own = quat[:, link]
    own = np.where(np.sum(own * own[:1], axis=1, keepdims=True) < 0, -own, own)
    attitude = CubicSpline(times[near], own)
    time = at
    if nearest:
        low, high = max(at - AROUND, times[near[0]]), min(at + AROUND, times[near[-1]])
        fine = np.linspace(low, high, 1 + round(float(high - low) / FINE))
        apart = np.linalg.norm(path(fine) - np.array(event["place"]), axis=1)
        time = float(fine[int(apart.argmin())])
    q = attitude(time) / np.linalg.norm(attitude(time))
    turn = np.stack([rotation.rotate(q, axis) for axis in np.eye(3)], axis=1)
    return Moment(
        time=time,
        miss=float(np.linalg.norm(path(time) - np.array(event["place"]))),
        place=path(time),
        velocity=path(time, 1),
        rotation=turn,
        normal=turn @ np.array(event["axis"], float),
    )


@dataclass(frozen=True)
class Rules:
    """How a problem's strike or throw is judged."""

    outcome: str
    """Key of the outcome in ``Solution.asked``."""
    unit: str
    nearest: bool
    """Whether it is judged where it is nearest to its place, or at its time."""
    follow: Callable[[Solution, Moment], dict[str, float]] | None = None
    """What comes of a moment beyond the hand, by name; ``outcome`` among it."""
    play: Callable[[Solution, str], dict[str, float]] | None = None
    """Figures of a replay in an engine with the real ball."""
    whole: Callable[[Solution, np.ndarray], dict[str, float]] | None = None
    """Figures of a whole replay, from its frames (T, 7 + n)."""
    also: Callable[[Solution], dict[str, float]] | None = None
    """Figures of the whole planned motion."""
    checks: Mapping[str, tuple[str, float, str]] = field(default_factory=dict)
    """Checks of what ``follow``, ``whole`` and ``play`` find: sense, limit, unit."""
    closed: Callable[[Solution, Replayed], dict[str, float]] | None = None
    """Figures of a replay in closed loop; None where only open loops count."""
    closed_checks: Mapping[str, tuple[str, float, str]] = field(default_factory=dict)
    """Checks of what ``closed`` finds."""


def limits(rules: Rules, feedback: bool = False) -> dict[str, tuple[str, float, str]]:
    """Checks of a certificate, of an open loop or one with feedback: sense, limit, unit."""
    out: dict[str, tuple[str, float, str]] = {
        "planned outcome": (">=", 0.0, rules.unit),
        "planned miss": ("<=", 0.002, "m"),
        "planned speed off": ("<=", 0.005, "of the asked speed"),
        "planned direction off": ("<=", 0.5, "deg"),
        "planned face off": ("<=", 0.5, "deg"),
    }
    for engine in ("mujoco", "drake"):
        out |= {
            f"replay in {engine}: outcome": (">=", 0.0, rules.unit),
            f"replay in {engine}: speed off": ("<=", 0.10, "of the asked speed"),
            f"replay in {engine}: late": ("recorded", np.nan, "s"),
        }
        if rules.nearest:
            out[f"replay in {engine}: miss"] = ("<=", 0.03, "m")
            out[f"replay in {engine}: face off"] = ("recorded", np.nan, "deg")
        else:
            out[f"replay in {engine}: direction off"] = ("<=", 3.0, "deg")
    return out | (dict(rules.closed_checks) if feedback else {}) | dict(rules.checks)


def planned(rules: Rules, solution: Solution, times: np.ndarray) -> dict[str, float]:
    """Figures of the planned motion on a grid of times; ``outcome`` among them."""
    event = solution.stats["event"]
    grid = np.unique(np.append(times, event["time"]))
    qpos = solution.sample(solution.times[0] + grid)["qpos"]
    found = moment(solution.body, event, grid, qpos, nearest=False)
    return {
        "planned miss": found.miss,
        "planned speed off": found.speed_off(event),
        "planned direction off": found.angle_off(event),
        "planned face off": found.face_off(event),
        **_followed(rules, solution, found, "planned "),
        **(rules.also(solution) if rules.also is not None else {}),
    }


def replayed(
    rules: Rules, solution: Solution, engine: str
) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """A replay in an engine: its times (T,) s, its frames (T, 7 + n) and its figures."""
    event = solution.stats["event"]
    played = replay_all(solution, engine, hold=0.1)
    times, qpos = played.times, played.qpos
    found = moment(solution.body, event, times, qpos, rules.nearest)
    head = f"replay in {engine}: "
    out = {
        f"{head}miss": found.miss,
        f"{head}speed off": found.speed_off(event),
        f"{head}direction off": found.angle_off(event),
        f"{head}face off": found.face_off(event),
        f"{head}late": found.time - event["time"],
        **_followed(rules, solution, found, head),
    }
    if rules.whole is not None:
        out |= {f"{head}{name}": value for name, value in rules.whole(solution, qpos).items()}
    if rules.play is not None:
        out |= {f"{head}{name}": value for name, value in rules.play(solution, engine).items()}
    if solution.stats.get(FEEDBACK) and rules.closed is not None:
        out |= {f"{head}{name}": value for name, value in rules.closed(solution, played).items()}
    return times, qpos, out


def _followed(rules: Rules, solution: Solution, found: Moment, head: str) -> dict[str, float]:
    if rules.follow is None:
        return {f"{head}outcome": float(np.linalg.norm(found.velocity))}
    return {f"{head}{name}": value for name, value in rules.follow(solution, found).items()}
