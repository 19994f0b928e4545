"""Long jump: one take-off step before the line, flight, heels down at a prescribed length.

The take-off foot stands wholly before the line x = 20. Nothing touches the ground in flight.
The motion ends as both heels reach the pit a margin beyond x = 20 + length, legs in front of the
body. A jump is measured to the nearest mark of any link in the 0.3 s after that, so the rest of the
body must come down beyond the length too: each of its points, left to fall from there, does. Effort
is minimal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from sports.humanoid.body import load_body
from sports.physics.base import GRAVITY
from warmstart.contact import outline
from warmstart.nlp import Result
from warmstart.phases import Bounds, Phase
from warmstart.problems import jumper
from warmstart.rigid_body import center_of_mass
from warmstart.separation import keep_apart
from warmstart.solution import Solution
from warmstart.transcription import Transcription

LINE_X = 20.0
CARRY = 0.10
"""In the program that is solved first, the centre of mass lands behind the heels by at most its
forward speed times this (s)."""
TOUCH = 0.003
"""Height (m) at which the right heel has landed."""
RATE = jumper.RATE | {"L_Shoulder_z": (-12.0, 12.0), "R_Shoulder_z": (-12.0, 12.0)}
"""Rate boxes (m/s, rad/s): a hand does not pass through a thigh between two knots."""
FOOT_SPEED, LIFT = 3.0, 0.8
"""Before its impact the take-off foot comes down at most so fast (m/s), and the impact gives the
centre of mass at most so much upward speed (m/s): a quarter of the athlete, the distal mass of
Seyfarth 1999 (J Biomech 32:1259), brought to rest, where faster legs are found to jump further."""
FAST, FINER = 6.0, 1.25
"""Jumps from this length (m) on are settled on a grid so much finer: they stand for 65 ms only, and
on the standard grid one of 7 m left a force residual of 0.0203 body weight between its knots (0.02
is allowed) and a hand 0.022 m deep in a knee (0.02). Their hands reach past their knees as they
land, so they keep off the whole shins: jumps of 6 m had a hand 0.036 m deep in one."""
LIMB_RATE = 18.0
"""Before the impact hinges turn at most so fast (rad/s): the speed at which hip and ankle of the
strength table carry no load."""


@dataclass(frozen=True)
class Config(jumper.Config):
    """Options of the long-jump problem."""

    length: float = 5.0
    """From the line to the nearest mark (m)."""
    margin: float = 0.15
    """The plan leaves its marks so far beyond the length (m): what the landing may lose when the
    motion is followed. A plan ends as the heels touch down, so the marks of what falls behind them
    are reckoned: see ``fallen``."""
    board: float = 0.03
    """Distance of the take-off toe before the line, at least (m)."""
    approach_speed: tuple[float, float] = (3.0, 10.5)
    """Forward speed of the centre of mass at touch-down of the take-off foot (m/s)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1.0 <= self.length <= 9.5:
            raise ValueError(
                f"length must lie between 1 and 9.5 m, not {self.length}: the world record is "
                "8.95 m"
            )
        if not 0.0 <= self.margin <= 1.0:
            raise ValueError(f"margin must lie between 0 and 1 m, not {self.margin}")
        if not 0.0 <= self.board <= 0.5:
            raise ValueError(f"board must lie between 0 and 0.5 m, not {self.board}")


def fallen(place, rate, radius: float):
    """x (m) at which a ball at ``place`` (3,) with velocity ``rate`` (3,) reaches the ground when
    nothing holds it: x + v_x t with the later root t of z - r + v_z t - g t^2 / 2 = 0."""
    root = ca.sqrt(rate[2] ** 2 + 2 * GRAVITY * (place[2] - radius))
    return place[0] + rate[0] * (rate[2] + root) / GRAVITY


