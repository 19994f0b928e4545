"""The two-handed free throw of the SMPL-X athlete, from the hold in which the task begins.

Both hands keep their pose against each other and the ball between them until the release; the
fingers stay as the hold (``sports/humanoid/hold.py``) has them. The ball is rigid on the right
hand; the left one pushes it with a force of its own, so that each hand's force on the ball is
known: it lies in the friction cone about its palm and presses. At the release the ball flies as
the shot v* of ``sports/hoop.py`` with the apex that is asked for; then the hands stay off it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from sports.free_throw import LINE_X, LOWEST, RIM
from sports.hoop import APEX
from sports.humanoid.body import Body, load_body
from sports.humanoid.hold import BASKETBALL, Hold, load_hold
from sports.physics.base import GRAVITY
from warmstart import rotation, thrown
from warmstart.contact import Ball
from warmstart.outcome import link_poses
from warmstart.phases import Grip, Phase
from warmstart.problems import clearance, jumper, striker
from warmstart.rigid_body import center_of_mass
from warmstart.separation import axis_balls
from warmstart.solution import Solution
from warmstart.transcription import Transcription

SIZE, MASS = BASKETBALL.shapes[0].size[0], BASKETBALL.shapes[0].mass
EQUIPMENT = "basketball_two_hands"
FRICTION = 0.65
"""Of the ball on the hands; the scene has 1."""
SPIN = 16.0
"""How fast the hands may turn at the release (rad/s, each axis)."""
PRESS = (8.0, 40.0)
"""Least and largest force of a palm on the ball along its normal (N)."""
LETTING_GO = 3
"""Knots before the release in which the palms may press less."""
OPENING = 0.002
"""Time in which the hands open (s)."""
FEET = {"L": "flat", "R": "flat"}
SWING, FOLLOW = (0.4, 0.90), (0.30, 0.70)
"""Durations (s) until the release, and after it."""
DURATIONS = (0.75, OPENING, 0.30)
"""Of the phases in a first guess (s)."""
PLACE = (0.40, 0.0, 1.65)
"""Where the ball is released, more or less (m)."""
AROUND = ((0.2, 0.6), (-0.02, 0.02), (1.5, 1.95))
"""Where the release may be: ahead of the spot, beside it, above the ground (m)."""
STRAIGHT = 60.0
"""How much the ball may be accelerated across its way at the release (m/s^2)."""
SHEAR = 300.0
"""Weight of horizontal force on the feet."""
ARMS = ("Shoulder_x", "Shoulder_y", "Shoulder_z", "Elbow_y", "Elbow_z")
WRIST = ("Wrist_x", "Wrist_y", "Wrist_z")
FREE = (
    *(f"{side}_{joint}" for side in "LR" for joint in jumper.LEGS),
    *("Torso_x", "Torso_y", "Torso_z", "Chest_y"),
    *(f"{side}_{joint}" for side in "LR" for joint in (*ARMS, *WRIST)),
)
"""34 hinges."""
HELD_LIMITS = (
    *(f"{side}_Thorax_{axis}" for side in "LR" for axis in "xyz"),
    *(f"{side}_{dof}" for side in "LR" for dof in ("Elbow_x", "Knee_x", "Knee_z", "Ankle_z")),
    *("Neck_x", "Neck_y", "Head_y"),
)
"""Held joints whose holding torque is bounded."""
POSITION = {
    "x": (-0.3, LINE_X - 0.05),
    "pitch": (-0.1, 0.15),
    "roll": (-0.05, 0.05),
    "yaw": (-0.05, 0.05),
    "Torso_x": (-0.05, 0.05),
    "Torso_y": (-0.1, 0.15),
    "Torso_z": (-0.05, 0.05),
    "Chest_y": (-0.1, 0.15),
    "Knee_y": (0.0, 1.4),
    "L_Shoulder_x": (-1.6, 1.2),
    "R_Shoulder_x": (-1.2, 1.6),
    "Shoulder_y": (-1.5, 1.5),
    "L_Shoulder_z": (-2.2, 0.3),
    "R_Shoulder_z": (-0.3, 2.2),
    "Elbow_y": (-1.2, 1.2),
    "L_Elbow_z": (-2.5, -0.05),
    "R_Elbow_z": (0.05, 2.5),
    "Wrist_x": (-1.2, 1.2),
    "Wrist_y": (-1.2, 1.2),
    "Wrist_z": (-1.3, 1.3),
}
"""Pose boxes (rad) that differ from those of a stroke."""
START = 0.03
"""How far the legs may be off the hold at the start (rad): its soles are a hair uneven."""
STANDING = ("x", "y", "pitch", "roll", "yaw", "Torso_x", "Torso_y", "Torso_z", "Chest_y")
BALANCE = ((-0.06, 0.02), (-0.03, 0.03))
"""Where the centre of mass is in the end, ahead of and beside the spot (m); the ankles are 0.07 m
behind it."""
STILL = 0.08
"""How fast it still is then (m/s)."""
TIPS = ("Thumb3", "Index3", "Middle3", "Ring3", "Pinky3")
ROOM = 0.02
"""How far (m) hands that were at the ball keep off it once they have opened."""
SPREAD = 6
"""Knots after the release over which they come to that."""


@dataclass(frozen=True)
class Config(striker.Config):
    """Options of the free throw problem."""

    apex: float = APEX
    """Highest point of the ball's path above the rim (m)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.3 <= self.apex <= 3.0:
            raise ValueError(
                f"apex must lie between 0.3 and 3 m above the rim, not {self.apex}: a flatter ball "
                "meets the ring from the side"
            )


