"""Penalty kick: put the ball from the spot into the goal, near a target.

The ball lies at (4, 0), 12 m before the goal plane x = 16; the target is a point of the goal.
Source: SMPLOlympics section 4 for goal, reward and success; IFAB Laws of the Game, law 14 (a kick,
and no second touch) and law 12 (no hands). The ball is in the net when its centre passes the plane
inside |y| <= 2 m, z <= 2 m; it is out when it passes elsewhere or leaves the field.

What the released reward leaves open is closed here: a ball that moves by less than
``LEAST_GAIN`` in a step does not get closer (rounding would switch the reward); the step in which
it passes the plane is judged at the point where it passes, since behind the plane it gets further
from the target; a touch with hand or arm ends the episode, and so does one with trunk or head
before a leg has kicked the ball: PPO (27 M samples) sat down on it and let the pelvis squeeze it
out.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sports import ball_games
from sports.humanoid.body import Body
from sports.physics.base import GRAVITY, PhysicsState
from sports.scene import Scene, Start
from sports.soccer import (
    BALL_RADIUS,
    HALF_LENGTH,
    HALF_WIDTH,
    football,
    goal_frame,
    goal_posts,
    in_goal,
    touch_pairs,
    touches,
)
from sports.task import Advance, Memory, Task, View, constant, length, nan_where

SPOT = (4.0, 0.0)
START = (3.0, 0.14)
LAST_ROOT_X = 6.0
TARGET_LOW, TARGET_HIGH = (HALF_LENGTH, -1.8, 0.2), (HALF_LENGTH, 1.8, 1.8)
SUCCESS_DISTANCE = 0.5
SECOND_TOUCH_SECONDS = 1.0
"""A touch later than this after the first is a second one."""
AIM_WIDTH = 5.0**-0.5
"""Of the paper's reward for aim, exp(-5 d^2) (m)."""
LEGS = tuple(f"{side}_{link}" for side in "LR" for link in ("Hip", "Knee", "Ankle", "Toe"))
"""Links that may kick."""
ANKLES = ("L_Ankle", "R_Ankle")
FLIGHT_TIMES = tuple(2.5 / 1.1**k for k in range(45))
"""Of the free flights to the target that ``flight`` compares with (s), 2.5 to 0.04."""
FLIGHT_SECONDS = 0.2
"""After the first touch, in which ``flight`` is paid: later a ball that rolls lacks less, too."""
LEAST_GAIN = 1e-3
"""Metres in a control step; less is no approach of the ball to its target."""
REST_SPEED, REST_SECONDS = 0.1, 0.5
"""A ball that was touched is at rest when it was on the ground and slower (m/s) for so long (s)."""


@dataclass(frozen=True)
class PenaltyKick:
    """Options of the penalty kick."""

    reach: float = 0.0
    """Reward for each metre by which a foot has come nearer to the ball than ever before in the
    episode, until the ball is kicked; 0 for the paper's terms alone. What they pay before, the
    root's way to the ball, is paid for sitting down at it too."""
    aim_width: float = AIM_WIDTH
    """Metres between the ball's way and the target over which the reward for aim falls to 1/e. Half
    of the goal is further from a target than the paper's width can be felt: a kicker that shoots
    at the middle learns more from 1 or 2."""
    flight: float = 0.0
    """Reward for each metre a second by which the ball, kicked, has come nearer than ever to a
    velocity at which it would fly through its target, within ``FLIGHT_SECONDS`` of the first touch;
    0 for the paper's terms alone. A ball on the ground earns those to the end: kicked a little
    upward or faster it stays there, so nothing leads from it to a ball that flies."""

    def __post_init__(self) -> None:
        if self.reach < 0.0:
            raise ValueError(f"the reward for reaching must not be negative: {self.reach}")
        if self.flight < 0.0:
            raise ValueError(f"the reward for flight must not be negative: {self.flight}")
        if self.aim_width <= 0.0:
            raise ValueError(f"the width of the aim must be positive: {self.aim_width}")


