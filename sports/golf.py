"""Golf: one stroke from a tee at a target up to 20 m away, over waves of turf or flat turf.

The athlete stands at (0, 1) facing -y with the club in place of the right hand; the ball lies on a
tee at the origin and play is along +x, to the athlete's left. The ball is moved by the ball law
(``sports/ball.py``); the athlete stands on the plane z = 0 everywhere: the waves are in the ball
law and in the drawing. The head of the club must meet the ball once; the ball then flies, lands,
rolls and rests, which ends the episode. Source: SMPLOlympics section 4 for goal, reward and start;
Rules of Golf, rule 10.1a: the ball is struck with the head of the club, not pushed or scooped, and
a stroke that happens to hit it twice is one stroke.

Fouls end the episode and are no hits: the ball goes backwards or stays on its tee, the shaft meets
it first, the club meets it again after ``STROKE_TIME``, a link comes near it. The landing in the
reward is the first contact of the ball with the turf: until then the one that the ball law predicts
when the ball is hit.

At the start the head is 2.55 m from the ball, where the paper's reward for nearing it,
exp(-100 d^2), is zero in float32: it leads nobody there. The option ``reach`` pays for every metre
by which the head has come nearer to the ball than before, once.

A ball once hit earns 1 a step wherever it goes. By the reward for its place, exp(-0.1 d), a ball
30 m off gains 0.005 a step with a metre: PPO drove every ball as far as it would go, 18 m from
where it should be on average. The option ``aim`` pays for each metre alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import torch
from torch import Tensor

from sports.ball import BALLS, landing_on_waves
from sports.humanoid.body import Body, Shape
from sports.physics.base import GRAVITY, PhysicsState
from sports.scene import Scene, SceneObject, Start, Surface
from sports.task import (
    Advance,
    Memory,
    Task,
    View,
    clamp01,
    constant,
    length,
    nan_where,
    squared,
)

TOOL = "R_Hand"
BALL = BALLS["golf"]
TEE_HEIGHT, TEE_HALF_WIDTH = 0.05, 0.005
"""Of a box (m)."""
PLAYER_Y = 1.0
CLOSEST, FURTHEST = 1.0, 20.0
"""Distances of the target in training (m); in evaluation they begin at 0."""
WAVES = (0.25, 2 * math.pi / 10.0, 2.0, 6.0)
"""Height of each of the two waves (m), their wave number (rad/m), and the distances from the tee
(m) up to which the turf is flat and from which they are full: h(x, y) = 0.25 (cos(k x + a) +
cos(k y + b)) smoothstep, 1 m from peak to peak."""
GRID, GRID_LENGTH, GRID_HALF_WIDTH = 32, 20.0, 10.0
"""Heights that are seen: 32 x 32 points, x in [0, 20], y in [-10, 10] (m)."""
PATIENCE = 2.0
"""Seconds in which the head must meet the ball."""
STROKE_TIME = 1 / 30
"""Seconds in which impacts on the club are one contact: a ball that is squeezed between head and
tee meets either several times in a few milliseconds."""
BACKWARDS = 0.05
"""The ball may go this far (m) behind the tee before it lands."""
KICK = 0.15
"""A link's origin nearer than this (m) to the ball is a kick."""
MOST_WEIGHTS = 30.0
"""Body weights of the club on the ground that are counted."""
REST_SPEED, REST_STEPS = 0.02, 3
"""A ball rests that has been slower than this (m/s) at the end of so many steps in a row: one at
the top of its path would be falling at 0.33 m/s a step later."""
TURF, TEE, HEAD, SHAFT = range(4)
"""Columns of ``Physics.ball_hits``: the order of the scene's surfaces."""


