"""What the ground gives a running athlete is the same in MuJoCo and in Drake.

On MuJoCo's default ground this fails: its contacts lift loaded feet (docs/physics.md).
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rl.policy import load_policy
from sports.env import make_env, make_scene
from sports.physics import PhysicsState, make_physics

WORLDS, STEPS, MOMENTS = 24, 4, (40, 55)


@pytest.fixture(scope="module")
def sprint() -> tuple[PhysicsState, Tensor]:
    """States of the shipped long jumper in its run-up and the targets (M, STEPS, nu) it chose."""
    policy = load_policy("pretrained:ppo-human", "long_jump")
    env = make_env("long_jump", num_worlds=WORLDS, strength="human", seed=5)
    obs, physics = env.reset(), env.physics
    env.age[:] = 0
    qpos, qvel, targets = [], [], []
    running = torch.ones(WORLDS, dtype=torch.bool)
    for _ in range(MOMENTS[-1] + STEPS):
        qpos.append(physics.qpos.clone())
        qvel.append(physics.qvel.clone())
        action = policy(obs).clamp(-1.0, 1.0)
        targets.append((action * env.action_scale).flatten(1))
        result = env.step(action)
        running &= ~result.ended
        obs = result.obs
    mocap = physics.mocap_pos[running].repeat(len(MOMENTS), 1, 1)
    env.close()
    assert int(running.sum()) > WORLDS // 2
    state = PhysicsState(
        torch.cat([qpos[t][running] for t in MOMENTS]),
        torch.cat([qvel[t][running] for t in MOMENTS]),
        mocap,
    )
    chosen = [torch.stack(targets[t : t + STEPS], 1)[running] for t in MOMENTS]
    return state, torch.cat(chosen)


def com_velocity(engine: str, state: PhysicsState, targets: Tensor) -> Tensor:
    """(M, 3) velocity of the centre of mass after the targets."""
    physics = make_physics(engine, make_scene("long_jump", strength="human"), len(targets))
    physics.reset(torch.ones(len(targets), dtype=torch.bool), state.clone())
    for k in range(STEPS):
        physics.step(targets[:, k])
    velocity = physics.geometry.center_of_mass(physics, 0)[1].clone()
    physics.close()
    return velocity


def test_a_sprint_takes_the_same_impulse_from_the_ground(sprint):
    state, targets = sprint
    assert float(state.qvel[:, 0].mean()) > 5.0, "these are states of a sprint"
    difference = com_velocity("mujoco", state, targets) - com_velocity("drake", state, targets)
    print("mean", difference.mean(0).tolist(), "rms", difference.square().mean(0).sqrt().tolist())
    assert float(difference.mean(0).abs().max()) < 0.12  # 0.27 forward, 0.30 up by default
    assert float(difference.norm(dim=-1).median()) < 0.25
