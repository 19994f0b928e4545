"""Plain scenes of every sport, for tests of pictures: the athletes, the ball, what stands there."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from sports.humanoid.body import Body, Shape, load_body
from sports.scene import Scene, SceneObject, Start
from tests.olympics_opt.episodes import Episode

FACING = math.pi
PLAIN: dict[str, tuple[tuple[Start, ...], tuple[float, float, float] | None, float, str]] = {
    "hurdling": ((Start(),), None, 0.0, ""),
    "golf": ((Start(y=1.0, yaw=-math.pi / 2),), (0.0, 0.0, 0.07), 0.0213, "club"),
    "javelin": ((Start(),), None, 0.0, ""),
    "tennis": ((Start(13.0, yaw=FACING),), (-12.5, 0.0, 1.2), 0.032, "racket"),
    "tennis_1v1": ((Start(13.0, yaw=FACING), Start(-13.0)), (0.0, 0.0, 2.5), 0.032, "racket"),
    "table_tennis": ((Start(2.0, yaw=FACING),), (0.0, 0.0, 1.4), 0.02, "paddle"),
    "table_tennis_1v1": ((Start(2.0, yaw=FACING), Start(-2.0)), (0.0, 0.0, 1.4), 0.02, "paddle"),
    "fencing": ((Start(-1.5), Start(1.5, yaw=FACING)), None, 0.0, "sword"),
    "boxing": ((Start(-1.5), Start(1.5, yaw=FACING)), None, 0.0, "gloves"),
    "penalty_kick": ((Start(3.0, 0.14),), (4.0, 0.0, 0.11), 0.11, ""),
    "soccer_1v1": ((Start(-3.0), Start(3.0, yaw=FACING)), (0.0, 0.0, 0.11), 0.11, ""),
    "soccer_2v2": (
        (Start(-3.0), Start(-8.0, 3.0), Start(3.0, yaw=FACING), Start(8.0, -3.0, FACING)),
        (0.0, 0.0, 0.11),
        0.11,
        "",
    ),
    "free_throw": ((Start(),), (0.35, 0.0, 1.5), 0.12, ""),
    "basketball_1v1": ((Start(-3.0), Start(3.0, yaw=FACING)), (-2.5, 0.0, 0.12), 0.12, ""),
    "basketball_2v2": (
        (Start(-3.0), Start(-6.0, 3.0), Start(3.0, yaw=FACING), Start(6.0, -3.0, FACING)),
        (-2.5, 0.0, 0.12),
        0.12,
        "",
    ),
}
"""Starts, where the ball is and its radius, equipment."""


def _box(name: str, center: tuple, half: tuple, motion: str = "fixed") -> SceneObject:
    shape = Shape("box", (0.0, 0.0, 0.0), half, 1.0)
    return SceneObject(name, (shape,), motion, center)  # type: ignore[arg-type]


def plain_scene(name: str, body: Body | None = None) -> Scene:
    """The scene of a task as far as pictures are concerned."""
    starts, ball, radius, tool = PLAIN[name]
    objects: list[SceneObject] = []
    if name.startswith("tennis"):
        objects.append(_box("net", (0.0, 0.0, 0.5), (0.01, 5.029, 0.5)))
    if name.startswith("table"):
        objects.append(_box("table", (0.0, 0.0, 0.745), (1.37, 0.7625, 0.015)))
        objects.append(_box("net", (0.0, 0.0, 0.836), (0.005, 0.915, 0.076)))
    if name == "hurdling":
        objects += [
            _box(f"hurdle{k}", (13.72 + 9.14 * k, 0.0, 0.5), (0.025, 1.0, 0.53), "mocap")
            for k in range(10)
        ]
    if name == "javelin":
        shaft = Shape("capsule", (-1.35, 0.0, 0.0), (0.0125,), 0.8, end=(1.35, 0.0, 0.0))
        objects.append(SceneObject("javelin", (shaft,), "free", (0.24, -0.59, 1.61)))
    if ball is not None:
        shape = Shape("sphere", (0.0, 0.0, 0.0), (radius,), 0.4)
        objects.append(SceneObject("ball", (shape,), "free", ball))
    body = body or load_body(equipment=(tool,) if tool else ())
    return Scene(name, body, agents=starts, objects=tuple(objects))


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


def with_waves(scene: Scene) -> Scene:
    """A golf scene whose turf is in waves."""
    from sports.scene import Surface

    size = (0.25, 2 * math.pi / 10.0, 2.0, 6.0)
    return dataclasses.replace(scene, surfaces=(Surface("turf", "waves", size=size),))
