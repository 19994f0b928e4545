"""Hurdling: one hurdle of prescribed height cleared at a prescribed run speed.

The motion begins as the take-off foot touches down before the first hurdle of the lane, leaves the
ground over its toes, carries every body point over the hurdle and ends as the ball of the other
foot, that of the lead leg, reaches the ground beyond it at about the speed of the run. A ``cycle``
goes on from there (:mod:`warmstart.problems.recovery_step`): over that foot and on to the next
touch-down of the take-off foot, at about the same speed. Effort is minimal. The keep-out region is
the parabola through the upper edges of the hurdle, z = h + c (d^2 - (x - x_hurdle)^2) with d half
its thickness: it contains the hurdle down to the ground, and nothing jumps it between two knots.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import casadi as ca
import numpy as np

from sports.humanoid.body import load_body
from sports.hurdling import FIRST_X, HALF_THICKNESS, RACE_HEIGHT
from warmstart.contact import Ball, outline
from warmstart.nlp import Result
from warmstart.phases import Bounds, Phase
from warmstart.problems import jumper, recovery_step
from warmstart.rigid_body import center_of_mass, load_tree, reduce_tree
from warmstart.separation import axis_balls, keep_apart
from warmstart.solution import Solution
from warmstart.transcription import Transcription

_PARABOLA = 8.0
"""Curvature c (1/m) of the keep-out parabola; it meets the ground 0.37 m from a hurdle of 1.067 m,
where nobody treads."""
_COVERED = ("Neck", "Thorax", "Wrist", "Spine")
"""Links whose balls lie inside the hull of their neighbours."""
NARROW = 0.3
"""The athlete's root stays this close to the middle of the lane (m)."""
POSE = jumper.POSE | {"L_Shoulder_x": -1.0, "R_Shoulder_x": 1.0}
"""Held joints (rad): the arms are held wider than in a jump, as a spread leg comes up to them."""
POSITION = jumper.POSITION | {"Hip_z": (-0.8, 0.8)}
SPREAD, ADDUCED, LEAD = 1.5, -0.5, (-0.6, 0.5)
"""Boxes of the hips' x (rad; positive spreads a left leg): the trail leg passes the hurdle spread
to its side by up to SPREAD."""
RATE = jumper.RATE | {"L_Shoulder_z": (-12.0, 12.0), "R_Shoulder_z": (-12.0, 12.0)}
OVERLAP = 0.01
"""How far (m) balls of forearm and thigh may overlap; the certificate allows two limbs 0.02."""
TOUCH = 0.004
"""Height (m) at which the ball of the lead foot has landed."""
COARSE = 0.5
"""``detail`` with which a cycle is solved first. On the whole grid key poses led astray: to a cost
of 1830 instead of 27, after 279 iterations."""
REST = 0.3
"""Speed (m/s) of the lead foot at the end of the stride from which a cycle is begun, where it shall
stand."""
FOOT_SPEED = 4.0
"""The lead foot comes down no faster than this, and sweeps over the ground no faster (m/s)."""


