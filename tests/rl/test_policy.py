"""Policy files: what is exported comes back, and whatever is not a policy is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file

from rl import pretrained
from rl.policy import PolicyError, export_policy, load_policy
from rl.rollout import collect
from rl.train import train
from tests.rl.toy import Integrator, toy_config, toy_env


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("policy") / "run"
    train(toy_config(folder, samples=4 * 1024), environment=toy_env)
    return folder


@pytest.fixture(scope="module")
def file(run) -> Path:
    return export_policy(run, run.parent / "ppo-paper", looks="a mass that comes to rest")


def test_export_and_load_are_the_learners_mean_action(run, file):
    obs = torch.randn(50, 1, 2) * 3.0
    whole, half = load_policy(run, "toy")(obs), load_policy(file, "toy")(obs)
    assert whole.shape == (50, 1, 1)
    torch.testing.assert_close(whole, half, atol=2e-3, rtol=2e-3)  # fp16 keeps three digits
    # by numpy, from the file alone
    weights = {k: v.double().numpy() for k, v in load_file(file).items()}
    card = json.loads(file.with_suffix(".json").read_text())
    x = (obs.double().numpy() - card["obs_mean"]) / card["obs_std"]
    x = np.clip(x, -5, 5)
    for layer in ("trunk.0", "trunk.2"):
        x = x @ weights[f"{layer}.weight"].T + weights[f"{layer}.bias"]
        x = x / (1 + np.exp(-x))
    x = x @ weights["head.weight"].T + weights["head.bias"]
    np.testing.assert_allclose(half.numpy(), x, atol=1e-5)


def test_the_card_says_what_it_is(file):
    card = load_policy(file, "toy").metadata
    assert (card["task"], card["algo"], card["strength"]) == ("toy", "ppo", "paper")
    assert card["samples"] == 4096
    assert card["obs_layout"] == {"state": [0, 2]}
    assert card["looks"] == "a mass that comes to rest"
    for name in ("config", "minutes", "hardware", "commit", "versions", "metrics", "sha256"):
        assert card[name], name
    assert load_file(file)["head.weight"].dtype == torch.float16
    assert str(file.parent) not in file.with_suffix(".json").read_text()


def test_a_loaded_policy_behaves_as_in_training(run):
    """The mean action that training stored for an observation is what the loaded policy gives."""
    from rl.checkpoint import checkpoints, load_checkpoint
    from rl.ppo import PPO
    from tests.rl.toy import SMALL

    agent = PPO(2, 1, SMALL)
    tensors = load_checkpoint(checkpoints(run)[-1])[1]
    agent.load_state_dict(
        {k.removeprefix("agent/"): v for k, v in tensors.items() if k.startswith("agent/")}
    )
    env, rollout, seen = Integrator(8, seed=5), agent.new_rollout(8), []
    policy = load_policy(run, "toy")
    obs = env.reset()
    seen.append(policy(obs))
    collect(env, agent, rollout, obs, 0.9, on_step=lambda r: seen.append(policy(r.obs)))
    torch.testing.assert_close(torch.stack(seen[:-1])[:, :, 0], rollout.mean)


def test_a_critic_travels_along_where_asked(run, tmp_path):
    from rl.ppo import PPO
    from tests.rl.toy import SMALL

    whole = load_policy(run, "toy")
    path = export_policy(run, tmp_path / "with", critic=True)
    policy = load_policy(path, "toy")
    obs = torch.randn(20, 2)
    torch.testing.assert_close(policy(obs), whole(obs), atol=2e-3, rtol=2e-3)
    agents = [PPO(2, 1, SMALL, seed=s) for s in (1, 2)]
    assert all(agent.load_critic(p.extra) for agent, p in zip(agents, (policy, whole)))
    values = [agent.value(obs) for agent in agents]
    torch.testing.assert_close(values[0], values[1], atol=1e-2, rtol=1e-2)
    alone = load_policy(export_policy(run, tmp_path / "without"), "toy")
    assert not agents[0].load_critic(alone.extra)


def refuse(source: object, match: str, task: str = "toy") -> None:
    with pytest.raises(PolicyError, match=match) as caught:
        load_policy(source, task)  # type: ignore[arg-type]
    assert len(str(caught.value).splitlines()) == 1 or "Error(s)" in str(caught.value)


def copy(file: Path, folder: Path, **changes: object) -> Path:
    card = json.loads(file.with_suffix(".json").read_text())
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(file, folder / "p.safetensors")
    card |= changes
    card = {k: v for k, v in card.items() if v is not ...}
    (folder / "p.json").write_text(json.dumps(card))
    return folder / "p.safetensors"


def test_what_is_no_policy_is_refused(file, tmp_path):
    refuse(tmp_path / "nothing", "there is no policy")
    refuse(tmp_path, "no checkpoint yet")
    refuse(file, "is of task 'toy', not of 'long_jump'", task="long_jump")
    refuse("pretrained:magic", "no pretrained policy 'magic'")
    (tmp_path / "text.safetensors").write_text("hello")
    refuse(tmp_path / "text.safetensors", "no whole safetensors file")
    alone = shutil.copy(file, tmp_path / "alone.safetensors")
    refuse(alone, "card .* cannot be read")
    for change, match in (
        ({"format": "x"}, "not the card"),
        ({"sha256": "0"}, "sha256 differs"),
        ({"hidden": ...}, "'hidden'"),
        ({"obs_size": "2"}, "'obs_size'"),
        ({"obs_size": 3}, "do not fit|not finite"),
        ({"hidden": [10**9]}, "impossible layer sizes"),
        ({"hidden": [-1]}, "impossible layer sizes"),
        ({"activation": "step"}, "step"),
        ({"obs_std": [0.0, 1.0]}, "not finite"),
        ({"obs_mean": [None, 1.0]}, "do not fit"),
        ({"obs_mean": [1.0]}, "not finite"),
    ):
        refuse(copy(file, tmp_path / "changed", **change), match)


def test_foreign_and_broken_weights_are_refused(file, tmp_path):
    import hashlib

    weights = load_file(file)
    for name, change in (
        ("fewer", {k: v for k, v in weights.items() if k != "head.bias"}),
        ("wider", {**weights, "head.weight": torch.zeros(5, 32)}),
        ("nan", {**weights, "head.bias": torch.tensor([float("nan")])}),
    ):
        path = copy(file, tmp_path / name)
        save_file(change, path)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        card = json.loads(path.with_suffix(".json").read_text()) | {"sha256": digest}
        path.with_suffix(".json").write_text(json.dumps(card))
        refuse(path, "do not fit|not finite")


@given(st.data())
def test_torn_files_are_refused(file, tmp_path_factory, data):
    path = copy(file, tmp_path_factory.mktemp("torn"))
    victim = data.draw(st.sampled_from([path, path.with_suffix(".json")]))
    content = bytearray(victim.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        content = bytearray(data.draw(st.binary(max_size=300)))
    victim.write_bytes(content)
    with pytest.raises(PolicyError):
        load_policy(path, "toy")


def test_a_policy_of_another_layout_is_refused(run):
    policy = load_policy(run, "toy")
    env = Integrator(2)
    policy.check(env)
    env.obs_slices = {"velocity": slice(0, 2)}
    with pytest.raises(PolicyError, match="layout"):
        policy.check(env)
    env.obs_size = 3
    with pytest.raises(PolicyError, match="obs_size 2"):
        policy.check(env)


def test_baselines():
    env = Integrator(3)
    obs = env.reset()
    zero, random = load_policy("zero", "toy"), load_policy("random", "toy")
    for policy in (zero, random):
        policy.check(env)
    assert not zero(obs).any()
    first = random(obs)
    assert first.abs().max() <= 1.0
    assert not torch.equal(first, random(obs))
    random.seed(0)
    assert torch.equal(first, random(obs))


def test_pretrained_are_found_by_algorithm_and_strength(file, tmp_path, monkeypatch):
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    for strength in ("human", "paper"):
        copy(file, tmp_path / "toy")
        for suffix in (".safetensors", ".json"):
            (tmp_path / "toy" / f"p{suffix}").rename(tmp_path / "toy" / f"ppo-{strength}{suffix}")
    assert [p["strength"] for p in pretrained.available()] == ["human", "paper"]
    assert pretrained.locate("toy").stem == "ppo-paper"
    assert pretrained.locate("toy", "ppo-human").stem == "ppo-human"
    assert load_policy("pretrained:ppo-human", "toy").metadata["task"] == "toy"
    refuse("pretrained:amp", r"shipped: pretrained:ppo-human, pretrained:ppo-paper")
    for suffix in (".safetensors", ".json"):  # one more of an algorithm is found by its own name
        path = tmp_path / "toy" / f"ppo-paper{suffix}"
        path.rename(path.with_stem("ppo-varied-paper"))
    assert [(p["algo"], p["name"]) for p in pretrained.available()][1] == ("ppo", "ppo-varied")
    assert pretrained.locate("toy", "ppo-varied").stem == "ppo-varied-paper"
    assert pretrained.locate("toy").stem == "ppo-human"
    refuse("pretrained:ppo-paper", r"shipped: pretrained:ppo-human, pretrained:ppo-varied-paper")


def test_shipped_policies_load_and_are_what_their_names_say():
    for entry in pretrained.available():
        policy = load_policy(entry["path"], entry["task"])
        card = policy.metadata
        assert card["strength"] == entry["strength"]
        assert card["algo"] == entry["algo"]
        assert Path(entry["path"]).stat().st_size < 15 * 2**20
