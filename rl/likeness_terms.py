"""Figures of a single motion that tell exploits from people: jerk, skating, sinking, effort.

All but the effort are taken from the path at 30 frames a second by differences, so that captured
and simulated motions are treated alike.

* ``jerk``: ln(D^3 / v_peak^2 integral |j|^2 dt) of the paths of head, hands and feet against the
  pelvis, and of the pelvis less its mean velocity, in windows of D = 1 s: the log dimensionless
  jerk of Balasubramanian et al. 2015 (J NeuroEng Rehabil 12:112) with its sign turned, so that more
  is rougher. It does not depend on how far or how fast, so a sprint may be as smooth as a stroll.
  Windows in which a part hardly moves (peak below 0.2 m/s) say nothing and are left out.
* ``skating``: m/s at which a foot on the ground slides. A foot is down while its lowest point is
  within 1.5 cm of the ground; of the points of its sole below 3 cm the slowest counts, so that a
  foot that rolls or turns on its ball does not slide. What lasts less than two frames does not
  count: touch-down and take-off fall between frames, and a sprinter's foot is down for three.
* ``penetration``: m that the lowest point of the body is below the ground, in one frame of twenty
  more.
* ``torque``, ``torque_rate``, ``power``: the largest share of what a person has, see ``effort``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch

from rl.likeness_motion import Drive, Motion, moving_dofs
from rl.motion import DOWN, LinkMotion, link_motion
from sports.humanoid.body import Body, load_body
from sports.physics.base import Geometry
from warmstart.library import FPS

WINDOW = 31
"""Frames of a window: one second from the first to the last."""
STRIDE = 15
"""Frames from one window to the next."""
KEY_LINKS = ("Head", "L_Wrist", "R_Wrist", "L_Ankle", "R_Ankle")
STILL = 0.2
"""m/s; a path whose fastest moment is slower has no jerk to speak of."""
LOW = 0.03
"""m; points of a sole that are lower slide with it, while its lowest is below ``DOWN``."""
FEET = (("L_Ankle", "L_Toe"), ("R_Ankle", "R_Toe"))
PERCENTILE = 95.0
"""Of a motion's frames: a figure of effort that is exceeded in one frame of twenty."""
TORQUE_RISE = 20.0
"""Largest torques (of the human table) per second: ten, because the fastest contraction takes
about 0.1 s to its full torque (Maffiuletti et al. 2016, Eur J Appl Physiol 116:1091), and as many
for the antagonists that let go. An estimate, of joints that are held still; what moving people show
is a third more (``rl.likeness.HUMAN_LIMITS``)."""
LEG_AXES = ("Hip_y", "Knee_y", "Ankle_y")
UNMEASURED = (
    "Hand",
    "Toe",
    "Thorax",
    "Knee_x",
    "Knee_z",
    "Ankle_x",
    "Ankle_z",
    "Elbow_x",
    "Elbow_y",
)
"""Links and dofs whose limits in the human table are structural or estimates (docs/strength.md):
torque and its rate are not judged by them. With them a policy of strength ``paper`` would be judged
by its hands, at 20 times a guess."""

UNITS = {
    "jerk": "ln",
    "skating": "m/s",
    "penetration": "m",
    "torque": "human limits",
    "torque_rate": "human limits",
    "power": "human limits",
    "torque_per_kg": "N m/kg",
    "torque_rate_per_kg": "N m/kg/s",
    "power_per_kg": "W/kg",
}
"""Figures of a motion."""
EFFORT = tuple(UNITS)[3:]
"""Those that need torques."""


def figures(motion: Motion) -> dict[str, float]:
    """The figures of ``UNITS``; NaN for one that the motion does not tell."""
    body = _table(motion.body)
    links = path(motion)
    out = {
        "jerk": jerk(body, links),
        "skating": skating(body, links),
        "penetration": penetration(body, links),
    }
    drive = motion.drive
    return out | (effort(body, drive) if drive is not None else dict.fromkeys(EFFORT, np.nan))


def path(motion: Motion) -> LinkMotion:
    """Places and attitudes of all links in the T frames of a motion, without a frame behind it."""
    found = link_motion(_table(motion.body), motion.qpos, FPS)
    return LinkMotion(**{name: x[:-1] for name, x in vars(found).items()})


def windows(frames: int) -> range:
    """First frames of the windows of a motion."""
    return range(0, frames - WINDOW + 1, STRIDE)


def jerk(body: Body, links: LinkMotion) -> float:
    """Mean log dimensionless jerk of the windows and parts that move; NaN without any."""
    root = links.pos[:, 0]
    parts = [links.pos[:, body.link_index(name)] - root for name in KEY_LINKS]
    values = []
    for start in windows(len(root)):
        rows = slice(start, start + WINDOW)
        pelvis = root[rows]
        drift = (pelvis[-1] - pelvis[0]) / (WINDOW - 1)
        steady = pelvis - np.arange(WINDOW)[:, None] * drift
        values += [log_dimensionless_jerk(p, FPS) for p in (steady, *(x[rows] for x in parts))]
    return _mean(values)


