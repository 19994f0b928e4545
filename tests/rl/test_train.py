"""Runs: bit-for-bit resume, signals and kills, full disks, settings, several ranks."""

from __future__ import annotations

import csv
import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import rl.checkpoint
from rl.assembly import default_env, pays_alike
from rl.checkpoint import CheckpointError, checkpoints, load_checkpoint
from rl.config import config_from_dict
from rl.policy import PolicyError, load_policy
from rl.polish_config import Polish
from rl.ppo import PAPER, PPOConfig
from rl.runlog import read_progress
from rl.train import TrainConfig, main, parse_args, train
from rl.worlds import engine_options
from sports.env import make_env
from sports.physics.variation import Variation, draw
from sports.retries import Retries
from tests.rl.toy import SMALL, Integrator, toy_config, toy_env

ROOT = Path(__file__).parents[2]
OWN = Variation(own_share=0.5)
TIMES = {"minutes", "samples_per_s", "rollout_s", "update_s"}


def rows(run: Path) -> list[dict[str, str]]:
    """progress.csv as text, without what a clock says."""
    with open(run / "progress.csv", newline="") as f:
        return [{k: v for k, v in r.items() if k not in TIMES} for r in csv.DictReader(f)]


def last(run: Path) -> dict[str, torch.Tensor]:
    return load_checkpoint(checkpoints(run)[-1])[1]


def same_bits(a: Path, b: Path) -> None:
    left, right = last(a), last(b)
    assert set(left) == set(right)
    for name, x in left.items():
        torch.testing.assert_close(right[name], x, rtol=0, atol=0, equal_nan=True, msg=name)
    assert rows(a) == rows(b)


@pytest.mark.parametrize(
    ("task", "retries"), [("high_jump", 0.0), ("long_jump", 0.0), ("long_jump", 0.8)]
)
def test_a_resumed_run_repeats_the_uninterrupted_one_bit_for_bit(tmp_path, task, retries):
    small = PPOConfig(hidden=(16, 16), steps=12, minibatches=2, epochs=2, sigma_final=0.06)
    each = 12 * 12
    base = TrainConfig(task=task, worlds=12, samples=4 * each, seed=3, quiet=True, ppo=small)
    base = dataclasses.replace(base, retries=Retries(retries, (0.1, 0.45)))
    base = dataclasses.replace(base, torque_change=0.05, charge_limit=0.5)
    train(dataclasses.replace(base, out=tmp_path / "whole"))
    if retries:
        assert last(tmp_path / "whole")["env/failures/retried"].any()

    class Interrupted(Exception):
        pass

    def stop(row):
        if row["iteration"] == 3:  # after the checkpoint of iteration 2: that one is lost
            raise Interrupted

    halves = dataclasses.replace(base, out=tmp_path / "halves", checkpoint_iterations=2)
    with pytest.raises(Interrupted):
        train(halves, on_iteration=stop)
    assert len(rows(tmp_path / "halves")) == 3
    summary = train(TrainConfig(task=task, out=tmp_path / "halves", resume=True, quiet=True))
    assert (summary.iterations, summary.samples) == (4, 4 * each)
    same_bits(tmp_path / "whole", tmp_path / "halves")
    assert [r["iteration"] for r in read_progress(tmp_path / "halves")] == [1, 2, 3, 4]


def test_a_run_in_parts_is_the_run_in_one_piece(tmp_path):
    """Schedules too: they follow the whole run, not the part."""
    fading = dataclasses.replace(SMALL, sigma_final=0.1)
    train(toy_config(tmp_path / "whole", ppo=fading), environment=toy_env)
    parts = toy_config(tmp_path / "parts", ppo=fading, resume=True)
    for part, iterations in ((0.5, 2), (0.6, 3), (1.0, 4)):
        assert train(parts, environment=toy_env, part=part).iterations == iterations
    same_bits(tmp_path / "whole", tmp_path / "parts")


def start(out: Path, samples: int, *args: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.rl.toy", str(out), str(samples), *args]
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, env=env, text=True, stdout=pipe, stderr=pipe)


def wait_for(condition, process: subprocess.Popen[str]) -> None:
    while not condition():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


