"""The ball law: how tennis, table tennis and golf balls fly, bounce, roll and come to rest.

One source for every engine. The functions are compiled from this file by numba for the CPU and by
Warp for the GPU (``sports.ball_compiled``); where they need no array of a scene they also take
CasADi expressions, for trajectory optimisation. So they use what all of these know: floats,
vectors made by ``vec`` and read by index, ``range``, variables that a loop changes begun as
``float(...)`` or ``int(...)``. Names that the compilers fill in: ``vec``, ``quat``, and the types
of arrays.

Flight: gravity, quadratic drag, Magnus lift along w x v; Runge-Kutta of order 4 over what is left
of a substep. The spin stays as it is in the air.

Impact: the earliest contact with any surface is found by conservative advancement. The distance to
a convex surface is a convex function along a straight line, so along a path whose acceleration is
at most A it stays above ``gap + rate t - A t^2 / 2``: going to the root of that never passes a
contact, and converges as Newton's method does (Mirtich 1996, section 2.3, has the first-order
form). Tools move on the screw from their pose at the beginning of the substep to that at its end,
so windows join without a gap.

Impulses: Newton's restitution and Coulomb's friction as in Chatterjee and Ruina (1998, "A new
algebraic rigid-body collision law based on impulse space considerations"), which never adds
energy, whatever the inertia of the tool.

World frame, z up; m, kg, s, rad. Vectors (x, y, z), quaternions (w, x, y, z).
"""

from __future__ import annotations

import math
from typing import Any

Vector = Any
"""Three floats."""
Quat = Any
"""Four floats."""
Row = Matrix = Cube = IntMatrix = Bits = Any
"""Arrays with 1, 2, 3 axes of floats, with 2 of integers, with 1 of booleans."""

# Places in a ball's row of numbers; see ``sports.ball.BallLaw.numbers``.
MASS, RADIUS, SHELL, AIR = 0, 1, 2, 3
DRAG_SLOW, DRAG_FAST, SPEED_SLOW, SPEED_SPAN = 4, 5, 6, 7
BALL_NUMBERS = 8

# Places in a surface's row of numbers, and of its integers.
CENTER, AXES, SIZE, RESTITUTION, FRICTION, ROLLING, REACH, BEND = 0, 3, 12, 16, 17, 18, 19, 20
SURFACE_NUMBERS = 21
KIND, TOOL = 0, 1
PLANE, BOX, DISC, WAVES = 0, 1, 2, 3

# Places in a tool's row of numbers.
TOOL_MASS, TOOL_CENTER, TOOL_COMPLIANCE = 0, 1, 4
TOOL_NUMBERS = 10

# Places in a ball's state.
POS, ATTITUDE, LINVEL, ANGVEL = 0, 3, 7, 10
STATE_NUMBERS = 13

GRAVITY = 9.81
"""m/s^2, as in ``sports.physics.base``"""
TINY = 1e-12
"""Added under square roots, so that they have derivatives at zero."""
TOUCH = 1e-4
"""A ball nearer than this (m) touches a surface."""
SLACK = 1e-3
"""A touching ball that leaves slower than this (m/s) is held by the surface."""
SOFT = 0.1
"""Impacts slower than this (m/s) do not bounce: 0.5 mm high."""
ROLLS = 1e-3
"""A held ball that slips slower than this (m/s) rolls."""
IMPACTS = 8
"""Most events of a ball in one substep: impacts, or pauses of a long search."""
ADVANCES = 40
"""Most steps of one search for a contact."""
FAR = 2.0
"""A share of the flight that no search finds."""
STRIDE = 0.05
"""Time step (s) of free flights: 1e-6 m from a reference integration (tests)."""
REFINEMENTS = 3
"""Newton steps to the moment at which a flight crosses a plane."""
BOUNCES = 20
"""Most bounces of a path on a plane."""
NEVER = math.inf
PATIENCE = 5.0
"""The longest flight (s) of a launch."""
TRIES, SHOTS = 60, 12
"""Most forward speeds that a launch tries, and most shots at each."""
LESSER = 0.97
"""From one forward speed to the next."""
NEAR = 1e-4
"""A launch that misses its target by less than this (m) has met it."""


def vec(x: float, y: float, z: float) -> Vector:
    """A vector."""
    return (x, y, z)