@dataclass(frozen=True)
class Config(jumper.Config):
    """Options of the hurdling problem."""

    hurdle_height: float = RACE_HEIGHT
    """Top of the hurdle above the ground (m); the races have 0.762 to 1.067."""
    run_speed: float = 6.0
    """Forward speed of the centre of mass at touch-down of the take-off foot (m/s)."""
    speed_loss: float = 0.4
    """By how much the speed at the landing, and at the end of a cycle, may differ from that
    (m/s)."""
    cycle: bool = True
    """Whether the stance of the lead leg and the next step of the trail leg follow, to the end of
    the stride cycle."""
    lead: Literal["right", "left"] = "right"
    """The leg that passes the hurdle first; the other foot takes off."""
    clearance: float = 0.04
    """Least distance of the body over the keep-out region at knots (m)."""
    approach_speed: tuple[float, float] = (0.0, 11.0)
    """Bounds that ``run_speed`` must respect (m/s)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.3 <= self.hurdle_height <= 1.2:
            raise ValueError(
                f"hurdle_height must lie between 0.3 and 1.2 m, not {self.hurdle_height}: "
                "the highest of a race are 1.067 m"
            )
        low, high = max(3.0, self.approach_speed[0]), min(10.0, self.approach_speed[1])
        if not low <= self.run_speed <= high:
            raise ValueError(
                f"run_speed must lie between {low:g} and {high:g} m/s, not {self.run_speed}: "
                "hurdlers run at 8 to 9"
            )
        if self.lead not in ("right", "left"):
            raise ValueError(f"lead must be right or left, not {self.lead}")
        if not 0.0 < self.speed_loss <= 2.0:
            raise ValueError(f"speed_loss must lie between 0 and 2 m/s, not {self.speed_loss}")
        if not 0.0 <= self.clearance <= 0.2:
            raise ValueError(f"clearance must lie between 0 and 0.2 m, not {self.clearance}")

    @property
    def legs(self) -> tuple[str, str]:
        """Sides of the take-off and of the lead leg."""
        return ("L", "R") if self.lead == "right" else ("R", "L")


def outward(side: str, low: float, high: float) -> tuple[float, float]:
    """A box of a hinge that turns about x or z, given as it is for the left side."""
    return (low, high) if side == "L" else (-high, -low)


def hurdle_clearance(ball: Ball, p_W, height):
    """Signed clearance of a ball over the keep-out parabola (a lower bound, m)."""
    dx = p_W[0] - FIRST_X
    top = height + _PARABOLA * (HALF_THICKNESS**2 - dx**2)
    return p_W[2] - top - ball.radius * ca.sqrt(1 + (2 * _PARABOLA * dx) ** 2)


def transcribe(
    config: Config, elastic: bool = False, foot_speed: float = FOOT_SPEED
) -> Transcription:
    """The nonlinear program; its parameter is the hurdle's height plus the clearance.

    ``foot_speed`` (m/s): the foot on whose touch-down the motion ends is no faster.
    """
    body = load_body("smpl", strength=config.strength)
    model = reduce_tree(load_tree(body), jumper.FREE, POSE)
    knots = jumper.scaled(config.detail)
    push, lead = config.legs
    phases = [
        Phase("flat", knots(10), (0.02, 0.20), {push: "flat"}, grading=2.0),
        Phase("toe", knots(10), (0.03, 0.15), {push: "toe"}),
        Phase("flight", knots(50), (0.25, 0.80), grading=2.0),
        *(recovery_step.phases(knots, lead) if config.cycle else []),
    ]
    position = jumper.boxes(POSITION) | {
        "x": (FIRST_X - 5, FIRST_X + (7 if config.cycle else 4)),
        "y": (-NARROW, NARROW),
        "z": (0.6, 2.0),
        "pitch": (-0.5, 1.2),
        f"{push}_Hip_x": outward(push, ADDUCED, SPREAD),
        f"{lead}_Hip_x": outward(push, *LEAD),
    }
    program = Transcription(
        body,
        model,
        phases,
        Bounds(position, jumper.boxes(RATE), acceleration=1000.0, hinge_rate=25.0),
        held_limits=jumper.HELD_LIMITS,
        flight_limits=jumper.FLIGHT_LIMITS,
        parameters=1,
        elastic=elastic,
    )
    keep_apart(program, body, np.arange(program.K))
    speed = (config.run_speed - 0.05, config.run_speed + 0.05)
    jumper.start_rows(program, speed, sink=(-0.8, 0.0), limb_rate=16.0, swing=lead)
    down = int(program.knots("flight")[-1])
    _over_the_hurdle(program, config)
    _touch_down(program, config, down, lead, foot_speed)
    if config.cycle:
        recovery_step.rows(program, push, lead)
        _touch_down(program, config, program.K - 1, push, foot_speed)
    for end in (0, down):
        program.bound(program.q[end, model.index("Torso_x")], -0.15, 0.15)
        program.bound(program.q[end, model.index("Torso_z")], -0.35, 0.35)
    program.bound(program.q[0, model.index("pitch")], -0.25, 0.25)
    return program


def _over_the_hurdle(program: Transcription, config: Config) -> None:
    """Nothing but the standing foot touches the ground, nothing the hurdle."""
    body, model, flight = program.body, program.model, program.knots("flight")
    push, lead = config.legs
    wide = ("Ankle", "Toe", "Pelvis", *(("Hand",) if config.cycle else ()))
    balls = [b for b in outline(body) if b.link.endswith(wide)]
    balls += [b for b in outline(body, sagittal=True) if not b.link.endswith((*wide, *_COVERED))]

    def clear(q, p):
        motion = model.motion(q)
        gaps = [
            hurdle_clearance(b, motion.point(model.tree.link(b.link), b.center), p[0])
            for b in balls
        ]
        return [("hurdle clearance", ca.vertcat(*gaps), 0.0, np.inf)]

    air = np.concatenate([program.knots("toe")[1:], flight[1:]])
    near = flight
    if config.cycle:  # the trail leg is still behind the athlete as the lead foot lands
        air = np.concatenate([air, program.knots("land")[1:]])
        near = np.arange(flight[0], program.K)
    program.rows("hurdle", air, clear)
    _forearm_off_the_thigh(program, push, near)
    if not config.cycle:
        program.ground(jumper.foot(body, lead), np.arange(flight[-1]))
    program.ground(jumper.foot(body, push), flight[1:4], margin=0.0)
    program.ground(jumper.foot(body, push), flight[4:])


def _forearm_off_the_thigh(program: Transcription, side: str, knots: np.ndarray) -> None:
    """The thigh of the trail leg comes up to the forearm of its side as nobody else's does."""
    body, model = program.body, program.model
    arm, thigh = (axis_balls(body, f"{side}_{link}", 3) for link in ("Elbow", "Hip"))

    def apart(q, p):
        motion = model.motion(q)
        at = {b: motion.point(model.tree.link(b.link), b.center) for b in (*arm, *thigh)}
        gaps = [
            ca.sumsqr(at[a] - at[b]) - (a.radius + b.radius - OVERLAP) ** 2
            for a in arm
            for b in thigh
        ]
        return [("forearm off the thigh", ca.vertcat(*gaps) / 0.05, 0.0, np.inf)]

    program.rows("forearm off the thigh", knots, apart)


