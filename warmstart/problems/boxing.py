"""Boxing: a straight punch, jab or cross, that meets the opponent at a given speed.

The athlete starts on guard, left foot ahead, and both feet stay where they stand. At the impact the
middle of the glove is its radius before the target, a point of the opponent's head or chest,
and moves straight from where the shoulder was on guard; the knuckles point along. A jab is struck
by the leading left hand, a cross by the right one. Afterwards the hand comes back. The opponent
stands still on guard as in the task and is not in the plan: the blow comes after the event.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import casadi as ca
import numpy as np

from sports import boxing, combat
from sports.humanoid.body import Body, load_body
from warmstart.phases import Phase
from warmstart.problems import clearance, guard, jumper, striker
from warmstart.separation import axis_balls
from warmstart.solution import Solution
from warmstart.transcription import Transcription

SIDE = {"jab": "L", "cross": "R"}
"""The hand that strikes, by punch."""
LINKS = {"head": "Head", "chest": "Chest"}
GLOVE = 0.08
"""Radius of a glove (m), as in ``sports/humanoid/data/equipment.csv``."""
FEET = {"L": "flat", "R": "flat"}
LOAD, SWING, FOLLOW = (0.10, 0.25), (0.10, 0.20), (0.30, 0.65)
"""Durations (s): the weight is shifted; the fist is driven to the impact; it comes back."""
DURATIONS = (0.25, 0.15, 0.60)
"""The same of a first guess."""
FREE = (
    *(f"{side}_{joint}" for side in "LR" for joint in jumper.LEGS),
    *(f"Torso_{axis}" for axis in "xyz"),
    *("Spine_z", "Chest_y", "Chest_z"),
    *(f"{side}_Shoulder_{axis}" for side in "LR" for axis in "xyz"),
    *("L_Elbow_z", "R_Elbow_z"),
)
"""28 hinges, and two of the wrist that strikes."""
POSE = {name: boxing.GUARD[name] for name in ("L_Elbow_x", "R_Elbow_x", "R_Ankle_z")}
"""Held joints (rad) as on guard."""
HELD_LIMITS = (
    *(f"{side}_Thorax_{axis}" for side in "LR" for axis in "xyz"),
    *(f"{side}_{dof}" for side in "LR" for dof in ("Elbow_x", "Elbow_y")),
    *(
        f"{side}_{dof}"
        for side in "LR"
        for dof in ("Knee_x", "Knee_z", "Ankle_z", "Toe_x", "Toe_z")
    ),
)
POSITION = {
    "pitch": (-0.12, 0.22),
    "roll": (-0.2, 0.2),
    "yaw": (-1.0, 1.0),
    "Torso_x": (-0.2, 0.2),
    "Torso_y": (-0.1, 0.15),
    "Chest_y": (-0.1, 0.12),
    "R_Shoulder_z": (-0.9, 1.9),
    "L_Shoulder_z": (-1.9, 0.9),
}
"""Pose boxes (rad) that differ from those of a stroke."""
WRIST = (-0.2, 0.2)
"""The same of the wrist that strikes: a fist hardly bends."""
SHEAR = 1000.0
"""Weight of horizontal force on the feet: the hips turn hard over them."""
FRICTION = {"friction_x": 0.5, "friction_y": 0.4}
EVEN = 0.4
"""Price of load that is not spread over both feet (:func:`warmstart.problems.guard.even`)."""
ROOM = 0.02
"""How far (m) the gloves keep off each other and the own head at knots."""
START, END, IDLE, TRUNK = 0.12, 0.40, 0.25, 0.10
"""How far (rad) angles may be from the guard at the start and at the end, those of the arm that
does not strike at any time, and those by which the trunk leans at both ends."""
WAY, BACK = 0.06, 0.12
"""How far (m) the fist may be from the straight way to the target, and on its way back."""
ELBOW = 0.03
"""How far (m) the elbow is below the fist at least."""
UP = 1.2
"""Height (m) that the other hand keeps at least; on guard it has 1.3."""
WIND_UP, THROUGH = 0.04, 0.15
"""How far (m) it may go back from the guard first, and beyond the impact afterwards."""


@dataclass(frozen=True)
class Config(striker.Config):
    """Options of a punch."""

    fist_speed: float = 6.0
    """Speed of the fist at the impact (m/s)."""
    punch: Literal["jab", "cross"] = "jab"
    """With the leading left hand, or with the right one."""
    target: Literal["head", "chest"] = "head"
    """What of the opponent is to be met: the middle of its front."""
    distance: float = 0.95
    """Between the roots of athlete and opponent on guard (m)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.punch not in SIDE:
            raise ValueError(f"punch must be 'jab' or 'cross', not '{self.punch}'")
        if self.target not in LINKS:
            raise ValueError(f"target must be 'head' or 'chest', not '{self.target}'")
        if not 1.0 <= self.fist_speed <= 14.0:
            raise ValueError(
                f"fist_speed must lie between 1 and 14 m/s, not {self.fist_speed}: the fastest "
                "straight punches that were measured have about 12"
            )
        if not 0.6 <= self.distance <= 1.3:
            raise ValueError(
                f"distance must lie between 0.6 and 1.3 m, not {self.distance}: the feet stay "
                "where they stand"
            )


