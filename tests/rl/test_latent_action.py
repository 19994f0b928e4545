"""The layer between a policy and its athlete: what it may reach, and what it must not change."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from rl.latent_action import LatentActions, LatentConfig, arm_dofs, finger_dofs, holding
from rl.policy import Policy, PolicyError, load_policy
from rl.prior import PriorError
from sports.env import make_env, make_scene
from sports.humanoid.body import is_finger, load_body
from sports.registry import get_task
from tests.rl.latent_made import made_prior


def layer_of(env, prior=None, **options) -> LatentActions:
    config = LatentConfig(**options)
    scene, tools = env.physics.scene, env.task.tools
    return LatentActions(prior or made_prior(), config, scene, tools, env.device)


def test_a_bounded_latent_stays_within_the_priors_reach():
    env, prior = make_env("hurdling", num_worlds=3), made_prior()
    layer = layer_of(env, prior, span=2.0)
    obs = env.reset()
    mean, sigma = prior.moments(obs)
    g = torch.Generator().manual_seed(0)
    for scale in (0.1, 1.0, 30.0, 1e6):
        z = layer.latent(obs, scale * torch.randn(3, 1, 6, generator=g))
        assert (((z - mean) / sigma).abs() <= 2.0 + 1e-5).all()
    torch.testing.assert_close(layer.latent(obs, torch.zeros(3, 1, 6)), mean)
    a = torch.full((3, 1, 6), 0.5)
    torch.testing.assert_close(layer.latent(obs, a), mean + sigma * 2.0 * math.tanh(0.5))
    free = layer_of(env, prior, combine="free")
    torch.testing.assert_close(free.latent(obs, a), mean + 0.5)
    env.close()


def test_acting_through_the_layer_is_decoding_by_hand():
    """The environment with the layer against the same environment fed decoded actions, through
    automatic resets."""
    prior = made_prior()
    one, two = (make_env("penalty_kick", num_worlds=4, seed=3) for _ in range(2))
    one.act_through(layer_of(one, prior))
    assert one.action_size == 6 and two.action_size == 69
    two.own_turns = True  # as an environment with a layer does
    first, obs = one.reset(), two.reset()
    assert torch.equal(first, obs)
    g = torch.Generator().manual_seed(0)
    ends = 0
    for _ in range(40):
        a = torch.randn(4, 1, 6, generator=g)
        mean, sigma = prior.moments(obs)
        by_hand = prior.decode(obs, mean + sigma * 2.5 * torch.tanh(a))
        x, y = one.step(a), two.step(by_hand)
        assert torch.equal(x.obs, y.obs) and torch.equal(x.reward, y.reward)
        torch.testing.assert_close(one.view.ctrl, two.view.ctrl, atol=0, rtol=0)
        obs, ends = y.obs, ends + int(y.ended.sum())
    assert ends > 0
    with pytest.raises(ValueError, match=r"expected \(4, 1, 6\)"):
        one.step(torch.zeros(4, 1, 69))
    one.act_through(None)
    assert one.action_size == 69
    one.close()
    two.close()


def test_targets_are_the_decoders_whatever_pose_a_task_is_around():
    """In boxing action 0 is a guard; the decoder's PD targets are absolute."""
    prior, env = made_prior(), make_env("boxing", num_worlds=2)
    assert float(env.action_offset.abs().max()) > 0.1
    env.act_through(layer_of(env, prior))
    obs = env.reset()
    a = torch.randn(2, 2, 6, generator=torch.Generator().manual_seed(0))
    z = env.layer.latent(obs, a)
    env.step(a)
    scale = torch.tensor(env.physics.scene.body.action_scale()).float()
    wanted = prior.decode(obs, z) * scale
    reach = torch.stack((env.action_offset - scale, env.action_offset + scale))
    torch.testing.assert_close(env.view.ctrl, wanted.clamp(*reach), atol=2e-6, rtol=0)
    env.close()


def test_a_resumed_environment_decodes_from_where_it_was():
    prior, a = made_prior(), torch.full((2, 1, 6), 0.3)
    one, two = (make_env("hurdling", num_worlds=2, seed=s) for s in (1, 2))
    for env in (one, two):
        env.act_through(layer_of(env, prior))
        env.reset()
    one.step(a)
    two.load_state_dict(one.state_dict())
    assert torch.equal(one.step(a).obs, two.step(a).obs)
    one.close()
    two.close()


