"""The cost of torques that jump: by hand, against the panel's torques, and over a resume."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rl.config import PPOConfig
from rl.likeness_motion import from_recording
from rl.likeness_terms import measured
from rl.recording import Tape
from rl.runlog import read_progress
from rl.torque_change import TorqueChangeCost
from rl.train import TrainConfig, train
from sports.env import make_env


def step(ended: bool = False, valid: bool = True) -> SimpleNamespace:
    return SimpleNamespace(ended=torch.tensor([ended]), valid=torch.tensor([valid]))


def hand_made(free: float = 0.0) -> tuple[SimpleNamespace, TorqueChangeCost]:
    """One athlete with a hip, whose limit is known, and a toe, whose limit is not."""
    dofs = [SimpleNamespace(name=n) for n in ("L_Hip_x", "L_Toe_x")]
    values = {"kp": [100.0, 100.0], "kd": [2.0, 2.0], "effort": [50.0, 50.0]}
    body = SimpleNamespace(dofs=dofs, num_dofs=2, array=lambda name: np.array(values[name]))
    physics = SimpleNamespace(
        scene=SimpleNamespace(body=body), qpos=torch.zeros(1, 9), qvel=torch.zeros(1, 8)
    )
    view = SimpleNamespace(ctrl=torch.zeros(1, 1, 2))
    env = SimpleNamespace(
        physics=physics, view=view, num_agents=1, num_worlds=1, device=torch.device("cpu")
    )
    return env, TorqueChangeCost(env, weight=0.5, free=free)


def test_the_change_is_squared_in_limits_and_guessed_limits_do_not_count():
    env, cost = hand_made()
    assert cost(step()).item() == 0.0, "the first step has none before it"
    env.view.ctrl = torch.full((1, 1, 2), 0.1)
    assert cost(step()).item() == pytest.approx(-0.5 * (10 / 50) ** 2)
    assert cost(step()).item() == 0.0, "a torque that stays costs nothing"
    env.physics.qvel = torch.full((1, 8), 5.0)  # at the end of this step: half of -2 x 5
    assert cost(step()).item() == pytest.approx(-0.5 * (5 / 50) ** 2)
    env.view.ctrl = torch.full((1, 1, 2), -9.0)  # within the limit: -50 - 10
    assert cost(step()).item() == pytest.approx(-0.5 * ((5 + 60) / 50) ** 2)
    env.view.ctrl = torch.full((1, 1, 2), 9.0)
    assert cost(step()).item() == pytest.approx(-0.5 * 2.0**2), "from one end to the other"


def test_what_a_person_does_may_be_free():
    """Of each dof by itself: two changes of half of what is free are not one."""
    env, cost = hand_made(free=0.4)
    cost(step())
    env.view.ctrl = torch.full((1, 1, 2), 0.2)  # to 20 N m of 50
    assert cost(step()).item() == pytest.approx(0.0, abs=1e-12)
    env.view.ctrl = torch.full((1, 1, 2), -0.3)
    assert cost(step()).item() == pytest.approx(-0.5 * (50 / 50 - 0.4) ** 2)
    env.view.ctrl = torch.full((1, 1, 2), -9.0)
    assert cost(step()).item() == pytest.approx(-0.5 * (20 / 50 - 0.4) ** 2, abs=1e-7)
    env.view.ctrl = torch.full((1, 1, 2), 9.0)
    assert cost(step()).item() == pytest.approx(-0.5 * (2.0 - 0.4) ** 2)


def test_nothing_is_paid_across_a_reset_nor_where_the_engine_diverged():
    env, cost = hand_made()
    cost(step())
    for last in (step(ended=True), step(valid=False)):
        env.view.ctrl = env.view.ctrl + 0.05
        assert cost(last).item() == 0.0
        env.view.ctrl = env.view.ctrl + 0.05
        assert cost(step()).item() == 0.0, "a new episode's first step"
        env.view.ctrl = env.view.ctrl + 0.05
        assert cost(step()).item() < 0.0


def test_it_is_the_change_of_the_panels_torques():
    """Against the torques that the panel of human-likeness works out from a recording."""
    env = make_env("long_jump", num_worlds=2, training=False, strength="human", seed=3)
    tape = Tape(env, on=True)
    generator = torch.Generator().manual_seed(0)
    env.reset()
    cost = TorqueChangeCost(env, 1.0)
    paid = []
    for _ in range(12):
        action = 0.3 * torch.randn(2, 1, env.action_size, generator=generator)
        result = env.step(action)
        assert not result.ended.any()
        tape.add(action, result)
        paid.append(cost(result)[1, 0].item())
    facts = {"task": "long_jump", "options": {}, "seed": 3, "strength": "human"}
    (motion,) = from_recording(tape.cut(1, 0, 12, {}, facts))
    drive, body = motion.drive, env.physics.scene.body
    assert drive is not None
    share = np.diff(drive.torque.mean(1), axis=0) / body.array("effort")
    counted = np.array([measured(dof.name) for dof in body.dofs])
    expected = -(np.minimum(np.abs(share), 2.0) ** 2)[:, counted].sum(1)
    # The recording's first row is what the first action led to: its first torque is the second's.
    assert paid[2:] == pytest.approx(expected.tolist(), rel=1e-3)
    assert min(paid) < -0.5
    env.close()


def test_the_log_tells_what_it_came_to(tmp_path):
    """The mean over steps and athletes, of each cost; one that is off has no column."""
    small = PPOConfig(hidden=(8,), steps=6, minibatches=1, epochs=1)
    config = TrainConfig(
        task="long_jump", out=tmp_path, worlds=2, samples=36, quiet=True, ppo=small
    )
    train(replace(config, torque_change=0.5, impact=0.1, impact_limit=0.0))
    rows = read_progress(tmp_path)
    assert {"cost/torque_change", "cost/impact"} <= set(rows[0])
    told = [row["cost/torque_change"] for row in rows[1:]]
    assert all(x is not None and x > 0.0 for x in told) and rows[0]["cost/torque_change"] is None
    train(replace(config, out=tmp_path / "plain"))
    assert not any(name.startswith("cost/") for name in read_progress(tmp_path / "plain")[0])


def test_a_negative_cost_is_refused():
    for wrong in ({"torque_change": -0.1}, {"torque_change": 0.1, "torque_change_limit": -0.1}):
        with pytest.raises(ValueError, match="torque_change_limit must not be negative"):
            TrainConfig(task="long_jump", **wrong)
    with pytest.raises(ValueError, match="give --torque-change"):
        TrainConfig(task="long_jump", torque_change_limit=0.4)
