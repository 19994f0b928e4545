"""A ball in play: impacts on surfaces and tools, rolling, rest; a substep of a world.

Engines call, for each world, ``begin_world`` before a control step, ``push_world`` before and
``turn_world`` and ``finish_world`` after each substep.
"""

from __future__ import annotations

import math

from sports.ball_law.contact import (
    FREE,
    FRICTION,
    RESTITUTION,
    ROLLING,
    STILL,
    TOOL,
    TOOL_CENTER,
    TOOL_COMPLIANCE,
    TOOL_MASS,
    TOUCH,
    Game,
    attitude,
    cell,
    meeting,
    posture,
    row,
    search,
    window,
)
from sports.ball_law.flight import (
    GRAVITY,
    RADIUS,
    SHELL,
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
    ball_matrix,
    combine,
    cross,
    dot,
    fly,
    impulse,
    length,
    product,
    project,
    quat,
    struck,
    symmetric,
    times,
    turned,
    vec,
)

# Places in a ball's state.
POS, ATTITUDE, LINVEL, ANGVEL = 0, 3, 7, 10
STATE_NUMBERS = 13

SLACK = 1e-3
"""A touching ball that leaves slower than this (m/s) is held by the surface."""
SOFT = 0.1
"""Impacts slower than this (m/s) do not bounce: 0.5 mm high."""
ROLLS = 1e-3
"""A held ball that slips slower than this (m/s) rolls."""
IMPACTS = 8
"""Most events of a ball in one substep: impacts, or pauses of a long search."""
LITTLE = 1e-9
"""The share of a substep that is not worth going on."""
UPRIGHT = 0.1
"""A surface bears a ball where its normal has at least this much of the vertical."""
NO_HIT = math.inf
"""The time of an impact that was not."""


def tool_matrix(tools: Matrix, t: int, arm: Vector) -> tuple[Vector, Vector]:
    """What a tool, as a free rigid body, adds to the M of ``impulse``; ``arm`` from its origin to
    the contact, all in its frame."""
    c = ahead(arm, -1.0, row(tools, t, TOOL_CENTER))
    pure = row(tools, t, TOOL_COMPLIANCE)
    mixed = row(tools, t, TOOL_COMPLIANCE + 3)
    x = cross(symmetric(pure, mixed, vec(0.0, c[2], -c[1])), c)
    y = cross(symmetric(pure, mixed, vec(-c[2], 0.0, c[0])), c)
    z = cross(symmetric(pure, mixed, vec(c[1], -c[0], 0.0)), c)
    free = 1.0 / tools[t, TOOL_MASS]
    return vec(free + x[0], free + y[1], free + z[2]), vec(y[0], z[0], z[1])


def hit(
    ball: Row,
    surfaces: Matrix,
    tools: Matrix,
    before: Cube,
    after: Cube,
    pending: Cube,
    w: int,
    i: int,
    a: float,
    b: float,
    at: float,
    dt: float,
    p: Vector,
    v: Vector,
    spin: Vector,
    bouncing: int,
) -> tuple[Vector, Vector, Vector, int]:
    """An impact of a ball on surface ``i``: its position (moved out of the surface), velocity and
    spin; 1 where it bounced, 0 where the surface holds it from now on. Adds to ``pending``
    what a tool feels. ``bouncing`` 0: do not bounce, whatever the speed."""
    tool, radius = int(surfaces[i, TOOL]), ball[RADIUS]
    g, n, o, flow = meeting(surfaces, before, after, w, i, a, b, at, p)
    if g > 2.0 * TOUCH:
        return p, v, spin, 1
    q = ahead(p, -min(g, 0.0), n)
    slip = ahead(ahead(v, -radius, cross(spin, n)), -1.0 / dt, flow)
    speed = -dot(slip, n)
    if speed <= 0.0:
        return q, v, spin, 0
    bounced = int(0)
    restitution = float(0.0)
    if bouncing == 1 and speed >= SOFT:
        bounced = 1
        restitution = float(surfaces[i, RESTITUTION])
    friction = surfaces[i, FRICTION]
    push = vec(0.0, 0.0, 0.0)
    if tool < 0:
        diagonal, mixed = ball_matrix(n, ball)
        push = impulse(slip, n, diagonal, mixed, restitution, friction)
    else:
        # In the tool's frame, where its inertia is known.
        origin, old, axis, angle, move = window(before, after, w, tool)
        lx = turned(axis, angle * at, axis_x(old))
        ly = turned(axis, angle * at, axis_y(old))
        lz = turned(axis, angle * at, axis_z(old))
        contact = ahead(p, -radius, n)
        own = project(lx, ly, lz, n)
        diagonal, mixed = ball_matrix(own, ball)
        more, mingled = tool_matrix(tools, tool, project(lx, ly, lz, ahead(contact, -1.0, o)))
        diagonal, mixed = add(diagonal, more), add(mixed, mingled)
        push = impulse(project(lx, ly, lz, slip), own, diagonal, mixed, restitution, friction)
        push = combine(lx, ly, lz, push)
        moment = cross(contact, push)
        for k in range(3):
            pending[w, tool, k] = pending[w, tool, k] - push[k]
            pending[w, tool, 3 + k] = pending[w, tool, 3 + k] - moment[k]
    u, whirl = struck(v, spin, n, push, ball)
    return q, u, whirl, bounced


