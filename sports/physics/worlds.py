"""The worlds of the ``mujoco`` engine: a batch of C MuJoCo and what is done around it.

A control step is ``substeps`` calls of the batch; after each, balls roll and momentum is kept.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from sports.ball_law.compiled import for_cpu
from sports.ball_law.contact import Game
from sports.humanoid.mjcf import body_name
from sports.physics.athletes import Tree, finish_athlete, look_at_contacts, roll_ball
from sports.physics.game import build_game, has_game
from sports.physics.momentum import AthleteKeeper
from sports.physics.results import Results, show, show_state
from sports.physics.variation import Draw, contact_softness, split_damping
from sports.scene import Scene, SceneObject

TOO_MUCH = 1e30
"""Squared contact forces (N^2) from here on are no forces: the world has diverged."""


class _Ball:
    """A ball that bounces and rolls in N worlds."""

    def __init__(self, model: mujoco.MjModel, ball: SceneObject, num_worlds: int) -> None:
        (sphere,) = ball.shapes
        joint, sensor = model.joint(ball.name), model.sensor(f"rolls:{ball.name}")
        first = joint.qposadr[0] + 3
        self._quat = slice(first, first + 4)
        self._qvel = slice(joint.dofadr[0], joint.dofadr[0] + 6)
        self._force = slice(sensor.adr[0], sensor.adr[0] + 3)
        self._mass, self._radius = sphere.mass, sphere.size[0]
        self.friction = np.full(num_worlds, ball.friction)
        """(N,) with the ground."""

    def roll(
        self, timestep: np.ndarray, sensors: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
    ) -> None:
        """The ground's friction after a time step (N,)."""
        roll_ball(
            sensors[:, self._force],
            timestep,
            self.friction,
            self._mass,
            self._radius,
            qpos[:, self._quat],
            qvel[:, self._qvel],
        )


