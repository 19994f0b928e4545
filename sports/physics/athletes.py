"""The arithmetic of athletes in many worlds: loops over worlds and links, compiled by numba.

MuJoCo computes the links of the state *before* a step. Asking it for those of the state after
costs a fifth of a control step, since it computes inertias and contacts along the way; this costs
a fortieth. Every link hangs on three hinges, ``R_parent_link = Rx Ry Rz`` (``body.py``); positions,
attitudes and velocities are summed up from the root (Featherstone 2008, section 5.3).

Arrays of the engine are float64 (N, ...); what is shown is float32 (..., N), as
``sports.physics.results`` lays it out. World frame; m, kg, s, rad, N. Vectors are tuples (x, y, z),
matrices tuples of their columns, quaternions (w, x, y, z).

A compiled function is kept on disk until *its own file* changes: so all of them are in this one,
and constants of other modules come in as arguments.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numba
import numpy as np

from sports.humanoid.mjcf import body_name
from sports.scene import Scene

Vector = tuple[float, float, float]
Columns = tuple[Vector, Vector, Vector]


def compiled(function: Callable[..., Any]) -> Any:
    """``function`` as machine code, made at its first call and kept on disk: beside this file or,
    where that cannot be written, in the user's cache folder. Divisions by zero give inf or NaN."""
    options = {"error_model": "numpy", "nogil": True}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # neither folder can be written
        return numba.njit(**options)(function)


class Tree(NamedTuple):
    """One athlete of a model."""

    parent: np.ndarray
    """(B,) int64; -1 for the root."""
    offset: np.ndarray
    """(B, 3) of the links from their parents, in the frames of those (m)."""
    center: np.ndarray
    """(B, 3) centres of mass, in the links' frames (m)."""
    mass: np.ndarray
    """(B,) kg"""
    inertia: np.ndarray
    """(B, 3, 3) about the centres of mass, in the links' frames (kg m^2)."""
    qpos: int
    """Where its positions begin in ``qpos``."""
    qvel: int
    """Where its velocities begin in ``qvel``."""


def tree_of(model: mujoco.MjModel, scene: Scene, agent: int = 0) -> Tree:
    """An athlete of a scene in its model, as ``mjcf.build_model`` makes it."""
    body = scene.body
    ids = [model.body(body_name(agent, name)).id for name in body.link_names]
    axes = np.empty((len(ids), 9))
    for k, i in enumerate(ids):
        mujoco.mju_quat2Mat(axes[k], model.body_iquat[i])
    axes = axes.reshape(-1, 3, 3)
    return Tree(
        parent=np.array(body.parents(), np.int64),
        offset=model.body_pos[ids],
        center=model.body_ipos[ids],
        mass=model.body_mass[ids],
        inertia=axes @ (model.body_inertia[ids][:, :, None] * axes.swapaxes(1, 2)),
        qpos=scene.agent_qpos(agent).start,
        qvel=scene.agent_qvel(agent).start,
    )


class Pose(NamedTuple):
    """The links of one athlete in one world, float64."""

    quat: np.ndarray
    """(B, 4)"""
    axes: np.ndarray
    """(B, 3, 3) their x, y and z axes: R_WB by columns."""
    pos: np.ndarray
    """(B, 3) origins."""
    linvel: np.ndarray
    """(B, 3) velocities of the origins."""
    angvel: np.ndarray
    """(B, 3)"""


class Athlete(NamedTuple):
    """What is shown of one athlete in N worlds, float32; to be written."""

    quat: np.ndarray
    """(4, B, N)"""
    rot: np.ndarray
    """(3, 3, B, N) R_WB"""
    pos: np.ndarray
    """(3, B, N)"""
    linvel: np.ndarray
    """(3, B, N)"""
    angvel: np.ndarray
    """(3, B, N)"""
    felt: np.ndarray
    """(N, 15 B - 2) as ``Physics.felt``"""
    whole: np.ndarray
    """(6, N) centre of mass and its velocity."""


