"""Set shot: a ball put on a path into the basket with one hand, by the athlete without fingers.

The SMPL athlete cannot play the task ``free_throw``: the ball (0.6 kg) is rigid on its right palm
until the hand opens within ``OPENING`` at the release. A palm can push a ball but not pull it:
until the release the force on the ball lies in the friction cone about the palm's normal, from rest
on. At the release the palm faces where the ball flies. The velocity there is the shot v* of
``sports/hoop.py`` with the apex that is asked for. Both feet stay where they stand, behind the
line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from sports.free_throw import LINE_X, RIM
from sports.hoop import APEX
from sports.humanoid.body import Body, load_body
from sports.humanoid.hold import BASKETBALL
from sports.physics.base import GRAVITY
from warmstart import thrown
from warmstart.contact import Ball
from warmstart.phases import Phase
from warmstart.problems import clearance, jumper, striker
from warmstart.separation import axis_balls
from warmstart.solution import Solution
from warmstart.transcription import Transcription

LINK = "R_Wrist"
GRIP = (-0.015, -0.125, -0.145)
"""The ball's centre on that link (m), as in ``sports/humanoid/data/equipment.csv``."""
PALM = (0.0, 0.0, -1.0)
"""From the palm to the ball."""
SIZE, MASS = BASKETBALL.shapes[0].size[0], BASKETBALL.shapes[0].mass
FRICTION = 0.7
"""Of the ball on the palm; the scenes have 1."""
LEAST = 0.2
"""Least push of the palm on the ball, in weights of the ball."""
OPENING = 0.002
"""Time in which the hand opens (s)."""
FEET = {"L": "flat", "R": "flat"}
SWING, FOLLOW = (0.35, 0.90), (0.30, 0.50)
"""Durations (s) until the release, and after it."""
DURATIONS = (0.60, OPENING, 0.35)
"""Of the phases in a first guess (s)."""
PLACE = (0.30, -0.15)
"""Where the ball is released, ahead of and beside the spot (m)."""
SHEAR = 300.0
"""Weight of horizontal force on the feet."""
STRAIGHT = 60.0
"""How much the ball may be accelerated across its way at the release (m/s^2)."""
GUIDED, GUIDE = 20, 0.26
"""Intervals of the swing, of 32, in which the left hand is at the ball, and how near (m)."""
NEAREST, WIDEST = 0.15, 0.25**2
"""How far ahead of the spot the held ball is at least (m), and how far beside it at most (m^2)."""
SPIN = 12.0
"""How fast the hand may turn at the release (rad/s, each axis): two turns a second of backspin."""


