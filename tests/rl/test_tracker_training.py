"""The tracker in the training loop: it learns, resumes bit by bit, and is measured clip by clip."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from olympics_opt.cli import main
from rl.checkpoint import checkpoints, load_checkpoint
from rl.policy import PolicyError, export_policy, load_policy
from rl.ppo import PPOConfig
from rl.runlog import read_progress
from rl.tracker_evaluation import evaluate_tracker, summarise
from rl.train import TrainConfig, train
from tests.warmstart.clips_made import random_clip
from warmstart.bank import demonstration_files
from warmstart.clip import Clip
from warmstart.library import Library, Origin, pack

SMALL = PPOConfig(hidden=(32,), steps=4, minibatches=2, epochs=1, sigma=0.1)


def golf() -> Clip:
    return Clip.load(next(f for f in demonstration_files("golf") if "12mps" in f.name))


def saved(path: Path, *clips: Clip) -> Path:
    pack((f"clip_{i}", c) for i, c in enumerate(clips)).save(path)
    return path


def config(out: Path, clips: Path, **changes) -> TrainConfig:
    plain = {"task": "tracking", "worlds": 8, "quiet": True, "ppo": SMALL, "samples": 8 * 4 * 4}
    options = {"split": "all"}
    return TrainConfig(out=out, clips=(clips,), options=options, **{**plain, **changes})


def test_a_few_updates_bring_the_athlete_nearer_to_a_clip(tmp_path):
    clips = saved(tmp_path / "golf.npz", golf())
    run = config(
        tmp_path / "run",
        clips,
        worlds=64,
        samples=15 * 64 * 16,
        ppo=PPOConfig(
            hidden=(128, 128),
            steps=16,
            minibatches=4,
            epochs=8,
            gamma=0.95,
            sigma=0.1,
            learning_rate=1e-4,
            learning_rate_limits=(1e-5, 1e-3),
        ),
    )
    train(run)
    motions = Library.load(clips)
    before, after = (
        evaluate_tracker(p, motions)["clips"][0] for p in ("zero", str(tmp_path / "run"))
    )
    # Measured: from 62 mm to 40 mm after 15 updates, 31 mm after 30.
    assert after["success"] == 1.0
    assert after["mpjpe"] < 0.85 * before["mpjpe"]


def test_a_resumed_run_goes_on_bit_by_bit(tmp_path):
    clips = saved(tmp_path / "clips.npz", golf(), random_clip(0))
    whole = train(config(tmp_path / "whole", clips))
    train(config(tmp_path / "parts", clips), part=0.5)
    parts = train(config(tmp_path / "parts", clips, resume=True))
    one, two = (load_checkpoint(s.checkpoint)[1] for s in (whole, parts))
    assert one.keys() == two.keys() and "env/tracking/failure" in one
    for name, value in one.items():
        assert torch.equal(value, two[name]), name


def test_the_sampling_and_the_curriculum_are_at_work_in_a_run(tmp_path):
    clips = saved(tmp_path / "clips.npz", golf(), random_clip(0, 60))
    train(config(tmp_path / "run", clips, samples=8 * 4 * 20))
    tensors = load_checkpoint(checkpoints(tmp_path / "run")[-1])[1]
    failure = tensors["env/tracking/failure"]
    swing, noise = failure[: -(-golf().num_frames // 15)], failure[-3:]
    # Nobody can play noise in the air; a golf swing hardly fails.
    assert float(noise.max()) > 0.9 and float(swing.min()) < 0.9
    # The last rollout began at 95 % of the run.
    assert float(tensors["env/tracking/tolerance"]) == pytest.approx(0.25)
    rows = read_progress(tmp_path / "run")
    assert {"terms/position", "metrics/success", "metrics/mpjpe"} <= set(rows[-1])


def test_another_library_is_refused_on_resume(tmp_path):
    clips = saved(tmp_path / "clips.npz", golf())
    train(config(tmp_path / "run", clips))
    saved(clips, random_clip(0))
    with pytest.raises(ValueError, match="trained on another clip library"):
        train(config(tmp_path / "run", clips, resume=True, samples=10_000))


def test_the_card_names_archives_and_licences(tmp_path):
    walk = random_clip(0, licence="CC BY-NC 4.0", sport="walk")
    clips = saved(tmp_path / "clips.npz", golf(), walk)
    train(config(tmp_path / "run", clips))
    export_policy(tmp_path / "run", tmp_path / "tracker.safetensors")
    card = json.loads((tmp_path / "tracker.json").read_text())
    assert card["task"] == "tracking" and card["library"]["digest"] == Library.load(clips).digest
    assert card["library"]["archives"]["demonstrations"]["licences"] == ["Apache-2.0"]
    assert card["library"]["archives"]["files"]["licences"] == ["CC BY-NC 4.0"]
    with pytest.raises(PolicyError, match="of task 'tracking', not of 'long_jump'"):
        load_policy(tmp_path / "tracker.safetensors", "long_jump")
    # An athlete with fingers sees and moves more.
    with pytest.raises(PolicyError, match="obs_size 934"):
        evaluate_tracker(
            str(tmp_path / "tracker.safetensors"), pack([("a", random_clip(0, body="smplx"))])
        )


def test_every_clip_is_played_once_in_any_number_of_worlds():
    clips = [random_clip(i, 12 + i) for i in range(5)]
    motions = pack((f"c{i}", c) for i, c in enumerate([*clips, golf()]))
    few, many = (evaluate_tracker("zero", motions, num_worlds=n) for n in (2, 6))
    assert [c["name"] for c in few["clips"]] == [o.name for o in motions.origins]
    for one, two in zip(few["clips"], many["clips"]):
        assert one["success"] == two["success"]
        assert one["mpjpe"] == pytest.approx(two["mpjpe"], rel=1e-3)
    assert few["clips"][5]["success"] == 1.0 and few["clips"][5]["followed"] == 1.0
    lost = [c for c in few["clips"] if c["success"] == 0.0]
    assert all(c["followed"] <= 1.0 for c in lost)


def test_figures_of_splits_archives_and_tags():
    def origin(name: str, archive: str, tag: str) -> Origin:
        return Origin(name, archive, tag, "MIT", "x")

    names = [f"n{i}" for i in range(40)]
    origins = [origin(n, "ab"[i % 2], "xyz"[i % 3]) for i, n in enumerate(names)]
    rng = np.random.default_rng(0)
    rows = rng.uniform(0, 100, (40, 5))
    rows[:, 0] = rng.integers(0, 2, 40)
    rows[:, 4] /= 100
    found = summarise(origins, rows)
    held = np.array([o.held_out for o in origins])
    assert 0 < held.sum() < 40
    mine = ~held & (np.arange(40) % 2 == 1)
    figures = found["train"]["archives"]["b"]
    assert figures["success"]["mean"] == pytest.approx(rows[mine, 0].mean())
    assert figures["success"]["n"] == mine.sum()
    assert figures["mpjpe"]["mean"] == pytest.approx(rows[mine & (rows[:, 0] == 1), 1].mean())
    mine = held
    assert found["held_out"]["all"]["followed"]["mean"] == pytest.approx(rows[mine, 4].mean())
    counts = [row["success"]["n"] for row in found["train"]["tags"].values()]
    assert sum(counts) == (~held).sum()


def test_the_commands(tmp_path, capsys):
    for i in range(3):
        random_clip(i, 12, licence="MIT", sport="run").save(tmp_path / "clips" / f"a/{i}.npz")
    library, run, result = (str(tmp_path / n) for n in ("library.npz", "run", "result.json"))
    assert main(["mocap", "pack", str(tmp_path / "clips"), "--out", library]) == 0
    assert "a: 3 clips" in capsys.readouterr().out
    small = ["--worlds", "4", "--samples", "32", "--ppo.steps", "4", "--ppo.minibatches", "2"]
    small += ["--ppo.hidden", "16", "--task.split", "all", "--quiet"]
    assert main(["train", "tracking", "--clips", library, "--out", run, *small]) == 0
    arguments = ["tracker", "--policy", run, "--clips", library, "--out", result]
    assert main(arguments) == 0
    found = json.loads(Path(result).read_text())
    assert found["trials"] == 3 and {c["name"] for c in found["clips"]} == {"a/0", "a/1", "a/2"}
    capsys.readouterr()
    # A user's mistakes: code 2, one sentence, nothing written.
    for wrong, sentence in (
        (["train", "tracking", "--out", f"{run}2"], "there are no clips to track"),
        (["train", "tracking", "--clips", result, "--out", f"{run}2"], "not a readable clip"),
        (["tracker", "--policy", "none", "--clips", library, "--out", f"{run}2"], "no policy"),
        (["mocap", "pack", str(tmp_path / "none"), "--out", f"{run}2"], "there is nothing at"),
    ):
        assert main(wrong) == 2
        said = capsys.readouterr().err
        assert sentence in said and len(said.strip().splitlines()) == 1
        assert not Path(f"{run}2").exists()
