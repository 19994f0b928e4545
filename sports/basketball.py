"""Basketball: one against one and two against two, on a whole court.

The court is 29 x 15 m (FIBA's is a metre shorter), the rims are 12.925 m from its middle. Team 0
attacks +x. A basket is the ball's centre downward through a ring (``sports/hoop.py``); it ends the
episode. A ball that came up through the ring must leave it first. A ball off the court is dropped
at the nearest point inside from above all heads, and so is one that lies still on a ring, below
where it lay. Source: SMPLOlympics section 4 for rewards; FIBA Official Basketball Rules for the
baskets and for the foot: kicking the ball is a violation.

A foot on the ball is counted and brings that athlete nothing for a second: no reward, and a basket
of its side within that second is void; it ends the episode and pays nobody. What the other side's
basket costs it still costs. Who has the ball, and whose shot it is, goes by contacts of hands and
fingers. Steps and dribbling are free, as in the paper.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sports import ball_games
from sports.hoop import RIM_HEIGHT, aim, crossing, hoop
from sports.humanoid.body import Body
from sports.humanoid.hold import BASKETBALL
from sports.physics.base import PhysicsState
from sports.scene import Scene, Start
from sports.task import Advance, Memory, Task, View, constant, length, squared

HALF_LENGTH, HALF_WIDTH = 14.5, 7.5
RIM_X = 12.925
TIP_OFF = ((-2.0, 0.0), (-5.0, -3.0))
"""Where team 0 stands; team 1 stands opposite, turned by 180 degrees."""
UNIFORM_HALF = (12.5, 6.0)
"""m; athletes of starts anywhere, so that the ball beside them is on the court."""
LEAST_DISTANCE = 2.0
"""m between athletes there: arms are stretched out by 0.9 m."""
LAYOUTS = 24
"""Drawn to find one with that distance."""
BESIDE = (0.3, 1.0)
"""Distance from root to ball at the start (m)."""
BALL_HEIGHT, DROP_HEIGHT = 1.0, 2.5
"""Of the ball at the start, under outstretched arms, and where it is dropped inside (m)."""
INSIDE = 0.5
"""A ball is dropped this far inside the lines (m), an athlete put on its feet twice as far."""
LOW = 0.2
"""A ball whose middle is lower (m; it lies at 0.12) is on the floor."""
STILL_SPEED, STILL_STEPS, HIGH = 0.1, 30, 2.0
"""A ball that is slower than this (m/s) for 1 s above this height (m) lies on a ring."""
LIMBS = ("L_Wrist", "R_Wrist", "L_Ankle", "R_Ankle")
"""With all beyond them: hands and feet."""
ROWS_PER_ATHLETE, CONTACTS_PER_ATHLETE = 220, 50
"""Reserved on a GPU; one on its feet takes 64 and 16, and no fall was seen to take more."""


@dataclass(frozen=True)
class Basketball:
    """Options of the matches."""

    uniform: float = 0.5
    """Share of training episodes that start with the players anywhere on the court; the others, and
    all in evaluation, begin where a tip-off would be. The ball is beside any of them."""
    jump_ball: float = 0.0
    """Seconds for which a ball may lie or roll on the floor; then it is dropped there from above
    all heads. 0 for ever, as in the paper: from then on nobody's hands come near it."""
    fall: float = 0.0
    """What a fall costs. The paper's is free but for the second on the floor."""

    def __post_init__(self) -> None:
        if min(self.jump_ball, self.fall) < 0.0:
            raise ValueError(
                "the seconds until a jump ball and the cost of a fall must not be negative: "
                f"{self.jump_ball}, {self.fall}"
            )
        if not 0.0 <= self.uniform <= 1.0:
            raise ValueError(f"the share of uniform starts must be in [0, 1], not {self.uniform}")


def scene(config: Basketball, body: Body, team_size: int) -> Scene:
    """Court, baskets, ball and two teams."""
    places = TIP_OFF[:team_size]
    teams = [Start(x, y) for x, y in places] + [Start(-x, -y, math.pi) for x, y in places]
    agents = 2 * team_size
    return Scene(
        name=f"basketball_{team_size}v{team_size}",
        body=body,
        agents=tuple(teams),
        objects=(
            replace(BASKETBALL, pos=(0.0, 0.0, BALL_HEIGHT)),
            *hoop("west", (-RIM_X, 0.0, RIM_HEIGHT), -1.0),
            *hoop("east", (RIM_X, 0.0, RIM_HEIGHT), 1.0),
        ),
        contact_pairs=tuple((f"agent{a}/{limb}/", "ball") for a in range(agents) for limb in LIMBS),
        timestep=1.0 / 240.0,
        substeps=8,
        rows_per_world=ROWS_PER_ATHLETE * agents,
        contacts_per_world=CONTACTS_PER_ATHLETE * agents,
        sites={"centre": (0.0, 0.0, 0.0)},
    )


