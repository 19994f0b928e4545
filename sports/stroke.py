"""A control step of a racket sport: the rules applied, the landing foreseen, the next ball.

Tasks with one athlete go on until it loses a point: the machine launches the next ball when a
return has bounced and gone. Tasks with two athletes end with the point. World frame, m, s. N
worlds, A agents.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sports.ball import crossing, landing
from sports.physics.base import GRAVITY
from sports.rackets import HAND, Game, aims, leaning, racket_pos, served
from sports.rally import SIDES, Point, Touches, met, play, touches
from sports.task import Advance, Memory, View, constant, nan_where, place_object, squared

BODY_DISTANCE = 0.15
"""A ball nearer than this (m) to a link has met the body."""
LONGEST = 3.0
"""Flights of returns are followed for so long (s)."""
READY_DISTANCE, READY_HEIGHT = 3.0, 0.2
"""m from where an athlete began and of its root below the start's: scales of being ready."""
APEX_FALL = 2.0
"""m above the option ``apex`` that divide the pay of a stroke by e."""
REACHABLE = 4.0
"""A racket further than this (m) from the ball is as good as this far."""


@dataclass
class Stroke:
    """What rewards are made of, per agent (N, A)."""

    point: Point
    near: Tensor
    """exp(-sharpness d^2) of the distance from racket to ball, while the ball is on its way."""
    closer: Tensor
    """By how much that is more than ever since the last stroke or launch."""
    promising: Tensor
    """bool: its stroke will land in the court beyond the net, and has not yet."""
    low: Tensor
    """Factor of the pay for a stroke, by how high it rises; 1 without the option ``apex``."""
    miss: Tensor
    """Squared, from the predicted landing to the target (m^2)."""
    landed: Tensor
    """bool: its stroke has landed there in this step."""
    returns: Tensor
    """Strokes that landed there before this step."""


def judge(game: Game, view: View, memory: Memory, sharpness: float) -> Stroke:
    """Applies the rules to the last control step and looks ahead. ``sharpness`` (1/m^2) with which
    nearness of racket and ball falls off."""
    physics = view.physics
    ball, linvel = physics.object_pos[:, 0], physics.object_linvel[:, 0]
    racket = racket_pos(game, view)
    touch = touches(physics, 0)
    sides = constant(SIDES, ball.device)[: racket.shape[1]]

    way = torch.stack((memory["ball"], _corner(touch, ball), ball), 1)
    bumped = met(view, way, BODY_DISTANCE, HAND)
    trespassed = view.root_pos[..., 0] * sides < 0
    late = bumped | trespassed | leaning(view) | view.fallen()
    before = memory["hitter"], memory["bounced"]
    point = play(game.court, *before, touch, ball, linvel, late)

    own = point.hitter[:, None] == sides
    has_struck = (memory["strokes"] + point.struck) > 0  # a feed is nobody's stroke
    flying = (own & has_struck).any(-1) & ~point.bounced & ~point.lost.any(-1)
    spot, coming = predicted(game, view, point.hitter, flying)
    to_target = spot[:, None] - memory["target"]
    landed = point.landed[:, None] & (point.landed_by[:, None] == sides)
    near = (-sharpness * squared(racket - ball[:, None])).exp() * ~own
    return Stroke(
        point=point,
        near=near,
        closer=(near - memory["nearest"]).clamp(min=0.0),
        promising=own & coming[:, None],
        low=lowness(view.config.apex, ball[:, 2], linvel[:, 2])[:, None],
        miss=to_target[..., 0].square() + to_target[..., 1].square(),
        landed=landed & has_struck,
        returns=memory["returns"],
    )


def shaping(
    game: Game, view: View, memory: Memory, stroke: Stroke, sharpness: float
) -> dict[str, Tensor]:
    """Rewards of the options ``reach``, ``drive``, ``aim`` and ``recover``, where they are asked
    for."""
    config, terms = view.config, {}
    if config.reach > 0.0:
        terms["reach"] = config.reach * nearer(memory, stroke, sharpness)
    if config.drive > 0.0:
        terms["drive"] = config.drive * carried(view, memory, stroke)
    if config.aim > 0.0:
        terms["aim"] = config.aim * aimed(stroke, config.aim_width)
    if config.recover > 0.0:
        sides = constant(SIDES, stroke.near.device)[: stroke.near.shape[1]]
        waits = (stroke.point.hitter[:, None] == sides) & (memory["strokes"] > 0)
        terms["recover"] = config.recover * ready(game, view) * waits
    return terms


