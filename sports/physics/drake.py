"""Drake: the independent engine that says whether a result is a property of the motion.

One plant, one diagram, one context per world; worlds are stepped one after another in this
process (run several processes for speed: a plant is not shared between threads). The time step
is finer than MuJoCo's (at most 1/480 s) and the contact model is another one: compliant points
with Hunt-Crossley damping in Drake's convex solver, which is what makes agreement mean something.

Athletes come from :mod:`sports.humanoid.drake_plant`. Fixtures (``fixed`` and ``mocap``) are
welded to the world through a frame whose pose is a parameter of the context, so that each world
has its own; their velocity is zero, as it is for a mocap body in MuJoCo. ``solref`` of an object
is a MuJoCo number and has no meaning here. A ball's restitution comes from its stiffness: a soft
contact loses little, a stiff one more, by a law of the time step alone.
"""

# The stubs of Drake and MuJoCo type arrays, ports and modules more narrowly than they are.
# pyright: reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from torch import Tensor

from sports import quaternion
from sports.ball_law.compiled import for_cpu
from sports.humanoid.drake_plant import DrakeHumanoid, rotate
from sports.humanoid.mjcf import build_model
from sports.physics.base import Geometry, PhysicsState, diverged
from sports.physics.drake_calm import CalmBalls
from sports.physics.drake_objects import floating
from sports.physics.drake_scene import Forces, ScenePlant
from sports.physics.game import build_game, has_game
from sports.scene import Scene

MAX_TIMESTEP = 1.0 / 480.0
"""Largest time step (s) chosen on its own: standing joints then follow MuJoCo to 1e-3 rad."""
BOUNCE_TIMESTEP = 1.0 / 960.0
"""The same of a scene with a ball that bounces, whose contact must be soft for its time step: at
1/480 s a kick at 15 m/s would go through it."""
KICK_TIMESTEP = 1.0 / 3840.0
"""The same where athletes kick it and do not hold it. The softness that 1/960 s asks for keeps ball
and foot together for 20 ms and more, and the leg pushes on: 15 m/s where the same kicks come to 11
in MuJoCo at fine steps and here at 1/3840 s."""
HOLD_TIMESTEP = 1.0 / 1920.0
"""The same where hands hold something that does not bounce. A hand that throws presses with 100 N
on contacts of 5e5 N/m; at a coarser step they hold on for too long: the shipped javelin thrower
came to 0.8 m at 1/480 s, 1.4 m at 1/960 s and 2.0 m at 1/1920 s."""


