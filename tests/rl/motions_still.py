"""An athlete who stands, and what may be wrong with it; frames at 30 a second."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rl.likeness_motion import Motion
from sports.humanoid.body import load_body
from warmstart.library import FPS

BODY = load_body("smpl")


def standing(frames: int = 91) -> Motion:
    """A T-pose whose soles touch the ground, with its feet level."""
    qpos = np.zeros((frames, 7 + BODY.num_dofs))
    qpos[:, 2], qpos[:, 3] = BODY.standing_height(0.0), 1.0
    return Motion("standing", "made", "smpl", qpos)


def slid(motion: Motion, speed: float) -> Motion:
    """Carried along x at ``speed`` (m/s)."""
    qpos = motion.qpos.copy()
    qpos[:, 0] += speed * np.arange(len(qpos)) / FPS
    return replace(motion, qpos=qpos)


def lifted(motion: Motion, height: float) -> Motion:
    qpos = motion.qpos.copy()
    qpos[:, 2] += height
    return replace(motion, qpos=qpos)


def swinging(motion: Motion, amplitude: float, hertz: float, dofs: tuple[str, ...]) -> Motion:
    """With hinges that swing by ``amplitude`` (rad) on top of what they do."""
    qpos = motion.qpos.copy()
    wave = amplitude * np.sin(2 * np.pi * hertz * np.arange(len(qpos)) / FPS)
    for name in dofs:
        qpos[:, 7 + BODY.dof_index(name)] += wave
    return replace(motion, qpos=qpos)


def turned(motion: Motion, rate: float, point: np.ndarray) -> Motion:
    """Turned about the vertical through ``point`` (x, y) at ``rate`` (rad/s); from a standing one
    that faces x."""
    angle = rate * np.arange(len(motion.qpos)) / FPS
    qpos = motion.qpos.copy()
    arm = qpos[:, :2] - point
    c, s = np.cos(angle), np.sin(angle)
    qpos[:, 0] = point[0] + c * arm[:, 0] - s * arm[:, 1]
    qpos[:, 1] = point[1] + s * arm[:, 0] + c * arm[:, 1]
    qpos[:, 3], qpos[:, 6] = np.cos(angle / 2), np.sin(angle / 2)
    return replace(motion, qpos=qpos)
