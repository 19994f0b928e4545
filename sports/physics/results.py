"""What the ``mujoco`` engine shows of its worlds after a step or a reset.

Float32 arrays with the components first and the worlds last: an operation on one component then
runs over all links and worlds at once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from sports.frames import fill_proprioception
from sports.physics.base import Geometry
from sports.physics.kinematics import Kinematics, Pose
from sports.physics.vectors import rotation
from sports.scene import Scene

Rows = slice | np.ndarray
"""Some worlds: all, or by index."""


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
    """The tensors of ``Physics`` for N worlds."""

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
    felt: np.ndarray
    """(A, 15 B - 2, N) as ``Physics.felt``"""
    ground_force: np.ndarray
    """(3, A B, N) as ``Physics.ground_force``"""
    pair_force: np.ndarray
    """(P, N) as ``Physics.pair_force``"""

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
            felt=np.zeros((agents, 15 * links - 2, n), np.float32),
            objects=Motion.zeros(len(scene.free_objects), n),
            ground_force=np.zeros((3, agents * links, n), np.float32),
            pair_force=np.zeros((len(scene.contact_pairs), n), np.float32),
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
            self.felt[..., worlds],
            self.ground_force[..., worlds],
            self.pair_force[..., worlds],
        )

    def take(self, worlds: np.ndarray, other: Results) -> None:
        """Copies the rows of some worlds, by index."""
        for mine, theirs in zip(self._worlds_last(), other._worlds_last()):
            mine[..., worlds] = theirs[..., worlds]

    def _worlds_last(self) -> list[np.ndarray]:
        """Views of all arrays with the worlds in the last axis."""
        state = [self.qpos.T, self.qvel.T, self.mocap_pos.T]
        motion = [getattr(m, f.name) for m in (self.links, self.objects) for f in fields(m)]
        return [*state, *motion, self.rotation, self.felt, self.ground_force, self.pair_force]


class Shown:
    """Results as the tensors of ``Physics``: views of the same memory."""

    def __init__(self, scene: Scene, geometry: Geometry, results: Results) -> None:
        self.scene, self.geometry, self.results = scene, geometry, results
        self.num_worlds = len(results.qpos)
        self.qpos, self.qvel = torch.from_numpy(results.qpos), torch.from_numpy(results.qvel)
        self.mocap_pos = torch.from_numpy(results.mocap_pos)
        links, objects = results.links, results.objects
        self.body_pos, self.body_quat = _turned(links.pos), _turned(links.quat)
        self.body_linvel, self.body_angvel = _turned(links.linvel), _turned(links.angvel)
        self.body_rot = torch.from_numpy(results.rotation).permute(4, 2, 3, 0, 1)
        self.felt = torch.from_numpy(results.felt).permute(2, 0, 1)
        self.object_pos, self.object_quat = _turned(objects.pos), _turned(objects.quat)
        self.object_linvel, self.object_angvel = _turned(objects.linvel), _turned(objects.angvel)
        agents = (scene.num_agents, scene.body.num_links)
        self.ground_force = _turned(results.ground_force).unflatten(1, agents)
        self.pair_force = torch.from_numpy(results.pair_force).T

    def extent(self, direction: Tensor) -> Tensor:
        return self.geometry.extent(self.body_pos, self.body_quat, direction)


def _turned(array: np.ndarray) -> Tensor:
    """(N, ..., k) tensor over an array (k, ..., N)."""
    return torch.from_numpy(array).movedim((-1, 0), (0, -1))


class Display:
    """Writes results from states."""

    def __init__(self, scene: Scene, kinematics: Kinematics, out: Results) -> None:
        self._scene, self._kinematics, self._out = scene, kinematics, out

    def state(self, rows: Rows, qpos: np.ndarray, qvel: np.ndarray, mocap: np.ndarray) -> None:
        """Everything but forces, of states (n, nq), (n, nv), (n, M, 3)."""
        with np.errstate(all="ignore"):
            for agent in range(self._scene.num_agents):
                own = qpos[:, self._scene.agent_qpos(agent)]
                pose = self._kinematics.pose(own, qvel[:, self._scene.agent_qvel(agent)])
                self.athlete(agent, rows, own[:, :3], pose)
            self.rest(rows, qpos, qvel, mocap)

    def athlete(self, agent: int, rows: Rows, root: np.ndarray, pose: Pose) -> None:
        """The links of an athlete with its root at (n, 3)."""
        out, links, order = self._out, self._out.links, self._kinematics.table
        pos = (pose.pos[:, order] + root.T[:, None]).astype(np.float32)
        rot, linvel, angvel = pose.rot[:, :, order], pose.velocity[:, order], pose.spin[:, order]
        links.pos[:, agent][..., rows] = pos
        links.quat[:, agent][..., rows] = pose.quat[:, order]
        links.linvel[:, agent][..., rows] = linvel
        links.angvel[:, agent][..., rows] = angvel
        out.rotation[:, :, agent][..., rows] = rot
        felt = np.empty((out.felt.shape[1], pos.shape[2]), np.float32)
        yaw = np.arctan2(rot[1, 0, 0], rot[0, 0, 0])
        fill_proprioception(felt, np.cos(yaw), np.sin(yaw), pos, rot, linvel, angvel)
        out.felt[agent][:, rows] = felt

    def rest(self, rows: Rows, qpos: np.ndarray, qvel: np.ndarray, mocap: np.ndarray) -> None:
        """The state itself, and the objects."""
        out, objects = self._out, self._out.objects
        out.qpos[rows], out.qvel[rows], out.mocap_pos[rows] = qpos, qvel, mocap
        for k, o in enumerate(self._scene.free_objects):
            pos, quat = np.split(qpos[:, self._scene.object_qpos(o.name)].T, [3])
            linear, (x, y, z) = np.split(qvel[:, self._scene.object_qvel(o.name)].T, 2)
            quat = quat / np.sqrt((quat * quat).sum(0))
            turn = rotation(quat)
            objects.pos[:, k][:, rows], objects.quat[:, k][:, rows] = pos, quat
            objects.linvel[:, k][:, rows] = linear
            objects.angvel[:, k][:, rows] = turn[:, 0] * x + turn[:, 1] * y + turn[:, 2] * z