def test_kill_at_any_moment_then_resume_is_the_uninterrupted_run(tmp_path):
    train(toy_config(tmp_path / "whole", samples=30 * 1024), environment=toy_env)
    killed = tmp_path / "killed"
    process = start(killed, 10**9)
    wait_for(
        lambda: len(checkpoints(killed)) > 0 and checkpoints(killed)[-1].name > "step_0000004",
        process,
    )
    process.send_signal(signal.SIGKILL)
    assert process.wait(60) == -signal.SIGKILL
    done = json.loads((checkpoints(killed)[-1] / "state.json").read_text())["iteration"]
    assert done >= 5
    if done >= 30:
        pytest.skip("this machine was too quick to be killed in time")
    train(toy_config(killed, samples=30 * 1024, resume=True), environment=toy_env)
    same_bits(tmp_path / "whole", killed)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_saves_and_exits_0(tmp_path, number):
    process = start(tmp_path, 10**9)
    wait_for(lambda: (tmp_path / "progress.csv").is_file(), process)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert "stopped by signal" in out
    assert int(out.split()[-1]) == len(rows(tmp_path)) == int(checkpoints(tmp_path)[-1].name[5:])


def test_a_full_disk_ends_the_run_with_a_sentence(tmp_path, monkeypatch):
    real = os.fsync

    def fsync(handle: int) -> None:
        if len(checkpoints(tmp_path)) == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(handle)

    monkeypatch.setattr(rl.checkpoint.os, "fsync", fsync)
    with pytest.raises(CheckpointError, match="No space left on device"):
        train(toy_config(tmp_path, checkpoint_iterations=1), environment=toy_env)
    monkeypatch.undo()
    assert [p.name for p in checkpoints(tmp_path)] == ["step_0000001", "step_0000002"]
    summary = train(toy_config(tmp_path, resume=True), environment=toy_env)
    assert summary.iterations == 4


def test_stops_by_minutes_and_writes_what_ran(tmp_path):
    summary = train(toy_config(tmp_path, samples=None, minutes=0.01), environment=toy_env)
    assert summary.stopped_by == "minutes"
    data = json.loads((tmp_path / "config.json").read_text())
    assert data["config"]["ppo"]["hidden"] == [32, 32]
    assert {"commit", "versions", "hardware"} <= set(data)
    assert list((tmp_path / "tensorboard").glob("events*"))


