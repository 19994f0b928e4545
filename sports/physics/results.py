"""What the ``mujoco`` engine shows of its worlds after a step or a reset.

Float32 arrays with the components first and the worlds last: what a task does with one component
then runs over all links and worlds at once. Only what is felt has the worlds first, as the
observation that it becomes a part of.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from sports.physics.athletes import (
    Athlete,
    Tree,
    copy_worlds,
    show_athlete,
    show_numbers,
    show_object,
)
from sports.physics.base import SPEED_LIMIT, Geometry
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
            "whole": (6, agents),
            "ground_force": (3, agents * links),
            "pair_force": (len(scene.contact_pairs),),
            "link_force": (3, agents * links * scene.link_contacts),
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
        self.felt = np.zeros((num_worlds, agents, 15 * links - 2), np.float32)
        """(N, A, 15 B - 2) as ``Physics.felt``"""
        self.whole = parts["whole"]
        """(6, A, N) as ``Physics.whole``"""
        self.ground_force = parts["ground_force"]
        """(3, A B, N) as ``Physics.ground_force``"""
        self.pair_force = parts["pair_force"]
        """(P, N) as ``Physics.pair_force``"""
        self.link_force = parts["link_force"]
        """(3, A B, N) as ``Physics.link_force``; (3, 0, N) where nobody asks for it."""
        surfaces = len(scene.surfaces) if scene.ball is not None else 0
        self.ball_hits = np.zeros((num_worlds, surfaces), np.int32)
        """(N, S) as ``Physics.ball_hits``"""
        self.ball_hit_time = np.full((num_worlds, surfaces), np.inf, np.float32)
        """(N, S) as ``Physics.ball_hit_time``"""
        self.ball_hit_pos = np.zeros((num_worlds, surfaces, 3), np.float32)
        """(N, S, 3) as ``Physics.ball_hit_pos``"""
        self.wave_phase = np.zeros((num_worlds, 2), np.float32)
        """(N, 2) as ``Physics.wave_phase``"""
        self.bad = np.zeros(num_worlds, np.bool_)
        """(N,) bool: the numbers of the state are those of ``sports.physics.base.diverged``."""

    @cached_property
    def by_world(self) -> np.ndarray:
        """(N, ...) a copy with the worlds first, quick to pick a few from."""
        return np.ascontiguousarray(self._all.T)

    def put(self, worlds: np.ndarray, source: Results, chosen: np.ndarray | None = None) -> None:
        """Makes worlds, by index, those of other results that do not change any more: the same
        ones or ``chosen`` ones."""
        chosen = worlds if chosen is None else chosen
        copy_worlds(source.by_world, chosen, worlds, self._all)
        for own, other in zip(self.rows, source.rows):
            own[worlds] = other[chosen]

    @property
    def rows(self) -> tuple[np.ndarray, ...]:
        """Arrays (N, ...) that are not in the one array."""
        balls = (self.ball_hits, self.ball_hit_time, self.ball_hit_pos, self.wave_phase)
        return (self.felt, *balls) if self.ball_hits.shape[1] else (self.felt,)

    def athlete(self, agent: int) -> Athlete:
        """What is shown of an athlete; views."""
        links = self.links
        return Athlete(
            quat=links.quat[:, agent],
            rot=self.rotation[:, :, agent],
            pos=links.pos[:, agent],
            linvel=links.linvel[:, agent],
            angvel=links.angvel[:, agent],
            felt=self.felt[:, agent],
            whole=self.whole[:, agent],
        )


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
        self.felt = torch.from_numpy(results.felt)
        self.ball_hits = torch.from_numpy(results.ball_hits)
        self.ball_hit_time = torch.from_numpy(results.ball_hit_time)
        self.ball_hit_pos = torch.from_numpy(results.ball_hit_pos)
        self.wave_phase = torch.from_numpy(results.wave_phase)
        self.whole = _turned(results.whole)
        self.object_pos, self.object_quat = _turned(objects.pos), _turned(objects.quat)
        self.object_linvel, self.object_angvel = _turned(objects.linvel), _turned(objects.angvel)
        agents = (scene.num_agents, scene.body.num_links)
        self.ground_force = _turned(results.ground_force).unflatten(1, agents)
        self.pair_force = torch.from_numpy(results.pair_force).T
        others = _turned(results.link_force)
        self.link_force = others.unflatten(1, agents) if scene.link_contacts else none(agents)

    def extent(self, direction: Tensor) -> Tensor:
        return self.geometry.extent(self.body_pos, self.body_quat, direction)


def none(agents: tuple[int, int]) -> Tensor:
    """(0, A, B, 3) the ``link_force`` that nobody asked for."""
    return torch.zeros(0, *agents, 3)


def _turned(array: np.ndarray) -> Tensor:
    """(N, ..., k) tensor over an array (k, ..., N)."""
    turned = torch.from_numpy(array).movedim(-1, 0)
    return turned.movedim(1, -1)


def show_state(scene: Scene, qpos: np.ndarray, qvel: np.ndarray, out: Results) -> bool:
    """The state itself (N, nq), (N, nv), float64, and the free objects. Whether it is bad in some
    world."""
    out.bad[:] = False
    lost = show_numbers(qpos, out.qpos, np.inf, out.bad)
    lost |= show_numbers(qvel, out.qvel, SPEED_LIMIT, out.bad)
    for k, o in enumerate(scene.free_objects):
        state = qpos[:, scene.object_qpos(o.name)], qvel[:, scene.object_qvel(o.name)]
        show_object(*state, *(getattr(out.objects, f.name)[:, k] for f in fields(Motion)))
    return lost


def show(
    scene: Scene, trees: Sequence[Tree], qpos: np.ndarray, qvel: np.ndarray, out: Results
) -> None:
    """Everything but fixtures and forces, of a state (N, nq), (N, nv), float64."""
    show_state(scene, qpos, qvel, out)
    for agent, tree in enumerate(trees):
        show_athlete(tree, qpos, qvel, out.athlete(agent))