@dataclass(frozen=True)
class Palms:
    """How the hold has the ball in its hands."""

    grip: Grip
    push: tuple[float, float, float]
    """Where both palms together push, in the frame of the right wrist (unit)."""
    normals: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Of the palms at the ball, left and right, in the frames of their wrists (unit)."""
    points: tuple[Ball, ...]
    """Fingertips and palms, as balls on their wrists."""


def hold_qpos(body: Body, hold: Hold) -> np.ndarray:
    """(7 + n,) the athlete as the hold has it."""
    qpos = np.zeros(7 + body.num_dofs)
    qpos[2:4] = hold.root_height, 1.0
    for name, angle in hold.angles.items():
        qpos[7 + body.dof_index(name)] = angle
    return qpos


@cache
def palms() -> Palms:
    """The hands of the packaged hold, by forward kinematics."""
    body, hold = load_body("smplx"), load_hold("basketball")
    pos, quat = link_poses(body, hold_qpos(body, hold)[None])
    ball = np.array(hold.pos)

    def local(link: str, vector: np.ndarray) -> tuple[float, float, float]:
        own = rotation.rotate(rotation.conjugate(quat[0, body.link_index(link)]), vector)
        return (float(own[0]), float(own[1]), float(own[2]))

    def place(link: str) -> np.ndarray:
        return pos[0, body.link_index(link)]

    facing, points = [], []
    for side in "LR":
        wrist = body.link_index(f"{side}_Wrist")
        facing.append(rotation.rotate(quat[0, wrist], np.array([0.0, 0.0, -1.0])))
        under = ball - SIZE * facing[-1]
        points.append(
            Ball(f"{side}_Wrist", local(f"{side}_Wrist", under - place(f"{side}_Wrist")), 0.0)
        )
        for tip in TIPS:
            index = body.link_index(f"{side}_{tip}")
            (shape,) = body.links[index].shapes
            end = pos[0, index] + rotation.rotate(quat[0, index], np.array(shape.end))
            own = local(f"{side}_Wrist", end - place(f"{side}_Wrist"))
            points.append(Ball(f"{side}_Wrist", own, float(shape.size[0])))
    push = np.sum(facing, axis=0) * (1.0, 0.0, 1.0)
    centers = [local(f"{s}_Wrist", ball - place(f"{s}_Wrist")) for s in "LR"]
    right, left = (quat[0, body.link_index(f"{s}_Wrist")] for s in "RL")
    turned = rotation.multiply(rotation.conjugate(right), left)
    matrix = np.stack([rotation.rotate(turned, axis) for axis in np.eye(3)], axis=1)
    rows = tuple((float(r[0]), float(r[1]), float(r[2])) for r in matrix)
    return Palms(
        Grip("R_Wrist", centers[1], "L_Wrist", centers[0], rows),
        local("R_Wrist", push / np.linalg.norm(push)),
        ((0.0, 0.0, -1.0), (0.0, 0.0, -1.0)),
        tuple(points),
    )


def make_event(config: Config) -> striker.Event:
    """What the hands must do at the release; where that is, is the optimiser's."""
    held, velocity = palms(), thrown.shot(np.array(PLACE), np.array(RIM), config.apex)
    x, y, z = (float(v) for v in velocity)
    u, v, w = (float(v) for v in velocity / np.linalg.norm(velocity))
    return striker.Event(
        held.grip.first,
        held.grip.point,
        held.push,
        PLACE,
        (x, y, z),
        (u, v, w),
        fixed=(),
        facing=False,
        spin=SPIN,
        straight=STRAIGHT,
    )