def test_settings_that_contradict_a_run_are_refused(tmp_path):
    train(toy_config(tmp_path, samples=1024), environment=toy_env)
    with pytest.raises(ValueError, match="--resume"):
        train(toy_config(tmp_path), environment=toy_env)
    with pytest.raises(ValueError, match="worlds 32 differs from the run's 64"):
        train(toy_config(tmp_path, resume=True, worlds=32), environment=toy_env)
    with pytest.raises(ValueError, match="run of task 'toy'"):
        train(toy_config(tmp_path, resume=True, task="long_jump"), environment=toy_env)
    for bad in ({"worlds": 0}, {"minutes": -1.0}, {"start_probability": (0.5, 1.5)}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            TrainConfig(task="toy", **bad)
    with pytest.raises(ValueError, match="--paper"):
        TrainConfig(task="toy", paper=True, ppo=SMALL)


def test_a_command_line_resumes_a_run_with_the_runs_own_options(tmp_path, capsys):
    """The plain command line continues; the same option again is no contradiction."""
    out = ["high_jump", "--out", str(tmp_path / "run"), "--quiet"]
    levels = ["--task.levels", "0.4", "0.6", "--task.bar-height", "1.2"]
    small = ["--worlds", "2", "--ppo.hidden", "8", "--ppo.steps", "4", "--samples", "8"]
    assert main([*out, *small, *levels]) == 0
    for n, again in enumerate(([], ["--task.bar-height", "1.2"], levels), start=2):
        assert main([*out, "--resume", "--samples", str(8 * n), *again]) == 0
        own = json.loads((tmp_path / "run" / "config.json").read_text())["config"]["options"]
        assert (own["bar_height"], own["levels"]) == (1.2, [0.4, 0.6])
    assert [r["samples"] for r in read_progress(tmp_path / "run")] == [8, 16, 24, 32]
    capsys.readouterr()
    assert main([*out, "--resume", "--task.bar-height", "1.5"]) == 2
    assert "bar_height 1.5 differs from the run's 1.2" in capsys.readouterr().err


def test_fine_tuning_starts_from_the_policy(tmp_path):
    first = train(toy_config(tmp_path / "a", samples=8 * 1024), environment=toy_env)
    before = {k: v for k, v in last(tmp_path / "a").items() if k.startswith("agent/actor.")}
    frozen = dataclasses.replace(SMALL, hidden=(8,), learning_rate=0.0, kl_band=None)
    train(
        toy_config(tmp_path / "b", samples=2 * 1024, ppo=frozen, init=str(tmp_path / "a")),
        environment=toy_env,
    )
    after = last(tmp_path / "b")
    for name, x in before.items():  # with rate 0 the actor stays what it was, hidden sizes too
        assert torch.equal(after[name], x)
    counts = [float(last(tmp_path / n)["agent/obs_norm.total"][0]) for n in "ab"]
    assert counts[0] == first.samples
    assert counts[1] == pytest.approx(first.samples + 2 * 1024)
    with pytest.raises(PolicyError, match="task 'toy'"):
        train(TrainConfig(task="long_jump", out=tmp_path / "c", init=str(tmp_path / "a")))


@pytest.mark.parametrize(
    ("changes", "rests"),
    [
        ({}, False),
        ({"ppo": dataclasses.replace(SMALL, critic_warmup=3, gamma=0.9)}, True),
        ({"ppo": dataclasses.replace(SMALL, critic_warmup=3, sigma=0.2)}, False),
        ({"ppo": dataclasses.replace(SMALL, critic_warmup=0, gamma=0.9)}, False),
        ({"options": {"bar": 1.0}}, True),
        ({"seed": 5, "worlds": 32}, False),
    ],
)
def test_a_critic_learns_alone_first_where_something_else_is_paid(tmp_path, changes, rests):
    """A run that goes on from another: the actor stays what it was for two iterations, or not."""
    train(toy_config(tmp_path / "a", samples=2 * 1024), environment=toy_env)
    short = {"samples": 2 * 16 * changes.get("worlds", 64), "init": str(tmp_path / "a")}
    train(toy_config(tmp_path / "b", **short, **changes), environment=toy_env)
    before, after = (last(tmp_path / name) for name in "ab")
    for name in (name for name in before if name.startswith(("agent/actor.", "agent/critic."))):
        same = torch.equal(before[name], after[name])
        assert same == (rests and name.startswith("agent/actor.")), name


@pytest.mark.parametrize(
    "changes",
    [
        {"impact": 0.2},
        {"impact_limit": 3.0},
        {"sinking": 0.2},
        {"torque_change": 0.5},
        {"torque_change": 0.5, "torque_change_limit": 0.4},
        {"charge_limit": 0.5},
        {"imitation": 0.1},
        {"algo": "selfplay"},
        {"options": {"somersaults": False}},
    ],
)
def test_a_critic_knows_the_pay_that_it_learned_from_and_no_other(changes):
    config = TrainConfig(task="long_jump", impact=0.1, seed=2)
    card = json.loads(json.dumps({"config": dataclasses.asdict(config)}, default=str))
    assert pays_alike(card, dataclasses.replace(config, seed=3, worlds=7))
    assert not pays_alike(card, dataclasses.replace(config, **changes))
    since = ("torque_change", "torque_change_limit", "charge_limit")
    for name in since:  # a card of before there were these
        del card["config"][name]
    assert pays_alike(card, config)
    if set(changes) & set(since):
        assert not pays_alike(card, dataclasses.replace(config, **changes))


@pytest.mark.parametrize("moving", [False, True])
def test_an_actor_that_does_not_learn_stays_the_policy_it_began_as(tmp_path, moving):
    """With rate 0 in a world 3 m away, where observations are others: what it does is what the
    first policy does, unless the statistics of observations move under it. A resumed run too."""
    train(toy_config(tmp_path / "a", samples=4 * 1024), environment=toy_env)

    class Elsewhere(Integrator):
        def _draw(self):
            return super()._draw() + torch.tensor([3.0, 0.0])

    def elsewhere(config, seed):
        return Elsewhere(config.num_worlds, seed)

    still = dataclasses.replace(SMALL, learning_rate=0.0, kl_band=None, moving_statistics=moving)
    config = toy_config(tmp_path / "b", samples=4 * 1024, ppo=still, init=str(tmp_path / "a"))
    train(config, environment=elsewhere, part=0.5)
    again = dataclasses.replace(config, resume=True)
    train(again, environment=elsewhere)
    obs = torch.tensor([[[0.5, -0.2]], [[-0.9, 0.1]], [[3.0, 0.4]]])
    first, second = (load_policy(str(tmp_path / n), "toy")(obs) for n in "ab")
    assert torch.allclose(first, second, rtol=0, atol=1e-6) is not moving
    assert float(last(tmp_path / "b")["agent/obs_norm.total"][0]) == 8 * 1024


def test_command_line():
    config = parse_args(["high_jump", "--worlds", "8", "--task.bar-height", "1.2", "--paper"])
    assert (config.task, config.worlds, config.options["bar_height"]) == ("high_jump", 8, 1.2)
    assert config.hyper == PAPER
    words = ["--vary", "--variation.friction", "0.8", "1.2", "--variation.own-share", "0.3"]
    config = parse_args(["long_jump", *words])
    assert config.variation == Variation(friction=(0.8, 1.2), own_share=0.3)
    stored = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    assert config_from_dict(stored).variation == config.variation
    words = ["--retries.share", "0.8", "--retries.seconds", "1", "4", "--retries.even"]
    config = parse_args(["long_jump", *words])
    assert config.retries == Retries(0.8, (1.0, 4.0), even=True)
    stored = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    assert config_from_dict(stored).retries == config.retries
    del stored["retries"]  # of an older version
    assert config_from_dict(stored).retries == Retries()
    config = parse_args(["long_jump", "--ppo.sigma", "0.1", "--strength", "human"])
    assert (config.ppo.sigma, config.strength) == (0.1, "human")


@pytest.mark.parametrize("args", [["chess"], [], ["long_jump", "--init", "nowhere"]])
def test_mistakes_exit_with_2_and_a_sentence(args, capsys, tmp_path):
    assert main([*args, *(["--out", str(tmp_path)] if args else [])]) == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_two_ranks_learn_what_one_process_learns_from_both_batches(tmp_path):
    """gloo on the CPU: gradients, divergence and statistics merge; only rank 0 writes."""
    script = str(Path(__file__).with_name("ranks.py"))
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *launch, script, str(tmp_path)],
        cwd=ROOT,
        env=env,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    from tests.rl.ranks import learn

    learn(tmp_path / "one.json", slice(None))
    one, rank0, rank1 = (
        json.loads((tmp_path / f"{n}.json").read_text()) for n in ("one", "rank0", "rank1")
    )
    assert rank0 == rank1
    for name, values in one.items():
        torch.testing.assert_close(
            torch.tensor(rank0[name]), torch.tensor(values), rtol=1e-4, atol=2e-6, msg=name
        )
    # and whole runs: one log, resumable, both ranks' worlds counted
    assert [r["samples"] for r in read_progress(tmp_path / "run")] == [2048, 4096, 6144, 8192]
    files = {p.name for p in checkpoints(tmp_path / "run")[-1].iterdir()}
    assert {"rank0.json", "rank1.json", "state.json"} <= files
    state = [load_checkpoint(checkpoints(tmp_path / "run")[-1], r)[1] for r in (0, 1)]
    assert torch.equal(state[0]["agent/actor.head.weight"], state[1]["agent/actor.head.weight"])
    assert not torch.equal(state[0]["env/x"], state[1]["env/x"])


