"""Lessons: each begins with what the one before came to, ends once, and goes on after a stop."""

from __future__ import annotations

import csv
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from olympics_opt import cli
from rl import pretrained
from rl.checkpoint import checkpoints, load_checkpoint
from rl.config import TrainConfig, parse_args
from rl.lessons import Ended, folder, lesson_words, load_plan, plan_names, teach
from rl.policy import load_policy
from rl.recipe import ROOT
from rl.until import GROUPS, ITERATIONS

SMALL = "--worlds 4 --ppo.hidden 8 --ppo.steps 4 --quiet"
PLAN = f"""
task = "hurdling"
options = "{SMALL} --task.gap-seen"
[[lessons]]
name = "low"
options = "--samples 320 --task.least 0.5 --ppo.sigma 0.3"
[[lessons]]
name = "high"
options = "--samples 48 --task.first-max {{curriculum/h_max}} --ppo.critic-warmup 9 --ppo.gamma 0.9"
"""


def written(path: Path, text: str = PLAN) -> Path:
    path.write_text(text)
    return path


def actor(run: Path) -> dict[str, torch.Tensor]:
    state = load_checkpoint(checkpoints(run)[-1])[1]
    return {k: x for k, x in state.items() if k.startswith(("agent/actor.", "agent/critic."))}


def recipe(policy: Path, capsys) -> tuple[str, list[TrainConfig]]:
    """What the command prints, and the settings of the trainings in it."""
    capsys.readouterr()
    assert cli.main(["recipe", "hurdling", "--policy", str(policy)]) == 0
    text = capsys.readouterr().out
    parts = text.replace("\\\n", " ").split("\n\n")
    return text, [parse_args(shlex.split(x)[2:]) for x in parts if x.startswith("olympics-opt ")]


def test_a_lesson_begins_with_what_the_one_before_came_to(tmp_path):
    """Its actor, which rests in the second as another discount is the critic's to learn first; its
    critic, which moves on; and a level of its log."""
    plan = load_plan(str(written(tmp_path / "plan.toml")))
    out = tmp_path / "out"
    ended = teach(plan, out)
    assert [(x.name, x.samples, x.stopped_by) for x in ended] == [
        ("low", 320, "samples"),
        ("high", 48, "samples"),
    ]
    low, high = (actor(folder(plan, k, out)) for k in (0, 1))
    for name, x in low.items():
        assert torch.equal(high[name], x) == name.startswith("agent/actor."), name
    with open(out / "1_low" / "progress.csv", newline="") as f:
        log = list(csv.DictReader(f))
    for name in (name for name in log[0] if name.startswith(GROUPS)):
        told = [float(row[name]) for row in log if row[name]][-ITERATIONS:]
        assert (name in ended[0].levels) == bool(told)
        if told:
            assert ended[0].levels[name] == pytest.approx(np.mean(told))
    config = json.loads((out / "2_high" / "config.json").read_text())["config"]
    assert config["options"]["first_max"] == pytest.approx(
        ended[0].levels["curriculum/h_max"], rel=1e-3
    )
    assert config["init"] == str(out / "1_low")

    policy = load_policy(str(out / "policy.safetensors"), "hurdling")
    own = load_policy(str(out / "2_high"), "hurdling")
    obs = torch.randn(5, policy.metadata["obs_size"], generator=torch.Generator().manual_seed(1))
    assert torch.allclose(policy(obs), own(obs), atol=2e-3)  # float16
    told = policy.metadata["lessons"]
    assert [x["samples"] for x in told] == [320, 48]
    first = parse_args(["hurdling", *shlex.split(told[0]["options"])])
    assert (first.ppo.sigma, first.options["least"], first.num_worlds) == (0.3, 0.5, 4)
    assert "--init" not in told[1]["options"]


OTHER = f"""
task = "hurdling"
options = "{SMALL}"
[[lessons]]
name = "run"
task = "long_jump"
options = "--samples 320 --task.no-somersaults"
[[lessons]]
name = "hurdle"
options = "--samples 48 --task.gap-seen --ppo.critic-warmup 9"
"""


