"""What the strokes of tennis and table tennis share.

The machine launches as in the task, the ball bounces once, and the athlete stands where its racket
can meet it. The ball law gives the face and the velocity of the racket after which the ball leaves
with ``ball_speed`` and lands at the target (:func:`warmstart.shot.stroke_to`); the motion that
brings the racket there costs the least effort. Both feet stay where they stand. The plan knows the
racket's inertia but not the blow of the ball, which comes after the event and is felt in the
replays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sports.humanoid.body import Body, load_body
from sports.rackets import WRIST, Game
from sports.scene import Scene
from warmstart import shot
from warmstart.contact import Ball
from warmstart.phases import Phase
from warmstart.problems import jumper, striker
from warmstart.solution import Solution
from warmstart.transcription import Transcription

FACE = {"forehand": -1.0, "backhand": 1.0}
"""Which side of the racket hits: along the wrist's z, the back of the hand."""
YAW = math.pi
"""The athlete faces -x."""
FEET = {"L": "flat", "R": "flat"}
SWING, FOLLOW = (0.40, 0.75), (0.30, 0.50)
"""Durations (s) until the impact, and after it."""
DURATIONS = (0.66, 0.35)
"""The same of a first guess."""
Boxes = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Sport:
    """What tells one racket sport from the other."""

    name: str
    game: Game
    equipment: str
    scene: Callable[[Body], Scene]
    """The task's scene."""
    half_thickness: float
    """Of the racket (m)."""
    tool: tuple[Ball, ...]
    """Balls around head and handle, for clearances."""
    meet_x: float
    """The ball is met when it comes to this plane (m)."""
    heights: tuple[float, float]
    """Between which the ball may come there (m)."""
    before: Mapping[str, tuple[float, float]]
    """Where the ball is met, ahead of and to the left of the middle between the feet (m), by side
    of the stroke."""
    ready: Mapping[str, Boxes]
    """Boxes (rad) of the pose in which the athlete waits, by side."""
    position: Mapping[str, Boxes]
    """Pose boxes (rad) that differ from those of all strokes, by side."""


@dataclass(frozen=True)
class Config(striker.Config):
    """Options of a stroke to a target."""

    ball_speed: float = 10.0
    """Speed of the ball right after the impact (m/s)."""
    side: Literal["forehand", "backhand"] = "forehand"
    target: tuple[float, float] = (0.0, 0.0)
    """Where the ball is to land beyond the net, x and y (m)."""
    machine_speed: float = 10.0
    """Forward speed of the machine's ball at its launch (m/s)."""
    bounce: tuple[float, float] = (0.0, 0.0)
    """Where the machine's ball bounces on the athlete's side, x and y (m)."""
    brush: float = 0.35
    """How steeply the racket rises across its face (rad): topspin."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.side not in FACE:
            raise ValueError(f"side must be 'forehand' or 'backhand', not '{self.side}'")
        if not -0.2 <= self.brush <= 0.9:
            raise ValueError(f"brush must lie between -0.2 and 0.9 rad, not {self.brush}")

    def check(self, game: Game, ball: tuple[float, float], machine: tuple[float, float]) -> None:
        """Raises ValueError for speeds outside ``ball`` and ``machine`` (m/s), or for places that
        are not on the court of the game."""
        for name, (low, high) in (("ball_speed", ball), ("machine_speed", machine)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} must lie between {low:g} and {high:g} m/s, not {value}")
        length, width = game.court.half_length, game.court.half_width
        for name, side, words in (("target", -1.0, "far"), ("bounce", 1.0, "near")):
            x, y = getattr(self, name)
            if not (0.05 * length <= side * x <= length and abs(y) <= width):
                raise ValueError(f"{name} {(x, y)} does not lie in the {words} half of the court")


@dataclass(frozen=True)
class Aim:
    """What a stroke has to do, and what it has to do with."""

    event: striker.Event
    where: tuple[float, float, float]
    """Where the athlete stands: x, y (m) and yaw (rad)."""
    launched: shot.Ball
    met: shot.Ball
    stroke: shot.Stroke


def aim(sport: Sport, config: Config, body: Body) -> Aim:
    """The stroke that the options ask for. Raises ValueError where the ball law has none."""
    game, sign = sport.game, FACE[config.side]
    start = np.array([game.serve.x, 0.0, game.serve.z[0]])
    launched, ball = shot.incoming(game, start, config.machine_speed, config.bounce, sport.meet_x)
    low, high = sport.heights
    if not low <= ball.pos[2] <= high:
        raise ValueError(
            f"the machine's ball comes at a height of {ball.pos[2]:.2f} m, out of reach of a "
            "stroke from the ground; choose another bounce or machine_speed"
        )
    face = (0.0, 0.0, sign)
    point = (0.0, -game.reach, sign * sport.half_thickness)
    tool = shot.tool_numbers(sport.scene(body))
    stroke = shot.stroke_to(
        game, ball, config.target, config.ball_speed, config.brush, tool, face, np.array(point)
    )
    place = ball.pos - game.radius * stroke.normal
    ahead, left = sport.before[config.side]

    def own(v: np.ndarray) -> tuple[float, float, float]:
        """In the frame of the athlete, which faces -x."""
        return -float(v[0]), -float(v[1]), float(v[2])

    event = striker.Event(
        WRIST,
        point,
        face,
        (ahead, left, float(place[2])),
        own(stroke.velocity),
        own(stroke.normal),
    )
    where = (float(place[0]) + ahead, float(place[1]) + left, YAW)
    return Aim(event, where, launched, ball, stroke)


def transcribe(
    sport: Sport, config: Config, body: Body, event: striker.Event, elastic: bool = False
) -> Transcription:
    """The nonlinear program."""
    knots = jumper.scaled(config.detail)
    phases = [Phase("swing", knots(32), SWING, FEET), Phase("follow", knots(15), FOLLOW, FEET)]
    position = sport.position.get(config.side, {})
    program = striker.transcribe(
        body, event, phases, config, position=position, tool=sport.tool, elastic=elastic
    )
    for name, (low, high) in sport.ready[config.side].items():
        program.bound(program.q[0, program.model.index(name)], low, high)
    for name in ("pitch", "roll"):
        program.bound(program.q[-1, program.model.index(name)], -0.2, 0.25)
    return program


def solve(
    sport: Sport,
    config: Config,
    guess: Solution | None,
    progress: Callable[[int, float], None] | None,
    more: Callable[[Transcription, Aim], None] = lambda program, aimed: None,
) -> Solution:
    """The least-effort stroke; ``more`` adds a sport's own rows to the program."""
    body = load_body("smpl", strength=config.strength, equipment=[sport.equipment])
    aimed = aim(sport, config, body)

    def transcribed(elastic: bool) -> Transcription:
        program = transcribe(sport, config, body, aimed.event, elastic)
        more(program, aimed)
        return program

    launched = aimed.launched
    return striker.solve(
        sport.name,
        {"ball_speed": config.ball_speed},
        aimed.event,
        transcribed,
        lambda program: striker.key_guess(program, f"{sport.name}_{config.side}", DURATIONS),
        guess,
        config,
        progress,
        f"a {config.side} of {config.ball_speed:g} m/s "
        f"(racket {np.linalg.norm(aimed.stroke.velocity):.1f} m/s)",
        aimed.where,
        ball={
            "launch": {"pos": launched.pos.tolist(), "linvel": launched.linvel.tolist()},
            "met": float(aimed.met.time),
            "target": list(config.target),
            "over_net": aimed.stroke.over_net,
        },
    )
