"""The rules that racket sports share: who hit the ball last, where it bounced, who lost the point.

A point is a state machine driven by what the ball touches. After a stroke the ball must first
bounce in the other half of the court (anywhere else it is out; a ball that meets the net goes on,
and is out when it comes down on the wrong side); the other side must then hit it before it bounces
again. A stroke is a foul if the same side hit the ball last, if it meets the ball beyond the net,
or, where volleys are not allowed, before the ball has bounced. A point is also lost by a side whose
athlete falls, crosses the net, leans on table or net or is met by the ball; and when the ball
leaves the space of play or stops (on the net), by the receiver after a good bounce, else by the
side that hit it. Let balls are played on. Two impacts on a racket within a control step (33 ms) are
one stroke, as the rules have it of a ball hit twice in one swing; a contact in a later step is a
second one. Source: ITF rules of tennis 12, 24 and 25; ITTF laws of table tennis 2.7 and 2.10.

Sides are +1 (the half x > 0, agent 0) and -1 (agent 1, or the machine of the tasks with one
athlete). Within a control step impacts are taken in the order of their times. World frame, m, s.
N worlds, A agents.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from sports.physics.base import Physics
from sports.task import View, constant, squared

SIDES = (1.0, -1.0)
"""Of agent 0 and of its opponent."""
STOPPED = 0.05
"""A ball slower than this (m/s) lies somewhere."""


@dataclass(frozen=True)
class Court:
    """What a ball may touch and where it must stay."""

    half_length: float
    half_width: float
    line: float
    """How far beyond the lines (m) a ball's centre may be: a ball that touches a line is in."""
    height: float
    """Of the playing surface (m): below it the ball meets the edge of a table."""
    net_height: float
    """Of the net's top in the middle (m)."""
    net_rise: float
    """How much higher it is at the posts (m)."""
    net_half_width: float
    """From the middle to the posts (m)."""
    volleys: bool
    """Whether a ball may be hit before it has bounced."""
    ceiling: float
    """A ball above this height (m) is lost by the side that hit it."""
    floor: float
    """A ball below this height (m) has left the space of play; -inf where the ground decides."""
    behind: float
    """A ball beyond this |x| (m) has left the space of play."""

    def net_top(self, y: Tensor) -> Tensor:
        """(N,) height (m) of the net's top, straight from the middle to the posts."""
        return self.net_height + self.net_rise / self.net_half_width * y.abs()

    def inside(self, spot: Tensor) -> Tensor:
        """(N,) whether a ball whose centre meets the surface at ``spot`` (N, 3) is in."""
        x, y, z = spot.unbind(-1)
        long = x.abs() <= self.half_length + self.line
        return long & (y.abs() <= self.half_width + self.line) & (z >= self.height)


class Touches(NamedTuple):
    """What the ball touched in the last control step."""

    bounces: Tensor
    """(N,) impacts on the playing surface."""
    bounce_time: Tensor
    """(N,) of the first one, seconds from the beginning of the step; inf where there is none."""
    bounce_pos: Tensor
    """(N, 3) the ball's centre at that one."""
    strokes: Tensor
    """(N, A) impacts on each racket."""
    stroke_time: Tensor
    """(N, A)"""
    stroke_pos: Tensor
    """(N, A, 3)"""


def touches(physics: Physics, surface: int) -> Touches:
    """Of a scene whose surfaces are the playing surface in place ``surface`` and, as the last ones,
    the agents' rackets."""
    agents = physics.scene.num_agents
    hits, time, pos = physics.ball_hits, physics.ball_hit_time, physics.ball_hit_pos
    rackets = hits[:, -agents:], time[:, -agents:], pos[:, -agents:]
    return Touches(hits[:, surface], time[:, surface], pos[:, surface], *rackets)


@dataclass
class Point:
    """A point after a control step, and what happened in it."""

    hitter: Tensor
    """(N,) side that hit the ball last."""
    bounced: Tensor
    """(N,) bool: the ball has had its good bounce since."""
    struck: Tensor
    """(N, A) bool: a stroke by the rules in this step."""
    landed: Tensor
    """(N,) bool: the good bounce was in this step."""
    landed_by: Tensor
    """(N,) side whose stroke that was."""
    spot: Tensor
    """(N, 3) where it was, the ball's centre."""
    lost: Tensor
    """(N, 2) bool: the sides +1 and -1 that lost the point in this step."""


