"""Worlds of C MuJoCo on native threads: what one thread of the ``mujoco`` engine drives.

A control step is ``substeps`` calls of a batch, the momentum kept after each. Results go into
float32 arrays with the components first and the worlds last: an operation on one component then
runs over all links and worlds at once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import mujoco
import numpy as np
from mujoco.batch import Batch

from sports.humanoid.mjcf import body_name
from sports.physics.kinematics import Kinematics, Pose, cross, rotation
from sports.physics.momentum import AthleteKeeper, Tree
from sports.physics.variation import Draw
from sports.scene import Scene

Rows = slice | np.ndarray
_ALL = slice(None)


@dataclass(frozen=True)
class Motion:
    """Of some bodies (...) in N worlds; m, m/s, rad/s, world frame."""

    pos: np.ndarray
    """(3, ..., N) origins."""
    quat: np.ndarray
    """(4, ..., N)"""
    linvel: np.ndarray
    """(3, ..., N) velocities of the origins."""
    angvel: np.ndarray
    """(3, ..., N)"""

    @classmethod
    def zeros(cls, *shape: int) -> Motion:
        """For bodies and worlds of ``shape`` (..., N)."""
        return cls(*(np.zeros((k, *shape), np.float32) for k in (3, 4, 3, 3)))

    def of(self, worlds: slice) -> Motion:
        """Views of some worlds."""
        return Motion(*(getattr(self, f.name)[..., worlds] for f in fields(self)))


@dataclass(frozen=True)
class Results:
    """What a batch of N worlds shows after a step or reset; float32."""

    qpos: np.ndarray
    """(N, nq)"""
    qvel: np.ndarray
    """(N, nv)"""
    mocap_pos: np.ndarray
    """(N, M, 3)"""
    links: Motion
    """(A, B, N)"""
    rotation: np.ndarray
    """(3, 3, A, B, N) R_WB of the links."""
    objects: Motion
    """(O, N)"""
    ground_force: np.ndarray
    """(3, A B, N) as ``Physics.ground_force``"""
    pair_force: np.ndarray
    """(3, P, N) of that substep in which it was largest."""

    @classmethod
    def zeros(cls, scene: Scene, n: int) -> Results:
        """For ``n`` worlds of a scene."""
        agents, links = scene.num_agents, scene.body.num_links
        return cls(
            qpos=np.zeros((n, scene.nq), np.float32),
            qvel=np.zeros((n, scene.nv), np.float32),
            mocap_pos=np.zeros((n, len(scene.mocap_objects), 3), np.float32),
            links=Motion.zeros(agents, links, n),
            rotation=np.zeros((3, 3, agents, links, n), np.float32),
            objects=Motion.zeros(len(scene.free_objects), n),
            ground_force=np.zeros((3, agents * links, n), np.float32),
            pair_force=np.zeros((3, len(scene.contact_pairs), n), np.float32),
        )

    def of(self, worlds: slice) -> Results:
        """Views of some worlds."""
        return Results(
            self.qpos[worlds],
            self.qvel[worlds],
            self.mocap_pos[worlds],
            self.links.of(worlds),
            self.rotation[..., worlds],
            self.objects.of(worlds),
            self.ground_force[..., worlds],
            self.pair_force[..., worlds],
        )


class Worlds:
    """Some worlds of a scene; ``out`` holds their results after every call."""

    def __init__(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        kinematics: Kinematics,
        threads: int,
        out: Results,
        drawn: Draw | None = None,
    ) -> None:
        """``model`` of ``mjcf``; ``drawn``: what makes the worlds differ."""
        self.scene, self.out, self._kinematics = scene, out, kinematics
        n, body = len(out.qpos), scene.body
        self.batch = batch = Batch(model, nsim=n, nthread=threads)
        self.qpos, self.qvel = batch.bind("qpos"), batch.bind("qvel")
        self.warmstart, self._ctrl = batch.bind("qacc_warmstart"), batch.bind("ctrl")
        self._mocap = batch.bind("mocap_pos") if model.nmocap else None
        self._mocap_rows = [model.body(o.name).mocapid[0] for o in scene.mocap_objects]
        self.keepers = [
            AthleteKeeper(model, batch.bind, body_name(agent, body.link_names[0]))
            for agent in range(scene.num_agents)
        ]
        split = out.ground_force.shape[1]
        forces = batch.bind("sensordata")[:, : 3 * (split + out.pair_force.shape[1])]
        forces = forces.reshape(n, -1, 3)
        self._peaks = [_Peak(forces[:, :split], out.ground_force)]
        if scene.contact_pairs:
            self._peaks.append(_Peak(forces[:, split:], out.pair_force))
        self._timesteps: list[np.ndarray] | None = None
        if drawn is not None:
            self._vary(drawn)
        batch.reset(stage=0)
        self._fresh = batch.state[0].copy()
        self._show(_ALL)

    def step(self, ctrl: np.ndarray) -> None:
        """One control step with targets (n, nu)."""
        self._ctrl[:] = ctrl
        for peak in self._peaks:
            peak.clear(_ALL)
        for i in range(self.scene.substeps):
            if self._timesteps is not None:
                self._timestep[:] = self._timesteps[i].reshape(self._timestep.shape)
                for keeper in self.keepers:
                    keeper.expected.timestep = self._timesteps[i]
            self.batch.step()
            with np.errstate(all="ignore"):  # worlds that diverge, found by the engine
                for peak in self._peaks:
                    peak.look()
                if i < self.scene.substeps - 1:
                    for keeper in self.keepers:
                        keeper.correct(current=False)
        with np.errstate(all="ignore"):
            for agent, keeper in enumerate(self.keepers):
                self._finish(agent, keeper)
            self._show_rest(_ALL)

    def reset(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, mocap: np.ndarray) -> None:
        """Puts worlds ``ids`` into states (len(ids), ...)."""
        self.batch.state[ids] = self._fresh
        self.qpos[ids], self.qvel[ids] = qpos, qvel
        if self._mocap is not None:
            for k, row in enumerate(self._mocap_rows):
                self._mocap[ids, row] = mocap[:, k]
        for keeper in self.keepers:
            keeper.forget(ids)
        for peak in self._peaks:
            peak.clear(ids)
        self._show(ids)

    def load(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        warmstart: np.ndarray,
        target: np.ndarray,
        path: np.ndarray,
    ) -> None:
        """Goes on from double-precision states, warm starts and expected momenta (A, n, ...)."""
        self.qpos[:], self.qvel[:], self.warmstart[:] = qpos, qvel, warmstart
        for keeper, expected, where in zip(self.keepers, target, path):
            keeper.expected.target[:], keeper.expected.path[:] = expected, where
        self._show(_ALL)

    def _vary(self, drawn: Draw) -> None:
        """Gives each world its own numbers; see the ``warp`` engine."""
        expand = self.batch.expand
        expand("geom_friction")[:, :, 0] *= drawn.friction[:, None]
        expand("geom_solref")[:, :, 0] = drawn.contact_time[:, None]
        expand("actuator_gainprm")[:, :, 0] *= drawn.stiffness[:, None]
        expand("actuator_biasprm")[:, :, 1] *= drawn.stiffness[:, None]
        damping = expand("dof_damping")
        damping *= drawn.damping.reshape(-1, *[1] * (damping.ndim - 1))
        if drawn.coarse.any():
            h = self.scene.timestep
            self._timestep = expand("opt.timestep")
            double = np.where(drawn.coarse, 2 * h, h)
            none = np.where(drawn.coarse, 0.0, h)
            self._timesteps = [none if i % 2 else double for i in range(self.scene.substeps)]

    def _finish(self, agent: int, keeper: AthleteKeeper) -> None:
        """Corrects an athlete's momentum after the last substep and shows its links."""
        qpos = self.qpos[:, self.scene.agent_qpos(agent)]
        pose = self._kinematics.pose(qpos, self.qvel[:, self.scene.agent_qvel(agent)])
        whole = self._kinematics.whole(pose)
        after = Tree(
            inertia=whole.inertia.T,
            angular=whole.angular.T,
            velocity=whole.velocity.T,
            com=qpos[:, :3] + whole.com.T,
            root_pos=qpos[:, :3],
            root_quat=qpos[:, 3:7],
            root_force=keeper.tree.root_force,
        )
        twist, _ = keeper.correct(True, after)
        # The pose is of the velocities before the correction, which moves the athlete as a whole.
        turn, speed = np.split(np.array(twist.T, np.float32, order="C"), 2)
        pose.spin[:] += turn[:, None]
        pose.velocity[:] += speed[:, None] + cross(turn[:, None], pose.pos - whole.com[:, None])
        self._show_athlete(agent, _ALL, pose)

    def _show(self, rows: Rows) -> None:
        """Shows a state that was set from outside."""
        with np.errstate(all="ignore"):
            for agent in range(self.scene.num_agents):
                qpos = self.qpos[rows, self.scene.agent_qpos(agent)]
                pose = self._kinematics.pose(qpos, self.qvel[rows, self.scene.agent_qvel(agent)])
                self._show_athlete(agent, rows, pose)
            self._show_rest(rows)

    def _show_athlete(self, agent: int, rows: Rows, pose: Pose) -> None:
        links, order = self.out.links, self._kinematics.table
        root = self.qpos[rows, self.scene.agent_qpos(agent)][:, :3].T
        links.pos[:, agent][..., rows] = pose.pos[:, order] + root[:, None]
        links.quat[:, agent][..., rows] = pose.quat[:, order]
        links.linvel[:, agent][..., rows] = pose.velocity[:, order]
        links.angvel[:, agent][..., rows] = pose.spin[:, order]
        self.out.rotation[:, :, agent][..., rows] = pose.rot[:, :, order]

    def _show_rest(self, rows: Rows) -> None:
        """The state itself, and the free objects."""
        out, scene = self.out, self.scene
        out.qpos[rows], out.qvel[rows] = self.qpos[rows], self.qvel[rows]
        if self._mocap is not None:
            out.mocap_pos[rows] = self._mocap[rows][:, self._mocap_rows]
        for k, o in enumerate(scene.free_objects):
            pos, quat = np.split(self.qpos[rows, scene.object_qpos(o.name)].T, [3])
            linear, (x, y, z) = np.split(self.qvel[rows, scene.object_qvel(o.name)].T, 2)
            quat = quat / np.sqrt((quat * quat).sum(0))
            turn = rotation(quat)
            out.objects.pos[:, k][:, rows], out.objects.quat[:, k][:, rows] = pos, quat
            out.objects.linvel[:, k][:, rows] = linear
            spin = turn[:, 0] * x + turn[:, 1] * y + turn[:, 2] * z
            out.objects.angvel[:, k][:, rows] = spin


class _Peak:
    """Each sensor's force in that substep of a control step in which it was largest."""

    def __init__(self, force: np.ndarray, out: np.ndarray) -> None:
        """``force`` (n, S, 3), live; ``out`` (3, S, n)."""
        self._force, self._out = force, out
        self._square = np.zeros(force.shape[:2])

    def clear(self, rows: Rows) -> None:
        self._out[..., rows] = 0.0
        self._square[rows] = 0.0

    def look(self) -> None:
        """Takes the forces of a substep into account; numbers beyond all bounds are no forces."""
        square = self._force * self._force
        square = square[..., 0] + square[..., 1] + square[..., 2]
        # Most sensors are silent: write only where there is something new.
        more = np.nonzero((square > self._square) & (square < 1e30))
        self._square[more] = square[more]
        self._out[:, more[1], more[0]] = self._force[more].T
