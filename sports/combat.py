"""What duels share: an opponent to see, a weapon that reaches for it, touches that count.

Two athletes of one body face each other along x. A weapon is a point of a hand: the tip of a sword,
the middle of a glove. It scores on the opponent's trunk and head. An athlete's weapons count as
one: a step in which both gloves land is one point.

Sources: SMPLOlympics, section 4, for goal and reward; World Fencing (FIE) and World Boxing (AIBA)
rules for what a touch is. A point is an event, not a state: after one, the weapon must leave the
targets for half a second before the next, so that neither pushing nor holding pays. Who stays close
to the opponent for a second holds: nothing that weapons do counts or pays until both have stepped
apart, as after the referee's "break" (boxing) or "halt" for body contact (fencing).

Shapes: N worlds, A = 2 athletes, B links, W weapons of each, K targets.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, reduce

import torch
from torch import Tensor

from sports.physics.base import GRAVITY
from sports.scene import Start
from sports.starts import START_NOISE
from sports.task import Advance, Memory, Move, View, constant, place_athlete, squared

TARGETS = ("Pelvis", "Torso", "Spine", "Chest", "Head")
HALF_DISTANCE = 1.5
"""From the middle to each athlete at the start (m)."""
TOUCH_FORCE = 50.0
"""Force (N) from which a contact is a touch."""
TOUCH_DISTANCE_SQUARED = 0.1
"""Of the weapon's point from the target's origin (m^2), the paper's: 0.316 m."""
REST = 0.5
"""Seconds without contact before the next point."""
CLOSE, APART, HOLDING = 0.6, 0.9, 1.0
"""Horizontal distance of the roots (m) below which athletes are close, that from which they have
stepped apart, and the seconds of closeness from which they hold each other. Blows are struck from
0.8 m and more."""
LEFT = 0.03
"""Of an athlete's pose, after a referee has parted it from the other, where it was before. Put back
exactly, two of one policy are mirror images from then on, and what a bout comes to is the same in
all bouts and decided by rounding: a boxer won 44 of 100 against itself and lost 25 on one
processor, and won 27 and lost 42 on another."""
CREDIT = 1.0
"""Seconds after a weapon's contact with the opponent for which the opponent's fall is its doing."""
NEVER = 1e6
"""Steps since a contact that has not been yet."""
FACING, VELOCITY, STRIKE = 0.1, 0.1, 0.6
"""Weights of the reward's terms."""
WANTED_SPEED = 1.0
"""Towards the opponent (m/s); more is not paid."""
MAX_LOAD = 10.0
"""Body weights up to which forces are shown, so that their squares stay numbers that a network can
take."""
ROWS, CONTACTS = 288, 72
"""``Scene.rows_per_world`` and ``contacts_per_world``: twice the most seen in 32 worlds and 300
steps of two athletes thrashing on top of each other (144, 35); at play it is about 100 and 25."""


@dataclass(frozen=True)
class Options:
    """Options of both duels. Raises ValueError for a reward below 0."""

    point: float = 1.0
    """Reward for a point, and cost of the opponent's. The paper's 1 is little beside the up to 0.6
    of every step in which a weapon is near the opponent."""
    conceded: float = 1.0
    """Share of it that the opponent's point costs. At 1, as in the paper, an exchange of blows is
    worth as little to two equals as none."""
    shadow: bool = True
    """Pay how near the weapon is to the opponent in every step, as the paper does. False: pay only
    what is nearer than ever since it could score again. Keeping a glove near the opponent for 10 s
    earns 180 in boxing, and a punch 1: PPO learned to do without (50 M samples)."""
    reach: float = 0.0
    """Reward for each metre that the weapon gets nearer to the opponent than ever since it could
    score again; 0 for the paper's terms alone, by which a weapon more than half a metre away earns
    nothing by coming nearer."""
    knock_down: float = 0.0
    """Reward for the opponent's fall within 1 s after one's own weapon was in contact with it, and
    cost of such a fall; 0 for the paper's terms alone. A fall without contact earns nothing."""
    part: bool = False
    """Who hold each other are parted at once, as by a referee: both are back on guard where the
    bout began. Without it they may stay so to the end, where nothing that weapons do counts."""

    def __post_init__(self) -> None:
        for name in ("point", "conceded", "reach", "knock_down"):
            if getattr(self, name) < 0.0:
                raise ValueError(f"the reward '{name}' must not be negative: {getattr(self, name)}")


