"""What strikes and throws share: an athlete on its feet, and what its hand does at one moment.

The athlete starts at rest on both feet, in its own frame (feet about the origin, facing +x). At
the end of the phase ``swing`` a point of a link has a prescribed place, velocity and direction (an
:class:`Event`); the phase ``follow`` brings everything near rest. Effort is minimal. A problem
turns its outcome into an event, and puts the finished motion where its sport has it
(:func:`placed`).
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np

from sports.humanoid.body import Body, Strength
from sports.physics.base import GRAVITY
from warmstart import rotation
from warmstart.contact import Ball
from warmstart.nlp import Result
from warmstart.outcome import link_poses
from warmstart.phases import Bounds, Grip, Phase, Weights
from warmstart.problems import clearance, jumper
from warmstart.rigid_body import load_tree, reduce_tree
from warmstart.solution import Solution
from warmstart.transcription import Transcription

FREE = (
    *(f"{side}_{joint}" for side in "LR" for joint in jumper.LEGS),
    *(f"Torso_{axis}" for axis in "xyz"),
    *("Spine_z", "Chest_y", "Chest_z"),
    *(f"{side}_Shoulder_{axis}" for side in "LR" for axis in "xyz"),
    *("L_Elbow_z", "R_Elbow_y", "R_Elbow_z"),
    *("R_Wrist_x", "R_Wrist_y", "R_Wrist_z"),
)
"""32 hinges: with the root the 38 degrees of freedom of a stroke."""
GIRDLE = ("R_Thorax_x", "R_Thorax_y", "R_Thorax_z")
"""The shoulder girdle of the right arm, which moves too in what is faster than a stroke."""
GIRDLE_POSITION = dict.fromkeys(GIRDLE, (-0.4, 0.4))
"""Its pose boxes (rad)."""
HELD_LIMITS = (
    *(*GIRDLE, "R_Elbow_x"),
    *("R_Hand_x", "R_Hand_y", "R_Hand_z"),
    *(f"{side}_{dof}" for side in "LR" for dof in ("Knee_x", "Knee_z", "Ankle_z")),
)
"""Held joints whose holding torque comes near its limit and is therefore bounded."""
POSITION = {
    "pitch": (-0.35, 0.6),
    "roll": (-0.4, 0.4),
    "yaw": (-1.4, 1.4),
    "Hip_x": (-0.7, 0.7),
    "Hip_y": (-1.4, 0.6),
    "Hip_z": (-0.8, 0.8),
    "Knee_y": (0.2, 1.6),
    "Ankle_x": (-0.4, 0.4),
    "Ankle_y": (-0.7, 0.6),
    "Toe_y": (-0.9, 0.2),
    "Torso_x": (-0.25, 0.25),
    "Torso_y": (-0.25, 0.45),
    "Torso_z": (-0.45, 0.45),
    "Spine_z": (-0.35, 0.35),
    "Chest_y": (-0.2, 0.35),
    "Chest_z": (-0.4, 0.4),
    "L_Shoulder_x": (-1.45, 0.9),
    "L_Shoulder_y": (-1.2, 1.2),
    "L_Shoulder_z": (-1.9, 0.0),
    "L_Elbow_z": (-2.4, -0.1),
    "R_Shoulder_x": (-0.9, 1.45),
    "R_Shoulder_y": (-1.2, 1.2),
    "R_Shoulder_z": (-0.9, 1.9),
    "R_Elbow_y": (-0.9, 0.9),
    "R_Elbow_z": (0.1, 2.4),
    "R_Wrist_x": (-0.6, 0.6),
    "R_Wrist_y": (-1.2, 1.2),
    "R_Wrist_z": (-0.9, 0.9),
}
"""Pose boxes (rad). A right arm is lowered by positive shoulder x and swings forward with positive
shoulder z; a positive right elbow z bends it; left signs are opposite."""
RATE = {
    "x": (-3.0, 3.0),
    "y": (-2.0, 2.0),
    "z": (-2.0, 2.0),
    "pitch": (-4.0, 4.0),
    "roll": (-4.0, 4.0),
    "yaw": (-9.0, 9.0),
}
"""Rate boxes of the root (m/s, rad/s)."""


SHARE = 0.93
"""Share of a torque limit that a stroke may use at knots: it is used at its peak for one knot, and
more between two."""
SHEAR = 150.0
"""Weight of the horizontal force on each foot."""
COMFORT = {
    **dict.fromkeys(("pitch", "roll", "Torso_x", "Torso_y", "Chest_y"), 0.0),
    **{f"{side}_Hip_{axis}": 0.0 for side in "LR" for axis in "xz"},
    "L_Shoulder_x": -1.1,
    "L_Shoulder_z": -0.5,
    "L_Elbow_z": -1.0,
}
"""Angles (rad) to which a small price draws the posture: upright, and an idle arm at rest."""
PRICE = 4e-3
"""Cost of a squared radian off :data:`COMFORT` at one knot."""


@dataclass(frozen=True)
class Config:
    """Options of all strikes and throws. Raises ValueError for values that none accepts."""

    strength: Strength = "human"
    """Torque limits: ``human`` (with torque-speed lines) or ``paper``."""
    detail: float = 1.0
    """Knots relative to the standard grid; below 1 solves faster and is less exact."""
    max_iterations: int = 300
    """IPOPT iterations before giving up."""

    def __post_init__(self) -> None:
        if not 0.3 <= self.detail <= 4.0:
            raise ValueError(f"detail must lie between 0.3 and 4, not {self.detail}")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations must be at least 1, not {self.max_iterations}")


@dataclass(frozen=True)
class Event:
    """What a point of a link does at the moment of the strike or the release.

    In the frame of the athlete: x forward, y left, z up, feet about the origin (m, m/s).
    """

    link: str
    point: tuple[float, float, float]
    """In the link's frame (m)."""
    axis: tuple[float, float, float]
    """A direction of the link (unit, its frame) that must point along ``normal``."""
    place: tuple[float, float, float]
    velocity: tuple[float, float, float]
    normal: tuple[float, float, float]
    fixed: tuple[int, ...] = (0, 1, 2)
    """Coordinates of ``place`` that are prescribed; the others are the optimiser's."""
    facing: bool = True
    """Whether the axis must; else the optimiser decides where it points."""
    spin: float = np.inf
    """Largest component of the link's angular velocity (rad/s)."""
    straight: float = np.inf
    """Largest acceleration of the point across ``normal``, each way (m/s^2): who is late by t
    throws at an angle off by about t times this over the speed."""

    def parameters(self) -> list[float]:
        """The program's parameters: place, velocity, normal and two directions across it."""
        n = np.array(self.normal) / np.linalg.norm(self.normal)
        across = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        across /= np.linalg.norm(across)
        rows = (self.place, self.velocity, n, across, np.cross(n, across))
        return [float(x) for row in rows for x in row]

    def at(self, time: float, x: float, y: float, yaw: float) -> dict[str, Any]:
        """The event in a solution's stats: at its time, where :func:`placed` puts it."""
        turn = rotation.exp(np.array([0.0, 0.0, yaw]))
        place, velocity, normal = (
            rotation.rotate(turn, np.array(v)) for v in (self.place, self.velocity, self.normal)
        )
        return {
            "time": time,
            "link": self.link,
            "point": list(self.point),
            "axis": list(self.axis),
            "place": (place + np.array([x, y, 0.0])).tolist(),
            "velocity": velocity.tolist(),
            "normal": normal.tolist(),
        }