class Kept(NamedTuple):
    """What the momentum keeper of an athlete in N worlds needs; see ``momentum.py``."""

    expected: np.ndarray
    """(N, 9) angular and linear momentum, place of the centre of mass; NaN where unknown."""
    timestep: np.ndarray
    """(N,)"""
    mass: float
    weight: float
    """Force of gravity along z (N)."""
    no_force: float
    """A root force below this touches nothing."""


# Vectors, matrices and quaternions.


@compiled
def row(a: np.ndarray, i: int) -> Vector:
    """A vector out of an array (..., 3)."""
    return a[i, 0], a[i, 1], a[i, 2]


@compiled
def put(a: np.ndarray, i: int, v: Vector) -> None:
    """A vector into an array (..., 3)."""
    a[i, 0], a[i, 1], a[i, 2] = v


@compiled
def add(a: Vector, b: Vector) -> Vector:
    """a + b"""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled
def subtract(a: Vector, b: Vector) -> Vector:
    """a - b"""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def times(s: float, a: Vector) -> Vector:
    """s a"""
    return s * a[0], s * a[1], s * a[2]


@compiled
def dot(a: Vector, b: Vector) -> float:
    """a . b"""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """a x b"""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@compiled
def combine(m: Columns, v: Vector) -> Vector:
    """M v"""
    return (
        m[0][0] * v[0] + m[1][0] * v[1] + m[2][0] * v[2],
        m[0][1] * v[0] + m[1][1] * v[1] + m[2][1] * v[2],
        m[0][2] * v[0] + m[1][2] * v[1] + m[2][2] * v[2],
    )


@compiled
def project(m: Columns, v: Vector) -> Vector:
    """M^T v"""
    return dot(m[0], v), dot(m[1], v), dot(m[2], v)


@compiled
def product(a: Any, b: Any) -> Any:
    """Of quaternions: the rotation ``b`` first, then ``a``."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@compiled
def rotation(q: Any) -> Columns:
    """The matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@compiled
def unit(w: float, x: float, y: float, z: float) -> Any:
    """A quaternion of length 1."""
    length = math.sqrt(w * w + x * x + y * y + z * z)
    return w / length, x / length, y / length, z / length


@compiled
def solve(m: Any, right: Vector) -> Vector:
    """M^-1 right of a symmetric M (xx, yy, zz, xy, xz, yz) by Cramer's rule; NaN where it is
    singular (an athlete that has diverged)."""
    xx, yy, zz, xy, xz, yz = m
    x = (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy)  # adjugate, by columns
    y = (x[1], xx * zz - xz * xz, xy * xz - xx * yz)
    z = (x[2], y[2], xx * yy - xy * xy)
    return times(1.0 / dot((xx, xy, xz), x), combine((x, y, z), right))


# The links of an athlete.


@compiled
def new_pose(links: int) -> Pose:
    """To be written."""
    return Pose(
        np.empty((links, 4)),
        np.empty((links, 3, 3)),
        np.empty((links, 3)),
        np.empty((links, 3)),
        np.empty((links, 3)),
    )


@compiled
def axes_of(pose: Pose, link: int) -> Columns:
    """R_WB of a link."""
    a = pose.axes
    return (
        (a[link, 0, 0], a[link, 0, 1], a[link, 0, 2]),
        (a[link, 1, 0], a[link, 1, 1], a[link, 1, 2]),
        (a[link, 2, 0], a[link, 2, 1], a[link, 2, 2]),
    )


@compiled
def put_attitude(pose: Pose, link: int, quat: Any) -> Columns:
    """Writes and returns R_WB of a link."""
    columns = rotation(quat)
    for k in range(4):
        pose.quat[link, k] = quat[k]
    for j in range(3):
        for i in range(3):
            pose.axes[link, j, i] = columns[j][i]
    return columns


