"""The kernels of the ``warp`` engine around MuJoCo Warp's own, one thread a world or a contact.

Contact forces by link and pair, the largest of a control step, balls that slide and roll, the
athletes' momentum, the ball of the ball law. World frame; m, kg, s, rad, N. Compiled by Warp from
this file.
"""

from __future__ import annotations

import mujoco
import numpy as np
import warp as wp

from sports.humanoid.mjcf import body_name
from sports.physics.base import GRAVITY, NO_FORCE
from sports.scene import GROUND, Scene


@wp.kernel
def sum_contacts(
    count: wp.array(dtype=int),  # type: ignore[valid-type]
    world_of: wp.array(dtype=int),  # type: ignore[valid-type]
    geoms: wp.array(dtype=wp.vec2i),  # type: ignore[valid-type]
    contact_force: wp.array(dtype=wp.spatial_vector),  # type: ignore[valid-type]
    geom_link: wp.array(dtype=int),  # type: ignore[valid-type]
    side_a: wp.array2d(dtype=int),  # type: ignore[valid-type]
    side_b: wp.array2d(dtype=int),  # type: ignore[valid-type]
    geom_ball: wp.array(dtype=int),  # type: ignore[valid-type]
    num_links: int,
    others: int,
    forces: wp.array3d(dtype=float),  # type: ignore[valid-type]
):
    """Adds each contact's force (on its second geom, world frame) to its link and pairs, and
    from slot ``others`` on (if positive) to links that met something else than the ground; the
    ground's on a geom with a slot of its own in ``geom_ball`` there."""
    i = wp.tid()
    if i >= count[0]:
        return
    world = world_of[i]
    pair = geoms[i]
    f = wp.spatial_top(contact_force[i])
    first, second = geom_link[pair[0]], geom_link[pair[1]]
    # -2 marks the ground, -1 what is neither ground nor athlete.
    if first == -2 and second >= 0:
        for k in range(3):
            wp.atomic_add(forces, world, second, k, f[k])
    if second == -2 and first >= 0:
        for k in range(3):
            wp.atomic_add(forces, world, first, k, -f[k])
    if first == -2 and geom_ball[pair[1]] >= 0:
        wp.atomic_add(forces, world, geom_ball[pair[1]], 2, f[2])
    if second == -2 and geom_ball[pair[0]] >= 0:
        wp.atomic_add(forces, world, geom_ball[pair[0]], 2, -f[2])
    if others > 0 and first != -2 and second != -2:
        for k in range(3):
            if second >= 0:
                wp.atomic_add(forces, world, others + second, k, f[k])
            if first >= 0:
                wp.atomic_add(forces, world, others + first, k, -f[k])
    for p in range(side_a.shape[1]):
        if side_b[pair[0], p] == 1 and side_a[pair[1], p] == 1:
            for k in range(3):
                wp.atomic_add(forces, world, num_links + p, k, f[k])
        if side_a[pair[0], p] == 1 and side_b[pair[1], p] == 1:
            for k in range(3):
                wp.atomic_add(forces, world, num_links + p, k, -f[k])


@wp.kernel
def damp(
    damping: wp.array2d(dtype=float),  # type: ignore[valid-type]
    qvel: wp.array2d(dtype=float),  # type: ignore[valid-type]
    force: wp.array2d(dtype=float),  # type: ignore[valid-type]
):
    """The force against every rate (N, nv) by its damping."""
    w, i = wp.tid()
    force[w, i] = -damping[w, i] * qvel[w, i]


@wp.kernel
def roll(
    forces: wp.array3d(dtype=float),  # type: ignore[valid-type]
    slot: int,
    timestep: wp.array(dtype=float),  # type: ignore[valid-type]
    friction: wp.array(dtype=float),  # type: ignore[valid-type]
    mass: float,
    radius: float,
    q: int,
    v: int,
    qpos: wp.array2d(dtype=float),  # type: ignore[valid-type]
    qvel: wp.array2d(dtype=float),  # type: ignore[valid-type]
):
    """``athletes.roll_ball`` for one world; same formulas. ``q``, ``v``: where the ball's positions
    and velocities begin."""
    w = wp.tid()
    load = forces[w, slot, 2]
    turn = wp.quat_to_matrix(
        wp.normalize(wp.quat(qpos[w, q + 4], qpos[w, q + 5], qpos[w, q + 6], qpos[w, q + 3]))
    )
    spin = turn @ wp.vec3(qvel[w, v + 3], qvel[w, v + 4], qvel[w, v + 5])
    x = qvel[w, v] - radius * spin[1]
    y = qvel[w, v + 1] + radius * spin[0]
    slip = wp.sqrt(x * x + y * y)
    if load > 0.0 and slip > 0.0:
        step = timestep[w % timestep.shape[0]]
        change = wp.min(slip / 3.5, friction[w] * load * step / mass)
        x = -change / slip * x
        y = -change / slip * y
        qvel[w, v] = qvel[w, v] + x
        qvel[w, v + 1] = qvel[w, v + 1] + y
        local = wp.transpose(turn) @ wp.vec3(2.5 / radius * y, -2.5 / radius * x, 0.0)
        for k in range(3):
            qvel[w, v + 3 + k] = qvel[w, v + 3 + k] + local[k]