PARAMETERS = 15


def boxes(
    table: Mapping[str, tuple[float, float]], free: Sequence[str]
) -> dict[str, tuple[float, float]]:
    """Boxes by coordinate name; a joint named without its side stands for both."""
    out = {}
    for name, box in table.items():
        if f"L_{name}" in free:
            out[f"L_{name}"], out[f"R_{name}"] = box, box
        elif name in free or name in ("x", "y", "z", "pitch", "roll", "yaw"):
            out[name] = box
    return out


def transcribe(
    body: Body,
    event: Event,
    phases: Sequence[Phase],
    config: Config,
    *,
    free: Sequence[str] = FREE,
    pose: Mapping[str, float] | None = None,
    position: Mapping[str, tuple[float, float]] | None = None,
    rate: Mapping[str, tuple[float, float]] | None = None,
    held_limits: Sequence[str] = HELD_LIMITS,
    tool: Sequence[Ball] = (),
    unloaded: Body | None = None,
    feet: tuple[tuple[float, float], tuple[float, float]] | None = ((0.4, 0.75), (-0.3, 0.3)),
    bounds: Mapping[str, float] | None = None,
    shear: float = SHEAR,
    comfort: Mapping[str, float] | None = None,
    grip: Grip | None = None,
    aim: Callable[[Any], Any] | None = None,
    elastic: bool = False,
) -> Transcription:
    """The nonlinear program of a strike or throw; its parameters are the event's.

    ``phases`` contain ``swing``, whose last knot is the event; ``pose`` are held angles (rad),
    ``position`` and ``rate`` boxes that differ from :data:`POSITION` and :data:`RATE`; ``tool`` are
    balls around what is held, ``unloaded`` is the body in phases without it; ``feet``: how far the
    left foot stands to the left of and ahead of the right one (m), None where the problem says
    itself how it stands; ``comfort`` are angles (rad) in place of :data:`COMFORT`; ``grip``: two
    hands at one thing; ``aim`` gives the velocity of the event by its place (3x1), where that is
    not prescribed.
    """
    model = reduce_tree(load_tree(body), free, pose or {})
    place = boxes({**POSITION, **(position or {})}, free)
    place |= {"x": (-0.6, 0.6), "y": (-0.5, 0.5), "z": (0.6, 1.02)} | {
        k: v for k, v in (position or {}).items() if k in "xyz"
    }
    program = Transcription(
        body,
        model,
        phases,
        Bounds(
            place,
            boxes({**RATE, **(rate or {})}, free),
            **{"hinge_rate": 35.0, "acceleration": 1000.0, "torque_share": SHARE, **(bounds or {})},
        ),
        Weights(shear=shear),
        held_limits=held_limits,
        parameters=PARAMETERS,
        elastic=elastic,
        standing=True,
        unloaded=reduce_tree(load_tree(unloaded), free, pose or {}) if unloaded else None,
        grip=grip,
    )
    at = int(program.knots("swing")[-1])
    link = model.tree.link(event.link)

    def strike(q, v, p):
        motion = model.motion(q, v)
        axis = motion.R_WL[link] @ ca.DM(list(event.axis))
        here = motion.point(link, event.point)
        velocity = p[3:6] if aim is None else aim(here)
        rows = [] if event.spin == np.inf else [("spin", motion.w[link], -event.spin, event.spin)]
        if event.fixed:
            rows.append(("place", (here - p[:3])[list(event.fixed)] / 0.1, 0.0, 0.0))
        off = motion.point_velocity(link, event.point) - velocity
        rows.append(("velocity", off / 5.0, 0.0, 0.0))
        if not event.facing:
            return rows
        return [
            *rows,
            ("direction", ca.vertcat(ca.dot(axis, p[9:12]), ca.dot(axis, p[12:15])), 0.0, 0.0),
            ("facing", ca.dot(axis, p[6:9]), 0.5, np.inf),
        ]

    program.rows("event", [at], strike, rates=True)

    def pull(q, v, a, p):
        motion = model.motion(q, v, a)
        c, w = ca.DM(list(event.point)), motion.w[link]
        own = motion.acc[link] + ca.cross(motion.alpha[link], c) + ca.cross(w, ca.cross(w, c))
        total = motion.R_WL[link] @ own - ca.DM([0.0, 0.0, GRAVITY])
        across = ca.vertcat(ca.dot(total, p[9:12]), ca.dot(total, p[12:15]))
        return 0.0, [("straight", across / 100.0, -event.straight / 100.0, event.straight / 100.0)]

    if event.straight < np.inf:
        here = [program.q[[at]], program.v[[at]], program.a[[at]]]
        program.program.block("event pull", here, pull)
    rest(program)
    everywhere = np.arange(program.K)
    if feet is not None:
        stance(program, body, *feet)
    clearance.arms_off(program, body, everywhere)
    loaded = np.array([k for k in everywhere if program.model_at(int(k)) is model])
    if tool:
        clearance.tool_off(program, body, tool, loaded)
    comfort = COMFORT if comfort is None else comfort
    wanted = {model.index(name): angle for name, angle in comfort.items() if name in model.names}
    where, angles = list(wanted), ca.DM(list(wanted.values()))
    program.cost(
        "posture",
        everywhere,
        lambda q, v, p: PRICE / config.detail * ca.sumsqr(q[where] - angles),
    )
    return program