@compiled
def pose_links(
    tree: Tree,
    qpos: np.ndarray,
    qvel: np.ndarray,
    w: int,
    pose: Pose,
) -> None:
    """The links of world ``w`` from qpos (N, nq) and qvel (N, nv)."""
    q, v = tree.qpos, tree.qvel
    root = unit(qpos[w, q + 3], qpos[w, q + 4], qpos[w, q + 5], qpos[w, q + 6])
    turn = put_attitude(pose, 0, root)
    put(pose.pos, 0, (qpos[w, q], qpos[w, q + 1], qpos[w, q + 2]))
    put(pose.linvel, 0, (qvel[w, v], qvel[w, v + 1], qvel[w, v + 2]))
    put(pose.angvel, 0, combine(turn, (qvel[w, v + 3], qvel[w, v + 4], qvel[w, v + 5])))
    for i in range(1, len(tree.parent)):
        p = tree.parent[i]
        q, v = tree.qpos + 4 + 3 * i, tree.qvel + 3 + 3 * i
        a, b, c = 0.5 * qpos[w, q], 0.5 * qpos[w, q + 1], 0.5 * qpos[w, q + 2]
        sa, sb, sc = math.sin(a), math.sin(b), math.sin(c)
        ca, cb, cc = math.cos(a), math.cos(b), math.cos(c)
        joint = (  # Rx Ry Rz
            ca * cb * cc - sa * sb * sc,
            sa * cb * cc + ca * sb * sc,
            ca * sb * cc - sa * cb * sc,
            ca * cb * sc + sa * sb * cc,
        )
        parent = (pose.quat[p, 0], pose.quat[p, 1], pose.quat[p, 2], pose.quat[p, 3])
        base = axes_of(pose, p)
        own = put_attitude(pose, i, product(parent, joint))
        # Hinge axes: x of the parent, z of the link, and between them y turned back about z.
        middle = add(times(2.0 * sc * cc, own[0]), times(cc * cc - sc * sc, own[1]))
        spin = add(row(pose.angvel, p), times(qvel[w, v], base[0]))
        spin = add(spin, add(times(qvel[w, v + 1], middle), times(qvel[w, v + 2], own[2])))
        put(pose.angvel, i, spin)
        arm = combine(base, row(tree.offset, i))
        put(pose.pos, i, add(row(pose.pos, p), arm))
        put(pose.linvel, i, add(row(pose.linvel, p), cross(row(pose.angvel, p), arm)))


@compiled
def whole_of(tree: Tree, pose: Pose) -> tuple[Any, Vector, Vector, Vector]:
    """The athlete as one body: inertia about its centre of mass (xx, yy, zz, xy, xz, yz), angular
    momentum about it, its velocity, its position (Featherstone 2008, sections 2.12 and 2.13)."""
    root = row(pose.pos, 0)
    total, com, linear, angular = 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    xx, yy, zz, xy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(tree.parent)):
        mass, own, spin = tree.mass[i], axes_of(pose, i), row(pose.angvel, i)
        arm = combine(own, row(tree.center, i))
        center = add(subtract(row(pose.pos, i), root), arm)
        momentum = times(mass, add(row(pose.linvel, i), cross(spin, arm)))
        # R I R^T
        ix = combine(own, row(tree.inertia[i], 0))
        iy = combine(own, row(tree.inertia[i], 1))
        iz = combine(own, row(tree.inertia[i], 2))
        half = ((ix[0], iy[0], iz[0]), (ix[1], iy[1], iz[1]), (ix[2], iy[2], iz[2]))
        x, y, z = combine(own, half[0]), combine(own, half[1]), combine(own, half[2])
        total += mass
        com = add(com, times(mass, center))
        linear = add(linear, momentum)
        angular = add(angular, add(combine((x, y, z), spin), cross(center, momentum)))
        square = dot(center, center)
        xx += x[0] + mass * (square - center[0] * center[0])
        yy += y[1] + mass * (square - center[1] * center[1])
        zz += z[2] + mass * (square - center[2] * center[2])
        xy += x[1] - mass * center[0] * center[1]
        xz += x[2] - mass * center[0] * center[2]
        yz += y[2] - mass * center[1] * center[2]
    # From the root to the centre of mass.
    com = times(1.0 / total, com)
    square = dot(com, com)
    inertia = (
        xx - total * (square - com[0] * com[0]),
        yy - total * (square - com[1] * com[1]),
        zz - total * (square - com[2] * com[2]),
        xy + total * com[0] * com[1],
        xz + total * com[0] * com[2],
        yz + total * com[1] * com[2],
    )
    angular = subtract(angular, cross(com, linear))
    return inertia, angular, times(1.0 / total, linear), add(root, com)


