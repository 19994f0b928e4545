"""Football: one against one and two against two, on a small field with walls.

The field is 32 x 20 m; walls 1 m high leave two mouths of 4 m. Team 0 attacks +x. A goal is the
ball's centre past the goal plane inside |y| <= 2 m, z <= 2 m; it ends the episode. A ball over a
wall is dropped at the nearest point inside, from above all heads. Source: SMPLOlympics section 4
for field and rewards; IFAB Laws of the Game for the ball (laws 1, 2) and for handling (law 12).

Handling: a touch with hand or arm up to the shoulder is counted, brings that athlete no reward for
a second, and a goal within that second of handling by the scoring side is void: it ends the episode
and pays nobody. The 0.5 m within which an athlete plays the ball are measured along the ground: the
root of one who stands is 0.8 m above it.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sports import ball_games
from sports.humanoid.body import Body, Shape
from sports.physics.base import PhysicsState
from sports.scene import Scene, SceneObject, Start
from sports.task import Advance, Memory, Task, View, clamp01, constant, length

HALF_LENGTH, HALF_WIDTH = 16.0, 10.0
GOAL_HALF_WIDTH, GOAL_HEIGHT = 2.0, 2.0
WALL_HEIGHT, WALL_HALF_THICKNESS = 1.0, 0.5
"""m; thick, so that no shot passes: a ball moves 0.25 m in a time step at 30 m/s."""
OVER_WALL = 0.5
"""Distance (m) beyond a wall's face at which a ball is over it, wherever it is in height."""
DROP_HEIGHT = 2.0
BALL_RADIUS, BALL_MASS = 0.11, 0.43
RESTITUTION = 0.8
ROLLING = 0.5
"""1/s: 6.4 m from the 3.2 m/s of FIFA's ball roll test, which asks for 4 to 8 m on good grass."""
GRASS_FRICTION = 0.6
ARMS = tuple(f"{side}_{part}" for side in "LR" for part in ("Shoulder", "Elbow", "Wrist", "Hand"))
"""Links that may not play the ball."""
PLAYING_DISTANCE = 0.5
KICK_OFF = ((-3.0, 0.0), (-8.0, -3.0))
"""Where team 0 stands; team 1 stands opposite, turned by 180 degrees."""
UNIFORM_HALF = (13.0, 8.0)
LEAST_DISTANCE = 2.0
"""m; of starts anywhere. More than the rule's 1 m: arms are stretched out by 0.9 m."""
BESIDE = (2.0, 3.0)
"""m, from an athlete to a ball that starts beside it."""
LAYOUTS = 24
"""Drawn to find one with that distance; all fail once in 1e11 starts of five points."""


@dataclass(frozen=True)
class Soccer:
    """Options of the matches."""

    uniform: float = 0.5
    """Share of training episodes that start with ball and players anywhere on the field; the
    others, and all in evaluation, kick off."""
    beside: float = 0.0
    """Share of the starts anywhere that have the ball 2 to 3 m from one of the athletes: from the
    others nearly all that is learned from is running."""
    terminate_on_fall: bool = False
    """End the episode of an athlete that falls; else it is put back on its feet after 1 s."""
    no_circling: bool = False
    """Pay for the way that an athlete itself goes to the ball, and charge for going away from it.
    By the paper's clamp going away is free: who circles beside a ball earns with every round."""
    fall: float = 0.0
    """What a fall costs. The paper's is free but for the second on the ground, and athletes run
    faster than they can turn."""

    def __post_init__(self) -> None:
        if self.fall < 0.0:
            raise ValueError(f"the cost of a fall must not be negative: {self.fall}")
        if not 0.0 <= self.uniform <= 1.0:
            raise ValueError(f"the share of uniform starts must be in [0, 1], not {self.uniform}")
        if not 0.0 <= self.beside <= 1.0:
            raise ValueError(f"the share beside the ball must be in [0, 1], not {self.beside}")


def football(pos: tuple[float, float, float]) -> SceneObject:
    """The ball."""
    return SceneObject(
        name="ball",
        shapes=(Shape("sphere", (0, 0, 0), (BALL_RADIUS,), BALL_MASS),),
        motion="free",
        pos=pos,
        friction=GRASS_FRICTION,
        restitution=RESTITUTION,
        rolling=ROLLING,
        rgba=(0.95, 0.95, 0.95, 1.0),
    )