def rest(program: Transcription, end_rate: float = 2.5) -> None:
    """At rest at the first knot, nearly so at the last one, with the mass over the feet there."""
    program.fix(program.v[0], 0.0)
    program.bound(program.v[-1, 6:], -end_rate, end_rate)
    program.bound(program.v[-1, :3], -0.3, 0.3)
    program.bound(program.v[-1, 3:6], -1.0, 1.0)


def stance(
    program: Transcription,
    body: Body,
    apart: tuple[float, float],
    ahead: tuple[float, float],
    knot: int = 0,
) -> None:
    """The feet at a knot: the left one ``apart`` (m) to the left of and ``ahead`` (m) of
    the right one; the athlete between them."""
    model = program.model
    ankles = [model.tree.link(f"{side}_Ankle") for side in "LR"]

    def feet(q, p):
        motion = model.motion(q)
        left, right = (motion.p_WL[i] for i in ankles)
        return [
            ("feet apart", left[1] - right[1], *apart),
            ("foot ahead", left[0] - right[0], *ahead),
            ("between the feet", (left + right)[:2] / 2, -0.02, 0.02),
        ]

    program.rows("stance", [knot], feet)


def both_feet(program: Transcription, share: float, price: float) -> None:
    """Each foot carries at least a ``share`` of the weight, and by a ``price`` evenly over its
    sole."""
    least = share * program.weight
    for side, forces in program.f.items():
        up = np.array([index[:, 2] for index in forces.values()])

        def carried(f, p):
            rows = [("weight on both feet", ca.sum1(f) / least, 1.0, np.inf)]
            return price * ca.sumsqr(f / program.weight), rows

        program.program.block(f"load {side}", [up], carried)