def play(
    court: Court,
    hitter: Tensor,
    bounced: Tensor,
    touch: Touches,
    ball: Tensor,
    linvel: Tensor,
    late: Tensor,
) -> Point:
    """One control step of a point.

    ``hitter`` (N,) and ``bounced`` (N,) are those of the last step, ``ball`` and ``linvel`` (N, 3)
    the place and velocity of the ball now. ``late`` (N, A) says whose athlete loses the point by
    something that has no time within the step: it counts where no impact has decided the point.
    """
    ends = constant(SIDES, ball.device)
    sides = ends[: touch.strokes.shape[1]]
    struck, when = touch.strokes > 0, touch.stroke_time
    swung = struck.any(-1)
    inside, spot_x = court.inside(touch.bounce_pos), touch.bounce_pos[:, 0]

    # Bounces before the stroke; all of them where there is none.
    early = touch.bounce_time < when.amin(-1)
    before = torch.where(swung, early, touch.bounces)
    bounces = before > 0
    fresh = bounces & ~bounced
    landed = fresh & inside & (spot_x * hitter < 0)
    twice = (bounces & bounced) | (landed & (before > 1))
    out = fresh & ~landed
    bounced = bounced | landed

    # The stroke, or both athletes' in one step.
    second = when.flip(1) < when
    own = (sides == hitter[:, None]) & ~second
    foul = own | (sides * touch.stroke_pos[..., 0] < 0)
    if not court.volleys:
        volley = struck & ~own & ~(bounced[:, None] & ~second)
        # Behind the end of the table the ball was out already.
        past = touch.stroke_pos[..., 0].abs() > court.half_length
        out, foul = out | (volley & past).any(-1), foul | volley
    decided = out | twice
    foul = foul & struck & ~decided[:, None]
    by_bounce = hitter * (out.float() - twice.float())
    landed_by = hitter
    hitter = torch.where(swung, ends[when.masked_fill(~struck, -1.0).argmax(-1)], hitter)
    bounced = bounced & ~swung

    # Bounces after the stroke. Where there was one before it too, this one's place is not known,
    # but so near to the stroke that it is on the striker's own side.
    after = touch.bounces > before
    good = after & ~early & inside & (spot_x * hitter < 0)
    rest = (after & ~good).float() - (good & (touch.bounces > before + 1)).float()
    by_bounce = torch.where(decided, by_bounce, hitter * rest)
    bounced = bounced | good

    # What has no time within the step.
    x, _, z = ball.unbind(-1)
    high = z > court.ceiling
    gone = (z < court.floor) | (x.abs() > court.behind) | (squared(linvel) < STOPPED**2)
    by_leaving = torch.where(bounced & ~high, -hitter, hitter) * (high | gone)

    fouled = foul.any(-1)
    lost = torch.where(fouled[:, None], _both(foul), by_bounce[:, None] == ends)
    still = ~(fouled | (by_bounce != 0))
    lost = lost | ((_both(late) | (by_leaving[:, None] == ends)) & still[:, None])
    return Point(
        hitter=hitter,
        bounced=bounced,
        struck=struck & ~foul & ~decided[:, None],
        landed=landed | (good & ~decided & ~fouled),
        landed_by=torch.where(good, hitter, landed_by),
        spot=touch.bounce_pos,
        lost=lost,
    )


def _both(mask: Tensor) -> Tensor:
    """(N, 2) of a mask (N, A): no athlete stands for the machine."""
    if mask.shape[1] == 2:
        return mask
    return torch.cat((mask, torch.zeros_like(mask)), 1)


def met(view: View, way: Tensor, distance: float, but: tuple[str, ...]) -> Tensor:
    """(N, A) bool: the ball came nearer than ``distance`` (m) to an athlete, to the origin or the
    centre of mass of a link other than ``but``, which hold the racket.

    ``way`` (N, K, 3): corners of the ball's way in the last step, taken as straight between them;
    the athletes as they are at its end.
    """
    physics, center = view.physics, view.geometry.center
    pos = physics.body_pos.permute(1, 3, 2, 0)  # (A, 3, B, N)
    x, y, z = physics.body_rot.permute(4, 1, 3, 2, 0)  # columns
    cx, cy, cz = center.T[:, :, None]  # (B, 1)
    middle = torch.addcmul(pos, x, cx).addcmul_(y, cy).addcmul_(z, cz)
    points = torch.cat((pos, middle), 2)  # (A, 3, 2 B, N)
    corners = way.permute(1, 2, 0)[:, None, :, None]  # (K, 1, 3, 1, N)
    start, along = corners[:-1], corners[1:] - corners[:-1]
    gap = points - start
    share = (gap * along).sum(2) / (along * along).sum(2).clamp(min=1e-12)
    gap -= share.clamp_(0.0, 1.0)[:, :, None] * along
    near = (gap * gap).sum(2).amin(0)  # (A, 2 B, N)
    names = physics.scene.body.link_names
    free = constant(tuple(math.inf if name in but else 0.0 for name in names) * 2, pos.device)
    return ((near + free[:, None]).amin(1) < distance * distance).T