@dataclass(frozen=True)
class Weapon:
    """What an athlete hits with."""

    link: str
    side: str
    """Of a contact pair: the link, or one of its shapes."""
    length: float
    """From the link's origin to the weapon's point, along the link's -y (m)."""


def contact_pairs(weapons: tuple[Weapon, ...]) -> tuple[tuple[str, str], ...]:
    """``Scene.contact_pairs``: by athlete, by weapon, by target of the opponent."""
    return tuple(
        (f"agent{a}/{weapon.side}", f"agent{1 - a}/{target}")
        for a in range(2)
        for weapon in weapons
        for target in TARGETS
    )


def on_guard(pose: Mapping[str, float], z: float) -> tuple[Start, Start]:
    """Two athletes who face each other in a pose, their roots at height ``z`` (m)."""
    return (
        Start(-HALF_DISTANCE, pose=pose, z=z),
        Start(HALF_DISTANCE, yaw=math.pi, pose=pose, z=z),
    )


@cache
def _rows(link_names: tuple[str, ...], wanted: tuple[str, ...], device: torch.device) -> Tensor:
    return torch.tensor([link_names.index(name) for name in wanted], device=device)


def _of(view: View, links: Tensor, wanted: tuple[str, ...]) -> Tensor:
    """(N, A, k, ...) the wanted of links (N, A, B, ...)."""
    rows = _rows(view.physics.scene.body.link_names, wanted, links.device)
    return links.index_select(2, rows)


def gaps(view: View, weapons: tuple[Weapon, ...]) -> Tensor:
    """(N, A, W, K, 3) from the points of the athletes' weapons to the origins of the opponent's
    targets, world frame (m)."""
    physics, hands = view.physics, tuple(weapon.link for weapon in weapons)
    origins, axes = _of(view, physics.body_pos, hands), _of(view, physics.body_rot[..., 1], hands)
    lengths = constant(tuple(weapon.length for weapon in weapons), origins.device)[:, None]
    points = torch.addcmul(origins, axes, lengths, value=-1.0)
    targets = _of(view, physics.body_pos, TARGETS).flip(1)
    return targets[:, :, None] - points[:, :, :, None]


def features(view: View, weapons: tuple[Weapon, ...]) -> dict[str, Tensor]:
    """The opponent as an athlete sees it, in its own heading frame (204 + 15 W).

    Root position relative to the own root, rotation (first two columns of its matrix), velocity in
    the world; positions and velocities of all links relative to the own root and its velocity;
    targets relative to the weapons' points; squared force on each link, own and opponent's, of
    everything but the ground, in units of the body weight (paper), up to ``MAX_LOAD``.
    """
    physics = view.physics
    pos, linvel = physics.body_pos, physics.body_linvel
    place = pos.flip(1) - pos[:, :, :1]
    motion = linvel.flip(1)
    turn = view.rotation[:, :, 0].flip(1)[..., :2].transpose(2, 3)  # (N, A, 2, 3)
    parts = {
        "opponent_pos": place[:, :, :1],
        "opponent_rot": turn,
        "opponent_linvel": motion[:, :, :1],
        "opponent_body_pos": place,
        "opponent_body_linvel": motion - linvel[:, :, :1],
        "targets": gaps(view, weapons).flatten(2, 3),
    }
    # One rotation for all of them: it is most of the work.
    seen = view.heading.local(torch.cat(tuple(parts.values()), dim=2)).flatten(2)
    found = dict(zip(parts, seen.split([3 * part.shape[2] for part in parts.values()], dim=-1)))
    weight = GRAVITY * view.geometry.mass.sum()
    load = (squared(physics.link_force) / weight.square()).clamp(max=MAX_LOAD**2)
    return found | {"own_force": load, "opponent_force": load.flip(1)}