def goal_frame(name: str, side: float) -> SceneObject:
    """The frame that holds the net: so far behind the goal plane that a ball at 30 m/s which would
    rebound from it has been seen behind the plane before."""
    x, radius = side * (HALF_LENGTH + 1.2), 0.06
    y, z = GOAL_HALF_WIDTH + radius, GOAL_HEIGHT + radius
    return SceneObject(
        name=name,
        shapes=(
            Shape("capsule", (x, -y, 0), (radius,), 1.0, end=(x, -y, z)),
            Shape("capsule", (x, y, 0), (radius,), 1.0, end=(x, y, z)),
            Shape("capsule", (x, -y, z), (radius,), 1.0, end=(x, y, z)),
        ),
        motion="fixed",
        pos=(0.0, 0.0, 0.0),
        rgba=(0.9, 0.9, 0.9, 1.0),
        meets_ground=False,
    )


def touch_pairs(agents: int) -> tuple[tuple[str, str], ...]:
    """Contacts with the ball: each athlete's, then those of each one's arms."""
    pairs = [(f"agent{a}", "ball") for a in range(agents)]
    pairs += [(f"agent{a}/{link}", "ball") for a in range(agents) for link in ARMS]
    return tuple(pairs)


def touches(view: View) -> tuple[Tensor, Tensor]:
    """(N, A) who touched the ball in the last control step, and who with hand or arm."""
    agents = view.physics.scene.num_agents
    touch = view.physics.pair_force[:, : agents * (1 + len(ARMS))] > 0.0
    return touch[:, :agents], touch[:, agents:].unflatten(1, (agents, len(ARMS))).any(-1)


def goal_posts(view: View, side: Tensor) -> Tensor:
    """(N, A, 4) feet of the posts of the goals at x = 16 ``side`` (A,), seen from the root: of who
    looks into the goal the right one, then the left one, x and y each (m). The bar is 2 m high."""
    right = constant((HALF_LENGTH, -GOAL_HALF_WIDTH, 0.0), side.device)
    left = constant((HALF_LENGTH, GOAL_HALF_WIDTH, 0.0), side.device)
    posts = side[:, None, None] * torch.stack((right, left))  # (A, 2, 3)
    return view.heading.local(posts - view.root_pos[:, :, None])[..., :2].flatten(2)


def in_goal(at: Tensor) -> Tensor:
    """(N,) whether points of a goal plane (N, 3) are in the goal."""
    return (at[:, 1].abs() <= GOAL_HALF_WIDTH) & (at[:, 2] <= GOAL_HEIGHT)


def scene(config: Soccer, body: Body, team_size: int) -> Scene:
    """Field, walls, goals, ball and two teams."""
    wall_z, thick = WALL_HEIGHT / 2, WALL_HALF_THICKNESS
    mouth = GOAL_HALF_WIDTH + BALL_RADIUS  # the ball's centre may pass everywhere in the goal
    end = (HALF_WIDTH - mouth) / 2
    boxes = [
        ((0.0, side * (HALF_WIDTH + thick), wall_z), (HALF_LENGTH + 2 * thick, thick, wall_z))
        for side in (-1, 1)
    ]
    boxes += [
        ((ahead * (HALF_LENGTH + thick), side * (mouth + end), wall_z), (thick, end, wall_z))
        for ahead in (-1, 1)
        for side in (-1, 1)
    ]
    walls = SceneObject(
        name="walls",
        shapes=tuple(Shape("box", center, size, 1.0) for center, size in boxes),
        motion="fixed",
        pos=(0.0, 0.0, 0.0),
        rgba=(0.35, 0.55, 0.4, 1.0),
        meets_ground=False,
    )
    places = KICK_OFF[:team_size]
    teams = [Start(x, y) for x, y in places] + [Start(-x, -y, math.pi) for x, y in places]
    agents = 2 * team_size
    return Scene(
        name=f"soccer_{team_size}v{team_size}",
        body=body,
        agents=tuple(teams),
        objects=(
            football((0.0, 0.0, BALL_RADIUS)),
            walls,
            goal_frame("goal_left", -1.0),
            goal_frame("goal_right", 1.0),
        ),
        contact_pairs=touch_pairs(agents),
        sites={"centre": (0.0, 0.0, 0.0)},
    )


