"""C MuJoCo on a native thread pool: the engine that runs everywhere.

Each control step is ``substeps`` calls of the batch; contact forces are kept from the substep
in which they were largest, and the last call leaves positions and velocities current.
"""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from sports.humanoid.mjcf import body_name, build_model
from sports.physics.base import Geometry, PhysicsState, default_state, diverged
from sports.physics.momentum import AthleteKeeper
from sports.physics.variation import Draw, Variation, draw
from sports.quaternion import cross
from sports.scene import Scene

_VEL = int(mujoco.mjtStage.mjSTAGE_VEL)


class MujocoPhysics:
    """The ``mujoco`` engine; see :class:`sports.physics.base.Physics` for the tensors."""

    engine = "mujoco"

    def __init__(
        self,
        scene: Scene,
        num_worlds: int,
        threads: int = 0,
        variation: Variation | None = None,
        variation_seed: int = 0,
    ) -> None:
        """``threads``: 0 for all cores. ``variation``: let the worlds differ."""
        self.scene = scene
        self.num_worlds = n = num_worlds
        self.device = torch.device("cpu")
        self.model = model = build_model(scene)
        self.batch = Batch(model, nsim=n, nthread=threads)
        self.geometry = Geometry(scene.body, self.device)
        bind = self.batch.bind
        self._qpos, self._qvel, self._ctrl = bind("qpos"), bind("qvel"), bind("ctrl")
        self._mocap = bind("mocap_pos") if model.nmocap else None
        self._xpos, self._xquat, self._cvel = bind("xpos"), bind("xquat"), bind("cvel")
        self._com, self._sensors = bind("subtree_com"), bind("sensordata")
        self._warmstart = bind("qacc_warmstart")

        agents, links = scene.num_agents, scene.body.num_links
        self._ids = np.array(
            [
                [model.body(body_name(a, link)).id for link in scene.body.link_names]
                for a in range(agents)
            ]
        )
        self._objects = np.array([model.body(o.name).id for o in scene.free_objects], dtype=int)
        every = np.concatenate((self._ids.ravel(), self._objects))
        self._rows: slice | np.ndarray = every
        if np.array_equal(every, np.arange(every[0], every[0] + len(every))):
            self._rows = slice(int(every[0]), int(every[0]) + len(every))  # copies faster
        self._roots = model.body_rootid[every]
        self._mocap_rows = [model.body(o.name).mocapid[0] for o in scene.mocap_objects]
        self._shape = (agents, links)
        self._num_ground = agents * links

        self.qpos = torch.zeros(n, scene.nq)
        self.qvel = torch.zeros(n, scene.nv)
        self.mocap_pos = torch.zeros(n, len(self._mocap_rows), 3)
        self.ground_force = torch.zeros(n, agents, links, 3)
        self.pair_force = torch.zeros(n, len(scene.contact_pairs))
        self.bad = torch.zeros(n, dtype=torch.bool)
        self.nan_worlds = 0
        self.overflow = 0
        self._forces = np.zeros((n, self._num_ground + len(scene.contact_pairs), 3))
        roots = [body_name(a, scene.body.link_names[0]) for a in range(agents)]
        self._keepers = [AthleteKeeper(model, bind, root) for root in roots]
        self._twist, self._shift = np.zeros((n, agents, 6)), np.zeros((n, agents, 3))
        self._timesteps: list[np.ndarray] | None = None
        if variation is not None:
            self._vary(draw(variation, n, scene.substeps, variation_seed))
        self.batch.reset(stage=_VEL)
        self._read()

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

    def step(self, ctrl: Tensor) -> None:
        self._ctrl[:] = ctrl.numpy()
        forces = np.zeros_like(self._forces)
        largest = np.full(forces.shape[:2], -1.0)
        for i in range(self.scene.substeps):
            last = i == self.scene.substeps - 1
            if self._timesteps is not None:
                self._timestep[:] = self._timesteps[i].reshape(self._timestep.shape)
            self.batch.step(stage=_VEL if last else 0)
            self._keep_momentum(i, last)
            now = self._sensors.reshape(self.num_worlds, -1, 3)[:, : self._forces.shape[1]]
            norm = np.einsum("nsi,nsi->ns", now, now)
            more = norm > largest
            np.copyto(forces, now, where=more[:, :, None])
            np.copyto(largest, norm, where=more)
        self._forces = np.nan_to_num(forces)
        with np.errstate(over="ignore", invalid="ignore"):  # diverged worlds, found just below
            self._read()
        self.bad = diverged(self.qpos, self.qvel)
        if self.bad.any():
            self.nan_worlds += int(self.bad.sum())
            safe = default_state(self.scene, self.num_worlds, self.device)
            safe.mocap_pos = self.mocap_pos
            self.reset(self.bad, safe)

    def _keep_momentum(self, substep: int, last: bool) -> None:
        """Undoes the integrator's drift of every athlete's momentum; see ``momentum.py``."""
        for agent, keeper in enumerate(self._keepers):
            if self._timesteps is not None:
                keeper.expected.timestep = self._timesteps[substep]
            twist, shift = keeper.correct(current=last)
            if last:
                self._twist[:, agent] = twist
                self._shift[:, agent] = shift

    def reset(self, mask: Tensor, state: PhysicsState) -> None:
        ids = np.flatnonzero(mask.numpy())
        if ids.size == 0:
            return
        self.batch.reset(ids=ids, stage=0)
        self._qpos[ids] = state.qpos.numpy()[ids]
        self._qvel[ids] = state.qvel.numpy()[ids]
        if self._mocap is not None:
            mocap = state.mocap_pos.numpy()[ids]
            for k, row in enumerate(self._mocap_rows):
                self._mocap[ids, row] = mocap[:, k]
        self.batch.forward(ids=ids, stage=_VEL)
        for keeper in self._keepers:
            keeper.forget(ids)
        self._twist[ids], self._shift[ids] = 0.0, 0.0
        self._forces[ids] = 0.0
        self._read()

    def extent(self, direction: Tensor) -> Tensor:
        return self.geometry.extent(self.body_pos, self.body_quat, direction)

    def extra_state(self) -> dict[str, Tensor]:
        """Double-precision state and the solver's warm start: with them a resumed run repeats
        the interrupted one bit for bit."""
        return {
            "qpos": torch.from_numpy(self._qpos.copy()),
            "qvel": torch.from_numpy(self._qvel.copy()),
            "qacc_warmstart": torch.from_numpy(self._warmstart.copy()),
            "target": torch.from_numpy(np.stack([k.expected.target for k in self._keepers])),
            "path": torch.from_numpy(np.stack([k.expected.path for k in self._keepers])),
        }

    def load_extra_state(self, state: dict[str, Tensor]) -> None:
        """Restores :meth:`extra_state`; call after ``reset``."""
        self._qpos[:], self._qvel[:] = state["qpos"].numpy(), state["qvel"].numpy()
        self._warmstart[:] = state["qacc_warmstart"].numpy()
        for i, keeper in enumerate(self._keepers):
            keeper.expected.target[:] = state["target"][i].numpy()
            keeper.expected.path[:] = state["path"][i].numpy()
        self.batch.forward(stage=_VEL)
        self._read()

    def close(self) -> None:
        del self.batch

    def _read(self) -> None:
        """Copies the engine's float64 rows into the float32 tensors of the protocol."""
        n, (agents, links) = self.num_worlds, self._shape
        k = agents * links
        self.qpos = torch.from_numpy(self._qpos.astype(np.float32))
        self.qvel = torch.from_numpy(self._qvel.astype(np.float32))
        if self._mocap is not None:
            self.mocap_pos = torch.from_numpy(self._mocap[:, self._mocap_rows].astype(np.float32))
        # In float64, since the centre of mass is subtracted from positions far from the origin.
        arm = self._xpos[:, self._rows] - self._com[:, self._roots]
        pos = _float(self._xpos[:, self._rows])
        quat, twist = _float(self._xquat[:, self._rows]), _float(self._cvel[:, self._rows])
        # The last substep's correction came after the engine had computed these.
        shift, change = _float(self._shift), _float(self._twist)
        pos[:, :k].view(n, agents, links, 3).add_(shift[:, :, None])
        twist[:, :k].view(n, agents, links, 6).add_(change[:, :, None])
        # cvel is taken at the centre of mass of the kinematic tree; move it to the link origin.
        ang = twist[..., :3]
        lin = twist[..., 3:] + cross(ang, _float(arm))
        self.body_pos, self.object_pos = pos[:, :k].view(n, agents, links, 3), pos[:, k:]
        self.body_quat, self.object_quat = quat[:, :k].view(n, agents, links, 4), quat[:, k:]
        self.body_linvel, self.object_linvel = lin[:, :k].view(n, agents, links, 3), lin[:, k:]
        self.body_angvel, self.object_angvel = ang[:, :k].unflatten(1, self._shape), ang[:, k:]
        forces = _float(self._forces)
        self.ground_force = forces[:, :k].view(n, agents, links, 3)
        self.pair_force = forces[:, k:].norm(dim=-1)


def _float(values: np.ndarray) -> Tensor:
    """A float32 copy as a tensor."""
    return torch.from_numpy(values.astype(np.float32))
