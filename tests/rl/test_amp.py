"""AMP in a rollout and in runs: windows, resets, a known optimum, resume, what it says it is."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from rl.amp import AMP, STATISTICS, AMPConfig
from rl.checkpoint import checkpoints, load_checkpoint
from rl.discriminator import style_reward
from rl.evaluate import evaluate
from rl.policy import PolicyError, export_policy, load_policy
from rl.ppo import PPO, PPOConfig
from rl.rollout import Rollout, collect
from rl.runlog import read_progress
from rl.style_features import Demonstrations
from rl.train import TrainConfig, train
from tests.rl.frames import Draws, step_result
from tests.rl.spring import STEPS, Spring, demonstrations, law, moved, starts
from tests.rl.test_train import same_bits
from warmstart.bank import demonstration_files

ROOT = Path(__file__).parents[2]
CPU = torch.device("cpu")
CLIP = next(f for f in demonstration_files("long_jump") if "5m" in f.name)
SMALL = AMPConfig(hidden=(16,), batch=32, steps=2, replay=60, replay_share=0.2, frames=4)


def shown(size: int, frames: int) -> Demonstrations:
    states = torch.randn(40, size, generator=torch.Generator().manual_seed(1))
    begins = torch.arange(41 - frames)
    return Demonstrations(states, begins, torch.ones(len(begins), dtype=torch.bool))


def test_windows_that_reach_over_a_reset_are_masked_and_others_are_what_was_seen():
    """Against a plain list of frames of each athlete, over three rollouts, 2 agents a world."""
    worlds, agents, steps, h = 5, 2, 6, 4
    rows = worlds * agents
    source = Draws(rows, 3, seed=2)
    config = dataclasses.replace(SMALL, combine="additive", style=0.5)
    amp = AMP(source, shown(3, h), rows, steps, config)
    g = torch.Generator().manual_seed(5)
    seen: list[list[torch.Tensor]] = [[] for _ in range(rows)]  # of the present episode
    masked = 0
    for _ in range(3):
        rollout = Rollout(steps, rows, 2, 2, CPU, torch.float32)
        rollout.reward.fill_(1.0)
        expected = torch.full((steps, rows), 1.0)
        for t in range(steps):
            source.draw()
            ended = torch.rand(worlds, generator=g) < 0.15
            valid = torch.rand(worlds, generator=g) < 0.9
            ended &= valid
            amp.watch(step_result(worlds, agents, 0.3, ended, valid))
            for row in range(rows):
                world = row // agents
                if not valid[world]:
                    seen[row] = []
                    continue
                seen[row].append(source.now[row].clone())
                if len(seen[row]) >= h:
                    window = amp.norm.normalize(torch.stack(seen[row][-h:])).flatten()
                    with torch.no_grad():
                        style = style_reward(amp.net(window)).squeeze(-1)
                    expected[t, row] += 0.5 * style / 8.0
                else:
                    masked += 1
                if ended[world]:
                    seen[row] = []
        amp.pay(rollout, scale=8.0)
        torch.testing.assert_close(rollout.reward, expected)
        told = amp.update()
        assert float(told["style/masked"]) == pytest.approx(
            float((expected == 1.0).float().mean()), abs=1e-6
        )
    assert masked > 10


def test_masked_windows_teach_nothing():
    """With every window masked the discriminator stays as it is, whatever it was shown."""
    source = Draws(6, 3, seed=2)
    config = dataclasses.replace(SMALL, weight_decay=0.0)
    amp = AMP(source, shown(3, 4), 6, 5, config)
    before = {k: v.clone() for k, v in amp.net.state_dict().items()}
    rollout = Rollout(5, 6, 2, 2, CPU, torch.float32)
    for _ in range(5):
        source.draw()
        amp.watch(step_result(6, 1, 1.0, ended=torch.ones(6, dtype=torch.bool)))
    amp.pay(rollout, 1.0)
    told = amp.update()
    assert (rollout.reward == 0.0).all()
    assert float(told["style/masked"]) == 1.0
    for name, x in amp.net.state_dict().items():
        assert torch.equal(x, before[name])


def test_demonstrations_are_drawn_by_kind_and_then_alike():
    kinds = torch.zeros(37, dtype=torch.bool)
    kinds[:2] = True  # two optimised windows among 35 captured ones
    some = dataclasses.replace(shown(3, 4), optimised=kinds)
    config = dataclasses.replace(SMALL, optimised_share=0.25)
    amp = AMP(Draws(6, 3, 0), some, 6, 5, config)
    counts = torch.bincount(amp.draw_demonstrations(40_000), minlength=37) / 40_000
    torch.testing.assert_close(counts[:2], torch.full((2,), 0.125), rtol=0.05, atol=0.0)
    torch.testing.assert_close(counts[2:], torch.full((35,), 0.75 / 35), rtol=0.15, atol=0.0)
    one = AMP(Draws(6, 3, 0), dataclasses.replace(some, optimised=kinds | True), 6, 5, config)
    assert len(one.draw_demonstrations(2000).unique()) == 37


def test_reported_share_is_that_of_the_reward():
    source = Draws(6, 3, seed=2)
    amp = AMP(source, shown(3, 4), 6, 5, dataclasses.replace(SMALL, combine="additive"))
    for _ in range(2):
        rollout = Rollout(5, 6, 2, 2, CPU, torch.float32)
        for _ in range(5):
            source.draw()
            amp.watch(step_result(6, 1, -0.7))
        amp.pay(rollout, 1.0)
        told = amp.update()
    style = float(rollout.reward.mean())
    assert float(told["style/share"]) == pytest.approx(style / (style + 0.7), rel=1e-5)
    assert float(told["style/reward"]) == pytest.approx(style / 0.2, rel=1e-5)


def test_a_policy_learns_the_law_that_the_demonstrations_obey():
    """Style is the only reward. In the end the motion from new starts is the demonstrations', and
    the discriminator cannot tell: its reward is near 2 log 2, which it was below before."""
    torch.manual_seed(0)
    hyper = PPOConfig(
        hidden=(32, 32),
        steps=16,
        minibatches=4,
        gamma=0.9,
        sigma=0.2,
        learning_rate=1e-3,
        critic_learning_rate=1e-3,
        kl_band=None,
    )
    config = AMPConfig(
        combine="additive",
        style=1.0,
        frames=4,
        hidden=(64, 32),
        batch=512,
        steps=4,
        replay=16384,
        replay_share=0.1,
        learning_rate=1e-3,
        gradient_penalty=0.5,
    )
    env, rows, turns = Spring(128, 1), 128, 80
    ppo = PPO(2, 1, hyper, seed=1)
    amp = AMP(env, demonstrations(4), rows, 16, config, seed=1)
    rollout, obs = ppo.new_rollout(rows), env.reset()
    fresh = starts(50, torch.Generator().manual_seed(7))

    @torch.no_grad()
    def distance() -> float:
        mine, theirs, squares = fresh, fresh, []
        for _ in range(STEPS):
            mine = moved(mine, ppo.actor(ppo.prepare(mine))[:, 0])
            theirs = moved(theirs, law(theirs))
            squares.append((mine - theirs).square().mean())
        return float(torch.stack(squares).mean().sqrt())

    paid = []
    for turn in range(turns):
        ppo.sigma.fill_(0.2 * 0.25 ** (turn / turns))
        obs = collect(env, ppo, rollout, obs, hyper.gamma, on_step=amp.watch)
        amp.pay(rollout, 1.0)
        if turn == 0:
            ppo.obs_norm.commit()
            assert distance() > 0.4
        else:
            ppo.update(rollout)
            paid.append(float(amp.update()["style/reward"]))
    assert distance() < 0.1
    assert min(paid[:30]) < 1.2 < paid[-1]
    assert paid[-1] == pytest.approx(2.0 * math.log(2.0), abs=0.12)


TINY = PPOConfig(hidden=(16, 16), steps=12, minibatches=2, epochs=2)


def run_config(out, **changes) -> TrainConfig:
    base = TrainConfig(
        task="long_jump",
        algo="amp",
        out=out,
        worlds=8,
        samples=4 * 96,
        seed=3,
        quiet=True,
        clips=(CLIP,),
        ppo=TINY,
        amp=SMALL,
    )
    return dataclasses.replace(base, **changes)


def test_a_resumed_run_repeats_the_uninterrupted_one_bit_for_bit(tmp_path):
    """Discriminator, its optimiser, replay, normaliser, unfinished windows, and the policy."""
    train(run_config(tmp_path / "whole"))

    class Interrupted(Exception):
        pass

    def stop(row):
        if row["iteration"] == 3:
            raise Interrupted

    with pytest.raises(Interrupted):
        train(run_config(tmp_path / "halves", checkpoint_iterations=2), on_iteration=stop)
    again = TrainConfig(task="long_jump", out=tmp_path / "halves", resume=True, quiet=True)
    assert train(again).iterations == 4
    same_bits(tmp_path / "whole", tmp_path / "halves")
    tensors = load_checkpoint(checkpoints(tmp_path / "halves")[-1])[1]
    for part in ("net.head.weight", "adam.head.weight.exp_avg", "replay.frames", "tail"):
        assert tensors[f"style/{part}"].abs().sum() > 0.0, part
    assert {"style/norm.total", "style/generator", "style/age"} <= set(tensors)


def test_what_a_run_says(tmp_path):
    """Log, card, evaluation and export say amp; a policy that is no actor here is refused."""
    run = tmp_path / "run"
    train(run_config(run, samples=2 * 96))
    rows = read_progress(run)
    with open(run / "progress.csv", newline="") as f:
        assert set(STATISTICS) <= set(next(csv.reader(f)))
    assert rows[0]["style/loss"] is None  # nothing is learned in the first
    assert 0.0 <= rows[1]["style/share"] < 1.0
    assert json.loads((run / "config.json").read_text())["config"]["amp"]["frames"] == 4
    policy = load_policy(str(run), "long_jump")
    assert policy.metadata["algo"] == "amp"
    found = evaluate(policy, "long_jump", trials=2, num_worlds=2)
    assert found.result["algo"] == "amp"
    file = export_policy(run, tmp_path / "exported")
    assert load_policy(file, "long_jump").metadata["algo"] == "amp"
    # a run of ppo may begin with it: the actor is of the same kind
    fine = run_config(tmp_path / "ppo", algo="ppo", amp=AMPConfig(), init=str(file), samples=96)
    assert train(fine).iterations == 1
    with pytest.raises(ValueError, match="algo 'amp' differs from the run's 'ppo'"):
        train(dataclasses.replace(fine, algo="amp", resume=True))
    card_path = file.with_suffix(".json")
    card_path.write_text(json.dumps({**json.loads(card_path.read_text()), "algo": "distillation"}))
    with pytest.raises(PolicyError, match="of algorithm 'distillation', which cannot be played"):
        load_policy(file, "long_jump")


def test_both_athletes_of_a_duel_are_paid_for_their_style(tmp_path):
    boxing = tuple(demonstration_files("boxing"))
    train(run_config(tmp_path, task="boxing", worlds=3, samples=2 * 72, clips=boxing))
    tensors = load_checkpoint(checkpoints(tmp_path)[-1])[1]
    assert tensors["style/tail"].shape[1] == tensors["style/age"].numel() == 6
    assert read_progress(tmp_path)[-1]["style/reward"] > 0.0


def test_two_ranks_share_one_discriminator(tmp_path):
    """gloo on the CPU: each has its own replay and windows, both the same network and features."""
    args = ["long_jump", "--algo", "amp", "--clips", str(CLIP), "--out", str(tmp_path)]
    args += ["--worlds", "4", "--samples", "288", "--quiet", "--ppo.hidden", "8"]
    args += ["--ppo.steps", "12", "--ppo.minibatches", "2", "--ppo.epochs", "1"]
    args += ["--amp.hidden", "16", "--amp.batch", "32", "--amp.frames", "4", "--device", "cpu"]
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [sys.executable, *launch, "-m", "rl.train", *args],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    one, two = (load_checkpoint(checkpoints(tmp_path)[-1], rank)[1] for rank in (0, 1))
    for name in one:
        same = name.startswith(("style/net.", "style/adam.", "style/norm.total"))
        if same:
            assert torch.equal(one[name], two[name]), name
    assert not torch.equal(one["style/replay.frames"], two["style/replay.frames"])
    assert float(one["style/adam.head.weight.step"]) > 0.0


def test_the_tracker_takes_no_style():
    with pytest.raises(ValueError, match="the tracker follows its clips"):
        TrainConfig(task="tracking", algo="amp")
