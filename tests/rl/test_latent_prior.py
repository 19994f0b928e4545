"""The latent prior as a file: what is written comes back, and whatever is not one is refused."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from rl import prior as priors
from rl.policy import PolicyError, load_policy
from rl.prior import (
    PriorError,
    body_digest,
    check_layout,
    find_prior,
    halved,
    load_prior,
    save_prior,
    self_layout,
)
from sports.env import make_env
from sports.frames import proprioception_slices
from sports.humanoid.body import load_body
from tests.rl.latent_made import made_prior


def observations(prior, seed: int = 1) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return 2.0 * torch.randn(40, 1, prior.nets.shape.obs_size, generator=g)


def test_a_prior_comes_back_to_the_last_bit(tmp_path):
    prior = made_prior()
    path = save_prior(prior, tmp_path / "p.anything", half=False)
    assert path.name == "p.safetensors"
    back, obs = load_prior(path), observations(prior)
    z = torch.randn(40, 1, 6, generator=torch.Generator().manual_seed(2))
    for one, two in (
        (prior.moments(obs), back.moments(obs)),
        (prior.posterior(obs), back.posterior(obs)),
        ((prior.decode(obs, z),), (back.decode(obs, z),)),
    ):
        for a, b in zip(one, two):
            assert torch.equal(a, b)
    assert back.digest == prior.digest == back.card["digest"]
    # Written again it is the same file.
    again = save_prior(back, tmp_path / "again", half=False)
    assert again.read_bytes() == path.read_bytes()


def test_fp16_keeps_three_digits_and_the_normaliser_whole(tmp_path):
    prior = made_prior()
    path = save_prior(prior, tmp_path / "half", half=True)
    tensors = load_file(path)
    kinds = {v.dtype for k, v in tensors.items() if not k.startswith("normalizer.")}
    assert kinds == {torch.float16} and tensors["normalizer.mean"].dtype == torch.float32
    back, obs = load_prior(path), observations(prior)
    for one, two in zip(prior.moments(obs), back.moments(obs)):
        torch.testing.assert_close(one, two, atol=5e-3, rtol=5e-3)
    z = torch.randn(40, 1, 6, generator=torch.Generator().manual_seed(2))
    one, two = prior.decode(obs, z), back.decode(obs, z)
    assert float((one - two).abs().max()) < 5e-3  # of an action of pi rad
    assert torch.equal(back.mean, prior.mean) and back.digest != prior.digest
    # A run's prior is what its file will be.
    assert halved(prior).digest == back.digest
    assert save_prior(back, tmp_path / "b", half=True).read_bytes() == path.read_bytes()


def test_the_file_alone_says_what_it_does(tmp_path):
    """By numpy, from the two files."""
    prior = made_prior()
    path = save_prior(prior, tmp_path / "p", half=False)
    w = {k: v.double().numpy() for k, v in load_file(path).items()}
    clip = json.loads(path.with_suffix(".json").read_text())["observation_clip"]
    obs = observations(prior)
    x = (obs.double().numpy() - w["normalizer.mean"]) / w["normalizer.std"]
    body = np.clip(x, -clip, clip)[..., :358]

    def net(name: str, x: np.ndarray, layers: int) -> np.ndarray:
        for i in range(layers):
            x = x @ w[f"{name}.trunk.{2 * i}.weight"].T + w[f"{name}.trunk.{2 * i}.bias"]
            x = x / (1 + np.exp(-x))
        return x @ w[f"{name}.head.weight"].T + w[f"{name}.head.bias"]

    moments = net("prior", body, 1)
    mean, sigma = (t.numpy() for t in prior.moments(obs))
    np.testing.assert_allclose(mean, moments[..., :6], atol=1e-5)
    np.testing.assert_allclose(sigma, np.exp(np.clip(moments[..., 6:], -5, 2) / 2), rtol=1e-4)
    z = np.random.default_rng(0).normal(size=(40, 1, 6))
    expected = net("decoder", np.concatenate([body, z], -1), 2)
    found = prior.decode(obs, torch.tensor(z).float()).numpy()
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_without_its_encoder_it_is_smaller_and_acts_alike(tmp_path):
    prior = made_prior()
    whole = save_prior(prior, tmp_path / "whole", half=True)
    part = save_prior(prior, tmp_path / "part", half=True, encoder=False)
    assert part.stat().st_size < 0.75 * whole.stat().st_size
    one, two, obs = load_prior(whole), load_prior(part), observations(prior)
    assert torch.equal(one.moments(obs)[0], two.moments(obs)[0])
    assert one.digest == two.digest  # so policies find either
    with pytest.raises(PriorError, match="without its encoder"):
        two.posterior(obs)


def test_nan_in_an_observation_counts_as_zero():
    prior, obs = made_prior(), observations(made_prior())
    broken, plain = obs.clone(), obs.clone()
    broken[:, :, 5], plain[:, :, 5] = torch.nan, 0.0
    assert torch.equal(prior.moments(broken)[0], prior.moments(plain)[0])


def test_what_is_no_prior_is_refused(tmp_path):
    path = save_prior(made_prior(), tmp_path / "p", half=False)
    card = json.loads(path.with_suffix(".json").read_text())

    def refused(words: str, **changes) -> None:
        path.with_suffix(".json").write_text(json.dumps({**card, **changes}))
        with pytest.raises(PriorError, match=words) as caught:
            load_prior(path)
        assert "\n" not in str(caught.value)

    refused("prior of another version", format="olympics-opt prior 0")
    refused("not the card of a prior", format="olympics-opt policy 1")
    refused("sha256 differs", sha256="0" * 64)
    refused("has been altered", digest="0" * 64)
    refused("made for another build of body 'smpl'", body_digest="0" * 64)
    refused("made for another build of body 'smplx'", body="smplx")
    refused("unknown body 'horse'", body="horse")
    refused("another layout", layout={**card["layout"], "root_height": [1, 2]})
    refused("sizes", latent=-3)
    refused("sizes", hidden={**card["hidden"], "decoder": [1 << 20]})
    refused("do not fit its card", latent=5)
    refused("altered|do not fit|not finite", observation_clip=0.0)
    path.with_suffix(".json").write_text(json.dumps(card))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(PriorError, match="no whole safetensors file"):
        load_prior(path)
    for place, words in ((tmp_path / "none", "there is no prior"), (tmp_path, "no checkpoint")):
        with pytest.raises(PriorError, match=words):
            load_prior(place)
    path.write_bytes(data)
    path.with_suffix(".json").unlink()
    with pytest.raises(PriorError, match="cannot be read"):
        load_prior(path)


def test_numbers_that_are_not_finite_are_refused(tmp_path):
    prior = made_prior()
    prior.nets.decoder.head.bias.data[3] = torch.nan
    path = save_prior(prior, tmp_path / "p", half=False)
    with pytest.raises(PriorError, match="not finite"):
        load_prior(path)
    prior.nets.decoder.head.bias.data[3] = 1e6
    with pytest.raises(PriorError, match="do not fit fp16"):
        save_prior(prior, tmp_path / "q", half=True)
    assert not (tmp_path / "q.safetensors").exists()


def test_a_prior_is_found_by_its_digest(tmp_path, monkeypatch):
    one, two = made_prior(), made_prior(seed=1)
    near, far = tmp_path / "near", tmp_path / "far"
    save_prior(one, near / "one", half=False)
    save_prior(two, far / "two", half=False)
    save_file({"x": torch.zeros(1)}, near / "alien.safetensors")
    assert find_prior(one.digest, [near]).digest == one.digest
    with pytest.raises(PriorError, match=r"needs the latent prior .* put the prior's two files"):
        find_prior(two.digest, [near])
    monkeypatch.setenv(priors.SEARCH, f"{tmp_path / 'nowhere'}:{far}")
    assert find_prior(two.digest, [near]).digest == two.digest
    monkeypatch.delenv(priors.SEARCH)
    monkeypatch.setattr(priors.pretrained, "FOLDER", tmp_path)
    shutil.move(far, tmp_path / "prior")
    assert find_prior(two.digest, [near]).digest == two.digest
    assert load_prior("pretrained").digest == two.digest


def test_bodies_are_told_apart_by_what_a_prior_knows_of_them():
    plain = body_digest(load_body("smpl"))
    assert plain != body_digest(load_body("smplx"))
    # Strength and equipment change how it fares, not what an action means.
    other = load_body("smpl", strength="human", equipment=("racket",))
    assert plain == body_digest(other)


@pytest.mark.parametrize("task", ["hurdling", "penalty_kick", "tennis", "boxing"])
def test_sports_show_the_body_as_the_tracker_does(task):
    env = make_env(task, num_worlds=1)
    check_layout(self_layout(24), env.obs_slices)
    assert proprioception_slices(24).items() <= env.obs_slices.items()
    moved = {**env.obs_slices, "body_rot": slice(0, 144)}
    with pytest.raises(PriorError, match="shows it elsewhere"):
        check_layout(self_layout(24), moved)
    env.close()


def test_a_prior_is_no_policy(tmp_path):
    path = save_prior(made_prior(), tmp_path / "p", half=False)
    with pytest.raises(PolicyError, match="not the card of a policy"):
        load_policy(path, "hurdling")


def test_the_shipped_prior_is_whole_and_small():
    """It stands by what it learned in ``balance``; tracker and prior together are at most 14 MB."""
    prior = load_prior("pretrained")
    assert prior.encoder and prior.steady is not None
    shipped = list(priors.pretrained.FOLDER.glob("*/*.safetensors"))
    own = [p.stat().st_size for p in shipped if p.parent.name in ("prior", "tracking")]
    assert len(own) == 2 and sum(own) <= 14e6
    assert sum(p.stat().st_size for p in shipped) <= 30e6
