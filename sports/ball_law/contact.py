"""What a ball can touch, and when it does: surfaces, tools in motion, the search for a contact."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from sports.ball_law.flight import (
    TINY,
    Cube,
    Matrix,
    Quat,
    Row,
    Vector,
    add,
    ahead,
    axis_x,
    axis_y,
    axis_z,
    combine,
    cross,
    dot,
    length,
    product,
    project,
    quat,
    times,
    turned,
    vec,
)

IntMatrix = Any
"""Array of integers with 2 axes."""

# Places in a surface's row of numbers, and its kinds.
CENTER, AXES, SIZE, RESTITUTION, FRICTION, ROLLING, REACH, BEND = 0, 3, 12, 16, 17, 18, 19, 20
KIND, TOOL, BALL_RADIUS = 21, 22, 23
SURFACE_NUMBERS = 24
PLANE, BOX, DISC, WAVES = 0.0, 1.0, 2.0, 3.0

# Places in a tool's row of numbers.
TOOL_MASS, TOOL_CENTER, TOOL_COMPLIANCE = 0, 1, 4
TOOL_NUMBERS = 10

TOUCH = 1e-4
"""A ball nearer than this (m) touches a surface."""
ADVANCES = 40
"""Most steps of one search for a contact."""
FAR = 2.0
"""A share of the flight that no search finds."""
FREE = 1e-4
"""What nothing has touched has a velocity within this (m/s) of that of gravity and drag alone."""
STILL = 1e-9
"""A tool that turns less than this (rad) in a substep does not turn."""
WIDER = 1.6
"""Bound of a tool's way on its screw by the straight way, up to half a turn: pi / 2."""


class Game(NamedTuple):
    """All that the law knows of N worlds of a scene with S surfaces and T tools.

    Tools are the links that surfaces are on. The GPU has the same names with arrays of its own.
    """

    ball: Row
    """(BALL_NUMBERS,)"""
    surfaces: Matrix
    """(S, SURFACE_NUMBERS) centre and axes (of the surface's frame, by columns) in the tool's or
    the world's frame, size, restitution, friction, deceleration of a rolling ball, greatest
    distance from the tool's origin, bound of the curvature (1/m), kind, the tool that it is on or
    -1, radius of the ball."""
    tools: Matrix
    """(T, TOOL_NUMBERS) mass, centre of mass, and inverse inertia about it (xx, yy, zz, xy, xz,
    yz) in the link's frame."""
    phases: Matrix
    """(N, 2) of the waves (rad)."""
    before: Cube
    """(N, T, 7) position and quaternion of each tool at the beginning of the substep."""
    after: Cube
    """(N, T, 7) at its end."""
    pending: Cube
    """(N, T, 6) impulse that each tool is to feel (N s), and its moment about the world's origin
    (N m s)."""
    state: Matrix
    """(N, STATE_NUMBERS) the ball: position, quaternion, velocity, spin."""
    clock: Row
    """(N,) seconds since the control step began."""
    hits: IntMatrix
    """(N, S) impacts on each surface since then."""
    hit_time: Matrix
    """(N, S) when the first of them was (s); inf where there was none."""
    hit_pos: Cube
    """(N, S, 3) where the ball was then."""
    places: IntMatrix
    """(1, 2) where the ball's numbers begin in ``qpos`` and ``qvel``."""
    chains: IntMatrix
    """(T, L) where the root's positions begin in ``qpos``, then those of the three hinges of each
    link on the way to the tool, R_parent_link = Rx Ry Rz; -1 after the last."""
    offsets: Cube
    """(T, L, 3) of those links in their parents (m)."""
    bodies: IntMatrix
    """(T, 2) each tool's body in the engine, and its athlete."""
    dragged: IntMatrix
    """(D, 3) of each object with drag: its body in the engine, where its numbers begin in ``qpos``
    and ``qvel``."""
    drags: Matrix
    """(D, 4) N s^2/m^2 along its x axis and across it, mass (kg), and its moment of inertia about
    the x axis as a share of that about the others."""
    tops: Cube
    """(N, D, 11) of each object with drag, from before the substep: the velocity (m/s) that it will
    have if nothing touches it, quaternion, its angular momentum over its inertia about the y axis
    (rad/s), and spin about the x axis (rad/s)."""
    wrench: Cube
    """(N, bodies, 6) what the engine has to apply: force, torque about the centre of mass."""
    applied: Cube
    """(N, A, 6) what each athlete feels of it: force, moment about the world's origin."""