@wp.kernel
def keep_largest(
    now: wp.array3d(dtype=float),  # type: ignore[valid-type]
    first: int,
    forces: wp.array3d(dtype=float),  # type: ignore[valid-type]
    largest: wp.array2d(dtype=float),  # type: ignore[valid-type]
):
    """Keeps each force of a substep that is larger than in those before it, and zeroes it."""
    world, s = wp.tid()
    x = now[world, s, 0]
    y = now[world, s, 1]
    z = now[world, s, 2]
    square = x * x + y * y + z * z
    if first == 1 or square > largest[world, s]:
        largest[world, s] = square
        forces[world, s, 0] = x
        forces[world, s, 1] = y
        forces[world, s, 2] = z
    for k in range(3):
        now[world, s, k] = 0.0


@wp.kernel
def keep_momentum(
    cinert: wp.array3d(dtype=float),  # type: ignore[valid-type]
    qfrc_constraint: wp.array2d(dtype=float),  # type: ignore[valid-type]
    applied: wp.array3d(dtype=float),  # type: ignore[valid-type]
    timestep: wp.array(dtype=float),  # type: ignore[valid-type]
    tree: wp.array2d(dtype=int),  # type: ignore[valid-type]
    links: int,
    mass: float,
    current: int,
    cvel: wp.array3d(dtype=float),  # type: ignore[valid-type]
    com: wp.array3d(dtype=float),  # type: ignore[valid-type]
    xpos: wp.array3d(dtype=float),  # type: ignore[valid-type]
    xquat: wp.array3d(dtype=float),  # type: ignore[valid-type]
    known: wp.array2d(dtype=int),  # type: ignore[valid-type]
    target: wp.array3d(dtype=float),  # type: ignore[valid-type]
    path: wp.array3d(dtype=float),  # type: ignore[valid-type]
    qpos: wp.array2d(dtype=float),  # type: ignore[valid-type]
    qvel: wp.array2d(dtype=float),  # type: ignore[valid-type]
):
    """The correction of ``momentum.py`` for one athlete of one world; same formulas."""
    w, a = wp.tid()
    root, q, v = tree[a, 0], tree[a, 1], tree[a, 2]
    h = timestep[w % timestep.shape[0]]
    angular = wp.vec3(0.0, 0.0, 0.0)
    linear = wp.vec3(0.0, 0.0, 0.0)
    inertia = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for k in range(links):
        b = root + k
        tensor = wp.mat33(
            cinert[w, b, 0], cinert[w, b, 3], cinert[w, b, 4],
            cinert[w, b, 3], cinert[w, b, 1], cinert[w, b, 5],
            cinert[w, b, 4], cinert[w, b, 5], cinert[w, b, 2],
        )  # fmt: skip
        moment = wp.vec3(cinert[w, b, 6], cinert[w, b, 7], cinert[w, b, 8])
        spin = wp.vec3(cvel[w, b, 0], cvel[w, b, 1], cvel[w, b, 2])
        speed = wp.vec3(cvel[w, b, 3], cvel[w, b, 4], cvel[w, b, 5])
        inertia += tensor
        angular += tensor @ spin + wp.cross(moment, speed)
        linear += cinert[w, b, 9] * speed - wp.cross(moment, spin)
    center = wp.vec3(com[w, root, 0], com[w, root, 1], com[w, root, 2])
    arm = wp.vec3(xpos[w, root, 0], xpos[w, root, 1], xpos[w, root, 2]) - center
    turn = wp.quat_to_matrix(
        wp.quat(xquat[w, root, 1], xquat[w, root, 2], xquat[w, root, 3], xquat[w, root, 0])
    )
    force = wp.vec3(qfrc_constraint[w, v], qfrc_constraint[w, v + 1], qfrc_constraint[w, v + 2])
    local = wp.vec3(qfrc_constraint[w, v + 3], qfrc_constraint[w, v + 4], qfrc_constraint[w, v + 5])
    flying = wp.length(force) + wp.length(local) < wp.static(NO_FORCE)
    push = wp.vec3(applied[w, a, 0], applied[w, a, 1], applied[w, a, 2])
    moment = wp.vec3(applied[w, a, 3], applied[w, a, 4], applied[w, a, 5])
    start = center - (float(current) * h / mass) * linear
    moment += turn @ local + wp.cross(arm, force) - wp.cross(start, push)
    impulse_l = h * moment
    impulse_p = h * (force + push + wp.vec3(0.0, 0.0, wp.static(-GRAVITY) * mass))

    error_l = wp.vec3(0.0, 0.0, 0.0)
    error_p = wp.vec3(0.0, 0.0, 0.0)
    shift = wp.vec3(0.0, 0.0, 0.0)
    if known[w, a] == 1:
        error_l = wp.vec3(target[w, a, 0], target[w, a, 1], target[w, a, 2]) - angular
        error_p = wp.vec3(target[w, a, 3], target[w, a, 4], target[w, a, 5]) - linear
        if current == 1:
            error_l += impulse_l
            error_p += impulse_p
        if flying:
            shift = wp.vec3(path[w, a, 0], path[w, a, 1], path[w, a, 2]) - center
            if current == 1:
                shift += (h / mass) * (linear + error_p)
    spin_change = wp.inverse(inertia) @ error_l
    speed_change = error_p / mass
    next_l = angular + error_l
    next_p = linear + error_p
    ahead = center + shift
    if current == 0:
        next_l += impulse_l
        next_p += impulse_p
        ahead += (h / mass) * next_p
    root_change = speed_change + wp.cross(spin_change, arm)
    local_change = wp.transpose(turn) @ spin_change
    for i in range(3):
        target[w, a, i] = next_l[i]
        target[w, a, 3 + i] = next_p[i]
        path[w, a, i] = ahead[i]
        qpos[w, q + i] = qpos[w, q + i] + shift[i]
        qvel[w, v + i] = qvel[w, v + i] + root_change[i]
        qvel[w, v + 3 + i] = qvel[w, v + 3 + i] + local_change[i]
    known[w, a] = 1
    if current == 1:
        # What a task reads was computed before this correction.
        for i in range(3):
            com[w, root, i] = com[w, root, i] + shift[i]
        for k in range(links):
            for i in range(3):
                cvel[w, root + k, i] = cvel[w, root + k, i] + spin_change[i]
                cvel[w, root + k, 3 + i] = cvel[w, root + k, 3 + i] + speed_change[i]
                xpos[w, root + k, i] = xpos[w, root + k, i] + shift[i]