def test_a_lesson_may_be_of_another_task(tmp_path, capsys):
    """The second begins with the first's actor, whose layers above the first are as they were."""
    plan = load_plan(str(written(tmp_path / "plan.toml", OTHER)))
    out = tmp_path / "out"
    assert [x.samples for x in teach(plan, out)] == [320, 48]
    run, hurdle = (actor(folder(plan, k, out)) for k in (0, 1))
    above = {k for k in run if k.startswith("agent/actor.") and "trunk.0." not in k}
    assert above and all(torch.equal(run[k], hurdle[k]) for k in above)
    first = "agent/actor.trunk.0.weight"
    assert hurdle[first].shape != run[first].shape

    policy = load_policy(str(out / "policy.safetensors"), "hurdling")
    assert [x["task"] for x in policy.metadata["lessons"]] == ["long_jump", "hurdling"]
    _, told = recipe(out / "policy.safetensors", capsys)
    assert [x.task for x in told] == ["long_jump", "hurdling"]
    assert told[0].options["somersaults"] is False and told[1].init == str(told[0].out)
    assert cli.main(["lessons", str(tmp_path / "plan.toml"), "--show"]) == 0
    assert "olympics-opt train long_jump --worlds" in capsys.readouterr().out


def test_lessons_that_have_ended_are_not_begun_again(tmp_path, capsys):
    plan = load_plan(str(written(tmp_path / "plan.toml")))
    out = tmp_path / "out"
    ended = teach(plan, out)
    before = {p: p.stat().st_mtime_ns for p in out.glob("*/progress.csv")}
    assert teach(plan, out) == ended
    assert {p: p.stat().st_mtime_ns for p in out.glob("*/progress.csv")} == before
    assert "low: 320 samples" in capsys.readouterr().out
    other = PLAN.replace('"low"', '"slow"')
    with pytest.raises(ValueError, match="lessons of another plan"):
        teach(load_plan(str(written(tmp_path / "other.toml", other))), out)


def test_after_a_signal_the_same_command_goes_on(tmp_path):
    """Stopped in the first lesson, which is not told as ended; in the end as if never stopped."""
    plan = load_plan(str(written(tmp_path / "plan.toml", PLAN.replace("320", "640"))))
    words = ["-m", "olympics_opt", "lessons", str(tmp_path / "plan.toml")]
    words += ["--out", str(tmp_path / "out"), "--checkpoint-iterations", "1"]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen([sys.executable, *words], env=env)
    deadline = time.monotonic() + 120
    while len(checkpoints(tmp_path / "out" / "1_low")) < 2:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) == 0
    assert not (tmp_path / "out" / "lessons.json").exists()
    assert not (tmp_path / "out" / "2_high").exists()
    teach(plan, tmp_path / "out", ["--checkpoint-iterations", "1"])
    teach(plan, tmp_path / "whole")
    for k in (0, 1):
        stopped, whole = (actor(folder(plan, k, tmp_path / name)) for name in ("out", "whole"))
        for name, x in whole.items():
            assert torch.equal(stopped[name], x), name


STARTS = {
    "hurdling_latent_from_long_jump": str(pretrained.locate("long_jump", "latent-human")),
    "soccer_1v1_latent": str(pretrained.locate("hurdling", "latent-human")),
    "soccer_2v2_latent": str(pretrained.locate("soccer_1v1", "latent-human")),
}
"""What plans of ours begin with; the others begin from nothing."""


@pytest.mark.parametrize("name", plan_names())
def test_our_plans_can_be_followed(name):
    """Every option of every lesson is one, and its clips are here."""
    plan = load_plan(name)
    out = Path("out")
    known = {"curriculum/h_max": 0.5, "metrics/success": 0.5}
    assert plan.about
    for k, lesson in enumerate(plan.lessons):
        before = Ended("before", 1, 1.0, "samples", known) if k else None
        config = parse_args(lesson_words(plan, k, ["--worlds", "3"], before, out))
        assert config.num_worlds == 3, lesson.name  # what is told last counts
        assert config.init == (str(folder(plan, k - 1, out)) if k else STARTS.get(name))
        assert config.samples is not None  # minutes would be another plan on another machine
        assert all(clip.is_file() for clip in config.clips)