def rolled(
    ball: Row,
    surfaces: Matrix,
    before: Cube,
    after: Cube,
    w: int,
    i: int,
    a: float,
    b: float,
    h: float,
    p: Vector,
    v: Vector,
    spin: Vector,
) -> tuple[Vector, Vector]:
    """Velocity and spin of a ball that lay on surface ``i`` for a time: slowed where it rolls."""
    if surfaces[i, TOOL] >= 0.0:
        return v, spin
    g, n, o, flow = meeting(surfaces, before, after, w, i, a, b, 1.0, p)
    slip = ahead(v, -ball[RADIUS], cross(spin, n))
    slip = ahead(slip, -dot(slip, n), n)
    if g > TOUCH or n[2] < UPRIGHT or dot(slip, slip) > ROLLS * ROLLS:
        return v, spin
    speed, loss = length(v), h * surfaces[i, ROLLING]
    if speed <= loss:
        return vec(0.0, 0.0, 0.0), vec(0.0, 0.0, 0.0)
    return times(1.0 - loss / speed, v), times(1.0 - loss / speed, spin)


def lies(
    ball: Row,
    surfaces: Matrix,
    before: Cube,
    after: Cube,
    w: int,
    a: float,
    b: float,
    p: Vector,
    v: Vector,
    spin: Vector,
) -> int:
    """1 where a ball is at rest, held by a surface against the pull along its slope."""
    if dot(v, v) > 0.0 or dot(spin, spin) > 0.0:
        return 0
    for i in range(surfaces.shape[0]):
        if surfaces[i, TOOL] < 0.0:
            g, n, o, flow = meeting(surfaces, before, after, w, i, a, b, 0.0, p)
            pull = GRAVITY / (1.0 + ball[SHELL]) * math.sqrt(max(1.0 - n[2] * n[2], 0.0))
            if abs(g) <= TOUCH and n[2] >= UPRIGHT and pull <= surfaces[i, ROLLING]:
                return 1
    return 0


def note(game: Game, w: int, i: int, time: float, p: Vector) -> None:
    """Counts an impact on surface ``i``, ``time`` (s) after the control step began."""
    game.hits[w, i] = game.hits[w, i] + 1
    if game.hits[w, i] == 1:
        game.hit_time[w, i] = time
        for k in range(3):
            game.hit_pos[w, i, k] = p[k]


def spun(own: Quat, spin: Vector, h: float) -> Quat:
    """An attitude after a time of turning at a spin."""
    rate = length(spin)
    if rate < STILL:
        return own
    half = 0.5 * rate * h
    s = math.sin(half) / rate
    return product(quat(math.cos(half), s * spin[0], s * spin[1], s * spin[2]), own)


