"""Penalty kick: the ball into the goal, at a given speed to a target.

From a stand: the athlete is at rest with the left foot beside the ball and the right one behind,
lifts the right foot slowly off the ground, swings it back and kicks; the left foot stays where it
stands. Or after one step (``approach``): the left foot starts behind and lands beside the ball
(:mod:`warmstart.problems.kick_step`); such a kick is replayed with feedback.

The front of the toes meets the ball: a ball without friction leaves along the face that hits it, so
the face points where the ball shall go and the foot moves along it. The speed of the foot follows
from that of the ball by Newton's restitution with the foot's effective mass
(:mod:`warmstart.kick`). The plan does not know the blow of the ball, which comes after the event
and is felt in the replays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from sports.humanoid.body import Body, load_body
from sports.penalty_kick import SPOT, TARGET_HIGH, TARGET_LOW
from sports.soccer import BALL_RADIUS
from warmstart import kick
from warmstart.phases import Phase
from warmstart.problems import jumper, kick_step, striker
from warmstart.separation import axis_balls, keep_apart
from warmstart.solution import Solution
from warmstart.transcription import Transcription

FREE = (
    *(f"{side}_{joint}" for side in "LR" for joint in jumper.LEGS),
    *("Torso_x", "Torso_y", "Torso_z", "Spine_z", "Chest_y", "Chest_z"),
    *(f"{side}_Shoulder_{axis}" for side in "LR" for axis in "xz"),
)
"""24 hinges: with the root 30 degrees of freedom."""
POSE = {"L_Elbow_z": -0.8, "R_Elbow_z": 0.8}
"""Held joints (rad); all joints not named in FREE or here are held at 0."""
POSITION = {
    "x": (-0.2, 1.2),
    "y": (-0.4, 0.4),
    "z": (0.84, 1.02),
    "pitch": (-0.5, 0.6),
    "yaw": (-0.9, 0.9),
    "Hip_y": (-1.6, 0.8),
    "Knee_y": (0.05, 2.0),
    "Ankle_y": (-0.8, 0.8),
    "L_Shoulder_x": (-1.45, 0.2),
    "R_Shoulder_x": (-0.2, 1.45),
    "L_Shoulder_z": (-1.5, 1.2),
    "R_Shoulder_z": (-1.2, 1.5),
}
"""Pose boxes (rad) that differ from those of a stroke."""
RATE = {"x": (-1.0, 4.0), "yaw": (-6.0, 6.0)}
"""Rate boxes of the root (m/s, rad/s) that differ from those of a stroke."""
COMFORT = striker.COMFORT | {"R_Shoulder_x": 1.1, "R_Shoulder_z": 0.5}
"""Both arms are idle (rad)."""
LEFT = {"L": "flat"}
LEAN, SWING, FOLLOW = (0.25, 0.60), (0.30, 0.55), (0.25, 0.60)
"""Durations (s): on both feet, with the right foot in the air until the impact, and after it."""
DURATIONS = (0.60, 0.55, 0.25)
"""Of the phases in a first guess (s)."""
SLOW = 0.5
"""Largest rate of a hinge while the right foot stands (rad/s): what moves the body fast lets a sole
that is at rest at knots slide between them."""
QUIET = 15.0
"""Largest acceleration of a hinge then (rad/s^2)."""
BEHIND = 0.62
"""How far the middle of the feet stands behind the ball (m)."""
BESIDE = 0.14
"""How far to the left (m)."""
FEET = (0.15, 0.30), (0.15, 0.40)
"""How far the left foot stands to the left of and ahead of the right one at the ball (m)."""
ORIGIN = (SPOT[0] - BEHIND, SPOT[1] + BESIDE)
"""Where the middle of the feet stands at the ball, in the task's world (m)."""
SHEAR = 600.0
"""Weight of horizontal force on the feet: those of a split stance would push apart."""
EVEN = 0.2
"""Price of the squared load of a point of a sole, over body weight, at one knot."""
SWEEP = 0.05
"""How high over the ground the kicking foot passes (m), but for its rise and the impact: a replay
whose foot scuffs the ground loses its speed."""
LOW = 0.018
"""How high it is at the impact (m)."""
ROOM = 0.05
"""How far the standing foot keeps off the ball (m)."""


