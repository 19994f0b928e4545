"""Several athletes in one world: whose episode ends, what the sport moves, who touched whom."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from pettingzoo.test import parallel_api_test

from rl.rollout import Rollout, collect
from sports.adapters.gymnasium_env import OlympicsEnv
from sports.adapters.pettingzoo_env import OlympicsParallelEnv
from sports.env import make_env
from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from sports.physics import default_state, make_physics
from tests.sports import duel

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
OTHER_ENGINES = (("warp", {"device": "cpu"}), ("drake", {}))


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    duel.register(monkeypatch)


def topple(env, agent: int, world: int) -> None:
    """Lays an athlete on the ground for the step to come."""
    physics = env.physics
    qpos, q = physics.qpos.clone(), physics.scene.agent_qpos(agent)
    qpos[world, q.start + 2] = 0.2
    qpos[world, q.start + 3 : q.start + 7] = torch.tensor([0.7071, 0.0, 0.7071, 0.0])
    mask = torch.arange(env.num_worlds) == world
    physics.move(mask, qpos, physics.qvel.clone())


def test_who_falls_is_terminated_and_the_other_is_cut_off():
    env = make_env("duel", num_worlds=3, training=False)
    action = torch.zeros(3, 2, env.action_size)
    env.step(action)
    topple(env, agent=1, world=2)
    result = env.step(action)
    no = [False, False]
    assert result.terminated.tolist() == [no, no, [False, True]]
    assert result.truncated.tolist() == [no, no, [True, False]]
    assert result.ended.tolist() == [False, False, True]
    assert env.view.clock.tolist() == [2, 2, 0]


def test_the_time_limit_cuts_off_all():
    env = make_env("duel", num_worlds=2, training=False)
    action = torch.zeros(2, 2, env.action_size)
    results = [env.step(action) for _ in range(40)]
    assert not results[38].ended.any() and results[39].truncated.all()
    assert not results[39].terminated.any()


def test_a_rollout_keeps_ends_apart():
    """Terminated rows take no bootstrap, the other athlete's rows do."""
    env = make_env("duel", num_worlds=2, training=False)
    size = env.obs_size, env.action_size
    rollout = Rollout(2, 4, *size, torch.device("cpu"), torch.float32)

    class Still:
        device = torch.device("cpu")

        def act(self, obs):
            action = torch.zeros(len(obs), size[1])
            return obs, action, action, action[:, 0]

        def prepare(self, obs):
            return obs

    obs = collect(env, Still(), rollout, env.reset(), 0.99)
    topple(env, agent=0, world=1)
    collect(env, Still(), rollout, obs, 0.99)
    assert rollout.terminated[0].tolist() == [False, False, True, False]
    assert rollout.truncated[0].tolist() == [False, False, False, True]


