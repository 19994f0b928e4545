"""Tennis: return a machine's balls to a target in the far court, or play a point against another.

The net is the plane x = 0. The athlete of ``tennis`` stands at (13, 0) facing -x; the machine
launches from x = -12.5, again as soon as a return has bounced and gone; the first point lost ends
the episode. In ``tennis_1v1`` agent 0 stands there and agent 1 at (-13, 0); the ball is let go over
the net towards one of them, and the episode is one point. Rules: ``sports/rally.py``. Source:
SMPLOlympics section 4 for goal and reward; ITF rules of tennis, rule 1, for the court.

The reward leads the racket to the ball, then pays for every step in which the stroke is on its way
into the court, more the nearer to the target, and for its bounce. Only one athlete has the ball to
play; who waits for the other gets nothing. Whether a stroke is on its way in is what the ball law
predicts, the net included.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import torch

from sports import rackets, stroke
from sports.ball import BALLS
from sports.humanoid.body import Body, Shape
from sports.physics.base import PhysicsState
from sports.rackets import NET_RESTITUTION, Feed, Game, Serve
from sports.rally import Court
from sports.scene import Scene, SceneObject, Surface
from sports.task import Advance, Memory, Task, View

HALF_LENGTH, HALF_WIDTH = 23.77 / 2, 8.23 / 2
"""m; singles court, outer edges of the lines."""
NET_HEIGHT = 1.0
"""m, everywhere, as in the paper."""
NET_MIDDLE, NET_POSTS = 0.914, 1.07
"""m, of the rules: at the strap and at the posts."""
NET_HALF_WIDTH = HALF_WIDTH + 0.914
"""m; singles posts stand outside the lines."""
NET_HALF_THICKNESS = 0.01
SHARPNESS = 1.0
"""Of the approach: exp(-SHARPNESS d^2) (1/m^2)."""
RACKET_RADIUS, RACKET_THICKNESS, RACKET_REACH = 0.15, 0.02, 0.35
"""m; as in ``sports/humanoid/data/equipment.csv``."""

GAME = Game(
    law="tennis",
    court=Court(
        half_length=HALF_LENGTH,
        half_width=HALF_WIDTH,
        line=BALLS["tennis"].radius,
        height=0.0,
        net_height=NET_HEIGHT,
        net_rise=0.0,
        net_half_width=NET_HALF_WIDTH,
        volleys=True,
        ceiling=8.0,
        floor=-math.inf,
        behind=15.9,
    ),
    player_x=13.0,
    reach=RACKET_REACH,
    target=((-11.0, -8.0), (-3.0, 3.0)),
    serve=Serve(
        x=-12.5,
        y=(-3.0, 3.0),
        z=(1.2, 1.2),
        speed=(18.0, 25.0),
        land_x=(6.0, 11.0),
        land_y=(-3.0, 3.0),
        clear=0.25,
        apex=4.0,
    ),
    feed=Feed(z=2.5, speed=(10.0, 12.0), aside=(0.0, 0.0)),
    opens=False,
    behind=12.9,
    moments=tuple(0.1 * k for k in range(1, 11)),
)


@dataclass(frozen=True)
class Tennis(rackets.Options):
    """Options of tennis."""

    net: Literal["level", "rules"] = "level"
    """1 m high everywhere, as in the paper, or 0.914 m in the middle and 1.07 m at the posts."""

    def __post_init__(self) -> None:
        if self.net not in ("level", "rules"):
            raise ValueError(f"the net must be 'level' or 'rules', not '{self.net}'")
        super().__post_init__()


@cache
def game(config: Tennis) -> Game:
    """The game with the net and the machine that the options ask for."""
    rules = rackets.narrowed(GAME, config.width)
    if config.net == "level":
        return rules
    rise = NET_POSTS - NET_MIDDLE
    court = dataclasses.replace(GAME.court, net_height=NET_MIDDLE, net_rise=rise)
    return dataclasses.replace(rules, court=court)


def net(court: Court) -> tuple[SceneObject, ...]:
    """One box, or two whose tops fall from the posts to the middle."""
    size = (NET_HALF_THICKNESS, NET_HALF_WIDTH, NET_HEIGHT / 2)
    white = (0.9, 0.9, 0.9, 0.6)
    if court.net_rise == 0.0:
        box = Shape("box", (0, 0, 0), size, mass=10.0)
        return (SceneObject("net", (box,), "fixed", (0, 0, NET_HEIGHT / 2), rgba=white),)
    slope = math.atan2(court.net_rise, court.net_half_width)
    half = math.hypot(court.net_rise, court.net_half_width) / 2
    box = Shape("box", (0, 0, 0), (NET_HALF_THICKNESS, half, NET_HEIGHT / 2), mass=5.0)
    halves = []
    for name, side in (("net_right", -1), ("net_left", 1)):
        # Half the net's height below the middle of its top edge.
        y = side * (court.net_half_width / 2 + NET_HEIGHT / 2 * math.sin(slope))
        z = court.net_height + court.net_rise / 2 - NET_HEIGHT / 2 * math.cos(slope)
        attitude = (math.cos(slope / 2), side * math.sin(slope / 2), 0.0, 0.0)
        halves.append(SceneObject(name, (box,), "fixed", (0, y, z), attitude, rgba=white))
    return tuple(halves)


def scene(config: Tennis, body: Body, agents: int = 1) -> Scene:
    """Court, net, ball and rackets."""
    rules = game(config)
    nets = net(rules.court)
    return Scene(
        name="tennis" if agents == 1 else "tennis_1v1",
        body=body,
        agents=rackets.players(rules, agents),
        objects=(rackets.ball(rules), *nets),
        contact_pairs=rackets.leaning_pairs(nets, agents),
        surfaces=(
            Surface("ground", "plane"),
            *(rackets.solid(part, restitution=NET_RESTITUTION) for part in nets),
            *rackets.rackets(rules, RACKET_RADIUS, RACKET_THICKNESS, agents),
        ),
    )


def start(
    view: View, state: PhysicsState, context: Memory, generator: torch.Generator, training: bool
) -> tuple[PhysicsState, Memory]:
    """Launches the first ball and draws the numbers of the next ones."""
    return rackets.draw(game(view.config), view, state, generator)


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset: a ball is on its way, no stroke yet."""
    return rackets.begin(game(view.config), view, context)


