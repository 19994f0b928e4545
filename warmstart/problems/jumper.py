"""What the two jumps share: the free joints, the held pose, pose boxes, start and key frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.interpolate import PchipInterpolator

from sports.humanoid.body import Body, Strength
from warmstart.contact import Ball, outline
from warmstart.nlp import Result
from warmstart.phases import ELASTIC_REACH
from warmstart.problems import Infeasible
from warmstart.rigid_body import ReducedModel, center_of_mass, load_tree, reduce_tree
from warmstart.solution import Solution
from warmstart.transcription import Transcription

LEGS = ("Hip_x", "Hip_y", "Hip_z", "Knee_y", "Ankle_x", "Ankle_y", "Toe_y")
FREE = (
    *(f"{side}_{joint}" for side in "LR" for joint in LEGS),
    "Torso_x",
    "Torso_y",
    "Torso_z",
    "Chest_y",
    "L_Shoulder_z",
    "R_Shoulder_z",
)
POSE = {"L_Shoulder_x": -1.25, "R_Shoulder_x": 1.25, "L_Elbow_z": -1.0, "R_Elbow_z": 1.0}
"""Arms lowered and elbows bent (rad); all joints not named in FREE or here are held at 0."""
HELD_LIMITS = (
    *(f"{side}_Knee_{axis}" for side in "LR" for axis in "xz"),
    *(f"{side}_Thorax_{axis}" for side in "LR" for axis in "xyz"),
    *(f"{side}_{dof}" for side in "LR" for dof in ("Ankle_z", "Toe_x", "Toe_z")),
    *("Spine_x", "Spine_y", "Spine_z", "Chest_x", "Chest_z"),
    *("Neck_x", "Neck_y", "Head_y"),
)
"""Held joints whose holding torque comes near its limit in stance and is therefore bounded."""
FLIGHT_LIMITS = (
    *(f"{side}_{dof}" for side in "LR" for dof in ("Knee_x", "Thorax_y", "Thorax_z")),
    *("Spine_x", "Neck_y"),
)
"""The same in flight."""
POSITION = {
    "pitch": (-0.7, 1.9),
    "roll": (-0.5, 0.5),
    "yaw": (-0.8, 0.8),
    "Hip_x": (-0.5, 0.5),
    "Hip_y": (-2.1, 0.6),
    "Hip_z": (-0.6, 0.6),
    "Knee_y": (0.05, 2.3),
    "Ankle_x": (-0.3, 0.3),
    "Ankle_y": (-0.6, 0.8),
    "Toe_y": (-0.9, 0.2),
    "Torso_x": (-0.4, 0.4),
    "Torso_z": (-0.5, 0.5),
    "Torso_y": (-0.2, 0.5),
    "Chest_y": (-0.2, 0.4),
    "L_Shoulder_z": (-2.2, 0.9),
    "R_Shoulder_z": (-0.9, 2.2),
}
"""Pose boxes (rad). Positive about +y is flexion of knee and trunk, extension of hip,
plantar flexion of the ankle; a left arm swings forward with negative, a right one with positive
shoulder z."""
RATE = {
    "x": (-1.0, 11.0),
    "y": (-1.5, 1.5),
    "z": (-7.0, 6.0),
    "pitch": (-8.0, 8.0),
    "roll": (-3.0, 3.0),
    "yaw": (-4.0, 4.0),
}
"""Rate boxes of the root (m/s, rad/s)."""


@dataclass(frozen=True)
class Config:
    """Options of both jumps. Raises ValueError for values that no jump accepts."""

    strength: Strength = "human"
    """Torque limits: ``human`` (with torque-speed lines) or ``paper``."""
    approach_speed: tuple[float, float] = (2.0, 10.5)
    """Forward speed of the centre of mass at touch-down of the take-off foot (m/s)."""
    detail: float = 1.0
    """Knots relative to the standard grid; below 1 solves faster and is less exact."""
    max_iterations: int = 300
    """IPOPT iterations before giving up."""

    def __post_init__(self) -> None:
        if not 0.3 <= self.detail <= 4.0:
            raise ValueError(f"detail must lie between 0.3 and 4, not {self.detail}")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations must be at least 1, not {self.max_iterations}")
        low, high = self.approach_speed
        if not 0.0 <= low <= high <= 11.0:
            raise ValueError(
                f"approach_speed must be a range within 0..11 m/s, not {self.approach_speed}"
            )


def scaled(detail: float) -> Callable[[int], int]:
    """Intervals of a phase at a level of detail."""
    return lambda intervals: max(3, round(intervals * detail))


def make_model(body: Body) -> ReducedModel:
    """The athlete of both jumps: 6 + 20 coordinates."""
    return reduce_tree(load_tree(body), FREE, POSE)


def boxes(table: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Boxes by coordinate name; a joint named without its side stands for both."""
    out = {}
    for name, box in table.items():
        if f"L_{name}" in FREE:
            out[f"L_{name}"], out[f"R_{name}"] = box, box
        else:
            out[name] = box
    return out


