"""Does the opponent feel it? A planned punch or lunge played against the opponent of its task.

The opponent stands on guard where the task has it, held by its own servos, and the engine makes
the contact. What counts as a touch is the task's rule (``sports/combat.py``): so much force between
the weapon and trunk or head, with the weapon's point near enough.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from sports import combat
from sports.env import make_scene
from sports.physics import PhysicsState, make_physics
from warmstart import rotation
from warmstart.replay import REPLAY_RATE
from warmstart.solution import Solution

AFTER = 0.1
"""How long (s) after the planned touch is looked."""


def met(solution: Solution, engine: str, weapons: tuple[combat.Weapon, ...]) -> dict[str, float]:
    """Open loop at ``REPLAY_RATE`` until ``AFTER`` the planned touch, against the opponent.

    Returns ``opponent: force`` (N), the largest between a weapon and a target from which the
    weapon's point is no further than the task allows, 0 without one, and ``opponent: late`` (s),
    when that was after the planned touch (the end of what was looked at without one). Raises
    RuntimeError when the simulation diverges.
    """
    scene = make_scene(solution.problem, strength=solution.body.strength)
    scene = replace(scene, timestep=1.0 / REPLAY_RATE, substeps=1)
    event = solution.stats["event"]
    end = min(event["time"] + AFTER, solution.duration)
    middle = (np.arange(math.floor(end * REPLAY_RATE)) + 0.5) / REPLAY_RATE
    motion = solution.sample(solution.times[0] + middle)
    targets = motion["qpos"][:, 7:] + motion["torque"] / solution.body.array("kp")
    other = np.tile(scene.action_offset(), (len(targets), 1))
    ctrl = torch.tensor(np.hstack([targets, other]), dtype=torch.float32)
    qpos = torch.tensor(scene.default_qpos()[None], dtype=torch.float32)
    qpos[0, scene.agent_qpos(0)] = torch.tensor(solution.qpos[0], dtype=torch.float32)
    physics = make_physics(engine, scene, 1)
    state = PhysicsState(qpos, torch.zeros(1, scene.nv), torch.zeros(1, 0, 3))
    physics.reset(torch.ones(1, dtype=torch.bool), state)
    hands = [scene.body.link_index(weapon.link) for weapon in weapons]
    points = np.array([[0.0, -weapon.length, 0.0] for weapon in weapons])
    marks = [scene.body.link_index(name) for name in combat.TARGETS]
    most, when = 0.0, end
    for step, row in enumerate(ctrl):
        physics.step(row[None])
        if bool(physics.bad.any()):
            raise RuntimeError(f"the duel diverged in {engine} after {step} steps")
        pos, quat = physics.body_pos[0].double().numpy(), physics.body_quat[0].double().numpy()
        tips = pos[0, hands] + rotation.rotate(quat[0, hands], points)
        far = np.square(tips[:, None] - pos[1, marks]).sum(-1)
        force = physics.pair_force[0].double().numpy().reshape(2, len(hands), len(marks))[0]
        here = float(np.where(far <= combat.TOUCH_DISTANCE_SQUARED, force, 0.0).max())
        if here > most:
            most, when = here, (step + 1) / REPLAY_RATE
    physics.close()
    return {"opponent: force": most, "opponent: late": when - event["time"]}