def features(view: View, memory: Memory) -> dict[str, torch.Tensor]:
    """Ball, its velocity, racket and target (12), the opponent (9), the ball's path (30)."""
    return rackets.features(game(view.config), view, memory)


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    rules = game(view.config)
    now = stroke.judge(rules, view, memory, SHARPNESS)
    terms = {
        "approach": now.near if view.config.shadow else now.closer,
        "landing": (1.0 + (-now.miss).exp()) * now.promising * now.low,
        "bounce": now.landed.float(),
    }
    terms |= stroke.shaping(rules, view, memory, now, SHARPNESS)
    return stroke.conclude(rules, view, memory, now, terms)


def scene_1v1(config: Tennis, body: Body) -> Scene:
    """The same court with an athlete at either end."""
    return scene(config, body, agents=2)


TASK = Task(
    name="tennis",
    config=Tennis,
    scene=scene,
    start=start,
    begin=begin,
    features=features,
    advance=advance,
    metrics={
        "success": "fraction",
        "hits": "1/episode",
        "error": "m",
        "contacts": "strokes",
        "contact_rate": "fraction",
    },
    main_metric="hits",
    max_steps=600,
    equipment=("racket",),
    tools=(rackets.WRIST,),
    sees=("ball_path",),
    summary="Return the balls of a machine to targets in the far court.",
)

DUEL = dataclasses.replace(
    TASK,
    name="tennis_1v1",
    scene=scene_1v1,
    metrics={
        "success": "fraction",
        "hits": "1/episode",
        "error": "m",
        "rally": "strokes",
        "points_for": "fraction",
        "points_against": "fraction",
    },
    main_metric="rally",
    summary="Play a point of tennis against another athlete.",
)
