"""Latent priors in the training loop: distilled, resumed bit by bit, checked, and acted through by
policies that must not change them."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from olympics_opt.cli import main
from rl.amp import AMPConfig
from rl.checkpoint import checkpoints, load_checkpoint
from rl.evaluate import evaluate, standing_starts
from rl.latent_action import LatentConfig
from rl.match import Pair, Setting, play_match
from rl.policy import PolicyError, export_policy, load_policy
from rl.ppo import PPOConfig
from rl.prior import PriorError, load_prior, save_prior
from rl.prior_check import check_prior
from rl.prior_play import Sampler, play_prior, upright_frames
from rl.runlog import read_progress
from rl.selfplay import SelfPlayConfig
from rl.student import Student
from rl.tracker_evaluation import evaluate_tracker
from rl.train import TrainConfig, train
from sports.env import make_env
from sports.starts import START_NOISE
from tests.rl.latent_made import OPTIONS, golf, made_prior, prior_config, teacher_run
from tests.rl.motions_made import tables
from tests.warmstart.clips_made import random_clip
from warmstart.bank import demonstration_files
from warmstart.library import Library

SMALL = PPOConfig(hidden=(16,), steps=4, minibatches=2, epochs=1, sigma=0.3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A tracker, a clip, and a prior distilled of them."""
    place = tmp_path_factory.mktemp("latent")
    teacher_run(place)
    train(prior_config(place))
    return place


def task_config(folder: Path, out: Path, **changes) -> TrainConfig:
    plain = {"task": "penalty_kick", "worlds": 8, "samples": 4 * 8 * 4, "quiet": True}
    plain |= {"ppo": SMALL, "prior": str(folder / "prior" / "prior.safetensors")}
    return TrainConfig(out=out, **{**plain, **changes})


def same_bits(one: Path, two: Path) -> None:
    a, b = (load_checkpoint(checkpoints(run)[-1])[1] for run in (one, two))
    assert a.keys() == b.keys()
    for name, value in a.items():
        torch.testing.assert_close(value, b[name], rtol=0, atol=0, equal_nan=True, msg=name)


# The distillation.


PULSE = {"pose": False, "stiffness": 0.0, "nats": (0.0, 0.0), "beta": (0.01, 0.001)}
PULSE |= {"start_sigma": 1.0, "smooth": 0.005}


@pytest.mark.parametrize("recipe, part", [({}, 0.4), (PULSE, 0.25)], ids=["ours", "pulse"])
def test_a_student_learns_to_do_as_its_teacher(folder, tmp_path, recipe, part):
    """On one clip: the error of its actions falls to a part (around the pose it is small from the
    beginning), it follows as well as the teacher."""
    shutil.copytree(folder / "tracker", tmp_path / "tracker")
    shutil.copy(folder / "golf.npz", tmp_path / "golf.npz")
    wide = {"encoder": (96,), "prior": (64,), "decoder": (96, 96), "learning_rate": 1e-3}
    options = {**OPTIONS, **wide, "latent": 16, "steps": 8, "minibatches": 4, "epochs": 6}
    options |= {"fallen": 0.0, "push": 0.3, **recipe}
    # The clip's phase tells what to do, so that of PULSE needs no latent, nor to learn one.
    updates = 30 if recipe else 60
    run = prior_config(tmp_path, worlds=32, samples=updates * 32 * 8, options=options)
    train(run)
    rows = read_progress(run.out)
    first, last = (
        np.mean([float(r["action_error"] or 0) for r in some]) for some in (rows[:1], rows[-3:])
    )
    assert last < part * first
    if recipe:
        assert rows[0]["beta"] == pytest.approx(0.01) and rows[-1]["beta"] == pytest.approx(0.001)
    else:
        assert all(row["active"] > 2 / 3 * 16 for row in rows)
    library = Library.load(tmp_path / "golf.npz")
    teacher = evaluate_tracker(str(folder / "tracker"), library)["clips"][0]
    student = evaluate_tracker(Student(load_prior(run.out)), library)["clips"][0]
    assert teacher["success"] == student["success"] == 1.0
    # Measured: 60 mm and 67 mm.
    assert student["mpjpe"] < teacher["mpjpe"] + 30.0


