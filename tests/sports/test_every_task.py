"""What every task of the registry must keep, whatever its sport."""

from __future__ import annotations

import pytest
import torch

from sports.env import Env, make_env
from sports.frames import proprioception_slices
from sports.physics import PhysicsState
from sports.registry import get_task, num_agents, task_names


def worlds_of(task: str) -> int:
    """Few where a world is large."""
    return 8 if num_agents(task) > 2 or get_task(task).body == "smplx" else 32


def env_lasts(task: str) -> bool:
    """Whether an episode goes on after a fall, for minutes."""
    return get_task(task).max_steps > 600


def actions(env: Env, steps: int, sigma: float = 0.3, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    shape = (steps, env.num_worlds, env.num_agents, env.action_size)
    return sigma * torch.randn(shape, generator=generator)


@pytest.mark.parametrize("task", task_names())
def test_two_hundred_random_steps_are_finite(task):
    env = make_env(task, num_worlds=worlds_of(task), seed=1)
    size = (env.num_worlds, env.num_agents)
    ended = torch.zeros(env.num_worlds, dtype=torch.bool)
    for action in actions(env, 200):
        result = env.step(action)
        goal = torch.cat(tuple(env.task.features(env.view, env.memory).values()), -1)
        assert goal.isfinite().all() and result.obs.isfinite().all()
        assert result.reward.isfinite().all() and result.reward.shape == size
        assert result.terminated.shape == result.truncated.shape == size
        assert not (result.terminated & result.truncated).any()
        assert set(result.metrics) == set(env.task.metrics)
        assert all(v.shape == (env.num_worlds,) for v in result.metrics.values())
        total = torch.stack(tuple(result.terms.values())).sum(0)
        torch.testing.assert_close(result.reward, total)
        ended |= result.ended
    assert env.physics.nan_worlds <= 2
    assert ended.all() or get_task(task).max_steps > 200
    env.close()


@pytest.mark.parametrize("task", task_names())
def test_a_world_that_diverges_is_lost_alone(task, monkeypatch):
    """On a GPU its NaN reach the task: nothing may be looked up by them."""
    env, clean = (make_env(task, num_worlds=4, seed=1, training=False) for _ in range(2))
    for action in actions(env, 3):
        env.step(action), clean.step(action)

    def step(ctrl, physics=env.physics, honest=env.physics.step):
        honest(ctrl)
        physics.bad[2] = True
        for value in vars(physics).values():
            if isinstance(value, torch.Tensor) and value.is_floating_point() and len(value) == 4:
                value[2] = torch.nan

    monkeypatch.setattr(env.physics, "step", step)
    action = actions(env, 1)[0]
    result, reference = env.step(action), clean.step(action)
    assert result.valid.tolist() == [True, True, False, True]
    assert result.obs.isfinite().all() and result.reward[result.valid].isfinite().all()
    others = torch.tensor([0, 1, 3])
    assert torch.equal(result.obs[others], reference.obs[others])
    assert torch.equal(result.reward[others], reference.reward[others])
    env.close(), clean.close()


@pytest.mark.parametrize("task", task_names())
def test_a_task_says_what_a_success_is(task):
    """Verification compares success rates on two engines, evaluation ranks by the main metric."""
    record = get_task(task)
    assert record.metrics["success"] == "fraction" and record.main_metric in record.metrics
    assert record.summary.endswith(".")


@pytest.mark.parametrize("task", task_names())
def test_the_observation_is_what_its_slices_say(task):
    env = make_env(task, num_worlds=2, training=False)
    felt = proprioception_slices(env.physics.scene.body.num_links)
    at = 0
    for name, part in env.obs_slices.items():
        assert part.start == at and part.stop > at, name
        at = part.stop
    assert at == env.obs_size
    assert {k: env.obs_slices[k] for k in felt} == felt
    obs = env.reset()
    for name, value in env.task.features(env.view, env.memory).items():
        assert torch.equal(obs[..., env.obs_slices[f"goal/{name}"]], value), name
    env.close()


@pytest.mark.parametrize("task", task_names())
def test_a_seed_decides_everything(task):
    first, second, other = (make_env(task, num_worlds=3, seed=s) for s in (5, 5, 6))
    assert not torch.equal(first.reset(), other.reset())
    assert torch.equal(first.reset(), (second.reset(), second.reset())[1])
    for action in actions(first, 25, sigma=1.0):
        a, b = first.step(action), second.step(action)
        assert torch.equal(a.obs, b.obs) and torch.equal(a.reward, b.reward)
        assert torch.equal(a.ended, b.ended)


@pytest.mark.parametrize("task", task_names())
def test_permuting_the_worlds_permutes_everything(task):
    """Bit for bit, through falls and new starts: those of one environment, handed to the other in
    another order."""
    n = 6
    order = torch.tensor([3, 5, 0, 2, 1, 4])
    straight, permuted = (make_env(task, num_worlds=n, seed=2) for _ in range(2))
    draw, drawn, handed = straight._draw, [], []

    def record():
        drawn.append(draw())
        return drawn[-1]

    def hand_on():
        state, context = drawn[len(handed)]
        handed.append(state)
        rows = PhysicsState(**{k: v[order] for k, v in vars(state).items() if v is not None})
        return rows, {k: v[order] for k, v in context.items()}

    straight._draw, permuted._draw = record, hand_on
    assert torch.equal(straight.reset()[order], permuted.reset())
    permuted.age = straight.age[order].clone()
    ends = 0
    for action in actions(straight, 60, sigma=0.7, seed=3):
        a, b = straight.step(action), permuted.step(action[order])
        for name in ("obs", "final_obs", "reward", "terminated", "truncated", "remaining_paid"):
            assert torch.equal(getattr(a, name)[order], getattr(b, name)), name
        for name, value in (a.terms | a.metrics).items():
            other = (b.terms | b.metrics)[name]
            assert torch.equal(value[order].nan_to_num(-1.0), other.nan_to_num(-1.0)), name
        ends += int(a.ended.sum())
    assert len(handed) == len(drawn) and (ends >= 3 or env_lasts(task))
    for name, value in straight.curriculum.items():
        assert torch.equal(value[order], permuted.curriculum[name]), name


@pytest.mark.parametrize("task", task_names())
def test_drake_plays_it_too(task):
    """Its scene, features and rules, from the same start; after 3 steps without an action still
    where MuJoCo is."""
    envs = [make_env(task, engine=e, num_worlds=1, training=False) for e in ("mujoco", "drake")]
    for _ in range(3):
        mine, other = (env.step(torch.zeros(1, env.num_agents, env.action_size)) for env in envs)
    assert torch.equal(mine.terminated, other.terminated)
    q, r = envs[0].physics.qpos, envs[1].physics.qpos
    torch.testing.assert_close(q, r, rtol=0, atol=0.02)
    for name, value in mine.metrics.items():
        assert torch.equal(value.isnan(), other.metrics[name].isnan()), name
    for env in envs:
        env.close()


@pytest.mark.parametrize("task", task_names())
def test_mistakes_get_a_sentence(task):
    with pytest.raises(ValueError, match="no option 'height_of_everest'"):
        make_env(task, num_worlds=1, options={"height_of_everest": 1})
    with pytest.raises(ValueError, match="at least 1, not 0"):
        make_env(task, num_worlds=0)
    env = make_env(task, num_worlds=2)
    good = torch.zeros(2, env.num_agents, env.action_size)
    for shape in (good[:1], good[..., :5], torch.zeros(2, env.num_agents + 1, env.action_size)):
        with pytest.raises(ValueError, match="action has shape"):
            env.step(shape)
    good[1, 0, 3] = torch.nan
    with pytest.raises(ValueError, match=r"not finite in 1 worlds: \[1\]"):
        env.step(good)
    env.close()