def shot(place, apex: float):
    """3x1 ``SX``: the velocity of :func:`warmstart.thrown.shot`."""
    up = ca.sqrt(2 * GRAVITY * (RIM[2] + apex - place[2]))
    time = up / GRAVITY + math.sqrt(2 * apex / GRAVITY)
    return ca.vertcat((RIM[0] - place[0]) / time, (RIM[1] - place[1]) / time, up)


def transcribe(
    config: Config, body: Body, bare: Body, event: striker.Event, elastic: bool = False
) -> Transcription:
    """The nonlinear program."""
    knots = jumper.scaled(config.detail)
    phases = [
        Phase("swing", knots(36), SWING, FEET),
        Phase("release", 1, (OPENING, OPENING), FEET, abrupt=True),
        Phase("follow", knots(16), FOLLOW, FEET, loaded=False, grading=2.0),
    ]
    hold = load_hold("basketball")
    program = striker.transcribe(
        body,
        event,
        phases,
        config,
        free=FREE,
        pose=hold.angles,
        position=POSITION,
        held_limits=HELD_LIMITS,
        unloaded=bare,
        shear=SHEAR,
        feet=None,
        comfort={"pitch": 0.0, "Torso_y": 0.0, "Chest_y": 0.0},
        grip=palms().grip,
        aim=lambda place: shot(place, config.apex),
        elastic=elastic,
    )
    model = program.model
    first = model.tree.link(palms().grip.first)
    low, high = np.array(AROUND).T

    def around(q, p):
        return [("release", model.motion(q).point(first, palms().grip.point), low, high)]

    program.rows("release", program.knots("swing")[-1:], around)

    def balanced(q, v, p):
        place, velocity = center_of_mass(model.tree, model.motion(q, v))
        return [
            ("mass over the feet", place[:2] / 0.1, *(np.array(x) / 0.1 for x in zip(*BALANCE))),
            ("mass at rest", velocity, -STILL, STILL),
        ]

    program.rows("balance", [program.K - 1], balanced, rates=True)
    for name in STANDING:
        program.fix(program.q[0, model.index(name)], 0.0)
    for name in model.free:
        angle = hold.angles.get(name, 0.0)
        slack = START if name.endswith(jumper.LEGS) else 0.0
        program.bound(program.q[0, model.index(name)], angle - slack, angle + slack)
    held = program.held
    ball = Ball(palms().grip.first, palms().grip.point, SIZE)
    program.ground([ball], held, margin=LOWEST + 0.03 - SIZE)
    trunk = [axis_balls(body, link)[-1] for link in clearance.TRUNK]
    clearance.keep_off(program, [(ball, b) for b in trunk], held, clearance.TOOL_ROOM)
    pressed(program)
    let_go(program, config.apex)
    return program


