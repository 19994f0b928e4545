"""What games with a ball and two teams share: who sees what, who has the ball, who lies too long.

Teams: the first half of the athletes is team 0 and attacks +x, the second half is team 1 and
attacks -x. A field turned by 180 degrees with the teams exchanged is the same game, and everybody
sees and earns the same (``tests/sports/test_soccer.py``). The ball is the first free object.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache

import torch
from torch import Tensor

from sports import quaternion
from sports.physics.base import PhysicsState
from sports.task import (
    Memory,
    Move,
    View,
    clamp01,
    constant,
    length,
    nan_where,
    place_athlete,
    place_object,
)

BALL_TOP_SPEED = 30.0
"""m/s, at which ``toward`` is 1"""
GET_UP_SECONDS = 1.0
"""So long after its fall an athlete is put back on its feet."""
UPRIGHT = 0.7
"""Height (m) of the root at which an athlete that fell has got up by itself."""
BODY_CLEARANCE, BALL_CLEARANCE = 1.8, 0.6
"""Distances (m) from other athletes, arms stretched out, and from the ball that it needs there."""
FOUL_SECONDS = 1.0
"""For so long a foul costs what it would have brought."""
_RINGS = (BODY_CLEARANCE, 2 * BODY_CLEARANCE)


@cache
def _others(num_agents: int) -> tuple[int, ...]:
    """For each athlete its mates, its opponents beginning with its counterpart, and the ball."""
    size, table = num_agents // 2, []
    for agent in range(num_agents):
        team, place = divmod(agent, max(size, 1))
        if num_agents == 1:
            table += [1]
            continue
        table += [team * size + (place + k) % size for k in range(1, size)]
        table += [(1 - team) * size + (place + k) % size for k in range(size)]
        table += [num_agents]
    return tuple(table)


def attack(view: View) -> Tensor:
    """(A,) 1 for who attacks +x, -1 for who attacks -x."""
    agents = view.physics.scene.num_agents
    signs = tuple(1.0 if a < max(agents // 2, 1) else -1.0 for a in range(agents))
    return constant(signs, view.clock.device)


def seen(view: View, field: Mapping[str, Tensor] | None = None) -> dict[str, Tensor]:
    """The ball, then the ``field`` (features of the sport's own), the mates and the opponents as
    each athlete sees them.

    For each (``ball``, ``mate1``, ..., ``opponent1``, ...) ``_position`` from the own root (N, A,
    3), ``_rotation`` 6-D (N, A, 6), ``_velocity`` linear and angular (N, A, 6), all in the own
    heading frame.
    """
    physics, root = view.physics, view.root_pos
    agents = root.shape[1]
    ball_rot = quaternion.matrix(physics.object_quat[:, :1])
    rot = torch.cat((view.rotation[:, :, 0], ball_rot), 1)  # (N, A + 1, 3, 3)
    things = torch.stack(
        (
            torch.cat((root, physics.object_pos[:, :1]), 1),
            rot[..., 0],
            rot[..., 1],
            torch.cat((view.root_linvel, physics.object_linvel[:, :1]), 1),
            torch.cat((physics.body_angvel[:, :, 0], physics.object_angvel[:, :1]), 1),
        ),
        dim=2,
    )
    of_each = things[:, constant(_others(agents), root.device).view(agents, agents)]
    of_each[..., 0, :] -= root[:, :, None]
    of_each = view.heading.local(of_each)  # (N, A, A, 5, 3)
    mates = agents // 2 - 1
    names = [f"mate{k + 1}" for k in range(mates)]
    names += [f"opponent{k + 1}" for k in range(agents - 1 - max(mates, 0))]

    def one(k: int, name: str) -> dict[str, Tensor]:
        return {
            f"{name}_position": of_each[:, :, k, 0],
            f"{name}_rotation": of_each[:, :, k, 1:3].flatten(2),
            f"{name}_velocity": of_each[:, :, k, 3:].flatten(2),
        }

    features = one(agents - 1, "ball") | dict(field or {})
    for k, name in enumerate(names):
        features |= one(k, name)
    return features


def toward(pos: Tensor, linvel: Tensor, goal: Tensor) -> Tensor:
    """(...) ``v_toward`` of sports.md: speed towards a goal as a share of 30 m/s, in [0, 1]."""
    way = goal - pos
    closing = (linvel * way).sum(-1) / length(way).clamp(min=1e-6)
    return clamp01(closing / BALL_TOP_SPEED)


def crossing(before: Tensor, now: Tensor, x: float) -> tuple[Tensor, Tensor]:
    """Where points (N, 3) that moved from ``before`` to ``now`` in a control step crossed the plane
    at ``x`` on their way out of the field: (N,) bool and (N, 3), on a straight line.

    The fall of a free flight is off that line by up to g T^2 / 8 = 1.4 mm, a bounce within the step
    by up to T / 4 times the change of its vertical speed (7 cm at 5 m/s).
    """
    start, end = before[:, 0] / x, now[:, 0] / x
    crosses = (start < 1.0) & (end >= 1.0)
    along = ((1.0 - start) / (end - start).clamp(min=1e-9)).clamp(0.0, 1.0)
    return crosses, torch.lerp(before, now, along[:, None])


NEVER = 1e6
"""Steps since an event that has not been yet."""


def count_since(event: Tensor, steps: Tensor) -> Tensor:
    """Steps since an event, 0 where it is now; ``steps`` are those of the last step."""
    return (steps + 1.0).masked_fill(event, 0.0)


def recently(view: View, steps: Tensor) -> Tensor:
    """Whether an event was less than ``FOUL_SECONDS`` ago."""
    return steps * view.control_timestep < FOUL_SECONDS - 1e-6


# Who has the ball.


def begin_possession(view: View) -> Memory:
    """Nobody has it yet: ``owner`` (N,), steps of either team ``held`` (N, 2)."""
    zero = torch.zeros_like(view.root_pos[:, 0, 0])
    return {"owner": zero, "held": torch.zeros_like(view.root_pos[:, 0, :2])}


def possession(memory: Memory, touch: Tensor) -> tuple[Memory, Tensor]:
    """A team has the ball from its touch on until the other's; both at once change nothing.

    ``touch`` (N, A) bool. Returns memory and (N,) team 0's share of the time so far, NaN before the
    first touch.
    """
    half = touch.shape[1] // 2
    ours, theirs = touch[:, :half].any(1), touch[:, half:].any(1)
    owner = torch.where(ours == theirs, memory["owner"], ours.float() - theirs.float())
    held = memory["held"] + torch.stack((owner > 0, owner < 0), 1)
    total = held.sum(1)
    share = nan_where(total == 0, held[:, 0] / total)
    return {"owner": owner, "held": held}, share


# What is put elsewhere.


@cache
def _places() -> tuple[float, ...]:
    """Offsets (m) of places to get up, the nearest first: here, then eight on each ring."""
    places = [0.0, 0.0]
    for radius in _RINGS:
        for k in range(8):
            places += [radius * math.cos(k * math.pi / 4), radius * math.sin(k * math.pi / 4)]
    return tuple(places)


def lying(view: View, memory: Memory, fallen: Tensor) -> Memory:
    """Who lies, of who has ``fallen`` (N, A) and who lay before: ``down`` (N, A) steps since the
    fall of who has not got up, ``falls`` (N, A) so far."""
    fell_before = memory["down"] > 0
    lies = fallen | (fell_before & (view.root_pos[..., 2] < UPRIGHT))
    return {
        "down": (memory["down"] + 1.0) * lies,
        "falls": memory["falls"] + (fallen & ~fell_before),
    }


def get_up(
    view: View, down: Tensor, half_length: float, half_width: float, onto: Move | None = None
) -> tuple[Move, Tensor, Tensor]:
    """Puts the athlete of each world that has lain for longest, and for ``GET_UP_SECONDS``, on its
    feet, facing where it faced: where it lies, or else on the nearest of 16 places on two rings
    around it (drawn into the field of +-``half_length`` x +-``half_width``) with nobody and no ball
    near. If all are taken, where it lies. One athlete of a world at a time: the next one's turn is
    a control step later.

    ``down`` (N, A) steps since the fall of who has not got up. Returns the move, ``down`` with 0
    for who got up, and (N, A, 3) the roots after the move.
    """
    root, agents = view.root_pos, down.shape[1]
    ready = down * view.control_timestep >= GET_UP_SECONDS - 1e-6
    each = torch.arange(agents, device=down.device)
    # Of equals the first: each has its own rank.
    rank = torch.where(ready, down, -1.0) - each / (2.0 * agents)
    up = (rank.argmax(1)[:, None] == each) & ready  # (N, A)
    lying = (root * up[..., None]).sum(1)  # (N, 3), zero where nobody gets up
    edge = constant((half_length, half_width), root.device)
    # Turned with the side, so that the game is the same for both.
    side = (attack(view) * up).sum(1)[:, None, None]
    places = constant(_places(), root.device).view(-1, 2)
    at = (lying[:, None, :2] + side * places).clamp(-edge, edge)  # (N, K, 2)
    near = (at[:, :, None] - root[:, None, :, :2]).square().sum(-1) < BODY_CLEARANCE**2
    ball = view.physics.object_pos[:, :1, :2]
    taken = (near & ~up[:, None]).any(-1)
    taken |= (at - ball).square().sum(-1) < BALL_CLEARANCE**2
    order = torch.arange(len(places), device=down.device)
    best = torch.where(taken, -order, len(places) - order).argmax(1)
    spot = torch.take_along_dim(at, best[:, None, None], 1)[:, 0]  # (N, 2)
    yaw = torch.atan2(view.heading.sin, view.heading.cos)
    move = onto
    for agent in range(agents):
        x, y = spot.unbind(-1)
        move = place_athlete(view, up[:, agent], agent, x, y, yaw[:, agent], onto=move)
    assert move is not None
    slices = [view.physics.scene.agent_qpos(agent).start for agent in range(agents)]
    roots = torch.stack([move.qpos[:, s : s + 3] for s in slices], 1)
    return move, down.masked_fill(up, 0.0), torch.where(up[..., None], roots, root)


def drop_inside(
    view: View,
    outside: Tensor,
    half_length: float,
    half_width: float,
    height: float,
    onto: Move | None = None,
) -> tuple[Move, Tensor]:
    """Drops the ball at rest from ``height`` (m), above all heads, at the nearest point of the
    field of +-``half_length`` x +-``half_width`` where ``outside`` (N,) is true. Returns the move
    and (N, 3) the ball's place after it."""
    ball = view.physics.object_pos[:, 0]
    edge = constant((half_length, half_width, height), ball.device)
    low = constant((-half_length, -half_width, height), ball.device)
    inside = ball.clamp(low, edge)
    name = view.physics.scene.free_objects[0].name
    move = place_object(view, outside, name, inside, torch.zeros_like(inside), onto=onto)
    return move, torch.where(outside[:, None], inside, ball)


def turn_ball(state: PhysicsState, first: int, generator: torch.Generator) -> None:
    """Turns the ball, whose position begins at ``first`` in qpos, into any of all directions alike
    (Shoemake 1992). Turned as the field in every start, it would tell an athlete which side it is
    on: one that had learned that touched the ball first in 160 of 200 kick-offs on side 0, in 19 on
    side 1."""
    n, device = state.qpos.shape[0], state.qpos.device
    draw = torch.rand(n, 3, device=device, generator=generator)
    far, angles = draw[:, :1], 2.0 * math.pi * draw[:, 1:]
    one, two = angles.unbind(1)
    of_one, of_two = torch.stack((one.cos(), one.sin()), 1), torch.stack((two.cos(), two.sin()), 1)
    quat = torch.cat((far.sqrt() * of_one, (1.0 - far).sqrt() * of_two), 1)
    state.qpos[:, first + 3 : first + 7] = quat


def apart(places: Tensor, distance: float) -> Tensor:
    """(N, P, 2) the first of K layouts (N, K, P, 2) in which all points are ``distance`` (m) apart;
    the last one if there is none."""
    gaps = (places[:, :, :, None] - places[:, :, None]).square().sum(-1)  # (N, K, P, P)
    size = places.shape[2]
    self_pairs = torch.eye(size, dtype=torch.bool, device=places.device)
    good = (gaps.masked_fill(self_pairs, torch.inf) >= distance**2).flatten(2).all(-1)
    order = torch.arange(places.shape[1], device=places.device)
    first = torch.where(good, len(order) - order, order - len(order)).argmax(1)
    return torch.take_along_dim(places, first[:, None, None, None], 1)[:, 0]