def key_guess(program: Transcription, name: str, durations: Sequence[float]) -> np.ndarray:
    """A first guess from key poses (``keys/NAME.csv``) and the durations of the phases (s).

    The first column is a time: 0 at the start, 1 at the event, 2 at the end; the others are
    reduced coordinates by name. The poses are those of an earlier solution, rounded to 0.01: a
    program without them takes two to five times as long.
    """
    text = resources.files("warmstart.problems").joinpath("keys", f"{name}.csv").read_text()
    rows = list(csv.DictReader(text.splitlines()))
    times = [float(row.pop("time")) for row in rows]
    frames = [{k: float(v) for k, v in row.items() if k in program.model.names} for row in rows]
    at = program.nominal_times(durations)
    event = float(at[program.knots("swing")[-1]])
    seconds = np.interp(times, (0.0, 1.0, 2.0), np.array([0.0, event, at[-1]])).tolist()
    return program.guess(jumper.key_frames(program.model, seconds, frames, at), durations)


def solve(
    name: str,
    asked: dict[str, float],
    event: Event,
    transcribed: Callable[[bool], Transcription],
    guessed: Callable[[Transcription], np.ndarray],
    guess: Solution | None,
    config: Config,
    progress: Callable[[int, float], None] | None,
    what: str,
    where: tuple[float, float, float] = (0.0, 0.0, 0.0),
    thrown: tuple[str, float] | None = None,
    finish: Callable[[Solution, dict[str, Any]], dict[str, Any]] | None = None,
    **stats: object,
) -> Solution:
    """The least-effort motion with an event, put at ``where`` (x, y, yaw) of its sport.

    ``transcribed(elastic)`` makes the program, ``guessed`` a first guess of it; ``guess`` is a
    neighbour's solution; ``thrown`` names what leaves the hand, and in which time (s); ``finish``
    tells what the optimiser decided about the event, whose place is known. Raises
    Infeasible, saying ``what`` was asked for.
    """

    def attempt(elastic: bool) -> tuple[Transcription, Result]:
        program = transcribed(elastic)
        start = guessed(program) if guess is None else program.guess_from(unplaced(guess))
        return program, jumper.run(
            program, start, event.parameters(), guess is not None, progress, config.max_iterations
        )

    program, result = attempt(False)
    jumper.check(result, what, lambda: attempt(True))
    time = float(program.times(result.x)[program.knots("swing")[-1]])
    if thrown is not None:
        stats["payload"] = {"equipment": thrown[0], "held": time, "gone": time + thrown[1]}
    stats["options"] = asdict(config)
    solution = program.solution(name, asked, result, placed=list(where), **stats)
    at = event.at(time, *where)
    free = [i for i in range(3) if i not in event.fixed]
    solution = placed(solution, *where)
    if free:  # where the optimiser put it
        here = place_of(solution, at)
        at["place"] = [float(here[i]) if i in free else at["place"][i] for i in range(3)]
    if finish is not None:
        at |= finish(solution, at)
    return replace(solution, stats=solution.stats | {"event": at})