def make_event(config: Config, body: Body) -> striker.Event:
    """What the fist must do at the impact, in the frame of the athlete."""
    side = SIDE[config.punch]
    ahead = guard.between_feet(body, boxing.GUARD, boxing.GUARD_Z)
    target = guard.front_of(body, boxing.GUARD, boxing.GUARD_Z, LINKS[config.target])
    target = np.array([config.distance - target[0], -target[1], target[2]])  # it faces -x
    shoulder = guard.point_on_guard(body, boxing.GUARD, boxing.GUARD_Z, f"{side}_Shoulder")
    along = (target - shoulder) / np.linalg.norm(target - shoulder)
    place = target - GLOVE * along - np.array([ahead, 0.0, 0.0])
    velocity = config.fist_speed * along
    return striker.Event(
        link=f"{side}_Hand",
        point=(0.0, 0.0, 0.0),
        axis=(0.0, 1.0 if side == "L" else -1.0, 0.0),
        place=(float(place[0]), float(place[1]), float(place[2])),
        velocity=(float(velocity[0]), float(velocity[1]), float(velocity[2])),
        normal=(float(along[0]), float(along[1]), float(along[2])),
    )


def transcribe(
    config: Config, body: Body, event: striker.Event, elastic: bool = False
) -> Transcription:
    """The nonlinear program."""
    knots = jumper.scaled(config.detail)
    phases = [
        Phase("load", knots(10), LOAD, FEET),
        Phase("swing", knots(20), SWING, FEET),
        Phase("follow", knots(22), FOLLOW, FEET, grading=3.0),
    ]
    side = SIDE[config.punch]
    wrist = tuple(f"{side}_Wrist_{axis}" for axis in "xz")
    idle = [
        name
        for name in ("Shoulder_x", "Shoulder_y", "Shoulder_z", "Elbow_z")
        for name in [f"{'R' if side == 'L' else 'L'}_{name}"]
    ]
    kept = {name: boxing.GUARD.get(name, 0.0) for name in idle}
    upright = dict.fromkeys(("pitch", "roll", "Torso_x", "Torso_y", "Chest_y"), 0.0)
    program = striker.transcribe(
        body,
        event,
        phases,
        config,
        free=(*FREE, *wrist),
        pose=POSE,
        position=POSITION
        | dict.fromkeys(wrist, WRIST)
        | {name: (angle - IDLE, angle + IDLE) for name, angle in kept.items()},
        held_limits=HELD_LIMITS,
        feet=((0.15, 0.40), (0.25, 0.45)),
        bounds=FRICTION,
        shear=SHEAR,
        comfort=upright | kept,
        elastic=elastic,
    )
    for knot, slack in ((0, START), (-1, END)):
        guard.near(program, knot, boxing.GUARD, slack)
        guard.near(program, knot, {}, TRUNK, ("pitch", "roll", "Torso_x", "Torso_y", "Chest_y"))
    guard.settled(program, (-0.08, 0.12))
    _apart(program, body)
    guard.even(program, EVEN)
    _straight(program, body, event, side)
    return program