def ball_beside_one(
    layouts: Tensor, share: float, half: Tensor, generator: torch.Generator
) -> Tensor:
    """Layouts (N, K, A + 1, 2) of the athletes and, last, the ball (m), with the ball of a
    ``share`` of the N worlds beside one athlete, in a random direction, but within +-``half``
    (2,)."""
    n, tried, things, _ = layouts.shape
    draw = torch.rand(n, tried, 4, device=layouts.device, generator=generator)
    angle, way, which, chosen = draw.unbind(-1)
    which = (which * (things - 1)).long()[..., None, None]
    athlete = torch.take_along_dim(layouts, which, 2)[:, :, 0]
    way = (BESIDE[0] + (BESIDE[1] - BESIDE[0]) * way)[..., None]
    angle = 2.0 * math.pi * angle
    ball = athlete + way * torch.stack((angle.cos(), angle.sin()), -1)
    ball = torch.where(
        (chosen[:, :1] < share)[..., None], ball.clamp(-half, half), layouts[:, :, -1]
    )
    return torch.cat((layouts[:, :, :-1], ball[:, :, None]), 2)


def start(
    view: View,
    state: PhysicsState,
    context: Memory,
    generator: torch.Generator,
    training: bool,
) -> tuple[PhysicsState, Memory]:
    """Kick-off, or in training for a share of the worlds ball and players anywhere, facing
    anywhere."""
    physics, n = view.physics.scene, state.qpos.shape[0]
    ball_at = physics.object_qpos("ball").start
    ball_games.turn_ball(state, ball_at, generator)
    if not training or view.config.uniform == 0.0:
        return state, {}
    device, agents = state.qpos.device, physics.num_agents
    half = constant(UNIFORM_HALF, device)
    draw = torch.rand(n, LAYOUTS, agents + 1, 2, device=device, generator=generator)
    layouts = (2.0 * draw - 1.0) * half
    if view.config.beside > 0.0:
        layouts = ball_beside_one(layouts, view.config.beside, half, generator)
    places = ball_games.apart(layouts, LEAST_DISTANCE)
    other = torch.rand(n, agents + 1, device=device, generator=generator)
    uniform = (other[:, -1] < view.config.uniform)[:, None]
    spin = math.pi * other  # half of the yaw, which is in [0, 2 pi)
    zero = torch.zeros_like(spin)
    turn = torch.stack((spin.cos(), zero, zero, spin.sin()), -1)
    rows = [physics.agent_qpos(a).start for a in range(agents)]
    for k, first in enumerate([*rows, ball_at]):
        at = slice(first, first + 2)
        state.qpos[:, at] = torch.where(uniform, places[:, k], state.qpos[:, at])
    for k, first in enumerate(rows):
        at = slice(first + 3, first + 7)
        state.qpos[:, at] = torch.where(uniform, turn[:, k], state.qpos[:, at])
    return state, {}


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset: nobody has touched anything."""
    ball, root = view.physics.object_pos[:, 0], view.root_pos
    zero = torch.zeros_like(root[..., 0])
    return {
        "ball": ball.clone(),
        "to_ball": length(root - ball[:, None]),
        "since_handling": torch.full_like(zero, ball_games.NEVER),
        "handling": zero.bool(),
        "handled": zero.clone(),
        "down": zero.clone(),
        "falls": zero.clone(),
        **ball_games.begin_possession(view),
    }


def features(view: View, memory: Memory) -> dict[str, Tensor]:
    """The ball, both goals (the own one first) and the others as each athlete sees them."""
    goes = ball_games.attack(view)
    goals = {"own_goal": goal_posts(view, -goes), "other_goal": goal_posts(view, goes)}
    return ball_games.seen(view, goals)


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    root, ball = view.root_pos, view.physics.object_pos[:, 0]
    linvel, before = view.physics.object_linvel[:, 0], memory["ball"]
    goes = ball_games.attack(view)  # (A,)
    touch, handling = touches(view)
    since_handling = ball_games.count_since(handling, memory["since_handling"])
    fouled = ball_games.recently(view, since_handling)  # (N, A)
    handled = memory["handled"] + (handling & ~memory["handling"])

    # A goal, at either end: +1 for team 0, -1 for team 1.
    through = [ball_games.crossing(before, ball, side * HALF_LENGTH) for side in (1.0, -1.0)]
    right, left = (crosses & in_goal(at) for crosses, at in through)
    scored = right.float() - left.float()
    side = scored[:, None] * goes  # (N, A) 1 for those who scored
    void = ((side > 0) & fouled).any(1)
    points = side.masked_fill(void[:, None], 0.0)

    # Rewards: to the ball, and at the ball to the other goal.
    if view.config.no_circling:
        approach = memory["to_ball"] - length(root - before[:, None])
    else:
        approach = clamp01(memory["to_ball"] - length(root - ball[:, None]))
    far, high = (HALF_LENGTH, 0.0, 0.0), (0.0, 0.0, GOAL_HEIGHT / 2)
    aim = goes[:, None] * constant(far, ball.device) + constant(high, ball.device)  # (A, 3)
    gained = length(before[:, None] - aim) - length(ball[:, None] - aim)
    aside = root[..., :2] - ball[:, None, :2]
    plays = aside.square().sum(-1) < PLAYING_DISTANCE**2
    speed = ball_games.toward(ball[:, None], linvel[:, None], aim)
    terms = {
        "approach": 0.05 * approach,
        "dribble": 0.2 * gained * plays,
        "shot": 0.3 * speed * plays,
    }
    terms = {name: term.masked_fill(fouled, 0.0) for name, term in terms.items()}
    terms["goal"] = 10.0 * points
    fallen = view.fallen()
    laid = ball_games.lying(view, memory, fallen)
    if view.config.fall > 0.0:
        terms["fall"] = -view.config.fall * (laid["falls"] - memory["falls"])

    # Who lies too long is put on its feet, a ball over a wall is dropped inside.
    edge = HALF_LENGTH - 1.0, HALF_WIDTH - 1.0
    move, down, root_after = ball_games.get_up(view, laid["down"], *edge)
    x, y, z = ball.unbind(-1)
    beyond = torch.maximum(x.abs() - HALF_LENGTH, y.abs() - HALF_WIDTH)
    outside = (beyond > OVER_WALL) | ((beyond > 0.0) & (z > WALL_HEIGHT))
    edge = HALF_LENGTH - 2 * BALL_RADIUS, HALF_WIDTH - 2 * BALL_RADIUS
    move, ball_after = ball_games.drop_inside(view, outside, *edge, DROP_HEIGHT, onto=move)

    held, share = ball_games.possession(memory, touch)
    half = root.shape[1] // 2
    counted = scored.masked_fill(void, 0.0)
    terminated = (scored != 0)[:, None].expand_as(fallen)
    if view.config.terminate_on_fall:
        terminated = terminated | fallen
    return Advance(
        memory={
            "ball": ball_after,
            "to_ball": length(root_after - ball_after[:, None]),
            "since_handling": since_handling,
            "handling": handling,
            "handled": handled,
            **laid,
            "down": down,
            **held,
        },
        terms=terms,
        terminated=terminated,
        metrics={
            "success": (counted > 0).float(),
            "goals_for": (counted > 0).float(),
            "goals_against": (counted < 0).float(),
            "possession": share,
            "falls": laid["falls"][:, :half].sum(1),
            "handling": handled[:, :half].sum(1),
        },
        success=counted > 0,
        move=move,
        outcome=counted,
    )


def _match(team_size: int, summary: str) -> Task:
    return Task(
        name=f"soccer_{team_size}v{team_size}",
        config=Soccer,
        scene=functools.partial(scene, team_size=team_size),
        start=start,
        begin=begin,
        features=features,
        advance=advance,
        metrics={
            "success": "fraction",
            "goals_for": "goals",
            "goals_against": "goals",
            "possession": "fraction",
            "falls": "count",
            "handling": "count",
        },
        main_metric="goals_for",
        max_steps=3000,
        reward_scale=3.0,
        summary=summary,
    )


SOCCER_1V1 = _match(1, "Football, one against one; goals_for is team 0's.")
SOCCER_2V2 = _match(2, "Football, two against two; goals_for is team 0's.")
