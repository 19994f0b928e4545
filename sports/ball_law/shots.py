"""Free flights of a ball, for what tasks ask: landings, paths, launches."""

from __future__ import annotations

import math
from typing import Any

from sports.ball_law.contact import wave
from sports.ball_law.flight import (
    GRAVITY,
    RADIUS,
    TINY,
    Cube,
    Matrix,
    Quat,
    Row,
    Vector,
    add,
    bounce,
    fly,
    quat,
    vec,
)

Bits = Any
"""Array of booleans."""

STRIDE = 0.05
"""Time step (s) of free flights: less than 1 mm from a reference integration (tests)."""
REFINEMENTS = 3
"""Newton steps to the moment at which a flight crosses a plane."""
BOUNCES = 20
"""Most bounces of a path on a plane."""
NEVER = math.inf
"""The time of what does not happen."""
STROLL = 0.01
"""Time step (s) of a flight over waves: 0.3 m at 30 m/s, where a wave is 10 m long."""
HALVINGS = 12
"""Of such a step, to find the landing: 2 microseconds."""
PATIENCE = 5.0
"""The longest flight (s) of a launch."""
TRIES, SHOTS = 60, 12
"""Most forward speeds that a launch tries, and most shots at each."""
LESSER = 0.97
"""From one forward speed to the next."""
NEAR = 1e-4
"""A launch that misses its target by less than this (m) has met it."""


def land(
    p: Vector, v: Vector, spin: Vector, height: float, limit: float, ball: Row
) -> tuple[Vector, float]:
    """Where and when (s) a ball first falls through a height; where it is at the time limit, and
    ``NEVER``, where it does not."""
    q, u = add(p, vec(0.0, 0.0, 0.0)), add(v, vec(0.0, 0.0, 0.0))
    time, found = float(0.0), int(0)
    for _ in range(int(limit / STRIDE) + 2):
        h = float(min(STRIDE, limit - time))
        if h <= 0.0:
            break
        r, s = fly(q, u, spin, h, ball)
        if u[2] > 0.0 and s[2] < 0.0:  # not past the top in one stride
            h = h * u[2] / (u[2] - s[2])
            r, s = fly(q, u, spin, h, ball)
        if q[2] > height and r[2] <= height:
            found = 1
            h = h * (q[2] - height) / (q[2] - r[2])
            for _ in range(REFINEMENTS):
                r, s = fly(q, u, spin, h, ball)
                h = h - (r[2] - height) / s[2]
            r, s = fly(q, u, spin, h, ball)
        q, u = r, s
        time = time + h
        if found == 1:
            break
    if found == 0:
        time = float(NEVER)
    return q, time


def above_waves(p: Vector, waves: Quat, a: float, b: float, ball: Row) -> float:
    """Gap along z between a ball and waves: amplitude, wave number, inner, outer; phases."""
    h, sx, sy = wave(p[0], p[1], waves[0], waves[1], waves[2], waves[3], a, b)
    return p[2] - h - ball[RADIUS] * math.sqrt(1.0 + sx * sx + sy * sy)


def land_on_waves(
    p: Vector,
    v: Vector,
    spin: Vector,
    waves: Quat,
    a: float,
    b: float,
    limit: float,
    ball: Row,
) -> tuple[Vector, float]:
    """Where and when (s) a ball first touches waves; where it is at the time limit, and ``NEVER``,
    where it does not."""
    q, u = add(p, vec(0.0, 0.0, 0.0)), add(v, vec(0.0, 0.0, 0.0))
    for k in range(int(limit / STROLL)):
        r, s = fly(q, u, spin, STROLL, ball)
        if above_waves(r, waves, a, b, ball) <= 0.0:
            early, late = float(0.0), float(STROLL)
            for _ in range(HALVINGS):
                h = 0.5 * (early + late)
                r, s = fly(q, u, spin, h, ball)
                if above_waves(r, waves, a, b, ball) <= 0.0:
                    late = h
                else:
                    early = h
            return r, STROLL * float(k) + late
        q, u = r, s
    return q, float(NEVER)


def meet(
    p: Vector, v: Vector, spin: Vector, x: float, limit: float, ball: Row
) -> tuple[Vector, float]:
    """Where and when (s) a ball first comes to a plane across the x axis; where it is at the time
    limit, and ``NEVER``, where it does not."""
    q, u = add(p, vec(0.0, 0.0, 0.0)), add(v, vec(0.0, 0.0, 0.0))
    time, found = float(0.0), int(0)
    for _ in range(int(limit / STRIDE) + 2):
        h = float(min(STRIDE, limit - time))
        if h <= 0.0:
            break
        r, s = fly(q, u, spin, h, ball)
        if (q[0] - x) * (r[0] - x) <= 0.0 and q[0] != r[0]:
            found = 1
            h = h * (x - q[0]) / (r[0] - q[0])
            for _ in range(REFINEMENTS):
                r, s = fly(q, u, spin, h, ball)
                h = h - (r[0] - x) / s[0]
            r, s = fly(q, u, spin, h, ball)
        q, u = r, s
        time = time + h
        if found == 1:
            break
    if found == 0:
        time = float(NEVER)
    return q, time