def ready(game: Game, view: View) -> Tensor:
    """(N, A) 1 for athletes who stand as at the start, less away from there, lower, leaning or
    turned from the net."""
    root, rotation = view.root_pos, view.rotation[:, :, 0]
    sides = constant(SIDES, root.device)[: root.shape[1]]
    x, y, z = root.unbind(-1)
    standing = float(view.physics.scene.start_qpos[view.physics.scene.agent_qpos(0)][2])
    away = ((x - sides * game.player_x).square() + y.square()) / READY_DISTANCE**2
    sunk = ((standing - z).clamp(min=0.0) / READY_HEIGHT).square()
    upright = rotation[..., 2, 2].clamp(min=0.0)
    facing = 0.5 - 0.5 * sides * rotation[..., 0, 0]
    return (-0.5 * (away + sunk)).exp() * upright * facing


def carried(view: View, memory: Memory, stroke: Stroke) -> Tensor:
    """(N, A) in the step of an athlete's stroke that breaks no rule, the share of the way to its
    target that the ball will fly, less for a high one (``low``); 0 in other steps and for a stroke
    away from it."""
    ball = view.physics.object_pos[:, 0, None]
    way = (memory["target"] - ball)[..., :2]
    share = 1.0 - stroke.miss.sqrt() / torch.hypot(way[..., 0], way[..., 1]).clamp(min=1e-6)
    point, agents = stroke.point, share.shape[1]
    flies = point.struck & ~point.bounced[:, None] & ~point.lost[:, :agents]
    return share.clamp(min=0.0) * flies * stroke.low


def aimed(stroke: Stroke, width: float) -> Tensor:
    """(N, A) in the step of a stroke that will land in the far court, exp(-miss / ``width``) of the
    distance (m) by which it will miss its target, less for a high one (``low``); 0 in other
    steps."""
    lands = stroke.point.struck & stroke.promising
    return (-stroke.miss.sqrt() / width).exp() * lands * stroke.low


def lowness(apex: float, z: Tensor, linvel_z: Tensor) -> Tensor:
    """(N,) 1 for balls that do not rise above ``apex`` (m), less for higher ones; 1 for an apex
    of 0. How high a ball rises is told from its height and vertical speed now, without drag."""
    if apex == 0.0:
        return torch.ones_like(z)
    rise = z + linvel_z.square() / (2.0 * GRAVITY)
    return (-(rise - apex).clamp(min=0.0) / APEX_FALL).exp()


def nearer(memory: Memory, stroke: Stroke, sharpness: float) -> Tensor:
    """(N, A) metres by which a racket has come nearer than ever to the ball on its way, within
    ``REACHABLE``. Unlike exp(-sharpness d^2) it says where to go from afar."""
    before = memory["nearest"]
    best = torch.maximum(before, stroke.near)
    least = math.exp(-sharpness * REACHABLE**2)
    far, near = ((-x.clamp(least, 1.0).log() / sharpness).sqrt() for x in (before, best))
    return far - near


def _corner(touch: Touches, ball: Tensor) -> Tensor:
    """(N, 3) where the ball had its first impact in the step; where it is now if it had none."""
    times = torch.cat((touch.stroke_time, touch.bounce_time[:, None]), 1)
    places = torch.cat((touch.stroke_pos, touch.bounce_pos[:, None]), 1)
    time, first = times.min(1)
    place = places.gather(1, first[:, None, None].expand(-1, 1, 3))[:, 0]
    return torch.where(time.isinf()[:, None], ball, place)


