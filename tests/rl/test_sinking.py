"""The cost of sinking against the panel's depth, by hand, and where there is no flat ground."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rl.charges import charges
from rl.likeness_motion import Motion
from rl.likeness_terms import figures
from rl.sinking import SinkingCost
from rl.train import TrainConfig
from sports.env import make_env
from tests.rl.steps_made import ended


def placed(env, depths: list[float]) -> None:
    """Athletes in the task's default pose, whose lowest points are so deep (m)."""
    state = env._default.clone()
    height = figures(still(state.qpos[0, :76]))["penetration"]
    assert height < 1e-3
    state.qpos[:, 2] -= torch.tensor(depths)
    env.physics.reset(torch.ones(len(depths), dtype=torch.bool), state)


def still(qpos: torch.Tensor) -> Motion:
    return Motion("still", "", "smpl", np.tile(qpos.double().numpy(), (20, 1)))


def test_it_is_the_depth_of_the_panel_beyond_what_is_free():
    env = make_env("long_jump", num_worlds=4, training=False)
    placed(env, [0.0, 0.015, 0.034, 0.05])
    cost = SinkingCost(env, weight=0.5, limit=0.02, most=0.1)(ended(4))
    depth = [figures(still(q[:76]))["penetration"] for q in env.physics.qpos]
    expected = [-0.5 * max(0.0, 100.0 * d - 2.0) for d in depth]
    assert cost[:, 0].tolist() == pytest.approx(expected, abs=2e-3)
    assert cost[:2].abs().max() == 0.0 and float(cost[3]) < float(cost[2]) < -0.3
    env.close()


def test_a_world_that_was_reset_or_diverged_costs_nothing_and_no_depth_more_than_ten_centimetres():
    env = make_env("long_jump", num_worlds=4, training=False)
    placed(env, [0.05, 0.05, 0.05, 0.5])
    result = ended(4)
    result.ended[0], result.valid[1] = True, False
    env.physics.body_pos[1] = torch.nan
    cost = SinkingCost(env, weight=2.0, limit=0.0, most=0.1)(result)[:, 0]
    assert cost[:2].tolist() == [0.0, 0.0] and -12.0 < float(cost[2]) < -8.0
    assert float(cost[3]) == -20.0
    env.close()


def test_beyond_the_most_no_depth_costs_more():
    env = make_env("long_jump", num_worlds=4, training=False)
    placed(env, [0.015, 0.03, 0.05, 0.08])
    config = TrainConfig(task="long_jump", sinking=2.0, sinking_most=0.01)
    sinking = charges(config, env)[-1].bonus(ended(4))[:, 0].tolist()
    depth = figures(still(env.physics.qpos[1, :76]))["penetration"]
    assert 0.02 < depth < 0.03 and sinking[0] == 0.0
    assert sinking[1] == pytest.approx(-2.0 * (100.0 * depth - 2.0), abs=4e-3)
    assert sinking[2:] == [pytest.approx(-2.0)] * 2
    env.close()


def test_both_athletes_of_a_bout_are_watched():
    env = make_env("boxing", num_worlds=3, training=False)
    env.reset()
    env.physics.body_pos[1, 1, :, 2] -= 0.1
    cost = SinkingCost(env, weight=1.0, limit=0.02, most=0.1)(ended(3))
    assert cost.shape == (3, 2) and int((cost < -5.0).sum()) == 1 and float(cost[1, 1]) < -5.0
    env.close()


def test_it_is_charged_within_the_limit_and_not_on_waves():
    config = TrainConfig(task="long_jump", sinking=0.3, charge_limit=0.5)
    env = make_env("long_jump", num_worlds=2, training=False)
    names = [part.name for part in charges(config, env)]
    assert names == ["charge_limit", "sinking"]
    env.close()
    env = make_env("golf", num_worlds=2, training=False)
    with pytest.raises(ValueError, match="flat ground"):
        charges(TrainConfig(task="golf", sinking=0.3), env)
    env.close()


def test_mistakes_are_refused():
    with pytest.raises(ValueError, match="sinking_limit must not be negative"):
        TrainConfig(task="long_jump", sinking=0.1, sinking_limit=-0.01)
    with pytest.raises(ValueError, match="sinking_most must be positive"):
        TrainConfig(task="long_jump", sinking=0.1, sinking_most=0.0)