def test_a_resumed_distillation_goes_on_bit_by_bit(folder, tmp_path):
    for name in ("tracker", "golf.npz"):
        (tmp_path / name).symlink_to(folder / name)
    parts = prior_config(tmp_path, "parts")
    train(parts, part=0.5)
    assert json.loads((checkpoints(parts.out)[-1] / "state.json").read_text())["iteration"] == 2
    train(replace(parts, resume=True))
    same_bits(folder / "prior", parts.out)
    assert (parts.out / "prior.safetensors").read_bytes() == (
        folder / "prior" / "prior.safetensors"
    ).read_bytes()


SCRIPT = """
import sys, torch
from pathlib import Path
from tests.rl.latent_made import prior_config
from rl.train import train
torch.set_num_threads(1)
train(prior_config(Path(sys.argv[1]), "killed", samples=10**9, checkpoint_iterations=1))
"""


def test_killed_it_loses_little(folder):
    """SIGKILL between checkpoints: the run goes on, at another length, as one never killed."""
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(folder)], cwd=root, env=environment
    )
    run = folder / "killed"
    deadline = time.monotonic() + 120.0
    while not checkpoints(run) or checkpoints(run)[-1].name < "step_0000003":
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait(60)
    done = json.loads((checkpoints(run)[-1] / "state.json").read_text())["samples"]
    later = done + 2 * 32
    # The schedules of both are those of a run of 10**9 samples, as good as at their beginning.
    config = prior_config(folder, "killed", samples=10**9, resume=True)
    train(config, part=later / 10**9)
    train(prior_config(folder, "whole", samples=10**9), part=later / 10**9)
    same_bits(run, folder / "whole")


RANKS = """
import sys
from pathlib import Path
from tests.rl.latent_made import prior_config
from rl.train import train
train(prior_config(Path(sys.argv[1]), "ranks", samples=2 * 4 * 8 * 4, device="cpu"))
"""


def test_two_ranks_learn_one_student_in_worlds_of_their_own(folder, tmp_path):
    root, script = Path(__file__).parents[2], tmp_path / "ranks.py"
    script.write_text(RANKS)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--local-addr", "127.0.0.1", "--nproc-per-node", "2", str(script), str(folder)]
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    subprocess.run(command, cwd=root, env=environment, check=True, timeout=180)
    saved = checkpoints(folder / "ranks")[-1]
    one, two = (load_checkpoint(saved, rank)[1] for rank in (0, 1))
    for name, value in one.items():
        if name.startswith(("agent/nets.", "agent/adam.")):
            assert torch.equal(value, two[name]), name
    assert not torch.equal(one["env/qpos"], two["env/qpos"])
    alone = load_checkpoint(checkpoints(folder / "prior")[-1])[1]
    assert not torch.equal(one["agent/nets.prior.head.bias"], alone["agent/nets.prior.head.bias"])
    assert (
        load_prior(folder / "ranks" / "prior.safetensors").digest
        == load_prior(folder / "ranks").digest
    )


def test_another_teacher_or_library_is_refused_on_resume(folder, tmp_path):
    shutil.copytree(folder / "prior", tmp_path / "prior")
    shutil.copy(folder / "golf.npz", tmp_path / "golf.npz")
    other = replace(prior_config(folder), out=tmp_path / "prior", resume=True, samples=10_000)
    with pytest.raises(ValueError, match=r"tracker .* differs from the run's"):
        train(replace(other, tracker=str(tmp_path / "x")))
    with pytest.raises(ValueError, match="latent 7 differs from the run's 6"):
        train(replace(other, options={**OPTIONS, "latent": 7}))


def test_the_card_names_the_teacher_the_archives_and_the_licences(folder):
    card = json.loads((folder / "prior" / "prior.json").read_text())
    assert card["format"] == "olympics-opt prior 1" and card["body"] == "smpl"
    assert card["library"]["archives"]["demonstrations"]["licences"] == ["Apache-2.0"]
    tracker = load_policy(folder / "tracker", "tracking")
    assert card["teacher"]["sha256"] == tracker.metadata["sha256"]
    assert card["layout"]["body_angvel"] == [286, 358] and card["latent"] == 6
    assert card["precision"] == "float16" and card["samples"] == 128
    prior = load_prior(folder / "prior" / "prior.safetensors")
    assert torch.equal(prior.mean, tracker.mean) and torch.equal(prior.std, tracker.std)
    # A run and its file are one prior.
    assert load_prior(folder / "prior").digest == prior.digest