def play(game: Game, w: int, dt: float) -> None:
    """A substep of the ball of world ``w``, in which the tools go from ``game.before`` to
    ``game.after``. ``dt`` 0: nothing happens."""
    if not dt > 0.0:
        return
    ball, surfaces, tools, pending = game.ball, game.surfaces, game.tools, game.pending
    before, after = game.before, game.after
    a, b = float(game.phases[w, 0]), float(game.phases[w, 1])
    p, v = row(game.state, w, POS), row(game.state, w, LINVEL)
    spin = row(game.state, w, ANGVEL)
    rests = int(lies(ball, surfaces, before, after, w, a, b, p, v, spin))
    still, own = vec(0.0, 0.0, 0.0), attitude(game.state, w, ATTITUDE)
    left, held = float(dt), int(0)
    for _ in range(IMPACTS):
        if left <= LITTLE * dt:
            break
        begin, share = 1.0 - left / dt, left / dt
        q, u = add(p, still), add(v, still)
        cb, cc, cd = add(still, still), add(still, still), add(still, still)
        if rests == 0:
            q, u = fly(p, v, spin, left, ball)
            way = ahead(q, -1.0, p)
            cb = times(left, v)
            cc = ahead(ahead(times(3.0, way), -2.0, cb), -left, u)
            cd = ahead(ahead(cb, -2.0, way), left, u)
        first, which = float(1.0), int(-1)
        for i in range(surfaces.shape[0]):
            if (held >> i) & 1 == 0 and (rests == 0 or surfaces[i, TOOL] >= 0.0):
                s, found = search(
                    surfaces,
                    before,
                    after,
                    w,
                    i,
                    a,
                    b,
                    begin,
                    share,
                    SLACK * left,
                    first,
                    p,
                    cb,
                    cc,
                    cd,
                )
                if s < first:
                    first = s
                    which = i if found == 1 else -2
        part = first * left
        if which != -1 and rests == 0:
            q, u = fly(p, v, spin, part, ball)
        p, v, own = q, u, spun(own, spin, part)
        left = left - part
        if which == -1:
            left = 0.0
        at = 1.0 - left / dt
        if held != 0:
            for i in range(surfaces.shape[0]):
                if (held >> i) & 1 == 1:
                    p, v, spin, bounced = hit(
                        ball,
                        surfaces,
                        tools,
                        before,
                        after,
                        pending,
                        w,
                        i,
                        a,
                        b,
                        at,
                        dt,
                        p,
                        v,
                        spin,
                        0,
                    )
                    v, spin = rolled(ball, surfaces, before, after, w, i, a, b, part, p, v, spin)
        if which >= 0:
            rests = 0
            note(game, w, which, game.clock[w] + dt - left, p)
            p, v, spin, bounced = hit(
                ball, surfaces, tools, before, after, pending, w, which, a, b, at, dt, p, v, spin, 1
            )
            if bounced == 1:
                held = 0
            else:
                held = held | (1 << which)
    if left > LITTLE * dt:
        # Squeezed: out of the tools, then out of what does not move.
        for fixed in range(2):
            for i in range(surfaces.shape[0]):
                moves = 1 if surfaces[i, TOOL] >= 0.0 else 0
                if moves + fixed == 1:
                    p, v, spin, bounced = hit(
                        ball,
                        surfaces,
                        tools,
                        before,
                        after,
                        pending,
                        w,
                        i,
                        a,
                        b,
                        1.0,
                        dt,
                        p,
                        v,
                        spin,
                        0,
                    )
    for k in range(3):
        game.state[w, POS + k] = p[k]
        game.state[w, LINVEL + k] = v[k]
        game.state[w, ANGVEL + k] = spin[k]
    for k in range(4):
        game.state[w, ATTITUDE + k] = own[k]
    game.clock[w] = game.clock[w] + dt


def read_ball(game: Game, w: int, qpos: Matrix, qvel: Matrix) -> None:
    """The ball's state out of its places in the engine's (as of a free joint of MuJoCo)."""
    q, v = game.places[0, 0], game.places[0, 1]
    own = attitude(qpos, w, q + 3)
    spin = combine(axis_x(own), axis_y(own), axis_z(own), row(qvel, w, v + 3))
    for k in range(3):
        game.state[w, POS + k] = qpos[w, q + k]
        game.state[w, LINVEL + k] = qvel[w, v + k]
        game.state[w, ANGVEL + k] = spin[k]
    for k in range(4):
        game.state[w, ATTITUDE + k] = own[k]


