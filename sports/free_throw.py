"""Free throw: from a standing start with the ball between the hands, from behind the line.

The athlete starts at the origin in a hold found by simulation (``sports/humanoid/hold.py``), the
rim's middle is 4.5 m ahead at 3.05 m. Source: SMPLOlympics section 4 for goal and reward, with the
shot v* of ``sports/hoop.py`` in place of the paper's, which cannot score; FIBA Official Basketball
Rules for basket and board and for what a free throw is: one throw, from behind the line.

A state machine on contacts: HELD until the ball has been free for 2 whole control steps (nothing
of the athlete touched it in any substep, and it is out of reach of both palms); then THROWN, for
good. Rewards are those of the ball's velocity until it is free and then stay as they were in the
first free step, which is the release; a touch before the throw is settled takes that back. Lines,
falls and a low ball matter while it is not free. Whatever touches the ball once it is thrown ends
the throw, so it is not pushed again, batted in or dunked. So do a foot on the ball at any time, a
ball that comes up through the ring (both violations by FIBA's rules) and one that lies still,
stuck on the ring. Holding the ball pays 0.001 a step.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sports import ball_games, quaternion
from sports.hoop import RIM_HEIGHT, aim, arrival, crossing, hoop
from sports.humanoid.body import Body
from sports.humanoid.hold import BASKETBALL, load_hold
from sports.scene import GROUND, Scene
from sports.task import (
    Advance,
    Memory,
    Task,
    View,
    constant,
    length,
    nan_where,
    nothing_to_draw,
    squared,
)

RIM = (4.5, 0.0, RIM_HEIGHT)
LINE_X = 0.3
"""How far forward the root may be while the ball is not free (m)."""
LOWEST = 1.1
"""Height under which a ball that is not free was dropped (m)."""
FREE_STEPS = 2
"""Whole control steps without a touch after which a ball is thrown."""
BALL_RADIUS = BASKETBALL.shapes[0].size[0]
OUT_OF_REACH = 0.25
"""From wrist to the ball's middle (m); 0.17 in the hold."""
STILL_SPEED, STILL_STEPS = 0.1, 15
"""A ball slower than this (m/s) for so long (0.5 s) lies still."""
FEET = ("L_Ankle", "R_Ankle")


@dataclass(frozen=True)
class FreeThrow:
    """Options of the free throw."""

    entry: float = 0.0
    """Reward per step for where the ball would come down through the rim's plane,
    exp(-(miss / ``entry_width``)^2), until it is free and then as it was at the release; 0 for the
    paper's terms alone. Those hardly tell a basket from a ball 0.5 m off: PPO (18 M samples) threw
    1.4 m off on average."""
    entry_width: float = 0.5
    """In m. A ball 0.1 to 0.2 m off springs from the ring, mostly out of the basket: to someone who
    comes that near, 0.5 says little."""
    release_ends: bool = False
    """End the episode once the ball is thrown, and pay all that it would earn in the air at once:
    half of an episode is flight, in which there is nothing to do. Success is then a ball that would
    go in without touching the ring, and nothing else is paid for it. The rules need the whole
    flight."""

    def __post_init__(self) -> None:
        if self.entry < 0.0:
            raise ValueError(f"the reward for the entry must not be negative: {self.entry}")
        if not self.entry_width > 0.0:
            raise ValueError(f"the entry's width must be above 0 m, not {self.entry_width}")


