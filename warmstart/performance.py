"""A throw as its task plays it: targets in, and out comes a clip of states the engine reached."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from sports.env import Env, make_env
from sports.humanoid.body import Strength
from warmstart.bank import START
from warmstart.clip import Clip

RETURN = 0.7
"""Time in which the targets go back to those of the task's hold, after the throw (s)."""


@dataclass(frozen=True)
class Performance:
    """An episode from the task's own start until it ended."""

    clip: Clip
    """Of the athlete and the object, at the control rate, with the targets that were played. Its
    ``meta`` is empty."""
    metrics: dict[str, float]
    """Of the task at the end, where they are defined."""
    seen: list[bool]
    """What ``watch`` said after each step."""


def searched_clip(
    played: Performance, touched: Sequence[bool], task: str, strength: Strength, numbers: np.ndarray
) -> Clip:
    """The clip of a throw that was searched for, with what it achieved, the numbers (P,) it was
    made from, when it began and, where it was one, when it was released.

    ``touched`` says after which steps the athlete touched the object, ``played.seen`` after which
    the rules called it released.
    """
    events = {START: 0.0}
    if True in played.seen:
        # Frame k is before step k: the last frame after a step in which a hand touched it.
        first = played.seen.index(True)
        events["release"] = (max(k for k in range(first) if touched[k]) + 1) / played.clip.fps
    meta = {
        "problem": task,
        "achieved": {name: round(value, 6) for name, value in played.metrics.items()},
        "strength": strength,
        "source": "searched in MuJoCo, thrown by the task's own athlete",
        "licence": "Apache-2.0",
        "events": events,
        "numbers": [round(float(x), 6) for x in numbers],
    }
    return replace(played.clip, meta=meta)


def numbers_near(path: Path | None, size: int) -> np.ndarray | None:
    """The numbers (size,) of a searched clip, to search around; None without a file. Raises
    ValueError for a clip that this search did not make."""
    if path is None:
        return None
    near = np.array(Clip.load(path).meta.get("numbers", ()), dtype=float)
    if near.shape != (size,):
        raise ValueError(f"it is not a clip of this command ({size} numbers)")
    return near


def perform(
    task: str,
    strength: Strength,
    held: str,
    ctrl: np.ndarray,
    watch: Callable[[Env], bool],
    *,
    engine: str = "mujoco",
) -> Performance:
    """Plays targets ``ctrl`` (K, n) (rad), one row a control step, in a task in an engine; then
    the targets go back to those of action 0. ``held`` names the object of the clip.

    ``watch`` is asked after every step, and False is noted for the last one, when the world has
    begun anew. Raises RuntimeError when the simulation diverges.
    """
    env = make_env(task, engine=engine, num_worlds=1, strength=strength, training=False)
    try:
        env.keep_snapshot = True
        scene, body = env.physics.scene, env.physics.scene.body
        rate = 1.0 / scene.control_timestep
        offset, scale = scene.action_offset(), body.action_scale()
        first = env.snapshot()
        qpos, qvel = [first["qpos"][0]], [first["qvel"][0]]
        played, metrics, seen = [], {}, []
        for step in range(env.max_steps):
            back = min(max(step - len(ctrl) + 1, 0) / (RETURN * rate), 1.0)
            target = ctrl[min(step, len(ctrl) - 1)]
            target = target + back * (offset - target)
            action = torch.tensor((target - offset) / scale, dtype=torch.float32)
            result = env.step(action[None, None])
            if not bool(result.valid[0]):
                raise RuntimeError(f"the throw diverged at control step {step}")
            played.append(target)
            metrics = {name: float(value[0]) for name, value in result.metrics.items()}
            qpos.append(env.final_snapshot["qpos"][0].clone())
            qvel.append(env.final_snapshot["qvel"][0].clone())
            ended = bool(result.ended[0])
            seen.append(not ended and watch(env))
            if ended:
                break
    finally:
        env.close()
    played.append(played[-1])
    places, rates = torch.stack(qpos).double().numpy(), torch.stack(qvel).double().numpy()
    clip = Clip(
        fps=rate,
        body=body.name,
        qpos=places[:, scene.agent_qpos(0)],
        qvel=rates[:, scene.agent_qvel(0)],
        ctrl=np.array(played),
        object_qpos=places[:, scene.object_qpos(held)],
        object_qvel=rates[:, scene.object_qvel(held)],
    )
    return Performance(clip, {k: v for k, v in metrics.items() if math.isfinite(v)}, seen)
