"""A latent prior that learns to stay on its feet: what it learns is what it then plays."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rl.balance import BalanceConfig, advance, make_balance_env, steadied
from rl.latent_action import LatentActions, LatentConfig
from rl.policy import load_policy
from rl.ppo import PPOConfig
from rl.prior import PriorError, load_prior, save_prior
from rl.prior_play import Sampler, play_prior
from rl.train import TrainConfig, train
from sports.env import make_scene
from sports.task import View
from tests.rl.latent_made import golf_library, made_prior
from warmstart.library import load_library

SMALL = PPOConfig(hidden=(16,), steps=4, minibatches=2, epochs=2, learning_rate=1e-3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A prior that knows nothing, a clip, and a run in which it learns to balance."""
    place = tmp_path_factory.mktemp("balance")
    save_prior(made_prior(), place / "prior.safetensors", half=False)
    golf_library(place)
    train(run_config(place))
    return place


def run_config(folder: Path, **changes) -> TrainConfig:
    plain = {"worlds": 8, "samples": 3 * 8 * 4, "quiet": True, "options": {"split": "all"}}
    plain |= {"prior": str(folder / "prior.safetensors"), "clips": (folder / "golf.npz",)}
    plain |= {"out": folder / "run", "ppo": SMALL}
    return TrainConfig(task="balance", **{**plain, **changes})


def observations(count: int, size: int) -> torch.Tensor:
    return torch.randn(count, 1, size, generator=torch.Generator().manual_seed(3))


def test_the_mean_moves_by_what_the_policy_says(folder):
    """The policy of the run, read as any policy is, against the prior of the run."""
    before, after = load_prior(folder / "prior.safetensors"), load_prior(folder / "run")
    policy = load_policy(folder / "run", "balance")
    obs = observations(50, before.size)
    (mean, sigma), (moved, same) = before.moments(obs), after.moments(obs)
    torch.testing.assert_close(same, sigma, rtol=2e-3, atol=0)  # the run's is rounded to fp16
    torch.testing.assert_close((moved - mean) / sigma, policy(obs), rtol=0, atol=2e-2)
    assert policy(obs).abs().max() > 0.05


def test_what_it_learned_with_is_what_it_plays():
    """The action layer of the task, at the policy's noise, draws the latents of ``Sampler``."""
    prior = made_prior()
    how = LatentConfig("scaled", span=1.0)
    layer = LatentActions(prior, how, make_scene("long_jump"), (), "cpu")
    obs, noise = observations(20, prior.size), torch.randn(20, 1, prior.latent)
    mean, sigma = prior.moments(obs)
    torch.testing.assert_close(layer.latent(obs, noise), mean + sigma * noise)
    assert TrainConfig(task="balance", prior="x", ppo=SMALL).hyper.sigma == 1.0


def test_it_survives_its_file(folder, tmp_path):
    prior = load_prior(folder / "run")
    again = load_prior(save_prior(prior, tmp_path / "steady.safetensors", half=True))
    obs = observations(20, prior.size)
    for one, two in zip(prior.moments(obs), again.moments(obs)):
        torch.testing.assert_close(one, two, rtol=0, atol=0)
    assert again.digest == prior.digest != load_prior(folder / "prior.safetensors").digest
    card = json.loads((tmp_path / "steady.json").read_text())
    assert card["steady"]["learned"]["samples"] == 3 * 8 * 4
    library = load_library((folder / "golf.npz",))
    one, two = (
        play_prior(p, library, num_worlds=4, seconds=0.3, sampler=Sampler(), keep=4)
        for p in (prior, again)
    )
    assert (one.qpos == two.qpos).all()


def test_a_step_on_its_feet_pays_until_the_time_is_up(folder):
    """Latents of zero: the prior's mean, from frames of a golfer on his feet."""
    env = make_balance_env(run_config(folder, options={"split": "all", "seconds": 0.5}), 0, {})
    try:
        env.reset()
        ends = torch.zeros(8)
        for _ in range(15):
            result = env.step(torch.zeros(8, 1, env.action_size))
            standing = ~result.terminated[:, 0]
            assert result.reward[:, 0].tolist() == standing.float().tolist()
            assert result.metrics["success"].tolist() == standing.float().tolist()
            ends += result.truncated[:, 0]
        assert ends.tolist() == [1.0] * 8, "15 steps of 1/30 s each, begun at different ages"
    finally:
        env.close()


