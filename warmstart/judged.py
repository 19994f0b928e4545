"""How the strikes and throws are judged, by problem."""

from __future__ import annotations

import numpy as np

from sports import tennis
from warmstart import shot, thrown
from warmstart.solution import Solution
from warmstart.strike import Moment, Rules


def _tennis(solution: Solution, found: Moment) -> dict[str, float]:
    scene = tennis.scene(tennis.Tennis(), solution.body)
    return shot.followed(tennis.GAME, scene, solution, found)


def _tennis_played(solution: Solution, engine: str) -> dict[str, float]:
    scene = tennis.scene(tennis.Tennis(), solution.body)
    return shot.played(tennis.GAME, scene, solution, engine)


def _javelin(solution: Solution, found: Moment) -> dict[str, float]:
    return {
        "outcome": float(np.linalg.norm(found.velocity)),
        "height": float(found.place[2]),
        "distance": thrown.distance(found.place, found.velocity, found.normal),
    }


_THROWN: dict[str, tuple[str, float, str]] = {
    f"{head}{name}": ("recorded", float("nan"), "m")
    for head in ("planned ", "replay in mujoco: ", "replay in drake: ")
    for name in ("height", "distance")
}
_BALL: dict[str, tuple[str, float, str]] = {
    "planned landing off target": ("<=", 0.5, "m"),
    "planned over the net": (">=", 0.0, "m"),
    **{
        f"replay in {engine}: {name}": ("recorded", float("nan"), unit)
        for engine in ("mujoco", "drake")
        for name, unit in (
            ("landing off target", "m"),
            ("over the net", "m"),
            ("ball: speed", "m/s"),
            ("ball: landing off target", "m"),
            ("ball: over the net", "m"),
        )
    },
}

RULES: dict[str, Rules] = {
    "javelin": Rules("release_speed", "m/s", False, _javelin, None, _THROWN),
    "tennis": Rules("ball_speed", "m/s", True, _tennis, _tennis_played, _BALL),
}
"""By problem."""
