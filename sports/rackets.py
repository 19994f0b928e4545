"""What tennis and table tennis share besides the rules of ``sports/rally.py``: launches, features,
predictions and the book-keeping of an episode.

Tasks with one athlete play against a machine at x < 0 that launches the next ball when the last
return has bounced and gone; an episode is many points won and ends with the first one lost. Tasks
with two athletes play one point. Everything is turned by 180 degrees for the athlete at x < 0.
World frame, m, s. N worlds, A agents.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sports.ball import BALLS, crossing, landing, launch, path
from sports.humanoid.body import Shape
from sports.physics.base import PhysicsState
from sports.rally import SIDES, Court, Point, met, play, touches
from sports.scene import SceneObject, Start, Surface
from sports.task import Advance, Memory, View, constant, nan_where, place_object, squared

Range = tuple[float, float]

HAND = ("R_Wrist", "R_Hand")
"""Links that hold the racket: the ball may come near them."""
WRIST = HAND[0]
BODY_DISTANCE = 0.15
"""A ball nearer than this (m) to a link has met the body."""
DRAWS = 16
"""Rows of random numbers drawn for an episode, used one for each ball and then again."""
LONGEST = 3.0
"""Flights of returns are followed for so long (s)."""
NET_RESTITUTION = 0.1
"""A net gives way (our choice; the rules do not say)."""


@dataclass(frozen=True)
class Serve:
    """How the machine launches a ball towards +x: uniform draws, then shooting by the ball law."""

    x: float
    y: Range
    z: Range
    speed: Range
    """Forward velocity (m/s)."""
    land_x: Range
    land_y: Range
    clear: float
    """Between the net's top and the lowest point of the ball (m), at least."""
    apex: float
    """The ball's centre stays below this height (m)."""


@dataclass(frozen=True)
class Feed:
    """A ball let go over the middle of the net, level, towards one of the sides."""

    z: float
    speed: Range
    aside: Range
    """Velocity along y (m/s)."""


@dataclass(frozen=True)
class Game:
    """What tells one racket sport from the other."""

    law: str
    court: Court
    player_x: float
    reach: float
    """Of the racket's centre from the wrist, along the hand's -y (m)."""
    target: tuple[Range, Range]
    """x and y in which targets lie, for the athlete at x > 0 (m)."""
    serve: Serve
    feed: Feed
    opens: bool
    """Whether the first ball of a task with one athlete is fed."""
    behind: float
    """A return that has bounced is done with when it is this far (m) behind the net."""
    moments: tuple[float, ...]
    """Of the positions that ``ball_path`` shows (s)."""

    @property
    def radius(self) -> float:
        """Of the ball (m)."""
        return BALLS[self.law].radius


# Scene.


def players(game: Game, agents: int) -> tuple[Start, ...]:
    """Athletes behind the ends of the court, facing the net."""
    own = Start(x=game.player_x, yaw=math.pi)
    return (own, Start(x=-game.player_x))[:agents]


def ball(game: Game) -> SceneObject:
    """The ball, where a feed begins."""
    shape = Shape("sphere", (0, 0, 0), (game.radius,), BALLS[game.law].mass)
    where = (0.0, 0.0, game.feed.z)
    return SceneObject("ball", (shape,), "ball", where, rgba=(0.8, 0.9, 0.2, 1.0), law=game.law)


def rackets(game: Game, radius: float, thickness: float, agents: int) -> tuple[Surface, ...]:
    """The face of each athlete's racket, both sides of it."""
    return tuple(
        Surface(
            f"racket{agent}",
            "disc",
            center=(0.0, -game.reach, 0.0),
            size=(radius, thickness / 2),
            link=f"agent{agent}/{WRIST}",
        )
        for agent in range(agents)
    )


def solid(obj: SceneObject, **how: float) -> Surface:
    """The same box for the ball as for the athletes."""
    (shape,) = obj.shapes
    at = tuple(a + b for a, b in zip(obj.pos, shape.center))
    return Surface(obj.name, "box", center=at, size=shape.size, quat=obj.quat, **how)  # type: ignore


# Starts and launches.