def transcribe(config: Config, elastic: bool = False, settled: bool = True) -> Transcription:
    """The nonlinear program; its parameter is the length. Unless ``settled``, only the centre of
    mass is carried towards the heels, and the rest of the body may come down behind them."""
    body = load_body("smpl", strength=config.strength)
    model = jumper.make_model(body)
    fast = settled and config.length >= FAST
    knots = jumper.scaled((FINER if fast else 1.0) * config.detail)
    phases = [
        Phase("flat", knots(12), (0.02, 0.25), {"L": "flat"}, grading=2.0),
        Phase("toe", knots(12), (0.025, 0.12), {"L": "toe"}),
        Phase("flight", knots(48), (0.25, 1.20), grading=3.0),
    ]
    position = jumper.boxes(jumper.POSITION) | {
        "x": (LINE_X - 3, LINE_X + 12),
        "y": (-0.5, 0.5),
        "z": (0.42, 2.5),
        "pitch": (-0.7, 1.2),
    }
    program = Transcription(
        body,
        model,
        phases,
        Bounds(position, jumper.boxes(RATE), acceleration=2000.0, hinge_rate=30.0),
        held_limits=jumper.HELD_LIMITS,
        flight_limits=jumper.FLIGHT_LIMITS,
        parameters=1,
        elastic=elastic,
    )
    keep_apart(program, body, np.arange(program.K), straight=fast)
    program.touch_down("L", FOOT_SPEED, LIFT)
    jumper.start_rows(program, config.approach_speed, sink=(-0.8, -0.1), limb_rate=LIMB_RATE)
    left, right = jumper.foot(body, "L"), jumper.foot(body, "R")
    boxes = [b for b in outline(body) if b.link.endswith(("Ankle", "Toe"))]
    corners = [b for b in boxes if b.link.startswith("L")]
    upper = [b for b in boxes if b not in left + right]  # of a foot that lands on its heel

    def behind_line(q, p):
        motion = model.motion(q)
        x = [motion.point(model.tree.link(b.link), b.center)[0] for b in corners]
        return [("board", ca.vertcat(*x) - LINE_X, -np.inf, -config.board)]

    program.rows("board", [0], behind_line)
    flight = program.knots("flight")
    program.ground(right, np.arange(program.K - 1))
    program.ground(left, flight[1:4], margin=0.0)
    program.ground(left, flight[4:-1])
    whole = outline(body, sagittal=True)
    behind = [b for b in whole if not b.link.endswith(("Knee", "Ankle", "Toe"))]
    rest = [b for b in whole if b.link in ("Pelvis", "L_Hip", "R_Hip", "L_Hand", "R_Hand")]
    program.ground(rest, flight[-8:], margin=0.05)

    def land(q, v, p):
        motion = model.motion(q, v)
        mark = LINE_X + p[0] + config.margin
        soles = [
            motion.point(model.tree.link(b.link), b.center) - ca.vertcat(mark, 0, 0)
            for b in left + right
        ]
        tops = [
            motion.point(model.tree.link(b.link), b.center) - ca.vertcat(mark, 0, 0) for b in upper
        ]
        heels = [
            s
            for s, b in zip(soles, left + right, strict=True)
            if b.link.endswith("Ankle") and b.center[0] < 0
        ]
        com, velocity = center_of_mass(model.tree, motion)
        carried = ("carried over the feet", mark - com[0] - CARRY * velocity[0], -np.inf, 0.0)
        if settled:
            falls = []
            for b in behind:
                link = model.tree.link(b.link)
                place, rate = motion.point(link, b.center), motion.point_velocity(link, b.center)
                falls.append(fallen(place, rate, b.radius))
            carried = ("falls beyond the length", ca.vertcat(*falls) - mark, 0.0, np.inf)
        return [
            ("feet over the pit", ca.vertcat(*[s[2] for s in soles + tops]), 0.0, np.inf),
            ("heels down", ca.vertcat(*[h[2] for h in heels]), 0.0, [0.03, 0.03, TOUCH, TOUCH]),
            ("heels at the length", ca.vertcat(*[h[0] for h in heels]), 0.0, 0.12),
            ("feet beyond the length", ca.vertcat(*[s[0] for s in soles + tops]), 0.0, np.inf),
            ("body behind the feet", mark - com[0], -0.2, 0.75),
            ("carried forward", velocity[0], 1.5, np.inf),
            carried,
            ("trunk over the legs", com[2], 0.45, 1.3),
        ]

    program.rows("landing", [program.K - 1], land, rates=True)
    for name, low, high in (("pitch", -0.1, 1.0), ("roll", -0.4, 0.4), ("yaw", -0.4, 0.4)):
        program.bound(program.q[-1, model.index(name)], low, high)
    return program


