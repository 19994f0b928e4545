"""Episodes of every sport's scene made by hand, for tests of pictures."""

from __future__ import annotations

from functools import cache

import numpy as np

from sports.env import make_scene
from sports.registry import task_names
from sports.scene import Scene
from tests.olympics_opt.episodes import Episode

TASKS = tuple(name for name in task_names() if name not in ("high_jump", "long_jump"))
"""All but the jumps, which have episodes of their own."""


@cache
def scene_of(name: str) -> Scene:
    """The scene of a task."""
    return make_scene(name)


def still(scene: Scene, frames: int = 30) -> Episode:
    """An episode in which nothing moves."""
    qpos = np.tile(scene.default_qpos(), (frames, 1))
    mocap = np.tile(scene.default_mocap_pos(), (frames, 1, 1))
    force = np.zeros((frames, scene.num_agents, scene.body.num_links, 3))
    return Episode(scene.name, scene, qpos, mocap, force, {"success": 0.0})


def thrown(
    scene: Scene, velocity: tuple[float, float, float], start: int = 8, frames: int = 45
) -> Episode:
    """The ball lies still, then flies freely and bounces off the ground with half its speed."""
    episode = still(scene, frames)
    ball = scene.object_qpos("ball")
    radius = next(o for o in scene.objects if o.name == "ball").shapes[0].size[0]
    dt, p, v = episode.dt, episode.qpos[0, ball][:3].copy(), np.array(velocity)
    for i in range(start, frames):
        p, v = p + v * dt - np.array([0.0, 0.0, 4.905 * dt**2]), v - np.array([0, 0, 9.81 * dt])
        if p[2] < radius and v[2] < 0:
            p[2], v = radius, v * (0.8, 0.8, -0.5)
        episode.qpos[i, ball.start : ball.start + 3] = p
    return episode
