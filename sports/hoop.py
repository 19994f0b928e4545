"""The basket of basketball: ring and board, the shot that would go in, and whether one did.

Source: FIBA Official Basketball Rules, Basketball Equipment, for the measures; SMPLOlympics
section 4 for the reward's idea of a velocity v* with which the ball would go in. The paper takes
the highest point of the ball's path at the rim itself. Such a ball arrives level: its entry angle
is 0, the ring is a line as seen from it, and it cannot score. So the path here has its apex
0.9 m above the rim. From the free-throw line (1.5 m high, 4.15 m away) v* is 3.7 m/s forward
and 6.9 m/s up, and the ball comes down into the ring at 49 degrees.

World frame, z up; m, s, rad. A basket counts downward only.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from sports.humanoid.body import Shape
from sports.physics.base import GRAVITY
from sports.scene import SceneObject
from sports.task import squared

RIM_HEIGHT, RING_RADIUS, RING_THICKNESS = 3.05, 0.23, 0.018
"""Upper side of the ring, its inner radius and the thickness of its metal (m)."""
SEGMENTS = 16
"""Straight pieces of the ring; its inner radius is then true within 2.3 mm."""
BOARD_WIDTH, BOARD_HEIGHT, BOARD_THICKNESS, BOARD_FOOT = 1.8, 1.05, 0.03, 2.90
"""Of the backboard (m); the last is how high its lower edge is."""
BOARD_BEHIND = 0.375
"""From the rim's centre to the face of the backboard (m)."""
APEX = 0.9
"""Highest point of the shot v* above the rim (m)."""
_RING_COLOR, _BOARD_COLOR = (0.9, 0.35, 0.1, 1.0), (0.93, 0.94, 0.96, 1.0)


def hoop(name: str, rim: tuple[float, float, float], side: float) -> tuple[SceneObject, ...]:
    """Ring and backboard around the middle ``rim`` of the ring; ``side`` is 1.0 where the board
    stands beyond it along +x, -1.0 along -x. Named ``NAME_rim`` and ``NAME_board``."""
    tube = RING_THICKNESS / 2
    # A polygon is nearer than its corners: corners and middles are as much too far as too near.
    radius = 2 * (RING_RADIUS + tube) / (1 + math.cos(math.pi / SEGMENTS))
    corners = [
        (radius * math.cos(a), radius * math.sin(a), -tube)
        for a in (2 * math.pi * k / SEGMENTS for k in range(SEGMENTS + 1))
    ]
    ring = [
        Shape("capsule", start, (tube,), 0.2, end=end) for start, end in itertools.pairwise(corners)
    ]
    inner = RING_RADIUS + RING_THICKNESS
    half = (BOARD_BEHIND - inner) / 2
    bracket = Shape("box", (side * (inner + half), 0.0, -tube), (half, 0.05, tube), 1.0)
    board = Shape(
        "box",
        (
            side * (BOARD_BEHIND + BOARD_THICKNESS / 2),
            0.0,
            BOARD_FOOT + BOARD_HEIGHT / 2 - RIM_HEIGHT,
        ),
        (BOARD_THICKNESS / 2, BOARD_WIDTH / 2, BOARD_HEIGHT / 2),
        20.0,
    )
    return (
        SceneObject(f"{name}_rim", (*ring, bracket), "fixed", rim, rgba=_RING_COLOR),
        SceneObject(f"{name}_board", (board,), "fixed", rim, rgba=_BOARD_COLOR),
    )


def shot(ball: Tensor, rim: Tensor) -> Tensor:
    """(..., 3) velocity v* (m/s) with which a ball at ``ball`` (..., 3) rises to the apex and comes
    down through the middle of ``rim`` (..., 3); from above the apex it falls from where it is."""
    way = rim - ball
    rise = (way[..., 2] + APEX).clamp(min=0.0)
    up = (2 * GRAVITY * rise).sqrt()
    drop = (-way[..., 2]).clamp(min=APEX)
    time = up / GRAVITY + (2 * drop / GRAVITY).sqrt()
    return torch.cat((way[..., :2] / time[..., None], up[..., None]), dim=-1)


def aim(ball: Tensor, velocity: Tensor, rim: Tensor) -> Tensor:
    """(...) exp(-0.1 |v - v*|^2): how like the shot a velocity (..., 3) is."""
    return torch.exp(-0.1 * squared(velocity - shot(ball, rim)))


class Arrival(NamedTuple):
    """How a ball that flew on freely would come down through the plane of a rim."""

    miss: Tensor
    """(...) distance from the rim's middle (m); infinite for a ball that would not reach it."""
    angle: Tensor
    """(...) of its path below the horizontal there (rad); meaningless where it would not."""

    def clean(self, radius: float) -> Tensor:
        """(...) bool: whether a ball of that radius (m) would touch the ring nowhere. Seen along
        its path the ring is narrower by the sine of the angle."""
        return (RING_RADIUS - self.miss) * self.angle.sin() > radius


def arrival(ball: Tensor, velocity: Tensor, rim: Tensor) -> Arrival:
    """Of balls at (..., 3) with velocities (..., 3) at rims (..., 3)."""
    drop = ball[..., 2] - rim[..., 2]
    square = velocity[..., 2].square() + 2 * GRAVITY * drop
    fall = square.clamp(min=0.0).sqrt()
    time = (velocity[..., 2] + fall) / GRAVITY
    miss = (ball + time[..., None] * velocity - rim)[..., :2]
    reaches = (square >= 0) & (time >= 0)
    return Arrival(
        miss=torch.hypot(miss[..., 0], miss[..., 1]).masked_fill(~reaches, torch.inf),
        angle=torch.atan2(fall, torch.hypot(velocity[..., 0], velocity[..., 1])),
    )


class Crossing(NamedTuple):
    """How a ball went through the plane of a rim in one control step."""

    down: Tensor
    """(...) bool."""
    up: Tensor
    """(...) bool."""
    miss: Tensor
    """(...) from the rim's middle to where it crossed (m); meaningless where it did not."""
    angle: Tensor
    """(...) of its path below the horizontal there (rad), likewise."""

    @property
    def inside(self) -> Tensor:
        """(...) bool: through the ring, where it crossed at all."""
        return self.miss < RING_RADIUS


def crossing(before: Tensor, now: Tensor, rim: Tensor, timestep: float) -> Crossing:
    """From a ball's centres (..., 3) at the ends of a control step of ``timestep`` seconds.

    Between them it moves in a straight line; a free ball's path is 1.4 mm off that at most.
    """
    was, height = before[..., 2] - rim[..., 2], now[..., 2] - rim[..., 2]
    way = now - before
    share = was / (was - height)
    x, y = (before - rim + share[..., None] * way)[..., :2].unbind(-1)
    # The mean velocity is that of the middle of the step; gravity acts until the crossing.
    speed = way / timestep
    fall = GRAVITY * timestep * (share - 0.5) - speed[..., 2]
    return Crossing(
        down=(was > 0) & (height <= 0),
        up=(was <= 0) & (height > 0),
        miss=torch.hypot(x, y),
        angle=torch.atan2(fall, torch.hypot(speed[..., 0], speed[..., 1])),
    )