@compiled
def feel(pose: Pose, out: np.ndarray) -> None:
    """Writes ``sports.frames.proprioception`` of an athlete (15 B - 2,)."""
    ahead = pose.axes[0, 0, 0], pose.axes[0, 0, 1]
    length = math.sqrt(ahead[0] * ahead[0] + ahead[1] * ahead[1])
    c, s = (ahead[0] / length, ahead[1] / length) if length > 0.0 else (1.0, 0.0)
    links, root = len(pose.pos), row(pose.pos, 0)
    out[0] = root[2]
    at = 1
    for i in range(1, links):
        at = seen(c, s, subtract(row(pose.pos, i), root), out, at)
    for i in range(links):
        own = axes_of(pose, i)
        at = seen(c, s, own[1], out, seen(c, s, own[0], out, at))
    for i in range(links):
        at = seen(c, s, row(pose.linvel, i), out, at)
    for i in range(links):
        at = seen(c, s, row(pose.angvel, i), out, at)


@compiled
def seen(c: float, s: float, v: Vector, out: np.ndarray, at: int) -> int:
    """Writes a vector as seen from a heading with cosine ``c`` and sine ``s``; what comes next."""
    out[at], out[at + 1], out[at + 2] = c * v[0] + s * v[1], c * v[1] - s * v[0], v[2]
    return at + 3


@compiled
def write(pose: Pose, com: Vector, velocity: Vector, w: int, out: Athlete) -> None:
    """Shows an athlete of world ``w``."""
    for i in range(len(pose.pos)):
        for k in range(4):
            out.quat[k, i, w] = pose.quat[i, k]
        for k in range(3):
            out.pos[k, i, w] = pose.pos[i, k]
            out.linvel[k, i, w] = pose.linvel[i, k]
            out.angvel[k, i, w] = pose.angvel[i, k]
            for j in range(3):
                out.rot[k, j, i, w] = pose.axes[i, j, k]
    for k in range(3):
        out.whole[k, w], out.whole[3 + k, w] = com[k], velocity[k]
    feel(pose, out.felt[w])


@compiled
def show_athlete(
    tree: Tree,
    qpos: np.ndarray,
    qvel: np.ndarray,
    out: Athlete,
) -> None:
    """Shows an athlete of states (N, nq), (N, nv)."""
    pose = new_pose(len(tree.parent))
    for w in range(len(qpos)):
        pose_links(tree, qpos, qvel, w, pose)
        _, _, velocity, com = whole_of(tree, pose)
        write(pose, com, velocity, w, out)


# Its momentum.


@compiled
def advance(kept: Kept, w: int, moment: Vector, force: Vector) -> None:
    """Lets the expected momentum and path go on by a time step."""
    h, expected = kept.timestep[w], kept.expected
    for k in range(3):
        expected[w, k] += h * moment[k]
        expected[w, 3 + k] += h * force[k]
        expected[w, 6 + k] += h / kept.mass * expected[w, 3 + k]


@compiled
def missing(kept: Kept, w: int, first: int, shown: Vector) -> Vector:
    """What three shown numbers lack of those expected from ``first`` on; zero where unknown."""
    expected = kept.expected
    x = expected[w, first] - shown[0]
    y = expected[w, first + 1] - shown[1]
    z = expected[w, first + 2] - shown[2]
    return 0.0 if x != x else x, 0.0 if y != y else y, 0.0 if z != z else z