def test_a_finer_time_step_is_heard(folder):
    env = make_balance_env(run_config(folder, timestep_divisor=2), 0, {})
    try:
        scene = env.physics.scene
        assert (scene.timestep, scene.substeps) == (pytest.approx(1 / 240), 8)
    finally:
        env.close()


def test_it_may_begin_from_what_was_learned_before(folder, tmp_path):
    """With a rate of almost nothing the new run's prior is the old one's."""
    still = replace(SMALL, learning_rate=1e-12, kl_band=None)
    again = run_config(folder, out=tmp_path / "again", init=str(folder / "run"), ppo=still)
    train(again)
    one, two = load_prior(folder / "run"), load_prior(again.out)
    for name, weight in one.steady.net.state_dict().items():
        torch.testing.assert_close(two.steady.net.state_dict()[name], weight, rtol=0, atol=1e-6)


def test_lying_is_a_fall(folder):
    """Hand-made: the athlete of the first frame laid on its back."""
    env = make_balance_env(run_config(folder), 0, {})
    try:
        env.reset()
        state = env.physics.qpos.clone()
        state[:4, 2] = 0.15
        state[:4, 3:7] = torch.tensor([0.7071068, 0.0, 0.7071068, 0.0])
        everyone = torch.ones(8, dtype=torch.bool)
        env.physics.move(everyone, state, torch.zeros_like(env.physics.qvel))
        view: View = env.view
        view.refresh()
        view.clock = torch.full_like(view.clock, 2)  # nobody falls before
        step = advance(view, {})
        assert step.terminated[:4].all() and not step.terminated[4:].any()
        assert step.terms["upright"][:, 0].tolist() == [0.0] * 4 + [1.0] * 4
    finally:
        env.close()


def test_mistakes_are_told(folder, tmp_path):
    with pytest.raises(ValueError, match="give --prior"):
        run_config(folder, prior=None)
    with pytest.raises(ValueError, match="give --clips"):
        train(run_config(folder, clips=(), out=tmp_path / "a"))
    with pytest.raises(ValueError, match="strength 'paper'"):
        train(run_config(folder, strength="human", out=tmp_path / "b"))
    with pytest.raises(ValueError, match="leave --algo"):
        run_config(folder, algo="amp")
    with pytest.raises(ValueError, match=r"leave --ppo\.sigma out"):
        run_config(folder, ppo=replace(SMALL, sigma=0.3))
    with pytest.raises(ValueError, match="leave --keep-policies out"):
        run_config(folder, keep_policies=True)
    with pytest.raises(ValueError, match="seconds"):
        BalanceConfig(seconds=0.0)
    with pytest.raises(PriorError, match="learned to balance already"):
        train(run_config(folder, prior=str(folder / "run"), out=tmp_path / "c"))
    with pytest.raises(PriorError, match="cannot be used"):
        empty = tmp_path / "empty"
        empty.mkdir()
        save_prior(made_prior(), empty / "prior.safetensors", half=False)
        steadied(empty)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda card: card.pop("steady"),
        lambda card: card["steady"].update(hidden=[17]),
        lambda card: card["steady"].update(hidden="x"),
        lambda card: card["steady"].update(observation_clip=4.0),
        lambda card: card["steady"].update(activation="none"),
    ],
)
def test_an_altered_card_is_refused(folder, tmp_path, spoil):
    prior = load_prior(folder / "run")
    path = save_prior(prior, tmp_path / "p.safetensors", half=True)
    card = json.loads(path.with_suffix(".json").read_text())
    spoil(card)
    path.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(PriorError):
        load_prior(path)


def test_a_run_goes_on_bit_for_bit(folder, tmp_path):
    """And with the run's own copy of the prior alone."""
    whole = train(run_config(folder, out=tmp_path / "whole"))
    prior = save_prior(made_prior(), tmp_path / "prior.safetensors", half=False)
    part = run_config(folder, out=tmp_path / "part", prior=str(prior))
    train(part, part=0.4)
    prior.unlink()
    train(replace(part, resume=True))
    one, two = (load_prior(out) for out in (whole.out, part.out))
    assert one.digest == two.digest