def approach(view: View) -> tuple[Tensor, Tensor]:
    """(N, A) how well an athlete faces its opponent, and how it moves towards it, each in [0, 1].

    exp(-2 (1 - cos)) of the horizontal angle between its heading and the opponent;
    exp(-4 max(1 - v, 0)^2) of the horizontal speed v of its root towards it (m/s), 0 unless v > 0.
    """
    root = view.root_pos
    ahead, left, _ = view.heading.local(root.flip(1) - root).unbind(-1)
    vx, vy, _ = view.heading.local(view.root_linvel).unbind(-1)
    far = torch.hypot(ahead, left).clamp(min=1e-6)
    facing = torch.exp(2.0 * (ahead / far - 1.0))
    speed = (vx * ahead + vy * left) / far
    lacking = (WANTED_SPEED - speed).clamp(min=0.0)
    return facing, torch.exp(-4.0 * lacking.square()) * (speed > 0.0)


def begin(view: View, weapons: tuple[Weapon, ...]) -> Memory:
    """Memory after a reset: nobody has scored, every weapon may."""
    squares = squared(gaps(view, weapons))
    nobody = torch.zeros_like(squares[:, :, 0, 0])
    return {
        "squares": squares,
        "nearest": nearness(squares),
        "gap": least_gap(squares),
        "wait": nobody.clone(),
        "touches": nobody.clone(),
        "since_contact": torch.full_like(nobody, NEVER),
        "close_steps": nobody[:, 0].clone(),
        "holding": nobody[:, 0] > 0.0,
    }


def nearness(squares: Tensor) -> Tensor:
    """(N, A) exp(-10 d^2) of the least distance d (m) of an athlete's weapons from the targets, of
    squares (N, A, W, K): the paper's."""
    return torch.exp(-10.0 * squares.flatten(2).amin(-1))


def least_gap(squares: Tensor) -> Tensor:
    """(N, A) least distance (m) of an athlete's weapons from the targets, of squares (N, A, W,
    K)."""
    return squares.flatten(2).amin(-1).sqrt()


def clinch(view: View, memory: Memory) -> tuple[Tensor, Tensor]:
    """(N,) steps for which the athletes have been close, and (N,) bool whether they hold each
    other. PPO (20 M samples) learned to: a weapon near a target pays in every step."""
    root = view.root_pos
    way = squared((root[:, 1] - root[:, 0]) * constant((1.0, 1.0, 0.0), root.device))
    close_steps = (memory["close_steps"] + 1.0).masked_fill(way >= CLOSE**2, 0.0)
    long = close_steps * view.control_timestep >= HOLDING - 1e-6
    return close_steps, (memory["holding"] | long) & (way < APART**2)


