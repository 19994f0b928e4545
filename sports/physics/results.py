"""What the ``mujoco`` engine shows of its worlds after a step or a reset.

Float32 arrays with the components first and the worlds last: an operation on one component then
runs over all links and worlds at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from sports.frames import fill_proprioception
from sports.physics.base import SPEED_LIMIT, Geometry
from sports.physics.kinematics import Kinematics, Pose
from sports.physics.vectors import rotation
from sports.scene import Scene


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


class Results:
    """The tensors of ``Physics`` for N worlds: parts of one array, so that worlds are copied at
    once."""

    def __init__(self, scene: Scene, num_worlds: int) -> None:
        agents, links, objects = scene.num_agents, scene.body.num_links, len(scene.free_objects)
        shapes = {
            "qpos": (scene.nq,),
            "qvel": (scene.nv,),
            "mocap_pos": (len(scene.mocap_objects), 3),
            "rotation": (3, 3, agents, links),
            "felt": (agents, 15 * links - 2),
            "whole": (6, agents),
            "ground_force": (3, agents * links),
            "pair_force": (len(scene.contact_pairs),),
        }
        for kind, number in (("links", (agents, links)), ("objects", (objects,))):
            shapes |= {f"{kind}.{f.name}": (_SIZES[f.name], *number) for f in fields(Motion)}
        ends = np.cumsum([math.prod(shape) for shape in shapes.values()])
        self.num_worlds = num_worlds
        # Rows a power of two apart would share their places in a cache.
        self._all = np.zeros((ends[-1], num_worlds + 16), np.float32)[:, :num_worlds]
        parts = {
            name: rows.reshape(*shape, num_worlds)
            for (name, shape), rows in zip(shapes.items(), np.split(self._all, ends[:-1]))
        }
        self.qpos = parts["qpos"]
        """(nq, N)"""
        self.qvel = parts["qvel"]
        """(nv, N)"""
        self.mocap_pos = parts["mocap_pos"]
        """(M, 3, N)"""
        self.links = _motion(parts, "links")
        """(A, B, N)"""
        self.rotation = parts["rotation"]
        """(3, 3, A, B, N) R_WB of the links."""
        self.objects = _motion(parts, "objects")
        """(O, N)"""
        self.felt = parts["felt"]
        """(A, 15 B - 2, N) as ``Physics.felt``"""
        self.whole = parts["whole"]
        """(6, A, N) as ``Physics.whole``"""
        self.ground_force = parts["ground_force"]
        """(3, A B, N) as ``Physics.ground_force``"""
        self.pair_force = parts["pair_force"]
        """(P, N) as ``Physics.pair_force``"""

    @cached_property
    def by_world(self) -> np.ndarray:
        """(N, ...) a copy with the worlds first, quick to pick a few from."""
        return np.ascontiguousarray(self._all.T)

    def states(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """qpos (n, nq), qvel (n, nv) and mocap_pos (n, M, 3) in rows of ``by_world``."""
        nq, nv, moved = len(self.qpos), len(self.qvel), self.mocap_pos.size // self.num_worlds
        qpos, qvel, mocap, _ = np.split(rows, np.cumsum((nq, nv, moved)), axis=1)
        return qpos, qvel, mocap.reshape(len(rows), moved // 3, 3)

    def put(self, worlds: np.ndarray, rows: np.ndarray) -> None:
        """Makes worlds, by index, those of some rows of ``by_world``."""
        self._all[:, worlds] = rows.T

    def diverged(self) -> np.ndarray:
        """(N,) bool, as ``sports.physics.base.diverged``."""
        furthest, fastest = np.abs(self.qpos).max(0), np.abs(self.qvel).max(0)
        return ~((furthest < np.inf) & (fastest < SPEED_LIMIT))

    def pose(self, agent: int) -> Pose:
        """Of the athlete; views."""
        links, rot = self.links, self.rotation[:, :, agent]
        parts = (v[:, agent] for v in (links.pos, links.angvel, links.linvel))
        return Pose(links.quat[:, agent], rot, *parts)


_SIZES = {"pos": 3, "quat": 4, "linvel": 3, "angvel": 3}


def _motion(parts: dict[str, np.ndarray], kind: str) -> Motion:
    return Motion(*(parts[f"{kind}.{f.name}"] for f in fields(Motion)))


class Shown:
    """Results as the tensors of ``Physics``: views of the same memory."""

    def __init__(self, scene: Scene, geometry: Geometry, results: Results) -> None:
        self.scene, self.geometry, self.results = scene, geometry, results
        self.num_worlds = results.num_worlds
        self.qpos, self.qvel = _turned(results.qpos), _turned(results.qvel)
        self.mocap_pos = torch.from_numpy(results.mocap_pos).permute(2, 0, 1)
        links, objects = results.links, results.objects
        self.body_pos, self.body_quat = _turned(links.pos), _turned(links.quat)
        self.body_linvel, self.body_angvel = _turned(links.linvel), _turned(links.angvel)
        self.body_rot = torch.from_numpy(results.rotation).permute(4, 2, 3, 0, 1)
        self.felt = torch.from_numpy(results.felt).permute(2, 0, 1)
        self.whole = _turned(results.whole)
        self.object_pos, self.object_quat = _turned(objects.pos), _turned(objects.quat)
        self.object_linvel, self.object_angvel = _turned(objects.linvel), _turned(objects.angvel)
        agents = (scene.num_agents, scene.body.num_links)
        self.ground_force = _turned(results.ground_force).unflatten(1, agents)
        self.pair_force = torch.from_numpy(results.pair_force).T

    def extent(self, direction: Tensor) -> Tensor:
        return self.geometry.extent(self.body_pos, self.body_quat, direction)


def _turned(array: np.ndarray) -> Tensor:
    """(N, ..., k) tensor over an array (k, ..., N)."""
    turned = torch.from_numpy(array).movedim(-1, 0)
    return turned.movedim(1, -1)


class Display:
    """Writes results from states."""

    def __init__(self, scene: Scene, kinematics: Kinematics, out: Results) -> None:
        self._scene, self._kinematics, self._out = scene, kinematics, out
        self.poses = [out.pose(agent) for agent in range(scene.num_agents)]

    def state(self, qpos: np.ndarray, qvel: np.ndarray, mocap: np.ndarray) -> None:
        """Everything but forces, of states (n, nq), (n, nv), (n, M, 3)."""
        with np.errstate(all="ignore"):
            self.given(qpos, qvel, mocap)
            for agent, pose in enumerate(self.poses):
                self.pose(agent)
                root = qpos[:, self._scene.agent_qpos(agent)][:, :3].T
                whole = self._kinematics.whole(pose)
                self._out.whole[:, agent] = np.concatenate((root + whole.com, whole.velocity))
                self.athlete(agent, root)

    def given(self, qpos: np.ndarray, qvel: np.ndarray, mocap: np.ndarray) -> None:
        """The state itself, and the objects."""
        out, objects, scene = self._out, self._out.objects, self._scene
        out.qpos[:], out.qvel[:], out.mocap_pos[:] = qpos.T, qvel.T, mocap.transpose(1, 2, 0)
        for k, o in enumerate(scene.free_objects):
            pos, quat = np.split(out.qpos[scene.object_qpos(o.name)], [3])
            linear, spin = np.split(out.qvel[scene.object_qvel(o.name)], 2)
            objects.pos[:, k], objects.linvel[:, k] = pos, linear
            unit = np.divide(quat, np.sqrt((quat * quat).sum(0)), out=objects.quat[:, k])
            turn = rotation(unit, np.empty((3, 3, out.num_worlds), np.float32))
            np.einsum("ijn,jn->in", turn, spin, out=objects.angvel[:, k])

    def pose(self, agent: int) -> None:
        """The links of an athlete, as the shown state has them, with positions from the root."""
        qpos, qvel = self._scene.agent_qpos(agent), self._scene.agent_qvel(agent)
        self._kinematics.pose(self._out.qpos[qpos], self._out.qvel[qvel], self.poses[agent])

    def athlete(self, agent: int, root: np.ndarray) -> None:
        """Puts the links of an athlete to its root (3, n), and what it feels."""
        pose = self.poses[agent]
        pose.pos[:] += root.astype(np.float32)[:, None]
        yaw = np.arctan2(pose.rot[1, 0, 0], pose.rot[0, 0, 0])
        motion = (pose.pos, pose.rot, pose.velocity, pose.spin)
        fill_proprioception(self._out.felt[agent], np.cos(yaw), np.sin(yaw), *motion)