def test_what_cannot_be_distilled_is_refused(folder, tmp_path):
    config = prior_config(folder, "none")
    with pytest.raises(ValueError, match="give --tracker"):
        train(replace(config, tracker=None))
    with pytest.raises(ValueError, match="is a baseline"):
        train(replace(config, tracker="zero"))
    with pytest.raises(PolicyError, match="no policy"):
        train(replace(config, tracker=str(tmp_path / "nothing")))
    with pytest.raises(ValueError, match="athlete is one of strength 'paper'"):
        train(replace(config, strength="human"))
    with pytest.raises(ValueError, match="learner of its own"):
        replace(config, ppo=SMALL)
    with pytest.raises(ValueError, match="--tracker is for the task 'prior'"):
        TrainConfig(task="hurdling", tracker="x")
    with pytest.raises(ValueError, match="comes before a latent prior"):
        replace(config, prior="x")
    with pytest.raises(ValueError, match="targets of a clip are no latents"):
        TrainConfig(task="hurdling", prior="x", clone=2, clips=(Path("a.npz"),))
    with pytest.raises(ValueError, match="need --prior"):
        TrainConfig(task="hurdling", algo="latent")
    assert not (folder / "none").exists()


# Policies that act through it.


def test_a_task_policy_learns_and_its_prior_stays_as_it_is(folder, tmp_path, monkeypatch):
    import rl.train as loop

    seen = []
    whole = loop._Trainer._iterate

    def watched(self, *args):
        row = whole(self, *args)
        prior = self.env.layer.prior
        parts = [*prior.nets.state_dict().values(), prior.mean, prior.std]
        seen.append(b"".join(x.numpy().tobytes() for x in parts))
        assert not any(p.requires_grad or p.grad is not None for p in prior.nets.parameters())
        actor = {k: v.clone() for k, v in self.agent.actor.state_dict().items()}
        learned.append(torch.cat([x.flatten() for x in actor.values()]))
        return row

    learned: list[torch.Tensor] = []
    monkeypatch.setattr(loop._Trainer, "_iterate", watched)
    run = tmp_path / "run"
    train(task_config(folder, run))
    source = folder / "prior" / "prior.safetensors"
    assert len(seen) == 4 and len(set(seen)) == 1
    assert not torch.equal(learned[0], learned[-1])
    # The run has a copy of its own, the same to the byte.
    assert (run / "prior.safetensors").read_bytes() == source.read_bytes()
    tensors = load_checkpoint(checkpoints(run)[-1])[1]
    assert tensors["agent/actor.head.bias"].shape == (6,)