def test_the_arm_with_the_tool_may_be_moved_a_little():
    env = make_env("tennis", num_worlds=2)
    layer = layer_of(env, arm_residual=0.2)
    body = env.physics.scene.body
    arm = arm_dofs(body, env.task.tools)
    links = {body.dofs[i].link for i in arm}
    assert links == {"R_Thorax", "R_Shoulder", "R_Elbow", "R_Wrist", "R_Hand"}
    assert layer.size == 6 + 15
    obs = env.reset()
    plain = torch.zeros(2, 1, 21)
    for value, radians in ((1e6, 0.2), (-1e6, -0.2), (0.5, 0.2 * math.tanh(0.5))):
        moved = plain.clone()
        moved[..., 6:] = value
        change = (layer(obs, moved) - layer(obs, plain)) * env.action_scale
        expected = torch.zeros(69)
        expected[arm] = radians
        torch.testing.assert_close(change, expected.expand(2, 1, 69), atol=1e-5, rtol=0)
    env.close()
    plain_task = make_env("hurdling", num_worlds=1)
    with pytest.raises(ValueError, match="nothing in hand, so no arm"):
        layer_of(plain_task, arm_residual=0.2)
    plain_task.close()
    # The fencer holds the sword in the hand, further down the same arm; fingers do not count.
    smpl = load_body("smpl")
    assert arm_dofs(smpl, ("R_Hand",)) == arm_dofs(smpl, ("R_Wrist",))
    assert holding(env.physics.scene) == () == holding(plain_task.physics.scene)
    assert holding(make_scene("javelin")) == ("R_Wrist",)
    assert holding(make_scene("free_throw")) == ("L_Wrist", "R_Wrist")
    fingers = load_body("smplx")
    assert not any(is_finger(fingers.dofs[i].link) for i in arm_dofs(fingers, ("R_Wrist",)))
    assert len(arm_dofs(fingers, ("R_Wrist",))) == 12


def test_fingers_keep_the_grasp_of_the_task():
    env, prior = make_env("javelin", num_worlds=2), made_prior("smplx")
    assert get_task("javelin").body == "smplx"
    env.act_through(layer_of(env, prior))
    env.reset()
    env.step(torch.randn(2, 1, 6, generator=torch.Generator().manual_seed(0)))
    finger = torch.tensor([is_finger(d.link) for d in env.physics.scene.body.dofs])
    held = env.action_offset.expand(2, 1, -1)
    assert torch.equal(env.view.ctrl[..., finger], held[..., finger])
    assert float((env.view.ctrl - held)[..., ~finger].abs().min(-1).values.max()) > 0.0
    env.close()


def test_a_prior_of_another_body_is_refused():
    env = make_env("hurdling", num_worlds=1)
    with pytest.raises(PriorError, match="of body 'smplx', the athlete of this task is 'smpl'"):
        layer_of(env, made_prior("smplx"))
    with pytest.raises(ValueError, match="span must be positive"):
        LatentConfig(span=0.0)
    env.close()


def test_a_policy_without_its_layer_is_not_played():
    zero = load_policy("zero", "hurdling")
    env = make_env("hurdling", num_worlds=1)
    policy = Policy(None, torch.zeros(0), torch.ones(0), dict(zero.metadata))
    policy.check(env)  # a baseline needs none
    layer = layer_of(env)
    card = {"latent": dataclasses.asdict(LatentConfig()) | {"prior_digest": "other"}}
    stranger = Policy(None, torch.zeros(0), torch.ones(0), {**zero.metadata, **card})
    stranger.prior = made_prior()
    env.act_through(layer)
    with pytest.raises(PolicyError, match="acts through another latent prior"):
        stranger._check_latent(env)
    env.close()


def test_a_hand_opens_and_lets_go():
    """Two numbers, right and left apart; with the hand open the javelin falls out of it."""
    env, prior = make_env("javelin", num_worlds=3, training=False), made_prior("smplx")
    layer = layer_of(env, prior, hands=True)
    env.act_through(layer)
    body = env.physics.scene.body
    left, right = finger_dofs(body)
    assert {body.dofs[i].link[0] for i in left} == {"L"}
    assert {body.dofs[i].link[0] for i in right} == {"R"}
    assert len(left) == len(right) == 45
    assert layer.size == env.action_size == 6 + 2
    obs = env.reset()
    action = torch.zeros(3, 1, 8)
    action[1, 0, 6], action[2, 0, 7] = 0.6, 5.0  # the left half open, the right one wide
    plain = layer(obs, torch.zeros(3, 1, 8))
    changed = (layer(obs, action) - plain) * env.action_scale
    grasp = env.action_offset
    assert torch.equal(changed[0], torch.zeros(1, body.num_dofs))
    for world, own, other, share in ((1, left, right, 0.5), (2, right, left, 1.0)):
        torch.testing.assert_close(changed[world, 0, own], -share * grasp[own], atol=1e-6, rtol=0)
        assert float(changed[world, 0, other].abs().max()) == 0.0
    action[1, 0, 6] = 0.2  # not yet
    assert torch.equal(layer(obs, action)[1], plain[1])
    # The right hand holds the javelin, which is tossed up: only the open hand lets it go.
    action[1, 0, 6] = 1.0
    ctrl = (grasp + (layer(obs, action) - plain) * env.action_scale)[:, 0]
    physics, up = env.physics, env.physics.scene.object_qvel("javelin").start + 2
    for _ in range(4):
        physics.step(ctrl)
    before = physics.object_pos[:, 0, 2].clone()
    qvel = physics.qvel.clone()
    qvel[:, up] = 2.0
    physics.move(torch.ones(3, dtype=torch.bool), physics.qpos, qvel)
    for _ in range(5):
        physics.step(ctrl)
    rose = (physics.object_pos[:, 0, 2] - before).tolist()
    assert max(rose[:2]) < 0.04 < 0.08 < rose[2]
    env.close()
    plain_task = make_env("hurdling", num_worlds=1)
    with pytest.raises(ValueError, match="has no fingers for"):
        layer_of(plain_task, hands=True)
    plain_task.close()