def test_a_plan_may_extend_another(tmp_path):
    """What it says stands above, option by option; the rest is the other's."""
    written(tmp_path / "base.toml", PLAN)
    middle = """
    extends = "base.toml"
    options = "--worlds 3"
    [[lessons]]
    name = "high"
    options = "--samples 96 --task.haste 40 --ppo.gamma=0.8"
    [[lessons]]
    name = "last"
    options = "--samples 12"
    """
    written(tmp_path / "middle.toml", middle)
    plan = load_plan(str(written(tmp_path / "own.toml", 'extends = "middle.toml"\nfirst = "high"')))
    assert [lesson.name for lesson in plan.lessons] == ["high", "last"]
    assert plan.options == tuple(f"{SMALL} --task.gap-seen".split()[2:] + ["--worlds", "3"])
    known = {"curriculum/h_max": 0.5}
    before = Ended("low", 1, 1.0, "samples", known)
    high = parse_args(lesson_words(plan, 0, [], before, tmp_path))
    assert (high.samples, high.ppo.gamma, high.ppo.critic_warmup) == (96, 0.8, 9)
    assert (high.num_worlds, high.options["haste"], high.options["first_max"]) == (3, 40.0, 0.5)
    assert plan.lessons[0].options.count("--samples") == 1
    whole = load_plan(str(tmp_path / "middle.toml"))
    assert [lesson.name for lesson in whole.lessons] == ["low", "high", "last"]
    assert whole.lessons[0] == load_plan(str(tmp_path / "base.toml")).lessons[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('extends = "plan.toml"', "extends itself"),
        ('extends = "nowhere"', "no plan 'nowhere'"),
        ('extends = "hurdling_latent"\nfirst = "walk"', "no lesson of that name"),
        (f'first = "low"\n{PLAN}', "extends no plan"),
        ("task = 3 4", "is no plan"),
        ('task = "hurdling"', "needs a task and"),
        ('task = "chess"\nlessons = [{name="a"}]', "no task 'chess'"),
        ('task = "hurdling"\nlessons = [{name="a", task="chess"}]', "no task 'chess'"),
        ('task = "golf"\nlessons = [{name="a", task="hurdling"}]', "last lesson is of 'hurdling'"),
        ('task = "hurdling"\nlessons = []', "no lesson in it"),
        ('task = "hurdling"\nlessons = [{name="a"}, {name="a"}]', "same name"),
        ('task = "hurdling"\nlessons = [{name="a/b"}]', "must do for a folder"),
        ('task = "hurdling"\nlessons = [{name="a", options="--out x"}]', "leave --out out"),
        ('task = "hurdling"\nlessons = [{name="a", options="\'"}]', "is no plan"),
        (PLAN.replace("{curriculum/h_max}", "{h_max}"), r"\{h_max\} is not known"),
    ],
)
def test_plans_that_cannot_be_are_refused_in_a_sentence(text, words, tmp_path, capsys):
    path = written(tmp_path / "plan.toml", text)
    quick = ["--samples", "16", "--out", str(tmp_path / "out")]
    assert cli.main(["lessons", str(path), *quick]) == 2
    error = capsys.readouterr().err
    assert re.search(words, error) and error.count("\n") == 1


def test_command_line(tmp_path, capsys):
    path = str(written(tmp_path / "plan.toml"))
    assert cli.main(["lessons", "--help"]) == 0
    assert "hurdling_latent: " in capsys.readouterr().out
    assert cli.main(["lessons", path, "--show", "--seed", "7"]) == 0
    text = capsys.readouterr().out
    assert all(len(line) < 100 for line in text.splitlines())
    text = text.replace("\\\n", " ")
    lines = [x for x in text.splitlines() if x.startswith("olympics-opt ")]
    low = parse_args(shlex.split(lines[0])[2:])
    assert (low.seed, low.samples, low.out.name, low.init) == (7, 320, "low", None)
    assert "--init low" in lines[1] and len(lines) == 2
    for args, words in (
        (["nowhere"], "there is no plan 'nowhere'"),
        (["--show"], "say which plan"),
        ([path, "--resume"], "leave --resume out"),
    ):
        assert cli.main(["lessons", *args]) == 2
        assert words in capsys.readouterr().err


def test_the_recipe_tells_all_lessons(tmp_path, capsys):
    plan = load_plan(str(written(tmp_path / "plan.toml")))
    teach(plan, tmp_path / "out")
    text, (low, high) = recipe(tmp_path / "out" / "policy.safetensors", capsys)
    assert low.init is None and high.init == str(low.out)
    assert (low.samples, high.samples, high.ppo.gamma) == (320, 48, 0.9)
    assert high.options["first_max"] != 0.3 or low.options["first_max"] == 0.3
    assert "Not in the project" not in text