def test_a_task_policy_resumes_bit_by_bit_with_its_own_prior(folder, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train(task_config(folder, whole))
    moved = tmp_path / "elsewhere"
    save_prior(load_prior(folder / "prior"), moved / "prior", half=True)
    config = task_config(folder, parts, prior=str(moved / "prior.safetensors"))
    train(config, part=0.5)
    shutil.rmtree(moved)  # a run needs nothing but its own folder
    train(replace(config, resume=True))
    same_bits(whole, parts)
    save_prior(made_prior(), parts / "prior", half=False)
    with pytest.raises(PriorError, match="acts through the prior"):
        train(replace(config, resume=True, samples=10_000))


def test_it_goes_with_a_style_and_an_arm(folder, tmp_path):
    clips = tuple(demonstration_files("tennis"))[:1]
    config = task_config(
        folder,
        tmp_path / "run",
        task="tennis",
        algo="amp",
        clips=clips,
        latent=LatentConfig(arm_residual=0.2, span=2.0),
        amp=AMPConfig(hidden=(16,), batch=32, steps=2, frames=2),
    )
    train(config)
    policy = load_policy(tmp_path / "run", "tennis")
    card = policy.metadata
    assert card["algo"] == "latent-amp" and card["action_size"] == 6 + 15
    assert card["latent"]["span"] == 2.0 and card["latent"]["arm_residual"] == 0.2
    train(replace(config, resume=True, samples=6 * 8 * 4))
    # Another way of acting is another policy.
    other = replace(config, out=tmp_path / "other", init=str(tmp_path / "run"))
    with pytest.raises(PolicyError, match="acts through another latent prior"):
        train(replace(other, latent=LatentConfig(arm_residual=0.2)))
    with pytest.raises(ValueError, match="give --prior as well"):
        train(replace(other, prior=None, latent=LatentConfig(), algo="ppo", amp=AMPConfig()))
    train(other)
    # Also where the task shows more than the policy knew.
    seeing = replace(other, out=tmp_path / "seeing", options={"ball_path": True})
    with pytest.raises(PolicyError, match="acts through another latent prior"):
        train(replace(seeing, latent=LatentConfig(arm_residual=0.2)))
    train(seeing)


def test_two_sides_play_through_one_prior(folder, tmp_path):
    few = SelfPlayConfig(pool=4, snapshot_samples=200, ladder=(100,))
    config = task_config(
        folder,
        tmp_path / "whole",
        task="fencing",
        algo="selfplay",
        selfplay=few,
        latent=LatentConfig(arm_residual=0.2),
    )
    train(config)
    run = tmp_path / "whole"
    card = load_policy(run, "fencing").metadata
    arms = 15
    assert card["algo"] == "latent-selfplay" and card["action_size"] == 6 + arms
    # A frozen opponent acts through the same prior.
    first = load_policy(f"{run}@0", "fencing")
    assert first.prior is not None and first.prior.digest == card["latent"]["prior_digest"]

    parts = replace(config, out=tmp_path / "parts")
    train(parts, part=0.5)
    train(replace(parts, resume=True))
    same_bits(run, parts.out)

    # In a match each athlete acts as it learned to: through the prior on its own turns, or not.
    latest = load_policy(run, "fencing")
    env = make_env("fencing", num_worlds=2, training=False)
    pair = Pair(latest, load_policy("zero", "fencing"))
    pair.check(env)
    assert isinstance(env.own_turns, torch.Tensor) and env.own_turns.tolist() == [True, False]
    obs = env.reset()
    action = pair(obs)
    prior = load_prior(folder / "prior")
    mean, sigma = prior.moments(obs[:, :1])
    assert latest.actor is not None and latest.layer is not None
    told = latest.actor(((obs[:, :1] - latest.mean) / latest.std).clamp(-5, 5))
    decoded = prior.decode(obs[:, :1], mean + 2.5 * sigma * torch.tanh(told[..., :6]))
    arm = action[:, :1] - (decoded - env.action_offset / env.action_scale)
    moved = (arm.abs() > 1e-5).any(0)[0]
    assert 0 < int(moved.sum()) <= arms
    assert float(arm.abs().max()) <= 0.2 / float(env.action_scale.min()) + 1e-5
    assert float(action[:, 1].abs().max()) == 0.0
    env.close()
    match = play_match(f"{run}@0", run, Setting("fencing", trials=4, worlds=2))
    assert match["algo"] == "latent-selfplay against latent-selfplay"
    assert match["metrics"]["score"]["n"] + match["unrated"] == 4


def test_an_evaluation_is_stepping_by_hand(folder, tmp_path, monkeypatch):
    train(replace(task_config(folder, tmp_path / "run"), keep_policies=True))
    path = export_policy(tmp_path / "run", tmp_path / "shipped" / "kick")
    kept = list((tmp_path / "run" / "policies").glob("*.safetensors"))
    assert load_policy(kept[-1], "penalty_kick").prior is not None  # of the run above it
    assert path.stat().st_size < 40_000  # the prior is not in it
    card = json.loads(path.with_suffix(".json").read_text())
    assert card["algo"] == "latent" and card["config"]["prior"] == "prior.safetensors"
    with pytest.raises(PolicyError, match="needs the latent prior"):
        load_policy(path, "penalty_kick")
    monkeypatch.setenv("OLYMPICS_OPT_PRIORS", str(folder / "prior"))
    found = evaluate(path, "penalty_kick", trials=3, num_worlds=3, seed=5)
    assert found.result["algo"] == "latent"
    assert found.result["prior_digest"] == card["latent"]["prior_digest"]

    policy, prior = load_policy(path, "penalty_kick"), load_prior(folder / "prior")
    env = make_env("penalty_kick", num_worlds=3, seed=5, training=False)
    env.starts = standing_starts(env, START_NOISE)
    obs, total = env.reset(), torch.zeros(3)
    open_ = torch.ones(3, dtype=torch.bool)
    assert policy.actor is not None
    env.own_turns = True
    while open_.any():
        x = ((obs - policy.mean) / policy.std).clamp(-5, 5)
        mean, sigma = prior.moments(obs)
        z = mean + sigma * 2.5 * torch.tanh(policy.actor(x))
        result = env.step(prior.decode(obs, z))
        total += torch.where(open_, result.reward[:, 0], 0.0)
        open_ &= ~result.ended
        obs = result.obs
    np.testing.assert_allclose(found.trials["return"], total.numpy(), rtol=1e-5)
    env.close()


def test_drake_plays_the_same_policy(folder, tmp_path, monkeypatch):
    pytest.importorskip("pydrake")
    train(task_config(folder, tmp_path / "run", task="hurdling"))
    one, two = (
        evaluate(
            tmp_path / "run", "hurdling", engine=e, trials=1, num_worlds=1, processes=1, record=1
        )
        for e in ("mujoco", "drake")
    )
    first, second = one.best.action[0], two.best.action[0]
    np.testing.assert_allclose(first, second, atol=5e-3)
    assert first.shape == (1, 69)


# Playing the prior, and checking it.


def test_samplers_draw_what_they_say():
    g = torch.Generator().manual_seed(0)

    def noise(sampler: Sampler, steps: int = 400) -> torch.Tensor:
        last, rows = None, []
        for step in range(steps):
            last = sampler.noise(last, step, torch.randn(64, 3, generator=g))
            rows.append(last)
        return torch.stack(rows)

    for kind, one_step in (("each", 0.0), ("held", 0.9), ("smooth", np.exp(-0.1)), ("mean", None)):
        x = noise(Sampler(kind, hold=10))  # type: ignore[arg-type]
        if one_step is None:
            assert float(x.abs().max()) == 0.0
            continue
        assert float(x.std()) == pytest.approx(1.0, abs=0.05)
        assert float((x[1:] * x[:-1]).mean()) == pytest.approx(one_step, abs=0.05)
    with pytest.raises(ValueError, match="unknown sampler 'wild'"):
        Sampler("wild")  # type: ignore[arg-type]


def test_it_begins_on_its_feet():
    flying = random_clip(0)
    flying.qpos[:, 2] += 3.0
    with pytest.raises(ValueError, match="on its feet"):
        upright_frames(tables(flying))
    both = tables(flying, golf())
    found = upright_frames(both)
    half = both.num_frames
    assert bool(((found % half) >= len(flying.qpos) + 1).all()) and len(found) > 20
    assert set((found % half).tolist()) == {int(f) % half for f in found if f >= half}


def test_a_prior_alone_falls_or_stands_as_its_decoder_says(folder):
    """A decoder of plain zeros holds the T-pose, which falls from a golfer's address; the seconds
    are counted in a second way."""
    library = Library.load(folder / "golf.npz")
    prior = load_prior(folder / "prior")
    for net in (prior.nets.decoder,):
        net.head.weight.zero_()
        net.head.bias.zero_()
    found = play_prior(prior, library, num_worlds=4, seconds=4.0, seed=1, keep=4)
    again = play_prior(prior, library, num_worlds=4, seconds=4.0, seed=1)
    np.testing.assert_array_equal(found.upright, again.upright)
    assert found.qpos.shape == (4, 120, 76) and found.qvel.shape == (4, 120, 75)
    for world in range(4):
        low = np.flatnonzero(found.qpos[world, :, 2] < 0.15)  # the root on the ground
        if len(low):
            assert found.upright[world] <= low[0] / 30.0 + 1e-6
            assert not found.standing[world]
    assert found.upright.min() < 4.0
    with pytest.raises(ValueError, match="at least one world"):
        play_prior(prior, library, num_worlds=0)


def test_the_check_measures_what_it_says(folder, tmp_path, capsys):
    library = str(folder / "golf.npz")
    out = tmp_path / "check.json"
    arguments = ["prior", "check", str(folder / "prior"), "--clips", library, "--worlds", "4"]
    arguments += ["--seconds", "1", "--tracker", str(folder / "tracker"), "--out", str(out)]
    code = main(arguments)
    said, found = capsys.readouterr().out, json.loads(out.read_text())
    checks = found["checks"]
    assert set(checks) == {"kl", "active", "student", "standing"}
    assert code == (0 if found["passed"] else 1)
    assert checks["kl"]["value"] == pytest.approx(sum(found["nats"]), abs=1e-3)
    assert checks["active"]["value"] == sum(x > 0.01 for x in found["nats"])
    assert checks["active"]["required"] == "more than 3.75 of 6"
    ratio = (
        found["student"]["train"]["all"]["success"]["mean"]
        if "train" in found["student"]
        else (found["student"]["held_out"]["all"]["success"]["mean"])
    )
    assert checks["student"]["value"] == pytest.approx(ratio)  # the teacher follows its clip
    assert checks["standing"]["value"] == found["alone"]["standing"]["mean"]
    for check in checks.values():
        word = "PASS" if check["passed"] else "FAIL"
        assert f"{word:<12}" in said
    # Without the tracker, and without the encoder, what cannot be checked is said.
    save_prior(load_prior(folder / "prior"), tmp_path / "small", half=True, encoder=False)
    part = check_prior(
        load_prior(tmp_path / "small.safetensors"), Library.load(library), num_worlds=2, seconds=0.5
    )
    assert [c["passed"] for n, c in part["checks"].items() if n != "standing"] == [None] * 3
    assert part["complete"] is False


def test_the_commands(folder, tmp_path, capsys):
    library, run = str(folder / "golf.npz"), str(tmp_path / "prior")
    small = ["--worlds", "4", "--samples", "32", "--task.steps", "4", "--task.minibatches", "2"]
    small += ["--task.latent", "4", "--task.encoder", "8", "--task.prior", "8"]
    small += ["--task.decoder", "8", "--task.split", "all", "--quiet"]
    tracker = str(folder / "tracker")
    assert (
        main(["train", "prior", "--tracker", tracker, "--clips", library, "--out", run, *small])
        == 0
    )
    file = tmp_path / "p.safetensors"
    assert main(["prior", "export", run, "--out", str(file)]) == 0
    assert file.read_bytes() == (tmp_path / "prior" / "prior.safetensors").read_bytes()
    sheet, clip = tmp_path / "sheet.png", tmp_path / "clip.npz"
    for out in (sheet, clip):
        play = ["prior", "play", str(file), "--clips", library, "--out", str(out)]
        assert main([*play, "--worlds", "2", "--seconds", "0.5"]) == 0
        assert out.stat().st_size > 1000
    policy = str(tmp_path / "policy")
    task = ["--worlds", "4", "--samples", "32", "--ppo.steps", "4", "--ppo.minibatches", "2"]
    task += ["--ppo.hidden", "8", "--quiet", "--prior", str(file), "--latent.span", "2"]
    assert main(["train", "hurdling", "--out", policy, *task]) == 0
    thrower = str(tmp_path / "thrower")  # who has fingers, and is moved as one without
    assert main(["train", "javelin", "--out", thrower, *task]) == 0
    env = make_env("javelin", num_worlds=2)
    learned = load_policy(thrower, "javelin")
    learned.check(env)
    assert learned(env.reset()).shape == (2, 1, 153)
    env.close()
    capsys.readouterr()
    # A user's mistakes: code 2, one sentence, nothing written.
    none, fingers = str(tmp_path / "none"), str(tmp_path / "fingers.safetensors")
    save_prior(made_prior("smplx"), fingers, half=False)
    for wrong, sentence in (
        (["prior", "check", tracker, "--clips", library], "of task 'tracking', not of 'prior'"),
        (["prior", "play", run, "--clips", library, "--out", f"{none}.gif"], "must end in .mp4"),
        (["prior", "export", none, "--out", f"{none}.safetensors"], "there is no prior"),
        (["prior", "frobnicate"], "prior has no command"),
        (["train", "hurdling", "--prior", none, "--out", none], "there is no prior"),
        (["train", "hurdling", "--prior", fingers, "--out", none], "of body 'smplx', the athlete"),
        (["train", "prior", "--clips", library, "--out", none], "give --tracker"),
        (["evaluate", "hurdling", "--policy", run, "--out", none], "'distillation'"),
    ):
        assert main(wrong) == 2, wrong
        said = capsys.readouterr().err
        assert sentence in said and len(said.strip().splitlines()) == 1, said
    assert not list(tmp_path.glob("none*"))


def test_a_prior_tells_nothing_of_the_machine_that_made_it(folder):
    card = json.loads((folder / "prior" / "prior.json").read_text())
    assert "out" not in card["config"] and card["config"]["clips"] == ["golf.npz"]
    assert str(folder) not in json.dumps(card)