def _touch_down(
    program: Transcription, config: Config, knot: int, side: str, foot_speed: float
) -> None:
    """A knot at which the ball of a foot reaches the ground under a body that runs on."""
    body, model = program.body, program.model
    other = "L" if side == "R" else "R"
    sole = jumper.foot(body, side)
    stands = knot < program.K - 1  # then the foot is placed with its contact

    def land(q, v, p):
        motion = model.motion(q, v)
        com, velocity = center_of_mass(model.tree, motion)
        at = [motion.point(model.tree.link(b.link), b.center) for b in sole]
        speed = [motion.point_velocity(model.tree.link(b.link), b.center) for b in sole]
        ball = [p_W for p_W, b in zip(at, sole, strict=True) if b.link.endswith("Toe")]
        rear = [p_W for p_W, b in zip(at, sole, strict=True) if b.link.endswith("Ankle")]
        behind, ahead = [x[0] for x in rear], [x[0] for x in ball]
        slide = [s[0] for s in speed]
        fall = [s[2] for s in speed]
        down = ("ball of the foot down", ca.vertcat(*[x[2] for x in ball]), 0.0, TOUCH)
        slow = [
            ("foot slides", ca.vertcat(*slide), -foot_speed, foot_speed),
            ("foot comes down", ca.vertcat(*fall), -foot_speed, 0.0),
        ]
        return [
            *([] if stands else [down]),
            ("heel", ca.vertcat(*[x[2] for x in rear]), 0.0, 0.12),
            ("foot beyond the hurdle", ca.vertcat(*behind), FIRST_X + 0.4, np.inf),
            ("foot under the body", ca.vertcat(*ahead) - com[0], -0.25, 0.40),
            *([] if stands else slow),
            (
                "speed after the hurdle",
                velocity[0],
                config.run_speed - config.speed_loss,
                config.run_speed + config.speed_loss,
            ),
            ("side speed after the hurdle", velocity[1], -0.3, 0.3),
            ("sink after the hurdle", velocity[2], -2.5, 0.0),
        ]

    program.rows("touch-down", [knot], land, rates=True)
    q = program.q[knot]
    for name, low, high in (
        ("z", 0.80, 1.1),
        ("pitch", -0.2, 0.6),
        ("roll", -0.25, 0.25),
        ("yaw", -0.4, 0.4),
        (f"{side}_Knee_y", 0.05, 0.7),
        (f"{other}_Hip_x", *outward(other, -0.3, 0.6)),
        ("L_Shoulder_z", -1.2, 0.9),
        ("R_Shoulder_z", -0.9, 1.2),
    ):
        program.bound(q[model.index(name)], low, high)
    for name in ("pitch", "roll", "yaw"):
        program.bound(program.v[knot, model.index(name)], -3.0, 3.0)