def scene(config: FreeThrow, body: Body) -> Scene:
    """The athlete with the ball before the basket. Raises ValueError for a body without
    fingers."""
    hold = load_hold("basketball")
    return Scene(
        name="free_throw",
        body=body,
        agents=(hold.start(body),),
        objects=(hold.placed(BASKETBALL), *hoop("hoop", RIM, 1.0)),
        offset=hold.targets(body),
        steady=hold.steady(body),
        contact_pairs=(
            ("agent0", "ball"),
            *((f"agent0/{foot}/", "ball") for foot in FEET),
            ("ball", GROUND),
        ),
        timestep=1.0 / 240.0,
        substeps=8,
        sites={"spot": (0.0, 0.0, 0.0), "line": (LINE_X, 0.0, 0.0)},
    )


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset: in the hands."""
    ball = view.physics.object_pos[:, 0]
    zero = torch.zeros_like(ball[:, 0])
    nothing = torch.full_like(zero, torch.nan)
    memory = {
        "ball": ball.clone(),
        "free_steps": zero.clone(),
        "thrown": zero > 0,
        "aim": zero.clone(),
        "toward": zero.clone(),
        "release_speed": nothing.clone(),
        "release_height": nothing.clone(),
        "miss": nothing.clone(),
        "entry_angle": nothing.clone(),
        "still_steps": zero.clone(),
    }
    if view.config.entry > 0.0:
        memory["entry"] = zero.clone()
    return memory


def features(view: View, memory: Memory) -> dict[str, Tensor]:
    """The ball, the way to the rim and the way back to the spot, as seen from the athlete (20)."""
    physics, root = view.physics, view.root_pos
    ball = physics.object_pos
    axes = quaternion.matrix(physics.object_quat)
    vectors = torch.stack(
        (
            ball - root,
            axes[..., 0],
            axes[..., 1],
            physics.object_linvel,
            physics.object_angvel,
            constant(RIM, ball.device) - ball,
            -root,
        ),
        dim=2,
    )
    pos, first, second, linvel, angvel, rim, spot = view.heading.local(vectors).unbind(2)
    return {
        "ball_pos": pos,
        "ball_rot": torch.cat((first, second), dim=-1),
        "ball_linvel": linvel,
        "ball_angvel": angvel,
        "rim": rim,
        "spot": spot[..., :2],
    }


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    physics = view.physics
    ball, velocity = physics.object_pos[:, 0], physics.object_linvel[:, 0]
    rim = constant(RIM, ball.device)
    touched, left_foot, right_foot, landed = (physics.pair_force > 0).unbind(-1)

    # HELD, free for now, THROWN.
    near = _wrist_distance(view) < OUT_OF_REACH**2
    free_steps = (memory["free_steps"] + 1).masked_fill(touched | near, 0.0)
    was_thrown = memory["thrown"]
    thrown = was_thrown | (free_steps >= FREE_STEPS)
    flies = was_thrown | (free_steps > 0)
    flew = was_thrown | (free_steps > 1)

    def at_release(name: str, now: Tensor) -> Tensor:
        return torch.where(flew, memory[name], now)

    aimed = at_release("aim", 0.5 * aim(ball, velocity, rim))
    toward = at_release("toward", 0.5 * ball_games.toward(ball, velocity, rim))
    come = arrival(ball, velocity, rim)
    shaping: Memory = {}
    if view.config.entry > 0.0:
        there = torch.exp(-(come.miss / view.config.entry_width).square())
        shaping["entry"] = at_release("entry", there)

    cross = crossing(memory["ball"], ball, rim, view.control_timestep)
    rises_through = cross.up & cross.inside
    line = ~flies & (view.root_pos[:, 0, 0] > LINE_X)
    foul = line | left_foot | right_foot | (was_thrown & touched) | rises_through
    lost = ~flies & ((ball[:, 2] < LOWEST) | view.fallen()[:, 0])
    still = flies & (squared(velocity) < STILL_SPEED**2)
    still_steps = (memory["still_steps"] + 1).masked_fill(~still, 0.0)
    failed = foul | lost | landed | (still_steps >= STILL_STEPS)
    success = cross.down & cross.inside & thrown & ~failed

    first_pass = cross.down & flies & memory["miss"].isnan()
    basket, missed, angle = success, cross.miss, cross.angle
    done = basket
    if view.config.release_ends:
        done = first_pass = thrown & ~was_thrown & ~failed
        missed, angle = come.miss, come.angle
        success, basket = done & come.clean(BALL_RADIUS), torch.zeros_like(done)
    memory = {
        "ball": ball.clone(),
        "free_steps": free_steps,
        "thrown": thrown,
        "aim": aimed,
        "toward": toward,
        "release_speed": at_release("release_speed", length(velocity)),
        "release_height": at_release("release_height", ball[:, 2]),
        "miss": torch.where(first_pass, missed, memory["miss"]),
        "entry_angle": torch.where(first_pass, angle, memory["entry_angle"]),
        "still_steps": still_steps,
        **shaping,
    }
    released = torch.stack((memory["release_speed"], memory["release_height"]))
    speed, height = nan_where(~thrown, released).unbind()
    terms = {"aim": aimed, "toward": toward, "basket": basket.float()}
    if view.config.entry > 0.0:
        terms["entry"] = view.config.entry * shaping["entry"]
    return Advance(
        memory=memory,
        terms={name: term[:, None] for name, term in terms.items()},
        terminated=(failed | done)[:, None],
        metrics={
            "success": success.float(),
            "miss": memory["miss"],
            "entry_angle": memory["entry_angle"],
            "release_speed": speed,
            "release_height": height,
            "foul": foul.float(),
        },
        success=success,
        remaining_paid=done,
    )


def _wrist_distance(view: View) -> Tensor:
    """(N,) squared distance (m^2) from the nearer wrist to the ball's middle."""
    physics = view.physics
    ball, links = physics.object_pos[:, 0], physics.scene.body
    left, right = (
        squared(physics.body_pos[:, 0, links.link_index(wrist)] - ball)
        for wrist in ("L_Wrist", "R_Wrist")
    )
    return torch.minimum(left, right)


TASK = Task(
    name="free_throw",
    config=FreeThrow,
    scene=scene,
    start=nothing_to_draw,
    begin=begin,
    features=features,
    advance=advance,
    metrics={
        "success": "fraction",
        "miss": "m",
        "entry_angle": "rad",
        "release_speed": "m/s",
        "release_height": "m",
        "foul": "fraction",
    },
    main_metric="success",
    max_steps=300,
    body="smplx",
    age_at_start=False,
    summary="Throw a ball from the free-throw line into the basket.",
)