@wp.kernel
def show_ball(
    state: wp.array2d(dtype=float),  # type: ignore[valid-type]
    body: int,
    xpos: wp.array3d(dtype=float),  # type: ignore[valid-type]
    xquat: wp.array3d(dtype=float),  # type: ignore[valid-type]
    com: wp.array3d(dtype=float),  # type: ignore[valid-type]
    cvel: wp.array3d(dtype=float),  # type: ignore[valid-type]
):
    """Shows where the ball law has put the ball; the engine had looked before. ``state`` as
    ``Game.state``: position, quaternion, velocity, spin."""
    w = wp.tid()
    for k in range(3):
        xpos[w, body, k] = state[w, k]
        com[w, body, k] = state[w, k]
        cvel[w, body, k] = state[w, 10 + k]
        cvel[w, body, 3 + k] = state[w, 7 + k]
    for k in range(4):
        xquat[w, body, k] = state[w, 3 + k]


def contact_tables(
    scene: Scene, model: mujoco.MjModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per geom: its athlete link counted over agents (-2 ground, -1 other), and (geoms, P)
    whether it is on the first and second side of each named pair of the scene."""
    links = {
        body_name(a, link): a * scene.body.num_links + i
        for a in range(scene.num_agents)
        for i, link in enumerate(scene.body.link_names)
    }
    names = [model.body(model.geom_bodyid[g]).name for g in range(model.ngeom)]
    geoms = [model.geom(g).name for g in range(model.ngeom)]
    geom_link = np.array([links.get(name, -1) for name in names], dtype=np.int32)
    geom_link[model.geom(GROUND).id] = -2

    def member(side: int) -> np.ndarray:
        table = np.zeros((model.ngeom, len(scene.contact_pairs)), dtype=np.int32)
        for p, pair in enumerate(scene.contact_pairs):
            one, whole = pair[side], f"{pair[side]}/"
            if ":" in one or one == GROUND:
                table[:, p] = [geom == one for geom in geoms]
            elif one.endswith("/"):
                agent, link = one[:-1].split("/")
                beyond = {f"{agent}/{name}" for name in scene.body.subtree(link)}
                table[:, p] = [n in beyond for n in names]
            else:
                table[:, p] = [n == one or n.startswith(whole) for n in names]
        return table

    return geom_link, member(0), member(1)
