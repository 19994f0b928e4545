"""Hand-made episodes: a ballistic jump over a bar or into a pit, for tests of pictures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sports.humanoid.body import Body, Shape, load_body
from sports.scene import Scene, SceneObject


@dataclass
class Episode:
    task: str
    scene: Scene
    qpos: np.ndarray
    mocap_pos: np.ndarray
    ground_force: np.ndarray
    metrics: dict[str, float] = field(default_factory=dict)
    seed: int = 7
    world: int = 3
    dt: float = 1 / 30
    shown: dict[str, np.ndarray] = field(default_factory=dict)


def bar_scene(body: Body | None = None, height: float = 1.5) -> Scene:
    bar = SceneObject(
        "bar",
        (Shape("cylinder", (0.0, -2.05, 0.0), (0.025,), 2.0, end=(0.0, 2.05, 0.0)),),
        "free",
        (20.0, 6.0, height - 0.025),
    )
    uprights = tuple(
        SceneObject(
            f"upright{i}",
            (Shape("box", (0.0, 0.0, -1.5), (0.03, 0.03, 1.5), 1.0),),
            "mocap",
            (20.0, y, height - 0.05),
        )
        for i, y in enumerate((4.0, 8.0))
    )
    return Scene("high_jump", body or load_body(), objects=(bar, *uprights))


def jump(scene: Scene, task: str, *, frames: int = 75, takeoff: int = 30, seed: int = 0) -> Episode:
    """Runs at 8 m/s towards x = 20, leaves the ground at frame ``takeoff``, lands at its end."""
    rng = np.random.default_rng(seed)
    body, dt = scene.body, 1 / 30
    qpos = np.tile(scene.default_qpos(), (frames, 1))
    flight = np.clip((np.arange(frames) - takeoff) * dt, 0, None)
    qpos[:, 0] = 19.8 + (np.arange(frames) - takeoff) * dt * 8.0
    height = body.standing_height()
    z = height + 4.0 * flight - 4.905 * flight**2
    air = (flight > 0) & (z > height)
    qpos[:, 2] = np.maximum(z, height)
    swing = np.sin(np.linspace(0, 9, frames))[:, None] * rng.uniform(-1.5, 1.5, body.num_dofs)
    qpos[:, 7 : 7 + body.num_dofs] = swing
    force = np.zeros((frames, scene.num_agents, body.num_links, 3))
    force[~air, 0, body.link_index("L_Toe"), 2] = 700.0
    mocap = np.tile(scene.default_mocap_pos(), (frames, 1, 1))
    return Episode(task, scene, qpos, mocap, force, {"success": 1.0})