@compiled
def keep(
    kept: Kept,
    w: int,
    current: bool,
    inertia: Any,
    angular: Vector,
    velocity: Vector,
    com: Vector,
    root: Vector,
    axes: Columns,
    constraint: np.ndarray,
    applied: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
) -> tuple[Vector, Vector, Vector]:
    """Corrects the root of world ``w``; see ``momentum.AthleteKeeper.correct``.

    ``inertia`` to ``axes``: the athlete as a whole and its root. ``constraint`` (6,), ``qpos``
    (7,), ``qvel`` (6,): of the free joint, in that world. ``applied`` (6,): force, moment about the
    world's origin, of what else acts from outside. Returns what was added: rotation, velocity of
    the centre of mass, shift.
    """
    arm, linear = subtract(root, com), times(kept.mass, velocity)
    # The generalised force of the root as a wrench at the centre of mass.
    force = (constraint[0], constraint[1], constraint[2])
    local = (constraint[3], constraint[4], constraint[5])
    moment = add(cross(arm, force), combine(axes, local))
    size = abs(force[0]) + abs(force[1]) + abs(force[2])
    size += abs(local[0]) + abs(local[1]) + abs(local[2])
    push = (applied[0], applied[1], applied[2])
    moment = add(moment, subtract((applied[3], applied[4], applied[5]), cross(com, push)))
    force = add(force, push)
    force = (force[0], force[1], force[2] + kept.weight)
    if current:
        advance(kept, w, moment, force)
    angular_error, linear_error = missing(kept, w, 0, angular), missing(kept, w, 3, linear)
    shift = missing(kept, w, 6, com)
    if size >= kept.no_force:
        shift = (0.0, 0.0, 0.0)  # on the ground the contacts decide
    angular, linear = add(angular, angular_error), add(linear, linear_error)
    com = add(com, shift)
    for k in range(3):
        kept.expected[w, k] = angular[k]
        kept.expected[w, 3 + k] = linear[k]
        kept.expected[w, 6 + k] = com[k]
    if not current:
        advance(kept, w, moment, force)
    turn, speed = solve(inertia, angular_error), times(1.0 / kept.mass, linear_error)
    root_speed, root_turn = add(speed, cross(turn, arm)), project(axes, turn)
    for k in range(3):
        qpos[k] += shift[k]
        qvel[k] += root_speed[k]
        qvel[3 + k] += root_turn[k]
    return turn, speed, shift


@compiled
def keep_measured(
    kept: Kept,
    current: bool,
    motion: np.ndarray,
    inertia: np.ndarray,
    constraint: np.ndarray,
    applied: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
    added: np.ndarray,
) -> None:
    """Corrects the roots of N athletes from the engine's own fields.

    ``motion`` (N, 21) of ``mjcf.WHOLE_SENSORS``, ``inertia`` (N, 6) about the centres of mass,
    ``constraint`` and ``applied`` (N, 6), ``qpos`` (N, 7), ``qvel`` (N, 6); writes to the last two,
    and what was added to ``added`` (N, 9): rotation, velocity of the centre of mass, shift.
    """
    for w in range(len(motion)):
        m, i = motion[w], inertia[w]
        turn, speed, shift = keep(
            kept,
            w,
            current,
            (i[0], i[1], i[2], i[3], i[4], i[5]),
            (m[0], m[1], m[2]),
            (m[3], m[4], m[5]),
            (m[6], m[7], m[8]),
            (m[9], m[10], m[11]),
            ((m[12], m[13], m[14]), (m[15], m[16], m[17]), (m[18], m[19], m[20])),
            constraint[w],
            applied[w],
            qpos[w],
            qvel[w],
        )
        for k in range(3):
            added[w, k], added[w, 3 + k], added[w, 6 + k] = turn[k], speed[k], shift[k]


@compiled
def finish_athlete(
    tree: Tree,
    kept: Kept,
    constraint: np.ndarray,
    applied: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
    out: Athlete,
) -> None:
    """Keeps an athlete's momentum after the last substep of a control step and shows it.

    ``constraint`` (N, nv), ``qpos`` (N, nq) and ``qvel`` (N, nv) are the engine's; writes to the
    last two. ``applied`` (N, 6) as for ``keep``.
    """
    pose = new_pose(len(tree.parent))
    q, v = tree.qpos, tree.qvel
    for w in range(len(qpos)):
        pose_links(tree, qpos, qvel, w, pose)
        inertia, angular, velocity, com = whole_of(tree, pose)
        turn, speed, shift = keep(
            kept,
            w,
            True,
            inertia,
            angular,
            velocity,
            com,
            row(pose.pos, 0),
            axes_of(pose, 0),
            constraint[w, v : v + 6],
            applied[w],
            qpos[w, q : q + 7],
            qvel[w, v : v + 6],
        )
        # The pose is of the state before the correction, which moves the athlete as a whole.
        for i in range(len(pose.pos)):
            arm = subtract(row(pose.pos, i), com)
            moved = add(row(pose.linvel, i), add(speed, cross(turn, arm)))
            put(pose.linvel, i, moved)
            put(pose.angvel, i, add(row(pose.angvel, i), turn))
            put(pose.pos, i, add(row(pose.pos, i), shift))
        write(pose, add(com, shift), add(velocity, speed), w, out)


