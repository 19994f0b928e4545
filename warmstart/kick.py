"""A football's way from the foot to the goal: impact by restitution, then free flight.

The football has no friction with athletes and no drag (``sports/soccer.py``), so it leaves along
the normal n of the face that hits it, with

    v = (1 + e) m / (m + m_ball) (u . n),    1 / m = n' J M^-1 J' n

where u is the velocity of the face, e the ball's restitution and m the foot's effective mass at the
point of contact, all joints free (Newton's restitution for an articulated body: Featherstone, Rigid
Body Dynamics Algorithms, chapter 11). World frame of the penalty kick; m, s.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from sports.humanoid.body import Body
from sports.humanoid.mjcf import build_model
from sports.penalty_kick import SPOT, PenaltyKick, scene
from sports.physics.base import GRAVITY
from sports.soccer import BALL_MASS, BALL_RADIUS, HALF_LENGTH, RESTITUTION
from warmstart.replay import REPLAY_RATE, replay_states
from warmstart.solution import Solution
from warmstart.strike import Moment

LINK = "R_Toe"
AXIS = (1.0, 0.0, 0.0)
"""Direction of that link which the ball takes: the front of the toes."""
EFFECTIVE_MASS = 1.0
"""Of the foot in a plan (kg); each kick's own is in its certificate."""
AFTER = 0.02
"""The ball's speed is read this long (s) after it has begun to move."""
LOST = 99.0
"""Said of a ball that does not come to the goal plane (m)."""
STEEPEST = math.radians(25.0)
"""No foot that comes forward along the ground lifts a ball more than this."""


def face(body: Body) -> tuple[float, float, float]:
    """Middle of the front of the toes, in their link's frame (m)."""
    box = body.links[body.link_index(LINK)].shapes[0]
    x, y, z = box.center
    return (float(x + box.size[0]), float(y), float(z))


def gain(mass: float) -> float:
    """Speed of the ball over that of a face with an effective mass (kg) along its normal."""
    return (1.0 + RESTITUTION) * mass / (mass + BALL_MASS)


def foot_speed(ball_speed: float) -> float:
    """Speed of the foot (m/s) that a plan asks for."""
    return ball_speed / gain(EFFECTIVE_MASS)


def effective_mass(
    body: Body, qpos: np.ndarray, link: str, point: np.ndarray, normal: np.ndarray
) -> float:
    """Of a point of a link (its frame, m) along a direction of the world (kg), by MuJoCo."""
    model = build_model(body)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    i = 1 + body.link_index(link)
    jac = np.zeros((3, model.nv))
    where = data.xpos[i] + data.xmat[i].reshape(3, 3) @ point
    mujoco.mj_jac(model, data, jac, None, where, i)
    push = normal @ jac
    moved = np.zeros((1, model.nv))
    mujoco.mj_solveM(model, data, moved, push[None])
    return 1.0 / float(push @ moved[0])


def direction(speed: float, target: tuple[float, float]) -> np.ndarray:
    """(3,) unit: where a ball from the spot has to leave to pass the goal plane at a target (y, z).

    The lower of the two parabolas. Raises ValueError where there is none, or only a lob.
    """
    across = np.array([HALF_LENGTH - SPOT[0], target[0] - SPOT[1]])
    d, rise = float(np.linalg.norm(across)), target[1] - BALL_RADIUS
    root = speed**4 - GRAVITY * (GRAVITY * d**2 + 2 * rise * speed**2)
    angle = math.atan2(speed**2 - math.sqrt(root), GRAVITY * d) if root >= 0.0 else math.inf
    if angle > STEEPEST:
        raise ValueError(
            f"a ball of {speed:g} m/s does not fly to a target {target[1]:g} m high unless it is "
            "lobbed; ask for more ball_speed or a lower target"
        )
    c = math.cos(angle)
    return np.array([c * across[0] / d, c * across[1] / d, math.sin(angle)])


def passes(place: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """(2,) y and z where a ball in free flight passes the goal plane; on the ground where it would
    be under it. NaN where it does not come there."""
    if velocity[0] <= 0.0:
        return np.full(2, np.nan)
    t = (HALF_LENGTH - place[0]) / velocity[0]
    z = place[2] + t * (velocity[2] - 0.5 * GRAVITY * t)
    return np.array([place[1] + t * velocity[1], max(z, BALL_RADIUS)])


# What becomes of the ball of a solved kick.


def followed(solution: Solution, found: Moment) -> dict[str, float]:
    """The ball's speed after the impact (``outcome``, m/s), how far from its target it passes the
    goal plane (m) and the effective mass of the foot (kg), from the foot's motion."""
    event = solution.stats["event"]
    pose = solution.sample(solution.times[:1] + event["time"])["qpos"][0]
    point = np.array(event["point"])
    mass = effective_mass(solution.body, pose, event["link"], point, found.normal)
    speed = max(gain(mass) * float(found.velocity @ found.normal), 0.0)
    spot = np.array([*SPOT, BALL_RADIUS])
    off = passes(spot, speed * found.normal) - np.array(solution.stats["target"])
    return {
        "outcome": speed,
        "off target": float(np.nan_to_num(np.linalg.norm(off), nan=LOST)),
        "effective mass": mass,
    }


def played(solution: Solution, engine: str) -> dict[str, float]:
    """Speed of the engine's own ball after the impact (m/s), and how far from its target it passes
    the goal plane in the engine (m)."""
    asked = solution.asked["ball_speed"]
    hold = 2.0 * (HALF_LENGTH - SPOT[0]) / asked
    ball = np.array([*SPOT, BALL_RADIUS, 1.0, 0.0, 0.0, 0.0])
    world = scene(PenaltyKick(), solution.body)
    _, qpos, qvel = replay_states(solution, engine, hold, world, (ball, np.zeros(6)))
    at, rate = 7 + solution.body.num_dofs, 6 + solution.body.num_dofs
    where, speed = qpos[:, at : at + 3], np.linalg.norm(qvel[:, rate : rate + 3], axis=1)
    moved = np.flatnonzero(speed > 0.2 * asked)
    over = np.flatnonzero((where[1:, 0] >= HALF_LENGTH) & (where[:-1, 0] < HALF_LENGTH))
    out = {"ball: speed": 0.0, "ball: off target": LOST}
    if moved.size:
        out["ball: speed"] = float(
            speed[min(moved[0] + round(AFTER * REPLAY_RATE), len(speed) - 1)]
        )
    if over.size:
        a, b = where[over[0]], where[over[0] + 1]
        point = a + (HALF_LENGTH - a[0]) / (b[0] - a[0]) * (b - a)
        off = float(np.linalg.norm(point[1:] - np.array(solution.stats["target"])))
        out["ball: off target"] = min(off, LOST)
    return out
