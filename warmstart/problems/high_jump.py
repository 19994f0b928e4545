"""High jump: one take-off step, a bar of prescribed height, landing on the feet beyond it.

The athlete comes down the line y = 6 (the bar spans y = 4 to 8), takes off from the left foot,
clears the bar at (20, 6) with every body point and ends as the right foot reaches the ground.
Effort is minimal. The bar's keep-out region is the parabola z = h - 8 (x - 20)^2: it contains
the bar (radius 0.025 m) and, unlike a circle, cannot be passed on the wrong side or jumped
between two knots.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import casadi as ca
import numpy as np

from sports.humanoid.body import load_body
from warmstart.contact import Ball, outline
from warmstart.nlp import Result
from warmstart.phases import Bounds, Phase
from warmstart.problems import high_jump_styles, jumper
from warmstart.separation import keep_apart
from warmstart.solution import Solution
from warmstart.transcription import Transcription

BAR_X, LANE_Y = 20.0, 6.0
_PARABOLA = 8.0
"""Curvature (1/m) of the keep-out parabola; up to 1 / (2 radius) = 20 would contain the bar."""
EASY, RAISE = 1.2, 0.05
"""A bar above EASY (m) is reached from there, raised by RAISE (m) at a time: from key poses the
solver finds no way over 1.5 m at strength human."""
_ROUGH = {"ipopt.tol": 1e-2, "ipopt.dual_inf_tol": 10.0, "ipopt.compl_inf_tol": 1e-2}
"""Optimality of the jumps on the way up; they are as feasible as the last one."""
_COVERED = ("Neck", "Thorax", "Wrist", "Spine")
"""Links whose balls lie inside the hull of their neighbours."""
_TRUNK = ("Chest", "Head", "L_Shoulder", "R_Shoulder")
"""Links that would fall back onto a low bar after the landing."""


@dataclass(frozen=True)
class Config(jumper.Config):
    """Options of the high-jump problem."""

    bar_height: float = 1.0
    """Top of the bar above the ground (m)."""
    clearance: float = 0.04
    """Least distance of the body over the bar at knots (m)."""
    approach_speed: tuple[float, float] = (2.0, 7.0)
    """Forward speed of the centre of mass at touch-down of the take-off foot (m/s)."""
    style: Literal["tuck", "scissor", "flop"] = "tuck"
    """``tuck``: straight at the bar, both legs drawn up. ``scissor``: sitting, one leg after the
    other. ``flop``: back to the bar, landing on the back."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.style not in ("tuck", "scissor", "flop"):
            raise ValueError(f"style must be tuck, scissor or flop, not {self.style}")
        if not 0.3 <= self.bar_height <= 2.6:
            raise ValueError(
                f"bar_height must lie between 0.3 and 2.6 m, not {self.bar_height}: the world "
                "record is 2.45 m"
            )
        if not 0.0 <= self.clearance <= 0.3:
            raise ValueError(f"clearance must lie between 0 and 0.3 m, not {self.clearance}")


def bar_clearance(ball: Ball, p_W, bar_height):
    """Signed clearance of a ball over the keep-out parabola (a lower bound, m)."""
    dx = p_W[0] - BAR_X
    reach = ball.radius * ca.sqrt(1 + (2 * _PARABOLA * dx) ** 2)
    return p_W[2] - bar_height + _PARABOLA * dx**2 - reach


def transcribe(config: Config, elastic: bool = False) -> Transcription:
    """The nonlinear program; its parameter is the bar's height plus the clearance."""
    if config.style != "tuck":
        return high_jump_styles.transcribe(config, elastic)
    body = load_body("smpl", strength=config.strength)
    model = jumper.make_model(body)
    knots = jumper.scaled(config.detail)
    higher = float(np.clip(config.bar_height - 1.2, 0.0, 0.4))
    turn = 2.0 * higher  # lies down over a high bar, and moves abruptly: finer knots
    phases = [
        Phase("flat", knots(11), (0.09, 0.30), {"L": "flat"}),
        Phase("toe", knots(7), (0.04, 0.15), {"L": "toe"}),
        Phase("flight", knots(28 + round(80 * higher)), (0.30, 1.20), grading=3.0),
    ]
    position = jumper.boxes(jumper.POSITION) | {
        "x": (BAR_X - 5, BAR_X + 3),
        "y": (LANE_Y - 0.5, LANE_Y + 0.5),
        "z": (0.5, 3.0),
        "roll": (-0.35 - turn, 0.35 + turn),
    }
    rate = jumper.boxes(jumper.RATE) | {"roll": (-3.0 - 5 * turn, 3.0 + 5 * turn)}
    program = Transcription(
        body,
        model,
        phases,
        Bounds(position, rate),
        held_limits=jumper.HELD_LIMITS,
        flight_limits=jumper.FLIGHT_LIMITS,
        parameters=1,
        elastic=elastic,
    )
    keep_apart(program, body, np.arange(program.K))
    jumper.start_rows(program, config.approach_speed, sink=(-1.2, -0.1), limb_rate=12.0)
    flight = program.knots("flight")
    wide = ("Ankle", "Toe", "Pelvis")
    balls = [b for b in outline(body) if b.link.endswith(wide)]
    flat = outline(body, sagittal=turn == 0.0)  # who turns shows the bar every corner
    balls += [b for b in flat if not b.link.endswith((*wide, *_COVERED))]

    def clear(q, p):
        motion = model.motion(q)
        gaps = [
            bar_clearance(b, motion.point(model.tree.link(b.link), b.center), p[0]) for b in balls
        ]
        return [("bar clearance", ca.vertcat(*gaps), 0.0, np.inf)]

    air = np.concatenate([program.knots("toe")[1:], flight[1:]])
    program.rows("bar", air, clear)
    left, right = jumper.foot(body, "L"), jumper.foot(body, "R")
    program.ground(right, np.arange(program.K - 1))
    program.ground(left, flight[1:4], margin=0.0)
    program.ground(left, flight[4:])

    def land(q, p):
        motion = model.motion(q)
        corners = [motion.point(model.tree.link(b.link), b.center) for b in right]
        trunk = [motion.point(model.tree.link(link), (0, 0, 0))[0] for link in _TRUNK]
        return [
            ("landing height", ca.vertcat(*[c[2] for c in corners]), 0.0, 0.03),
            ("landing beyond the bar", ca.vertcat(*[c[0] for c in corners]), BAR_X + 0.2, np.inf),
            ("root beyond the bar", q[0], BAR_X + 0.3, np.inf),
            ("trunk beyond the bar", ca.vertcat(*trunk), BAR_X + 0.15, np.inf),
            ("root height", q[2], 0.70, 1.2),
        ]

    program.rows("end", [program.K - 1], land)
    program.bound(program.q[-1, model.index("pitch")], -0.4, 0.7)
    program.bound(program.q[-1, model.index("roll")], -0.35, 0.35)
    return program


