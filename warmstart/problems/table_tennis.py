"""Table tennis: return a machine's ball to a spot on the table, forehand or backhand.

See :mod:`warmstart.problems.racket` for how. Paddle, hands and forearms stay above the table or
before its end, the legs before it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from sports import table_tennis
from sports.humanoid.body import Body
from sports.scene import Scene
from warmstart.contact import Ball
from warmstart.problems import clearance, racket
from warmstart.separation import axis_balls
from warmstart.solution import Solution
from warmstart.transcription import Transcription

GAME = table_tennis.GAME
ROOM = 0.06
"""How far (m) everything keeps from the table."""
PADDLE = (Ball("R_Wrist", (0.0, -table_tennis.PADDLE_REACH, 0.0), table_tennis.PADDLE_RADIUS),)
"""A ball around the blade; the handle lies in the hand."""
READY = {
    "yaw": (-0.5, 0.5),
    "R_Shoulder_x": (0.6, 1.4),
    "R_Elbow_z": (0.6, 2.0),
    "L_Shoulder_x": (-1.45, -0.7),
}


def scene(body: Body) -> Scene:
    """The task's scene."""
    return table_tennis.scene(table_tennis.TableTennis(), body)


SPORT = racket.Sport(
    name="table_tennis",
    game=GAME,
    equipment="paddle",
    scene=scene,
    half_thickness=table_tennis.PADDLE_THICKNESS / 2,
    tool=PADDLE,
    meet_x=1.7,  # a third of a metre behind the table
    heights=(0.95, 1.45),
    before={"forehand": (0.35, -0.50), "backhand": (0.45, 0.0)},
    ready={"forehand": READY, "backhand": READY},
    position={"backhand": {"R_Elbow_y": (-1.2, 1.2)}},
)


@dataclass(frozen=True)
class Config(racket.Config):
    """Options of the table-tennis problem."""

    ball_speed: float = 7.0
    """Speed of the ball right after the impact (m/s)."""
    target: tuple[float, float] = (-0.8, 0.3)
    """Where the ball is to land on the far half of the table, x and y (m)."""
    machine_speed: float = 4.0
    """Forward speed of the machine's ball at its launch (m/s)."""
    bounce: tuple[float, float] = (0.9, 0.0)
    """Where the machine's ball bounces, x and y (m)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check(GAME, (4.0, 20.0), (3.0, 6.0))


def off_the_table(program: Transcription, aimed: racket.Aim) -> None:
    """Adds the rows: paddle and arms above the table, all else before its end."""
    model, body = program.model, program.body
    end = aimed.where[0] - table_tennis.HALF_LENGTH - ROOM
    """Of the table, as far ahead of the athlete (m)."""
    above = [*PADDLE, axis_balls(body, "R_Hand")[-1], axis_balls(body, "R_Elbow")[-1]]
    before = [axis_balls(body, "L_Hand")[-1], axis_balls(body, "L_Elbow")[-1]]
    before += [axis_balls(body, f"{s}_Knee")[0] for s in "LR"]

    def clear(q, p):
        motion = model.motion(q)

        def at(ball: Ball):
            return motion.point(model.tree.link(ball.link), ball.center)

        over = [at(b)[2] - b.radius - table_tennis.HEIGHT - ROOM for b in above]
        short = [end - at(b)[0] - b.radius for b in before]
        return [("off the table", ca.vertcat(*over, *short) / 0.1, 0.0, np.inf)]

    everywhere = np.arange(program.K)
    program.rows("table", everywhere, clear)
    hips = [replace(b, radius=b.radius + clearance.CORNERS) for b in axis_balls(body, "Pelvis")]
    arm = axis_balls(body, "L_Elbow", 3)[1:]  # it hangs, kept back by the table
    clearance.keep_off(program, [(a, b) for a in arm for b in hips], everywhere)


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort stroke. See :meth:`warmstart.problems.Problem.solve`."""
    return racket.solve(SPORT, config, guess, progress, off_the_table)
