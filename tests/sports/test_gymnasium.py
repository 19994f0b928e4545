"""The Gymnasium adapters against the library's own checker and against the environment itself."""

from __future__ import annotations

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from sports.adapters.gymnasium_env import OlympicsEnv, OlympicsVectorEnv
from sports.env import make_env
from sports.registry import num_agents, task_names


@pytest.mark.parametrize("task", [name for name in task_names() if num_agents(name) == 1])
def test_the_library_finds_nothing(task):
    name = f"olympics/{task.title().replace('_', '')}-v0"
    env = gymnasium.make(name, strength="human")
    check_env(env.unwrapped, skip_render_check=True)
    env.close()
    env.close()
    envs = gymnasium.make_vec(name, num_envs=3)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    obs, _ = envs.reset(seed=1)
    assert obs in envs.observation_space and obs.shape[0] == 3
    envs.close()


def test_worlds_go_as_those_of_the_environment():
    """Rewards, ends and observations of 60 random steps, past the end of several episodes."""
    envs, n = OlympicsVectorEnv("high_jump", 6, training=False), 6
    plain = make_env("high_jump", num_worlds=n, training=False)
    obs, _ = envs.reset(seed=3)
    plain.generator.manual_seed(3)
    np.testing.assert_array_equal(obs, plain.reset()[:, 0].numpy())
    rng, ends = np.random.default_rng(0), 0
    for _ in range(60):
        action = rng.uniform(-1.0, 1.0, (n, envs.single_action_space.shape[0])).astype(np.float32)
        obs, reward, terminated, truncated, info = envs.step(action)
        result = plain.step(torch.from_numpy(action)[:, None])
        np.testing.assert_array_equal(obs, result.obs[:, 0].numpy())
        np.testing.assert_array_equal(reward, result.reward[:, 0].double().numpy())
        np.testing.assert_array_equal(terminated, result.terminated[:, 0].numpy())
        ended = terminated | truncated
        ends += int(ended.sum())
        assert ("final_obs" in info) == bool(ended.any())
        for world in np.flatnonzero(ended):
            last = info["final_obs"][world]
            np.testing.assert_array_equal(last, result.final_obs[world, 0].numpy())
            assert not np.array_equal(last, obs[world])
            assert info["final_info"]["metrics"]["success"][world] == 0.0
        if ended.any():
            np.testing.assert_array_equal(info["_final_obs"], ended)
    assert ends >= n
    envs.close()
    plain.close()


def test_one_world_ends_without_beginning_again():
    env = OlympicsEnv("long_jump", training=False)
    env.reset(seed=0)
    steps: list[np.ndarray] = []
    for _ in range(200):
        assert env.env.view.clock[0] == len(steps)
        obs, reward, terminated, truncated, info = env.step(np.ones(69, np.float32))
        steps.append(obs)
        if terminated or truncated:
            break
        assert info == {}
    assert terminated and len(steps) > 3 and not info["diverged"]
    assert info["metrics"]["success"] == 0.0 and np.isnan(info["metrics"]["length"])
    fresh, _ = env.reset(seed=0)
    assert np.abs(obs - fresh).max() > 0.1 and isinstance(reward, float)
    env.close()


def test_a_seed_decides_the_curriculum_too():
    envs = OlympicsVectorEnv("high_jump", 4)
    first, _ = envs.reset(seed=5)
    envs.env.curriculum["level"][:] = 2
    other, _ = envs.reset()
    again, _ = envs.reset(seed=5)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert (envs.env.age == 0).all()
    envs.close()


def test_mistakes_get_a_sentence():
    envs = OlympicsVectorEnv("long_jump", 2)
    with pytest.raises(ValueError, match=r"shape \(2, 5\), expected \(2, 69\)"):
        envs.step(np.zeros((2, 5)))
    with pytest.raises(ValueError, match="finite"):
        envs.step(np.full((2, 69), np.nan))
    with pytest.raises(ValueError, match="a number, not a list"):
        envs.reset(seed=[1, 2])
    envs.close()
    with pytest.raises(ValueError, match="unknown task"):
        OlympicsEnv("swimming")


def test_the_examples_of_the_readme_run():
    text = (Path(__file__).parents[2] / "README.md").read_text()
    worlds, match = re.findall(r"```python\n(.*?)```", text, re.S)
    found: dict = {}
    exec(match, found)
    assert set(found["rewards"]) == {"athlete_0", "athlete_1"} == set(found["terminations"])
    found["match"].close()
    exec(worlds.replace("num_envs=256", "num_envs=2"), found)
    assert found["obs"].shape == (2, found["envs"].single_observation_space.shape[0])
    found["envs"].close()


def test_another_librarys_learner_learns_from_it():
    """Two updates of Stable-Baselines3's PPO: samples counted, losses finite, weights changed."""
    from stable_baselines3 import PPO

    env = gymnasium.make("olympics/LongJump-v0", strength="human")
    learner = PPO("MlpPolicy", env, n_steps=48, batch_size=24, n_epochs=2, seed=0, device="cpu")
    before = [p.detach().clone() for p in learner.policy.parameters()]
    learner.learn(96)
    assert learner.num_timesteps == 96 and learner._n_updates == 4
    after = list(learner.policy.parameters())
    assert all(bool(p.isfinite().all()) for p in after)
    assert any(not torch.equal(a, b) for a, b in zip(before, after))
    env.close()