def draw(
    game: Game, view: View, state: PhysicsState, generator: torch.Generator
) -> tuple[PhysicsState, Memory]:
    """The first ball of every world, and random numbers (N, DRAWS, 9) in [0, 1), a row for each
    ball: columns 0 to 4 of its launch or 0 to 2 of its feed, then two for each agent's target."""
    n, device, scene = state.qpos.shape[0], state.qpos.device, view.physics.scene
    luck = torch.rand(n, DRAWS, 9, device=device, generator=generator)
    first = luck[:, 0]
    if scene.num_agents == 1 and not game.opens:
        pos, linvel = served(game, first, torch.ones_like(first[:, 0], dtype=torch.bool))
    else:
        pos, linvel = fed(game, first, scene.num_agents == 2)
    q, v = scene.object_qpos("ball"), scene.object_qvel("ball")
    state.qpos[:, q.start : q.start + 3] = pos
    state.qvel[:, v.start : v.start + 3] = linvel
    return state, {"luck": luck}


def served(game: Game, luck: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Position and velocity (N, 3) of the machine's balls; at rest where ``mask`` is false."""
    serve, court = game.serve, game.court
    ranges = (serve.y, serve.z, serve.speed, serve.land_x, serve.land_y)
    y, z, speed, land_x, land_y = _within(ranges, luck[:, :5]).unbind(-1)
    pos = torch.stack((torch.full_like(y, serve.x), y, z), -1)
    spot = torch.stack((land_x, land_y, torch.full_like(y, court.height + game.radius)), -1)
    over = court.net_height + court.net_rise + serve.clear + game.radius
    linvel = launch(game.law, pos, speed, spot, net=(0.0, over), apex=serve.apex, mask=mask)
    return pos, linvel


def fed(game: Game, luck: Tensor, either: bool) -> tuple[Tensor, Tensor]:
    """Position and velocity (N, 3) of balls fed towards +x or, with ``either``, to one side."""
    ahead, aside = _within((game.feed.speed, game.feed.aside), luck[:, :2]).unbind(-1)
    if either:
        ahead = torch.where(luck[:, 2] < 0.5, -ahead, ahead)
    zero = torch.zeros_like(ahead)
    return torch.stack((zero, zero, zero + game.feed.z), -1), torch.stack((ahead, aside, zero), -1)


def aims(game: Game, luck: Tensor, agents: int) -> Tensor:
    """(N, A, 3) targets on the surface, each in the half beyond the net."""
    spots = _within(game.target, luck[:, 5:].unflatten(-1, (2, 2)))[:, :agents]
    spots = spots * constant(SIDES, luck.device)[:agents, None]
    return torch.nn.functional.pad(spots, (0, 1), value=game.court.height)


def _within(ranges: tuple[Range, ...], share: Tensor) -> Tensor:
    """(..., k) numbers at a share of the way through k ranges."""
    low = constant(tuple(a for a, _ in ranges), share.device)
    return torch.addcmul(low, share, constant(tuple(b - a for a, b in ranges), share.device))


def begin(game: Game, view: View, context: Memory) -> Memory:
    """Memory after a reset: the ball flies towards one side, so the other one had it last."""
    ball, linvel = view.physics.object_pos[:, 0], view.physics.object_linvel[:, 0]
    zero = torch.zeros_like(view.root_pos[..., 0])  # (N, A)
    luck = context["luck"]
    return {
        "luck": luck,
        "turn": torch.ones_like(zero[:, 0], dtype=torch.long),
        "ball": ball.clone(),
        "hitter": -linvel[:, 0].sign(),
        "bounced": torch.zeros_like(zero[:, 0], dtype=torch.bool),
        "target": aims(game, luck[:, 0], zero.shape[1]),
        "balls": torch.ones_like(zero[:, 0]),
        "strokes": zero.clone(),
        "returns": zero.clone(),
        "error_sum": zero.clone(),
    }


# Features.


def racket_pos(game: Game, view: View) -> Tensor:
    """(N, A, 3) centres of the rackets."""
    wrist = view.physics.scene.body.link_index(WRIST)
    physics = view.physics
    return physics.body_pos[:, :, wrist] - game.reach * physics.body_rot[:, :, wrist, :, 1]


def features(game: Game, view: View, memory: Memory) -> dict[str, Tensor]:
    """Ball, its velocity, racket and target as seen by each athlete (12); of a second athlete its
    root, velocity and racket (9); then the ball's path (30)."""
    physics, root, local = view.physics, view.root_pos, view.heading.local
    ball, linvel = physics.object_pos[:, :1], physics.object_linvel[:, :1]
    racket = racket_pos(game, view)
    seen = [ball - root, linvel.expand_as(root), racket - root, memory["target"] - root]
    names = ["ball", "ball_velocity", "racket", "target"]
    if root.shape[1] == 2:
        seen += [root.flip(1) - root, view.root_linvel.flip(1), racket.flip(1) - root]
        names += ["opponent", "opponent_velocity", "opponent_racket"]
    goal = dict(zip(names, local(torch.stack(seen, 2)).unbind(2)))
    if view.config.ball_path:
        flight = physics.object_pos[:, 0], physics.object_linvel[:, 0], physics.object_angvel[:, 0]
        to_come = path(game.law, *flight, game.moments, ground=game.court.height)
        goal["ball_path"] = local(to_come[:, None] - root[:, :, None]).flatten(2)
    return goal


# A control step.


@dataclass
class Stroke:
    """What rewards are made of, per agent (N, A)."""

    point: Point
    reaching: Tensor
    """bool: the ball is on its way to this athlete."""
    racket_distance: Tensor
    """Squared, from racket to ball (m^2)."""
    promising: Tensor
    """bool: its stroke will land in the court beyond the net, and has not yet."""
    miss: Tensor
    """Squared, from the predicted landing to the target (m^2)."""
    landed: Tensor
    """bool: its stroke has landed there in this step."""
    returns: Tensor
    """Strokes that landed there before this step."""


def judge(game: Game, view: View, memory: Memory) -> Stroke:
    """Applies the rules to the last control step and looks ahead."""
    physics = view.physics
    ball = physics.object_pos[:, 0]
    racket = racket_pos(game, view)
    touch = touches(physics, 0)
    sides = constant(SIDES, ball.device)[: racket.shape[1]]

    # The ball's way: from where it was, by its first impact, to where it is.
    moment = touch.stroke_time[:, 0]
    corner = touch.stroke_pos[:, 0]
    for agent in range(1, len(sides)):
        sooner = touch.stroke_time[:, agent] < moment
        moment = torch.where(sooner, touch.stroke_time[:, agent], moment)
        corner = torch.where(sooner[:, None], touch.stroke_pos[:, agent], corner)
    straight = moment.isinf() & touch.bounce_time.isinf()
    corner = torch.where(moment.isinf()[:, None], touch.bounce_pos, corner)
    corner = torch.where(straight[:, None], ball, corner)
    way = torch.stack((memory["ball"], corner, ball), 1)

    bumped = met(view, way, BODY_DISTANCE, HAND)
    trespassed = view.root_pos[..., 0] * sides < 0
    late = bumped | trespassed | view.fallen()
    point = play(game.court, memory["hitter"], memory["bounced"], touch, ball, late)

    own = point.hitter[:, None] == sides
    has_struck = (memory["strokes"] + point.struck) > 0  # a feed is nobody's stroke
    flying = (own & has_struck).any(-1) & ~point.bounced & ~point.lost.any(-1)
    spot, coming = predicted(game, view, point.hitter, flying)
    to_target = spot[:, None] - memory["target"]
    landed = point.landed[:, None] & (point.landed_by[:, None] == sides)
    return Stroke(
        point=point,
        reaching=~own,
        racket_distance=squared(racket - ball[:, None]),
        promising=own & coming[:, None],
        miss=to_target[..., 0].square() + to_target[..., 1].square(),
        landed=landed & has_struck,
        returns=memory["returns"],
    )


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
    success = hits > 0
    metrics = {
        "success": success.float(),
        "hits": hits,
        "error": nan_where(~success, errors / hits.clamp(min=1.0)),
    }
    common = {**memory, "strokes": strokes, "returns": returns, "error_sum": error_sum}
    step = _solo if agents == 1 else _duel
    return step(game, view, common, point, metrics, success, terms)


def _solo(
    game: Game,
    view: View,
    memory: Memory,
    point: Point,
    metrics: dict[str, Tensor],
    success: Tensor,
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
    }
    contacts = memory["strokes"][:, 0]
    metrics |= {"contacts": contacts, "contact_rate": contacts / memory["balls"]}
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
    success: Tensor,
    terms: dict[str, Tensor],
) -> Advance:
    """One point: who gets a ball to play gets a new target."""
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
    won = (lost.flip(1) & ~lost).float()
    metrics |= {
        "rally": memory["strokes"].sum(-1),
        "points_0": won[:, 0],
        "points_1": won[:, 1],
    }
    return Advance(
        memory=memory,
        terms=terms,
        terminated=lost.any(-1, keepdim=True).expand(-1, 2),
        metrics=metrics,
        success=success,
    )


def _row(memory: Memory) -> Tensor:
    """(N, 9) random numbers of the next ball."""
    luck = memory["luck"]
    turn = (memory["turn"] % luck.shape[1])[:, None, None]
    return luck.gather(1, turn.expand(-1, 1, luck.shape[2]))[:, 0]
