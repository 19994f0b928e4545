"""Vectors, the flight of a ball and its impacts: the smooth part of the ball law.

The names that compilers fill in: ``vec``, ``quat`` and the types. ``ball`` is a row of numbers, see
``sports.ball.BallLaw.numbers``.
"""

from __future__ import annotations

import math
from typing import Any

Vector = Any
"""Three floats."""
Quat = Any
"""Four floats."""
Row = Matrix = Cube = Any
"""Arrays of floats with 1, 2, 3 axes."""

# Places in a ball's row of numbers.
MASS, RADIUS, SHELL, AIR = 0, 1, 2, 3
DRAG_SLOW, DRAG_FAST, SPEED_SLOW, SPEED_SPAN = 4, 5, 6, 7
BALL_NUMBERS = 8

GRAVITY = 9.81
"""m/s^2, as in ``sports.physics.base``"""
TINY = 1e-12
"""Added under square roots, so that they have derivatives at zero."""


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


def symmetric(diagonal: Vector, mixed: Vector, v: Vector) -> Vector:
    """M v, of a symmetric M, (xx, yy, zz) and (xy, xz, yz). Smooth."""
    return vec(
        diagonal[0] * v[0] + mixed[0] * v[1] + mixed[1] * v[2],
        mixed[0] * v[0] + diagonal[1] * v[1] + mixed[2] * v[2],
        mixed[1] * v[0] + mixed[2] * v[1] + diagonal[2] * v[2],
    )


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
    along = symmetric(diagonal, mixed, n)
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