# What else is shown.


@compiled
def show_object(
    qpos: np.ndarray,
    qvel: np.ndarray,
    pos: np.ndarray,
    quat: np.ndarray,
    linvel: np.ndarray,
    angvel: np.ndarray,
) -> None:
    """Shows a free object, qpos (N, 7) and qvel (N, 6), as (3, N), (4, N), (3, N), (3, N)."""
    for w in range(len(qpos)):
        attitude = unit(qpos[w, 3], qpos[w, 4], qpos[w, 5], qpos[w, 6])
        spin = combine(rotation(attitude), (qvel[w, 3], qvel[w, 4], qvel[w, 5]))
        for k in range(4):
            quat[k, w] = attitude[k]
        for k in range(3):
            pos[k, w], linvel[k, w], angvel[k, w] = qpos[w, k], qvel[w, k], spin[k]


@compiled
def roll_ball(
    force: np.ndarray,
    timestep: np.ndarray,
    friction: np.ndarray,
    mass: float,
    radius: float,
    quat: np.ndarray,
    qvel: np.ndarray,
) -> None:
    """Lets the ground's friction act on a ball after a time step, by Coulomb's law.

    ``force`` (N, 3) of the ground on it in that step, ``timestep`` (N,), ``friction`` (N,),
    ``quat`` (N, 4) and ``qvel`` (N, 6) of its free joint; writes to the last. The impulse is what
    makes a solid ball roll (2/7 of its slip), or what friction can give.
    """
    for w in range(len(qvel)):
        if not force[w, 2] > 0.0:
            continue
        axes = rotation(unit(quat[w, 0], quat[w, 1], quat[w, 2], quat[w, 3]))
        spin = combine(axes, (qvel[w, 3], qvel[w, 4], qvel[w, 5]))
        x, y = qvel[w, 0] - radius * spin[1], qvel[w, 1] + radius * spin[0]  # of the lowest point
        slip = math.sqrt(x * x + y * y)
        if not slip > 0.0:
            continue
        change = min(slip / 3.5, friction[w] * force[w, 2] * timestep[w] / mass)
        x, y = -change / slip * x, -change / slip * y
        qvel[w, 0] += x
        qvel[w, 1] += y
        turn = project(axes, (2.5 / radius * y, -2.5 / radius * x, 0.0))
        for k in range(3):
            qvel[w, 3 + k] += turn[k]


@compiled
def show_numbers(rows: np.ndarray, columns: np.ndarray, limit: float, bad: np.ndarray) -> bool:
    """Writes (N, k) to (k, N); sets ``bad`` (N,) where a number is not below a limit, or is NaN.
    Whether there was one."""
    found = False
    for j in range(len(columns)):
        for w in range(len(rows)):
            columns[j, w] = rows[w, j]
            beyond = not abs(rows[w, j]) < limit
            bad[w] |= beyond
            found |= beyond
    return found


