"""Javelin: from a standing start with the javelin in the right hand, thrown from behind a line.

The athlete starts at the origin in a hold found by simulation (``sports/humanoid/hold.py``) and
must let go within 1.6 s and stay within 2 m of the start; x = 2 is the foul line. The throw ends
when any part of the javelin touches the ground: the distance is that point's x - 2. Source:
SMPLOlympics section 4 for stages and reward; World Athletics technical rules for the line (no part
of the body may touch the ground on or beyond it, also after the release).

"Hand" is the middle of the right palm, "grip" the javelin's centre of mass. A javelin is released
when the palm is 0.15 m from the whole shaft and nothing of the athlete touches it. From 1.6 s on it
is on its own: a hand near the shaft, or a touch by any link, ends the throw as a failure, so nobody
carries it, kicks it on or catches it again. What touches the ground before the release does not
count, wherever the tip is. Rewards follow the paper, so a metre of the javelin's flight pays the
same whether the throw will count or not.

By the technical rules a throw goes over the shoulder or the upper part of the throwing arm and is
not slung. The paper does not ask how, and a search that was not asked slung it past the hip. So a
throw counts only if the hand was at the shoulder's height or above for the last 0.2 s before the
release (``over_arm``), and if it came down in the sector: between the lines which the rules draw
from 8 m behind their arc through the ends of it, here the points where the foul line meets the
sides of a runway 4 m wide (``in_sector``). ``sling`` and ``anywhere`` ask no more than the paper
does. The same rules want the tip to land first: ``tip_first`` is a metric of the throws that count,
as the paper has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from sports import quaternion
from sports.humanoid.body import Body
from sports.humanoid.hold import JAVELIN, JAVELIN_LENGTH, JAVELIN_RADIUS, NOSE_UP, load_hold
from sports.physics.base import GRAVITY
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

LINE_X, HALF_FIELD = 2.0, 2.0
"""Foul line, and how far from the start the root may be along x and y (m)."""
HOLD_STEPS, THROW_STEPS, RELEASE_STEPS = 18, 36, 48
"""Control steps (0.6, 1.2, 1.6 s): the javelin is held; is thrown; must have left the hand."""
ARC = 8.0
"""Radius of the arc of the rules (m), from whose centre the sector opens: 29 degrees with a runway
4 m wide."""
REACH = 0.15
"""Palm to grip (m) beyond which the grip is lost; palm to shaft beyond which it is let go."""
MAX_TILT = 0.5
"""rad off the attitude of the hold while held."""
TOUCH = 1e-3
"""A support point this close to the ground (m) touches it."""
LOW_HAND, DELIVERY = 0.15, 6
"""A hand more than so far (m) below the shoulder within the last control steps (0.2 s) before the
release slings the javelin."""
OPEN = 0.1
"""From a fingertip's last joint to the middle of the shaft (m) where a hand is open."""
FINGERS = ("Index", "Middle", "Ring", "Pinky", "Thumb")
GOLDEN = 0.6180339887
"""Worlds in a row get numbers of [0, 1) that lie apart by so much, round the end."""
LOOKS, LOOK = 40, 0.1
"""Steps in which the rest of a flight is foretold, and their length (s)."""
END = JAVELIN_LENGTH / 2 - JAVELIN_RADIUS
"""From the grip to the middle of the round ends (m)."""
AIM = (math.cos(NOSE_UP), 0.0, math.sin(NOSE_UP))
"""Where the nose points in the hold."""
# Weights of grab, start, goal and attitude while it is held, while it is thrown, and later.
_WEIGHTS = (0.9, 0.0, 0.0, 0.1, -0.05, 0.05, 0.9, 0.0, 0.0, 0.0, 0.9, 0.1)

_Array = TypeVar("_Array", Tensor, np.ndarray, float)