def follow(
    p: Vector, v: Vector, spin: Vector, h: float, floor: float, ground: Vector, ball: Row
) -> tuple[Vector, Vector, Vector]:
    """Position, velocity and spin after a time, with bounces on a plane; ``ground`` holds its
    height for the ball's centre, its restitution and friction, and counts where the centre starts
    above it."""
    q, u, w = add(p, vec(0.0, 0.0, 0.0)), add(v, vec(0.0, 0.0, 0.0)), add(spin, vec(0.0, 0.0, 0.0))
    left = float(h)
    for _ in range(int(h / STRIDE) + 2 + BOUNCES):
        if left <= 0.0:
            break
        step = float(min(STRIDE, left))
        r, s = fly(q, u, w, step, ball)
        if r[2] < floor and s[2] < 0.0 and q[2] >= floor:
            fall = float(step)
            # From the later end: the path is bent downwards, so Newton's steps stay there.
            for _ in range(REFINEMENTS + 2):
                fall = fall - (r[2] - floor) / s[2]
                r, s = fly(q, u, w, fall, ball)
            step = max(fall, 0.0)
            s, w = bounce(s, w, vec(0.0, 0.0, 1.0), ground[0], ground[1], ball)
            r = vec(r[0], r[1], floor)
        q, u = r, s
        left = left - step
    return q, u, w


def reach(
    p: Vector, v: Vector, x: float, net: float, ball: Row
) -> tuple[float, float, float, float]:
    """Of a ball without spin that flies to a plane across the x axis: its height and time (s)
    there, its height at another such plane, and its greatest height on the way. ``NEVER`` for the
    time where it has not come there in ``PATIENCE``."""
    way = 1.0 if x > p[0] else -1.0
    none = vec(0.0, 0.0, 0.0)
    q, u = add(p, none), add(v, none)
    time, top, over = float(0.0), float(p[2]), float(NEVER)
    height, when = float(0.0), float(NEVER)
    for _ in range(int(PATIENCE / STRIDE)):
        r, s = fly(q, u, none, STRIDE, ball)
        last = way * (r[0] - x) >= 0.0
        if way * (q[0] - net) < 0.0 and way * (r[0] - net) >= 0.0:
            h = float(STRIDE * (net - q[0]) / (r[0] - q[0]))
            for _ in range(REFINEMENTS):
                a, b = fly(q, u, none, h, ball)
                h = h + (net - a[0]) / b[0]
            a, b = fly(q, u, none, h, ball)
            over = a[2]
        if u[2] > 0.0 and s[2] <= 0.0:
            h = float(STRIDE * u[2] / (u[2] - s[2]))
            a, b = fly(q, u, none, h, ball)
            if way * (a[0] - x) < 0.0:
                top = max(top, a[2])
        if last:
            h = float(STRIDE * (x - q[0]) / (r[0] - q[0]))
            for _ in range(REFINEMENTS):
                a, b = fly(q, u, none, h, ball)
                h = h + (x - a[0]) / b[0]
            a, b = fly(q, u, none, h, ball)
            height, when = a[2], time + h
            top = max(top, a[2])
            break
        top = max(top, r[2])
        q, u = r, s
        time = time + STRIDE
    return height, when, over, top


def aim(
    p: Vector, speed: float, target: Vector, net: float, clear: float, apex: float, ball: Row
) -> Vector:
    """Velocity without spin that brings a ball to ``target`` at a forward speed.

    Without spin it stays in a vertical plane, which gives v_y; v_z comes from shooting. Where the
    centre does not pass over x = ``net`` at ``clear``, the forward speed is lessened by
    ``LESSER`` until it does; where it then rises above ``apex``, raised.
    """
    forward, up = float(speed), float(0.0)
    slope = (target[1] - p[1]) / (target[0] - p[0])
    sense = int(0)
    for _ in range(TRIES):
        time = (target[0] - p[0]) / forward
        up = (target[2] - p[2]) / time + 0.5 * GRAVITY * time
        before, missed = float(0.0), float(0.0)
        over, top = float(0.0), float(0.0)
        for k in range(SHOTS):
            v = vec(forward, forward * slope, up)
            height, when, over, top = reach(p, v, target[0], net, ball)
            miss = height - target[2]
            change = float(miss / when)
            if k > 0 and abs(miss - missed) > TINY:
                change = miss * (up - before) / (miss - missed)
            if abs(miss) < NEAR:
                break
            before, missed = float(up), float(miss)
            up = up - change
        if over < clear and sense <= 0:
            sense = -1
            forward = forward * LESSER
        elif over < clear and sense == 1:
            sense = 2  # the last but one it is
            forward = forward * LESSER
        elif top > apex and (sense == 0 or sense == 1):
            sense = 1
            forward = forward / LESSER
        else:
            break
    return vec(forward, forward * slope, up)


# The same for many worlds.


def read(a: Matrix, i: int) -> Vector:
    """A vector out of an array (..., 3)."""
    return vec(float(a[i, 0]), float(a[i, 1]), float(a[i, 2]))


