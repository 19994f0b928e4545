"""Two styles of the high jump out of an oblique run-up: the scissor and the flop.

Both run towards the bar from its right and take off from the left foot, the one further from it.

* Scissor: a sitting clearance. Over the bar the trunk is upright, the right leg is beyond the bar
  while the left one is still before it, and the right foot lands first.
* Flop (Fosbury): the body turns its back to the bar in the air, goes over it head first with the
  chest up and the hips extended, and lands on its back, as the task's rules allow: a fall ends an
  attempt only while the root is before x = 20.1. The motion ends as the back reaches the ground.

The flight has two phases that meet as the root is over the bar; there the style is a constraint.
Keep-out region, effort and outcome are those of :mod:`warmstart.problems.high_jump`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from sports.humanoid.body import load_body
from warmstart.contact import outline
from warmstart.phases import Bounds, Phase
from warmstart.problems import jumper
from warmstart.separation import keep_apart
from warmstart.transcription import Transcription

if TYPE_CHECKING:
    from warmstart.problems.high_jump import Config

BAR_X, LANE_Y = 20.0, 6.0
HEADING = {"scissor": 0.55, "flop": 0.9}
"""Direction of the run (rad from the perpendicular of the bar)."""
TOUCH = 0.03
"""Height (m) at which the landing part of the body is down."""
TRUNK = ("Chest", "Head", "L_Shoulder", "R_Shoulder")
"""Links that would fall back onto a low bar after the landing."""
_COVERED = ("Neck", "Thorax", "Wrist", "Spine")
"""Links whose balls lie inside the hull of their neighbours."""

POSITION = {
    "scissor": jumper.POSITION | {"Hip_y": (-2.3, 0.6), "Hip_z": (-0.8, 0.8)},
    "flop": jumper.POSITION
    | {
        "Hip_y": (-2.1, 0.8),
        "Hip_z": (-0.8, 0.8),
        "Torso_x": (-0.5, 0.5),
        "Torso_y": (-0.6, 0.6),
        "Chest_y": (-0.4, 0.5),
        "Torso_z": (-0.6, 0.6),
    },
}
ROOT = {
    "scissor": {"pitch": (-0.7, 0.9), "roll": (-0.9, 0.9), "yaw": (-0.6, 1.8)},
    "flop": {"pitch": (-0.7, 2.6), "roll": (-1.2, 1.2), "yaw": (0.0, 4.4)},
}
"""Boxes of the root's attitude (rad)."""
HIP_X = {
    "scissor": {"L_Hip_x": (-0.5, 1.2), "R_Hip_x": (-1.2, 0.5)},
    "flop": {"L_Hip_x": (-0.5, 0.7), "R_Hip_x": (-0.7, 0.5)},
}
TURN = {"pitch": (-10.0, 10.0), "roll": (-8.0, 8.0), "yaw": (-12.0, 12.0), "y": (-1.0, 6.5)}
"""Boxes of the root's rates in a flop (rad/s, m/s)."""


def transcribe(config: Config, elastic: bool = False) -> Transcription:
    """The nonlinear program of a style; its parameter is the bar's height plus the clearance."""
    style = config.style
    body = load_body("smpl", strength=config.strength)
    model = jumper.make_model(body)
    knots = jumper.scaled(config.detail)
    phases = [
        Phase("flat", knots(11), (0.05, 0.30), {"L": "flat"}),
        Phase("toe", knots(9), (0.04, 0.15), {"L": "toe"}),
        Phase("rise", knots(24), (0.12, 0.50), grading=3.0),
        Phase("fall", knots(24), (0.12, 0.60 if style == "flop" else 0.48)),
    ]
    position = jumper.boxes(POSITION[style]) | {
        "x": (BAR_X - 4, BAR_X + 3),
        "y": (LANE_Y - 1.8, LANE_Y + 1.8),
        "z": (0.1 if style == "flop" else 0.5, 3.0),
        **ROOT[style],
        **HIP_X[style],
    }
    rate = jumper.boxes(jumper.RATE) | (
        TURN if style == "flop" else {"y": (-1.5, 5.0), "roll": (-6.0, 6.0)}
    )
    program = Transcription(
        body,
        model,
        phases,
        Bounds(position, rate, acceleration=600.0),
        held_limits=jumper.HELD_LIMITS,
        flight_limits=jumper.FLIGHT_LIMITS,
        parameters=1,
        elastic=elastic,
    )
    keep_apart(program, body, np.arange(program.K))
    jumper.start_rows(
        program,
        config.approach_speed,
        sink=(-1.2, -0.1),
        limb_rate=14.0,
        heading=HEADING[style],
    )
    program.bound(program.q[0, model.index("pitch")], -0.25, None)
    program.bound(program.q[0, model.index("Torso_x")], -0.2, 0.2)
    _over_the_bar(program)
    (_scissor if style == "scissor" else _flop)(program)
    return program