@dataclass(frozen=True)
class Javelin:
    """Options of the javelin throw."""

    let_go: float = 0.0
    """Reward for each metre by which the fingertips of the hand are, on average, further off the
    shaft than ever before in the episode, up to ``OPEN``, once it need not be held any more; 0 for
    the paper's terms alone. Those pay nothing for a hand that opens a little: PPO (7 M samples)
    held on until it had to have thrown."""
    deadline: int = RELEASE_STEPS
    """Control steps after which it must have left the hand; the rules' 48 (1.6 s), or fewer to
    train with: the longer a hand pushes the further it throws, so an athlete that learned with the
    rules' own deadline lets go in the very last step, shaken loose by the noise of its actions, and
    without that noise never does."""
    sling: bool = False
    """Whether a slung throw counts, as it does in the paper."""
    anywhere: bool = False
    """Whether a throw counts that came down outside the sector, as it does in the paper."""
    release_ends: float = 0.0
    """Share of the worlds, the first ones, whose episodes end with the release, where all that the
    javelin would earn in the air is paid at once (:func:`flight`): three in four steps of an
    episode are flight, in which there is nothing to do. A touch or a step over the line after the
    release is not seen there: for that leave some worlds whole. The rules need the whole flight."""
    release_turn: tuple[float, float] = (0.0, 0.0)
    """With ``release_ends``: how much more the nose turns to the left (rad/s) in what is foretold,
    from the first to the second, spread evenly over the worlds. What the last millisecond of a
    grip does to it differs between engines: the same throw turned by 0.5 rad/s in MuJoCo and by -1
    in Drake, where it came down 11 m earlier (docs/physics.md). Who throws far on average here has
    its nose along its path."""
    counts: bool = False
    """With ``release_ends``: what is foretold is paid only where the throw will count, thrown over
    the arm and down in the sector. The paper's terms pay the same for a metre that does not: a
    thrower who learned by them won twelve metres and lost a tenth of its throws to the left of the
    sector (18.6 M samples)."""

    def __post_init__(self) -> None:
        if not THROW_STEPS < self.deadline <= RELEASE_STEPS:
            raise ValueError(
                f"the deadline must be above {THROW_STEPS} and at most {RELEASE_STEPS} control "
                f"steps, not {self.deadline}"
            )
        if not 0.0 <= self.release_ends <= 1.0:
            raise ValueError(f"a share of the worlds is in [0, 1], not {self.release_ends}")
        for name, given in (("release_turn", any(self.release_turn)), ("counts", self.counts)):
            if given and self.release_ends == 0.0:
                raise ValueError(f"{name} is of a flight that is foretold: give release_ends")
        if self.let_go < 0.0:
            raise ValueError(f"the reward for letting go must not be negative: {self.let_go}")


