"""What becomes of a golf ball on its tee, by the project's ball law: impact, flight, landing.

World frame of the task: the ball on its tee at the origin, play along +x, flat turf; positions are
of the ball's centre; m, s, rad unless a name says degrees. The club is the tool of the impact: its
free body counts, the arm behind it does not, as in the engines. Source of the law:
``sports/ball_law``.
"""

from __future__ import annotations

import math

import numpy as np

from sports import golf
from sports.humanoid.body import Body, Shape
from sports.scene import Scene
from warmstart import rotation, shot
from warmstart.outcome import link_poses
from warmstart.replay import replay_states
from warmstart.solution import Solution
from warmstart.strike import AROUND, Moment, moment

LAW = "golf"
LYING = golf.TEE_HEIGHT + golf.BALL.radius
"""Height of the ball's centre on its tee."""
GOES = 0.5
"""A ball faster than this (m/s) has been struck."""


def scene(body: Body) -> Scene:
    """The task's scene on flat turf."""
    return golf.scene(golf.Golf(terrain="flat"), body)


def head(body: Body) -> Shape:
    """The box that is the head of the club, in the frame of the hand."""
    return body.links[body.link_index(golf.TOOL)].shapes[1]


def face_point(body: Body) -> tuple[float, float, float]:
    """The middle of the club's face, in the frame of the hand: the face looks along its x."""
    x, y, z = head(body).center
    return (x + head(body).size[0], y, z)


def head_corners(body: Body) -> np.ndarray:
    """(8, 3) corners of the club head, in the frame of the hand."""
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    return np.array(head(body).center) + signs * np.array(head(body).size)


def over_the_ground(body: Body, qpos: np.ndarray) -> float:
    """The least height (m) of the club head above the ground; ``qpos`` (T, 7 + n)."""
    link = body.link_index(golf.TOOL)
    pos, quat = link_poses(body, qpos)
    corners = head_corners(body)
    up = rotation.rotate(
        quat[:, None, link].repeat(len(corners), 1),
        np.broadcast_to(corners, (len(qpos), *corners.shape)),
    )
    return float((pos[:, link, None] + up)[..., 2].min())


def struck(body: Body, found: Moment, point: np.ndarray) -> shot.Ball:
    """The ball right after the face has met it on its tee; ``point`` (3,) of the hand's frame."""
    lying = shot.Ball(0.0, np.array([0.0, 0.0, LYING]), np.zeros(3), np.zeros(3))
    tool = shot.tool_numbers(scene(body))
    return shot.impact(LAW, lying, found.velocity, found.normal, tool, found.rotation, point)


def flight(ball: shot.Ball) -> dict[str, float]:
    """Launch speed (m/s) and angle (degrees) of a struck ball; where it first meets the turf, along
    the line of play (``carry``) and to the left of it (``aside``), m. All 0 of one that was not
    struck."""
    speed = float(np.linalg.norm(ball.linvel))
    landed = shot.until(LAW, ball, 2, golf.BALL.radius, -1.0) if speed > GOES else None
    carry, aside = (0.0, 0.0) if landed is None else (float(x) for x in landed.pos[:2])
    angle = math.degrees(math.asin(ball.linvel[2] / speed)) if speed > GOES else 0.0
    return {"launch speed": speed, "launch angle": angle, "carry": carry, "aside": aside}


# What becomes of the ball of a solved stroke.


def followed(solution: Solution, found: Moment) -> dict[str, float]:
    """Speed of the face (``outcome``, m/s), its loft and its attack (degrees), by how much the loft
    is off the asked one, and the ball's :func:`flight` by the ball law."""
    event = solution.stats["event"]
    speed = float(np.linalg.norm(found.velocity))
    loft, asked = (_elevation(n) for n in (found.normal, np.array(event["normal"])))
    ball = flight(struck(solution.body, found, np.array(event["point"])))
    return {
        "outcome": speed,
        "loft": loft,
        "loft off": abs(loft - asked),
        "attack": _elevation(found.velocity),
        **ball,
    }


def played(solution: Solution, engine: str) -> dict[str, float]:
    """The ball's :func:`flight` after a replay in which it lies on its tee in the engine, blow and
    recoil included; by how much its launch speed is off the planned one, over it: who meets it with
    the edge of the face sends it elsewhere; and what the head keeps off the ground (m)."""
    qpos = np.array([0.0, 0.0, LYING, 1.0, 0.0, 0.0, 0.0])
    _, where, rates = replay_states(
        solution, engine, 0.0, scene(solution.body), (qpos, np.zeros(6))
    )
    at, spin = 7 + solution.body.num_dofs, 6 + solution.body.num_dofs
    gone = np.flatnonzero(np.linalg.norm(rates[:, spin : spin + 3], axis=1) > GOES)
    k = min(int(gone[0]) + 1, len(where) - 1) if gone.size else 0  # the step of the impact is over
    turning = rotation.rotate(where[k, at + 3 : at + 7], rates[k, spin + 3 : spin + 6])
    ball = flight(shot.Ball(0.0, where[k, at : at + 3], rates[k, spin : spin + 3], turning))
    planned = flight(_planned(solution))["launch speed"]
    return {
        "head over the ground": over_the_ground(solution.body, where[:, :at]),
        "ball: launch speed off": abs(ball["launch speed"] / planned - 1.0),
        **{f"ball: {name}": value for name, value in ball.items()},
    }


def _planned(solution: Solution) -> shot.Ball:
    """The ball right after the planned impact."""
    event = solution.stats["event"]
    times = event["time"] + np.linspace(-AROUND, AROUND, 101)
    qpos = solution.sample(solution.times[0] + times)["qpos"]
    found = moment(solution.body, event, times, qpos, nearest=False)
    return struck(solution.body, found, np.array(event["point"]))


def swept(solution: Solution, rate: float = 480.0) -> dict[str, float]:
    """What the head keeps off the ground in the whole planned motion (m)."""
    times = np.append(np.arange(0.0, solution.duration, 1.0 / rate), solution.duration)
    qpos = solution.sample(solution.times[0] + times)["qpos"]
    return {"planned head over the ground": over_the_ground(solution.body, qpos)}


def _elevation(vector: np.ndarray) -> float:
    """Above the horizontal (degrees)."""
    return math.degrees(math.atan2(vector[2], math.hypot(vector[0], vector[1])))
