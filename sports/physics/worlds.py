"""The worlds of the ``mujoco`` engine in numpy: a batch of C MuJoCo and what is done around it.

A control step is ``substeps`` calls of the batch, the momentum kept after each.
"""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch

from sports.humanoid.mjcf import body_name
from sports.physics.kinematics import Kinematics
from sports.physics.momentum import AthleteKeeper, Tree
from sports.physics.results import Display, Results
from sports.physics.variation import Draw, contact_softness
from sports.physics.vectors import cross
from sports.scene import Scene


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
        self.scene, self._kinematics, self._out = scene, kinematics, out
        self._display = Display(scene, kinematics, out)
        n, body = out.num_worlds, scene.body
        self.batch = batch = Batch(model, nsim=n, nthread=threads)
        self.qpos, self.qvel = batch.bind("qpos"), batch.bind("qvel")
        self.warmstart, self._ctrl = batch.bind("qacc_warmstart"), batch.bind("ctrl")
        self._mocap = batch.bind("mocap_pos") if model.nmocap else np.zeros((n, 0, 3))
        self._mocap_rows = [model.body(o.name).mocapid[0] for o in scene.mocap_objects]
        self.keepers = [
            AthleteKeeper(model, batch.bind, body_name(agent, body.link_names[0]))
            for agent in range(scene.num_agents)
        ]
        self._peaks = _Peaks(batch.bind("sensordata"), out)
        self._timesteps: list[np.ndarray] | None = None
        self._softness = model.geom_solref, model.geom_solimp
        if drawn is not None:
            self._vary(drawn)
        batch.reset(stage=0)
        self._fresh = batch.state[0].copy()
        self.show()

    def step(self, ctrl: np.ndarray) -> None:
        """One control step with targets (n, nu)."""
        self._ctrl[:] = ctrl
        for i in range(self.scene.substeps):
            if self._timesteps is not None:
                self._timestep[:] = self._timesteps[i].reshape(self._timestep.shape)
                for keeper in self.keepers:
                    keeper.expected.timestep = self._timesteps[i]
            self.batch.step()
            with np.errstate(all="ignore"):  # worlds that diverge, found by the engine
                self._peaks.look()
                if i < self.scene.substeps - 1:
                    for keeper in self.keepers:
                        keeper.correct(current=False)
        with np.errstate(all="ignore"):
            self._display.given(self.qpos, self.qvel, self._mocap_pos())
            for agent, keeper in enumerate(self.keepers):
                self._finish(agent, keeper)
        self._peaks.show()

    def put(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, mocap: np.ndarray) -> None:
        """Puts worlds ``ids`` into states (len(ids), ...), without showing them."""
        self.batch.state[ids] = self._fresh
        self.qpos[ids], self.qvel[ids] = qpos, qvel
        for k, row in enumerate(self._mocap_rows):
            self._mocap[ids, row] = mocap[:, k]
        for keeper in self.keepers:
            keeper.forget(ids)

    def show(self) -> None:
        """Shows a state that was set from outside."""
        self._display.state(self.qpos, self.qvel, self._mocap_pos())

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
        self.show()

    def _mocap_pos(self) -> np.ndarray:
        return self._mocap[:, self._mocap_rows]

    def _vary(self, drawn: Draw) -> None:
        """Gives each world its own numbers; see the ``warp`` engine."""
        expand = self.batch.expand
        expand("geom_friction")[:, :, 0] *= drawn.friction[:, None]
        softness = contact_softness(*self._softness, drawn)
        expand("geom_solref")[:], expand("geom_solimp")[:] = softness
        expand("actuator_gainprm")[:, :, 0] *= drawn.stiffness[:, None]
        expand("actuator_biasprm")[:, :, 1] *= drawn.stiffness[:, None]
        damping = expand("dof_damping")
        damping *= drawn.damping.reshape(-1, *[1] * (damping.ndim - 1))
        self._timesteps = drawn.timesteps(self.scene.timestep, self.scene.substeps)
        if self._timesteps is not None:
            self._timestep = expand("opt.timestep")

    def _finish(self, agent: int, keeper: AthleteKeeper) -> None:
        """Corrects an athlete's momentum after the last substep and shows it."""
        q, v = self.scene.agent_qpos(agent).start, self.scene.agent_qvel(agent).start
        root, pose = self.qpos[:, q : q + 3], self._display.poses[agent]
        self._display.pose(agent)
        whole = self._kinematics.whole(pose)
        axes = pose.rot[:, :, 0].swapaxes(0, 1).reshape(9, -1)
        motion = (whole.angular, whole.velocity, root.T + whole.com, root.T, axes)
        after = Tree(whole.inertia.T, np.concatenate(motion).T, keeper.tree.root_force)
        twist, _ = keeper.correct(True, after)
        # The pose is of the state before the correction, which moves the athlete as a whole.
        turn, speed = np.split(np.array(twist.T, np.float32, order="C"), 2)
        pose.spin[:] += turn[:, None]
        pose.velocity[:] += speed[:, None] + cross(turn[:, None], pose.pos - whole.com[:, None])
        self._display.athlete(agent, root.T)
        out = self._out
        out.qpos[q : q + 3], out.qvel[v : v + 6] = root.T, self.qvel[:, v : v + 6].T
        out.whole[:, agent] = keeper.whole()[:, :6].T


class _Peaks:
    """Contact forces of those substeps of a control step in which they were largest."""

    def __init__(self, sensors: np.ndarray, out: Results) -> None:
        """``sensors`` (n, 3 k), live: first those of the ground, then those of the pairs."""
        ground, pairs = out.ground_force.shape[1], len(out.pair_force)
        self._ground, self._out = ground, out
        self._sensors = sensors[:, : 3 * (ground + pairs)].T
        self._largest: tuple[np.ndarray, np.ndarray] | None = None

    def look(self) -> None:
        """Takes a substep into account."""
        force = self._sensors.astype(np.float32, order="C").reshape(-1, 3, self._out.num_worlds)
        square = np.einsum("kin,kin->kn", force, force)
        if self._largest is None:
            self._largest = force, square
            return
        largest, peak = self._largest
        more = square > peak
        np.copyto(peak, square, where=more)
        np.copyto(largest, force, where=more[:, None])

    def show(self) -> None:
        """After the last substep. Numbers beyond all bounds are no forces."""
        assert self._largest is not None
        force, square = self._largest
        wild = ~(square < 1e30)
        if wild.any():
            force[np.broadcast_to(wild[:, None], force.shape)] = square[wild] = 0.0
        self._out.ground_force[:] = force[: self._ground].swapaxes(0, 1)
        self._out.pair_force[:] = np.sqrt(square[self._ground :])
        self._largest = None