@dataclass(frozen=True)
class Config(striker.Config):
    """Options of the set shot problem."""

    apex: float = APEX
    """Highest point of the ball's path above the rim (m)."""
    height: float = 1.85
    """Of the ball's centre above the ground at the release (m)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.3 <= self.apex <= 3.0:
            raise ValueError(
                f"apex must lie between 0.3 and 3 m above the rim, not {self.apex}: a flatter ball "
                "meets the ring from the side"
            )
        if not 1.6 <= self.height <= 2.0:
            raise ValueError(f"height must lie between 1.6 and 2.0 m, not {self.height}")


def make_event(config: Config) -> striker.Event:
    """What the hand must do at the release."""
    place = (*PLACE, config.height)
    velocity = thrown.shot(np.array(place), np.array(RIM), config.apex)
    x, y, z = (float(v) for v in velocity)
    u, v, w = (float(v) for v in velocity / np.linalg.norm(velocity))
    return striker.Event(
        LINK, GRIP, PALM, place, (x, y, z), (u, v, w), spin=SPIN, straight=STRAIGHT
    )


def transcribe(
    config: Config, body: Body, bare: Body, event: striker.Event, elastic: bool = False
) -> Transcription:
    """The nonlinear program."""
    knots = jumper.scaled(config.detail)
    phases = [
        Phase("swing", knots(32), SWING, FEET),
        Phase("release", 1, (OPENING, OPENING), FEET, abrupt=True),
        Phase("follow", knots(14), FOLLOW, FEET, loaded=False),
    ]
    program = striker.transcribe(
        body,
        event,
        phases,
        config,
        position=POSITION,
        tool=(Ball(LINK, GRIP, SIZE),),
        unloaded=bare,
        shear=SHEAR,
        feet=((0.15, 0.45), (-0.3, 0.05)),
        elastic=elastic,
    )
    held = np.array([k for k in range(program.K) if program.model_at(k) is program.model])
    hips = [replace(b, radius=b.radius + clearance.CORNERS) for b in axis_balls(body, "Pelvis")]
    idle = axis_balls(body, "L_Elbow", 3)
    head = [replace(b, radius=b.radius + clearance.CORNERS) for b in axis_balls(body, "Head")]
    arm = axis_balls(body, f"{LINK[0]}_Elbow", 3)
    pairs = [(a, b) for a in idle for b in hips] + [(a, b) for a in arm for b in head]
    clearance.keep_off(program, pairs, np.arange(program.K))
    pushed(program, held)
    guided(program, body, held, knots(GUIDED))
    return program


def pushed(program: Transcription, knots: np.ndarray) -> None:
    """The palm pushes the ball, inside the friction cone, at knots."""
    model = program.model
    link, normal = model.tree.link(LINK), ca.DM(list(PALM))

    def push(q, v, a, p):
        motion = model.motion(q, v, a)
        c, w = ca.DM(list(GRIP)), motion.w[link]
        # acc has gravity taken off already: this is the force per mass of the ball, link frame.
        force = motion.acc[link] + ca.cross(motion.alpha[link], c) + ca.cross(w, ca.cross(w, c))
        force = force / GRAVITY
        along = ca.dot(force, normal)
        across = ca.sumsqr(force) - along**2
        return 0.0, [
            ("palm pushes", along, LEAST, np.inf),
            ("ball stays on the palm", (FRICTION * along) ** 2 - across, 0.0, np.inf),
        ]

    program.program.block("ball", [program.q[knots], program.v[knots], program.a[knots]], push)


def guided(program: Transcription, body: Body, held: np.ndarray, knots: int) -> None:
    """The ball stays in front of the athlete; at the first ``knots`` the other hand is at it."""
    model = program.model
    link, other = model.tree.link(LINK), model.tree.link("L_Hand")
    palm = axis_balls(body, "L_Hand")[-1].center

    def front(q, p):
        ball = model.motion(q).point(link, GRIP)
        return [
            ("ball in front", ca.vertcat(ball[0] - NEAREST, WIDEST - ball[1] ** 2), 0.0, np.inf)
        ]

    def near(q, p):
        motion = model.motion(q)
        apart = ca.sumsqr(motion.point(other, palm) - motion.point(link, GRIP))
        return [("guiding hand", apart / GUIDE**2, 0.0, 1.0)]

    program.rows("ball in front", held, front)
    program.rows("guiding hand", np.arange(knots), near)


POSITION = {
    "x": (-0.4, LINE_X - 0.05),
    "pitch": (-0.25, 0.25),
    "roll": (-0.25, 0.25),
    "yaw": (-0.4, 0.6),
    "Torso_x": (-0.2, 0.2),
    "Torso_y": (-0.2, 0.2),
    "Torso_z": (-0.3, 0.3),
    "Chest_y": (-0.2, 0.2),
    "Chest_z": (-0.3, 0.3),
    "Knee_y": (0.1, 1.4),
    "R_Shoulder_x": (-1.4, 1.45),
    "R_Shoulder_y": (-1.4, 1.4),
    "R_Shoulder_z": (-0.9, 1.9),
    "R_Elbow_y": (-1.5, 1.5),
    "R_Wrist_x": (-1.1, 1.0),
}
"""Pose boxes (rad) that differ from those of a stroke: the shooting arm works overhead, the hand
is bent back under the ball; the trunk stays upright."""


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort throw. See :meth:`warmstart.problems.Problem.solve`."""
    body = load_body("smpl", strength=config.strength, equipment=["basketball"])
    bare = load_body("smpl", strength=config.strength)
    event = make_event(config)
    return striker.solve(
        "set_shot",
        {"apex": config.apex},
        event,
        lambda elastic: transcribe(config, body, bare, event, elastic),
        lambda program: striker.key_guess(program, "set_shot", DURATIONS),
        guess,
        config,
        progress,
        f"a set shot with its apex {config.apex:g} m above the rim",
        thrown=("basketball", OPENING),
    )
