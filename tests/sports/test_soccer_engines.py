"""Football on the engines: walls, random play, permutations, and the same game on another one."""

from __future__ import annotations

import pytest
import torch

from sports.env import make_env, make_scene
from sports.physics import PhysicsState, default_state, make_physics

MATCHES = ("soccer_1v1", "soccer_2v2")


@pytest.mark.parametrize("name", ["mujoco", "drake"])
def test_walls_stop_shots_and_mouths_let_them_in(name):
    """30 m/s at the long wall, at the wall beside the mouth, and into the mouth at its edge."""
    if name == "drake":
        pytest.importorskip("pydrake")
    scene = make_scene("soccer_1v1")
    options = {"threads": 1} if name == "mujoco" else {}
    physics = make_physics(name, scene, 3, **options)
    state = default_state(scene, 3, "cpu")
    q, v = scene.object_qpos("ball").start, scene.object_qvel("ball").start
    pos = [(5.0, 8.0, 0.5), (14.0, 3.0, 0.5), (14.0, 1.98, 0.5)]
    state.qpos[:, q : q + 3] = torch.tensor(pos)
    state.qvel[:, v : v + 3] = torch.tensor([(0.0, 30.0, 0.0), (30.0, 0.0, 0.0), (30.0, 0.0, 0.0)])
    physics.reset(torch.ones(3, dtype=torch.bool), state)
    furthest = torch.zeros(3, 3)
    for _ in range(5):
        physics.step(torch.zeros(3, scene.nu))
        furthest = torch.maximum(furthest, physics.object_pos[:, 0])
        assert physics.object_linvel.norm(dim=-1).max() < 30.5
    assert furthest[0, 1] < 10.4 and furthest[1, 0] < 16.4
    speed = physics.object_linvel[:, 0]
    assert -26.0 < speed[0, 1] < -20.0 and -26.0 < speed[1, 0] < -20.0
    assert furthest[2, 0] > 17.0


@pytest.mark.parametrize(("task", "n"), [("soccer_1v1", 32), ("soccer_2v2", 8)])
def test_random_matches_for_200_steps(task, n):
    env = make_env(task, num_worlds=n, seed=2, physics_options={"threads": 1})
    agents = env.num_agents
    generator = torch.Generator().manual_seed(0)
    up = torch.zeros(n, agents)
    for _ in range(200):
        before = env.memory["down"]
        result = env.step(0.5 * torch.randn(n, agents, 69, generator=generator))
        assert torch.isfinite(result.obs).all() and torch.isfinite(result.reward).all()
        assert result.valid.all()
        up += (before >= 29) & (env.memory["down"] == 0)
    assert env.physics.nan_worlds == 0
    assert (up > 0).float().mean() > 0.5


@pytest.mark.parametrize("task", ["penalty_kick", *MATCHES])
def test_the_seed_decides_and_a_permutation_of_the_worlds_permutes(task):
    n = 4
    order = torch.tensor([2, 0, 3, 1])
    envs = [make_env(task, num_worlds=n, training=False) for _ in range(2)]
    again = [make_env(task, num_worlds=n, seed=7) for _ in range(2)]
    scene = envs[0].physics.scene
    state = default_state(scene, n, "cpu")
    generator = torch.Generator().manual_seed(7)
    ball = scene.object_qpos("ball").start
    # In soccer one scores, one is behind the line; a kick that ended would draw another target.
    places = (4.0, 10.0, -2.8, 8.0) if task == "penalty_kick" else (4.0, 15.9, -2.8, -16.6)
    state.qpos[:, ball] = torch.tensor(places)
    state.qvel[:, scene.object_qvel("ball").start] = torch.tensor((0.0, 9.0, -5.0, 0.0))
    target = torch.tensor((16.0, 0.5, 1.0)) + 0.1 * torch.rand(n, 3, generator=generator)
    for env, rows in zip(envs, (torch.arange(n), order)):
        everyone = torch.ones(n, dtype=torch.bool)
        rows_state = PhysicsState(state.qpos[rows], state.qvel[rows], state.mocap_pos[rows])
        env.physics.reset(everyone, rows_state)
        env.view.refresh()
        env.memory = env.task.begin(env.view, {"target": target[rows]})
    first = torch.ones(n, dtype=torch.bool)  # the next game's ball is turned as drawn
    for _ in range(12):
        action = 0.6 * torch.randn(n, scene.num_agents, 69, generator=generator)
        a, b = envs[0].step(action), envs[1].step(action[order])
        c, d = (env.step(action) for env in again)
        for name in ("final_obs", "reward", "terminated", "truncated", "valid"):
            assert torch.equal(getattr(a, name)[order][first], getattr(b, name)[first]), name
        for name, value in {**a.terms, **a.metrics}.items():
            value, other = value[order][first], {**b.terms, **b.metrics}[name][first]
            assert torch.equal(value.nan_to_num(-1), other.nan_to_num(-1)), name
        first &= ~(b.terminated | b.truncated).any(1)
        assert torch.equal(a.obs[order][first], b.obs[first])
        for name in ("obs", "final_obs", "reward", "terminated", "truncated", "valid"):
            assert torch.equal(getattr(c, name), getattr(d, name)), name
    assert first.sum() == (n if task == "penalty_kick" else n - 1)  # one of the games saw a goal