class Worlds:
    """Some worlds of a scene; ``out`` holds their results after every call."""

    def __init__(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        trees: Sequence[Tree],
        threads: int,
        out: Results,
        drawn: Draw | None = None,
        felt_damping: bool = False,
    ) -> None:
        """``model`` of ``mjcf``; ``drawn``: what makes the worlds differ; ``felt_damping``:
        contacts feel the joints' damping in all of them."""
        self.scene, self._trees, self._out = scene, trees, out
        n, body = out.num_worlds, scene.body
        self.batch = batch = Batch(model, nsim=n, nthread=threads)
        self.qpos, self.qvel = batch.bind("qpos"), batch.bind("qvel")
        self.warmstart, self._ctrl = batch.bind("qacc_warmstart"), batch.bind("ctrl")
        self._mocap = batch.bind("mocap_pos") if model.nmocap else np.zeros((n, 0, 3))
        self._mocap_rows = [model.body(o.name).mocapid[0] for o in scene.mocap_objects]
        self.game = self._new_game(model) if has_game(scene) else None
        """The ball and the drag, if the scene has any."""
        self._law = for_cpu()
        applied = np.zeros((n, scene.num_agents, 6)) if self.game is None else self.game.applied
        self.keepers = [
            AthleteKeeper(
                model,
                batch.bind,
                body_name(agent, body.link_names[0]),
                applied=applied[:, agent],
            )
            for agent in range(scene.num_agents)
        ]
        self._athletes = [out.athlete(agent) for agent in range(scene.num_agents)]
        self._constraint, self._sensors = batch.bind("qfrc_constraint"), batch.bind("sensordata")
        sensors = out.ground_force.shape[1] + len(out.pair_force) + out.link_force.shape[1]
        self._peaks = np.zeros((n, sensors))
        self._balls = [_Ball(model, ball, n) for ball in scene.bouncing]
        self._timesteps: list[np.ndarray] | None = None
        self._even = np.full(n, scene.timestep)
        felt, longest = np.full(n, felt_damping), self._even
        if drawn is not None:
            self._vary(model, drawn)
            felt, longest = drawn.felt, drawn.stride * scene.timestep
        self._felt: np.ndarray | None = None
        if felt.any():
            self._feel(felt, longest)
        batch.reset(stage=0)
        self._fresh = batch.state[0].copy()
        self.show()

    def step(self, ctrl: np.ndarray) -> bool:
        """One control step with targets (n, nu). Whether some world has diverged."""
        out, game, state = self._out, self.game, (self.qpos, self.qvel)
        self._ctrl[:] = ctrl
        forces = out.ground_force, out.pair_force, out.link_force
        for array in (self._peaks, *forces):
            array[:] = 0.0
        if game is not None:
            self._law.begin_worlds(game, *state)
        for i in range(self.scene.substeps):
            last, timestep = i == self.scene.substeps - 1, self._even
            if self._timesteps is not None:
                timestep = self._timesteps[i]
                self._timestep[:] = timestep.reshape(self._timestep.shape)
                for keeper in self.keepers:
                    keeper.kept.timestep[:] = timestep
            if game is not None:
                self._law.push_worlds(game, timestep, *state)
            if self._felt is not None:
                np.multiply(self._felt, self.qvel, out=self._friction)
            self.batch.step()
            if game is not None:
                self._law.turn_worlds(game, timestep, *state)
            look_at_contacts(self._sensors, self._peaks, *forces, TOO_MUCH)
            for ball in self._balls:
                ball.roll(timestep, self._sensors, self.qpos, self.qvel)
            for tree, keeper, athlete in zip(self._trees, self.keepers, self._athletes):
                if last:
                    kept = keeper.kept, self._constraint, keeper.applied
                    finish_athlete(tree, *kept, *state, athlete)
                else:
                    keeper.correct(current=False)
            if game is not None:
                self._law.finish_worlds(game, timestep, *state)
        return show_state(self.scene, *state, out)

    def take(self, ids: np.ndarray) -> None:
        """Puts worlds ``ids`` into the states that ``out`` shows."""
        self.batch.state[ids] = self._fresh
        self.qpos[ids], self.qvel[ids] = self._out.qpos[:, ids].T, self._out.qvel[:, ids].T
        for k, row in enumerate(self._mocap_rows):
            self._mocap[ids, row] = self._out.mocap_pos[k][:, ids].T
        for keeper in self.keepers:
            keeper.forget(ids)
        if self.game is not None:
            self.game.pending[ids] = 0.0

    def move(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Changes the states of worlds ``ids`` to (n, nq), (n, nv), float32, where they differ
        from what is shown."""
        scene, out = self.scene, self._out
        changed_q, changed_v = qpos != out.qpos[:, ids].T, qvel != out.qvel[:, ids].T
        self.qpos[ids] = np.where(changed_q, qpos, self.qpos[ids])
        self.qvel[ids] = np.where(changed_v, qvel, self.qvel[ids])
        for agent, keeper in enumerate(self.keepers):
            moved = changed_q[:, scene.agent_qpos(agent)].any(1)
            moved |= changed_v[:, scene.agent_qvel(agent)].any(1)
            keeper.forget(ids[moved])
        some = Results(scene, len(ids))
        show(scene, self._trees, self.qpos[ids], self.qvel[ids], some)
        for name in ("mocap_pos", "ground_force", "pair_force", "link_force"):
            getattr(some, name)[:] = getattr(out, name)[..., ids]
        for own, shown in zip(some.rows[1:], out.rows[1:]):
            own[:] = shown[ids]
        out.put(ids, some, np.arange(len(ids)))

    def show(self) -> None:
        """Shows a state that was set from outside."""
        show(self.scene, self._trees, self.qpos, self.qvel, self._out)
        self._out.mocap_pos[:] = self._mocap[:, self._mocap_rows].transpose(1, 2, 0)

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
            keeper.target[:], keeper.path[:] = expected, where
        self.show()

    def _new_game(self, model: mujoco.MjModel) -> Game:
        """Its arrays; impacts are noted where they are shown."""
        out = self._out
        wrench = self.batch.bind("xfrc_applied")
        shown = {"hits": out.ball_hits, "hit_time": out.ball_hit_time, "hit_pos": out.ball_hit_pos}
        game = build_game(self.scene, model, out.num_worlds, wrench)
        if self.scene.ball is None:
            return game
        return game._replace(phases=out.wave_phase, **shown)

    def _vary(self, model: mujoco.MjModel, drawn: Draw) -> None:
        """Gives each world its own numbers; see the ``warp`` engine."""
        expand = self.batch.expand
        expand("geom_friction")[:, :, 0] *= drawn.friction[:, None]
        for ball in self._balls:
            ball.friction *= drawn.friction
        softness = contact_softness(model, drawn)
        expand("geom_solref")[:], expand("geom_solimp")[:] = softness
        stiffness, dampings = drawn.gains(self.scene)
        expand("actuator_gainprm")[:, :, 0] *= stiffness
        expand("actuator_biasprm")[:, :, 1] *= stiffness
        damping = expand("dof_damping").reshape(*dampings.shape, -1)
        damping *= dampings[..., None]
        if drawn.cone.any():
            expand("opt.cone")[drawn.cone] = int(mujoco.mjtCone.mjCONE_ELLIPTIC)
        if (drawn.impratio != 1.0).any():
            expand("opt.impratio")[:] = drawn.impratio
        self._timesteps = drawn.timesteps(self.scene.timestep, self.scene.substeps)
        if self._timesteps is not None:
            self._timestep = expand("opt.timestep")

    def _feel(self, felt: np.ndarray, timestep: np.ndarray) -> None:
        """Lets contacts feel the joints' damping in some worlds (n,) with time steps (n,)."""
        n, expand = len(felt), self.batch.expand
        damping = expand("dof_damping").reshape(n, self.scene.nv, -1)[:, :, 0]
        split = split_damping(damping, self.scene.joint_dofs(), felt, timestep)
        damping[:] = split.own
        expand("dof_armature")[:] += split.armature
        self._felt, self._friction = -split.force, self.batch.bind("qfrc_applied")