@pytest.mark.parametrize(
    ("precision", "sigma", "final", "multiplies"),
    [
        ("auto", 0.12, None, None),
        ("auto", 0.12, 0.05, None),
        ("auto", 0.12, 0.04, False),
        ("auto", 0.02, None, False),
        ("bfloat16", 0.02, None, True),
        ("float32", 0.12, None, False),
    ],
)
def test_bfloat16_is_for_noise_that_hides_its_rounding(precision, sigma, final, multiplies):
    """A mean action of bfloat16 may be off by 4e-4, a fiftieth of a sigma of 0.02 in each of 69."""
    ppo = PPOConfig(sigma=sigma, sigma_final=final)
    assert TrainConfig(task="long_jump", precision=precision, ppo=ppo).bf16 is multiplies


@pytest.mark.parametrize("vary", [False, True])
def test_felt_damping_reaches_the_worlds(vary):
    """The engine of such a run moves as one that was asked for it; with ``vary`` all worlds do."""
    config = TrainConfig("long_jump", worlds=4, seed=2, vary=vary, felt_damping=True)
    options = {"variation": Variation(felt_share=1.0), "variation_seed": 2} if vary else {}
    moved = []
    for env in (
        default_env(config, 2),
        make_env(
            "long_jump", num_worlds=4, seed=2, physics_options=options | {"felt_damping": True}
        ),
        make_env("long_jump", num_worlds=4, seed=2),
    ):
        generator = torch.Generator().manual_seed(1)
        for _ in range(8):
            env.step(0.2 * torch.randn(4, 1, env.action_size, generator=generator))
        moved.append(env.physics.qpos.clone())
        env.close()
    assert torch.equal(moved[0], moved[1])
    assert not torch.equal(moved[0], moved[2])


