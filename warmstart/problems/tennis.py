"""Tennis: return a machine's ball to a target, with a forehand or a backhand, at a given speed.

See :mod:`warmstart.problems.racket` for how; here are the places and the poses of tennis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sports import tennis
from sports.humanoid.body import Body
from sports.scene import Scene
from warmstart.contact import Ball
from warmstart.problems import racket
from warmstart.solution import Solution

GAME = tennis.GAME


def scene(body: Body) -> Scene:
    """The task's scene."""
    return tennis.scene(tennis.Tennis(), body)


SPORT = racket.Sport(
    name="tennis",
    game=GAME,
    equipment="racket",
    scene=scene,
    half_thickness=tennis.RACKET_THICKNESS / 2,
    tool=(
        Ball("R_Wrist", (0.0, -tennis.RACKET_REACH, 0.0), tennis.RACKET_RADIUS),
        Ball("R_Wrist", (0.0, -0.14, 0.0), 0.03),
    ),
    meet_x=12.5,  # half a metre before the task's start
    heights=(0.5, 1.5),
    before={"forehand": (0.45, -0.75), "backhand": (0.62, 0.40)},
    ready={
        "forehand": {
            "yaw": (-0.5, 0.5),
            "R_Shoulder_x": (0.7, 1.3),
            "R_Shoulder_z": (-0.4, 0.6),
            "R_Elbow_z": (0.5, 1.9),
            "L_Shoulder_x": (-1.45, -0.7),
        },
        "backhand": {
            "yaw": (-0.6, 0.6),
            "R_Shoulder_x": (0.7, 1.4),
            "R_Shoulder_z": (0.0, 1.4),
            "R_Elbow_z": (0.3, 1.9),
            "L_Shoulder_x": (-1.45, -0.7),
        },
    },
    position={"backhand": {"R_Shoulder_z": (-0.9, 2.1), "R_Elbow_y": (-1.2, 1.2)}},
)


@dataclass(frozen=True)
class Config(racket.Config):
    """Options of the tennis problem."""

    ball_speed: float = 24.0
    """Speed of the ball right after the impact (m/s)."""
    target: tuple[float, float] = (-9.5, 1.5)
    """Where the ball is to land in the far court, x and y (m)."""
    machine_speed: float = 20.0
    """Forward speed of the machine's ball at its launch (m/s)."""
    bounce: tuple[float, float] = (7.5, 0.0)
    """Where the machine's ball bounces, x and y (m)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check(GAME, (10.0, 60.0), (14.0, 30.0))


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort stroke. See :meth:`warmstart.problems.Problem.solve`."""
    return racket.solve(SPORT, config, guess, progress)
