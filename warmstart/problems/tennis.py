"""Tennis: return a machine's ball to a target, with a forehand or a backhand, at a given speed.

The machine launches as in the task, the ball bounces once, and the athlete stands where its racket
can meet it. The ball law gives the face and the velocity of the racket after which the ball leaves
with ``ball_speed`` and lands at the target (:func:`warmstart.shot.stroke_to`); the motion that
brings the racket there costs the least effort. Both feet stay where they stand. The plan knows the
racket's inertia but not the blow of the ball (0.058 kg), which comes after the event and is felt in
the replays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sports import tennis
from sports.humanoid.body import Body, load_body
from sports.scene import Scene
from warmstart import shot
from warmstart.contact import Ball
from warmstart.phases import Phase
from warmstart.problems import jumper, striker
from warmstart.solution import Solution
from warmstart.transcription import Transcription

GAME = tennis.GAME
MEET_X = 12.5
"""The ball is met when it comes to this plane (m): half a metre before the task's start."""
BEFORE = {"forehand": (0.45, -0.75), "backhand": (0.62, 0.40)}
"""Where the ball is met, ahead of and to the left of the middle between the feet (m)."""
FACE = {"forehand": -1.0, "backhand": 1.0}
"""Which side of the racket hits: along the wrist's z, the back of the hand."""
RACKET = (
    Ball("R_Wrist", (0.0, -tennis.RACKET_REACH, 0.0), tennis.RACKET_RADIUS),
    Ball("R_Wrist", (0.0, -0.14, 0.0), 0.03),
)
"""Balls around the racket's head and handle, for clearances."""
YAW = math.pi
FEET = {"L": "flat", "R": "flat"}
SWING, FOLLOW = (0.40, 0.75), (0.30, 0.50)
"""Durations (s) until the impact, and after it."""
DURATIONS = (0.66, 0.35)
"""The same of a first guess."""


@dataclass(frozen=True)
class Config(striker.Config):
    """Options of the tennis problem."""

    ball_speed: float = 24.0
    """Speed of the ball right after the impact (m/s)."""
    side: Literal["forehand", "backhand"] = "forehand"
    target: tuple[float, float] = (-9.5, 1.5)
    """Where the ball is to land in the far court, x and y (m)."""
    machine_speed: float = 20.0
    """Forward speed of the machine's ball at its launch (m/s)."""
    bounce: tuple[float, float] = (7.5, 0.0)
    """Where the machine's ball bounces, x and y (m)."""
    brush: float = 0.35
    """How steeply the racket rises across its face (rad): topspin."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 10.0 <= self.ball_speed <= 60.0:
            raise ValueError(f"ball_speed must lie between 10 and 60 m/s, not {self.ball_speed}")
        if self.side not in BEFORE:
            raise ValueError(f"side must be 'forehand' or 'backhand', not '{self.side}'")
        x, y = self.target
        if not (-tennis.HALF_LENGTH <= x <= -1.0 and abs(y) <= tennis.HALF_WIDTH):
            raise ValueError(f"target {self.target} does not lie in the far court")
        if not 14.0 <= self.machine_speed <= 30.0:
            raise ValueError(
                f"machine_speed must lie between 14 and 30 m/s, not {self.machine_speed}"
            )
        x, y = self.bounce
        if not (3.0 <= x <= tennis.HALF_LENGTH and abs(y) <= tennis.HALF_WIDTH):
            raise ValueError(f"bounce {self.bounce} does not lie in the near court")
        if not -0.2 <= self.brush <= 0.9:
            raise ValueError(f"brush must lie between -0.2 and 0.9 rad, not {self.brush}")


def scene(body: Body) -> Scene:
    """The task's scene."""
    return tennis.scene(tennis.Tennis(), body)


def make_event(
    config: Config, body: Body
) -> tuple[striker.Event, tuple[float, float, float], shot.Ball, shot.Ball, shot.Stroke]:
    """What the racket must do, where the athlete stands (x, y, yaw), the machine's ball at its
    launch and at the impact, and the stroke. Raises ValueError where the ball law has no such
    stroke."""
    start = np.array([GAME.serve.x, 0.0, GAME.serve.z[0]])
    launched, ball = shot.incoming(GAME, start, config.machine_speed, config.bounce, MEET_X)
    if not 0.5 <= ball.pos[2] <= 1.5:
        raise ValueError(
            f"the machine's ball comes at a height of {ball.pos[2]:.2f} m, no stroke from the "
            "ground; choose a bounce between 6.5 and 8.5 m"
        )
    face = (0.0, 0.0, FACE[config.side])
    point = (0.0, -tennis.RACKET_REACH, FACE[config.side] * tennis.RACKET_THICKNESS / 2)
    stroke = shot.stroke_to(
        GAME,
        ball,
        config.target,
        config.ball_speed,
        config.brush,
        shot.racket_numbers(scene(body)),
        face,
        np.array(point),
    )
    place = ball.pos - GAME.radius * stroke.normal
    ahead, left = BEFORE[config.side]

    def own(v: np.ndarray) -> tuple[float, float, float]:
        """In the frame of the athlete, which faces -x."""
        return -float(v[0]), -float(v[1]), float(v[2])

    event = striker.Event(
        "R_Wrist",
        point,
        face,
        (ahead, left, float(place[2])),
        own(stroke.velocity),
        own(stroke.normal),
    )
    where = (float(place[0]) + ahead, float(place[1]) + left, YAW)
    return event, where, launched, ball, stroke


def transcribe(
    config: Config, body: Body, event: striker.Event, elastic: bool = False
) -> Transcription:
    """The nonlinear program."""
    knots = jumper.scaled(config.detail)
    phases = [Phase("swing", knots(32), SWING, FEET), Phase("follow", knots(15), FOLLOW, FEET)]
    position = {} if config.side == "forehand" else BACKHAND_POSITION
    program = striker.transcribe(
        body, event, phases, config, position=position, tool=RACKET, elastic=elastic
    )
    ready = READY[config.side]
    for name, (low, high) in ready.items():
        program.bound(program.q[0, program.model.index(name)], low, high)
    for name in ("pitch", "roll"):
        program.bound(program.q[-1, program.model.index(name)], -0.2, 0.25)
    return program


READY = {
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
}
"""Boxes (rad) of the pose in which the athlete waits."""
BACKHAND_POSITION = {"R_Shoulder_z": (-0.9, 2.1), "R_Elbow_y": (-1.2, 1.2)}


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort stroke. See :meth:`warmstart.problems.Problem.solve`."""
    body = load_body("smpl", strength=config.strength, equipment=["racket"])
    event, where, launched, ball, stroke = make_event(config, body)
    return striker.solve(
        "tennis",
        {"ball_speed": config.ball_speed},
        event,
        lambda elastic: transcribe(config, body, event, elastic),
        lambda program: striker.key_guess(program, f"tennis_{config.side}", DURATIONS),
        guess,
        config,
        progress,
        f"a {config.side} of {config.ball_speed:g} m/s "
        f"(racket {np.linalg.norm(stroke.velocity):.1f} m/s)",
        where,
        ball={
            "launch": {"pos": launched.pos.tolist(), "linvel": launched.linvel.tolist()},
            "met": float(ball.time),
            "target": list(config.target),
            "over_net": stroke.over_net,
        },
    )