def scene(config: PenaltyKick, body: Body) -> Scene:
    """Kicker, ball and goal."""
    return Scene(
        name="penalty_kick",
        body=body,
        agents=(Start(*START),),
        objects=(football((*SPOT, BALL_RADIUS)), goal_frame("goal", 1.0)),
        contact_pairs=(*touch_pairs(1), *((f"agent0/{link}", "ball") for link in LEGS)),
        sites={"spot": (*SPOT, 0.0)},
    )


def start(
    view: View,
    state: PhysicsState,
    context: Memory,
    generator: torch.Generator,
    training: bool,
) -> tuple[PhysicsState, Memory]:
    """Draws the targets."""
    device = state.qpos.device
    draw = torch.rand(state.qpos.shape[0], 3, device=device, generator=generator)
    low, high = constant(TARGET_LOW, device), constant(TARGET_HIGH, device)
    return state, {"target": torch.lerp(low, high, draw)}


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset: the ball lies on the spot."""
    ball = view.physics.object_pos[:, 0]
    zero = torch.zeros_like(ball[:, 0])
    memory = {
        "target": context["target"],
        "ball": ball.clone(),
        "to_ball": length(view.root_pos[:, 0] - ball),
        "touched": zero.bool(),
        "since_touch": zero.clone(),
        "rest": zero.clone(),
    }
    if view.config.reach > 0.0:
        memory["nearest"] = foot_distance(view)
    if view.config.flight > 0.0:
        memory["lacks"] = velocity_lacking(ball, torch.zeros_like(ball), context["target"])
    return memory


def features(view: View, memory: Memory) -> dict[str, Tensor]:
    """Ball, target, goal and spot as seen from the kicker (24)."""
    ball, root = view.physics.object_pos[:, 0], view.root_pos
    spot = constant((*SPOT, 0.0), root.device)
    aim = torch.stack((memory["target"] - ball, spot - root[:, 0]), 1)[:, None]
    target, spot = view.heading.local(aim).unbind(2)
    return {
        **ball_games.seen(view),
        "target": target,
        "goal": goal_posts(view, ball_games.attack(view)),
        "spot": spot[..., :2],
    }


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    root, ball = view.root_pos[:, 0], view.physics.object_pos[:, 0]
    linvel, target = view.physics.object_linvel[:, 0], memory["target"]
    before, root_x = memory["ball"], root[:, 0]

    touch, handling = (t[:, 0] for t in touches(view))
    kick = (view.physics.pair_force[:, -len(LEGS) :] > 0.0).any(-1)
    touched = memory["touched"] | touch
    squeezed = touch & ~kick & ~memory["touched"]
    since_touch = memory["since_touch"] + memory["touched"]
    second = touch & (since_touch * view.control_timestep > SECOND_TOUCH_SECONDS + 1e-6)

    crosses, at = ball_games.crossing(before, ball, HALF_LENGTH)
    inside = in_goal(at)
    net = crosses & inside & touched
    x, y, z = ball.unbind(-1)
    out = (crosses & ~inside) | (y.abs() > HALF_WIDTH) | (x < -HALF_LENGTH)
    slow = touched & (length(linvel) < REST_SPEED) & (z < BALL_RADIUS + 0.05)
    rest = (memory["rest"] + 1.0) * slow
    rests = rest * view.control_timestep >= REST_SECONDS - 1e-6
    fell = view.fallen()[:, 0] & ~touched
    failed = fell | (root_x > LAST_ROOT_X) | second | handling | squeezed | (out | rests) & ~net
    miss = length(at - target)
    success = net & ~failed & (miss < SUCCESS_DISTANCE)

    # In the step of the crossing the ball counts as where it crossed.
    place = torch.where(crosses[:, None], at, ball)
    gain = length(before - target) - length(place - target)
    closer = gain > LEAST_GAIN
    entry, arrives = predicted_entry(view, place, linvel)
    entry = torch.where(crosses[:, None], at, entry)
    off = (entry - target).square().sum(-1) / view.config.aim_width**2
    near = torch.exp(-off) * (arrives | crosses)
    to_ball = length(root - ball)
    past = (root_x - SPOT[0]).clamp(min=0.0)
    # A touch against the rules pays nothing for where the ball goes.
    closer = closer & ~handling & ~squeezed
    terms = {
        "approach": (0.4 * (memory["to_ball"] - to_ball)).masked_fill(closer, 0.0),
        "progress": 0.1 * gain * closer,
        "speed": 0.1 * ball_games.toward(place, linvel, target) * closer,
        "aim": 0.8 * near * closer,
        "line": torch.exp(-0.2 * past.square()) - 1.0,
    }
    shaping: Memory = {}
    if view.config.reach > 0.0:
        nearest = torch.minimum(memory["nearest"], foot_distance(view))
        nearest = torch.where(memory["touched"], memory["nearest"], nearest)
        terms["reach"] = view.config.reach * (memory["nearest"] - nearest)
        shaping["nearest"] = nearest
    if view.config.flight > 0.0:
        early = since_touch * view.control_timestep <= FLIGHT_SECONDS + 1e-6
        kicked = touched & early & ~handling & ~squeezed
        lacks = torch.minimum(memory["lacks"], velocity_lacking(place, linvel, target))
        lacks = torch.where(kicked, lacks, memory["lacks"])
        terms["flight"] = view.config.flight * (memory["lacks"] - lacks)
        shaping["lacks"] = lacks
    return Advance(
        memory={
            "target": target,
            "ball": ball.clone(),
            "to_ball": to_ball,
            "touched": touched,
            "since_touch": since_touch,
            "rest": rest,
            **shaping,
        },
        terms={name: term[:, None] for name, term in terms.items()},
        terminated=(failed | net)[:, None],
        metrics={
            "success": success.float(),
            "error": nan_where(~success, miss),
            "touched": touched.float(),
            "kicked": (touched & ~squeezed & ~handling).float(),
            "goal": (net & ~failed).float(),
            "handling": handling.float(),
        },
        success=success,
        remaining_paid=net & ~failed,
    )


def foot_distance(view: View) -> Tensor:
    """(N,) from the nearer ankle to the middle of the ball (m)."""
    body = view.physics.scene.body
    ball = view.physics.object_pos[:, 0]
    left, right = (
        length(view.physics.body_pos[:, 0, body.link_index(ankle)] - ball) for ankle in ANKLES
    )
    return torch.minimum(left, right)


def velocity_lacking(ball: Tensor, linvel: Tensor, target: Tensor) -> Tensor:
    """(N,) m/s: the smallest change of velocity after which a ball at ``ball`` (N, 3) that flies
    freely passes the target (N, 3), after any of ``FLIGHT_TIMES``. On the way there it is, but for
    the spacing of these times, what it was."""
    time = constant(FLIGHT_TIMES, ball.device)[:, None]
    half_g = constant((0.0, 0.0, 0.5 * GRAVITY), ball.device)
    wanted = (target - ball)[:, None] / time + half_g * time
    return length(wanted - linvel[:, None]).amin(-1)


def predicted_entry(view: View, ball: Tensor, linvel: Tensor) -> tuple[Tensor, Tensor]:
    """Where the ball (N, 3) will pass the goal plane, and whether it does in the time left (N,).

    Free flight from here; where that would be under the ground the ball is on it. Bounces, and what
    friction takes from a ball on the ground, are left out.
    """
    x, y, z = ball.unbind(-1)
    vx, vy, vz = linvel.unbind(-1)
    time = (HALF_LENGTH - x).clamp(min=0.0) / vx.clamp(min=1e-6)
    left = (TASK.max_steps - view.clock) * view.control_timestep
    arrives = (vx > 0.0) & (time <= left)
    time = time.minimum(left)
    height = (z + time * (vz - 0.5 * GRAVITY * time)).clamp(min=BALL_RADIUS)
    return torch.stack((torch.full_like(x, HALF_LENGTH), y + vy * time, height), -1), arrives


TASK = Task(
    name="penalty_kick",
    config=PenaltyKick,
    scene=scene,
    start=start,
    begin=begin,
    features=features,
    advance=advance,
    metrics={
        "success": "fraction",
        "error": "m",
        "touched": "fraction",
        "kicked": "fraction",
        "goal": "fraction",
        "handling": "fraction",
    },
    main_metric="success",
    max_steps=120,
    reward_scale=10.0,
    age_at_start=False,
    summary="Kick the ball from the spot into the goal, within 0.5 m of a target.",
)
