"""One step to the ball before a kick: the left foot starts behind and lands beside the ball.

The athlete stands at rest with the left foot a step behind where the kick from a stand has it. Both
feet load (``lean``), the left one flies forward over the standing right one (``step``), lands with
no velocity, and both carry (``plant``) until the right one leaves the ground and swings. Nothing
has to come to rest between step and kick.

From the task's own start it is two steps: the athlete stands as the task has it, hardly bent, the
right foot steps first (``start``, ``right``), then the left one as above.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from sports.humanoid.body import Body
from sports.penalty_kick import PenaltyKick, scene
from sports.physics.base import GRAVITY
from warmstart.outcome import link_poses
from warmstart.phases import Phase
from warmstart.problems import guard, jumper
from warmstart.rigid_body import from_full_state
from warmstart.transcription import Transcription

BOTH, LEFT, RIGHT = {"L": "flat", "R": "flat"}, {"L": "flat"}, {"R": "flat"}
LEAN, STEP, PLANT = (0.20, 0.50), (0.30, 0.45), (0.10, 0.40)
"""Durations (s): both feet load; the left one is in the air; both stand."""
DURATIONS = (0.50, 0.45, 0.35)
"""The same of a first guess."""
START, FIRST = (0.20, 0.50), (0.25, 0.45)
"""Of the first of two steps (s): both feet load; the right one is in the air."""
START_DURATIONS = (0.50, 0.45)
"""The same of a first guess."""
OFF, AT = 0.03, (0.004, 0.01)
"""How far the first knot may be from the task's start: angles (rad), root and ankles (m)."""
SLACK = 0.002
"""How far a step may be off the asked length (m)."""
ASIDE = 0.15
"""How far the left foot may land to either side of where it started (m)."""
LIFT = 0.02
"""How high it passes over the ground in the middle of the step (m)."""
SLOW, QUIET = 2.0, 30.0
"""Largest rate (rad/s) and acceleration (rad/s^2) of a hinge while both feet stand: see the kick
from a stand."""
STILL = 3.0, 25.0
"""Largest acceleration (m/s^2) and angular acceleration (rad/s^2) of a sole that stands: at rest at
all knots, it must not move to and fro between them."""
ANKLES = ("L_Ankle", "R_Ankle")
SHORTEST, LONGEST = 0.3, 0.8
"""Steps that may be asked for (m)."""
POSITION = {"x": (-1.0, 1.2), "Knee_y": (0.02, 2.0)}
"""Pose boxes (m, rad) that differ from those of a kick from a stand."""


def phases(knots: Callable[[int], int], from_start: bool) -> list[Phase]:
    """What comes before the swing."""
    first = [Phase("start", knots(12), START, BOTH), Phase("right", knots(18), FIRST, LEFT)]
    return [
        *(first if from_start else []),
        Phase("lean", knots(18), LEAN, BOTH),
        Phase("step", knots(20), STEP, RIGHT),
        Phase("plant", knots(18), PLANT, BOTH),
    ]


def rows(program: Transcription, body: Body) -> int:
    """Adds the rows of all steps; returns the knot at which the left foot lands."""
    names = [phase.name for phase in program.phases]
    for side, name in (("R", "right"), ("L", "step")):
        if name in names:
            air, sole = program.knots(name)[1:-1], jumper.foot(body, side)
            program.ground(sole, air, margin=0.0)
            program.ground(sole, air[len(air) // 4 : -len(air) // 4], margin=LIFT)
    _still(program, names)
    for name in ("start", "lean", "plant"):
        if name in names:
            program.bound(program.v[program.knots(name), 6:], -SLOW, SLOW)
            program.bound(program.a[program.knots(name), 6:], -QUIET, QUIET)
    return int(program.knots("plant")[0])


def of_length(program: Transcription, length: float) -> None:
    """The left foot steps by a length (m)."""
    model, landed = program.model, int(program.knots("plant")[0])
    ankle = model.tree.link("L_Ankle")

    def stepped(before, after, p):
        way = model.motion(after).p_WL[ankle] - model.motion(before).p_WL[ankle]
        return 0.0, [
            ("step length", way[0], length - SLACK, length + SLACK),
            ("step aside", way[1], -ASIDE, ASIDE),
        ]

    program.program.block("step", [program.q[[0]], program.q[[landed]]], stepped)


def as_the_task(program: Transcription, body: Body, origin: tuple[float, float]) -> None:
    """The first knot is near the task's start; ``origin`` (m) is where the program's lies in the
    task."""
    model = program.model
    qpos = scene(PenaltyKick(), body).default_qpos()[None, : 7 + body.num_dofs].copy()
    qpos[:, :2] -= origin
    rest = np.zeros((1, qpos.shape[1] - 1))
    pose = from_full_state(model, qpos, rest, rest)[0][0]
    for name in (*guard.ROOT, *model.free):
        i, off = model.index(name), 0.0 if "Toe" in name else OFF
        program.bound(program.q[0, i], pose[i] - off, pose[i] + off)
    for i in range(2):
        program.bound(program.q[0, i], pose[i] - AT[0], pose[i] + AT[0])
    pos, _ = link_poses(body, qpos)
    stand = [(model.tree.link(name), pos[0, body.link_index(name)]) for name in ANKLES]

    def feet(q, p):
        motion = model.motion(q)
        return [
            (f"foot {'xy'[j]}", motion.p_WL[link][j] - float(at[j]), -AT[1], AT[1])
            for link, at in stand
            for j in range(2)
        ]

    program.rows("feet", [0], feet)


def _still(program: Transcription, names: Sequence[str]) -> None:
    """A sole that stands is hardly accelerated."""
    model, gravity = program.model, ca.DM([0.0, 0.0, GRAVITY])
    stands = {"R": ("start", "lean", "step", "plant"), "L": ("start", "right", "lean", "plant")}
    for side, where in stands.items():
        here = [program.knots(name)[1:] for name in where if name in names]
        knots = np.unique(np.concatenate(here))
        toe = model.tree.link(f"{side}_Toe")

        def still(q, v, a, p, toe=toe):
            motion = model.motion(q, v, a)
            return 0.0, [
                ("sole pull", (motion.R_WL[toe] @ motion.acc[toe] - gravity) / STILL[0], -1.0, 1.0),
                ("sole twist", motion.alpha[toe] / STILL[1], -1.0, 1.0),
            ]

        inputs = [program.q[knots], program.v[knots], program.a[knots]]
        program.program.block(f"still {side}", inputs, still)
