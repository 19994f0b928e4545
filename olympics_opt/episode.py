"""Recorded episodes as pictures need them: states put into a model, the part that decides.

Shared by the sheet of frames (`render.py`), the video (`video.py`) and the camera (`camera.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

from olympics_opt.raycast import Solid
from olympics_opt.scenery import complete_qpos, dressed, is_net, rgb, shape_colors, terrain
from olympics_opt.scenery.props import MESH
from sports.humanoid.mjcf import body_name, build_model
from sports.scene import Scene

BEFORE, AFTER = 0.7, 0.6
"""Seconds shown before a take-off and after the landing."""
TOUCH = 1.0
"""Ground force above which a link counts as touching (N)."""


class Episode(Protocol):
    """What is drawn: the fields of `rl.evaluate.Recording` that pictures need."""

    task: str
    scene: Scene
    qpos: np.ndarray
    """(T, nq) or, for a motion without its objects, (T, 7 + num_dofs)."""
    mocap_pos: np.ndarray
    """(T, M, 3)"""
    ground_force: np.ndarray
    """(T, A, B, 3) N, world frame."""
    metrics: dict[str, float]
    seed: int
    world: int
    dt: float


@dataclass(frozen=True)
class Window:
    """The part of an episode that decides it."""

    start: int
    takeoff: int | None
    landing: int | None
    stop: int
    """Last frame, included."""


class Player:
    """Puts an episode's frames into a MuJoCo model, one at a time.

    ``scene`` is the episode's with its props. ``build`` makes the model of it.
    """

    def __init__(
        self, episode: Episode, build: Callable[[Scene], mujoco.MjModel] = build_model
    ) -> None:
        self.episode = episode
        shown = getattr(episode, "shown", {})
        self.scene, places = dressed(episode.scene, shown)
        self.ground = terrain(episode.scene, shown)
        scene = self.scene
        self.model = build(scene)
        self.data = mujoco.MjData(self.model)
        self.qpos = complete_qpos(scene, episode.qpos)
        mocap = np.asarray(getattr(episode, "mocap_pos", np.zeros(0)), dtype=float)
        if mocap.size == 0:
            mocap = episode.scene.default_mocap_pos()[None]
        count = len(self.qpos)
        self.mocap = np.concatenate([_lasting(x, count) for x in (mocap, places)], axis=1)
        """(T, M, 3) positions of the fixtures, the props among them last."""
        self._targets = places.shape[1]
        self._rows = [self.model.body(o.name).mocapid[0] for o in scene.mocap_objects]
        own = [shape_colors(scene, agent) for agent in range(scene.num_agents)]
        colors = {
            self.model.geom(f"{body_name(agent, link)}:{k}").id: rgb(color)
            for agent, links in enumerate(own)
            for link, shapes in links.items()
            for k, color in enumerate(shapes)
        }
        nets = {self.model.body(o.name).id for o in scene.objects if is_net(o.name)}
        self._looks = [
            (
                colors.get(g, tuple(self.model.geom_rgba[g][:3])),
                float(self.model.geom_rgba[g][3]),
                MESH if int(self.model.geom_bodyid[g]) in nets else 0.0,
            )
            for g in range(self.model.ngeom)
        ]

    def __len__(self) -> int:
        return len(self.qpos)

    def show(self, frame: int) -> mujoco.MjData:
        """Kinematics of a frame; the same MjData every time."""
        self.data.qpos[:] = self.qpos[frame]
        for k, row in enumerate(self._rows):
            self.data.mocap_pos[row] = self.mocap[frame, k]
        mujoco.mj_kinematics(self.model, self.data)
        return self.data

    def solids(self, frame: int) -> list[Solid]:
        """Shapes of a frame for the software renderer."""
        data, model, kinds = self.show(frame), self.model, mujoco.mjtGeom
        names = {
            int(kinds.mjGEOM_BOX): ("box", 3),
            int(kinds.mjGEOM_SPHERE): ("sphere", 1),
            int(kinds.mjGEOM_CAPSULE): ("capsule", 2),
            int(kinds.mjGEOM_CYLINDER): ("cylinder", 2),
        }
        return [
            Solid(
                names[int(model.geom_type[g])][0],
                data.geom_xpos[g].copy(),
                data.geom_xmat[g].reshape(3, 3).copy(),
                model.geom_size[g][: names[int(model.geom_type[g])][1]],
                *self._looks[g],
            )
            for g in range(model.ngeom)
            if int(model.geom_type[g]) in names
        ]

    def roots(self) -> np.ndarray:
        """(T, A, 3) where the athletes are."""
        slices = [self.scene.agent_qpos(agent) for agent in range(self.scene.num_agents)]
        return np.stack([self.qpos[:, s][:, :3] for s in slices], axis=1)

    def targets(self, frame: int) -> np.ndarray:
        """(K, 3) where the props at targets stand."""
        return self.mocap[frame, self.mocap.shape[1] - self._targets :]

    def thing(self, name: str) -> np.ndarray:
        """(T, 3) where a moving object is."""
        return self.qpos[:, self.scene.object_qpos(name)][:, :3]

    def lowest(self, frame: int) -> float:
        """Height of the lowest point of the first athlete (m)."""
        data, model, low = self.show(frame), self.model, math.inf
        root = model.body(body_name(0, self.scene.body.links[0].name)).id
        for g in range(model.ngeom):
            if model.body_rootid[model.geom_bodyid[g]] != root:
                continue
            down = data.geom_xmat[g].reshape(3, 3)[2]
            size, kind = model.geom_size[g], model.geom_type[g]
            if kind == mujoco.mjtGeom.mjGEOM_BOX:
                reach = float(np.abs(down) @ size)
            else:  # a cylinder is taken for a capsule here
                reach = size[0] + (
                    0.0 if kind == mujoco.mjtGeom.mjGEOM_SPHERE else abs(down[2]) * size[1]
                )
            low = min(low, data.geom_xpos[g][2] - reach)
        return low


def _lasting(table: np.ndarray, count: int) -> np.ndarray:
    """(count, K, 3) of a table (T, K, 3) with as many rows, or with one that lasts."""
    return table if len(table) == count else np.broadcast_to(table[:1], (count, *table.shape[1:]))


def touching(episode: Episode, frame: int) -> list[str]:
    """Links of the first athlete that the ground pushed in a frame."""
    force = np.linalg.norm(np.asarray(episode.ground_force)[frame, 0], axis=-1)
    return [n for n, f in zip(episode.scene.body.link_names, force) if f > TOUCH]


def airborne(episode: Episode, player: Player) -> np.ndarray:
    """(T,) whether nothing of the first athlete touches the ground.

    From the recorded ground force; from the shapes' lowest point (more than 2 cm up) where an
    episode has no forces.
    """
    force = np.asarray(getattr(episode, "ground_force", np.zeros(0)))
    if force.size:
        return ~(np.linalg.norm(force[:, 0], axis=-1) > TOUCH).any(-1)
    return np.array([player.lowest(i) > 0.02 for i in range(len(player))])


def decisive_window(episode: Episode, player: Player) -> Window:
    """The jump of a jumping task: from 0.7 s before its take-off to 0.6 s after its landing.

    The jump is the flight that crosses x = 20 (the bar, the line); an episode that never gets
    there, and any other task, is shown whole, or for its last 3 s if it never jumped.
    """
    last = len(player) - 1
    if not episode.task.startswith(("long_jump", "high_jump")):
        return Window(0, None, None, last)
    x, air = player.qpos[:, 0], airborne(episode, player)
    before, after = round(BEFORE / episode.dt), round(AFTER / episode.dt)
    edges = np.flatnonzero(np.diff(np.r_[0, air.astype(int), 0]))
    flights = [(a, b) for a, b in zip(edges[::2], edges[1::2]) if x[min(b, last)] > 20.0]
    if not flights:
        return Window(max(0, last - round(3.0 / episode.dt)), None, None, last)
    # The first flight that ends beyond the mark and lasts: stumbling hops come after it.
    takeoff, landing = max(flights[:3], key=lambda f: f[1] - f[0])
    return Window(
        max(0, takeoff - before),
        int(takeoff),
        int(min(landing, last)),
        int(min(last, landing + after)),
    )


def heading(qpos: np.ndarray) -> float:
    """Direction of travel over some frames (rad); +x for somebody who stays in place."""
    way = qpos[-1, :2] - qpos[0, :2]
    return math.atan2(way[1], way[0]) if np.linalg.norm(way) > 1.0 else 0.0