@dataclass(frozen=True)
class Config(striker.Config):
    """Options of the penalty kick."""

    ball_speed: float = 15.0
    """Speed of the ball right after the impact (m/s)."""
    target: tuple[float, float] = (0.8, 0.8)
    """Where the ball is to pass the goal plane, y and z (m)."""
    approach: float = 0.0
    """Length of a step of the left foot to the ball (m); 0 for a kick from a stand."""
    from_start: bool = False
    """Begin as the task does, two steps from the ball; ``approach`` is then left at 0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 12.0 <= self.ball_speed <= 35.0:
            raise ValueError(
                f"ball_speed must lie between 12 and 35 m/s, not {self.ball_speed}: a slower ball "
                "does not fly to the goal"
            )
        for name, value, low, high in zip(
            "yz", self.target, TARGET_LOW[1:], TARGET_HIGH[1:], strict=True
        ):
            if not low <= value <= high:
                raise ValueError(
                    f"target {name} must lie between {low:g} and {high:g} m, not {value}"
                )
        kick.direction(self.ball_speed, self.target)
        if self.approach and not kick_step.SHORTEST <= self.approach <= kick_step.LONGEST:
            raise ValueError(
                f"approach must be 0, or a step of {kick_step.SHORTEST:g} to "
                f"{kick_step.LONGEST:g} m, not {self.approach}"
            )
        if self.approach and self.from_start:
            raise ValueError("from_start has its own two steps: leave approach at 0")

    @property
    def steps(self) -> bool:
        """Whether it is a kick after a step, which is replayed with feedback."""
        return self.from_start or self.approach > 0.0


def make_event(config: Config, body: Body) -> striker.Event:
    """What the foot must do at the impact, in the frame of the athlete."""
    n = kick.direction(config.ball_speed, config.target)
    center = np.array([BEHIND, -BESIDE, BALL_RADIUS])
    place, velocity = center - BALL_RADIUS * n, kick.foot_speed(config.ball_speed) * n
    return striker.Event(
        kick.LINK,
        kick.face(body),
        kick.AXIS,
        (float(place[0]), float(place[1]), float(place[2])),
        (float(velocity[0]), float(velocity[1]), float(velocity[2])),
        (float(n[0]), float(n[1]), float(n[2])),
    )


def transcribe(
    config: Config, body: Body, event: striker.Event, elastic: bool = False
) -> Transcription:
    """The nonlinear program."""
    knots = jumper.scaled(config.detail)
    steps = config.steps
    stand = [Phase("lean", knots(28), LEAN, LEFT | {"R": "flat"})]
    phases = [
        *(kick_step.phases(knots, config.from_start) if steps else stand),
        Phase("swing", knots(30), SWING, LEFT),
        Phase("follow", knots(10), FOLLOW, LEFT),
    ]
    position = POSITION | (kick_step.POSITION if steps else {})
    if config.from_start:
        position["Knee_y"] = (0.0, 2.0)
    program = striker.transcribe(
        body,
        event,
        phases,
        config,
        free=FREE,
        pose={} if config.from_start else POSE,
        position=position,
        rate=RATE,
        comfort=COMFORT,
        held_limits=jumper.HELD_LIMITS,
        feet=None,
        shear=SHEAR,
        elastic=elastic,
    )
    stands = kick_step.rows(program, body) if steps else 0
    if config.from_start:
        kick_step.as_the_task(program, body, ORIGIN)
    elif steps:
        kick_step.of_length(program, config.approach)
    striker.stance(program, body, *FEET, knot=stands)
    keep_apart(program, body, np.arange(program.K))
    air = np.concatenate([program.knots("swing")[1:], program.knots("follow")[1:]])
    swing, sole = program.knots("swing"), jumper.foot(body, "R")
    high = swing[len(swing) // 4 : -2]
    program.ground(sole, np.setdiff1d(air, [*high, *swing[-2:]]))
    program.ground(sole, high, margin=SWEEP)
    program.ground(sole, swing[-2:], margin=LOW)
    _evenly(program)
    _off_the_ball(program, body, [*program.knots("step")[-6:]] if steps else [0])
    if not steps:
        program.bound(program.v[program.knots("lean"), 6:], -SLOW, SLOW)
        program.bound(program.a[program.knots("lean"), 6:], -QUIET, QUIET)
    for side in "LR":  # at rest at all knots, it must not accelerate to and fro between them
        program.fix(program.a[0, program.model.index(f"{side}_Toe_y")], 0.0)
    return program


def _evenly(program: Transcription) -> None:
    """By a small price, soles are loaded evenly: on its edge a foot tips over in a replay."""
    for side, forces in program.f.items():
        up = np.array([index[:, 2] for index in forces.values()])
        program.program.block(
            f"load {side}", [up], lambda f, p: (EVEN * ca.sumsqr(f / program.weight), [])
        )


def _off_the_ball(program: Transcription, body: Body, knots: Sequence[int]) -> None:
    """The left leg keeps off the ball."""
    model = program.model
    balls = [b for link in ("Knee", "Ankle", "Toe") for b in axis_balls(body, f"L_{link}")]

    def off(q, p):
        motion = model.motion(q)
        center = p[:3] + BALL_RADIUS * p[6:9]
        gaps = [
            ca.sumsqr(motion.point(model.tree.link(b.link), b.center) - center)
            - (b.radius + BALL_RADIUS + ROOM) ** 2
            for b in balls
        ]
        return [("off the ball", ca.vertcat(*gaps) / 0.05, 0.0, np.inf)]

    program.rows("off the ball", knots, off)


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort kick. See :meth:`warmstart.problems.Problem.solve`."""
    body = load_body("smpl", strength=config.strength)
    event = make_event(config, body)
    asked, keys, durations = {"ball_speed": config.ball_speed}, "penalty_kick", DURATIONS
    what = (
        f"a kick of {config.ball_speed:g} m/s (foot {kick.foot_speed(config.ball_speed):.1f} m/s)"
    )
    if config.approach:
        asked["approach"] = config.approach
        keys, durations = "penalty_kick_step", (*kick_step.DURATIONS, *DURATIONS[1:])
        what += f" after a step of {config.approach:g} m"
    elif config.from_start:
        durations = (*kick_step.START_DURATIONS, *kick_step.DURATIONS, *DURATIONS[1:])
        keys = "penalty_kick_from_start"
        asked["steps"] = 2
        what += " after two steps"
    return striker.solve(
        "penalty_kick",
        asked,
        event,
        lambda elastic: transcribe(config, body, event, elastic),
        lambda program: striker.key_guess(program, keys, durations),
        guess,
        config,
        progress,
        what,
        (*ORIGIN, 0.0),
        target=list(config.target),
        feedback=config.steps,
    )