def advance(
    view: View, memory: Memory, weapons: tuple[Weapon, ...], faults: Mapping[str, Tensor]
) -> Advance:
    """One control step of a bout. ``faults`` (N, A) by name: who ended it by a fall or by leaving;
    such an athlete has lost, or whoever leads could end the bout by lying down. Otherwise, and
    where both did, more touches win. A fall is a knock-down where a weapon of the opponent was in
    contact, not in a clinch, within ``CREDIT``: only such a fall earns, and costs, what the task's
    option says. Metrics are those of athlete 0, faults and the opponent's faults among them;
    success is a bout it won.
    """
    squares = squared(gaps(view, weapons))
    # The force is the largest of the step's substeps, and the weapon may be off again at its end:
    # the distance is that of the nearer end.
    near = torch.minimum(squares, memory["squares"]) <= TOUCH_DISTANCE_SQUARED
    force = view.physics.pair_force.view(squares.shape)
    touch = ((force >= TOUCH_FORCE) & near).flatten(2).any(-1)
    contact = (force > 0.0).flatten(2).any(-1)

    close_steps, holding = clinch(view, memory)
    free = ~holding[:, None]
    move = None
    if view.config.part:
        move = _parted(view, holding)
        squares = squares.masked_fill(holding[:, None, None, None], math.inf)
        close_steps = close_steps.masked_fill(holding, 0.0)

    wait = memory["wait"]  # steps without contact before the next point
    ready = wait <= 0
    point = touch & ready & free
    rest = round(REST / view.control_timestep)
    wait = torch.where(point | (contact & ~ready), rest, (wait - 1).clamp(min=0))
    since_contact = (memory["since_contact"] + 1.0).masked_fill(contact & free, 0.0)
    recent = since_contact * view.control_timestep <= CREDIT + 1e-6
    downed = (faults["fell"].flip(1) & recent).float()

    scored = point.float()
    touches = memory["touches"] + scored

    facing, velocity = approach(view)
    strike, nearest = nearness(squares) * free, memory["nearest"]
    again = ~ready & (wait <= 0)  # may score again from now on
    if not view.config.shadow:
        closest = torch.maximum(nearest, strike)
        closest = torch.where(again, strike, closest)
        strike, nearest = (strike - nearest).clamp(min=0.0) * ready, closest
        if view.config.part:
            nearest = nearest.masked_fill(holding[:, None], 0.0)
    before, gap = memory["gap"], least_gap(squares)  # infinite after parting
    gained = (before - gap).clamp(min=0.0).masked_fill(before.isinf(), 0.0)
    conceded = view.config.conceded * scored.flip(1)
    terms = {
        "facing": FACING * facing,
        "velocity": VELOCITY * velocity,
        "strike": STRIKE * strike,
        "point": view.config.point * (scored - conceded),
        "reach": view.config.reach * gained * (ready & free),
        "knock_down": view.config.knock_down * (downed - downed.flip(1)),
    }

    mine, theirs = touches.unbind(1)
    ended = reduce(torch.logical_or, faults.values())
    lost, won = ended.unbind(1)
    margin = torch.where(lost == won, mine - theirs, won.float() - lost.float())
    win = margin > 0
    metrics = {
        "success": win.float(),
        "draw": (margin == 0).float(),
        "touches_for": mine,
        "touches_against": theirs,
        "knock_down": downed[:, 0],
    }
    for name, fault in faults.items():
        metrics[name], metrics[f"opponent_{name}"] = fault.float().unbind(1)
    return Advance(
        memory={
            "squares": squares,
            "nearest": nearest,
            "gap": torch.where(again | gap.isinf(), gap, torch.minimum(before, gap)),
            "wait": wait,
            "touches": touches,
            "since_contact": since_contact,
            "close_steps": close_steps,
            "holding": torch.zeros_like(holding) if view.config.part else holding,
        },
        terms=terms,
        terminated=ended,
        metrics=metrics,
        success=win,
        outcome=margin.sign(),
        move=move,
    )


def _parted(view: View, mask: Tensor) -> Move:
    """Both athletes on guard where the bout began, in the worlds of ``mask`` (N,), but for what is
    ``LEFT`` of the way that each joint has come, at most ``START_NOISE``."""
    move, zero = None, torch.zeros_like(view.root_pos[:, 0, 0])
    scene, qpos = view.physics.scene, view.physics.qpos
    for agent, start in enumerate(scene.agents):
        place = (zero + start.x, zero + start.y, zero + start.yaw)
        move = place_athlete(view, mask, agent, *place, onto=move)
        joints = slice(scene.agent_qpos(agent).start + 7, scene.agent_qpos(agent).stop)
        guard = constant(scene.start_qpos[joints], qpos.device)
        left = (LEFT * (qpos[:, joints] - guard)).clamp(-START_NOISE, START_NOISE)
        move.qpos[:, joints] += left * mask[:, None]
    assert move is not None
    return move
