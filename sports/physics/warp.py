"""MuJoCo Warp: thousands of worlds on one GPU, a control step in one CUDA graph.

The graph runs the substeps, keeps each contact force from the substep in which it was largest,
and refreshes kinematics and velocities so that what a task reads is current. The tensors of the
protocol are views of the engine's memory: nothing is copied, and nothing waits for the device.
Without a GPU the same code runs on Warp's CPU device (slowly; for tests).
"""

from __future__ import annotations

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from sports.ball_law.compiled import for_gpu
from sports.humanoid.body import is_finger
from sports.humanoid.mjcf import body_name, build_model
from sports.physics.base import GRAVITY, NO_FORCE, Geometry, PhysicsState, diverged
from sports.physics.game import build_game, has_game
from sports.physics.variation import Draw, Variation, contact_softness, draw
from sports.scene import GROUND, Scene

ITERATIONS, LINE_SEARCH = 5, 8
"""Newton iterations and line-search steps: 10 / 20 cost 10 % more (measured)."""
HOLD_ITERATIONS, HOLD_LINE_SEARCH = 10, 20
"""The same for hands that hold something: with 5 / 8, 1 % of the coordinates were more than 1e-3
away from C MuJoCo's after one control step from the midst of a throw, with these 0.15 %."""

_BUFFERS = int(mjw.OverflowType.ALL) & ~int(
    mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS
)
"""Overflows that lose contacts or rows; running out of iterations loses only precision."""


