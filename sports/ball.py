"""Tennis, table tennis and golf balls: their numbers, and flights of the ball law for tasks.

:mod:`sports.ball_law` is the law itself, which the engines follow in every substep. Here are the
questions that tasks ask about it, batched over N worlds: where a ball will land, where it will be,
how to launch it at a target. On a CPU they run as compiled loops, on a GPU as kernels; nothing
waits for the device. Positions are of the ball's centre. World frame; m, s, rad, kg.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sports.ball_law import flight
from sports.ball_law.compiled import for_cpu, for_gpu

AIR_DENSITY = 1.204
"""kg/m^3, dry air at 20 deg C and 101.325 kPa (ISO 2533)."""
TIME_LIMIT = 5.0
"""The longest flight (s) that :func:`landing` follows."""
NO_BOUND = 1e9
"""A height (m) that no ball reaches."""


@dataclass(frozen=True)
class BallLaw:
    """The numbers of a kind of ball."""

    mass: float
    """kg"""
    radius: float
    """m"""
    shell: float
    """Moment of inertia by m r^2: 2/3 of a hollow ball, 2/5 of a solid one."""
    drag: tuple[float, float]
    """Drag coefficients at low and at high speed."""
    drag_speeds: tuple[float, float]
    """Between these (m/s) the coefficient goes linearly from one to the other."""
    ground_restitution: float
    """On court, turf, table."""
    tool_restitution: float
    """On racket, paddle, club head."""
    friction: float
    rolling: float
    """Deceleration of a ball that rolls on a flat surface (m/s^2)."""
    rolling_waves: float
    """The same on waves, where it also holds a ball that has come to rest."""

    def numbers(self) -> np.ndarray:
        """(BALL_NUMBERS,) as ``sports.ball_law`` reads them."""
        numbers = np.zeros(flight.BALL_NUMBERS)
        numbers[flight.MASS], numbers[flight.RADIUS] = self.mass, self.radius
        numbers[flight.SHELL] = self.shell
        numbers[flight.AIR] = 0.5 * AIR_DENSITY * math.pi * self.radius**2 / self.mass
        numbers[flight.DRAG_SLOW], numbers[flight.DRAG_FAST] = self.drag
        numbers[flight.SPEED_SLOW] = self.drag_speeds[0]
        numbers[flight.SPEED_SPAN] = self.drag_speeds[1] - self.drag_speeds[0]
        return numbers


BALLS = {
    # Sizes and masses within ITF rule 3, ITTF rule 2.3, R&A equipment rules. Drag: Cross and
    # Lindsey, "Measurements of drag and lift on tennis balls in flight" (2014); for golf the drag
    # crisis of a dimpled sphere. Restitutions of ground give the rebounds of ITF (1.35-1.47 m
    # from 2.54 m) and ITTF (0.23 m from 0.30 m), drag included.
    "tennis": BallLaw(
        mass=0.058,
        radius=0.032,
        shell=2 / 3,
        drag=(0.55, 0.55),
        drag_speeds=(14.0, 25.0),
        ground_restitution=0.774,
        tool_restitution=0.8,
        friction=0.6,
        rolling=0.5,
        rolling_waves=3.0,
    ),
    "table_tennis": BallLaw(
        mass=0.0027,
        radius=0.020,
        shell=2 / 3,
        drag=(0.45, 0.45),
        drag_speeds=(14.0, 25.0),
        ground_restitution=0.905,
        tool_restitution=0.8,
        friction=0.25,
        rolling=0.1,
        rolling_waves=3.0,
    ),
    "golf": BallLaw(
        mass=0.0459,
        radius=0.02135,
        shell=2 / 5,
        drag=(0.5, 0.25),
        drag_speeds=(14.0, 25.0),
        ground_restitution=0.45,
        tool_restitution=0.78,
        friction=0.4,
        rolling=0.8,
        rolling_waves=3.0,
    ),
}
"""By name. The rolling decelerations of tennis and table tennis are ours: coefficients of rolling
resistance of 0.05 (felt on a hard court) and 0.01 (celluloid on wood)."""


def ball_of(law: str | BallLaw) -> BallLaw:
    """A ball by its name. Raises ValueError for an unknown one."""
    if isinstance(law, BallLaw):
        return law
    if law not in BALLS:
        raise ValueError(f"unknown ball law '{law}'; known: {', '.join(BALLS)}")
    return BALLS[law]


def landing(
    law: str | BallLaw,
    pos: Tensor,
    linvel: Tensor,
    angvel: Tensor,
    height: float | Tensor,
    limit: float = TIME_LIMIT,
) -> tuple[Tensor, Tensor]:
    """Where (N, 3) and after how many seconds (N,) balls first fall through a height.

    ``pos``, ``linvel``, ``angvel`` (N, 3); ``height`` of the centre, a number or (N,). A ball that
    does not within ``limit`` (s): where it is then, and inf.
    """
    n = len(pos)
    heights = height if isinstance(height, Tensor) else pos.new_full((n,), height)
    where, when = pos.new_empty(n, 3), pos.new_empty(n)
    arguments = (pos, linvel, angvel, heights, float(limit))
    _run("land_worlds", n, law, arguments, (where, when))
    return where, when


def landing_on_waves(
    law: str | BallLaw,
    pos: Tensor,
    linvel: Tensor,
    angvel: Tensor,
    waves: Sequence[float],
    phases: Tensor,
    mask: Tensor | None = None,
    limit: float = TIME_LIMIT,
) -> tuple[Tensor, Tensor]:
    """Where (N, 3) and after how many seconds (N,) balls first touch a surface of waves.

    ``pos``, ``linvel``, ``angvel`` (N, 3); ``waves``: the size of the ``Surface``, an amplitude of
    0 for flat ground at z = 0; ``phases`` (N, 2). A ball that does not within ``limit`` (s): where
    it is then, and inf. ``mask`` (N,): worlds that want it; the others get ``pos`` and inf, at no
    cost.
    """
    n = len(pos)
    wanted = pos.new_ones(n, dtype=torch.bool) if mask is None else mask
    where, when = pos.new_empty(n, 3), pos.new_empty(n)
    size = tuple(float(x) for x in waves)
    arguments = (pos, linvel, angvel, phases, *size, float(limit), wanted)
    _run("land_on_waves_worlds", n, law, arguments, (where, when))
    return where, when


def crossing(
    law: str | BallLaw,
    pos: Tensor,
    linvel: Tensor,
    angvel: Tensor,
    x: float,
    limit: float = TIME_LIMIT,
) -> tuple[Tensor, Tensor]:
    """Where (N, 3) and after how many seconds (N,) balls in free flight first come to the plane
    at ``x``: over a net. A ball that does not within ``limit`` (s): where it is then, and inf."""
    n = len(pos)
    where, when = pos.new_empty(n, 3), pos.new_empty(n)
    arguments = (pos, linvel, angvel, float(x), float(limit))
    _run("meet_worlds", n, law, arguments, (where, when))
    return where, when


def path(
    law: str | BallLaw,
    pos: Tensor,
    linvel: Tensor,
    angvel: Tensor,
    times: Sequence[float],
    ground: float | None = None,
) -> Tensor:
    """(N, K, 3) where balls will be after K rising times (s).

    In free flight or, with ``ground``, bouncing on the plane at that height (m).
    """
    ball = ball_of(law)
    out = pos.new_empty(len(pos), len(times), 3)
    moments = _constant(tuple(float(t) for t in times), pos.device)
    floor = -NO_BOUND if ground is None else ground + ball.radius
    surface = (floor, ball.ground_restitution, ball.friction)
    _run("path_worlds", len(pos), law, (pos, linvel, angvel, moments, *surface), (out,))
    return out


def launch(
    law: str | BallLaw,
    pos: Tensor,
    speed_x: Tensor,
    target: Tensor,
    net: tuple[float, float] | None = None,
    apex: float = NO_BOUND,
    mask: Tensor | None = None,
) -> Tensor:
    """(N, 3) velocities without spin that bring balls from ``pos`` to ``target``, both (N, 3) and
    of the centre, at a forward velocity ``speed_x`` (N,) towards it, by shooting.

    ``net``: x of a net and the height at which the centre has to pass over it at least (the net,
    the margin, the radius). Where it would not, the forward speed is lessened in steps of 3 %
    until it does; where it then rises above ``apex`` (m), raised as far as the net allows.
    ``mask`` (N,): worlds that want it; the others get zeros, at no cost.
    """
    n = len(pos)
    wanted = pos.new_ones(n, dtype=torch.bool) if mask is None else mask
    x, clear = (NO_BOUND, -NO_BOUND) if net is None else net
    out = pos.new_zeros(n, 3)
    arguments = (pos, speed_x, target, float(x), float(clear), float(apex), wanted)
    _run("aim_worlds", n, law, arguments, (out,))
    return out


def _run(
    name: str, n: int, law: str | BallLaw, arguments: tuple[Any, ...], out: tuple[Tensor, ...]
) -> None:
    """Calls a function of the law for n worlds: arguments, then the ball, then what is written."""
    device = out[0].device
    ball = _ball_numbers(ball_of(law), device)
    given = (*arguments, ball, *out)
    if device.type == "cuda":
        import warp as wp

        values = [wp.from_torch(a.contiguous()) if isinstance(a, Tensor) else a for a in given]
        stream = wp.stream_from_torch(torch.cuda.current_stream(device))
        kernel = getattr(for_gpu(), name)
        wp.launch(kernel, dim=n, inputs=values, device=str(device), stream=stream)
    else:
        function: Callable[..., None] = getattr(for_cpu(), name)
        function(*(a.numpy() if isinstance(a, Tensor) else a for a in given))


@cache
def _ball_numbers(ball: BallLaw, device: torch.device) -> Tensor:
    dtype = torch.float32 if device.type == "cuda" else torch.float64
    return torch.tensor(ball.numbers(), dtype=dtype, device=device)


@cache
def _constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=torch.float32, device=device)
