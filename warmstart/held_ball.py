"""A planned free throw with the real ball: held by friction between the hands of the task's scene.

The plan has the ball rigid on a hand. Here an engine's own ball lies in the hold in which the task
begins, the servos play the plan's torques open loop, the fingers press as the hold has them until
the release and open then. What the ball does is measured, whatever it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from sports.env import make_scene
from sports.free_throw import RIM
from sports.humanoid.body import FINGERS, Body
from sports.physics import default_state, make_physics
from sports.scene import Scene
from warmstart import thrown
from warmstart.replay import REPLAY_RATE
from warmstart.solution import Solution

FLIGHT = 1.5
"""How long the ball is watched after the planned release (s)."""
APART = 0.05
"""A ball that nothing touches for so long (s) has left the hands."""


@dataclass(frozen=True)
class Release:
    """How a ball left the hands."""

    time: float
    """Of the first frame in which nothing touches it (s)."""
    place: np.ndarray
    velocity: np.ndarray
    """(3,) of its centre there, world (m, m/s)."""
    basket: bool
    """Whether it then came down through the ring in the engine."""


def fingers(body: Body) -> np.ndarray:
    """(F,) indices of the dofs of all fingers."""
    names = tuple(f"{side}_{finger}" for side in "LR" for finger in FINGERS)
    return np.array([i for i, dof in enumerate(body.dofs) if dof.link.startswith(names)])


def targets(solution: Solution, scene: Scene, times: np.ndarray) -> np.ndarray:
    """(T, n) PD targets (rad) at times (T,) s: the plan's, fingers pressing until the release and
    straight from then on."""
    body = scene.body
    at = np.minimum(times, solution.duration)
    motion = solution.sample(solution.times[0] + at)
    out = motion["qpos"][:, 7:] + motion["torque"] / body.array("kp")
    bent, held = fingers(body), times < solution.stats["event"]["time"]
    out[:, bent] = np.where(held[:, None], scene.action_offset()[bent], 0.0)
    return out


def released(
    times: np.ndarray, touched: np.ndarray, pos: np.ndarray, vel: np.ndarray, earliest: float = 0.0
) -> Release:
    """When and how a ball left the hands: ``touched`` (T,) bool, ``pos`` and ``vel`` (T, 3).

    Raises ValueError where it never leaves them for ``APART``, or not after ``earliest`` (s).
    """
    step = float(times[1] - times[0])
    last = len(times) - round(APART / step)
    free = [
        k
        for k in range(last)
        if times[k] >= earliest and not touched[k : k + round(APART / step)].any()
    ]
    if not free:
        raise ValueError("the ball does not leave the hands")
    k = free[0]
    rim = np.array(RIM)
    down = (pos[k:-1, 2] > rim[2]) & (pos[k + 1 :, 2] <= rim[2])
    basket = False
    for i in np.flatnonzero(down) + k:
        share = (pos[i, 2] - rim[2]) / (pos[i, 2] - pos[i + 1, 2])
        there = pos[i] + share * (pos[i + 1] - pos[i])
        basket |= thrown.inside(there, rim)
    return Release(float(times[k]), pos[k], vel[k], basket)


def play(solution: Solution, engine: str) -> Release:
    """The throw in an engine with the real ball, from the task's own start.

    Raises ValueError where the ball does not leave the hands, RuntimeError when it diverges.
    """
    scene = make_scene("free_throw", strength=solution.body.strength)
    scene = replace(scene, timestep=1.0 / REPLAY_RATE, substeps=1)
    steps = round((solution.stats["event"]["time"] + FLIGHT) * REPLAY_RATE)
    ctrl = targets(solution, scene, (np.arange(steps) + 0.5) / REPLAY_RATE)
    physics = make_physics(engine, scene, 1)
    physics.reset(torch.ones(1, dtype=torch.bool), default_state(scene, 1, physics.device))
    touched, pos, vel = [], [], []
    for row in ctrl:
        physics.step(torch.tensor(row[None], dtype=torch.float32))
        if bool(physics.bad.any()):
            raise RuntimeError(f"the throw diverged in {engine} after {len(pos)} steps")
        touched.append(bool(physics.pair_force[0, 0] > 0))
        pos.append(physics.object_pos[0, 0].double().numpy().copy())
        vel.append(physics.object_linvel[0, 0].double().numpy().copy())
    physics.close()
    times = (np.arange(steps) + 1) / REPLAY_RATE
    return released(times, np.array(touched), np.array(pos), np.array(vel))


def figures(solution: Solution, engine: str) -> dict[str, float]:
    """What the real ball does in an engine, for a certificate."""
    found, event = play(solution, engine), solution.stats["event"]
    asked, speed = np.array(event["velocity"]), float(np.linalg.norm(found.velocity))
    cosine = found.velocity @ asked / (speed * np.linalg.norm(asked))
    flight = thrown.fall(found.place, found.velocity, np.array(RIM))
    return {
        "ball: late": found.time - event["time"],
        "ball: release speed": speed,
        "ball: speed off": abs(speed / float(np.linalg.norm(asked)) - 1.0),
        "ball: direction off": float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
        "ball: apex": flight["apex"],
        "ball: miss of the ring's middle": flight["miss"],
        "ball: basket": float(found.basket),
    }