@dataclass(frozen=True)
class Golf:
    """Options of golf."""

    terrain: Literal["waves", "flat"] = "waves"
    """Turf in waves, drawn anew for each episode, or flat."""
    distance: float | None = None
    """Distance of the target (m). None: drawn for each episode."""
    squared: bool = False
    """Squared distances in the rewards for ball and landing: the paper's text instead of its
    code."""
    reach: float = 0.0
    """Reward for each metre by which the head has come nearer to the ball than ever before in the
    episode, until it meets the ball; 0 for the paper's terms alone."""
    aim: float = 0.0
    """Reward for each metre that the ball, once hit, comes nearer to the target, and cost of each
    that it goes away from it (40 m off or more are alike); 0 for the paper's terms alone."""

    turf: float = 0.0
    """Cost of each body weight with which the club presses on the ground, in the substep of each
    step in which it does so most (30 or more are alike); 0 for the paper's terms alone."""

    def __post_init__(self) -> None:
        if self.terrain not in ("waves", "flat"):
            raise ValueError(f"the terrain must be 'waves' or 'flat', not '{self.terrain}'")
        if self.distance is not None and not 0.0 <= self.distance <= FURTHEST:
            raise ValueError(
                f"a target must be between 0 and {FURTHEST:g} m away, not {self.distance}"
            )
        if self.reach < 0.0:
            raise ValueError(f"the reward for reaching must not be negative: {self.reach}")
        if self.aim < 0.0:
            raise ValueError(f"the reward for aiming must not be negative: {self.aim}")
        if self.turf < 0.0:
            raise ValueError(f"the cost of turf must not be negative: {self.turf}")


def scene(config: Golf, body: Body) -> Scene:
    """Ball, tee and turf, and what of the club the ball can meet."""
    shaft, head = body.links[body.link_index(TOOL)].shapes
    assert shaft.end is not None
    x, y, z = ((a + b) / 2 for a, b in zip(shaft.center, shaft.end))
    # A square shaft: the ball is twice as thick, so that its edges matter little.
    along = math.dist(shaft.center, shaft.end) / 2
    thick = (shaft.size[0], along, shaft.size[0])
    link = f"agent0/{TOOL}"
    if config.terrain == "waves":
        turf = Surface("turf", kind="waves", size=WAVES)
    else:
        turf = Surface("turf", kind="plane")
    tee = (TEE_HALF_WIDTH, TEE_HALF_WIDTH, TEE_HEIGHT / 2)
    return Scene(
        name="golf",
        body=body,
        agents=(Start(y=PLAYER_Y, yaw=-math.pi / 2),),
        objects=(
            SceneObject(
                name="ball",
                shapes=(Shape("sphere", (0, 0, 0), (BALL.radius,), BALL.mass),),
                motion="ball",
                law="golf",
                pos=(0.0, 0.0, TEE_HEIGHT + BALL.radius),
                rgba=(0.95, 0.95, 0.95, 1.0),
            ),
        ),
        surfaces=(
            turf,
            Surface("tee", kind="box", center=(0.0, 0.0, TEE_HEIGHT / 2), size=tee),
            Surface("head", kind="box", center=head.center, size=head.size, link=link),
            Surface("shaft", kind="box", center=(x, y, z), size=thick, link=link),
        ),
        sites={"tee": (0.0, 0.0, TEE_HEIGHT)},
    )


def _amplitude(x: Tensor, y: Tensor) -> Tensor:
    """(...) height (m) of each of the two waves at a place."""
    height, _, inner, outer = WAVES
    share = clamp01((torch.hypot(x, y) - inner) / (outer - inner))
    return height * share.square() * (3 - 2 * share)


def turf_height(x: Tensor, y: Tensor, phases: Tensor) -> Tensor:
    """(N, ...) heights of the waves (m) at ``x`` and ``y`` (N, ...), by phases (N, 2) (rad)."""
    k = WAVES[1]
    a, b = phases.view(-1, 2, *[1] * (x.dim() - 1)).unbind(1)
    return _amplitude(x, y) * ((k * x + a).cos() + (k * y + b).cos())


@cache
def _grid(device: torch.device) -> tuple[Tensor, Tensor]:
    """(2, 32) places along x and along y, and (32, 32) amplitude of the waves there (m)."""
    along = torch.linspace(0.0, GRID_LENGTH, GRID, device=device)
    across = torch.linspace(-GRID_HALF_WIDTH, GRID_HALF_WIDTH, GRID, device=device)
    return torch.stack((along, across)), _amplitude(along[:, None], across)