def scene(config: Javelin, body: Body) -> Scene:
    """The athlete with the javelin in its hand. Raises ValueError for a body without fingers."""
    hold = load_hold("javelin")
    return Scene(
        name="javelin",
        body=body,
        agents=(hold.start(body),),
        objects=(hold.placed(JAVELIN),),
        offset=hold.targets(body),
        steady=hold.steady(body),
        contact_pairs=(("agent0", "javelin"), ("javelin", GROUND)),
        timestep=1.0 / 240.0,
        substeps=8,
        sites={"start": (0.0, 0.0, 0.0)},
    )


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset: in the hand. In the middle of a throw, too, the start is where the
    athlete of the scene stands."""
    ends, speeds = _ends(view)
    zero = torch.zeros_like(ends[:, 0, 0])
    start = constant(view.physics.scene.start_qpos[:3], zero.device)
    memory = {
        "start": start.expand(len(zero), 3).clone(),
        "x": view.physics.object_pos[:, 0, 0].clone(),
        "ends": ends,
        "speeds": speeds,
        "fall": fall(view.physics.object_linvel[:, 0], _nose(ends)),
        "released": zero > 0,
        "release_speed": torch.full_like(zero, torch.nan),
        "hand_heights": _height(view, _palm(view))[:, None].expand(-1, DELIVERY).clone(),
    }
    if view.config.let_go > 0.0:
        memory["opening"] = _opening(view, _nose(ends))
    return memory


def features(view: View, memory: Memory) -> dict[str, Tensor]:
    """The javelin, the hand and the way from the start, as seen from the athlete (19)."""
    physics, root = view.physics, view.root_pos
    vectors = torch.stack(
        (
            physics.object_pos - root,
            physics.object_linvel,
            physics.object_angvel,
            _palm(view)[:, None] - root,
            root - memory["start"][:, None],
        ),
        dim=2,
    )
    pos, linvel, angvel, hand, way = view.heading.local(vectors).unbind(2)
    # The heading is a turn about z by atan2(sin, cos); its conjugate comes first.
    half = 0.5 * torch.atan2(view.heading.sin, view.heading.cos)
    zero = torch.zeros_like(half)
    turn = torch.stack((half.cos(), zero, zero, -half.sin()), dim=-1)
    attitude = quaternion.multiply(turn, physics.object_quat)
    attitude = torch.where(attitude[..., :1] < 0, -attitude, attitude)
    return {
        "javelin_pos": pos,
        "javelin_quat": attitude,
        "javelin_linvel": linvel,
        "javelin_angvel": angvel,
        "hand": hand,
        "root": way,
    }


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    physics, root, clock = view.physics, view.root_pos[:, 0], view.clock
    grip, velocity, hand = physics.object_pos[:, 0], physics.object_linvel[:, 0], _palm(view)
    ends, speeds = _ends(view)
    nose = _nose(ends)

    held, late = clock < HOLD_STEPS, clock >= THROW_STEPS
    aim = torch.where(late[:, None], _unit(velocity), constant(AIM, root.device))
    angle = torch.acos((nose * aim).sum(-1).clamp(-1.0, 1.0))
    to_hand = hand - grip
    apart = squared(to_hand)
    near = torch.exp(-torch.stack((apart, squared(root - memory["start"]))))
    x = grip[:, 0]
    shares = torch.stack((near[0], near[1], x - memory["x"], torch.exp(-angle.square())), dim=-1)
    weights = constant(_WEIGHTS, root.device).view(3, 4)
    names = ("grab", "start", "goal", "attitude")
    stage = (clock >= HOLD_STEPS).long() + late
    terms: dict[str, Tensor] = dict(zip(names, (weights[stage] * shares).unbind(-1)))
    shaping: Memory = {}
    if view.config.let_go > 0.0:
        opening = torch.maximum(memory["opening"], _opening(view, nose))
        terms["let_go"] = view.config.let_go * (opening - memory["opening"]).masked_fill(held, 0.0)
        shaping["opening"] = opening

    # The hand leaves the shaft.
    touched, landed = (physics.pair_force > 0).unbind(-1)
    along = (to_hand * nose).sum(-1).clamp(-END, END)
    away = squared(torch.addcmul(to_hand, along[:, None], nose, value=-1)) > REACH**2
    free = away & ~touched
    released = memory["released"] | free
    lost = held & ((apart > REACH**2) | (angle > MAX_TILT))
    clinging = (clock >= view.config.deadline) & ~free

    furthest = view.geometry.marks(physics.body_pos[:, 0], view.rotation[:, 0], TOUCH).furthest
    touches_beyond = view.touching()[:, 0] & (physics.body_pos[:, 0, :, 0] >= LINE_X)
    outside = (root[:, :2].abs() > HALF_FIELD).any(-1)
    foul = outside | (furthest >= LINE_X) | touches_beyond.any(-1)
    fell = view.fallen()[:, 0] & ~released
    failed = lost | clinging | foul | fell

    before = memory["ends"], memory["speeds"], memory["fall"]
    mark, aside, nose_first = _landing(*before, view.control_timestep)
    # What the hand still held when it came down was no throw: the release was seen before.
    thrown, done = landed & memory["released"], failed | landed
    foretold = None
    if view.config.release_ends > 0.0:
        number = torch.arange(len(x), device=x.device)
        over = (number < view.config.release_ends * len(x)) & free & ~memory["released"] & ~failed
        low, high = view.config.release_turn
        left = low + (high - low) * ((number * GOLDEN) % 1.0) if low or high else None
        come = flight(view, nose, view.control_timestep, left)
        mark, aside = torch.where(over, come.x, mark), torch.where(over, come.y, aside)
        nose_first = torch.where(over, come.nose_first, nose_first)
        thrown, done = thrown | over, done | over
        foretold = over, come
    distance = mark - LINE_X
    thrown = thrown & ~failed & (distance > 0)
    speed = torch.where(memory["released"], memory["release_speed"], length(velocity))
    heights = torch.cat((memory["hand_heights"][:, 1:], _height(view, hand)[:, None]), dim=1)
    heights = torch.where(memory["released"][:, None], memory["hand_heights"], heights)
    over_arm = (heights >= -LOW_HAND).all(-1)
    in_sector = aside.abs() <= half_sector(distance)
    success = thrown & (over_arm | view.config.sling) & (in_sector | view.config.anywhere)
    if foretold is not None:
        over, come = foretold
        unpaid = ~(over & success) if view.config.counts else ~over
        earned = _WEIGHTS[-2] * (come.x - x), _WEIGHTS[-1] * come.attitude
        for name, more in zip(("goal", "attitude"), earned):
            terms[name] = terms[name] + more.masked_fill(unpaid, 0.0)
    metrics = nan_where(~success, torch.stack((distance, nose_first.float(), speed)))
    metrics = dict(zip(("distance", "tip_first", "release_speed"), metrics))
    metrics |= {
        "over_arm": nan_where(~thrown, over_arm.float()),
        "in_sector": nan_where(~thrown, in_sector.float()),
        "success": success.float(),
        "foul": foul.float(),
    }
    memory = {
        "start": memory["start"],
        "x": x.clone(),
        "ends": ends,
        "speeds": speeds,
        "fall": fall(velocity, nose),
        "released": released,
        "release_speed": nan_where(~released, speed),
        "hand_heights": heights,
        **shaping,
    }
    return Advance(
        memory=memory,
        terms={name: term[:, None] for name, term in terms.items()},
        terminated=done[:, None],
        metrics=metrics,
        success=success,
    )


def _palm(view: View) -> Tensor:
    """(N, 3) the middle of the right palm."""
    physics = view.physics
    body = physics.scene.body
    wrist = body.link_index("R_Wrist")
    palm = constant(body.links[wrist].shapes[0].center, physics.body_pos.device)
    return physics.body_pos[:, 0, wrist] + view.rotation[:, 0, wrist] @ palm


def _height(view: View, palm: Tensor) -> Tensor:
    """(N,) height of the palm (N, 3) over the right shoulder (m)."""
    shoulder = view.physics.scene.body.link_index("R_Shoulder")
    return palm[:, 2] - view.physics.body_pos[:, 0, shoulder, 2]


def _opening(view: View, nose: Tensor) -> Tensor:
    """(N,) mean distance (m) of the fingertips' last joints from the line of the shaft, each at
    most ``OPEN``."""
    physics = view.physics
    body = physics.scene.body
    tips = constant(tuple(body.link_index(f"R_{name}3") for name in FINGERS), nose.device)
    way = physics.body_pos[:, 0, tips] - physics.object_pos[:, :1]
    across = torch.linalg.cross(way, nose[:, None].expand_as(way))
    return length(across).clamp(max=OPEN).mean(-1)


def _ends(view: View) -> tuple[Tensor, Tensor]:
    """(N, 2, 3) the round ends' middles, nose and tail, and their velocities."""
    physics = view.physics
    quat = physics.object_quat[:, 0]
    arm = END * quaternion.rotate(quat, constant((1.0, 0.0, 0.0), quat.device))
    swing = torch.linalg.cross(physics.object_angvel[:, 0], arm)
    arms, swings = torch.stack((arm, -arm), dim=1), torch.stack((swing, -swing), dim=1)
    return physics.object_pos + arms, physics.object_linvel + swings