@compiled
def look_at_contacts(
    sensors: np.ndarray,
    peak: np.ndarray,
    ground: np.ndarray,
    pairs: np.ndarray,
    others: np.ndarray,
    beyond: float,
) -> None:
    """Keeps the contact forces of a substep that are larger than in those before it.

    ``sensors`` (N, >= 3 k): first those of the links and the ground, then those of the pairs, then
    those of the links and everything. ``peak`` (N, k) largest squares so far, ``ground`` and
    ``others`` (3, links, N), ``pairs`` (P, N). Squares from ``beyond`` on are no forces.
    """
    links, known = ground.shape[1], ground.shape[1] + len(pairs)
    for w in range(len(peak)):
        for i in range(peak.shape[1]):
            x, y, z = sensors[w, 3 * i], sensors[w, 3 * i + 1], sensors[w, 3 * i + 2]
            if i >= known:  # all but the ground
                j = 3 * (i - known)
                x, y, z = x - sensors[w, j], y - sensors[w, j + 1], z - sensors[w, j + 2]
            square = x * x + y * y + z * z
            if peak[w, i] < square < beyond:
                peak[w, i] = square
                if i < links:
                    ground[0, i, w], ground[1, i, w], ground[2, i, w] = x, y, z
                elif i < known:
                    pairs[i - links, w] = math.sqrt(square)
                else:
                    k = i - known
                    others[0, k, w], others[1, k, w], others[2, k, w] = x, y, z


# Points on the links' surfaces.


class Surface(NamedTuple):
    """Balls on the links."""

    points: np.ndarray
    """(K, 3) their centres, in the links' frames (m)."""
    radii: np.ndarray
    """(K,)"""
    owners: np.ndarray
    """(K,) their links, rising."""


@compiled
def put_across(
    surface: Surface, k: int, pos: np.ndarray, rot: np.ndarray, link: np.ndarray, at: np.ndarray
) -> None:
    """Writes x and z of a ball's centre to (2, N), from pos (N, B, 3) and rot (N, B, 3, 3).
    ``link`` (8, N) keeps what is needed of its link, as long as the balls come by link."""
    i, n = surface.owners[k], at.shape[1]
    if k == 0 or surface.owners[k - 1] != i:
        for row in range(2):
            for w in range(n):
                link[4 * row, w] = pos[w, i, 2 * row]
            for j in range(3):
                for w in range(n):
                    link[4 * row + 1 + j, w] = rot[w, i, 2 * row, j]
    x, y, z = surface.points[k]
    for row in range(2):
        o = 4 * row
        for w in range(n):
            at[row, w] = link[o, w] + link[o + 1, w] * x + link[o + 2, w] * y + link[o + 3, w] * z


@compiled
def find_marks(
    surface: Surface,
    pos: np.ndarray,
    rot: np.ndarray,
    below: float,
    standing: np.ndarray,
    rear: np.ndarray,
    ends: np.ndarray,
) -> None:
    """Writes ``Geometry.marks``: standing (B, N), rear (B, N), nearest and furthest (2, N)."""
    n = ends.shape[1]
    link, at = np.empty((8, n), np.float32), np.empty((2, n), np.float32)
    standing[:], rear[:], ends[0], ends[1] = False, np.inf, np.inf, -np.inf
    for k in range(len(surface.radii)):
        put_across(surface, k, pos, rot, link, at)
        i, radius = surface.owners[k], surface.radii[k]
        for w in range(n):
            rear[i, w] = min(rear[i, w], at[0, w] - radius)
        for w in range(n):
            if at[1, w] - radius < below:
                standing[i, w] = True
                ends[0, w] = min(ends[0, w], at[0, w])
                ends[1, w] = max(ends[1, w], at[0, w])


@compiled
def find_lowest(
    surface: Surface, pos: np.ndarray, rot: np.ndarray, x: float, reach: float, out: np.ndarray
) -> None:
    """Writes ``Geometry.lowest_near`` to (N,)."""
    n = len(out)
    link, at = np.empty((8, n), np.float32), np.empty((2, n), np.float32)
    out[:] = np.inf
    for k in range(len(surface.radii)):
        put_across(surface, k, pos, rot, link, at)
        for w in range(n):
            if abs(at[0, w] - x) < reach:
                out[w] = min(out[w], at[1, w] - surface.radii[k])


@compiled
def copy_worlds(
    rows: np.ndarray, chosen: np.ndarray, worlds: np.ndarray, columns: np.ndarray
) -> None:
    """Makes some columns of (k, N), by index, chosen rows of (M, k)."""
    for j in range(len(columns)):
        for i in range(len(worlds)):
            columns[j, worlds[i]] = rows[chosen[i], j]
