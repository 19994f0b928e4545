"""Fine-tuning: what it takes from a card, which candidate it keeps, and that it can be stopped."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import rl.train
from olympics_opt.fine_tune import POLICY, FineTuning, fine_tune, hyper_parameters
from rl.checkpoint import checkpoints
from rl.policy import load_policy
from rl.ppo import PPOConfig
from rl.train import TrainConfig, train

SMALL = PPOConfig(
    hidden=(16, 8), activation="relu", steps=4, minibatches=1, epochs=1, gamma=0.97, sigma=0.2
)
QUICK = FineTuning(steps=4, minibatches=1, epochs=1, critic_warmup=0, shares=(0.4, 0.7, 1.0))


@pytest.fixture(scope="module")
def shipped(tmp_path_factory) -> Path:
    """A run at strength human with a network, a horizon and a noise of its own."""
    out = tmp_path_factory.mktemp("shipped") / "run"
    ppo = dataclasses.replace(SMALL, sigma_final=0.03)
    train(TrainConfig("long_jump", out, worlds=2, samples=8, strength="human", ppo=ppo, quiet=True))
    return out


def tuned(shipped: Path, folder: Path) -> TrainConfig:
    return TrainConfig(
        "long_jump", folder / "run", worlds=4, minutes=0.02, seed=3, init=str(shipped), quiet=True
    )


def test_the_cards_own_network_and_horizon_and_no_more_than_its_last_noise(shipped: Path):
    card = load_policy(shipped, "long_jump").metadata
    ppo = hyper_parameters(card, FineTuning())
    assert (ppo.hidden, ppo.activation, ppo.gamma, ppo.sigma) == ((16, 8), "relu", 0.97, 0.03)
    assert ppo.kl_band is None  # the rate is what it is told to be
    card = {**card, "config": {"ppo": {**card["config"]["ppo"], "sigma_final": None}}}
    assert hyper_parameters(card, FineTuning(sigma=0.06)).sigma == 0.06
    for foreign in (None, "?", {"ppo": None}):
        assert hyper_parameters({**card, "config": foreign}, FineTuning(sigma=0.06)).sigma == 0.06


def test_the_best_candidate_is_kept_by_other_trials_than_those_reported(
    shipped: Path, tmp_path: Path, monkeypatch
):
    """Success decides, then the return; the file that is kept is the candidate's."""
    scores = iter([(0.8, 9.0), (0.9, 1.0), (0.9, 2.0)])
    seeds, files = [], []

    def play(task, policy, *, trials, seed, options, label):
        seeds.append(seed)
        files.append(Path(policy))
        success, value = next(scores)
        result = {"metrics": {"success": {"mean": success}}}
        return SimpleNamespace(result=result, trials={"return": np.full(trials, value)})

    monkeypatch.setattr("olympics_opt.play.play", play)
    facts = fine_tune(tuned(shipped, tmp_path), tmp_path, QUICK)
    assert len(files) == len(facts["candidates"]) == 3
    assert facts["kept"] == 2 and facts["candidates"][2]["return"] == 2.0
    assert (tmp_path / POLICY).read_bytes() == files[2].read_bytes()
    assert set(seeds) == {facts["selection"]["seed"]} and 3 not in seeds
    json.dumps(facts)
    policy = load_policy(tmp_path / POLICY, "long_jump").metadata
    assert (policy["strength"], policy["hidden"]) == ("human", [16, 8])
    iterations = [c["iteration"] for c in facts["candidates"]]
    assert iterations == sorted(set(iterations)) and iterations[-1] == facts["iterations"]


def test_a_stopped_fine_tuning_continues(shipped: Path, tmp_path: Path, monkeypatch):
    """Asked to stop in its second part; the same call then finishes with all candidates."""
    real, calls = rl.train.train, []

    def stopping(config: TrainConfig, part: float):
        summary = real(config, part=part)
        calls.append(summary)
        if len(calls) == 2:
            return dataclasses.replace(summary, stopped_by="signal")
        return summary

    monkeypatch.setattr("rl.train.train", stopping)
    config = tuned(shipped, tmp_path)
    quick = dataclasses.replace(QUICK, trials=1)
    with pytest.raises(KeyboardInterrupt):
        fine_tune(config, tmp_path, quick)
    assert not (tmp_path / POLICY).exists()
    done = checkpoints(config.out)[-1].name
    facts = fine_tune(config, tmp_path, quick)
    assert (tmp_path / POLICY).is_file()
    assert int(done[5:]) <= facts["iterations"] == int(checkpoints(config.out)[-1].name[5:])
    assert facts["minutes"] >= config.minutes