def start(
    view: View,
    state: PhysicsState,
    context: Memory,
    generator: torch.Generator,
    training: bool,
) -> tuple[PhysicsState, Memory]:
    """The ball beside any athlete; in training for a share of the worlds the athletes anywhere,
    facing anywhere."""
    layout, n = view.physics.scene, state.qpos.shape[0]
    device, agents = state.qpos.device, layout.num_agents
    rows = [layout.agent_qpos(a).start for a in range(agents)]
    luck = torch.rand(n, agents + 4, device=device, generator=generator)
    if training and view.config.uniform > 0.0:
        draw = torch.rand(n, LAYOUTS, agents, 2, device=device, generator=generator)
        half = constant(UNIFORM_HALF, device)
        places = ball_games.apart((2.0 * draw - 1.0) * half, LEAST_DISTANCE)
        uniform = (luck[:, -1] < view.config.uniform)[:, None]
        spin = math.pi * luck[:, :agents]  # half of the yaw, which is in [0, 2 pi)
        zero = torch.zeros_like(spin)
        turn = torch.stack((spin.cos(), zero, zero, spin.sin()), -1)
        for k, first in enumerate(rows):
            for at, new in ((slice(first, first + 2), places), (slice(first + 3, first + 7), turn)):
                state.qpos[:, at] = torch.where(uniform, new[:, k], state.qpos[:, at])
    roots = torch.stack([state.qpos[:, first : first + 2] for first in rows], 1)
    who, angle, far = luck[:, agents : agents + 3].unbind(-1)
    chosen = (who * agents).long().clamp(max=agents - 1)
    beside = torch.take_along_dim(roots, chosen[:, None, None], 1)[:, 0]
    angle, far = 2 * math.pi * angle, BESIDE[0] + (BESIDE[1] - BESIDE[0]) * far
    ball = layout.object_qpos("ball").start
    ball_games.turn_ball(state, ball, generator)
    way = far[:, None] * torch.stack((angle.cos(), angle.sin()), -1)
    state.qpos[:, ball : ball + 2] = beside + way
    return state, {}


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset: nobody has touched anything."""
    zero = torch.zeros_like(view.root_pos[..., 0])
    world = zero[:, 0]
    return {
        "ball": view.physics.object_pos[:, 0].clone(),
        "since_hand": torch.full_like(zero, ball_games.NEVER),
        "since_foot": torch.full_like(zero, ball_games.NEVER),
        "foot": zero.bool(),
        "fouls": zero.clone(),
        "down": zero.clone(),
        "falls": zero.clone(),
        "came_up": world > 0,
        "still_steps": world.clone(),
        "low_steps": world.clone(),
        **ball_games.begin_possession(view),
    }


def features(view: View, memory: Memory) -> dict[str, Tensor]:
    """The ball, both rims (the own one first) and the others as each athlete sees them."""
    goes = ball_games.attack(view)
    rims = torch.stack((_rims(view, -goes), _rims(view, goes)), 1)  # (A, 2, 3)
    own, other = view.heading.local(rims - view.root_pos[:, :, None]).unbind(2)
    return ball_games.seen(view, {"own_rim": own, "other_rim": other})


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    physics = view.physics
    ball, velocity, before = physics.object_pos[:, 0], physics.object_linvel[:, 0], memory["ball"]
    goes = ball_games.attack(view)  # (A,)
    half = len(goes) // 2
    left, right, left_foot, right_foot = (
        (physics.pair_force > 0).unflatten(1, (len(goes), len(LIMBS))).unbind(-1)
    )
    hand, foot = left | right, left_foot | right_foot  # (N, A)
    since_hand = ball_games.count_since(hand, memory["since_hand"])
    since_foot = ball_games.count_since(foot, memory["since_foot"])
    fouled = ball_games.recently(view, since_foot)
    fouls = memory["fouls"] + (foot & ~memory["foot"])

    # A basket, at either end: +1 for team 0, -1 for team 1.
    ends = _rims(view, constant((1.0, -1.0), ball.device))  # (2, 3)
    cross = crossing(before[:, None], ball[:, None], ends, view.control_timestep)
    basket = cross.down & cross.inside & ~memory["came_up"][:, None]  # (N, 2)
    rises, through = cross.up[:, 0], (cross.up & cross.inside).any(1)
    came_up = torch.where(rises, through, memory["came_up"])
    scored = basket[:, 0].float() - basket[:, 1].float()
    side = scored[:, None] * goes  # (N, A) 1 for those who scored
    void = ((side > 0) & fouled).any(1)
    counted = scored.masked_fill(void, 0.0)

    rims = _rims(view, goes)  # (A, 3)
    at, speed = ball[:, None], velocity[:, None]
    shot = aim(at, speed, rims) * ball_games.recently(view, since_hand)
    terms = {
        "hands": 0.1 * torch.exp(-5.0 * _hand_distance(view, ball)),
        "progress": 0.3 * (length(before[:, None] - rims) - length(at - rims)),
        "aim": 0.4 * shot,
        "toward": 0.3 * ball_games.toward(at, speed, rims),
    }
    terms = {name: term.masked_fill(fouled, 0.0) for name, term in terms.items()}
    terms["basket"] = 10.0 * counted[:, None] * goes

    # Who lies too long is put on its feet, a ball off the court or stuck is dropped inside.
    laid = ball_games.lying(view, memory, view.fallen())
    if view.config.fall > 0.0:
        terms["fall"] = -view.config.fall * (laid["falls"] - memory["falls"])
    edge = HALF_LENGTH - 2 * INSIDE, HALF_WIDTH - 2 * INSIDE
    move, down, _ = ball_games.get_up(view, laid["down"], *edge)
    still = (squared(velocity) < STILL_SPEED**2) & (ball[:, 2] > HIGH)
    still_steps = (memory["still_steps"] + 1.0).masked_fill(~still, 0.0)
    out = (ball[:, 0].abs() > HALF_LENGTH) | (ball[:, 1].abs() > HALF_WIDTH)
    out |= still_steps >= STILL_STEPS
    low_steps = (memory["low_steps"] + 1.0).masked_fill(ball[:, 2] > LOW, 0.0)
    if view.config.jump_ball > 0.0:
        out |= low_steps * view.control_timestep > view.config.jump_ball - 1e-6
    edge = HALF_LENGTH - INSIDE, HALF_WIDTH - INSIDE
    move, ball_after = ball_games.drop_inside(view, out, *edge, DROP_HEIGHT, onto=move)

    held, share = ball_games.possession(memory, hand)
    return Advance(
        memory={
            "ball": ball_after,
            "since_hand": since_hand,
            "since_foot": since_foot,
            "foot": foot,
            "fouls": fouls,
            **laid,
            "down": down,
            "came_up": came_up & ~out,
            "still_steps": still_steps.masked_fill(out, 0.0),
            "low_steps": low_steps.masked_fill(out, 0.0),
            **held,
        },
        terms=terms,
        terminated=(scored != 0)[:, None].expand_as(fouled),
        metrics={
            "success": (counted > 0).float(),
            "baskets_for": (counted > 0).float(),
            "baskets_against": (counted < 0).float(),
            "possession": share,
            "fouls": fouls[:, :half].sum(1),
            "falls": laid["falls"][:, :half].sum(1),
        },
        success=counted > 0,
        move=move,
        outcome=counted,
    )


def _rims(view: View, sides: Tensor) -> Tensor:
    """(k, 3) middles of the rims at x = 12.925 ``sides`` (k,)."""
    device = sides.device
    return sides[:, None] * constant((RIM_X, 0.0, 0.0), device) + constant(
        (0.0, 0.0, RIM_HEIGHT), device
    )


def _hand_distance(view: View, ball: Tensor) -> Tensor:
    """(N, A) mean distance (m) from the middles of both palms to the ball's."""
    body, gaps = view.physics.scene.body, []
    for wrist in LIMBS[:2]:
        link = body.link_index(wrist)
        palm = constant(body.links[link].shapes[0].center, ball.device)
        place = view.physics.body_pos[:, :, link] + view.rotation[:, :, link] @ palm
        gaps.append(length(place - ball[:, None]))
    return 0.5 * (gaps[0] + gaps[1])


def _match(team_size: int, summary: str) -> Task:
    return Task(
        name=f"basketball_{team_size}v{team_size}",
        config=Basketball,
        scene=functools.partial(scene, team_size=team_size),
        start=start,
        begin=begin,
        features=features,
        advance=advance,
        metrics={
            "success": "fraction",
            "baskets_for": "baskets",
            "baskets_against": "baskets",
            "possession": "fraction",
            "fouls": "count",
            "falls": "count",
        },
        main_metric="baskets_for",
        max_steps=3000,
        reward_scale=3.0,
        body="smplx",
        summary=summary,
    )


BASKETBALL_1V1 = _match(1, "Basketball, one against one; baskets_for is team 0's.")
BASKETBALL_2V2 = _match(2, "Basketball, two against two; baskets_for is team 0's.")