@pytest.mark.parametrize(("engine", "options"), (("mujoco", {}), *OTHER_ENGINES))
def test_the_sport_moves_a_ball_and_an_athlete(engine, options):
    """Where it was put, falling freely from there; what was not moved goes on as without it."""
    make = {"engine": engine, "training": False, "physics_options": options, "num_worlds": 1}
    env = make_env("duel", **make)
    ball, athlete = env.physics.scene.object_qpos("ball"), env.physics.scene.agent_qpos(1)
    action = torch.zeros(1, 2, env.action_size)
    for _ in range(duel.SERVE_STEP):
        obs = env.step(action).obs
    np.testing.assert_allclose(env.physics.object_pos[0, 0], duel.SERVE, atol=1e-6)
    np.testing.assert_allclose(env.physics.qpos[0, ball][:3], duel.SERVE, atol=1e-6)
    for _ in range(duel.STAND_STEP - duel.SERVE_STEP):
        before = env.physics.qpos[0].clone()
        obs = env.step(action).obs
    t = 2 / 30.0
    assert float(env.physics.object_pos[0, 0, 2]) == pytest.approx(3.0 - 4.905 * t * t, abs=0.015)
    # Athlete 1 stands at x = 4 in its start pose; athlete 0 has hardly moved.
    placed = env.physics.qpos[0, athlete]
    start = torch.tensor(env.physics.scene.default_qpos()[athlete], dtype=torch.float32)
    np.testing.assert_allclose(placed[:2], (4.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(placed[3:7], (1.0, 0.0, 0.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(placed[7:], start[7:], atol=1e-6)
    assert not np.allclose(before[athlete][:2], placed[:2])
    own = env.physics.scene.agent_qpos(0)
    np.testing.assert_allclose(env.physics.qpos[0, own], before[own], atol=1e-2)
    # The observation is of the state after the move.
    seen = obs[0, :, env.obs_slices["goal/opponent"]]
    np.testing.assert_allclose(seen[0, :2], (5.5, 0.0), atol=0.03)
    env.close()


def test_what_is_not_moved_goes_on_bit_for_bit():
    """Moving the ball in one world changes neither the athletes there nor any other world."""
    scene = make_env("duel", num_worlds=1).physics.scene
    pair = [make_physics("mujoco", scene, 2, threads=1) for _ in range(2)]
    g = torch.Generator().manual_seed(0)
    for k in range(8):
        ctrl = 0.2 * torch.randn(2, scene.nu, generator=g)
        for physics in pair:
            physics.step(ctrl)
        if k == 3:
            qpos = pair[0].qpos.clone()
            qpos[:, scene.object_qpos("ball").start + 2] += 5.0
            pair[0].move(torch.tensor([False, True]), qpos, pair[0].qvel.clone())
    athletes = slice(0, scene.agent_qpos(1).stop)
    assert torch.equal(pair[0].qpos[:, athletes], pair[1].qpos[:, athletes])
    assert torch.equal(pair[0].qpos[0], pair[1].qpos[0])
    assert float(pair[0].object_pos[1, 0, 2] - pair[1].object_pos[1, 0, 2]) > 4.0


def clinch(engine: str, substeps: int = 4, **options):
    """Physics in which athlete 0's right hand has just struck athlete 1's chest."""
    body = load_body()
    scene = replace(duel.scene(duel.Duel(reach=0.6), body), substeps=substeps)
    physics = make_physics(engine, scene, 2, **options)
    state = default_state(scene, 2, "cpu")
    state.qpos[:, 7 + body.dof_index("R_Shoulder_z")] = 1.4
    state.qpos[:, scene.agent_qpos(1).start + 1] = torch.tensor([-0.2, -0.24])
    physics.reset(torch.ones(2, dtype=torch.bool), state)
    ctrl = torch.zeros(2, scene.nu)
    ctrl[:, body.dof_index("R_Shoulder_z")] = 1.4
    physics.step(ctrl)
    return physics, state, ctrl


def test_forces_between_links_are_those_of_the_contacts():
    """Against a sum over MuJoCo's contacts, one substep from the same state."""
    physics, state, ctrl = clinch("mujoco", substeps=1)
    model = build_model(physics.scene)
    for world in range(2):
        data, force = mujoco.MjData(model), {}
        data.qpos[:], data.ctrl[:] = state.qpos[world], ctrl[world]
        mujoco.mj_step(model, data)
        for k, contact in enumerate(data.contact[: data.ncon]):
            wrench = np.zeros(6)
            mujoco.mj_contactForce(model, data, k, wrench)
            names = [model.body(model.geom_bodyid[g]).name for g in contact.geom]
            if "world" in names:
                continue
            for name, sign in zip(names, (-1.0, 1.0)):
                on_it = sign * contact.frame.reshape(3, 3).T @ wrench[:3]
                force[name] = force.get(name, 0.0) + on_it
        assert sum(np.linalg.norm(f) > 20.0 for f in force.values()) >= 2
        for agent in range(2):
            for i, link in enumerate(physics.scene.body.link_names):
                wanted = force.get(f"agent{agent}/{link}", np.zeros(3))
                got = physics.link_force[world, agent, i].numpy()
                np.testing.assert_allclose(got, wanted, atol=1e-3)


@pytest.mark.parametrize(("engine", "options"), OTHER_ENGINES)
def test_engines_agree_on_who_touches_whom(engine, options):
    (here, _, _), (there, _, _) = clinch("mujoco"), clinch(engine, **options)
    a, b = here.link_force.norm(dim=-1), there.link_force.norm(dim=-1)
    assert (a > 20.0).sum() >= 4 and torch.equal(a > 20.0, b > 20.0)
    if engine == "warp":
        torch.testing.assert_close(a, b, rtol=1e-3, atol=0.1)
    for physics in (here, there):
        # The hand has one shape: the contact of the shape is that of the link.
        assert (physics.pair_force[:, 0] > 20.0).all()
        assert torch.equal(physics.pair_force[:, 0], physics.pair_force[:, 1])


def test_a_start_pose_is_that_of_the_scene():
    env = make_env("duel", num_worlds=1, training=False)
    scene = env.physics.scene
    own = env.physics.qpos[0, scene.agent_qpos(1)]
    assert float(own[7 + scene.body.dof_index("L_Elbow_z")]) == pytest.approx(-0.5)
    assert float(own[0]) == 1.5 and math.isclose(abs(float(own[6])), 1.0, abs_tol=1e-6)


def test_pettingzoo_finds_nothing():
    env = OlympicsParallelEnv("duel", training=False)
    parallel_api_test(env, num_cycles=60)
    env.close()


def test_a_match_ends_for_both_and_says_who_fell():
    env = OlympicsParallelEnv("duel", training=False)
    first, _ = env.reset(seed=1)
    again, _ = env.reset(seed=1)
    for name in env.agents:
        np.testing.assert_array_equal(first[name], again[name])
    still = dict.fromkeys(env.agents, np.zeros(69, np.float32))
    env.step(still)
    topple(env.env, agent=1, world=0)
    obs, reward, terminated, truncated, info = env.step(still)
    assert terminated == {"athlete_0": False, "athlete_1": True}
    assert truncated == {"athlete_0": True, "athlete_1": False}
    assert info["athlete_0"]["metrics"]["steps"] == 2.0 and not info["athlete_0"]["diverged"]
    assert obs["athlete_1"][0] < 0.4 < obs["athlete_0"][0]  # of the end, not of the next start
    assert reward["athlete_1"] < 0.4 < reward["athlete_0"]
    assert env.agents == []
    with pytest.raises(ValueError, match="match is over"):
        env.step(still)
    env.close()


def test_mistakes_get_a_sentence():
    env = OlympicsParallelEnv("duel", training=False)
    env.reset()
    good = np.zeros(69, np.float32)
    with pytest.raises(ValueError, match="needs one for each of athlete_0, athlete_1"):
        env.step({"athlete_0": good})
    with pytest.raises(ValueError, match=r"athlete_1 has shape \(3,\), expected \(69,\)"):
        env.step({"athlete_0": good, "athlete_1": np.zeros(3)})
    with pytest.raises(ValueError, match="athlete_1 has a number that is not finite"):
        env.step({"athlete_0": good, "athlete_1": np.full(69, np.nan)})
    env.close()
    with pytest.raises(ValueError, match="2 athletes, Gymnasium knows one: use"):
        OlympicsEnv("duel")
