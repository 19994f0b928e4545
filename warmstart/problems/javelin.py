"""Javelin: a throw from a stand with a prescribed speed, angle and height at the release.

The SMPL athlete has no fingers: the javelin (0.8 kg, 2.7 m) is rigid on its right palm, nose along
the wrist's -x as in the task's hold, until the hand opens within ``OPENING`` at the release; after
that the athlete moves without it. At the release it points where it flies and does not turn. Both
feet stay where they stand.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from sports.humanoid.body import Body, load_body
from sports.humanoid.hold import JAVELIN_RADIUS
from sports.javelin import END
from warmstart.contact import Ball
from warmstart.phases import Phase
from warmstart.problems import clearance, jumper, striker
from warmstart.separation import axis_balls
from warmstart.solution import Solution
from warmstart.transcription import Transcription

LINK = "R_Wrist"
GRIP = (-0.007, -0.06, -0.045)
"""The javelin's centre of mass on that link (m), as in ``sports/humanoid/data/equipment.csv``."""
MASS = 0.8
"""kg"""
NOSE = (-1.0, 0.0, 0.0)
ENDS = tuple(
    Ball(LINK, (GRIP[0] + side * END, GRIP[1], GRIP[2]), JAVELIN_RADIUS) for side in (-1.0, 1.0)
)
OPENING = 0.002
"""Time in which the hand opens (s)."""
FEET = {"L": "flat", "R": "flat"}
DRAW, SWING, FOLLOW = (0.20, 0.45), (0.16, 0.35), (0.30, 0.50)
"""Durations (s): the slow first part, with long steps; until the release; and after it."""
DURATIONS = (0.45, 0.25, OPENING, 0.30)
"""Of the phases in a first guess (s)."""
CLOSING = 4.0
"""How many times shorter the last step before the release is: the wrist works fast there."""
TILT = math.radians(35.0)
"""How far the held javelin may point from where it will fly."""
SHEAR = 4000.0
"""Weight of horizontal force on the feet: a throw pushes harder than a stroke."""
CORNERS = 0.03
"""How far the corners of the left hand stick out of its ball (m)."""
STRAIGHT = 170.0
"""How much the javelin may be accelerated across its way at the release (m/s^2)."""
STANCE = ((0.15, 0.6), (0.4, 0.9))
"""How far the left foot stands to the left of and ahead of the right one (m)."""
FRICTION = {"friction_x": 0.4, "friction_y": 0.3}
"""Shares of its load that a sole point may push with along the ground."""
BOTH = 0.1
"""Share of body weight that each foot carries at least."""
SPREAD = 0.02
"""Cost at one knot of the squared load of a sole point over body weight."""
EASY = 0.8
"""Share of its torque limit that the wrist may use: it needs more between two knots."""
DROP = 225.0
"""How much the force that the javelin needs may change while the hand opens (N)."""
JERK = 6.0
"""How much the moment that it needs at the wrist may change while the hand opens (N m)."""
SPIN = 1.0
"""How fast the javelin may turn at the release (rad/s, each axis)."""