class DrakePhysics:
    """The ``drake`` engine; see :class:`sports.physics.base.Physics` for the tensors.

    ``timestep`` (s) must divide the scene's control time step; None takes the scene's time step
    divided by the smallest whole number that brings it to 1/480 s or below, with a ball that
    bounces to 1/960 s, with one that is kicked to 1/3840 s, with a javelin to 1/1920 s. Where
    nobody is near a ball that is kicked, control steps are made at 1/480 s
    (:mod:`sports.physics.drake_calm`), unless ``timestep`` is given. Raises ValueError for a time
    step that does not divide.
    """

    engine = "drake"
    felt = None
    whole = None

    def __init__(
        self,
        scene: Scene,
        num_worlds: int,
        timestep: float | None = None,
        contact_approximation: str = "lagged",
    ) -> None:
        self.scene = scene
        self.num_worlds = n = num_worlds
        self.device = torch.device("cpu")
        self.geometry = Geometry(scene.body, self.device)
        self.timestep = _step_of(scene, timestep)

        self._plant = fine = ScenePlant(scene, n, self.timestep, contact_approximation)
        self._calm = None
        if timestep is None and scene.kicked and not has_game(scene):
            step = _at_most(scene, MAX_TIMESTEP)
            coarse = ScenePlant(scene, n, step, contact_approximation)
            self._calm = CalmBalls(scene, fine, coarse)
        self.plant, self.substeps = fine.plant, fine.substeps
        plant = fine.plant
        self._humanoids, self._free = fine.humanoids, fine.free
        self._qpos, self._qvel = np.zeros((n, scene.nq)), np.zeros((n, scene.nv))
        self._add_game()

        agents, links, free = scene.num_agents, scene.body.num_links, len(self._free)
        self._q = np.zeros((n, plant.num_positions()))
        self._v = np.zeros((n, plant.num_velocities()))
        self._mocap = np.zeros((n, len(scene.mocap_objects), 3))
        bodies = agents * links + free
        self._pos, self._quat = np.zeros((n, bodies, 3)), np.zeros((n, bodies, 4))
        self._lin, self._ang = np.zeros((n, bodies, 3)), np.zeros((n, bodies, 3))
        self._ground = np.zeros((n, agents * links, 3))
        self._pair = np.zeros((n, len(scene.contact_pairs)))
        self._others = np.zeros((n * scene.link_contacts, agents * links, 3))
        self.bad = torch.zeros(n, dtype=torch.bool)
        self.nan_worlds = 0
        self.overflow = 0  # Drake has no contact buffers to overflow.
        self._qpos0 = scene.default_qpos()
        self._mocap0 = scene.default_mocap_pos()
        for world in range(n):
            self._place(world, self._qpos0, np.zeros(scene.nv), self._mocap0)
        self._publish()

    def step(self, ctrl: Tensor) -> None:
        targets = ctrl.detach().cpu().numpy().astype(float)
        if targets.shape != (self.num_worlds, self.scene.nu):
            raise ValueError(
                f"ctrl must be ({self.num_worlds}, {self.scene.nu}), not {targets.shape}"
            )
        self.bad = torch.zeros(self.num_worlds, dtype=torch.bool)
        for world in range(self.num_worlds):
            if not self._step_world(world, targets[world]):
                self.bad[world] = True
        self._read_states()
        self.bad |= diverged(self.qpos, self.qvel)
        if self.bad.any():
            self.nan_worlds += int(self.bad.sum())
            for world in torch.nonzero(self.bad).ravel().tolist():
                self._place(world, self._qpos0, np.zeros(self.scene.nv), self._mocap[world])
        self._publish()

    def overflows(self) -> dict[str, int]:
        return {}

    def reset(self, mask: Tensor, state: PhysicsState) -> None:
        qpos, qvel = state.qpos.double().cpu().numpy(), state.qvel.double().cpu().numpy()
        mocap = state.mocap_pos.double().cpu().numpy()
        for world in torch.nonzero(mask).ravel().tolist():
            self._place(world, qpos[world], qvel[world], mocap[world])
            self._forget_ball(world)
            if state.wave_phase is not None:
                self.wave_phase[world] = state.wave_phase[world]
        self._publish()

    def move(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        forces = self._ground.copy(), self._pair.copy(), self._others.copy()
        positions, velocities = qpos.double().cpu().numpy(), qvel.double().cpu().numpy()
        for world in torch.nonzero(mask).ravel().tolist():
            self._place(world, positions[world], velocities[world], self._mocap[world])
        self._ground, self._pair, self._others = forces
        self._publish()

    def extent(self, direction: Tensor) -> Tensor:
        return self.geometry.extent(self.body_pos, self.body_quat, direction)

    def close(self) -> None:
        for plant in self._all_plants():
            plant.close()

    # ---- one world ------------------------------------------------------------------------

    def _step_world(self, world: int, targets: np.ndarray) -> bool:
        """Advances one control step; False if the solver failed or the state is not finite."""
        if not np.isfinite(targets).all():
            self._forget_forces(world)
            return False
        fine, calm = self._plant, self._calm
        before = fine.state(world)
        if calm is not None and not calm.soon(before[0], self._pos[world], self._lin[world]):
            calm.coarse.set_state(world, *calm.to_coarse(*before))
            if self._advance(calm.coarse, world, targets):
                fine.set_state(world, *calm.to_fine(*calm.coarse.state(world)))
                return True
        return self._advance(fine, world, targets)

    def _advance(self, plant: ScenePlant, world: int, targets: np.ndarray) -> bool:
        """The same in one of the plants; False also if in the coarse one a ball met more than the
        ground it rolls on."""
        self._forget_forces(world)
        plant.aim(world, targets)
        calm = self._calm if plant is not self._plant else None
        game, state, law = self._game, (self._qpos, self._qvel), self._law
        if game is not None and law is not None:
            self._read_states(slice(world, world + 1))
            law.begin_world(game, world, *state)
        for _ in range(plant.substeps):
            if game is not None and law is not None:
                law.push_world(game, world, self.timestep, *state)
                self._push(world)
            if not plant.advance(world) or (calm is not None and calm.meets(world)):
                return False
            self._keep_forces(world, plant.forces(world))
            if game is not None and law is not None:
                self._read_states(slice(world, world + 1))
                law.finish_world(game, world, self.timestep, *state)
                if self._dragged:
                    before = self._qvel[world].copy()
                    law.turn_world(game, world, self.timestep, *state)
                    if not np.array_equal(before, self._qvel[world]):
                        self._put(world, self._dragged)
        if self.scene.ball is not None:
            self._put(world, [self.scene.ball.name])
        return bool(np.isfinite(np.concatenate(plant.state(world))).all())

    def _all_plants(self) -> list[ScenePlant]:
        return [self._plant] if self._calm is None else [self._plant, self._calm.coarse]

    def _forget_forces(self, world: int) -> None:
        for forces in (self._ground, self._pair, self._others):
            forces[world : world + 1] = 0.0

    def _keep_forces(self, world: int, found: Forces) -> None:
        """Keeps, per link and per pair, the largest net force of the substeps."""
        for kept, forces in ((self._ground, found.ground), (self._others, found.others)):
            for link, force in forces.items():
                if force @ force > kept[world, link] @ kept[world, link]:
                    kept[world, link] = force
        for k, force in found.pairs.items():
            self._pair[world, k] = np.maximum(self._pair[world, k], np.linalg.norm(force))

    def _place(self, world: int, qpos: np.ndarray, qvel: np.ndarray, mocap: np.ndarray) -> None:
        """Sets one world's state and fixtures; contact forces become zero."""
        scene = self.scene
        q, v = np.zeros(self.plant.num_positions()), np.zeros(self.plant.num_velocities())
        for a, humanoid in enumerate(self._humanoids):
            q[humanoid.q_index], v[humanoid.v_index] = humanoid.to_drake(
                qpos[scene.agent_qpos(a)], qvel[scene.agent_qvel(a)]
            )
        for obj in self._free:
            p, quat = np.split(qpos[scene.object_qpos(obj.name)], [3])
            linear, spin = np.split(qvel[scene.object_qvel(obj.name)], [3])
            quat = quat / np.linalg.norm(quat)
            start, start_v = floating(obj.joint)
            q[start : start + 7] = (*quat, *p)
            v[start_v : start_v + 6] = (*rotate(quat, spin), *linear)
        self._plant.set_state(world, q, v)
        for plant in self._all_plants():
            plant.place_fixtures(world, mocap)
        self._mocap[world] = mocap
        self._forget_forces(world)

    # ---- the ball law ---------------------------------------------------------------------

    def _add_game(self) -> None:
        """The ball and the drag, if the scene has any; the tensors that tell of the ball."""
        scene, n = self.scene, self.num_worlds
        self._game, self._law, self._pushed = None, None, [False] * n
        self._dragged = [o.name for o in scene.objects if o.drag is not None]
        if has_game(scene):
            self._game, self._law = build_game(scene, build_model(scene), n), for_cpu()
            rigids = {
                f"agent{a}/{link.name()}": link
                for a, h in enumerate(self._humanoids)
                for link in h.links
            }
            rigids |= {o.name: o.rigid for o in self._free}
            tools = [s.link for s in scene.surfaces if s.link is not None]
            names = [*dict.fromkeys(tools), *(o.name for o in scene.objects if o.drag is not None)]
            self._pushes = [(rigids[name].index(), rigids[name].default_com()) for name in names]
        surfaces = len(scene.surfaces) if scene.ball is not None else 0
        hits, times = np.zeros((n, surfaces), np.int32), np.full((n, surfaces), np.inf, np.float32)
        places, phases = np.zeros((n, surfaces, 3), np.float32), np.zeros((n, 2), np.float32)
        if self._game is not None and scene.ball is not None:
            shown = {"hits": hits, "hit_time": times, "hit_pos": places, "phases": phases}
            self._game = self._game._replace(**shown)
        self.ball_hits, self.ball_hit_time = torch.from_numpy(hits), torch.from_numpy(times)
        self.ball_hit_pos = torch.from_numpy(places)
        self.wave_phase = torch.from_numpy(phases)

    def _forget_ball(self, world: int) -> None:
        """Impacts of the ball in this world were not."""
        if self._game is not None:
            self._game.pending[world] = 0.0
            self.ball_hits[world], self.ball_hit_time[world] = 0, torch.inf
            self.ball_hit_pos[world] = 0.0

    def _push(self, world: int) -> None:
        """Applies what the law wants applied in the next step."""
        assert self._game is not None
        wrench = self._game.wrench[world]
        if not (wrench.any() or self._pushed[world]):
            return  # nothing new: what the plant has worked out stays valid
        self._pushed[world] = bool(wrench.any())
        forces = []
        for (index, center), row in zip(self._pushes, wrench):
            force = ExternallyAppliedSpatialForce()
            force.body_index, force.p_BoBq_B = index, center
            force.F_Bq_W = SpatialForce(tau=row[3:], f=row[:3])
            forces.append(force)
        port = self.plant.get_applied_spatial_force_input_port()
        port.FixValue(self._plant.contexts[world], forces)

    def _put(self, world: int, names: Sequence[str]) -> None:
        """Puts objects where the law has them. Of the ball the plant does not need to know in
        between: nothing in it touches the ball."""
        q, v = self._plant.state(world)
        for obj in self._free:
            if obj.name in names:
                p, quat = np.split(self._qpos[world, self.scene.object_qpos(obj.name)], [3])
                linear, spin = np.split(self._qvel[world, self.scene.object_qvel(obj.name)], [3])
                start, start_v = floating(obj.joint)
                q[start : start + 7] = (*quat, *p)
                v[start_v : start_v + 6] = (*rotate(quat, spin), *linear)
        self._plant.set_state(world, q, v)

    # ---- tensors --------------------------------------------------------------------------

    def _read_states(self, worlds: slice = slice(None)) -> None:
        """qpos and qvel of worlds in MuJoCo's convention; their tensors, if of all worlds."""
        scene = self.scene
        for world in range(self.num_worlds)[worlds]:
            self._q[world], self._v[world] = self._plant.state(world)
        own_q, own_v = self._q[worlds], self._v[worlds]
        qpos, qvel = self._qpos[worlds], self._qvel[worlds]
        with np.errstate(invalid="ignore", divide="ignore"):
            for a, humanoid in enumerate(self._humanoids):
                qpos[:, scene.agent_qpos(a)], qvel[:, scene.agent_qvel(a)] = humanoid.from_drake(
                    own_q[:, humanoid.q_index], own_v[:, humanoid.v_index]
                )
            for obj in self._free:
                start, start_v = floating(obj.joint)
                quat = own_q[:, start : start + 4]
                quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
                w_W = own_v[:, start_v : start_v + 3]
                w_B = rotate(quat * np.array([1.0, -1.0, -1.0, -1.0]), w_W)
                p_WB, v_WB = own_q[:, start + 4 : start + 7], own_v[:, start_v + 3 : start_v + 6]
                qpos[:, scene.object_qpos(obj.name)] = np.concatenate([p_WB, quat], axis=-1)
                qvel[:, scene.object_qvel(obj.name)] = np.concatenate([v_WB, w_B], axis=-1)
        if worlds == slice(None):
            self.qpos = torch.from_numpy(self._qpos.astype(np.float32))
            self.qvel = torch.from_numpy(self._qvel.astype(np.float32))

    def _publish(self) -> None:
        """Brings every tensor of the protocol up to date with the contexts."""
        self._read_states()
        plant, n = self.plant, self.num_worlds
        for world, context in enumerate(self._plant.contexts):
            for i, rigid in enumerate(self._plant.bodies):
                X_WB = plant.EvalBodyPoseInWorld(context, rigid)
                V_WB = plant.EvalBodySpatialVelocityInWorld(context, rigid)
                self._pos[world, i] = X_WB.translation()
                self._quat[world, i] = X_WB.rotation().ToQuaternion().wxyz()
                self._lin[world, i] = V_WB.translational()
                self._ang[world, i] = V_WB.rotational()
        agents, links = self.scene.num_agents, self.scene.body.num_links
        k = agents * links

        def tensor(values: np.ndarray) -> Tensor:
            return torch.from_numpy(values.astype(np.float32))

        pos, quat = tensor(self._pos), tensor(self._quat)
        lin, ang = tensor(self._lin), tensor(self._ang)
        self.body_pos, self.object_pos = pos[:, :k].view(n, agents, links, 3), pos[:, k:]
        self.body_quat, self.object_quat = quat[:, :k].view(n, agents, links, 4), quat[:, k:]
        self.body_rot = quaternion.matrix(self.body_quat)
        self.body_linvel, self.object_linvel = lin[:, :k].view(n, agents, links, 3), lin[:, k:]
        self.body_angvel, self.object_angvel = ang[:, :k].view(n, agents, links, 3), ang[:, k:]
        self.mocap_pos = tensor(self._mocap)
        self.ground_force = tensor(self._ground).view(n, agents, links, 3)
        self.link_force = tensor(self._others).view(-1, agents, links, 3)
        self.pair_force = tensor(self._pair)


def _step_of(scene: Scene, timestep: float | None) -> float:
    """The time step (s) that a scene is stepped with, or one that is asked for."""
    if timestep is None:
        largest = BOUNCE_TIMESTEP if scene.bouncing else MAX_TIMESTEP
        if scene.kicked:
            largest = KICK_TIMESTEP
        if any(o.holdable and o.restitution is None for o in scene.objects):
            largest = HOLD_TIMESTEP
        return _at_most(scene, largest)
    count = round(scene.control_timestep / timestep) if timestep > 0 else 0
    if count < 1 or abs(count * timestep - scene.control_timestep) > 1e-9:
        raise ValueError(
            f"the Drake time step must divide the control time step "
            f"{scene.control_timestep:.6g} s, which {timestep:.6g} s does not"
        )
    return scene.control_timestep / count


def _at_most(scene: Scene, largest: float) -> float:
    """The scene's time step divided by the smallest whole number that brings it to ``largest``."""
    return scene.timestep / math.ceil(scene.timestep / largest - 1e-9)


__all__ = ["MAX_TIMESTEP", "DrakeHumanoid", "DrakePhysics"]
