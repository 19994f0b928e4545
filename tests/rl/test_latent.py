"""The distillation's formulas against other people's, its targets against the tracker's own, and
its learning where the best that can be learned is known."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.distributions import Normal, kl_divergence

from rl.annealing import annealed
from rl.latent import KEEP, Distiller, FrozenNormalizer, absolute_action
from rl.latent_config import PriorConfig, options_of
from rl.latent_terms import gaussian_kl, hinge_weights, steered
from rl.networks import MLP
from rl.policy import Policy, PolicyError
from rl.tracker import TrackingConfig, TrackingEnv, make_tracking_env
from rl.tracking_terms import least_turn
from sports.physics.base import PhysicsState
from sports.turns import nearest_turn
from tests.rl.latent_made import golf
from tests.warmstart.clips_made import random_clip
from warmstart.clip import Clip
from warmstart.library import pack

SMALL = PriorConfig(
    split="all",
    latent=8,
    encoder=(64, 64),
    prior=(64,),
    decoder=(64, 64),
    steps=4,
    minibatches=4,
    epochs=2,
    learning_rate=2e-3,
    smooth=0.0,
    pose=False,
    stiffness=0.0,
    nats=(0.0, 0.0),
    beta=(0.01, 0.001),
)


def tracking_env(*clips: Clip, worlds: int = 2, action: str = "absolute", **more) -> TrackingEnv:
    library = pack((f"clip_{i}", c) for i, c in enumerate(clips))
    config = TrackingConfig(split="all", action=action)  # type: ignore[arg-type]
    return make_tracking_env(library, num_worlds=worlds, config=config, **more)


def teacher(env: TrackingEnv, hidden: int = 8) -> Policy:
    card = {"obs_size": env.obs_size, "action_size": 69, "observation_clip": 5.0}
    card |= {"obs_count": 1.0, "sha256": "made up", "algo": "ppo"}
    weights = torch.Generator().manual_seed(3)
    actor = MLP(env.obs_size, (hidden,), 69, head_gain=0.5, generator=weights)
    actor.requires_grad_(False)
    return Policy(actor, torch.zeros(env.obs_size), torch.ones(env.obs_size), card)


# Formulas.


def test_divergence_is_that_of_torch_distributions():
    g = torch.Generator().manual_seed(0)
    mean, mean_p = torch.randn(2, 500, 7, generator=g) * 2.0
    logvar, logvar_p = torch.rand(2, 500, 7, generator=g) * 7.0 - 5.0
    found = gaussian_kl(mean, logvar, mean_p, logvar_p)
    one, two = (Normal(m, (0.5 * v).exp()) for m, v in ((mean, logvar), (mean_p, logvar_p)))
    torch.testing.assert_close(found, kl_divergence(one, two), rtol=1e-4, atol=1e-5)
    assert float(gaussian_kl(mean, logvar, mean, logvar).abs().max()) < 1e-6
    # Worked in float32 whatever comes in.
    half = gaussian_kl(mean.bfloat16(), logvar.bfloat16(), mean_p.bfloat16(), logvar_p.bfloat16())
    assert half.dtype == torch.float32


def test_beta_falls_geometrically_and_stays():
    env = tracking_env(golf())
    learner = Distiller(env, teacher(env), dataclasses.replace(SMALL, learning_rate=5e-4))
    for share, beta, rate in ((0.0, 0.01, 5e-4), (0.35, 10**-2.5, None), (0.7, 0.001, None)):
        learner.schedule(share)
        assert float(learner.beta) == pytest.approx(beta, rel=1e-5)
        if rate is not None:
            assert float(learner.learning_rate) == pytest.approx(rate)
    learner.schedule(1.0)
    assert float(learner.beta) == pytest.approx(0.001, rel=1e-5)
    # The optimiser steps at the rate that was set.
    assert float(learner.optimizer.param_groups[0]["lr"]) == pytest.approx(1e-4)
    assert annealed(2.0, 8.0, 0.5) == pytest.approx(4.0)
    env.close()


def test_the_losses_by_hand():
    env = tracking_env(golf())
    learner = Distiller(env, teacher(env), SMALL)
    g = torch.Generator().manual_seed(1)
    obs = torch.randn(4, 3, env.obs_size, generator=g)
    label = torch.randn(4, 3, 69, generator=g)
    noise = torch.randn(4, 3, 8, generator=g)
    error, divergence, moved = learner.losses(obs, label, noise)
    nets = learner.nets
    with torch.no_grad():
        mean, logvar = nets.encoder(obs).chunk(2, -1)
        logvar = torch.clip(logvar, -5.0, 2.0)
        mean_p, logvar_p = nets.prior(obs[..., :358]).chunk(2, -1)
        z = mean + torch.exp(logvar / 2) * noise
        out = nets.decoder(torch.cat((obs[..., :358], z), -1))
        # A target that no action reaches is not asked for.
        expected = (out - label.clamp(-1, 1)).square().sum(-1).sqrt()
        torch.testing.assert_close(error, expected)
        two = Normal(mean_p, torch.exp(torch.clip(logvar_p, -5.0, 2.0) / 2))
        expected = kl_divergence(Normal(mean, torch.exp(logvar / 2)), two)
        torch.testing.assert_close(divergence, expected, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(moved, (mean[1:] - KEEP * mean[:-1]).norm(dim=-1))
    env.close()


def test_a_new_encoder_says_something_from_the_first_step_on():
    env = tracking_env(golf())
    for sigma in (0.22, 1.0):
        config = dataclasses.replace(SMALL, start_sigma=sigma, encoder=(256, 128))
        nets = Distiller(env, teacher(env), config).nets
        obs = torch.randn(500, env.obs_size, generator=torch.Generator().manual_seed(1))
        with torch.no_grad():
            mean, logvar = nets.posterior(obs)
            _, logvar_p = nets.expected(obs[:, :358])
        torch.testing.assert_close(
            (0.5 * logvar).exp().mean(), torch.tensor(sigma), rtol=0.05, atol=0
        )
        assert float((0.5 * logvar_p).exp().mean()) == pytest.approx(1.0, rel=0.05)
        assert 0.5 < float(mean.std()) < 2.0
    env.close()


def test_hinges_count_by_the_energy_of_their_springs():
    stiffness = torch.tensor([800.0, 200.0, 50.0])
    weight = hinge_weights(stiffness, 0.5)
    assert float(weight.square().mean()) == pytest.approx(1.0)
    off = torch.randn(9, 3, generator=torch.Generator().manual_seed(0))
    energy = 0.5 * (stiffness * off.square()).sum(-1)
    # The squared norm is the energy, but for one factor.
    torch.testing.assert_close((weight * off).square().sum(-1), energy * 2.0 / 350.0)
    assert torch.equal(hinge_weights(stiffness, 0.0), torch.ones(3))


def test_beta_is_steered_to_the_divergence_that_was_asked_for():
    beta = torch.tensor(1e-3)
    assert torch.equal(steered(beta, torch.tensor(20.0), 20.0, 0.1), beta)
    assert float(steered(beta, torch.tensor(30.0), 20.0, 0.1)) == pytest.approx(
        1e-3 * math.exp(0.05)
    )
    assert float(steered(beta, torch.tensor(900.0), 20.0, 0.1)) == pytest.approx(
        1e-3 * math.exp(0.1)
    )
    assert float(steered(beta, torch.tensor(0.0), 20.0, 0.1)) == pytest.approx(
        1e-3 * math.exp(-0.1)
    )
    # A Gaussian channel of Z dimensions, unit signals and noise s^2 = beta: 0.5 Z log(1 + 1 / s^2)
    # nats. It is led to where that is what was asked for.
    for _ in range(300):
        nats = 16.0 * torch.log1p(1.0 / beta)
        beta = steered(beta, nats, 48.0, 0.1)
    assert float(beta) == pytest.approx(1.0 / (math.exp(3.0) - 1.0), rel=1e-3)
    assert float(steered(torch.tensor(0.1), torch.tensor(99.0), 20.0, 0.1)) == pytest.approx(0.1)


# PD targets.


def test_two_triples_of_hinges_are_one_rotation():
    rng = np.random.default_rng(0)
    angle, near = torch.tensor(rng.uniform(-7, 7, (2, 200, 9)))
    found, flipped = nearest_turn(angle, near)
    assert 20 < int(flipped.sum()) < 580
    same = [Rotation.from_euler("XYZ", x.reshape(-1, 3).numpy()) for x in (angle, found)]
    assert (same[0].inv() * same[1]).magnitude().max() < 1e-6
    distance = (found - near).reshape(-1, 3).norm(dim=-1)
    # By trying all turns of both kinds.
    a = angle.reshape(-1, 1, 3)
    both = torch.cat(
        (a, torch.tensor([math.pi, math.pi, math.pi]) + a * torch.tensor([1, -1, 1])), 1
    )
    turns = 2 * math.pi * torch.cartesian_prod(*[torch.arange(-4.0, 5.0)] * 3)
    tried = both[:, :, None] + turns
    least = (tried - near.reshape(-1, 1, 1, 3)).norm(dim=-1).flatten(1).amin(-1)
    torch.testing.assert_close(distance, least, atol=1e-5, rtol=0)
    # What is near already stays as it is, to the last bit.
    close = angle + 0.3 * torch.tensor(rng.uniform(-1, 1, angle.shape))
    assert torch.equal(nearest_turn(close, angle)[0], close)


def test_a_state_on_another_turn_is_the_same_state():
    env = tracking_env(golf())
    rng = np.random.default_rng(1)
    qpos = env.physics.qpos.clone()
    qpos[:, 7:] = torch.tensor(rng.uniform(-3.1, 3.1, (2, 69))).float()
    qvel = torch.tensor(rng.normal(size=(2, 75))).float()
    seen = []
    for q, v in ((qpos, qvel), least_turn(qpos, qvel)):
        env.physics.reset(
            torch.ones(2, dtype=torch.bool), PhysicsState(q, v, env.physics.mocap_pos.clone())
        )
        p = env.physics
        seen.append([x.clone() for x in (p.body_pos, p.body_rot, p.body_linvel, p.body_angvel)])
    for one, two in zip(*seen):
        torch.testing.assert_close(one, two, atol=2e-4, rtol=1e-4)
    turned = least_turn(qpos, qvel)[0]
    assert float(turned[:, 7:].abs().max()) <= math.pi + 1e-5
    assert float((turned - qpos).abs().max()) > 1.0
    env.close()


def test_the_label_is_the_trackers_own_control():
    """Fed the teacher's absolute targets, the same physics does what it does under the tracker's
    residual actions."""
    assigned = {"worlds": 3, "assigned": [0, 0, 1]}
    clips = golf(), random_clip(0)
    residual = tracking_env(*clips, action="residual", **assigned)
    absolute = tracking_env(*clips, action="absolute", **assigned)
    torch.testing.assert_close(residual.reset(), absolute.reset(), atol=0, rtol=0)
    g = torch.Generator().manual_seed(0)
    for step in range(12):
        action = 0.4 * torch.randn(3, 69, generator=g)
        label = absolute_action(absolute, action)
        wanted = residual.targets(action[:, None])
        residual.step(action[:, None])
        absolute.step(label[:, None])
        # x / s * s is x but for the last bit of float32.
        torch.testing.assert_close(absolute.view.ctrl, wanted, atol=5e-7, rtol=0)
        tolerance = 1e-5 if step < 3 else 1e-2  # the last bit grows in contacts
        one, two = residual.physics.qpos, absolute.physics.qpos
        torch.testing.assert_close(one, two, atol=tolerance, rtol=0)
    residual.close()
    absolute.close()


def test_the_label_of_a_flipped_clip_turns_the_joint_alike():
    """A clip on the other turn of all its joints: same observations, same motion, and labels that
    an action reaches."""
    plain = golf()
    qpos = plain.qpos.copy()
    x = qpos[:, 7:].reshape(len(qpos), -1, 3)
    x += math.pi
    x[..., 1] = 2 * math.pi - x[..., 1]
    qvel = plain.qvel.copy()
    qvel[:, 7::3] *= -1.0  # the middle hinges turn the other way
    flipped = Clip(plain.fps, "smpl", qpos, qvel, ctrl=plain.ctrl)  # simulated as well
    env = tracking_env(plain, flipped, worlds=2, assigned=[0, 1])
    obs = env.reset()
    assert float(env.tracking.tables.joints(env.memory["frame"])[1].abs().max()) > 3.0
    # The library keeps angles to 1e-4 rad, so velocities to 3e-3 rad/s a link.
    torch.testing.assert_close(obs[0], obs[1], atol=2e-2, rtol=0)
    g = torch.Generator().manual_seed(0)
    reference = env.tracking.tables.joints(env.memory["frame"] + 1)
    action = 0.2 * torch.randn(2, 69, generator=g)
    label = absolute_action(env, action) * env.action_scale
    wanted = (reference + 0.8 * action).reshape(-1, 3).numpy()
    one, two = (Rotation.from_euler("XYZ", r) for r in (wanted, label.reshape(-1, 3).numpy()))
    assert (one.inv() * two).magnitude().max() < 1e-3
    assert float((label - env.physics.qpos[:, 7:]).abs().max()) < 1.5
    still = absolute_action(env, torch.zeros(2, 69))
    torch.testing.assert_close(still[0], still[1], atol=2e-3, rtol=0)
    env.close()


# Acting and learning.


def test_acting_labels_with_the_teacher_and_disturbs_some_worlds():
    env = tracking_env(golf(), worlds=8)
    policy = teacher(env)
    learner = Distiller(env, policy, dataclasses.replace(SMALL, noise=0.05, noisy=0.5))
    obs = env.reset()
    stored, action, label, _ = learner.act(obs[:, 0])
    torch.testing.assert_close(stored, obs[:, 0].clamp(-5, 5))
    torch.testing.assert_close(label, absolute_action(env, policy(obs)[:, 0]))
    with torch.no_grad():
        mean, _ = learner.nets.posterior(stored)
        plain = learner.nets.decode(stored[:, :358], mean)
    torch.testing.assert_close(action[4:], plain[4:])
    assert 0.03 < float((action - plain)[:4].std()) < 0.07
    env.close()


def test_some_worlds_act_by_the_prior_alone():
    env = tracking_env(golf(), worlds=8)
    config = dataclasses.replace(SMALL, noise=0.0, alone=0.5)
    learner = Distiller(env, teacher(env), config, seed=4)
    obs = env.reset()[:, 0]
    goal = obs.clone()
    goal[:, 358:] *= -1.0
    actions = []
    for seen in (obs, goal):
        learner.generator.manual_seed(7)
        stored, action, label, _ = learner.act(seen)
        actions.append(action)
        torch.testing.assert_close(label, absolute_action(env, learner._teacher(stored)))
    # What the goal shows moves those that follow it alone.
    assert torch.equal(actions[0][4:], actions[1][4:])
    assert float((actions[0] - actions[1])[:4].abs().amax(-1).min()) > 1e-4
    # Draws of the prior: as many as it takes give its decoded mean and spread.
    draws = torch.stack([learner.act(obs)[1][4:] for _ in range(400)])
    with torch.no_grad():
        stored = learner.prepare(obs)[4:, :358]
        mean, logvar = learner.nets.expected(stored)
        noise = torch.randn(2000, 4, 8, generator=torch.Generator().manual_seed(0))
        wanted = learner.nets.decode(
            stored.expand(2000, -1, -1), mean + (0.5 * logvar).exp() * noise
        )
    torch.testing.assert_close(draws.mean(0), wanted.mean(0), atol=0.02, rtol=0)
    torch.testing.assert_close(draws.std(0).mean(), wanted.std(0).mean(), rtol=0.1, atol=0)
    env.close()


def filled(learner: Distiller, obs: torch.Tensor, label: torch.Tensor):
    rollout = learner.new_rollout(obs.shape[1])
    rollout.obs.copy_(obs)
    rollout.mean.copy_(label)
    rollout.valid.fill_(True)
    return rollout


def taught(
    goal: bool, beta: float, updates: int = 120
) -> tuple[dict[str, float], dict[str, float]]:
    """First and last statistics of a student whose teacher is a known map: of the body alone, or
    of three numbers of the goal as well."""
    env = tracking_env(golf())
    learner = Distiller(env, teacher(env), SMALL)
    learner.obs_norm = FrozenNormalizer(torch.zeros(934), torch.ones(934), 5.0, 1.0)
    learner.beta.fill_(beta)
    g = torch.Generator().manual_seed(0)
    directions = torch.linalg.qr(torch.randn(69, 6, generator=g))[0].T  # orthonormal rows
    told = []
    for _ in range(updates):
        obs = torch.zeros(4, 64, 934)
        obs[..., :3] = torch.randn(4, 64, 3, generator=g)
        obs[..., 358:361] = torch.randn(4, 64, 3, generator=g)
        label = 0.3 * torch.tanh(obs[..., :3]) @ directions[:3]
        if goal:
            label = label + 0.3 * torch.tanh(obs[..., 358:361]) @ directions[3:]
        told.append({k: float(v) for k, v in learner.update(filled(learner, obs, label)).items()})
    env.close()
    return told[0], told[-1]


def test_a_student_of_a_known_map_learns_it():
    first, last = taught(goal=True, beta=1e-3)
    # 0.3 tanh(x) in six directions: an action of 0 is 0.46 off, a decoder without latent 0.32.
    assert first["action_error"] > 0.3
    assert last["action_error"] < 0.1
    # Three numbers of the goal must come through the latent.
    assert last["kl"] > 3.0 and last["active"] >= 3


def test_what_the_body_tells_needs_no_latent():
    _, last = taught(goal=False, beta=0.05)
    assert last["action_error"] < 0.12
    assert last["kl"] < 0.05 and last["active"] <= 2
    # The same weight of the divergence does not stop what must come through.
    assert taught(goal=True, beta=0.05)[1]["kl"] > 0.5


def faint(config: PriorConfig, updates: int) -> dict[str, float]:
    """Last statistics of a student whose teacher does mostly what the body tells, and a little that
    only the goal does: six directions of 0.05 beside six of 0.3."""
    env = tracking_env(golf())
    learner = Distiller(env, teacher(env), config)
    learner.obs_norm = FrozenNormalizer(torch.zeros(934), torch.ones(934), 5.0, 1.0)
    g = torch.Generator().manual_seed(0)
    directions = torch.linalg.qr(torch.randn(69, 12, generator=g))[0].T
    told = {}
    for i in range(updates):
        learner.schedule(i / updates)
        obs = torch.zeros(4, 64, 934)
        obs[..., :6] = torch.randn(4, 64, 6, generator=g)
        obs[..., 358:364] = torch.randn(4, 64, 6, generator=g)
        label = 0.3 * torch.tanh(obs[..., :6]) @ directions[:6]
        label = label + 0.05 * torch.tanh(obs[..., 358:364]) @ directions[6:]
        told = {k: float(v) for k, v in learner.update(filled(learner, obs, label)).items()}
    env.close()
    return told


def test_latents_that_collapsed_stay_awake():
    """With the settings of PULSE nothing of the goal comes through: the posterior is noise before
    the decoder has a use for it. With a divergence that is kept up it does."""
    pulse = dataclasses.replace(SMALL, start_sigma=1.0, smooth=0.005, learning_rate=5e-4)
    steered_ = dataclasses.replace(SMALL, smooth=0.0005, nats=(20.0, 8.0), beta=(1e-4, 1e-3))
    before, now = faint(pulse, 150), faint(steered_, 150)
    # What only the goal tells is 0.08 in the mean.
    assert before["kl"] < 0.5 and before["active"] <= 2
    assert 6.0 < now["kl"] < 10.0 and now["active"] >= 6
    assert now["action_error"] < 0.8 * before["action_error"]


def test_steps_across_a_reset_and_broken_worlds_teach_nothing():
    env = tracking_env(golf())
    losses, weights = [], []
    for poison in (0.0, 9.0):
        learner = Distiller(env, teacher(env), dataclasses.replace(SMALL, smooth=0.5, epochs=1))
        g = torch.Generator().manual_seed(5)
        obs = torch.randn(4, 8, 934, generator=g)
        label = 0.3 * torch.randn(4, 8, 69, generator=g)
        obs[2, 3] += poison
        label[2, 3] -= poison
        rollout = filled(learner, obs, label)
        rollout.valid[2, 3] = False
        losses.append(learner.update(rollout))
        weights.append({name: p.detach() for name, p in learner.nets.named_parameters()})
    for name, value in losses[0].items():
        assert torch.equal(value, losses[1][name]), name
    for name, value in weights[0].items():
        assert torch.equal(value, weights[1][name]), name
    # Smoothness is counted inside episodes alone.
    for ends in (False, True):
        learner = Distiller(env, teacher(env), dataclasses.replace(SMALL, smooth=0.5, epochs=1))
        obs = torch.randn(4, 8, 934, generator=torch.Generator().manual_seed(6))
        rollout = filled(learner, obs, torch.zeros(4, 8, 69))
        rollout.truncated.fill_(ends)
        smooth = float(learner.update(rollout)["smoothness"])
        assert smooth == 0.0 if ends else smooth > 0.1
    env.close()


def test_states_go_round():
    env = tracking_env(golf())
    obs = torch.randn(4, 8, 934, generator=torch.Generator().manual_seed(1))
    label = torch.randn(4, 8, 69, generator=torch.Generator().manual_seed(2)) * 0.2
    config = dataclasses.replace(SMALL, nats=(20.0, 8.0), pose=True, stiffness=0.5)
    one = Distiller(env, teacher(env), config)
    one.update(filled(one, obs, label))
    two = Distiller(env, teacher(env), config, seed=9)
    two.load_state_dict({k: v.clone() for k, v in one.state_dict().items()})
    told = [x.update(filled(x, obs, label)) for x in (one, two)]
    for name, value in told[0].items():
        assert torch.equal(value, told[1][name]), name
    other = teacher(env)
    other.metadata["sha256"] = "another"
    three = Distiller(env, other, SMALL)
    with pytest.raises(ValueError, match="learned from another tracker"):
        three.load_state_dict(one.state_dict())
    env.close()


def test_settings_that_cannot_be_are_refused():
    for wrong, words in (
        ({"latent": 0}, "at least 1"),
        ({"nats": (20.0, 0.0)}, "0 0 for a beta that is not steered"),
        ({"stiffness": -0.5}, "must not be negative"),
        ({"nats_share": 0.0}, "nats_share in"),
        ({"start_sigma": 0.0}, "must be positive"),
        ({"beta": (0.01, 0.0)}, "must be positive"),
        ({"fallen": 1.5}, r"lie in \[0, 1\]"),
        ({"push": -1.0}, "not be negative"),
    ):
        with pytest.raises(ValueError, match=words):
            PriorConfig(**wrong)
    with pytest.raises(ValueError, match="no option 'betta'"):
        options_of({"betta": 1})
    assert options_of({"beta": [0.1, 0.01]}).beta == (0.1, 0.01)
    env = tracking_env(golf())
    policy = teacher(env)
    policy.metadata["obs_size"] = 900
    with pytest.raises(PolicyError, match="obs_size 900"):
        Distiller(env, policy, SMALL)
    learner = Distiller(env, teacher(env), SMALL)
    with pytest.raises(ValueError, match="3 worlds cannot be cut into 4 minibatches"):
        learner.new_rollout(3)
    env.close()