def predicted(game: Game, view: View, side: Tensor, flying: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 3) where balls hit by ``side`` (N,) will come down to the surface, the ball's centre, and
    (N,) bool whether that is in the court beyond the net, which they must pass first, and they are
    ``flying`` (N,) there."""
    court, radius = game.court, game.radius
    physics = view.physics
    pos, linvel, angvel = (
        v[:, 0] for v in (physics.object_pos, physics.object_linvel, physics.object_angvel)
    )
    # Where nobody asks, flights that end at once.
    low = court.height + radius
    device, want = pos.device, flying[:, None]
    start = torch.where(want, pos, constant((0.0, 0.0, low + 1e-3), device))
    speed = torch.where(want, linvel, constant((0.0, 0.0, -1.0), device))
    spot, when = landing(game.law, start, speed, angvel, low, LONGEST)
    passed = pos[:, 0] * side < 0
    want = (flying & ~passed)[:, None]
    start = torch.where(want, pos, constant((-1e-3, 0.0, low), device))
    speed = torch.where(want, linvel, constant((1.0, 0.0, 0.0), device))
    over, _ = crossing(game.law, start, speed, angvel, 0.0, LONGEST)
    _, y, z = over.unbind(-1)
    clears = passed | (z > court.net_top(y) + radius) | (y.abs() > court.net_half_width + radius)
    inside = court.inside(spot) & (spot[:, 0] * side < 0) & when.isfinite()
    return spot, flying & clears & inside


def conclude(
    game: Game, view: View, memory: Memory, stroke: Stroke, terms: dict[str, Tensor]
) -> Advance:
    """The step's result: the next ball of the machine or the next targets, memory and metrics."""
    point, agents = stroke.point, memory["target"].shape[1]
    to_target = point.spot[:, None] - memory["target"]
    error = torch.hypot(to_target[..., 0], to_target[..., 1])
    strokes = memory["strokes"] + point.struck
    returns = memory["returns"] + stroke.landed
    error_sum = memory["error_sum"] + error.masked_fill(~stroke.landed, 0.0)
    hits, errors = returns.sum(-1), error_sum.sum(-1)
    metrics = {"hits": hits, "error": nan_where(hits == 0, errors / hits.clamp(min=1.0))}
    nearest = torch.maximum(memory["nearest"], stroke.near)
    nearest = nearest.masked_fill(point.struck.any(-1, keepdim=True), 0.0)
    common = {**memory, "strokes": strokes, "returns": returns, "error_sum": error_sum}
    common["nearest"] = nearest
    step = _solo if agents == 1 else _duel
    return step(game, view, common, point, metrics, terms)


def _solo(
    game: Game,
    view: View,
    memory: Memory,
    point: Point,
    metrics: dict[str, Tensor],
    terms: dict[str, Tensor],
) -> Advance:
    """The machine loses a point by a return: it launches the next ball."""
    ball, lost = view.physics.object_pos[:, 0], point.lost[:, :1]
    returned = (point.hitter > 0) & point.bounced
    again = (point.lost[:, 1] | (returned & (ball[:, 0] < -game.behind))) & ~lost[:, 0]
    luck = _row(memory)
    pos, linvel = served(game, luck, again)
    row = again[:, None]
    memory = {
        **memory,
        "turn": memory["turn"] + again,
        "ball": torch.where(row, pos, ball),
        "hitter": point.hitter.masked_fill(again, -1.0),
        "bounced": point.bounced & ~again,
        "target": torch.where(row[..., None], aims(game, luck, 1), memory["target"]),
        "balls": memory["balls"] + again,
        "nearest": memory["nearest"].masked_fill(row, 0.0),
    }
    contacts, success = memory["strokes"][:, 0], metrics["hits"] > 0
    metrics |= {
        "success": success.float(),
        "contacts": contacts,
        "contact_rate": contacts / memory["balls"],
    }
    return Advance(
        memory=memory,
        terms=terms,
        terminated=lost,
        metrics=metrics,
        success=success,
        move=place_object(view, again, "ball", pos, linvel),
    )


def _duel(
    game: Game,
    view: View,
    memory: Memory,
    point: Point,
    metrics: dict[str, Tensor],
    terms: dict[str, Tensor],
) -> Advance:
    """One point: who gets a ball to play gets a new target. A success is a point that agent 0 has
    won; ``points_for`` are its own."""
    struck, lost = point.struck, point.lost
    renewed = struck.flip(1)[..., None]
    memory = {
        **memory,
        "turn": memory["turn"] + struck.any(-1),
        "ball": view.physics.object_pos[:, 0].clone(),
        "hitter": point.hitter,
        "bounced": point.bounced,
        "target": torch.where(renewed, aims(game, _row(memory), 2), memory["target"]),
    }
    won = lost.flip(1) & ~lost
    points_for, points_against = won.float().unbind(-1)
    metrics |= {
        "success": points_for,
        "rally": memory["strokes"].sum(-1),
        "points_for": points_for,
        "points_against": points_against,
    }
    return Advance(
        memory=memory,
        terms=terms,
        terminated=lost.any(-1, keepdim=True).expand(-1, 2),
        metrics=metrics,
        success=won[:, 0],
        outcome=points_for - points_against,
    )


def _row(memory: Memory) -> Tensor:
    """(N, 9) random numbers of the next ball."""
    luck = memory["luck"]
    turn = (memory["turn"] % luck.shape[1])[:, None, None]
    return luck.gather(1, turn.expand(-1, 1, luck.shape[2]))[:, 0]