def sign(x: float) -> float:
    """1 or -1."""
    return 1.0 if x >= 0.0 else -1.0


def row(a: Matrix, i: int, k: int) -> Vector:
    """Three numbers of a row, from the k-th on."""
    return vec(float(a[i, k]), float(a[i, k + 1]), float(a[i, k + 2]))


def cell(a: Cube, i: int, j: int, k: int) -> Vector:
    """The same of an array with one more axis."""
    return vec(float(a[i, j, k]), float(a[i, j, k + 1]), float(a[i, j, k + 2]))


def attitude(a: Matrix, i: int, k: int) -> Quat:
    """A quaternion out of a row, from the k-th number on, made a unit one."""
    w, x, y, z = float(a[i, k]), float(a[i, k + 1]), float(a[i, k + 2]), float(a[i, k + 3])
    size = math.sqrt(w * w + x * x + y * y + z * z)
    return quat(w / size, x / size, y / size, z / size)


def posture(a: Cube, i: int, j: int) -> Quat:
    """The quaternion of a pose (position, quaternion)."""
    return quat(float(a[i, j, 3]), float(a[i, j, 4]), float(a[i, j, 5]), float(a[i, j, 6]))


def from_box(x: Vector, half: Vector) -> tuple[float, Vector]:
    """Signed distance of a point from a box about the origin, and the direction away from it."""
    dx, dy, dz = abs(x[0]) - half[0], abs(x[1]) - half[1], abs(x[2]) - half[2]
    sx, sy, sz = sign(x[0]), sign(x[1]), sign(x[2])
    ox, oy, oz = max(dx, 0.0), max(dy, 0.0), max(dz, 0.0)
    out = math.sqrt(ox * ox + oy * oy + oz * oz)
    if out > 0.0:
        return out, vec(sx * ox / out, sy * oy / out, sz * oz / out)
    if dx >= dy and dx >= dz:
        return dx, vec(sx, 0.0, 0.0)
    if dy >= dz:
        return dy, vec(0.0, sy, 0.0)
    return dz, vec(0.0, 0.0, sz)


def from_disc(x: Vector, radius: float, half: float) -> tuple[float, Vector]:
    """The same of a cylinder about the z axis."""
    wide = math.sqrt(x[0] * x[0] + x[1] * x[1])
    cx, cy = float(1.0), float(0.0)
    if wide > 0.0:
        cx, cy = x[0] / wide, x[1] / wide
    beyond, above = wide - radius, abs(x[2]) - half
    o, u, sz = max(beyond, 0.0), max(above, 0.0), sign(x[2])
    out = math.sqrt(o * o + u * u)
    if out > 0.0:
        return out, vec(cx * o / out, cy * o / out, sz * u / out)
    if above >= beyond:
        return above, vec(0.0, 0.0, sz)
    return beyond, vec(cx, cy, 0.0)


def wave(
    x: float, y: float, amplitude: float, k: float, inner: float, outer: float, a: float, b: float
) -> tuple[float, float, float]:
    """Height of waves and its derivatives along x and y."""
    far = math.sqrt(x * x + y * y)
    if far <= inner:
        return 0.0, 0.0, 0.0
    share = min((far - inner) / (outer - inner), 1.0)
    rise = amplitude * share * share * (3.0 - 2.0 * share)
    grow = amplitude * 6.0 * share * (1.0 - share) / ((outer - inner) * far)
    swell = math.cos(k * x + a) + math.cos(k * y + b)
    slope_x = grow * x * swell - rise * k * math.sin(k * x + a)
    slope_y = grow * y * swell - rise * k * math.sin(k * y + b)
    return rise * swell, slope_x, slope_y