def test_a_share_of_own_worlds_reaches_the_worlds():
    """They move as those of a run that does not vary, bit for bit; the others do not."""
    config = TrainConfig("long_jump", worlds=8, seed=2, vary=True, variation=OWN)
    moved = []
    for each in (config, TrainConfig("long_jump", worlds=8, seed=2)):
        env = default_env(each, 2)
        generator = torch.Generator().manual_seed(1)
        for _ in range(4):
            env.step(0.2 * torch.randn(8, 1, env.action_size, generator=generator))
        moved.append(env.physics.qpos.clone())
        substeps = env.physics.scene.substeps
        env.close()
    own = torch.tensor(draw(OWN, 8, substeps, 2).own)
    assert 2 <= int(own.sum()) <= 6
    assert torch.equal((moved[0] == moved[1]).all(1), own)


def test_like_drake_is_short_for_worlds_with_feet_that_stick():
    """Of its four options on the command line, and for evaluations and searches alike."""
    words = "--vary --variation.friction 0.8 1.25 --variation.felt-share 0.8"
    words += " --variation.cone-share 1 --variation.impratio 2 40 --timestep-divisor 2"
    long = engine_options(parse_args(["long_jump", *words.split()]), 5)
    short = engine_options(parse_args(["long_jump", "--like-drake", "--timestep-divisor", "2"]), 5)
    assert short == long and short["variation"].own_stride == 2
    search = Polish("long_jump", "zero", Path("x"), minutes=1, like_drake=True, timestep_divisor=2)
    assert engine_options(search, 5) == long
    assert not engine_options(parse_args(["long_jump"]), 5)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (dict(like_drake=True, vary=True), "leave --vary, the --variation options and"),
        (dict(like_drake=True, felt_damping=True), "and --felt-damping out"),
        (dict(variation=OWN, like_drake=True), "leave --vary, the --variation options and"),
        (dict(engine="drake", timestep_divisor=2), "drake has time steps of its own"),
        (dict(engine="drake", vary=True), "drake has worlds of its own"),
        (dict(engine="drake", like_drake=True), "drake has worlds of its own"),
        (dict(engine="drake", felt_damping=True), "always feel the joints' damping in drake"),
        (dict(variation=OWN), "give --vary as well"),
        (dict(variation=Variation(own_stride=2), vary=True), "is the timestep-divisor"),
        (dict(variation=OWN, vary=True, felt_damping=True), "leave --variation.own-share"),
    ],
)
def test_worlds_that_cannot_be_are_refused(given, words):
    with pytest.raises(ValueError, match=words):
        TrainConfig("long_jump", **given)


@pytest.mark.parametrize(
    "given", [dict(clone=5, clips=(Path("x.npz"),)), dict(algo="selfplay", task="boxing")]
)
def test_retries_are_for_one_athlete_who_learns_by_trying(given):
    with pytest.raises(ValueError, match=r"leave --retries\.share out"):
        TrainConfig(**{"task": "javelin", "retries": Retries(0.5)} | given)
