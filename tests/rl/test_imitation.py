"""The imitation reward against plain numbers, and demonstration starts in a run."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rl.imitation import Imitation, posture
from rl.ppo import PPOConfig
from rl.runlog import read_progress
from rl.train import TrainConfig, train
from sports.env import Starts, make_env


def frames(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    qpos = np.zeros((count, 76))
    qpos[:, :3] = [3.0, 0.0, 0.95]
    qpos[:, 3:7] = Rotation.random(count, random_state=seed).as_quat()[:, [3, 0, 1, 2]]
    qpos[:, 7:] = rng.normal(0, 0.5, (count, 69))
    return torch.tensor(qpos).float(), torch.tensor(rng.normal(size=(count, 75))).float()


def test_distance_is_the_mean_squared_joint_difference_at_any_wrap():
    qpos, qvel = frames(6, 0)
    near = qpos.clone()
    delta = 0.02 * torch.randn(6, 69, generator=torch.Generator().manual_seed(0))
    near[:, 7:] += delta + 2 * math.pi * torch.tensor([0, 1, -1, 2, 0, 1])[:, None]
    d = (posture(qpos, qvel) - posture(near, qvel)).square().sum(-1)
    torch.testing.assert_close(d, delta.square().mean(-1), rtol=1e-2, atol=1e-6)


def test_attitude_counts_by_the_angle_and_not_by_the_quaternions_sign():
    qpos, qvel = frames(5, 1)
    flipped = qpos.clone()
    flipped[:, 3:7] *= -1
    torch.testing.assert_close(posture(qpos, qvel), posture(flipped, qvel))
    turned = qpos.clone()
    angle = 0.7
    turn = Rotation.from_euler("z", angle)
    old = Rotation.from_quat(qpos[:, [4, 5, 6, 3]].numpy())
    turned[:, 3:7] = torch.tensor((old * turn).as_quat()[:, [3, 0, 1, 2]]).float()
    d = (posture(qpos, qvel) - posture(turned, qvel)).square().sum(-1)
    # both columns turn by the angle: 2 (2 - 2 cos), times 0.3^2
    np.testing.assert_allclose(d, 0.09 * 4 * (1 - math.cos(angle)), rtol=1e-3)


def test_bonus_is_full_on_a_frame_and_falls_with_the_distance():
    env = make_env("long_jump", num_worlds=4)
    qpos, qvel = frames(9, 2)
    env.starts = Starts(qpos, qvel, {}, probability=1.0)
    bonus = Imitation(env, weight=0.7, sharpness=5.0)
    env.reset()
    result = env.step(torch.zeros(4, 1, 69))
    last = env.final_snapshot
    last["qpos"][0], last["qvel"][0] = qpos[3], qvel[3]
    last["qpos"][1], last["qvel"][1] = qpos[4], qvel[4]
    last["qpos"][1, 7:] += 0.2
    result.valid = torch.tensor([True, True, True, False])
    r = bonus(result)[:, 0]
    assert float(r[0]) == pytest.approx(0.7, rel=1e-4)
    assert float(r[1]) == pytest.approx(0.7 * math.exp(-5.0 * 2 * (1 - math.cos(0.2))), rel=1e-3)
    assert r[3] == 0.0
    env.close()


def test_a_run_starts_from_demonstrations_and_lets_go_of_them(tmp_path):
    env = make_env("long_jump", num_worlds=2)
    qpos = torch.tensor(env.physics.scene.default_qpos()).float().repeat(5, 1)
    qpos[:, 0] = torch.arange(5.0) + 10.0
    starts = Starts(qpos, torch.zeros(5, 75), {}, probability=0.5)
    seen = []

    def environment(config, seed):
        made = make_env("long_jump", num_worlds=config.num_worlds, seed=seed)
        seen.append(made)
        return made

    small = PPOConfig(hidden=(8,), steps=4, minibatches=1, epochs=1)
    config = TrainConfig(
        task="long_jump",
        out=tmp_path,
        worlds=20,
        samples=5 * 80,
        quiet=True,
        ppo=small,
        imitation=0.1,
        start_probability=(1.0, 0.0),
    )
    weights = []
    train(
        config,
        starts=starts,
        environment=environment,
        on_iteration=lambda row: weights.append(seen[0].starts.probability),
    )
    np.testing.assert_allclose(weights, [1.0, 0.8, 0.6, 0.4, 0.2], atol=1e-6)
    assert len(read_progress(tmp_path)) == 5
    with pytest.raises(ValueError, match="--clips"):
        train(dataclasses.replace(config, out=tmp_path / "b"))
