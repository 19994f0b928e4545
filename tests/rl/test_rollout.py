"""Advantages against a plain loop and against cases done by hand; normalisers against numpy."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rl.normalizer import Normalizer
from rl.rollout import Rollout, collect, generalized_advantages, pay_remaining
from sports.env import StepResult


def loop_advantages(reward, value, next_value, terminated, truncated, valid, gamma, lam):
    """The definition, world by world: sum of (gamma lam)^k delta_(t+k) until the episode ends."""
    steps, rows = reward.shape
    out = np.zeros((steps, rows))
    for i in range(rows):
        for t in range(steps):
            total, weight = 0.0, 1.0
            for k in range(t, steps):
                if not valid[k, i]:
                    break
                after = 0.0 if terminated[k, i] else next_value[k, i]
                total += weight * (reward[k, i] + gamma * after - value[k, i])
                if terminated[k, i] or truncated[k, i]:
                    break
                weight *= gamma * lam
            out[t, i] = total
    return out


@given(st.integers(0, 10_000))
def test_advantages_follow_their_definition(seed):
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(1, 12)), int(rng.integers(1, 6)))
    numbers = [rng.normal(size=shape) for _ in range(3)]
    kind = rng.random(shape)
    flags = [kind < 0.15, (kind > 0.15) & (kind < 0.3), rng.random(shape) > 0.1]
    tensors = [torch.tensor(x, dtype=torch.float32) for x in numbers]
    tensors += [torch.tensor(x) for x in flags]
    advantages, returns = generalized_advantages(*tensors, 0.97, 0.9)
    expected = loop_advantages(*numbers, *flags, 0.97, 0.9)
    np.testing.assert_allclose(advantages.numpy(), expected, atol=2e-5)
    np.testing.assert_allclose(returns.numpy(), expected + numbers[1], atol=2e-5)


def one_world(terminated=(), truncated=(), invalid=()):
    """Three steps of reward 1, V = 10 everywhere, gamma 0.5, lam 1: advantages."""

    def flags(at):
        return torch.tensor([[t in at] for t in range(3)])

    reward, value = torch.ones(3, 1), torch.full((3, 1), 10.0)
    result = generalized_advantages(
        reward, value, value, flags(terminated), flags(truncated), ~flags(invalid), 0.5, 1.0
    )
    return result[0].flatten().tolist()


def test_bootstrap_by_hand():
    # going on: 1 + 0.5 + 0.25 + 0.125 * 10 - 10; 1 + 0.5 + 0.25 * 10 - 10; 1 + 0.5 * 10 - 10
    assert one_world() == [-7.0, -6.0, -4.0]
    # a terminal step is worth its reward: nothing follows
    assert one_world(terminated=(1,)) == [1.0 + 0.5 - 10.0, 1.0 - 10.0, -4.0]
    # a time limit is no outcome: the value of where it ended stands in, and the chain is cut
    assert one_world(truncated=(1,)) == [1.0 + 0.5 + 0.25 * 10.0 - 10.0, -4.0, -4.0]
    # an invalid step teaches nothing, and the step before relies on its own bootstrap
    assert one_world(invalid=(1,)) == [-4.0, 0.0, -4.0]


@given(st.floats(-5, 5), st.integers(0, 300), st.sampled_from([0.9, 0.99, 1.0]))
def test_remaining_steps_are_the_sum_they_stand_for(reward, steps, gamma):
    r, n = torch.tensor([[reward], [float(steps)]], dtype=torch.float64)
    paid = float(pay_remaining(r, n, gamma))
    assert paid == pytest.approx(sum(reward * gamma**k for k in range(steps + 1)), abs=1e-9)


class Scripted:
    """Two worlds of two agents that report what a script says, to follow numbers through."""

    num_worlds, num_agents, reward_scale = 2, 2, 10.0
    device = torch.device("cpu")

    def step(self, action):
        self.action = action
        n = torch.arange(4.0).reshape(2, 2, 1)
        return StepResult(
            obs=n + 200.0,
            final_obs=n + 100.0,
            reward=torch.tensor([[1.0, 2.0], [3.0, float("nan")]]),
            terms={},
            terminated=torch.tensor([[True, False], [False, False]]),
            truncated=torch.tensor([[False, True], [False, False]]),
            valid=torch.tensor([True, False]),
            remaining_paid=torch.tensor([2.0, 5.0]),
            metrics={},
        )


def test_collect_keeps_agents_apart_and_divides_by_the_reward_scale():
    actor = SimpleNamespace(
        device=torch.device("cpu"),
        prepare=lambda x: x,
        act=lambda x: (x, x.repeat(1, 3), x.repeat(1, 3), x[:, 0]),
    )
    rollout = Rollout(1, 4, 1, 3, torch.device("cpu"), torch.float32)
    env = Scripted()
    obs = torch.arange(4.0).reshape(2, 2, 1)
    after = collect(env, actor, rollout, obs, gamma=0.5)
    assert env.action[1, 0].tolist() == [2.0, 2.0, 2.0]  # world 1, agent 0 is row 2
    assert rollout.obs[0, :, 0].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert rollout.final_obs[0, :, 0].tolist() == [100.0, 101.0, 102.0, 103.0]
    assert after[1, 1, 0] == 203.0
    # world 0: two more steps paid, 1 + 0.5 + 0.25, to the agent whose episode ended;
    # world 1 is invalid: no NaN gets in
    torch.testing.assert_close(rollout.reward[0], torch.tensor([0.175, 0.2, 0.0, 0.0]))
    assert rollout.terminated[0].tolist() == [True, False, False, False]
    assert rollout.truncated[0].tolist() == [False, True, False, False]
    assert rollout.valid[0].tolist() == [True, True, False, False]


@given(st.lists(st.integers(1, 40), min_size=1, max_size=6), st.integers(0, 1000))
def test_normaliser_is_numpy_on_the_concatenated_data(sizes, seed):
    rng = np.random.default_rng(seed)
    offset = rng.uniform(-1e3, 1e3, 3)  # large against the spread: a naive sum of squares fails
    batches = [offset + rng.normal(size=(n, 3)) * [0.01, 1.0, 100.0] for n in sizes]
    norm = Normalizer(3, epsilon=0.0)
    for i, batch in enumerate(batches):
        norm.collect(torch.tensor(batch))
        if i % 2:
            norm.commit()
    norm.commit()
    data = np.concatenate(batches)
    np.testing.assert_allclose(norm.mean, data.mean(0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(norm.std, data.std(0), rtol=1e-4, atol=1e-6)
    assert float(norm.count) == len(data)


def test_normaliser_weights_clips_and_round_trips():
    rng = np.random.default_rng(0)
    data, keep = rng.normal(3.0, 2.0, (100, 2)), rng.random(100) > 0.3
    norm = Normalizer(2, clip=2.0)
    norm.collect(torch.tensor(data), torch.tensor(keep))
    assert torch.equal(norm.normalize(torch.tensor([[1.5, -9.0]])), torch.tensor([[1.5, -2.0]]))
    norm.commit()  # not in use before
    np.testing.assert_allclose(norm.mean, data[keep].mean(0), rtol=1e-5)
    np.testing.assert_allclose(norm.std, np.sqrt(data[keep].var(0) + 1e-4), rtol=1e-5)
    x = torch.tensor([[2.0, 4.0]])
    torch.testing.assert_close(norm.denormalize(norm.normalize(x)), x)
    other = Normalizer(2, clip=2.0)
    other.load_state_dict(norm.state_dict())
    assert torch.equal(other.normalize(x), norm.normalize(x))
    third = Normalizer(2, clip=2.0)
    third.set_moments(float(norm.count), norm.mean, norm.std)
    torch.testing.assert_close(third.normalize(x), norm.normalize(x), rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="3 features"):
        Normalizer(3).load_state_dict(norm.state_dict())


def test_features_that_are_kept_stay_as_they_are_and_the_others_follow_the_data():
    rng = np.random.default_rng(1)
    first, later = rng.normal(3.0, 2.0, (50, 3)), rng.normal(-70.0, 9.0, (400, 3))
    norm = Normalizer(3)
    norm.set_moments(50, torch.tensor(first.mean(0)), torch.tensor(first.std(0)))
    before = norm.mean.clone(), norm.std.clone()
    norm.keep(torch.tensor([True, False, False]))
    norm.keep(torch.tensor([False, False, True]))  # beside those kept already
    resumed = Normalizer(3)
    resumed.load_state_dict(norm.state_dict())
    old = {n: x for n, x in norm.state_dict().items() if n != "kept"}  # a state of before
    for each in (norm, resumed):
        for batch in np.split(later, 4):
            each.collect(torch.tensor(batch))
            each.commit()
        both = np.concatenate((first, later))[:, 1]
        kept = [0, 2]
        torch.testing.assert_close(each.mean[kept], before[0][kept], rtol=1e-7, atol=0)
        torch.testing.assert_close(each.std[kept], before[1][kept], rtol=1e-6, atol=0)
        np.testing.assert_allclose(each.mean[1], both.mean(), rtol=1e-5)
        np.testing.assert_allclose(each.std[1], both.std(), rtol=1e-3)
        assert float(each.count) == 450.0
    plain = Normalizer(3)
    plain.load_state_dict(old)
    plain.collect(torch.tensor(later))
    plain.commit()
    assert (plain.mean < -50.0).all()