def _over_the_bar(program: Transcription) -> None:
    """Every point of the body above the keep-out parabola; feet off the ground."""
    from warmstart.problems.high_jump import bar_clearance

    body, model = program.body, program.model
    balls = [b for b in outline(body) if not b.link.endswith(_COVERED)]

    def clear(q, p):
        motion = model.motion(q)
        gaps = [
            bar_clearance(b, motion.point(model.tree.link(b.link), b.center), p[0]) for b in balls
        ]
        return [("bar clearance", ca.vertcat(*gaps), 0.0, np.inf)]

    rise, fall = program.knots("rise"), program.knots("fall")
    program.rows("bar", np.concatenate([program.knots("toe")[1:], rise[1:], fall[1:]]), clear)
    left, right = jumper.foot(body, "L"), jumper.foot(body, "R")
    program.ground(right, np.arange(program.K - 1))
    program.ground(left, rise[1:4], margin=0.0)
    program.ground(left, np.concatenate([rise[4:], fall[1:]]))
    program.bound(program.q[fall[0], 0], BAR_X - 0.02, BAR_X + 0.02)


def _scissor(program: Transcription) -> None:
    """Sitting over the bar, one leg beyond it and one before; on the right foot at the end."""
    body, model, tree = program.body, program.model, program.model.tree
    right = jumper.foot(body, "R")

    def sit(q, p):
        motion = model.motion(q)
        x = {s: motion.point(tree.link(f"{s}_Ankle"), (0, 0, 0))[0] - BAR_X for s in "LR"}
        upright = motion.R_WL[tree.link("Chest")][2, 2]
        return [
            ("lead leg beyond the bar", x["R"], 0.25, np.inf),
            ("trail leg before the bar", x["L"], -np.inf, -0.15),
            ("sitting upright", upright, 0.75, np.inf),
        ]

    def land(q, p):
        motion = model.motion(q)
        corners = [motion.point(tree.link(b.link), b.center) for b in right]
        rest = [motion.point(tree.link(link), (0, 0, 0))[0] for link in (*TRUNK, "L_Knee")]
        trail = [motion.point(tree.link(b.link), b.center)[0] for b in jumper.foot(body, "L")]
        return [
            ("landing height", ca.vertcat(*[c[2] for c in corners]), 0.0, TOUCH),
            ("landing beyond the bar", ca.vertcat(*[c[0] for c in corners]), BAR_X + 0.25, np.inf),
            ("root beyond the bar", q[0], BAR_X + 0.25, np.inf),
            ("trunk beyond the bar", ca.vertcat(*rest), BAR_X + 0.15, np.inf),
            ("trail foot beyond the bar", ca.vertcat(*trail), BAR_X + 0.08, np.inf),
            ("upright at the landing", motion.R_WL[tree.link("Chest")][2, 2], 0.85, 1.0),
        ]

    middle, last = program.knots("fall")[0], program.q[-1]
    program.rows("sit", [middle], sit)
    program.rows("end", [program.K - 1], land)
    for side in "LR":
        program.bound(program.q[middle, model.index(f"{side}_Knee_y")], 0.05, 1.0)
    for name, low, high in (("pitch", -0.4, 0.6), ("roll", -0.4, 0.4), ("z", 0.7, 1.2)):
        program.bound(last[model.index(name)], low, high)


