"""Table tennis: return balls to a target on the far half of the table, or play a point.

The net is the plane x = 0. The athlete of ``table_tennis`` stands at (2, 0) facing -x. Its first
ball is let go over the net; later ones come from above the far end of the table and meet its own
half at once, as in the paper, without the bounce on the far half that a serve of the rules has.
``table_tennis_1v1`` is one point between athletes at either end. Rules: ``sports/rally.py``.
Source: SMPLOlympics section 4 for goal and reward; ITTF laws 2.1 and 2.2 for table and net.

The reward is that of tennis, but instead of the bounce it pays for the returns so far: every step
in which a stroke is on its way onto the table is worth one more after each return.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch

from sports import rackets, stroke
from sports.ball import BALLS
from sports.humanoid.body import Body, Shape
from sports.physics.base import PhysicsState
from sports.rackets import NET_RESTITUTION, Feed, Game, Serve
from sports.rally import Court
from sports.scene import Scene, SceneObject, Surface
from sports.task import Advance, Memory, Task, View

HALF_LENGTH, HALF_WIDTH, HEIGHT = 2.74 / 2, 1.525 / 2, 0.76
THICKNESS = 0.03
"""m, of the table's top."""
NET_HEIGHT, NET_HALF_WIDTH = 0.1525, HALF_WIDTH + 0.1525
"""m above the table; posts stand as far outside the side lines."""
NET_HALF_THICKNESS = 0.003
LEG = (HALF_LENGTH - 0.3, HALF_WIDTH - 0.15)
"""Where the table stands, from its middle (m)."""
PADDLE_RADIUS, PADDLE_THICKNESS, PADDLE_REACH = 0.08, 0.012, 0.12
"""m; as in ``sports/humanoid/data/equipment.csv``."""
SHARPNESS = 4.0
"""1/m^2, of the reward before contact."""

GAME = Game(
    law="table_tennis",
    court=Court(
        half_length=HALF_LENGTH,
        half_width=HALF_WIDTH,
        line=BALLS["table_tennis"].radius,
        height=HEIGHT,
        net_height=HEIGHT + NET_HEIGHT,
        net_rise=0.0,
        net_half_width=NET_HALF_WIDTH,
        volleys=False,
        ceiling=2.5,
        floor=0.5,
        behind=3.5,
    ),
    player_x=2.0,
    reach=PADDLE_REACH,
    target=((-1.2, -0.3), (-0.6, 0.6)),
    serve=Serve(
        x=-1.37,
        y=(-0.7, 0.7),
        z=(1.3, 1.6),
        speed=(3.5, 5.0),
        land_x=(0.35, 1.2),
        land_y=(-0.6, 0.6),
        clear=0.05,
        apex=2.5,
    ),
    feed=Feed(z=1.4, speed=(2.0, 3.0), aside=(-0.4, 0.4)),
    opens=True,
    behind=1.5,
    moments=tuple(0.05 * k for k in range(1, 11)),
)


@dataclass(frozen=True)
class TableTennis(rackets.Options):
    """Options of table tennis."""


def game(config: TableTennis) -> Game:
    """The game with the machine that the options ask for."""
    return rackets.narrowed(GAME, config.width)


def table() -> SceneObject:
    """Its top and four legs."""
    x, y = LEG
    foot = (HEIGHT - THICKNESS) / 2
    legs = tuple(
        Shape("box", (sx * x, sy * y, -THICKNESS / 2 - foot), (0.03, 0.03, foot), 5.0)
        for sx in (-1, 1)
        for sy in (-1, 1)
    )
    top = Shape("box", (0, 0, 0), (HALF_LENGTH, HALF_WIDTH, THICKNESS / 2), 60.0)
    where = (0, 0, HEIGHT - THICKNESS / 2)
    return SceneObject("table", (top, *legs), "fixed", where, rgba=(0.1, 0.3, 0.55, 1.0))


def scene(config: TableTennis, body: Body, agents: int = 1) -> Scene:
    """Table, net, ball and paddles."""
    size = (NET_HALF_THICKNESS, NET_HALF_WIDTH, NET_HEIGHT / 2)
    net = SceneObject(
        "net",
        (Shape("box", (0, 0, 0), size, 0.5),),
        "fixed",
        (0, 0, HEIGHT + NET_HEIGHT / 2),
        rgba=(0.9, 0.9, 0.9, 0.6),
    )
    board = table()
    return Scene(
        name="table_tennis" if agents == 1 else "table_tennis_1v1",
        body=body,
        agents=rackets.players(GAME, agents),
        objects=(rackets.ball(GAME), board, net),
        contact_pairs=rackets.leaning_pairs((board, net), agents),
        surfaces=(
            Surface("table", "box", center=board.pos, size=board.shapes[0].size),
            Surface("ground", "plane"),
            rackets.solid(net, restitution=NET_RESTITUTION),
            *rackets.rackets(GAME, PADDLE_RADIUS, PADDLE_THICKNESS, agents),
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
    """Ball, its velocity, paddle and target (12), the opponent (9), the ball's path (30)."""
    return rackets.features(game(view.config), view, memory)


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    rules = game(view.config)
    now = stroke.judge(rules, view, memory, SHARPNESS)
    worth = 1.0 + (-now.miss).exp() + now.returns
    terms = {
        "approach": now.near if view.config.shadow else now.closer,
        "landing": worth * now.promising * now.low,
    }
    terms |= stroke.shaping(rules, view, memory, now, SHARPNESS)
    return stroke.conclude(rules, view, memory, now, terms)


def scene_1v1(config: TableTennis, body: Body) -> Scene:
    """The same table with an athlete at either end."""
    return scene(config, body, agents=2)


TASK = Task(
    name="table_tennis",
    config=TableTennis,
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
    max_steps=300,
    equipment=("paddle",),
    tools=(rackets.WRIST,),
    sees=("ball_path",),
    summary="Return balls to targets on the far half of the table.",
)

DUEL = dataclasses.replace(
    TASK,
    name="table_tennis_1v1",
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
    summary="Play a point of table tennis against another athlete.",
)
