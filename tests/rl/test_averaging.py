"""The mean of policies: by numpy from the files alone, and through other statistics."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from rl.averaging import mean_policy
from rl.policy import Policy, PolicyError, export_policy, load_policy, read_policy
from rl.train import train
from tests.rl.toy import toy_config, toy_env


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> list[Path]:
    """Policies of one run at four times."""
    run = tmp_path_factory.mktemp("mean") / "run"
    config = toy_config(run, samples=4 * 1024)
    config = dataclasses.replace(config, checkpoint_iterations=1, keep_policies=True)
    train(config, environment=toy_env)
    return sorted((run / "policies").glob("*.safetensors"))


def test_a_run_keeps_the_policy_of_every_checkpoint(kept):
    run = kept[0].parent.parent
    assert [int(path.stem) for path in kept] == [1024, 2048, 3072, 4096]
    assert [load_policy(path, "toy").metadata["samples"] for path in kept] == [
        int(path.stem) for path in kept
    ]
    obs = torch.randn(50, 1, 2)
    last, whole = load_policy(kept[-1], "toy"), load_policy(run, "toy")
    torch.testing.assert_close(last(obs), whole(obs), atol=2e-3, rtol=2e-3)  # fp16
    early = load_policy(kept[0], "toy")
    assert (early(obs) - whole(obs)).abs().max() > 1e-2
    assert last.extra and set(last.extra) == set(whole.extra)


def test_the_mean_is_that_of_the_files_numbers(kept, tmp_path):
    """With statistics that are the same, every weight is the mean in shares of three and one."""
    files = [renormed(kept[i], kept[0], tmp_path / str(i)) for i in (1, 3)]
    mean = mean_policy([read_policy(f, "") for f in files], (3.0, 1.0))
    one, two = (load_file(f) for f in files)
    assert mean.actor is not None
    weights = {**mean.actor.state_dict(), **mean.extra}
    assert set(weights) == set(one)
    for name, value in weights.items():
        if value.dtype != torch.bool:
            wanted = 0.75 * one[name].astype(np.float64) + 0.25 * two[name].astype(np.float64)
            np.testing.assert_allclose(value.double().numpy(), wanted, atol=1e-6, rtol=1e-6)
    assert [a["share"] for a in mean.metadata["averaged"]] == [0.75, 0.25]
    path = export_policy(mean, tmp_path / "mean", critic=True)
    obs = torch.randn(50, 1, 2)
    again = load_policy(path, "toy")
    torch.testing.assert_close(again(obs), mean(obs), atol=2e-3, rtol=2e-3)
    assert again.metadata["averaged"] == mean.metadata["averaged"]


def test_of_one_policy_it_is_that_policy_whatever_statistics_a_copy_reads_by(kept):
    """A copy that reads observations otherwise, and makes up for it, is the same function."""
    own = read_policy(kept[-1], "")
    other = read_policy(kept[-1], "")
    scale, shift = torch.tensor([2.0, 0.7]), torch.tensor([0.3, -0.2])
    other.std, other.mean = own.std * scale, own.mean + shift
    assert other.actor is not None
    first = other.actor.trunk[0]
    with torch.no_grad():  # x / s = (x - d) / (s k) * k + d / s
        for w, b in (
            (first.weight, first.bias),
            (other.extra["critic.trunk.0.weight"], other.extra["critic.trunk.0.bias"]),
        ):
            b += w @ (shift / own.std)
            w *= scale
    obs = 0.2 * torch.randn(100, 1, 2) + own.mean  # where nothing is clipped
    torch.testing.assert_close(other(obs), own(obs), atol=1e-5, rtol=1e-5)
    for policies in ((own, other), (other, own)):
        mean = mean_policy(policies, (1.0, 2.0))
        torch.testing.assert_close(mean(obs), own(obs), atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(mean.mean, policies[0].mean)
        for name in ("critic.trunk.0.weight", "critic.trunk.0.bias"):
            torch.testing.assert_close(
                mean.extra[name], policies[0].extra[name], atol=1e-5, rtol=1e-5
            )


def test_without_a_critic_in_each_there_is_none_in_the_mean(kept, tmp_path):
    bare = export_policy(kept[0], tmp_path / "bare")
    assert not mean_policy([read_policy(bare, ""), read_policy(kept[1], "")]).extra


def test_what_is_not_of_one_kind_is_refused(kept, tmp_path):
    policies = [read_policy(kept[0], ""), read_policy(kept[1], "")]
    for name, value in (("task", "other"), ("hidden", [4]), ("strength", "human")):
        strange = dataclasses.replace(policies[1], metadata={**policies[1].metadata, name: value})
        with pytest.raises(PolicyError, match=f"differ in {name}"):
            mean_policy([policies[0], strange])
    with pytest.raises(PolicyError, match="is a baseline"):
        mean_policy([policies[0], read_policy("zero", "toy")])


@pytest.mark.parametrize(
    "shares, told",
    [
        ((1.0,), "2 policies need as many shares"),
        ((1.0, -0.1), "must not be negative"),
        ((0.0, 0.0), "must not be negative, and not all 0"),
        ((float("nan"), 1.0), "must not be negative"),
    ],
)
def test_shares_that_cannot_be_are_refused(kept, shares, told):
    policies = [read_policy(kept[0], ""), read_policy(kept[1], "")]
    with pytest.raises(ValueError, match=told):
        mean_policy(policies, shares)
    with pytest.raises(ValueError, match="two policies or more"):
        mean_policy(policies[:1])


def test_a_state_that_comes_twice_counts_once_unless_shares_say_otherwise(kept):
    """The run's own last state is that of its last file; which comes first gives the card."""
    last = read_policy(kept[0].parent.parent, "")
    files = [read_policy(path, "") for path in kept]
    mean = mean_policy([last, *files])
    counted = [(a["samples"], a["share"]) for a in mean.metadata["averaged"]]
    assert counted == [(4096, 0.25), (1024, 0.25), (2048, 0.25), (3072, 0.25)]
    assert mean.metadata["averaged"][0]["sha256"] == last.metadata["sha256"]
    heavy = mean_policy([last, files[-1], files[0]], (1.0, 1.0, 2.0))
    assert [a["share"] for a in heavy.metadata["averaged"]] == [0.25, 0.25, 0.5]
    with pytest.raises(ValueError, match="that differ"):
        mean_policy([last, files[-1]])
    polished = dataclasses.replace(last, metadata={**last.metadata, "polish": {"of": "it"}})
    assert len(mean_policy([last, polished]).metadata["averaged"]) == 2  # of as many samples


def renormed(path: Path, like: Path, out: Path) -> Path:
    """A copy of a policy that has the statistics of another."""
    card = json.loads(like.with_suffix(".json").read_text())
    policy: Policy = read_policy(path, "")
    policy.metadata |= {k: card[k] for k in ("obs_mean", "obs_std")}
    return export_policy(policy, out, critic=True)
