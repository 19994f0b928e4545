"""Fencing: a lunge whose point touches the opponent's chest at a given distance.

The athlete starts on guard, right foot ahead. Both feet load, then the front foot leaves the ground
and steps forward while the rear leg pushes and stays flat; the point touches before the front foot
lands, and the lunge ends at rest on both feet. At the touch the tip of the sword is at the target,
a point on the front of the opponent's chest as it stands on guard in the task, and the blade
points and moves along. ``reach`` is the distance over the ground from where the root is at the
start to that target. The opponent is not in the plan: the touch comes after the event.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from sports import combat, fencing
from sports.humanoid.body import Body, load_body
from warmstart.contact import Ball
from warmstart.phases import Phase
from warmstart.problems import guard, jumper, striker
from warmstart.solution import Solution
from warmstart.transcription import Transcription

LINK, LENGTH = fencing.SWORD[0].link, fencing.SWORD[0].length
"""The sword replaces this hand; its tip is this far along the hand's -y (m)."""
BLADE = tuple(Ball(LINK, (0.0, -along, 0.0), 0.01) for along in (0.08, 0.3, 0.6))
"""Balls on the blade, for clearances."""
LOAD, SWING, LAND, FOLLOW = (0.10, 0.20), (0.15, 0.35), (0.01, 0.08), (0.30, 0.60)
"""Durations (s): both feet load; the front foot flies, until the touch; until it lands; rest."""
DURATIONS = (0.20, 0.35, 0.01, 0.45)
"""The same of a first guess."""
FREE = (
    *(f"{side}_{joint}" for side in "LR" for joint in jumper.LEGS),
    *(f"Torso_{axis}" for axis in "xyz"),
    *("Spine_z", "Chest_y", "Chest_z"),
    *("L_Shoulder_x", "L_Shoulder_z", "L_Elbow_z"),
    *(f"R_Shoulder_{axis}" for axis in "xyz"),
    *("R_Elbow_y", "R_Elbow_z", "R_Wrist_x", "R_Wrist_z"),
)
"""30 hinges."""
POSE = {name: fencing.GUARD[name] for name in ("R_Elbow_x", "L_Ankle_z")}
"""Held joints (rad) as on guard."""
HELD_LIMITS = (
    *(f"{side}_Thorax_{axis}" for side in "LR" for axis in "xyz"),
    *("L_Elbow_x", "R_Elbow_x", "R_Hand_x", "R_Hand_y", "R_Hand_z"),
    *(f"{side}_{dof}" for side in "LR" for dof in ("Knee_x", "Knee_z", "Toe_x", "Toe_z")),
    *("L_Ankle_z", "R_Ankle_z"),
)
POSITION = {
    "x": (-0.3, 1.0),
    "z": (0.5, 1.02),
    "pitch": (-0.15, 0.35),
    "roll": (-0.3, 0.3),
    "Hip_x": (-1.0, 1.0),
    "Hip_y": (-1.7, 0.7),
    "Hip_z": (-1.0, 1.0),
    "Knee_y": (0.05, 1.9),
    "Ankle_x": (-0.5, 0.5),
    "Ankle_y": (-0.8, 0.7),
    "Torso_x": (-0.2, 0.2),
    "Torso_y": (-0.1, 0.25),
    "Chest_y": (-0.1, 0.2),
    "L_Shoulder_z": (-1.9, 0.9),
    "R_Wrist_x": (-0.5, 0.5),
    "R_Wrist_z": (-0.5, 0.5),
}
"""Pose boxes (rad, m) that differ from those of a stroke."""
RATE_X = (-1.0, 4.0)
START, TRUNK = 0.12, 0.10
"""How far (rad) angles may be from the guard at the start, and by how much the trunk leans."""
TILT = 0.4
"""How far (rad) the blade may point from where it will touch."""
WAY = 0.12
"""How far (m) the tip may be from the straight way to the target while the front foot flies."""
STAYS = 0.25
"""How far (m, each way) the tip may be from the target after the landing."""
STEP = (0.25, 1.0)
"""How far (m) the front foot steps."""
FRICTION = {"friction_x": 0.6, "friction_y": 0.4}
SHEAR, EVEN = 1000.0, 0.4
"""Price of horizontal force on the feet, and of load that is not spread over them."""