def quat(w: float, x: float, y: float, z: float) -> Quat:
    """A quaternion."""
    return (w, x, y, z)


# Vectors and rotations.


def add(a: Vector, b: Vector) -> Vector:
    """a + b"""
    return vec(a[0] + b[0], a[1] + b[1], a[2] + b[2])


def times(s: float, a: Vector) -> Vector:
    """s a"""
    return vec(s * a[0], s * a[1], s * a[2])


def ahead(a: Vector, s: float, b: Vector) -> Vector:
    """a + s b"""
    return vec(a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2])


def dot(a: Vector, b: Vector) -> float:
    """a . b"""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """a x b"""
    return vec(
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def length(a: Vector) -> float:
    """|a|"""
    return math.sqrt(dot(a, a))


def combine(x: Vector, y: Vector, z: Vector, v: Vector) -> Vector:
    """M v, of the matrix with columns x, y, z."""
    return vec(
        x[0] * v[0] + y[0] * v[1] + z[0] * v[2],
        x[1] * v[0] + y[1] * v[1] + z[1] * v[2],
        x[2] * v[0] + y[2] * v[1] + z[2] * v[2],
    )


def project(x: Vector, y: Vector, z: Vector, v: Vector) -> Vector:
    """M^T v, of the matrix with columns x, y, z."""
    return vec(dot(x, v), dot(y, v), dot(z, v))


def product(a: Quat, b: Quat) -> Quat:
    """The rotation ``b`` first, then ``a``."""
    return quat(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def axis_x(q: Quat) -> Vector:
    """The first column of a unit quaternion's matrix."""
    y, z = q[2], q[3]
    return vec(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (q[1] * y + q[0] * z),
        2.0 * (q[1] * z - q[0] * y),
    )


def axis_y(q: Quat) -> Vector:
    """The second column."""
    x, z = q[1], q[3]
    return vec(
        2.0 * (x * q[2] - q[0] * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (q[2] * z + q[0] * x),
    )


def axis_z(q: Quat) -> Vector:
    """The third column."""
    x, y = q[1], q[2]
    return vec(
        2.0 * (x * q[3] + q[0] * y),
        2.0 * (y * q[3] - q[0] * x),
        1.0 - 2.0 * (x * x + y * y),
    )


def turned(axis: Vector, angle: float, v: Vector) -> Vector:
    """``v`` turned about a unit axis (Rodrigues)."""
    c, s = math.cos(angle), math.sin(angle)
    side, along = cross(axis, v), (1.0 - c) * dot(axis, v)
    return vec(
        c * v[0] + s * side[0] + along * axis[0],
        c * v[1] + s * side[1] + along * axis[1],
        c * v[2] + s * side[2] + along * axis[2],
    )


def least(a: float, b: float) -> float:
    """The smaller one, also of CasADi expressions."""
    return 0.5 * (a + b - abs(a - b))


def largest(a: float, b: float) -> float:
    """The larger one, also of CasADi expressions."""
    return 0.5 * (a + b + abs(a - b))


# Flight.


def acceleration(v: Vector, spin: Vector, ball: Row) -> Vector:
    """Of a ball in the air (m/s^2), from its velocity and its spin (rad/s). Smooth.

    Drag coefficient: ``DRAG_SLOW`` up to a speed, then falling linearly to ``DRAG_FAST``. Lift
    coefficient 1 / (2 + v / (r w)).
    """
    speed = (dot(v, v) + TINY) ** 0.5
    whirl = (dot(spin, spin) + TINY) ** 0.5 * ball[RADIUS]
    share = least(largest((speed - ball[SPEED_SLOW]) / ball[SPEED_SPAN], 0.0), 1.0)
    drag = ball[DRAG_SLOW] + share * (ball[DRAG_FAST] - ball[DRAG_SLOW])
    slowing = -ball[AIR] * drag * speed
    lift = ball[AIR] * ball[RADIUS] * speed / (2.0 * whirl + speed)
    side = cross(spin, v)
    return vec(
        slowing * v[0] + lift * side[0],
        slowing * v[1] + lift * side[1],
        slowing * v[2] + lift * side[2] - GRAVITY,
    )


def fly(p: Vector, v: Vector, spin: Vector, h: float, ball: Row) -> tuple[Vector, Vector]:
    """Position and velocity after a time (s); Runge-Kutta of order 4. Smooth."""
    a = acceleration(v, spin, ball)
    vb = ahead(v, 0.5 * h, a)
    b = acceleration(vb, spin, ball)
    vc = ahead(v, 0.5 * h, b)
    c = acceleration(vc, spin, ball)
    vd = ahead(v, h, c)
    d = acceleration(vd, spin, ball)
    move = add(add(v, vd), times(2.0, add(vb, vc)))
    push = add(add(a, d), times(2.0, add(b, c)))
    return ahead(p, h / 6.0, move), ahead(v, h / 6.0, push)


# Impacts.


def solved(diagonal: Vector, mixed: Vector, right: Vector) -> Vector:
    """M^-1 right of a symmetric M, (xx, yy, zz) and (xy, xz, yz), by Cramer's rule. Smooth."""
    xx, yy, zz = diagonal[0], diagonal[1], diagonal[2]
    xy, xz, yz = mixed[0], mixed[1], mixed[2]
    ax, ay, az = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    by, bz, cz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    scale = 1.0 / (xx * ax + xy * ay + xz * az)
    return vec(
        scale * (ax * right[0] + ay * right[1] + az * right[2]),
        scale * (ay * right[0] + by * right[1] + bz * right[2]),
        scale * (az * right[0] + bz * right[1] + cz * right[2]),
    )


def impulse(
    slip: Vector, n: Vector, diagonal: Vector, mixed: Vector, restitution: float, friction: float
) -> Vector:
    """On a ball (N s) that meets a surface with relative velocity ``slip`` at the contact, along
    unit ``n`` away from the surface. Smooth.

    The impulse P changes that velocity by M P. With restitution the normal part of it is turned
    round; friction takes away the tangential part as far as its cone allows. With ``stop`` and
    ``stick`` the impulses that end the approach without friction and all relative motion, P is
    (1 + restitution) stop + share (stick - stop), which loses energy for any share in [0, 2].
    """
    along = vec(
        diagonal[0] * n[0] + mixed[0] * n[1] + mixed[1] * n[2],
        mixed[0] * n[0] + diagonal[1] * n[1] + mixed[2] * n[2],
        mixed[1] * n[0] + mixed[2] * n[1] + diagonal[2] * n[2],
    )
    stop = -dot(slip, n) / dot(n, along)
    stick = times(-1.0, solved(diagonal, mixed, slip))
    more = dot(stick, n) - stop
    aside = ahead(stick, -dot(stick, n), n)
    size = (dot(aside, aside) + TINY * TINY) ** 0.5
    push = (1.0 + restitution) * stop
    # |share aside| <= friction (push + share more), and share <= 1
    grip = friction * push
    share = (grip + TINY) / (largest(size - friction * more, grip) + TINY)
    return ahead(times(push + share * more, n), share, aside)


def ball_matrix(n: Vector, ball: Row) -> tuple[Vector, Vector]:
    """M of ``impulse`` for a ball against a fixed surface with unit normal ``n``. Smooth."""
    own, turn = 1.0 / ball[MASS], 1.0 / (ball[SHELL] * ball[MASS])
    both = own + turn
    return (
        vec(both - turn * n[0] * n[0], both - turn * n[1] * n[1], both - turn * n[2] * n[2]),
        vec(-turn * n[0] * n[1], -turn * n[0] * n[2], -turn * n[1] * n[2]),
    )


def struck(v: Vector, spin: Vector, n: Vector, push: Vector, ball: Row) -> tuple[Vector, Vector]:
    """Velocity and spin after an impulse at the contact on the side away from ``n``. Smooth."""
    turn = -1.0 / (ball[SHELL] * ball[MASS] * ball[RADIUS])
    return ahead(v, 1.0 / ball[MASS], push), ahead(spin, turn, cross(n, push))


def bounce(
    v: Vector, spin: Vector, n: Vector, restitution: float, friction: float, ball: Row
) -> tuple[Vector, Vector]:
    """Velocity and spin after an impact on a fixed surface with unit normal ``n``. Smooth."""
    slip = ahead(v, -ball[RADIUS], cross(spin, n))
    diagonal, mixed = ball_matrix(n, ball)
    push = impulse(slip, n, diagonal, mixed, restitution, friction)
    return struck(v, spin, n, push, ball)


# Free flights, for tasks.


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