def place_of(solution: Solution, event: dict[str, Any]) -> np.ndarray:
    """(3,) where the event's point is at its time (m)."""
    pos, quat = _link_of(solution, event)
    return pos + rotation.rotate(quat, np.array(event["point"]))


def axis_of(solution: Solution, event: dict[str, Any]) -> np.ndarray:
    """(3,) where the event's axis points at its time (unit)."""
    return rotation.rotate(_link_of(solution, event)[1], np.array(event["axis"]))


def _link_of(solution: Solution, event: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    pos, quat = link_poses(solution.body, solution.sample(np.array([event["time"]]))["qpos"])
    link = solution.body.link_index(event["link"])
    return pos[0, link], quat[0, link]


def unplaced(solution: Solution) -> Solution:
    """A solution in the athlete's own frame: undoes :func:`placed`."""
    x, y, yaw = solution.stats.get("placed", (0.0, 0.0, 0.0))
    c, s = np.cos(yaw), np.sin(yaw)
    return placed(solution, -(c * x + s * y), s * x - c * y, -yaw)


def placed(solution: Solution, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Solution:
    """The same motion turned by ``yaw`` (rad) about the world's z axis, then shifted (m)."""
    turn = rotation.exp(np.array([0.0, 0.0, yaw]))
    qpos, qvel, qacc = solution.qpos.copy(), solution.qvel.copy(), solution.qacc.copy()
    qpos[:, :3] = rotation.rotate(turn, qpos[:, :3]) + np.array([x, y, 0.0])
    qpos[:, 3:7] = rotation.multiply(np.broadcast_to(turn, (len(qpos), 4)), qpos[:, 3:7])
    qvel[:, :3], qacc[:, :3] = (
        rotation.rotate(turn, qvel[:, :3]),
        rotation.rotate(turn, qacc[:, :3]),
    )
    force = rotation.rotate(turn, solution.contact_force)
    return replace(solution, qpos=qpos, qvel=qvel, qacc=qacc, contact_force=force)