def _nose(ends: Tensor) -> Tensor:
    """(N, 3) direction in which the javelin points."""
    return (ends[:, 0] - ends[:, 1]) / (2 * END)


def fall(velocity: Tensor, nose: Tensor) -> Tensor:
    """(N, 3) acceleration (m/s^2) of the javelin in free flight, of its velocity (N, 3) and nose:
    gravity and drag."""
    assert JAVELIN.drag is not None
    along_drag, across_drag = (k / JAVELIN.shapes[0].mass for k in JAVELIN.drag)
    speed = (velocity * nose).sum(-1, keepdim=True)
    along = speed * nose
    across = velocity - along
    drag = along_drag * speed.abs() * along + across_drag * length(across)[:, None] * across
    return constant((0.0, 0.0, -GRAVITY), nose.device) - drag


class Flight(NamedTuple):
    """What a javelin in free flight has before it; (N,)."""

    x: Tensor
    y: Tensor
    """Where the end that comes first meets the ground (m)."""
    nose_first: Tensor
    """bool"""
    attitude: Tensor
    """Sum over the control steps of the flight of exp(-angle^2) between nose and velocity."""


def flight(view: View, nose: Tensor, timestep: float, left: Tensor | None = None) -> Flight:
    """The rest of the flight of a javelin whose nose (N, 3) turns on as it does now, or by ``left``
    (N,) more to the left (rad/s), in ``LOOKS`` steps of ``LOOK`` seconds with the drag of their
    middles. Its turn about its own axis moves no nose: the moment of inertia is 1/5800 of that
    about the others."""
    physics = view.physics
    place, velocity = physics.object_pos[:, 0], physics.object_linvel[:, 0]
    spin = physics.object_angvel[:, 0]
    if left is not None:
        spin = torch.cat((spin[:, :2], spin[:, 2:] + left[:, None]), dim=1)
    turn = spin - (spin * nose).sum(-1, keepdim=True) * nose
    rate = length(turn)[:, None].clamp(min=1e-6)
    sideways = torch.linalg.cross(turn / rate, nose)
    after = place[:, 2] < JAVELIN_RADIUS  # has landed
    attitude, now, pull = torch.zeros_like(place[:, 0]), nose, fall(velocity, nose)
    for look in range(LOOKS):
        half, whole = rate * (LOOK * (look + 0.5)), rate * (LOOK * (look + 1))
        middle = half.cos() * nose + half.sin() * sideways
        speed = velocity + 0.5 * LOOK * pull
        off = torch.acos((middle * _unit(speed)).sum(-1).clamp(-1.0, 1.0))
        pull = fall(speed, middle)
        change = LOOK * pull
        way = LOOK * (velocity + 0.5 * change)
        then = whole.cos() * nose + whole.sin() * sideways
        lowest = place[:, 2] - END * now[:, 2].abs()
        drop = lowest - (place + way)[:, 2] + END * then[:, 2].abs()
        share = ((lowest - JAVELIN_RADIUS) / drop.clamp(min=1e-6)).clamp(0.0, 1.0)
        part = torch.where(drop > 0.0, share, 1.0).masked_fill(after, 0.0)
        attitude = attitude + part * (LOOK / timestep) * torch.exp(-off.square())
        place = place + part[:, None] * way
        velocity = velocity + part[:, None] * change
        now = torch.where(part[:, None] > 0.0, torch.lerp(now, then, part[:, None]), now)
        after = after | (part < 1.0)
    # The end that is lower is the one that landed; its own distance counts.
    end = -now[:, 2].sign()[:, None] * END * now
    x, y = (place + end)[:, :2].unbind(-1)
    return Flight(x, y, now[:, 2] < 0.0, attitude)