@wp.kernel
def _sum_contacts(
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
def _roll(
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
def _keep_largest(
    now: wp.array3d(dtype=float),  # type: ignore[valid-type]
    first: int,
    forces: wp.array3d(dtype=float),  # type: ignore[valid-type]
    largest: wp.array2d(dtype=float),  # type: ignore[valid-type]
):
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
def _keep_momentum(
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
def _show_ball(
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


def _contact_tables(
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


class WarpPhysics:
    """The ``warp`` engine; see :class:`sports.physics.base.Physics` for the tensors."""

    engine = "warp"
    felt = None
    whole = None

    def __init__(
        self,
        scene: Scene,
        num_worlds: int,
        device: str | None = None,
        iterations: int | None = None,
        line_search: int | None = None,
        variation: Variation | None = None,
        variation_seed: int = 0,
    ) -> None:
        """``device``: a torch device; None takes the current GPU. ``variation``: let the worlds
        differ. Raises RuntimeError when there is no GPU and ``device`` does not say ``cpu``."""
        if device is None:
            if not torch.cuda.is_available():
                raise RuntimeError(
                    "engine 'warp' found no GPU; use --engine mujoco (or device='cpu' in tests)"
                )
            device = f"cuda:{torch.cuda.current_device()}"
        self.device = torch.device(device)
        self.scene, self.num_worlds = scene, num_worlds
        wp.config.quiet = True
        wp.init()
        self._wp_device = wp.device_from_torch(self.device)
        # Contact sensors sort all contacts for every sensor; summing them here is 9 % faster.
        self.model = model = build_model(scene, sensors=False)
        # Warp never resets a diverged world by itself, and does not know the flag that says so.
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        holds = any(o.holdable for o in scene.objects)
        model.opt.iterations = iterations or (HOLD_ITERATIONS if holds else ITERATIONS)
        model.opt.ls_iterations = line_search or (HOLD_LINE_SEARCH if holds else LINE_SEARCH)
        agents, links, n = scene.num_agents, scene.body.num_links, num_worlds
        ids = [
            model.body(body_name(a, link)).id
            for a in range(agents)
            for link in scene.body.link_names
        ] + [model.body(o.name).id for o in scene.free_objects]
        if ids != list(range(1, len(ids) + 1)):
            raise RuntimeError(f"scene '{scene.name}': athletes and balls are not listed first")

        # Fingers meet objects only: a flailing SMPL-X athlete with a javelin took 96 rows at most.
        solid = agents * sum(not is_finger(link) for link in scene.body.link_names)
        rows = scene.rows_per_world or 100 + 4 * solid + 48 * len(scene.free_objects)
        contacts = scene.contacts_per_world or 40 + solid // 2
        with wp.ScopedDevice(self._wp_device):
            self.m = mjw.put_model(model)
            self.m.opt.warn_overflow = 0  # counted below, never printed
            self.d = mjw.make_data(model, nworld=n, nconmax=contacts, njmax=rows)
            self._timesteps = [self.m.opt.timestep] * scene.substeps
            factor = np.ones(n)
            if variation is not None:
                drawn = draw(variation, n, scene.substeps, variation_seed)
                factor = drawn.friction
                self._vary(drawn)
        view = wp.to_torch
        d = self.d
        self.qpos, self.qvel = view(d.qpos), view(d.qvel)
        self._ctrl, self._warmstart = view(d.ctrl), view(d.qacc_warmstart)
        self.mocap_pos = view(d.mocap_pos) if model.nmocap else torch.zeros(n, 0, 3).to(self.device)
        self._overflow = view(d.overflow)
        k, o = agents * links, len(scene.free_objects)
        xpos, xquat = view(d.xpos)[:, 1 : 1 + k + o], view(d.xquat)[:, 1 : 1 + k + o]
        self._cvel = view(d.cvel)[:, 1 : 1 + k + o]
        self.body_rot = view(d.xmat)[:, 1 : 1 + k].unflatten(1, (agents, links))
        self._com = view(d.subtree_com)
        self._roots = torch.tensor(model.body_rootid[1 : 1 + k + o], device=self.device).long()
        self.body_pos = xpos[:, :k].unflatten(1, (agents, links))
        self.body_quat = xquat[:, :k].unflatten(1, (agents, links))
        self.object_pos, self.object_quat = xpos[:, k:], xquat[:, k:]
        self._split, self._shape = k, (agents, links)

        geom_link, side_a, side_b = _contact_tables(scene, model)
        pairs = len(scene.contact_pairs)
        links_end = self._first_ball = k + pairs + k * scene.link_contacts
        sensors = links_end + len(scene.bouncing)
        geom_ball = np.full(model.ngeom, -1, dtype=np.int32)
        for i, ball in enumerate(scene.bouncing):
            geom_ball[model.geom_bodyid == model.body(ball.name).id] = links_end + i
        self._others = k + pairs if scene.link_contacts else 0
        with wp.ScopedDevice(self._wp_device):
            self._geom_link = wp.array(geom_link, dtype=int)
            self._side_a = wp.array(side_a, dtype=int)
            self._side_b = wp.array(side_b, dtype=int)
            self._geom_ball = wp.array(geom_ball, dtype=int)
            self._ball_friction = [
                wp.array(np.full(n, ball.friction) * factor, dtype=float) for ball in scene.bouncing
            ]
            self._contact_ids = wp.array(np.arange(self.d.naconmax), dtype=int)
            self._contact_force = wp.zeros(self.d.naconmax, dtype=wp.spatial_vector)
            self._now = wp.zeros((n, sensors, 3), dtype=float)
            tree = [
                (1 + a * links, scene.agent_qpos(a).start, scene.agent_qvel(a).start)
                for a in range(agents)
            ]
            self._tree = wp.array(np.array(tree, dtype=np.int32), dtype=int)
        # The athletes' momentum, kept by _keep_momentum.
        self._known = torch.zeros(n, agents, dtype=torch.int32, device=self.device)
        self._target = torch.zeros(n, agents, 6, device=self.device)
        self._path = torch.zeros(n, agents, 3, device=self.device)
        fields = (d.cvel, d.subtree_com, d.xpos, d.xquat)
        self._kept = [wp.from_torch(view(d.cinert)), *(wp.from_torch(view(x)) for x in fields)]
        self._kept += [wp.from_torch(x) for x in (self._known, self._target, self._path)]
        self._game: dict[str, Tensor] = self._new_game() if has_game(scene) else {}
        surfaces = len(scene.surfaces) if scene.ball is not None else 0
        nothing = torch.zeros(n, surfaces, device=self.device)
        self.ball_hits = self._game.get("hits", nothing.int())
        self.ball_hit_time = self._game.get("hit_time", nothing)
        self.ball_hit_pos = self._game.get("hit_pos", nothing[..., None].expand(-1, -1, 3))
        self.wave_phase = self._game.get("phases", torch.zeros(n, 2, device=self.device))
        applied = torch.zeros(n, agents, 6, device=self.device)
        self._applied = wp.from_torch(self._game.get("applied", applied))
        self._forces = torch.zeros(n, sensors, 3, device=self.device)
        self._largest = torch.zeros(n, sensors, device=self.device)
        self._wp_forces = wp.from_torch(self._forces)
        self._wp_largest = wp.from_torch(self._largest)
        self.ground_force = self._forces[:, :k].unflatten(1, (agents, links))
        self.link_force = torch.zeros(0, agents, links, 3, device=self.device)
        if scene.link_contacts:
            self.link_force = self._forces[:, k + pairs : links_end].unflatten(1, (agents, links))
        self._pairs = slice(k, k + pairs)
        self.bad = torch.zeros(n, dtype=torch.bool, device=self.device)
        self.nan_worlds = torch.zeros((), dtype=torch.long, device=self.device)
        self.overflow = torch.zeros((), dtype=torch.long, device=self.device)
        self.geometry = Geometry(scene.body, self.device)
        qpos0 = torch.tensor(scene.default_qpos(), dtype=torch.float32, device=self.device)
        self.qpos.copy_(qpos0.expand_as(self.qpos))
        self._step_graph = self._capture(self._substeps)
        self._refresh_graph = self._capture(self._refresh)
        # The captures ran once for warming up: start over.
        self.qpos.copy_(qpos0.expand_as(self.qpos))
        for t in (self.qvel, self._ctrl, self._warmstart, self._forces, self._overflow):
            t.zero_()
        self._known.zero_()
        self._forget_ball(torch.ones(n, dtype=torch.bool, device=self.device))
        self._run(self._refresh_graph, self._refresh)
        self._derive()

    def step(self, ctrl: Tensor) -> None:
        self._ctrl.copy_(ctrl)
        self.step_graph()
        self._derive()
        full = (self._overflow & _BUFFERS) != 0
        wrong = diverged(self.qpos, self.qvel)
        self.bad = wrong | full
        self.nan_worlds = self.nan_worlds + wrong.sum()
        self.overflow = self.overflow + full.sum()
        self._overflow.zero_()

    def step_graph(self) -> None:
        """Runs only the captured substeps, for benchmarks."""
        self._run(self._step_graph, self._substeps)

    def reset(self, mask: Tensor, state: PhysicsState) -> None:
        row = mask[:, None]
        self.qpos.copy_(torch.where(row, state.qpos, self.qpos))
        self.qvel.copy_(torch.where(row, state.qvel, self.qvel))
        self._warmstart.masked_fill_(row, 0.0)
        if self.mocap_pos.shape[1]:
            self.mocap_pos.copy_(torch.where(row[..., None], state.mocap_pos, self.mocap_pos))
        self._forces.masked_fill_(row[..., None], 0.0)
        self._known.masked_fill_(row, 0)
        self._forget_ball(mask)
        if state.wave_phase is not None:
            self.wave_phase.copy_(torch.where(row, state.wave_phase, self.wave_phase))
        self._run(self._refresh_graph, self._refresh)
        self._derive()

    def move(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        row = mask[:, None]
        for agent in range(self.scene.num_agents):
            q, v = self.scene.agent_qpos(agent), self.scene.agent_qvel(agent)
            moved = (qpos[:, q] != self.qpos[:, q]).any(1) | (qvel[:, v] != self.qvel[:, v]).any(1)
            self._known[:, agent].masked_fill_(moved & mask, 0)
        self.qpos.copy_(torch.where(row, qpos, self.qpos))
        self.qvel.copy_(torch.where(row, qvel, self.qvel))
        self._run(self._refresh_graph, self._refresh)
        self._derive()

    def extent(self, direction: Tensor) -> Tensor:
        return self.geometry.extent(self.body_pos, self.body_quat, direction)

    def extra_state(self) -> dict[str, Tensor]:
        """The solver's warm start and the momentum expected."""
        kept = {
            "qacc_warmstart": self._warmstart.clone(),
            "known": self._known.clone(),
            "target": self._target.clone(),
            "path": self._path.clone(),
        }
        return kept | ({"pending": self._game["pending"].clone()} if self._game else {})

    def load_extra_state(self, state: dict[str, Tensor]) -> None:
        """Restores :meth:`extra_state`; call after ``reset``."""
        self._warmstart.copy_(state["qacc_warmstart"])
        self._known.copy_(state["known"])
        self._target.copy_(state["target"])
        self._path.copy_(state["path"])
        if self._game:
            self._game["pending"].copy_(state["pending"])

    def close(self) -> None:
        self._step_graph = self._refresh_graph = None

    def _vary(self, drawn: Draw) -> None:
        """Gives each world its own numbers. A coarse world takes several time steps at once, then
        some of length zero, which change nothing."""
        model, m, n = self.model, self.m, self.num_worlds

        def rows(values: np.ndarray) -> np.ndarray:
            return np.repeat(values[None], n, axis=0).astype(np.float32)

        friction = rows(model.geom_friction)
        friction[:, :, 0] *= drawn.friction[:, None]
        m.geom_friction = wp.array(friction, dtype=wp.vec3)
        solref, solimp = contact_softness(model.geom_solref, model.geom_solimp, drawn)
        m.geom_solref = wp.array(solref.astype(np.float32), dtype=m.geom_solref.dtype)
        m.geom_solimp = wp.array(solimp.astype(np.float32), dtype=m.geom_solimp.dtype)
        gain, bias = rows(model.actuator_gainprm), rows(model.actuator_biasprm)
        gain[:, :, 0] *= drawn.stiffness[:, None]
        bias[:, :, 1] *= drawn.stiffness[:, None]
        m.actuator_gainprm = wp.array(gain, dtype=m.actuator_gainprm.dtype)
        m.actuator_biasprm = wp.array(bias, dtype=m.actuator_biasprm.dtype)
        damping = rows(model.dof_damping.reshape(model.nv, -1)[:, 0])
        m.dof_damping = wp.array(damping * drawn.damping[:, None].astype(np.float32), dtype=float)
        timesteps = drawn.timesteps(self.scene.timestep, self.scene.substeps)
        if timesteps is not None:
            self._timesteps = [wp.array(h.astype(np.float32), dtype=float) for h in timesteps]

    def _new_game(self) -> dict[str, Tensor]:
        """The ball and the drag as tensors; ``self._wp_game`` is what the kernels get of them."""
        wrench = wp.to_torch(self.d.xfrc_applied)
        built = build_game(self.scene, self.model, self.num_worlds, np.zeros(wrench.shape))
        tensors = {"wrench": wrench}
        self._wp_game = for_gpu().Game()
        for name, array in built._asdict().items():
            dtype = torch.int32 if array.dtype == np.int32 else torch.float32
            if name not in tensors:
                tensors[name] = torch.tensor(array, dtype=dtype, device=self.device)
            setattr(self._wp_game, name, wp.from_torch(tensors[name]))
        return tensors

    def _forget_ball(self, mask: Tensor) -> None:
        """Impacts of the ball in worlds of a mask (N,) were not."""
        if self._game:
            row = mask[:, None]
            self.ball_hits.masked_fill_(row, 0)
            self.ball_hit_time.masked_fill_(row, torch.inf)
            self.ball_hit_pos.masked_fill_(row[..., None], 0.0)
            self._game["pending"].masked_fill_(row[..., None], 0.0)

    def _ask_law(self, kernel: str, *timestep: wp.array) -> None:
        """Launches a kernel of the ball law, by its name."""
        if self._game:
            inputs = [self._wp_game, *timestep, self.d.qpos, self.d.qvel]
            wp.launch(getattr(for_gpu(), kernel), dim=self.num_worlds, inputs=inputs)

    def _substeps(self) -> None:
        d = self.d
        self._ask_law("begin_worlds")
        for i in range(self.scene.substeps):
            self.m.opt.timestep = self._timesteps[i]
            self._ask_law("push_worlds", self._timesteps[i])
            mjw.step(self.m, d)
            mjw.contact_force(self.m, d, self._contact_ids, True, self._contact_force)
            wp.launch(
                _sum_contacts,
                dim=d.naconmax,
                inputs=[
                    d.nacon,
                    d.contact.worldid,
                    d.contact.geom,
                    self._contact_force,
                    self._geom_link,
                    self._side_a,
                    self._side_b,
                    self._geom_ball,
                    self._split,
                    self._others,
                ],
                outputs=[self._now],
            )
            self._roll_balls(self._timesteps[i])
            wp.launch(
                _keep_largest,
                dim=self._largest.shape,
                inputs=[self._now, int(i == 0)],
                outputs=[self._wp_forces, self._wp_largest],
            )
            last = i == self.scene.substeps - 1
            if last:
                self._refresh()
            self._correct(self._timesteps[i], last)
            self._ask_law("finish_worlds", self._timesteps[i])
        if self.scene.ball is not None:
            cvel, com, xpos, xquat = self._kept[1:5]
            state = wp.from_torch(self._game["state"])
            body = self.model.body(self.scene.ball.name).id
            outputs = [xpos, xquat, com, cvel]
            wp.launch(_show_ball, dim=self.num_worlds, inputs=[state, body], outputs=outputs)

    def _roll_balls(self, timestep: wp.array) -> None:
        for i, ball in enumerate(self.scene.bouncing):
            (sphere,) = ball.shapes
            wp.launch(
                _roll,
                dim=self.num_worlds,
                inputs=[
                    self._now,
                    self._first_ball + i,
                    timestep,
                    self._ball_friction[i],
                    sphere.mass,
                    sphere.size[0],
                    self.scene.object_qpos(ball.name).start,
                    self.scene.object_qvel(ball.name).start,
                    self.d.qpos,
                    self.d.qvel,
                ],
            )

    def _correct(self, timestep: wp.array, last: bool) -> None:
        cinert, *changed = self._kept
        wp.launch(
            _keep_momentum,
            dim=(self.num_worlds, self.scene.num_agents),
            inputs=[
                cinert,
                self.d.qfrc_constraint,
                self._applied,
                timestep,
                self._tree,
                self.scene.body.num_links,
                self.scene.body.mass,
                int(last),
                *changed,
                self.d.qpos,
                self.d.qvel,
            ],
        )

    def _refresh(self) -> None:
        mjw.kinematics(self.m, self.d)
        mjw.com_pos(self.m, self.d)
        mjw.com_vel(self.m, self.d)

    def _capture(self, work) -> wp.Graph | None:
        with wp.ScopedDevice(self._wp_device):
            work()  # compiles kernels outside the capture
            if self.device.type != "cuda":
                return None
            with wp.ScopedCapture() as capture:
                work()
            return capture.graph

    def _run(self, graph: wp.Graph | None, work) -> None:
        with wp.ScopedDevice(self._wp_device):
            if graph is None:
                work()
            else:
                # On torch's stream, so that both libraries keep one order.
                stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
                wp.capture_launch(graph, stream=stream)

    def _derive(self) -> None:
        """Velocities at the link origins; the engine's are at the tree's centre of mass."""
        spin, velocity = self._cvel[..., :3], self._cvel[..., 3:]
        arm = torch.cat((self.body_pos.flatten(1, 2), self.object_pos), dim=1)
        arm = arm - self._com[:, self._roots]
        linear = velocity + torch.linalg.cross(spin, arm)
        k = self._split
        self.body_linvel = linear[:, :k].unflatten(1, self._shape)
        self.body_angvel = spin[:, :k].unflatten(1, self._shape)
        self.object_linvel, self.object_angvel = linear[:, k:], spin[:, k:]
        self.pair_force = self._forces[:, self._pairs].norm(dim=-1)