def write_ball(game: Game, w: int, qpos: Matrix, qvel: Matrix) -> None:
    """The ball's state into its places."""
    q, v = game.places[0, 0], game.places[0, 1]
    own = attitude(game.state, w, ATTITUDE)
    spin = project(axis_x(own), axis_y(own), axis_z(own), row(game.state, w, ANGVEL))
    for k in range(3):
        qpos[w, q + k] = game.state[w, POS + k]
        qvel[w, v + k] = game.state[w, LINVEL + k]
        qvel[w, v + 3 + k] = spin[k]
    for k in range(4):
        qpos[w, q + 3 + k] = own[k]


def place_tool(game: Game, w: int, t: int, qpos: Matrix, pose: Cube) -> None:
    """Writes the pose of a tool's link to (N, T, 7), along the links on the way to it."""
    r = game.chains[t, 0]
    p, own = row(qpos, w, r), attitude(qpos, w, r + 3)
    for j in range(1, game.chains.shape[1]):
        q = game.chains[t, j]
        if q >= 0:
            arm = cell(game.offsets, t, j, 0)
            p = add(p, combine(axis_x(own), axis_y(own), axis_z(own), arm))
            half = times(0.5, row(qpos, w, q))
            sx, sy, sz = math.sin(half[0]), math.sin(half[1]), math.sin(half[2])
            cx, cy, cz = math.cos(half[0]), math.cos(half[1]), math.cos(half[2])
            joint = quat(
                cx * cy * cz - sx * sy * sz,
                sx * cy * cz + cx * sy * sz,
                cx * sy * cz - sx * cy * sz,
                cx * cy * sz + sx * sy * cz,
            )
            own = product(own, joint)
    for k in range(3):
        pose[w, t, k] = p[k]
    for k in range(4):
        pose[w, t, 3 + k] = own[k]


def begin_world(game: Game, w: int, qpos: Matrix, qvel: Matrix) -> None:
    """Before a control step: takes up the state of the engine, forgets the last impacts."""
    if game.places.shape[0] == 1:
        read_ball(game, w, qpos, qvel)
    for t in range(game.chains.shape[0]):
        place_tool(game, w, t, qpos, game.before)
    game.clock[w] = 0.0
    for i in range(game.hits.shape[1]):
        game.hits[w, i] = 0
        game.hit_time[w, i] = NO_HIT
        for k in range(3):
            game.hit_pos[w, i, k] = 0.0


def finish_world(game: Game, w: int, dt: float, qpos: Matrix, qvel: Matrix) -> None:
    """After a substep of the engine: moves the ball and writes it into the engine's state."""
    if game.places.shape[0] == 1:
        for t in range(game.chains.shape[0]):
            place_tool(game, w, t, qpos, game.after)
        play(game, w, dt)
        for t in range(game.chains.shape[0]):
            for k in range(7):
                game.before[w, t, k] = game.after[w, t, k]
        write_ball(game, w, qpos, qvel)


def turn_world(game: Game, w: int, dt: float, qpos: Matrix, qvel: Matrix) -> None:
    """After a substep of the engine: turns the objects with drag that nothing touched in it, whose
    velocity is therefore that of gravity and drag alone. Each is a symmetric top without a torque:
    it turns about its angular momentum and spins about its own axis, exactly so. Engines do not
    know: of a javelin with a spin of 117 rad/s one forgets the slow turn of the axis within 0.1 s,
    with another it grows tenfold."""
    for j in range(game.dragged.shape[0]):
        q, v = game.dragged[j, 1], game.dragged[j, 2]
        change = ahead(row(qvel, w, v), -1.0, cell(game.tops, w, j, 0))
        if dt > 0.0 and length(change) < FREE:
            momentum, spin = cell(game.tops, w, j, 7), float(game.tops[w, j, 10])
            half = 0.5 * (1.0 - game.drags[j, 3]) * spin * dt
            own = posture(game.tops, w, j)
            own = product(own, quat(math.cos(half), math.sin(half), 0.0, 0.0))
            own = spun(own, momentum, dt)
            side = project(axis_x(own), axis_y(own), axis_z(own), momentum)
            for k in range(4):
                qpos[w, q + 3 + k] = own[k]
            qvel[w, v + 3] = spin
            qvel[w, v + 4] = side[1]
            qvel[w, v + 5] = side[2]


