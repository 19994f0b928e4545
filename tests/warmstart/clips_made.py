"""Clips made up for tests."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sports.humanoid.body import load_body
from warmstart.clip import Clip, finite_difference_qvel


def random_clip(seed: int, frames: int = 40, fps: float = 30.0, body: str = "smpl", **meta) -> Clip:
    """Smooth noise: every hinge and the root wander."""
    table = load_body(body)
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None] / fps
    waves = rng.uniform(0.3, 1.5, table.num_dofs), rng.uniform(0, 6, table.num_dofs)
    qpos = np.zeros((frames, 7 + table.num_dofs))
    qpos[:, :3] = [3.0, -2.0, 1.5] + np.sin(t * [1.0, 0.7, 1.3])
    turns = np.concatenate([0.4 * np.sin(t * 2), 0.3 * np.cos(t), t + seed], axis=1)
    qpos[:, 3:7] = Rotation.from_euler("XYZ", turns).as_quat()[:, [3, 0, 1, 2]]
    qpos[:, 7:] = 0.5 * np.sin(2 * np.pi * waves[0] * t + waves[1])
    return Clip(fps, body, qpos, finite_difference_qvel(table, qpos, fps), meta=meta)