def gap(surfaces: Matrix, i: int, x: Vector, a: float, b: float) -> tuple[float, Vector]:
    """Between a ball at ``x`` in the frame of surface ``i`` and that surface (m; over waves
    along z), and its gradient, longer than 1 only over waves. Waves have the phases a, b."""
    kind, radius = surfaces[i, KIND], surfaces[i, BALL_RADIUS]
    size = row(surfaces, i, SIZE)
    if kind == BOX:
        far, away = from_box(x, size)
        return far - radius, away
    if kind == DISC:
        far, away = from_disc(x, size[0], size[1])
        return far - radius, away
    if kind == WAVES:
        h, sx, sy = wave(x[0], x[1], size[0], size[1], size[2], surfaces[i, SIZE + 3], a, b)
        return x[2] - h - radius * math.sqrt(1.0 + sx * sx + sy * sy), vec(-sx, -sy, 1.0)
    return x[2] - radius, vec(0.0, 0.0, 1.0)


def window(before: Cube, after: Cube, w: int, t: int) -> tuple[Vector, Quat, Vector, float, Vector]:
    """The motion of a tool in a substep: origin and attitude at its beginning; the unit axis and
    the angle of its turn, and the move of its origin, until the end."""
    origin, end = cell(before, w, t, 0), cell(after, w, t, 0)
    old, new = posture(before, w, t), posture(after, w, t)
    d = product(new, quat(old[0], -old[1], -old[2], -old[3]))
    s = sign(d[0])
    half = math.sqrt(d[1] * d[1] + d[2] * d[2] + d[3] * d[3])
    axis, angle = vec(0.0, 0.0, 1.0), float(0.0)
    if half > STILL:
        axis = vec(s * d[1] / half, s * d[2] / half, s * d[3] / half)
        angle = 2.0 * math.atan2(half, s * d[0])
    return origin, old, axis, angle, ahead(end, -1.0, origin)


def carried(
    origin: Vector, axis: Vector, angle: float, move: Vector, share: float
) -> tuple[Vector, Vector]:
    """Where a tool's origin is after a share of its screw, and its velocity by share."""
    if angle < STILL:
        return ahead(origin, share, move), move
    half, rise = 0.5 * angle, dot(axis, move)
    side = ahead(move, -rise, axis)
    s = math.sin(half)
    chord = times(math.sin(half * share) / s, turned(axis, half * (share - 1.0), side))
    speed = times(half / s, turned(axis, angle * (share - 0.5), side))
    return add(ahead(origin, share * rise, axis), chord), ahead(speed, rise, axis)