def first_guess(program: Transcription, config: Config) -> np.ndarray:
    """Key poses of a hurdler along a ballistic root path."""
    off, air = 0.13, 0.46
    durations = (0.065, off - 0.065, air)
    t = program.nominal_times(durations)
    arms = [{"L_Shoulder_z": -s, "R_Shoulder_z": s} for s in (-0.3, 0.0, 0.6, 0.9, 0.6, 0.0)]
    push, _ = config.legs
    spread = f"{push}_Hip_x", 1.0 if push == "L" else -1.0
    poses = [  # of the take-off leg and of the lead leg; how far the trail leg is spread
        ((-0.5, 0.35, 0.2, 0), (0.2, 1.4, 0, 0), 0.0, {}),
        ((0.1, 0.35, -0.4, 0), (-0.7, 1.5, 0, 0), 0.0, {"pitch": 0.1}),
        ((0.45, 0.1, 0.2, -0.7), (-1.4, 1.4, 0, 0), 0.0, {"pitch": 0.2}),
        ((0.0, 1.3, 0.2, 0), (-1.7, 0.5, 0, 0), 0.9, {"pitch": 0.5, "Torso_y": 0.3}),
        ((-0.8, 1.7, 0, 0), (-1.2, 0.4, 0, 0), 1.0, {"pitch": 0.4, "Torso_y": 0.3}),
        ((-1.2, 1.5, 0, 0), (-0.2, 0.2, 0.2, 0), 0.2, {"pitch": 0.1}),
    ]
    frames = []
    for (first, second, wide, trunk), arm in zip(poses, arms, strict=True):
        left, right = (first, second) if push == "L" else (second, first)
        frames.append(jumper.legs(left, right, **{spread[0]: wide * spread[1]}, **trunk, **arm))
    times = [0, 0.5 * off, off, off + 0.45 * air, off + 0.7 * air, off + air]
    q = jumper.key_frames(program.model, times, frames, t)
    start, take_off, land = 0.86, 1.0, 0.95
    rise = (land - take_off + 4.905 * air**2) / air
    fly = np.clip(t - off, 0.0, None)
    before = 0.55 * config.run_speed * air  # take-off is further from the hurdle than landing
    q[:, 0] = FIRST_X - before + config.run_speed * (t - off)
    q[:, 2] = np.where(
        t < off, start + (take_off - start) * (t / off) ** 2, take_off + rise * fly - 4.905 * fly**2
    )
    jumper.plant_foot(program.model, q, program.knots("flat"), program.knots("toe")[1:], push)
    return program.guess(q, durations)


def extended_guess(program: Transcription, config: Config, stride: Solution) -> np.ndarray:
    """A start point of a cycle: a solved stride over the hurdle, key poses from its landing on."""
    first = transcribe(replace(config, cycle=False))
    known, n = first.guess_from(stride), first.K - 1
    q = np.zeros((program.K, program.model.n))
    q[: n + 1] = known[first.q]
    durations = [stride.times[b] - stride.times[a] for _, a, b, _ in stride.phases]
    durations += recovery_step.DURATIONS
    t = program.nominal_times(durations)
    recovery_step.go_on(program, q, t, n, config.run_speed, config.legs)
    x = program.guess(q, durations)
    for mine, its in (
        (program.q, first.q),
        (program.v, first.v),
        (program.a, first.a),
        (program.u, first.u),
    ):
        x[mine[:n]] = known[its[:n]]
    for side in first.sides:
        for k, index in first.f[side].items():
            x[program.f[side][k]] = known[index]
    return x


def solve(
    config: Config,
    guess: Solution | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """The least-effort clearance. See :meth:`warmstart.problems.Problem.solve`.

    A cycle without a guess comes in three stages, of which the figures are the sum: a coarse stride
    that ends on a foot nearly at rest, the coarse cycle, the cycle.
    """
    if guess is not None:
        return _solved(config, lambda program: program.guess_from(guess), True, progress)
    if not config.cycle:
        return _solved(config, lambda program: first_guess(program, config), False, progress)
    coarse = replace(config, detail=min(config.detail, COARSE))
    plain = replace(coarse, cycle=False)
    stride = _solved(plain, lambda program: first_guess(program, plain), False, progress, REST)
    whole = _solved(
        coarse, lambda program: extended_guess(program, coarse, stride), False, progress
    )
    stages = [stride, whole]
    if config.detail > COARSE:
        stages.append(_solved(config, lambda program: program.guess_from(whole), True, progress))
    names = "solve_s", "cpu_s", "iterations"
    spent = {name: round(sum(s.stats[name] for s in stages), 2) for name in names}
    return replace(stages[-1], stats=stages[-1].stats | spent)


def _solved(
    config: Config,
    start: Callable[[Transcription], np.ndarray],
    neighbour: bool,
    progress: Callable[[int, float], None] | None,
    foot_speed: float = FOOT_SPEED,
) -> Solution:
    """One program from a start; raises Infeasible."""

    def attempt(elastic: bool) -> tuple[Transcription, Result]:
        program = transcribe(config, elastic, foot_speed)
        parameters = [config.hurdle_height + config.clearance]
        return program, jumper.run(
            program, start(program), parameters, neighbour, progress, config.max_iterations
        )

    program, result = attempt(False)
    what = f"a hurdle of {config.hurdle_height:g} m at {config.run_speed:g} m/s"
    jumper.check(result, what, lambda: attempt(True))
    asked = {"hurdle_height": config.hurdle_height, "run_speed": config.run_speed}
    if config.cycle:
        asked["stride_cycle"] = 1.0
    return program.solution("hurdling", asked, result)
