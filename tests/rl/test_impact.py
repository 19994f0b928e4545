"""The cost of impacts against forces made by hand, and against a fall that it must notice."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from rl.impact import ImpactCost
from rl.train import TrainConfig
from sports.env import make_env
from tests.rl.steps_made import ended


def test_only_the_excess_of_each_link_is_paid_for_and_never_a_reset_world():
    force = torch.zeros(4, 1, 3, 3)
    force[0, 0, 1] = torch.tensor([3.0, 0.0, 4.0])  # 5 body weights: 2 too many
    force[0, 0, 2] = torch.tensor([0.0, 0.0, 100.0])  # counted as 30 above the limit
    force[1, 0, 0] = torch.tensor([0.0, 0.0, 2.9])
    force[2], force[3] = 50.0, float("nan")  # of the last world the engine diverged
    scene = SimpleNamespace(body=SimpleNamespace(mass=1.0 / 9.81))
    physics = SimpleNamespace(ground_force=force, scene=scene)
    result = ended(4)
    result.ended[2] = True
    result.valid[3] = False
    cost = ImpactCost(SimpleNamespace(physics=physics), weight=0.5, limit=3.0)(result)
    assert cost[:, 0].tolist() == pytest.approx([-0.5 * (2.0 + 30.0), 0.0, 0.0, 0.0])


def test_standing_is_free_and_a_drop_is_not():
    env = make_env("long_jump", num_worlds=2, training=False)
    env.physics.step(torch.zeros(2, 69))
    cost = ImpactCost(env, weight=1.0, limit=2.5)
    assert cost(ended(2)).abs().max() == 0.0
    state = env._default.clone()
    state.qpos[:, 2] += torch.tensor([0.0, 1.0])
    env.physics.reset(torch.ones(2, dtype=torch.bool), state)
    paid = torch.zeros(2)
    for _ in range(20):  # 1 m takes 0.45 s, 14 steps
        env.physics.step(torch.zeros(2, 69))
        paid += cost(ended(2))[:, 0]
    assert paid[0] == 0.0 and paid[1] < -1.0
    env.close()


def test_a_negative_cost_is_refused():
    with pytest.raises(ValueError, match="negative"):
        TrainConfig(task="long_jump", impact=-0.1)