def half_sector(distance: _Array) -> _Array:
    """How far from the middle (m) a throw of that distance (m) may come down: between the lines
    from the arc's centre through the points 2 m to the left and right on the foul line."""
    return HALF_FIELD + distance * (HALF_FIELD / math.sqrt(ARC**2 - HALF_FIELD**2))


def _landing(
    ends: Tensor, speeds: Tensor, fall: Tensor, timestep: float
) -> tuple[Tensor, Tensor, Tensor]:
    """(N,) x and y where the javelin meets the ground within a control step that began so, and
    whether the nose comes first. The ends (N, 2, 3) fly on their parabolas of acceleration ``fall``
    (N, 3): at 25 m/s a control step is 0.8 m long, and where the javelin is after it has bounced or
    slid says little."""
    z, up, rise = ends[..., 2], speeds[..., 2], fall[:, None, 2]
    drop = (z - JAVELIN_RADIUS).clamp(min=0.0)
    # The smaller root of drop + up t + rise t^2 / 2 = 0, whatever the sign of ``rise``.
    root = (up.square() - 2 * rise * drop).clamp(min=0.0).sqrt()
    time = 2 * drop / (root - up).clamp(min=1e-9)
    first = time.min(dim=1, keepdim=True)
    time = time.clamp(max=timestep)[..., None]
    way = torch.addcmul(speeds[..., :2], time, fall[:, None, :2], value=0.5)
    met = torch.addcmul(ends[..., :2], time, way)
    x, y = met.gather(1, first.indices[..., None].expand(-1, 1, 2))[:, 0].unbind(-1)
    return x, y, first.indices[:, 0] == 0


def _unit(v: Tensor) -> Tensor:
    """(N, 3) directions; 0 where there is none."""
    return v / length(v).clamp(min=1e-6)[:, None]


TASK = Task(
    name="javelin",
    config=Javelin,
    scene=scene,
    start=nothing_to_draw,
    begin=begin,
    features=features,
    advance=advance,
    metrics={
        "success": "fraction",
        "distance": "m",
        "tip_first": "fraction",
        "over_arm": "fraction",
        "in_sector": "fraction",
        "release_speed": "m/s",
        "foul": "fraction",
    },
    main_metric="distance",
    max_steps=300,
    body="smplx",
    age_at_start=False,
    summary="Throw a javelin from behind the line.",
)