def pressed(program: Transcription) -> None:
    """Each hand's force on the ball lies in the friction cone about its palm, and presses."""
    model, grip = program.model, palms().grip
    first, second = (model.tree.link(b) for b in (grip.first, grip.second))
    least = np.full((len(program.held), 1), PRESS[0])
    least[-LETTING_GO:] = 0.0

    def build(q, v, a, press, p):
        motion = model.motion(q, v, a)
        c, w = ca.DM(list(grip.point)), motion.w[first]
        # acc has gravity taken off already: this is the force on the ball, world frame.
        force = motion.acc[first] + ca.cross(motion.alpha[first], c) + ca.cross(w, ca.cross(w, c))
        total = MASS * motion.R_WL[first] @ force
        rows = []
        for side, link, own, share in zip(
            "RL", (first, second), palms().normals[::-1], (total - press, press)
        ):
            along = ca.dot(share, motion.R_WL[link] @ ca.DM(list(own)))
            across = ca.sumsqr(share) - along**2
            rows += [
                (f"palm {side} presses", (along - p[-1]) / 10.0, 0.0, (PRESS[1] - PRESS[0]) / 10.0),
                (f"ball in palm {side}", ((FRICTION * along) ** 2 - across) / 200, 0.0, np.inf),
            ]
        return 0.0, rows

    held = program.held
    inputs = [program.q[held], program.v[held], program.a[held], program.press[held]]
    program.program.block("pressed", inputs, build, least)


def let_go(program: Transcription, apex: float) -> None:
    """After the release palms and fingertips stay off the ball, which flies on its parabola."""
    model = program.model
    knots = np.arange(program.ends[1] + 1, program.K)
    after = np.concatenate([[0.0], np.cumsum(program.spacing()[program.ends[2] :])])
    after = after[knots - program.ends[2]]
    share = np.minimum((knots - program.ends[2]) / SPREAD, 1.0) ** 2
    qpos = hold_qpos(program.body, load_hold("basketball"))
    pos, quat = link_poses(program.body, qpos[None])
    ball = np.array(load_hold("basketball").pos)
    gaps = []
    for b in palms().points:
        link = program.body.link_index(b.link)
        at = pos[0, link] + rotation.rotate(quat[0, link], np.array(b.center))
        gaps.append(float(np.linalg.norm(at - ball)))

    def build(q, h, start_q, p):
        motion = model.motion(q)
        time = OPENING + h * p[-2]
        place = model.motion(start_q).point(model.tree.link(palms().grip.first), palms().grip.point)
        flown = place + shot(place, apex) * time - ca.vertcat(0.0, 0.0, GRAVITY / 2 * time**2)
        rows = []
        for b, gap in zip(palms().points, gaps):
            apart = ca.sumsqr(motion.point(model.tree.link(b.link), b.center) - flown)
            start = gap - 0.001
            wanted = start + p[-1] * (SIZE + b.radius + ROOM - start)
            rows.append((apart - wanted**2) / 0.05)
        return 0.0, [("hands off the ball", ca.vertcat(*rows), 0.0, np.inf)]

    h = np.broadcast_to(program.h[2], (len(knots), 1))
    released = np.tile(program.q[program.ends[1]], (len(knots), 1))
    inputs = [program.q[knots], h, released]
    program.program.block("let go", inputs, build, np.stack([after, share], 1))


def found(solution: Solution, event: dict[str, Any]) -> dict[str, Any]:
    """What the optimiser decided: the velocity at its place, and where the palms push."""
    place = np.array(event["place"])
    velocity = thrown.shot(place, np.array(RIM), solution.asked["apex"])
    return {
        "velocity": velocity.tolist(),
        "normal": striker.axis_of(solution, event).tolist(),
    }


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort throw. See :meth:`warmstart.problems.Problem.solve`."""
    body = load_body("smplx", strength=config.strength, equipment=[EQUIPMENT])
    bare = load_body("smplx", strength=config.strength)
    event = make_event(config)
    return striker.solve(
        "free_throw",
        {"apex": config.apex},
        event,
        lambda elastic: transcribe(config, body, bare, event, elastic),
        lambda program: striker.key_guess(program, "free_throw", DURATIONS),
        guess,
        config,
        progress,
        f"a free throw with its apex {config.apex:g} m above the rim",
        thrown=(EQUIPMENT, OPENING),
        finish=found,
    )