def foot(body: Body, side: str) -> list[Ball]:
    """Corners of the sole of a foot."""
    links = (f"{side}_Ankle", f"{side}_Toe")
    return [b for b in outline(body) if b.link in links and b.center[2] < -0.01]


def start_rows(
    program: Transcription,
    speed: tuple[float, float],
    sink: tuple[float, float],
    limb_rate: float,
    swing: str = "R",
    heading: float = 0.0,
) -> None:
    """The first knot is the touch-down of the take-off foot out of a run.

    Centre of mass: forward ``speed`` (m/s) along ``heading`` (rad from +x towards +y), vertical
    velocity in ``sink`` (m/s), little sideways; hinges no faster than ``limb_rate`` (rad/s);
    trunk upright, the thigh of the ``swing`` leg hardly lifted. Rates are those before the impact
    of the foot, where the program has one.
    """
    model = program.model
    rates = program.v[0] if program.before is None else program.before

    def build(q, v, p):
        _, com = center_of_mass(model.tree, model.motion(q, v))
        c, s = math.cos(heading), math.sin(heading)
        return [
            ("approach speed", c * com[0] + s * com[1], *speed),
            ("side speed", c * com[1] - s * com[0], -0.2, 0.2),
            ("sink speed", com[2], *sink),
        ]

    program.program.block("start", [program.q[:1], rates[None]], lambda *x: (0.0, build(*x)))
    program.bound(rates[6:], -limb_rate, limb_rate)
    limits = {
        "z": (0.80, 1.1),
        "pitch": (-0.45, 0.25),
        "roll": (-0.15, 0.15),
        "yaw": (heading - 0.3, heading + 0.3),
        f"{swing}_Hip_y": (-0.3, 0.6),
        "L_Shoulder_z": (-0.9, 0.9),
        "R_Shoulder_z": (-0.9, 0.9),
    }
    for name, (low, high) in limits.items():
        program.bound(program.q[0, model.index(name)], low, high)
    for name in ("pitch", "roll", "yaw"):
        program.bound(rates[model.index(name)], -2.5, 2.5)


def legs(left: Sequence[float], right: Sequence[float], **more: float) -> dict[str, float]:
    """A key pose: hip, knee, ankle and toe y of both legs (rad) and any other coordinate."""
    pose = {}
    for side, values in (("L", left), ("R", right)):
        for joint, value in zip(("Hip_y", "Knee_y", "Ankle_y", "Toe_y"), values, strict=True):
            pose[f"{side}_{joint}"] = value
    return {**pose, **more}


def key_frames(
    model: ReducedModel,
    times: Sequence[float],
    frames: Sequence[Mapping[str, float]],
    at: np.ndarray,
) -> np.ndarray:
    """(K, n) positions by monotone cubic interpolation of key poses.

    A pose names reduced coordinates; what it leaves out is 0.
    """
    poses = np.zeros((len(frames), model.n))
    for row, frame in zip(poses, frames, strict=True):
        for name, value in frame.items():
            row[model.index(name)] = value
    return PchipInterpolator(times, poses, axis=0)(np.clip(at, times[0], times[-1]))


def plant_foot(
    model: ReducedModel, q: np.ndarray, flat: np.ndarray, push: np.ndarray, side: str = "L"
) -> None:
    """Bends the leg of a side of a guess (K, n) so that its foot stays where it stands.

    Planar two-link inverse kinematics about the hip. ``flat`` and ``push``: knots with the sole
    on the ground and with the heel rising to 0.8 rad. The ankle is placed under the middle of
    the root's path, so that the leg reaches forward first and back last.
    """
    tree = model.tree
    thigh = -tree.offset[tree.link(f"{side}_Knee")][[0, 2]]
    shin = -tree.offset[tree.link(f"{side}_Ankle")][[0, 2]]
    hip = tree.offset[tree.link(f"{side}_Hip")]
    heel, sole = 0.07, tree.offset[tree.link(f"{side}_Toe")]
    a, b = np.hypot(*thigh), np.hypot(*shin)
    knots = np.concatenate([flat, push])
    anchor = 0.5 * (q[knots[0], 0] + q[knots[-1], 0]) - 0.03
    for k in knots:
        lift = 0.8 * np.clip((k - push[0]) / max(len(push) - 1, 1), 0.0, 1.0) if k in push else 0.0
        toe = np.array([anchor + sole[0], heel + sole[2]])
        ankle = toe - [
            sole[0] * np.cos(lift) + sole[2] * np.sin(lift),
            sole[2] * np.cos(lift) - sole[0] * np.sin(lift),
        ]
        pitch = q[k, 3]
        root = q[k, [0, 2]] + [
            hip[0] * np.cos(pitch) + hip[2] * np.sin(pitch),
            hip[2] * np.cos(pitch) - hip[0] * np.sin(pitch),
        ]
        d = ankle - root
        reach = min(np.hypot(*d), 0.995 * (a + b))
        bend = np.pi - np.arccos((a * a + b * b - reach * reach) / (2 * a * b))
        lean = np.arccos((a * a + reach * reach - b * b) / (2 * a * reach))
        thigh_angle = -np.arctan2(d[0], -d[1]) - lean
        shape = np.arctan2(thigh[0], thigh[1]), np.arctan2(shin[0], shin[1])
        hip_y = thigh_angle - pitch - shape[0]
        knee = bend + shape[0] - shape[1]
        angles = hip_y, knee, lift - (pitch + hip_y + knee), -lift
        for joint, angle in zip(("Hip_y", "Knee_y", "Ankle_y", "Toe_y"), angles, strict=True):
            q[k, model.index(f"{side}_{joint}")] = angle