def _apart(program: Transcription, body: Body) -> None:
    """Gloves off each other and the own head, arms off the trunk, by ``ROOM``."""
    gloves = [axis_balls(body, f"{s}_Hand")[0] for s in "LR"]
    heads = [replace(b, radius=b.radius + clearance.CORNERS) for b in axis_balls(body, "Head")]
    trunk = [axis_balls(body, link)[-1] for link in ("Torso", "Spine", "Chest")]
    arms = [
        b
        for s in "LR"
        for b in (*axis_balls(body, f"{s}_Shoulder", 3)[1:], *axis_balls(body, f"{s}_Elbow", 3))
    ]
    pairs = [(gloves[0], gloves[1])]
    pairs += [
        (a, b) for these, those in ((gloves, heads), (arms, trunk)) for a in these for b in those
    ]
    clearance.keep_off(program, pairs, np.arange(program.K), ROOM)


def _straight(program: Transcription, body: Body, event: striker.Event, side: str) -> None:
    """The fist goes straight from the guard to the target and comes back, the elbow under it; the
    other hand stays up."""
    model = program.model
    fist, elbow = (model.tree.link(f"{side}_{link}") for link in ("Hand", "Elbow"))
    ahead = guard.between_feet(body, boxing.GUARD, boxing.GUARD_Z)
    ready = guard.point_on_guard(body, boxing.GUARD, boxing.GUARD_Z, f"{side}_Hand")
    ready = ready - np.array([ahead, 0.0, 0.0])
    way = np.array(event.place) - ready
    length = float(np.linalg.norm(way))
    along = ca.DM((way / length).tolist())

    def rows(width: float):
        def build(q, p):
            motion = model.motion(q)
            off = motion.p_WL[fist] - ca.DM(ready.tolist())
            far = ca.dot(off, along)
            return [
                ("straight way", (ca.sumsqr(off) - far**2) / width**2, -np.inf, 1.0),
                ("reach of the fist", far / 0.1, -WIND_UP / 0.1, (length + THROUGH) / 0.1),
                (
                    "elbow under the fist",
                    (off[2] + ready[2] - motion.p_WL[elbow][2]) / 0.1,
                    ELBOW / 0.1,
                    10,
                ),
            ]

        return build

    other = model.tree.link(f"{'R' if side == 'L' else 'L'}_Hand")

    def up(q, p):
        return [("other hand up", model.motion(q).p_WL[other][2] / 0.1, UP / 0.1, np.inf)]

    program.rows("other hand", np.arange(program.K), up)
    swing, follow = np.arange(program.knots("follow")[0] + 1), program.knots("follow")[1:]
    program.rows("straight", swing, rows(WAY))
    program.rows("back", follow, rows(BACK))


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort punch. See :meth:`warmstart.problems.Problem.solve`."""
    body = load_body("smpl", strength=config.strength, equipment=["gloves"])
    event = make_event(config, body)
    ahead = guard.between_feet(body, boxing.GUARD, boxing.GUARD_Z)
    return striker.solve(
        "boxing",
        {"fist_speed": config.fist_speed},
        event,
        lambda elastic: transcribe(config, body, event, elastic),
        lambda program: striker.key_guess(program, f"boxing_{config.punch}", DURATIONS),
        guess,
        config,
        progress,
        f"a {config.punch} of {config.fist_speed:g} m/s to the {config.target}",
        (combat.HALF_DISTANCE - config.distance + ahead, 0.0, 0.0),
    )
