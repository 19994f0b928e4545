"""Speed from hand-made logs, and two whole trainings on the processor."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rl.scaling import ScalingConfig, main, speed
from rl.train import parse_args


def log(count: int, first_s: float, each_s: float) -> list[dict]:
    """Iterations of 1000 samples of which the first takes longer."""
    return [
        {
            "iteration": i + 1,
            "samples": 1000 * (i + 1),
            "minutes": (first_s + each_s * i) / 60.0,
            "rollout_s": 0.75 * each_s,
            "update_s": 0.25 * each_s,
        }
        for i in range(count)
    ]


def test_speed_is_that_after_the_warm_up():
    for first in (0.5, 60.0):  # however long the first iteration took
        found = speed(log(40, first, 0.5), warm_up=5.0)
        assert found["samples_per_s"] == pytest.approx(2000.0)
        assert (found["rollout_s"], found["update_s"]) == pytest.approx((0.375, 0.125))
    # 40 iterations of which those up to 5 s do not count: 0.5 + 0.5 i >= 5 from i = 9 on
    assert speed(log(40, 0.5, 0.5), 5.0)["iterations"] == 30
    with pytest.raises(ValueError, match="too few for a figure: give more --seconds"):
        speed(log(12, 0.5, 0.5), 5.0)


def test_mistakes_are_sentences(capsys, tmp_path, monkeypatch):
    out = ["--out", str(tmp_path / "scaling.json")]
    assert main(["long_jump", *out, "--gpus", "0"]) == 2
    assert "at least 1" in capsys.readouterr().err
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    assert main(["long_jump", *out, "--gpus", "1", "4"]) == 2
    assert "this machine has 2 GPUs: --gpus 4 is too many" in capsys.readouterr().err
    monkeypatch.undo()
    assert main(["chess", *out, "--engine", "mujoco", "--gpus", "1"]) == 2
    assert "unknown task 'chess'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_one_and_two_processes_on_the_processor(tmp_path, capfd):
    out = tmp_path / "scaling.json"
    small = [
        "--ppo.hidden",
        "16",
        "--ppo.steps",
        "4",
        "--ppo.epochs",
        "1",
        "--ppo.minibatches",
        "1",
    ]
    args = ["long_jump", "--gpus", "2", "1", "--worlds", "2", "--engine", "mujoco"]
    args += ["--seconds", "1.5", "--warm-up", "0.3", "--out", str(out), "--runs", str(tmp_path)]
    assert main([*args, "--", *small]) == 0, capfd.readouterr().err
    found = json.loads(out.read_text())
    assert {"commit", "versions", "hardware"} <= set(found) and found["options"] == small
    one, two = found["rows"]
    assert (one["processes"], two["processes"], one["worlds"]) == (1, 2, 2)
    assert one["ratio"] == 1.0
    assert two["ratio"] == pytest.approx(two["samples_per_s"] / one["samples_per_s"])
    assert two["efficiency"] == pytest.approx(two["ratio"] / 2)
    for row in (one, two):  # samples of all processes: 2 worlds x 4 steps each
        per_iteration = row["samples_per_s"] * row["seconds"] / row["iterations"]
        assert per_iteration == pytest.approx(8 * row["processes"])
    assert "2 processes: " in capfd.readouterr().out
    ran = json.loads((tmp_path / "long_jump_2" / "config.json").read_text())
    assert ran["ranks"] == 2 and ran["config"]["engine"] == "mujoco"


def test_the_command_is_one_of_train():
    from rl.scaling import command

    words = command(ScalingConfig("golf", worlds=7), 3, Path("x"), ["--strength", "human"])
    assert words[words.index("--nproc-per-node") + 1] == "3"
    config = parse_args(words[words.index("rl.train") + 1 :])
    assert (config.task, config.worlds, config.engine, config.strength) == (
        *("golf", 7, "warp", "human"),
    )
    assert config.minutes == pytest.approx(0.75)