class _Progress(ca.Callback):
    """Hands IPOPT's iterations to a plain function."""

    def __init__(self, program: Transcription, report: Callable[[int, float], None]) -> None:
        ca.Callback.__init__(self)
        self.sizes = (
            len(program.program.lower),
            sum(len(b.index) * b.rows for b in program.program.blocks),
            max(program.program.parameters, 1),
        )
        self.report, self.count = report, 0
        self.construct("progress", {})

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        n, m, p = self.sizes
        size = {"f": 1, "x": n, "lam_x": n, "g": m, "lam_g": m, "lam_p": p}
        return ca.Sparsity.dense(size[ca.nlpsol_out(i)], 1)

    def eval(self, arg):
        self.report(self.count, float(arg[1]))
        self.count += 1
        return [0]


def run(
    program: Transcription,
    start: np.ndarray,
    parameters: Sequence[float],
    neighbour: bool,
    progress: Callable[[int, float], None] | None,
    max_iterations: int = 300,
    options: dict | None = None,
) -> Result:
    """Solves a transcribed jump; a neighbour's solution starts with a small barrier."""
    options = {"ipopt.max_iter": max_iterations, **(options or {})}
    if neighbour:
        options |= {
            "ipopt.mu_strategy": "monotone",
            "ipopt.mu_init": 1e-3,
            "ipopt.bound_push": 1e-4,
            "ipopt.bound_frac": 1e-4,
        }
    callback = _Progress(program, progress) if progress else None
    if callback:
        options["iteration_callback"] = callback
    return program.program.solve(program.program.solver(options), start, parameters)


VIOLATION = 1e-5
"""A program counts as solved below this violation of its scaled rows."""
NEARLY = 1e-3
"""An elastic program below this violation tells which torque limits are short."""


def solved(result: Result) -> bool:
    """Whether the solver found an optimum, or an acceptable one, within ``VIOLATION``."""
    return result.max_violation < VIOLATION and (result.success or "Acceptable" in result.status)


def check(result: Result, what: str, elastic: Callable[[], tuple[Transcription, Result]]) -> None:
    """Raises Infeasible naming what stands in the way, found by stretching torque limits."""
    if solved(result):
        return
    program, relaxed = elastic()
    strength = program.body.strength
    if relaxed.max_violation < NEARLY:
        stretched = program.stretched(relaxed.x)
        if stretched:
            needs = ", ".join(f"{dof} {100 * share:.0f} %" for dof, share in stretched[:4])
            raise Infeasible(
                f"{what} is infeasible at strength '{strength}': the solver found no motion "
                f"within the torque limits, and one with {needs} of them; ask for less"
            )
        raise Infeasible(
            f"{what}: the solver stopped with '{result.status}' although a motion within the "
            "torque limits exists; start it from a neighbour's solution"
        )
    worst = relaxed.worst[0][0] if relaxed.worst else "no single row"
    raise Infeasible(
        f"{what}: no motion found at strength '{strength}', nor with {ELASTIC_REACH:.0f} times "
        f"its torque: '{worst}' is not met (solver: {relaxed.status})"
    )


def shown(solution: Solution) -> str:
    """One line on a solution for logs."""
    stats = solution.stats
    return (
        f"{solution.problem} {solution.asked}: {stats['status']} in {stats['solve_s']:.0f} s, "
        f"{stats['iterations']} iterations, violation {stats['max_violation']:.1e}, "
        f"objective {stats['objective']:.3f}"
    )