def log_dimensionless_jerk(place: np.ndarray, fps: float) -> float:
    """ln(D^3 / v_peak^2 integral |j|^2 dt) of places (T, 3) (m); NaN where it rests."""
    speed = np.linalg.norm(np.diff(place, axis=0), axis=1) * fps
    if speed.max() < STILL:
        return float("nan")
    third = np.diff(place, 3, axis=0) * fps**3
    duration = (len(place) - 1) / fps
    integral = np.mean((third**2).sum(1)) * duration
    # A motion of constant acceleration has none: the floor keeps the logarithm finite.
    return float(np.log(max(duration**3 / speed.max() ** 2 * integral, 1e-3)))


def skating(body: Body, links: LinkMotion) -> float:
    """Mean speed (m/s) of feet on the ground; NaN for a motion that never stands."""
    geometry = _geometry(body.name)
    points = _points(geometry, links)
    height = points[..., 2] - geometry.radii.double().numpy()
    step = np.linalg.norm(np.diff(points[..., :2], axis=0), axis=-1) * FPS  # (T - 1, K)
    owner = geometry.owner.numpy()
    slides = []
    for foot in FEET:
        mine = np.isin(owner, [body.link_index(name) for name in foot])
        low = (height[:, mine] < LOW) & (height[:, mine].min(1) < DOWN)[:, None]
        slowest = np.where(low[:-1] & low[1:], step[:, mine], np.inf).min(1)
        lasting = _opened(slowest)
        slides.append(lasting[np.isfinite(lasting)])
    return _mean(np.concatenate(slides))


def _opened(speed: np.ndarray) -> np.ndarray:
    """(K,) the most that each value keeps up together with a neighbour; inf where it has none.

    A grey-scale opening over two values; inf are gaps.
    """
    pair = np.minimum(speed[:-1], speed[1:])
    pair = np.where(np.isfinite(np.maximum(speed[:-1], speed[1:])), pair, -np.inf)
    most = np.maximum(np.append(pair, -np.inf), np.insert(pair, 0, -np.inf))
    return np.where(most >= 0.0, most, np.inf)


def penetration(body: Body, links: LinkMotion) -> float:
    """Depth (m) of the lowest point under the ground, which one frame of twenty exceeds."""
    geometry = _geometry(body.name)
    points = _points(geometry, links)
    lowest = (points[..., 2] - geometry.radii.double().numpy()).min(1)
    return _high(np.maximum(0.0, -lowest))


def effort(body: Body, drive: Drive) -> dict[str, float]:
    """What the joints gave, in a person's limits and per kg of the athlete.

    ``torque``: of the strongest dof in a frame, what the human torque-speed line (docs/strength.md)
    asks of its muscle, (torque + kd speed) / limit; above 1 no person has it. ``torque_rate``: the
    fastest change of a dof's mean torque from step to step, over ``TORQUE_RISE`` limits a second.
    Both of the dofs whose limits were measured, see ``UNMEASURED``. ``power``: positive power of
    all dofs, over that of hips, knees and ankles of both legs extending at their best speeds at
    once (effort * no-load speed / 4 of each). Each is the value that one frame of twenty exceeds;
    NaN with fewer than two steps.
    """
    human = load_body(body.name, strength="human")
    dofs = moving_dofs(human)
    limit, slope = human.array("effort")[dofs], human.array("kd")[dofs]
    if len(drive.torque) < 2:
        return dict.fromkeys(EFFORT, np.nan)
    judged = np.array([measured(human.dofs[i].name) for i in dofs])
    asked = (np.abs(drive.torque + slope * drive.speed) / limit)[..., judged]
    mean = drive.torque.mean(1)
    change = np.abs(np.diff(mean, axis=0)) / drive.dt
    power = np.maximum(drive.torque * drive.speed, 0.0).sum(-1)
    return {
        "torque": _high(asked.max((1, 2))),
        "torque_rate": _high((change / (TORQUE_RISE * limit))[:, judged].max(1)),
        "power": _high(power.mean(1)) / leg_power(body.name),
        "torque_per_kg": _high(np.abs(drive.torque).max((1, 2))) / human.mass,
        "torque_rate_per_kg": _high(change.max(1)) / human.mass,
        "power_per_kg": _high(power.mean(1)) / human.mass,
    }


def leg_power(name: str) -> float:
    """W of both legs at strength ``human``, all extensors at half of their no-load speed."""
    human = load_body(name, strength="human")
    dofs = [d for d in human.dofs if d.name[2:] in LEG_AXES]
    return sum(d.effort**2 / d.kd / 4.0 for d in dofs)


def measured(dof: str) -> bool:
    """Whether the limit of a dof in the human table was measured, not guessed."""
    name = dof.removeprefix("L_").removeprefix("R_")
    return name not in UNMEASURED and name.rpartition("_")[0] not in UNMEASURED


def _points(geometry: Geometry, links: LinkMotion) -> np.ndarray:
    """(T, K, 3) support points of the body in the world."""
    pos, quat = (torch.tensor(x, dtype=torch.float32) for x in (links.pos, links.quat))
    return geometry.world_points(pos, quat).double().numpy()


@cache
def _table(name: str) -> Body:
    return load_body(name)


@cache
def _geometry(name: str) -> Geometry:
    return Geometry(_table(name), "cpu")


def _mean(values: Sequence[float] | np.ndarray) -> float:
    x = np.asarray(values, dtype=float)
    x = x[~np.isnan(x)]
    return float(x.mean()) if len(x) else float("nan")


def _high(values: np.ndarray) -> float:
    return float(np.percentile(values, PERCENTILE))
