"""One step to the ball before a kick: the left foot starts behind and lands beside the ball.

The athlete stands at rest with the left foot a step behind where the kick from a stand has it. Both
feet load (``lean``), the left one flies forward over the standing right one (``step``), lands with
no velocity, and both carry (``plant``) until the right one leaves the ground and swings. Nothing
has to come to rest between step and kick.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from sports.humanoid.body import Body
from sports.physics.base import GRAVITY
from warmstart.phases import Phase
from warmstart.problems import jumper
from warmstart.transcription import Transcription

BOTH, LEFT, RIGHT = {"L": "flat", "R": "flat"}, {"L": "flat"}, {"R": "flat"}
LEAN, STEP, PLANT = (0.20, 0.50), (0.30, 0.45), (0.10, 0.40)
"""Durations (s): both feet load; the left one is in the air; both stand."""
DURATIONS = (0.50, 0.45, 0.35)
"""The same of a first guess."""
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
SHORTEST, LONGEST = 0.3, 0.8
"""Steps that may be asked for (m)."""
POSITION = {"x": (-1.0, 1.2), "Knee_y": (0.02, 2.0)}
"""Pose boxes (m, rad) that differ from those of a kick from a stand."""


def phases(knots: Callable[[int], int]) -> list[Phase]:
    """What comes before the swing."""
    return [
        Phase("lean", knots(18), LEAN, BOTH),
        Phase("step", knots(20), STEP, RIGHT),
        Phase("plant", knots(18), PLANT, BOTH),
    ]


def rows(program: Transcription, body: Body, length: float) -> int:
    """Adds the rows of a step of a length (m); returns the knot at which the foot lands."""
    model = program.model
    ankle = model.tree.link("L_Ankle")
    air, landed = program.knots("step")[1:-1], int(program.knots("plant")[0])
    sole = jumper.foot(body, "L")
    program.ground(sole, air, margin=0.0)
    program.ground(sole, air[len(air) // 4 : -len(air) // 4], margin=LIFT)

    def stepped(before, after, p):
        way = model.motion(after).p_WL[ankle] - model.motion(before).p_WL[ankle]
        return 0.0, [
            ("step length", way[0], length - SLACK, length + SLACK),
            ("step aside", way[1], -ASIDE, ASIDE),
        ]

    _still(program)
    for name in ("lean", "plant"):
        program.bound(program.v[program.knots(name), 6:], -SLOW, SLOW)
        program.bound(program.a[program.knots(name), 6:], -QUIET, QUIET)
    program.program.block("step", [program.q[[0]], program.q[[landed]]], stepped)
    return landed


def _still(program: Transcription) -> None:
    """A sole that stands is hardly accelerated."""
    model, gravity = program.model, ca.DM([0.0, 0.0, GRAVITY])
    for side, names in (("R", ("lean", "step", "plant")), ("L", ("lean", "plant"))):
        knots = np.unique(np.concatenate([program.knots(name)[1:] for name in names]))
        toe = model.tree.link(f"{side}_Toe")

        def still(q, v, a, p, toe=toe):
            motion = model.motion(q, v, a)
            return 0.0, [
                ("sole pull", (motion.R_WL[toe] @ motion.acc[toe] - gravity) / STILL[0], -1.0, 1.0),
                ("sole twist", motion.alpha[toe] / STILL[1], -1.0, 1.0),
            ]

        inputs = [program.q[knots], program.v[knots], program.a[knots]]
        program.program.block(f"still {side}", inputs, still)