def search(
    surfaces: Matrix,
    before: Cube,
    after: Cube,
    w: int,
    i: int,
    a: float,
    b: float,
    begin: float,
    share: float,
    slack: float,
    limit: float,
    ca: Vector,
    cb: Vector,
    cc: Vector,
    cd: Vector,
) -> tuple[float, int]:
    """The first contact of a ball on the path ``ca + cb s + cc s^2 + cd s^3``, s in [0, 1], with
    surface ``i``: s, and 1 (0 where the search only came so far without one). ``FAR`` where there
    is none before ``limit``.

    The path covers ``share`` of the substep from ``begin`` on. A touching ball that leaves slower
    than ``slack`` (m by s) is in contact.
    """
    tool = int(surfaces[i, TOOL])
    center = row(surfaces, i, CENTER)
    ax, ay = row(surfaces, i, AXES), row(surfaces, i, AXES + 3)
    az = row(surfaces, i, AXES + 6)
    lb, lc, ld = length(cb), length(cc), length(cd)
    path, fast = lb + lc + ld, lb + 2.0 * lc + 3.0 * ld
    bend = 2.0 * lc + 6.0 * ld + TINY
    origin, axis, move = vec(0.0, 0.0, 0.0), vec(0.0, 0.0, 1.0), vec(0.0, 0.0, 0.0)
    angle = float(0.0)
    if tool >= 0:
        near = surfaces[i, REACH] + surfaces[i, BALL_RADIUS] + path + TOUCH
        far = length(ahead(ca, -1.0, cell(before, w, tool, 0)))
        drift = cell(after, w, tool, 0)
        drift = ahead(drift, -1.0, cell(before, w, tool, 0))
        shift = WIDER * length(drift)
        if far > near + shift:
            return FAR, 0
        origin, old, axis, angle, move = window(before, after, w, tool)
        lx, ly, lz = axis_x(old), axis_y(old), axis_z(old)
        center = combine(lx, ly, lz, center)
        ax, ay = combine(lx, ly, lz, ax), combine(lx, ly, lz, ay)
        az = combine(lx, ly, lz, az)
        # Bounds of what the frame adds: of its origin, of Coriolis and centripetal terms.
        quick, whirl = share * shift, share * angle
        meet = fast + quick
        bend = bend + whirl * (quick + 2.0 * meet + whirl * (far + shift + meet))
    else:
        g, slope = gap(surfaces, i, project(ax, ay, az, ahead(ca, -1.0, center)), a, b)
        curve = surfaces[i, BEND]
        if g > (length(slope) + curve * path) * path + TOUCH:
            return FAR, 0
        bend = bend + curve * fast * fast
    s = float(0.0)
    for _ in range(ADVANCES):
        p = ahead(ahead(ahead(ca, s, cb), s * s, cc), s * s * s, cd)
        dp = ahead(ahead(cb, 2.0 * s, cc), 3.0 * s * s, cd)
        if tool >= 0:
            at = begin + s * share
            o, do = carried(origin, axis, angle, move, at)
            p = ahead(p, -1.0, o)
            dp = ahead(dp, -share, ahead(do, angle, cross(axis, p)))
            if angle >= STILL:
                p, dp = turned(axis, -angle * at, p), turned(axis, -angle * at, dp)
        g, slope = gap(surfaces, i, project(ax, ay, az, ahead(p, -1.0, center)), a, b)
        rate = dot(slope, project(ax, ay, az, dp))
        if g <= TOUCH and rate < slack:
            return s, 1
        room = g if g > TOUCH else max(g, 0.0) + TOUCH
        root = math.sqrt(rate * rate + 2.0 * bend * room)
        s = s + (2.0 * room / (root - rate) if rate < 0.0 else (root + rate) / bend)
        if s >= limit:
            return FAR, 0
    return s, 0


def meeting(
    surfaces: Matrix,
    before: Cube,
    after: Cube,
    w: int,
    i: int,
    a: float,
    b: float,
    at: float,
    p: Vector,
) -> tuple[float, Vector, Vector, Vector]:
    """A ball at ``p`` and surface ``i`` after a share of the substep: the gap (m), the unit normal
    towards the ball, the origin of the surface's link (or of the world) and the velocity, by
    substep, of its point at the contact."""
    tool = int(surfaces[i, TOOL])
    center = row(surfaces, i, CENTER)
    ax, ay = row(surfaces, i, AXES), row(surfaces, i, AXES + 3)
    az = row(surfaces, i, AXES + 6)
    if tool < 0:
        g, slope = gap(surfaces, i, project(ax, ay, az, ahead(p, -1.0, center)), a, b)
        scale, zero = 1.0 / length(slope), vec(0.0, 0.0, 0.0)
        return scale * g, times(scale, combine(ax, ay, az, slope)), zero, zero
    origin, old, axis, angle, move = window(before, after, w, tool)
    o, do = carried(origin, axis, angle, move, at)
    lx, ly, lz = axis_x(old), axis_y(old), axis_z(old)
    q = project(lx, ly, lz, turned(axis, -angle * at, ahead(p, -1.0, o)))
    g, slope = gap(surfaces, i, project(ax, ay, az, ahead(q, -1.0, center)), a, b)
    n = turned(axis, angle * at, combine(lx, ly, lz, combine(ax, ay, az, slope)))
    arm = ahead(ahead(p, -surfaces[i, BALL_RADIUS], n), -1.0, o)
    return g, n, o, ahead(do, angle, cross(axis, arm))
