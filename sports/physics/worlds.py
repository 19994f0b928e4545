"""Worlds of C MuJoCo on native threads: what one thread of the ``mujoco`` engine drives.

A control step is ``substeps`` calls of a batch, the momentum kept after each. Where the links are
afterwards is computed by a second batch that knows neither contacts nor forces: that takes a third
of the time of asking the first. Results go into float32 arrays with the components first and the
worlds last: an operation on one component then runs over all links and worlds at once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import mujoco
import numpy as np
from mujoco.batch import Batch

from sports.humanoid.mjcf import body_name
from sports.physics.momentum import AthleteKeeper
from sports.physics.variation import Draw
from sports.scene import Scene

Rows = slice | np.ndarray
_VEL = int(mujoco.mjtStage.mjSTAGE_VEL)
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
        kinematics: mujoco.MjModel,
        threads: int,
        out: Results,
        drawn: Draw | None = None,
    ) -> None:
        """``model`` and ``kinematics`` of ``mjcf``; ``drawn``: what makes the worlds differ."""
        self.scene, self.out = scene, out
        n, agents = len(out.qpos), scene.num_agents
        self.batch = batch = Batch(model, nsim=n, nthread=threads)
        self._motion = motion = Batch(kinematics, nsim=n, nthread=threads)
        self.qpos, self.qvel = batch.bind("qpos"), batch.bind("qvel")
        self.warmstart, self._ctrl = batch.bind("qacc_warmstart"), batch.bind("ctrl")
        self._mocap = batch.bind("mocap_pos") if model.nmocap else None
        self._mocap_rows = [model.body(o.name).mocapid[0] for o in scene.mocap_objects]
        roots = [body_name(a, scene.body.link_names[0]) for a in range(agents)]
        after = (kinematics, motion.bind)
        self.keepers = [AthleteKeeper(model, batch.bind, root, after=after) for root in roots]
        self._twist, self._shift = np.zeros((6, agents, n)), np.zeros((3, agents, n))
        links = [
            [model.body(body_name(a, link)).id for link in scene.body.link_names]
            for a in range(agents)
        ]
        objects = [model.body(o.name).id for o in scene.free_objects]
        root_ids = model.body_rootid
        self._links = _Reader(motion, np.array(links), root_ids[links][:, :1], out.links)
        self._objects = _Reader(motion, np.array(objects, int), root_ids[objects], out.objects)
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
        self._move(None)
        for agent, keeper in enumerate(self.keepers):
            twist, shift = keeper.correct(current=True)
            self._twist[:, agent], self._shift[:, agent] = twist.T, shift.T
        with np.errstate(all="ignore"):
            self._read(_ALL)

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

    def _move(self, ids: np.ndarray | None) -> None:
        """Computes where the bodies are, and how they move, from the state."""
        rows = _ALL if ids is None else ids
        self._motion.bind("qpos")[rows] = self.qpos[rows]
        self._motion.bind("qvel")[rows] = self.qvel[rows]
        self._motion.forward(ids=ids, stage=_VEL)

    def _show(self, rows: Rows) -> None:
        """Shows a state that was set from outside."""
        self._twist[..., rows], self._shift[..., rows] = 0.0, 0.0
        self._move(None if isinstance(rows, slice) else rows)
        with np.errstate(all="ignore"):
            self._read(rows)

    def _read(self, rows: Rows) -> None:
        out = self.out
        out.qpos[rows], out.qvel[rows] = self.qpos[rows], self.qvel[rows]
        if self._mocap is not None:
            out.mocap_pos[rows] = self._mocap[rows][:, self._mocap_rows]
        # The last substep's correction came after the links were computed.
        self._links.read(rows, self._twist[:, :, None, rows], self._shift[:, :, None, rows])
        if self.scene.free_objects:
            self._objects.read(rows, 0.0, 0.0)


class _Reader:
    """Turns MuJoCo's float64 fields into a :class:`Motion`."""

    def __init__(self, batch: Batch, ids: np.ndarray, roots: np.ndarray, out: Motion) -> None:
        """``ids`` (...) of the bodies, ``roots`` of their trees, of a shape that broadcasts."""
        self._roots, self._out = roots, out
        self._shape, flat = ids.shape, ids.ravel()
        self._ids: Rows = flat
        if flat.size and np.array_equal(flat, np.arange(flat[0], flat[0] + flat.size)):
            self._ids = slice(int(flat[0]), int(flat[0]) + flat.size)  # copies faster
        self._pos, self._quat = batch.bind("xpos"), batch.bind("xquat")
        self._cvel, self._com = batch.bind("cvel"), batch.bind("subtree_com")

    def read(self, rows: Rows, twist: np.ndarray | float, shift: np.ndarray | float) -> None:
        """``twist`` (6, ..., n) and ``shift`` (3, ..., n) are added to all that is read."""
        where = self._take(self._pos, rows)
        pos = np.array(where, np.float32, order="C")
        # In float64, since the centre of mass is subtracted from positions far from the origin.
        arm = np.empty_like(pos)
        com = np.moveaxis(self._com[rows][:, self._roots], (-1, 0), (0, -1))
        np.subtract(where, com, out=arm, casting="same_kind")
        moving = np.array(self._take(self._cvel, rows), np.float32, order="C")
        moving += twist
        pos += shift
        # cvel is taken at the centre of mass of the kinematic tree; move it to the link origin.
        (p, q, r), (x, y, z), lin = moving[:3], arm, moving[3:]
        lin[0] += q * z - r * y
        lin[1] += r * x - p * z
        lin[2] += p * y - q * x
        out = self._out
        out.pos[..., rows], out.quat[..., rows] = pos, self._take(self._quat, rows)
        out.linvel[..., rows], out.angvel[..., rows] = lin, moving[:3]

    def _take(self, field: np.ndarray, rows: Rows) -> np.ndarray:
        """(k, ..., n) components first, worlds last."""
        taken = field[rows][:, self._ids].T
        return taken.reshape(taken.shape[0], *self._shape, taken.shape[2])


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