def _flop(program: Transcription) -> None:
    """Back to the bar, head beyond it and feet before it, hips extended; on the back at the end."""
    body, model, tree = program.body, program.model, program.model.tree
    balls = [b for b in outline(body) if not b.link.endswith(("Ankle", "Toe"))]
    soles = [b for side in "LR" for b in jumper.foot(body, side)]
    chest = body.links[body.link_index("Chest")].shapes[0]

    def arch(q, p):
        motion = model.motion(q)
        pelvis = motion.R_WL[tree.link("Pelvis")]
        ankles = [motion.point(tree.link(f"{s}_Ankle"), (0, 0, 0))[0] - BAR_X for s in "LR"]
        return [
            ("chest up", pelvis[2, 0], 0.7, np.inf),
            ("head beyond the bar", pelvis[0, 2], 0.5, np.inf),
            ("feet before the bar", ca.vertcat(*ankles), -np.inf, -0.2),
        ]

    def land(q, p):
        motion = model.motion(q)
        back = motion.point(tree.link("Chest"), chest.center)
        feet = [motion.point(tree.link(b.link), b.center)[0] for b in soles]
        return [
            ("back down", back[2] - chest.size[0], 0.0, 0.05),
            ("chest up at the landing", motion.R_WL[tree.link("Chest")][2, 0], 0.85, np.inf),
            ("root beyond the bar", q[0], BAR_X + 0.35, np.inf),
            ("feet beyond the bar", ca.vertcat(*feet), BAR_X + 0.15, np.inf),
        ]

    middle = program.knots("fall")[0]
    program.rows("arch", [middle], arch)
    program.rows("end", [program.K - 1], land)
    for side in "LR":
        program.bound(program.q[middle, model.index(f"{side}_Hip_y")], -0.2, None)
    program.ground(balls, np.arange(program.K - 12, program.K), margin=0.0)


def first_guess(program: Transcription, style: str, bar_height: float) -> np.ndarray:
    """Key poses along a ballistic root path in the direction of the run."""
    flop = style == "flop"
    off, up, down = 0.22, 0.33, 0.42 if flop else 0.38
    durations = (0.15, off - 0.15, up, down)
    t = program.nominal_times(durations)
    heading = HEADING[style]
    arm = {"L_Shoulder_z": -0.6, "R_Shoulder_z": 0.6}
    run = [
        jumper.legs((-0.5, 0.4, 0.2, 0), (0.3, 1.2, 0, 0), pitch=-0.1, yaw=heading),
        jumper.legs((0, 0.3, -0.3, 0), (-0.6, 1.3, 0, 0), yaw=heading, **arm),
    ]
    if flop:
        half = 0.5 * (heading + math.pi)
        frames = [
            *run,
            jumper.legs((0.3, 0.1, 0.3, -0.7), (-1.3, 1.6, 0, 0), yaw=heading + 0.3, **arm),
            jumper.legs((0.3, 0.6, 0.3, 0), (-0.8, 1.5, 0, 0), yaw=half + 0.3, pitch=0.6),
            jumper.legs((0.4, 1.3, 0.3, 0), (0.2, 1.4, 0, 0), yaw=math.pi, pitch=1.5, Torso_y=-0.3),
            jumper.legs((-0.9, 0.9, 0, 0), (-0.9, 0.9, 0, 0), yaw=math.pi, pitch=1.7),
            jumper.legs((-1.4, 0.9, 0, 0), (-1.4, 0.9, 0, 0), yaw=math.pi, pitch=1.7, Torso_y=0.3),
        ]
        speed, land, peak = 3.6, 0.25, bar_height + 0.2
    else:
        frames = [
            *run,
            jumper.legs((0.3, 0.1, 0.3, -0.7), (-1.7, 0.4, 0, 0), yaw=heading, **arm),
            jumper.legs((0.1, 0.4, 0.3, 0), (-2.0, 0.2, 0, 0), yaw=heading, **arm),
            jumper.legs((-0.9, 0.6, 0.3, 0), (-1.4, 0.2, 0, 0), yaw=heading, L_Hip_x=0.5, **arm),
            jumper.legs((-1.9, 0.2, 0, 0), (-0.7, 0.2, 0, 0), yaw=heading, L_Hip_x=0.3, **arm),
            jumper.legs((-1.0, 0.5, 0, 0), (-0.3, 0.3, 0.2, 0), yaw=heading, **arm),
        ]
        speed, land, peak = 3.6, 0.92, bar_height + 0.25
    times = [0, 0.15, off, off + 0.5 * up, off + up, off + up + 0.5 * down, off + up + down]
    q = jumper.key_frames(program.model, times, frames, t)
    start, take_off = 0.86, 0.97
    q[:, 0] = speed * (t - off - up)
    before = np.minimum(t / off, 1.0) ** 2
    rise = np.clip((t - off) / up, 0.0, 1.0)
    fall = np.clip((t - off - up) / down, 0.0, 1.0)
    q[:, 2] = start + (take_off - start) * before
    q[:, 2] += (peak - take_off) * rise * (2 - rise) - (peak - land) * fall**2
    jumper.plant_foot(program.model, q, program.knots("flat"), program.knots("toe")[1:])
    along = q[:, 0].copy()
    q[:, 0] = BAR_X + math.cos(heading) * along
    q[:, 1] = LANE_Y + math.sin(heading) * along
    return program.guess(q, durations)
