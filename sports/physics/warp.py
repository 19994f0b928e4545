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
from sports.humanoid.mjcf import body_name, build_model, firm_ground, let_rebound
from sports.physics import warp_kernels as kernels
from sports.physics.base import Geometry, PhysicsState, diverged
from sports.physics.game import build_game, has_game
from sports.physics.variation import Draw, Variation, contact_softness, draw, split_damping
from sports.physics.warp_pieces import faster
from sports.physics.warp_tree import trees
from sports.scene import Scene

ITERATIONS, LINE_SEARCH = 5, 8
"""Newton iterations and line-search steps: 10 / 20 cost 10 % more (measured)."""
HOLD_ITERATIONS, HOLD_LINE_SEARCH = 10, 20
"""The same for hands that hold something: with 5 / 8, 1 % of the coordinates were more than 1e-3
away from C MuJoCo's after one control step from the midst of a throw, with these 0.15 %."""

_PRECISION = (mjw.OverflowType.ITERATIONS, mjw.OverflowType.LS_ITERATIONS)
_BUFFERS = {kind.name.lower(): int(kind) for kind in mjw.OverflowType if kind not in _PRECISION}
"""Overflows that lose contacts or rows, by name; running out of iterations loses only precision."""


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
        felt_damping: bool = False,
        variation_blocks: int = 1,
    ) -> None:
        """``device``: a torch device; None takes the current GPU. ``variation``: let the worlds
        differ. ``felt_damping``: let contacts feel the joints' damping, on firm ground
        (``sports.physics.variation``). ``variation_blocks``: the worlds differ alike in each of so
        many blocks. Raises RuntimeError when there is no GPU and ``device`` does
        not say ``cpu``."""
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
        # Two boxes meet by the law of C MuJoCo, in up to 8 points, not in up to 4 of them.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
        if felt_damping and variation is None:
            firm_ground(model)
        drawn = None
        if variation is not None:
            if variation.rebound_share:
                let_rebound(model, scene, variation.rebound_links)
            drawn = draw(
                variation,
                num_worlds,
                scene.substeps,
                variation_seed,
                felt_damping,
                variation_blocks,
            )
            if drawn.cone.all():
                model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
            elif drawn.cone.any():
                raise ValueError(
                    "on a GPU friction has a round cone in all worlds or in none: give a "
                    "cone_share of 0, or of 1 with an own_share of 0 or an own_cone"
                )
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
            self._trees = trees(model, n)
            self.m.opt.warn_overflow = 0  # counted below, never printed
            self.d = mjw.make_data(model, nworld=n, nconmax=contacts, njmax=rows)
            self._timesteps = [self.m.opt.timestep] * scene.substeps
            factor, felt, stride = np.ones(n), np.full(n, felt_damping), np.ones(n)
            if drawn is not None:
                factor, felt, stride = drawn.friction, drawn.felt, drawn.stride
                self._vary(drawn)
            self._felt: wp.array | None = None
            if felt.any():
                self._feel(felt, stride * scene.timestep)
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

        geom_link, side_a, side_b = kernels.contact_tables(scene, model)
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
        # The athletes' momentum, kept by kernels.keep_momentum.
        self._known = torch.zeros(n, agents, dtype=torch.int32, device=self.device)
        self._target = torch.zeros(n, agents, 6, device=self.device)
        self._path = torch.zeros(n, agents, 3, device=self.device)
        fields = (d.cvel, d.subtree_com, d.xpos, d.xquat)
        self._kept = [wp.from_torch(view(d.cinert)), *(wp.from_torch(view(x)) for x in fields)]
        self._kept += [wp.from_torch(x) for x in (self._known, self._target, self._path)]
        self._game: dict[str, Tensor] = self._new_game() if has_game(scene) else {}
        self._turns = any(o.drag is not None for o in scene.objects)
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
        self._kinds = torch.tensor(tuple(_BUFFERS.values()), device=self.device)
        self._overflows = torch.zeros(len(_BUFFERS), dtype=torch.long, device=self.device)
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
        kinds = (self._overflow[:, None] & self._kinds) != 0
        full = kinds.any(-1)
        wrong = diverged(self.qpos, self.qvel)
        self.bad = wrong | full
        self.nan_worlds = self.nan_worlds + wrong.sum()
        self.overflow = self.overflow + full.sum()
        self._overflows = self._overflows + kinds.sum(0)
        self._overflow.zero_()

    def overflows(self) -> dict[str, int]:
        return {name: n for name, n in zip(_BUFFERS, self._overflows.tolist()) if n}

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
        solref, solimp = contact_softness(model, drawn)
        m.geom_solref = wp.array(solref.astype(np.float32), dtype=m.geom_solref.dtype)
        m.geom_solimp = wp.array(solimp.astype(np.float32), dtype=m.geom_solimp.dtype)
        gain, bias = rows(model.actuator_gainprm), rows(model.actuator_biasprm)
        stiffness, dampings = drawn.gains(self.scene)
        gain[:, :, 0] *= stiffness
        bias[:, :, 1] *= stiffness
        m.actuator_gainprm = wp.array(gain, dtype=m.actuator_gainprm.dtype)
        m.actuator_biasprm = wp.array(bias, dtype=m.actuator_biasprm.dtype)
        damping = rows(model.dof_damping.reshape(model.nv, -1)[:, 0])
        m.dof_damping = wp.array(damping * dampings.astype(np.float32), dtype=float)
        m.opt.impratio_invsqrt = wp.array(drawn.impratio.astype(np.float32) ** -0.5, dtype=float)
        timesteps = drawn.timesteps(self.scene.timestep, self.scene.substeps)
        if timesteps is not None:
            self._timesteps = [wp.array(h.astype(np.float32), dtype=float) for h in timesteps]

    def _feel(self, felt: np.ndarray, timestep: np.ndarray) -> None:
        """Lets contacts feel the joints' damping in some worlds (n,) with time steps (n,)."""
        m, shape = self.m, (self.num_worlds, self.scene.nv)
        damping = np.broadcast_to(m.dof_damping.numpy(), shape)
        split = split_damping(damping, self.scene.joint_dofs(), felt, timestep)
        armature = np.broadcast_to(m.dof_armature.numpy(), shape) + split.armature
        m.dof_damping = wp.array(split.own.astype(np.float32), dtype=float)
        m.dof_armature = wp.array(armature.astype(np.float32), dtype=float)
        self._felt = wp.array(split.force.astype(np.float32), dtype=float)

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
            if self._felt is not None:
                inputs = [self._felt, d.qvel]
                wp.launch(kernels.damp, dim=d.qvel.shape, inputs=inputs, outputs=[d.qfrc_applied])
            with faster(self._trees):
                mjw.step(self.m, d)
            if self._turns:
                self._ask_law("turn_worlds", self._timesteps[i])
            mjw.contact_force(self.m, d, self._contact_ids, True, self._contact_force)
            wp.launch(
                kernels.sum_contacts,
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
                kernels.keep_largest,
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
            wp.launch(kernels.show_ball, dim=self.num_worlds, inputs=[state, body], outputs=outputs)

    def _roll_balls(self, timestep: wp.array) -> None:
        for i, ball in enumerate(self.scene.bouncing):
            (sphere,) = ball.shapes
            wp.launch(
                kernels.roll,
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
            kernels.keep_momentum,
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