def first_guess(program: Transcription, length: float) -> np.ndarray:
    """Key poses of a sail-style jump along a ballistic root path."""
    off, air = 0.125, 0.40 + 0.05 * length
    durations = (0.07, off - 0.07, air)
    t = program.nominal_times(durations)
    arms = [{"L_Shoulder_z": -s, "R_Shoulder_z": s} for s in (-0.4, 0.0, 0.6, 1.5, 1.0, 0.6)]
    frames = [
        jumper.legs((-0.5, 0.35, 0.2, 0), (0.2, 1.4, 0, 0), pitch=-0.05, **arms[0]),
        jumper.legs((0.1, 0.35, -0.4, 0), (-0.7, 1.5, 0, 0), **arms[1]),
        jumper.legs((0.45, 0.1, 0.2, -0.7), (-1.3, 1.4, 0, 0), **arms[2]),
        jumper.legs((-0.2, 1.2, 0.3, 0), (-1.0, 1.0, 0, 0), **arms[3]),
        jumper.legs((-1.2, 0.8, 0, 0), (-1.2, 0.8, 0, 0), pitch=0.2, Torso_y=0.3, **arms[4]),
        jumper.legs((-1.4, 0.6, 0, 0), (-1.4, 0.6, 0, 0), pitch=0.3, Torso_y=0.4, **arms[5]),
    ]
    times = [0, 0.6 * off, off, off + 0.35 * air, off + 0.75 * air, off + air]
    q = jumper.key_frames(program.model, times, frames, t)
    start, land, take_off = 0.82, 0.62, 0.93
    speed = (length - 0.75 - 0.15) / air
    rise = (land - take_off + 4.905 * air**2) / air
    fly = np.clip(t - off, 0.0, None)
    q[:, 0] = LINE_X + 0.15 + speed * (t - off)
    q[:, 2] = np.where(
        t < off, start + (take_off - start) * (t / off) ** 2, take_off + rise * fly - 4.905 * fly**2
    )
    jumper.plant_foot(program.model, q, program.knots("flat"), program.knots("toe")[1:])
    return program.guess(q, durations)


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort jump of a length. See :meth:`warmstart.problems.Problem.solve`."""

    if guess is None:  # the rule of the fall is hard to meet from key poses
        own = _unsettled(config, progress)
        solution = solve(config, own, progress)
        spent = {k: own.stats[k] + solution.stats[k] for k in ("solve_s", "cpu_s", "iterations")}
        return replace(solution, stats=solution.stats | spent)
    start = guess

    def attempt(elastic: bool) -> tuple[Transcription, Result]:
        program = transcribe(config, elastic)
        return program, jumper.run(
            program,
            program.guess_from(start),
            [config.length],
            True,
            progress,
            config.max_iterations,
        )

    program, result = attempt(False)
    jumper.check(result, f"a jump of {config.length:g} m", lambda: attempt(True))
    return program.solution("long_jump", {"length": config.length}, result)


def _unsettled(config: Config, progress: Callable[[int, float], None] | None) -> Solution:
    """From key poses: a jump whose heels land at the length, whatever comes down behind them."""
    plain = replace(config, margin=0.0)

    def attempt(elastic: bool) -> tuple[Transcription, Result]:
        program = transcribe(plain, elastic, settled=False)
        start = first_guess(program, config.length)
        return program, jumper.run(
            program, start, [config.length], False, progress, config.max_iterations
        )

    program, result = attempt(False)
    jumper.check(result, f"a jump of {config.length:g} m", lambda: attempt(True))
    return program.solution("long_jump", {"length": config.length}, result)