def start(
    view: View,
    state: PhysicsState,
    context: Memory,
    generator: torch.Generator,
    training: bool,
) -> tuple[PhysicsState, Memory]:
    """Draws the distance of the target and the phases of the waves."""
    config: Golf = view.config
    draw = torch.rand(len(state.qpos), 3, device=state.qpos.device, generator=generator)
    closest = CLOSEST if training else 0.0
    distance = closest + (FURTHEST - closest) * draw[:, 0]
    if config.distance is not None:
        distance = torch.full_like(distance, config.distance)
    phases = 2 * math.pi * draw[:, 1:]
    if config.terrain == "waves":
        state.wave_phase = phases
    return state, {"distance": distance, "phases": phases}


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset: the target and the waves of the episode, and the ball on its tee."""
    x, phases = context["distance"], context["phases"]
    zero = torch.zeros_like(x)
    waves = (WAVES[1] * _grid(x.device)[0] + phases[..., None]).cos()
    height = turf_height(x, zero, phases)
    if view.config.terrain == "flat":
        waves, height = torch.zeros_like(waves), zero
    ball = view.physics.object_pos[:, 0]
    return {
        "target": torch.stack((x, zero, height), -1),
        "phases": phases,
        "waves": waves,
        "ball": ball.clone(),
        "met_at": torch.full_like(zero, torch.inf),
        "landed": zero.bool(),
        "landing": ball.clone(),
        "still": zero.clone(),
        "nearest": length(ball - head_pos(view)),
        "launch_speed": torch.full_like(zero, torch.nan),
    }


def head_pos(view: View) -> Tensor:
    """(N, 3) middle of the club head (m)."""
    scene = view.physics.scene
    hand, center = scene.body.link_index(TOOL), scene.surfaces[HEAD].center
    arm = view.rotation[:, 0, hand] * constant(center, view.clock.device)
    return view.physics.body_pos[:, 0, hand] + arm.sum(-1)


def features(view: View, memory: Memory) -> dict[str, Tensor]:
    """Ball, club head and target as seen from the athlete (9), and the heights of the turf (1024).

    Height 32 i + j is that at x = 20 i / 31, y = -10 + 20 j / 31 (m), fixed to the tee.
    """
    points = torch.stack((view.physics.object_pos[:, 0], head_pos(view), memory["target"]), 1)
    ball, head, target = view.heading.local(points[:, None] - view.root_pos[:, :, None]).unbind(2)
    along, across = memory["waves"].unbind(1)
    heights = (along[:, :, None] + across[:, None]).mul_(_grid(points.device)[1])
    return {"ball": ball, "head": head, "target": target, "heights": heights.flatten(1)[:, None]}


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    config: Golf = view.config
    physics = view.physics
    target = memory["target"]
    ball, linvel = physics.object_pos[:, 0], physics.object_linvel[:, 0]

    # Contact, and a second one.
    began = (view.clock - 1) * view.control_timestep
    on_head, on_shaft = physics.ball_hit_time[:, HEAD], physics.ball_hit_time[:, SHAFT]
    met_before = memory["met_at"]
    met_at = torch.minimum(met_before, began + on_head)
    contact = met_at < torch.inf
    first = contact & (met_before == torch.inf)
    on_club = torch.minimum(on_head, on_shaft)
    again = (on_club < torch.inf) & (began + on_club > met_before + STROKE_TIME)
    shaft_first = (on_shaft < on_head) & (met_before == torch.inf)
    to_head = squared(ball - head_pos(view))
    before = memory["nearest"]
    nearest = torch.where(contact, before, torch.minimum(before, to_head.sqrt()))

    # Flight, landing and rest.
    lands = contact & ~memory["landed"] & (physics.ball_hits[:, TURF] > 0)
    where = physics.ball_hit_pos[:, TURF]
    waves = WAVES if config.terrain == "waves" else (0.0, *WAVES[1:])
    spin, phases = physics.object_angvel[:, 0], memory["phases"]
    predicted, _ = landing_on_waves(BALL, ball, linvel, spin, waves, phases, first)
    landing = torch.where(first[:, None], predicted, memory["landing"])
    landing = torch.where(lands[:, None], where, landing)
    landed = memory["landed"] | lands
    x = torch.where(lands, where[:, 0], ball[:, 0])
    backwards = ~memory["landed"] & (x < -BACKWARDS)
    speed = length(linvel)
    launch_speed = torch.where(first, speed, memory["launch_speed"])
    still = (memory["still"] + 1) * (contact & (speed < REST_SPEED))
    at_rest = still >= REST_STEPS
    rests, stayed = at_rest & landed, at_rest & ~landed

    to_links = squared(physics.body_pos[:, 0] - ball[:, None])
    least = constant(_kick_distances(physics.scene.body.link_names), ball.device)
    kicked = (to_links < least).any(-1)
    foul = again | shaft_first | backwards | kicked | stayed
    late = view.clock >= round(PATIENCE / view.control_timestep)
    missed = ~contact & (late | view.fallen()[:, 0])
    hit = contact & ~foul

    miss = torch.stack((ball, landing, memory["ball"])) - target  # (3, N, 3)
    off, landing_off, was_off = length(miss)
    aside = torch.hypot(miss[:2, :, 0], miss[:2, :, 1])
    near, landing_near = (-0.1 * (aside.square() if config.squared else aside)).exp()
    gained = clamp01(was_off - off)
    terms = {
        "approach": (-100.0 * to_head).exp() * ~contact,
        "contact": contact.float(),
        "progress": gained * contact,
        "ball": near * contact,
        "landing": landing_near * contact,
    }
    if config.reach > 0.0:
        terms["reach"] = config.reach * (before - nearest)
    if config.aim > 0.0:
        furthest = 2 * FURTHEST
        terms["aim"] = (
            config.aim * (was_off.clamp(max=furthest) - off.clamp(max=furthest)) * contact
        )
    if config.turf > 0.0:
        force = length(physics.ground_force[:, 0, physics.scene.body.link_index(TOOL)])
        weights = force / (GRAVITY * physics.scene.body.mass)
        terms["turf"] = -config.turf * weights.clamp(max=MOST_WEIGHTS)

    measures = {
        "error": off,
        "landing_error": landing_off.masked_fill(~landed, torch.nan),
        "carry": torch.hypot(landing[:, 0], landing[:, 1]).masked_fill(~landed, torch.nan),
        "launch_speed": launch_speed,
    }
    metrics = dict(zip(measures, nan_where(~hit, torch.stack(tuple(measures.values())))))
    metrics |= {
        "success": hit.float(),
        "hit_rate": hit.float(),
        "contact": contact.float(),
        "foul": foul.float(),
        "nearest": nearest,
    }
    return Advance(
        memory=memory
        | {
            "ball": ball.clone(),
            "met_at": met_at,
            "landed": landed,
            "landing": landing,
            "still": still,
            "nearest": nearest,
            "launch_speed": launch_speed,
        },
        terms={name: term[:, None] for name, term in terms.items()},
        terminated=(foul | missed | rests)[:, None],
        metrics=metrics,
        success=hit,
        remaining_paid=rests & ~foul,
    )


@cache
def _kick_distances(links: tuple[str, ...]) -> tuple[float, ...]:
    """Squared distances (m^2) from the ball that no link may go below; the tool may."""
    return tuple(0.0 if name == TOOL else KICK**2 for name in links)


TASK = Task(
    name="golf",
    config=Golf,
    scene=scene,
    start=start,
    begin=begin,
    features=features,
    advance=advance,
    metrics={
        "success": "fraction",
        "hit_rate": "fraction",
        "error": "m",
        "landing_error": "m",
        "carry": "m",
        "launch_speed": "m/s",
        "contact": "fraction",
        "foul": "fraction",
        "nearest": "m",
    },
    main_metric="success",
    max_steps=300,
    reward_scale=10.0,
    equipment=("club",),
    tools=(TOOL,),
    age_at_start=False,
    summary="Hit a ball off its tee at a target up to 20 m away.",
)