@dataclass(frozen=True)
class Config(striker.Config):
    """Options of the javelin problem."""

    release_speed: float = 12.0
    """Speed of the javelin at the release (m/s)."""
    angle: float = 36.0
    """Of its velocity above the horizontal (degrees)."""
    height: float = 1.75
    """Of its centre of mass above the ground (m)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 4.0 <= self.release_speed <= 34.0:
            raise ValueError(
                f"release_speed must lie between 4 and 34 m/s, not {self.release_speed}: world "
                "class is 33 m/s"
            )
        if not 0.0 <= self.angle <= 60.0:
            raise ValueError(f"angle must lie between 0 and 60 degrees, not {self.angle}")
        if not 1.3 <= self.height <= 2.2:
            raise ValueError(f"height must lie between 1.3 and 2.2 m, not {self.height}")


def make_event(config: Config) -> striker.Event:
    """What the hand must do at the release."""
    a = math.radians(config.angle)
    forward = (math.cos(a), 0.0, math.sin(a))
    return striker.Event(
        LINK,
        GRIP,
        NOSE,
        (0.0, 0.0, config.height),
        (config.release_speed * forward[0], 0.0, config.release_speed * forward[2]),
        forward,
        fixed=(2,),
        spin=SPIN,
        straight=STRAIGHT,
    )


def transcribe(
    config: Config, body: Body, bare: Body, event: striker.Event, elastic: bool = False
) -> Transcription:
    """The nonlinear program."""
    knots = jumper.scaled(config.detail)
    phases = [
        Phase("draw", knots(14), DRAW, FEET),
        Phase("swing", knots(26), SWING, FEET, closing=CLOSING),
        Phase("release", 1, (OPENING, OPENING), FEET, abrupt=True),
        Phase("follow", knots(18), FOLLOW, FEET, grading=CLOSING, loaded=False),
    ]
    program = striker.transcribe(
        body,
        event,
        phases,
        config,
        free=FREE,
        position=POSITION,
        rate=RATE,
        held_limits=HELD_LIMITS,
        unloaded=bare,
        shear=SHEAR,
        bounds=FRICTION,
        feet=STANCE,
        elastic=elastic,
    )
    held = np.array([k for k in range(program.K) if program.model_at(k) is program.model])
    program.ground(ENDS, held, margin=0.05)
    hand, thighs = axis_balls(body, "L_Hand")[-1], axis_balls(body, "L_Hip", 3)
    fist = replace(hand, radius=hand.radius + CORNERS)
    arm = [*axis_balls(body, "L_Elbow"), *axis_balls(body, "L_Wrist"), fist]
    clearance.beside_shaft(program, event, arm, JAVELIN_RADIUS, held)
    clearance.shaft_off(program, body, event, JAVELIN_RADIUS, held)
    striker.both_feet(program, BOTH, SPREAD / config.detail)
    opens(program)
    link, forward = program.model.tree.link(LINK), list(event.normal)

    def point(q, p):
        nose = program.model.motion(q).R_WL[link] @ ca.DM(list(NOSE))
        return [("nose", ca.dot(nose, ca.DM(forward)), math.cos(TILT), np.inf)]

    program.rows("nose", held, point)
    clearance.keep_off(program, [(fist, b) for b in thighs], np.arange(program.K))
    if not elastic:
        for axis in "xyz":
            i = program.model.free.index(f"{LINK}_{axis}")
            most = EASY * program.effort[i] / program.bounds.torque_share
            program.bound(program.u[:, i], -most, most)
    for name, (low, high) in READY.items():
        program.bound(program.q[0, program.model.index(name)], low, high)
    for name in ("pitch", "roll"):
        program.bound(program.q[-1, program.model.index(name)], -0.2, 0.35)
    return program


def opens(program: Transcription) -> None:
    """What the javelin asks of the wrist hardly changes while the hand opens: mass and acceleration
    change together there, so that between the two knots the torque is no straight line."""
    model, link, middle = program.model, program.model.tree.link(LINK), ca.DM(list(GRIP))
    turning = ca.DM([0.0, MASS * END**2 / 3.0, MASS * END**2 / 3.0])

    def needs(state):
        motion = model.motion(*state)
        w, alpha = motion.w[link], motion.alpha[link]
        own = motion.acc[link] + ca.cross(alpha, middle) + ca.cross(w, ca.cross(w, middle))
        return MASS * own, MASS * ca.cross(middle, own) + turning * alpha

    def build(*x):
        (force, moment), (later, twist) = needs(x[:3]), needs(x[3:6])
        drop = ca.sumsqr(later - force) / DROP**2
        return 0.0, [
            ("opening, force", drop, -np.inf, 1.0),
            ("opening, moment", (twist - moment) / 20.0, -JERK / 20.0, JERK / 20.0),
        ]

    ends = program.knots("release")
    states = [x[[k]] for k in ends for x in (program.q, program.v, program.a)]
    program.program.block("opening", states, build)


FREE = (*striker.FREE, *striker.GIRDLE)
HELD_LIMITS = (
    *("L_Thorax_x", "L_Thorax_y", "L_Thorax_z", "L_Elbow_x", "Neck_x", "Neck_y", "Head_y"),
    "R_Elbow_x",
    *striker.HELD_LIMITS[7:],
)
POSITION = {
    "yaw": (-1.6, 0.8),
    "Knee_y": (0.1, 1.6),
    **striker.GIRDLE_POSITION,
    "R_Shoulder_x": (-1.4, 0.8),
    "R_Shoulder_y": (-1.4, 1.4),
    "R_Shoulder_z": (-1.2, 1.9),
    "R_Elbow_y": (-1.5, 1.5),
    "R_Wrist_x": (-1.0, 1.0),
    "R_Wrist_y": (-1.7, 1.7),
    "R_Wrist_z": (-1.2, 1.2),
}
"""Pose boxes (rad) that differ from those of a stroke: the throwing arm works overhead."""
RATE = {"pitch": (-6.0, 6.0)}
"""Rate boxes of the root (rad/s) that differ from those of a stroke."""
READY = {"yaw": (-1.4, 0.0), "L_Shoulder_x": (-1.45, 0.2)}


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort throw. See :meth:`warmstart.problems.Problem.solve`."""
    body = load_body("smpl", strength=config.strength, equipment=["javelin"])
    bare = load_body("smpl", strength=config.strength)
    event = make_event(config)
    return striker.solve(
        "javelin",
        {"release_speed": config.release_speed},
        event,
        lambda elastic: transcribe(config, body, bare, event, elastic),
        lambda program: striker.key_guess(program, "javelin", DURATIONS),
        guess,
        config,
        progress,
        f"a throw of {config.release_speed:g} m/s at {config.angle:g} degrees",
        thrown=("javelin", OPENING),
    )