def first_guess(program: Transcription, bar_height: float) -> np.ndarray:
    """Key poses of a tucked hurdle-style jump along a ballistic root path."""
    durations = (0.15, 0.07, 0.65)
    t = program.nominal_times(durations)
    arms = [{"L_Shoulder_z": -s, "R_Shoulder_z": s} for s in (-0.5, 0.0, 0.8, 1.0, 0.5, 0.0)]
    frames = [
        jumper.legs((-0.5, 0.4, 0.2, 0), (0.3, 1.2, 0, 0), pitch=-0.1, **arms[0]),
        jumper.legs((0, 0.3, -0.3, 0), (-0.6, 1.3, 0, 0), **arms[1]),
        jumper.legs((0.3, 0.1, 0.3, -0.7), (-1.4, 1.5, 0, 0), **arms[2]),
        jumper.legs((-1, 1.8, 0.3, 0), (-2.0, 1.8, 0, 0), pitch=0.3, Torso_y=0.3, **arms[3]),
        jumper.legs((-1.9, 2.0, 0.3, 0), (-1.6, 1.2, 0, 0), pitch=0.3, Torso_y=0.3, **arms[4]),
        jumper.legs((-0.9, 1.2, 0, 0), (-0.5, 0.4, 0, 0), pitch=0.1, **arms[5]),
    ]
    q = jumper.key_frames(program.model, [0, 0.15, 0.22, 0.45, 0.65, 0.87], frames, t)
    speed, off, rise, height = 3.6, 0.22, 2.5 + 1.2 * (bar_height - 1.0), 0.97
    air = np.clip(t - off, 0.0, None)
    q[:, 0] = BAR_X - speed * (off + 0.29) + speed * t
    q[:, 1] = LANE_Y
    q[:, 2] = np.where(
        t < off, 0.86 + (height - 0.86) * (t / off) ** 2, height + rise * air - 4.905 * air**2
    )
    q[:, 2] = np.maximum(q[:, 2], 0.8)
    return program.guess(q, durations)


def lower_bars(bar_height: float) -> list[float]:
    """Heights (m) on the way up to a bar, lowest first; none for a bar that is easy."""
    count = math.ceil(round((bar_height - EASY) / RAISE, 6))
    return [round(EASY + RAISE * i, 6) for i in range(count)]


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort jump over the bar. See :meth:`warmstart.problems.Problem.solve`.

    The iterations and times in its stats include those of the lower bars on the way up.
    """
    results: list[Result] = []

    def attempt(
        config: Config, guess: Solution | None, elastic: bool = False, rough: bool = False
    ) -> tuple[Transcription, Result]:
        program = transcribe(config, elastic)
        if guess is not None:
            start = program.guess_from(guess)
        elif config.style == "tuck":
            start = first_guess(program, config.bar_height)
        else:
            start = high_jump_styles.first_guess(program, config.style, config.bar_height)
        result = jumper.run(
            program,
            start,
            [config.bar_height + config.clearance],
            guess is not None,
            progress,
            config.max_iterations,
            _ROUGH if rough else None,
        )
        results.append(result)
        return program, result

    for height in lower_bars(config.bar_height) if guess is None else ():
        program, result = attempt(replace(config, bar_height=height), guess, rough=True)
        if not jumper.solved(result):
            break
        guess = program.solution("high_jump", {"bar_height": height}, result)
    program, result = attempt(config, guess)
    what = f"a bar at {config.bar_height:g} m"
    jumper.check(result, what, lambda: attempt(config, guess, elastic=True))
    total = replace(
        result,
        iterations=sum(r.iterations for r in results),
        solve_s=sum(r.solve_s for r in results),
        cpu_s=sum(r.cpu_s for r in results),
    )
    asked = {"bar_height": config.bar_height}
    return program.solution("high_jump", asked, total, style=config.style)