def put(a: Matrix, i: int, v: Vector) -> None:
    """A vector into an array (..., 3)."""
    for k in range(3):
        a[i, k] = v[k]


def land_world(
    i: int,
    p: Matrix,
    v: Matrix,
    spin: Matrix,
    height: Row,
    limit: float,
    ball: Row,
    pos: Matrix,
    time: Row,
) -> None:
    """``land`` of world ``i``, written to ``pos`` and ``time``."""
    where, when = land(read(p, i), read(v, i), read(spin, i), float(height[i]), limit, ball)
    put(pos, i, where)
    time[i] = when


def land_on_waves_world(
    i: int,
    p: Matrix,
    v: Matrix,
    spin: Matrix,
    phases: Matrix,
    amplitude: float,
    k: float,
    inner: float,
    outer: float,
    limit: float,
    wanted: Bits,
    ball: Row,
    pos: Matrix,
    time: Row,
) -> None:
    """``land_on_waves`` of world ``i`` where it is wanted, written to ``pos`` and ``time``."""
    where, when = read(p, i), float(NEVER)
    if wanted[i]:
        waves = quat(amplitude, k, inner, outer)
        a, b = float(phases[i, 0]), float(phases[i, 1])
        where, when = land_on_waves(where, read(v, i), read(spin, i), waves, a, b, limit, ball)
    put(pos, i, where)
    time[i] = when


def meet_world(
    i: int,
    p: Matrix,
    v: Matrix,
    spin: Matrix,
    x: float,
    limit: float,
    ball: Row,
    pos: Matrix,
    time: Row,
) -> None:
    """``meet`` of world ``i``, written to ``pos`` and ``time``."""
    where, when = meet(read(p, i), read(v, i), read(spin, i), x, limit, ball)
    put(pos, i, where)
    time[i] = when


def path_world(
    i: int,
    p: Matrix,
    v: Matrix,
    spin: Matrix,
    times_: Row,
    floor: float,
    restitution: float,
    friction: float,
    ball: Row,
    path: Cube,
) -> None:
    """Positions at rising times (s) of world ``i``, by ``follow``, written to ``path``."""
    q, u, w = read(p, i), read(v, i), read(spin, i)
    ground = vec(restitution, friction, 0.0)
    now = float(0.0)
    for k in range(times_.shape[0]):
        q, u, w = follow(q, u, w, float(times_[k]) - now, floor, ground, ball)
        now = float(times_[k])
        for j in range(3):
            path[i, k, j] = q[j]


def aim_world(
    i: int,
    p: Matrix,
    speed: Row,
    target: Matrix,
    net: float,
    clear: float,
    apex: float,
    wanted: Bits,
    ball: Row,
    linvel: Matrix,
) -> None:
    """``aim`` of world ``i`` where it is wanted, written to ``linvel``."""
    if wanted[i]:
        v = aim(read(p, i), float(speed[i]), read(target, i), net, clear, apex, ball)
        put(linvel, i, v)


def land_worlds(
    p: Matrix,
    v: Matrix,
    spin: Matrix,
    height: Row,
    limit: float,
    ball: Row,
    pos: Matrix,
    time: Row,
) -> None:
    """``land_world`` of all worlds, on a CPU."""
    for i in range(len(p)):
        land_world(i, p, v, spin, height, limit, ball, pos, time)


def land_on_waves_worlds(
    p: Matrix,
    v: Matrix,
    spin: Matrix,
    phases: Matrix,
    amplitude: float,
    k: float,
    inner: float,
    outer: float,
    limit: float,
    wanted: Bits,
    ball: Row,
    pos: Matrix,
    time: Row,
) -> None:
    """``land_on_waves_world`` of all worlds, on a CPU."""
    for i in range(len(p)):
        land_on_waves_world(
            i, p, v, spin, phases, amplitude, k, inner, outer, limit, wanted, ball, pos, time
        )


def meet_worlds(
    p: Matrix,
    v: Matrix,
    spin: Matrix,
    x: float,
    limit: float,
    ball: Row,
    pos: Matrix,
    time: Row,
) -> None:
    """``meet_world`` of all worlds, on a CPU."""
    for i in range(len(p)):
        meet_world(i, p, v, spin, x, limit, ball, pos, time)


def path_worlds(
    p: Matrix,
    v: Matrix,
    spin: Matrix,
    times_: Row,
    floor: float,
    restitution: float,
    friction: float,
    ball: Row,
    path: Cube,
) -> None:
    """``path_world`` of all worlds, on a CPU."""
    for i in range(len(p)):
        path_world(i, p, v, spin, times_, floor, restitution, friction, ball, path)


def aim_worlds(
    p: Matrix,
    speed: Row,
    target: Matrix,
    net: float,
    clear: float,
    apex: float,
    wanted: Bits,
    ball: Row,
    linvel: Matrix,
) -> None:
    """``aim_world`` of all worlds, on a CPU."""
    for i in range(len(p)):
        aim_world(i, p, speed, target, net, clear, apex, wanted, ball, linvel)