@dataclass(frozen=True)
class Config(striker.Config):
    """Options of a lunge."""

    reach: float = 2.1
    """From the root at the start to the target, over the ground (m)."""
    tip_speed: float = 2.5
    """Speed of the sword's tip at the touch (m/s)."""
    target: Literal["chest", "head"] = "chest"
    """What of the opponent is to be touched: the middle of its front."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1.5 <= self.reach <= 2.8:
            raise ValueError(f"reach must lie between 1.5 and 2.8 m, not {self.reach}")
        if not 0.5 <= self.tip_speed <= 6.0:
            raise ValueError(f"tip_speed must lie between 0.5 and 6 m/s, not {self.tip_speed}")
        if self.target not in LINKS:
            raise ValueError(f"target must be 'chest' or 'head', not '{self.target}'")


LINKS = {"head": "Head", "chest": "Chest"}


def make_event(config: Config, body: Body) -> striker.Event:
    """What the tip must do at the touch, in the frame of the athlete."""
    ahead = guard.between_feet(body, fencing.GUARD, fencing.GUARD_Z)
    target = guard.front_of(body, fencing.GUARD, fencing.GUARD_Z, LINKS[config.target])
    return striker.Event(
        link=LINK,
        point=(0.0, -LENGTH, 0.0),
        axis=(0.0, -1.0, 0.0),
        place=(config.reach - ahead, -float(target[1]), float(target[2])),
        velocity=(config.tip_speed, 0.0, 0.0),
        normal=(1.0, 0.0, 0.0),
    )


def transcribe(
    config: Config, body: Body, event: striker.Event, elastic: bool = False
) -> Transcription:
    """The nonlinear program."""
    knots = jumper.scaled(config.detail)
    both, rear = {"L": "flat", "R": "flat"}, {"L": "flat"}
    phases = [
        Phase("load", knots(8), LOAD, both),
        Phase("swing", knots(13), SWING, rear),
        Phase("land", knots(3), LAND, rear),
        Phase("follow", knots(14), FOLLOW, both, grading=3.0),
    ]
    upright = dict.fromkeys(("pitch", "roll", "Torso_x", "Torso_y", "Chest_y"), 0.0)
    arm = ("L_Shoulder_x", "L_Shoulder_z", "L_Elbow_z")
    program = striker.transcribe(
        body,
        event,
        phases,
        config,
        free=FREE,
        pose=POSE,
        position=POSITION,
        held_limits=HELD_LIMITS,
        tool=BLADE,
        feet=((0.15, 0.40), (-0.45, -0.25)),
        bounds=FRICTION,
        shear=SHEAR,
        comfort=upright | {name: fencing.GUARD[name] for name in arm},
        elastic=elastic,
    )
    model = program.model
    guard.near(program, 0, fencing.GUARD, START)
    ahead = guard.between_feet(body, fencing.GUARD, fencing.GUARD_Z)
    program.fix(program.q[0, model.index("x")], -ahead)
    program.fix(program.q[0, model.index("y")], 0.0)
    guard.settled(program, (-0.15, 0.25))
    for name in ("pitch", "roll"):
        program.bound(program.q[-1, model.index(name)], -0.2, 0.25)
    guard.even(program, EVEN)
    _step(program, body)
    _point_in_line(program, body, event)
    return program


def _step(program: Transcription, body: Body) -> None:
    """The front foot is off the ground while it flies, and lands ahead of where it stood."""
    model = program.model
    sole = jumper.foot(body, "R")
    air = np.concatenate([program.knots("swing")[1:], program.knots("land")[1:-1]])
    program.ground(sole, air, margin=0.0)
    first, last = round(0.2 * len(air)), len(air) - round(0.27 * len(air))
    program.ground(sole, air[first:last], margin=0.02)
    front, rear = (model.tree.link(f"{side}_Ankle") for side in "RL")

    def landed(q, p):
        motion = model.motion(q)
        gap = motion.p_WL[front] - motion.p_WL[rear]
        return [("step", gap[0], 0.34 + STEP[0], 0.34 + STEP[1]), ("width", gap[1], -0.45, -0.05)]

    program.rows("step", [int(program.knots("follow")[0])], landed)


def _point_in_line(program: Transcription, body: Body, event: striker.Event) -> None:
    """The blade points forward all the time, and its tip goes straight to the target while the
    front foot flies."""
    model = program.model
    hand = model.tree.link(LINK)
    ahead = guard.between_feet(body, fencing.GUARD, fencing.GUARD_Z)
    place = guard.point_on_guard(body, fencing.GUARD, fencing.GUARD_Z, LINK, event.point)
    ready = place - np.array([ahead, 0.0, 0.0])
    way = np.array(event.place) - ready
    along = ca.DM((way / np.linalg.norm(way)).tolist())

    def forward(q, p):
        blade = model.motion(q).R_WL[hand] @ ca.DM(list(event.axis))
        return [("blade forward", ca.dot(blade, p[6:9]), np.cos(TILT), np.inf)]

    def straight(q, p):
        off = model.motion(q).point(hand, event.point) - ca.DM(ready.tolist())
        side = ca.sumsqr(off) - ca.dot(off, along) ** 2
        return [("point in line", side / WAY**2, -np.inf, 1.0)]

    program.rows("blade", np.arange(program.K), forward)
    program.rows("line", program.knots("swing"), straight)

    def held(q, p):
        off = model.motion(q).point(hand, event.point) - p[:3]
        return [("point stays", off / 0.1, -STAYS / 0.1, STAYS / 0.1)]

    program.rows("held", program.knots("follow")[1:], held)


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort lunge. See :meth:`warmstart.problems.Problem.solve`."""
    body = load_body("smpl", strength=config.strength, equipment=["sword"])
    event = make_event(config, body)
    ahead = guard.between_feet(body, fencing.GUARD, fencing.GUARD_Z)
    target = guard.front_of(body, fencing.GUARD, fencing.GUARD_Z, LINKS[config.target])
    start = combat.HALF_DISTANCE - float(target[0]) - config.reach
    return striker.solve(
        "fencing",
        {"reach": config.reach, "tip_speed": config.tip_speed},
        event,
        lambda elastic: transcribe(config, body, event, elastic),
        lambda program: striker.key_guess(program, "fencing", DURATIONS),
        guess,
        config,
        progress,
        f"a lunge of {config.reach:g} m",
        (start + ahead, 0.0, 0.0),
    )