@pytest.mark.parametrize("task", ["penalty_kick", *MATCHES])
@pytest.mark.parametrize("name", ["warp", "drake"])
def test_another_engine_plays_the_same_game(task, name):
    """From the same start, standing still with the ball rolling: the same observations."""
    if name == "warp":
        pytest.importorskip("mujoco_warp")
    else:
        pytest.importorskip("pydrake")
    n = 2 if name == "warp" else 1
    options = {"device": "cpu"} if name == "warp" else {}
    kinds = (("mujoco", {"threads": 1}), (name, options))
    envs = [
        make_env(task, engine=kind, num_worlds=n, training=False, physics_options=more)
        for kind, more in kinds
    ]
    scene = envs[0].physics.scene
    target = torch.tensor([(16.0, 0.5, 1.0)]).expand(n, 3)
    for env in envs:
        state = default_state(scene, n, "cpu")
        q, v = scene.object_qpos("ball").start, scene.object_qvel("ball").start
        state.qpos[:, q + 2] = 0.3
        state.qvel[:, v : v + 3] = torch.tensor((1.0, 5.0, -1.0))
        env.physics.reset(torch.ones(n, dtype=torch.bool), state)
        env.view.refresh()
        env.memory = env.task.begin(env.view, {"target": target})
    for k in range(10 if name == "warp" else 5):
        action = torch.zeros(n, scene.num_agents, 69)
        a, b = (env.step(action) for env in envs)
        apart = (a.obs - b.obs).abs()
        if name == "warp":
            assert apart.max() < 1e-3, k
        else:  # a bounce lasts longer there, so what is compared is where things are
            slices = envs[0].obs_slices.items()
            places = [at for f, at in slices if f.endswith(("position", "goal"))]
            assert len(places) > 1 and max(apart[..., at].max() for at in places) < 0.05, k
        assert (a.reward - b.reward).abs().max() < 0.01
        assert torch.equal(a.terminated, b.terminated)
    assert int(envs[1].physics.nan_worlds) == 0 and int(envs[1].physics.overflow) == 0


def test_a_swung_leg_kicks_the_ball_in_both_mujocos():
    """Back swing and kick with the right hip: the foot meets the ball, and no hand does."""
    pytest.importorskip("mujoco_warp")
    speeds = []
    for name, options in (("mujoco", {"threads": 1}), ("warp", {"device": "cpu"})):
        env = make_env(
            "penalty_kick", engine=name, num_worlds=1, training=False, physics_options=options
        )
        scene = env.physics.scene
        state = default_state(scene, 1, "cpu")
        state.qpos[:, :2] = torch.tensor((3.7, 0.1))
        env.physics.reset(torch.ones(1, dtype=torch.bool), state)
        env.view.refresh()
        env.memory = env.task.begin(env.view, {"target": torch.tensor([[16.0, 0.0, 0.5]])})
        hip, knee = (scene.body.dof_index(f"R_{link}_y") for link in ("Hip", "Knee"))
        paid = 0.0
        for k in range(13):
            action = torch.zeros(1, 1, 69)
            action[..., hip] = 0.25 if k < 5 else -0.3
            action[..., knee] = 0.25 if k < 5 else 0.0
            result = env.step(action)
            paid += float(result.terms["speed"][0, 0])
        assert not result.terminated.any()
        assert result.metrics["touched"][0] == 1.0 and result.metrics["handling"][0] == 0.0
        speeds.append(env.physics.object_linvel[0, 0])
        assert speeds[-1][0] > 2.0 and paid > 0.02
    assert (speeds[0] - speeds[1]).abs().max() < 0.1
