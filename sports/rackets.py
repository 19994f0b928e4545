"""What tennis and table tennis share besides their rules: the pieces of a scene, launches, what
athletes see. ``sports/rally.py`` has the rules, ``sports/stroke.py`` a control step.

Tasks with one athlete play against a machine at x < 0, tasks with two against each other;
everything is turned by 180 degrees for the athlete at x < 0. World frame, m, s. N worlds, A agents.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from sports.ball import BALLS, launch, path
from sports.humanoid.body import Shape
from sports.physics.base import PhysicsState
from sports.rally import SIDES, Court
from sports.scene import SceneObject, Start, Surface
from sports.task import Memory, View, constant

Range = tuple[float, float]

HAND = ("R_Wrist", "R_Hand")
"""Links that hold the racket: the ball may come near them."""
WRIST = HAND[0]
DRAWS = 16
"""Rows of random numbers drawn for an episode, used one for each ball and then again."""
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


@dataclass(frozen=True)
class Options:
    """Options of every racket sport. Raises ValueError for a reward or apex below 0, a width
    outside (0, 1] or an aim without width."""

    ball_path: bool = False
    """Whether athletes see where the ball will be at ten moments to come (``Game.moments``),
    bounces at the court's height included."""
    shadow: bool = True
    """Pay how near racket and ball are in every step before a stroke, as the paper does. False: pay
    only what is nearer than ever to this ball. Following the ball with the racket to its second
    bounce earns more than risking a stroke (PPO, 24 M samples)."""
    reach: float = 0.0
    """Reward for each metre, of the last 4, by which the racket has come nearer to this ball than
    ever before; 0 for the paper's terms alone. From 2.5 m the paper's reward for nearness is 0.002:
    it leads nobody to a ball that is served wide."""
    drive: float = 0.0
    """Reward for a stroke, in the share of the way to the target that it will carry the ball, net
    or not; 0 for the paper's terms alone, which pay nothing for a stroke that will not land in the
    far court. From a tennis baseline that takes 15 m/s: of 100 000 strokes of PPO none did."""
    recover: float = 0.0
    """Reward in each step from a stroke until the next ball comes for standing as at the start,
    facing the net, near where the athlete began; 0 for the paper's terms alone. The next ball is
    4 s of tennis away: PPO bent down behind its stroke, and met no second one in 400 M samples."""
    aim: float = 0.0
    """Reward for a stroke that will land in the far court, less by a factor of e for every
    ``aim_width`` by which it will miss its target; 0 for the paper's terms alone, to which 0.2 m at
    the table are 2 % of a return. PPO went 40 % of the way with a target's depth."""
    aim_width: float = 0.2
    """m"""
    apex: float = 0.0
    """Height (m) above which strokes are paid less (their flight, ``drive`` and ``aim``): by a
    factor of e for every 2 m that they rise higher. 0: paid alike, as in the paper, for every step
    of their flight, so that the highest lob below the ceiling earns most, and bounces over the
    head of whom it is meant for."""
    width: float = 1.0
    """Share of the width over which the machine spreads its balls (in training, to begin with)."""

    def __post_init__(self) -> None:
        for name in ("reach", "drive", "recover", "aim", "apex"):
            if getattr(self, name) < 0.0:
                raise ValueError(f"the option '{name}' must not be negative: {getattr(self, name)}")
        if not self.aim_width > 0.0:
            raise ValueError(f"the width of the aim must be above 0 m, not {self.aim_width}")
        if not 0.0 < self.width <= 1.0:
            raise ValueError(f"the width must be above 0 and at most 1, not {self.width}")


@cache
def narrowed(game: Game, width: float) -> Game:
    """The game whose machine and feed spread their balls over a share of the width."""
    serve, feed = game.serve, game.feed

    def narrow(span: Range) -> Range:
        return width * span[0], width * span[1]

    serve = dataclasses.replace(serve, y=narrow(serve.y), land_y=narrow(serve.land_y))
    feed = dataclasses.replace(feed, aside=narrow(feed.aside))
    return dataclasses.replace(game, serve=serve, feed=feed)


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


def solid(obj: SceneObject, restitution: float) -> Surface:
    """For the ball, the box that an object at rest is for the athletes."""
    (box,) = obj.shapes
    return Surface(obj.name, "box", obj.pos, box.size, quat=obj.quat, restitution=restitution)


def leaning_pairs(fixtures: tuple[SceneObject, ...], agents: int) -> tuple[tuple[str, str], ...]:
    """Contact pairs of :func:`leaning`: each athlete, and the hand with its racket, on each of
    the table and the nets."""
    return tuple(
        (side, part.name)
        for agent in range(agents)
        for part in fixtures
        for side in (f"agent{agent}", f"agent{agent}/{WRIST}/")
    )


def leaning(view: View) -> Tensor:
    """(N, A) bool: an athlete touches table or net with more than the hand that holds the racket,
    which may lie on a table; it must not be leant on. Source: ITTF laws 2.10.1.8 to 2.10.1.10 (the
    playing surface moved, the net assembly, the free hand), ITF rule 24 (the net). PPO fell on the
    table after every stroke and lay there."""
    whole, hand = view.physics.pair_force.unflatten(1, (view.root_pos.shape[1], -1, 2)).unbind(-1)
    return ((whole - hand).abs() > 1e-3 * whole).any(-1)


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
        "nearest": zero.clone(),
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