def push_world(game: Game, w: int, dt: float, qpos: Matrix, qvel: Matrix) -> None:
    """Before a substep of the engine: writes what it has to apply in it, ``game.wrench``, and what
    the athletes feel of that, ``game.applied``: the impulses of the last substep on the tools, and
    the drag of objects."""
    for agent in range(game.applied.shape[1]):
        for k in range(6):
            game.applied[w, agent, k] = 0.0
    for t in range(game.bodies.shape[0]):
        body, athlete = game.bodies[t, 0], game.bodies[t, 1]
        force, moment = vec(0.0, 0.0, 0.0), vec(0.0, 0.0, 0.0)
        if dt > 0.0:
            force = times(1.0 / dt, cell(game.pending, w, t, 0))
            moment = times(1.0 / dt, cell(game.pending, w, t, 3))
            for k in range(6):
                game.pending[w, t, k] = 0.0
        own = posture(game.before, w, t)
        arm = row(game.tools, t, TOOL_CENTER)
        arm = combine(axis_x(own), axis_y(own), axis_z(own), arm)
        center = add(cell(game.before, w, t, 0), arm)
        torque = ahead(moment, -1.0, cross(center, force))
        for k in range(3):
            game.wrench[w, body, k] = force[k]
            game.wrench[w, body, 3 + k] = torque[k]
            game.applied[w, athlete, k] = game.applied[w, athlete, k] + force[k]
            game.applied[w, athlete, 3 + k] = game.applied[w, athlete, 3 + k] + moment[k]
    for j in range(game.dragged.shape[0]):
        q, v = game.dragged[j, 1], game.dragged[j, 2]
        own, velocity, spin = attitude(qpos, w, q + 3), row(qvel, w, v), row(qvel, w, v + 3)
        axis = axis_x(own)
        along = dot(axis, velocity)
        aside = ahead(velocity, -along, axis)
        force = times(-game.drags[j, 0] * abs(along) * along, axis)
        force = ahead(force, -game.drags[j, 1] * length(aside), aside)
        velocity = ahead(velocity, dt / game.drags[j, 2], force)
        turn = vec(game.drags[j, 3] * spin[0], spin[1], spin[2])
        turn = combine(axis, axis_y(own), axis_z(own), turn)
        for k in range(3):
            game.wrench[w, game.dragged[j, 0], k] = force[k]
            game.wrench[w, game.dragged[j, 0], 3 + k] = 0.0
            game.tops[w, j, k] = velocity[k]
            game.tops[w, j, 7 + k] = turn[k]
        game.tops[w, j, 2] = velocity[2] - GRAVITY * dt
        for k in range(4):
            game.tops[w, j, 3 + k] = own[k]
        game.tops[w, j, 10] = spin[0]


def begin_worlds(game: Game, qpos: Matrix, qvel: Matrix) -> None:
    """``begin_world`` of all worlds, on a CPU."""
    for w in range(len(qpos)):
        begin_world(game, w, qpos, qvel)


def push_worlds(game: Game, timestep: Row, qpos: Matrix, qvel: Matrix) -> None:
    """``push_world`` of all worlds, on a CPU; ``timestep`` (N,)."""
    for w in range(len(qpos)):
        push_world(game, w, timestep[w], qpos, qvel)


def turn_worlds(game: Game, timestep: Row, qpos: Matrix, qvel: Matrix) -> None:
    """``turn_world`` of all worlds, on a CPU; ``timestep`` (N,)."""
    for w in range(len(qpos)):
        turn_world(game, w, timestep[w], qpos, qvel)


def finish_worlds(game: Game, timestep: Row, qpos: Matrix, qvel: Matrix) -> None:
    """``finish_world`` of all worlds, on a CPU; ``timestep`` (N,)."""
    for w in range(len(qpos)):
        finish_world(game, w, timestep[w], qpos, qvel)
