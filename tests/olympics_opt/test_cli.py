"""The command line: help for everything it lists, and one sentence for every mistake."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from olympics_opt import cli
from rl import pretrained
from rl.ppo import PPOConfig
from sports.registry import task_names

HEAVY = ("pydrake", "casadi", "torch", "mujoco", "warp", "matplotlib", "OpenGL", "scipy")


def sentence_of(capsys, *args: str) -> str:
    """Runs a mistaken command line; returns its one sentence."""
    assert cli.main(args) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return err


def test_importing_the_command_line_is_light():
    code = f"import sys, olympics_opt.cli; print([m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("own", [None, "ACTIVE"])
def test_waiting_threads_sleep_unless_the_user_says_otherwise(own, monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    if own is not None:
        monkeypatch.setenv("OMP_WAIT_POLICY", own)
    assert cli.main(["--version"]) == 0
    assert os.environ["OMP_WAIT_POLICY"] == (own or "PASSIVE")


def test_the_overview_lists_what_exists_and_nothing_else(capsys):
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for name in cli.COMMANDS:
        assert f"\n  {name} " in text
    for name in cli.LATER:
        assert f"\n  {name} " not in text
        assert f"no command '{name}'" in sentence_of(capsys, name)


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_has_help(name: str, capsys):
    assert cli.main([name, "--help"]) == 0
    out = capsys.readouterr().out
    assert f"olympics-opt {name}" in out
    assert "--" in out


def test_help_of_a_task_lists_its_options(capsys):
    assert cli.main(["evaluate", "high_jump", "--help"]) == 0
    text = capsys.readouterr().out
    assert "--task.bar-height" in text and "Height of the bar's top" in text


def test_options_of_a_task_reach_its_config():
    args = "--task.no-curriculum --policy=x high_jump --out y --task.bar_height=1.2".split()
    config = cli.parse("evaluate", cli.COMMANDS["evaluate"], args)
    assert config.name == "high_jump"
    assert cli.chosen_options(config, "task") == {"bar_height": 1.2, "curriculum": False}
    plain = cli.parse(
        "evaluate", cli.COMMANDS["evaluate"], ["long_jump", "--policy", "x", "--out", "y"]
    )
    assert cli.chosen_options(plain, "task") == {}


@pytest.mark.parametrize(
    "line, words",
    [
        ("fly", "unknown command 'fly'"),
        ("evaluate hi_jump --policy zero --out x.json", "unknown task 'hi_jump'"),
        ("evaluate hi_jump --policy zero --out x.json", "high_jump"),
        ("evaluate high_jump --policy zero --out x.json --task.bar 1", "--task.bar-height"),
        ("evaluate high_jump --policy zero --out x.json --task.bar-height 99", "not 99.0"),
        ("evaluate high_jump --policy nowhere --out x.json", "no policy 'nowhere'"),
        ("evaluate high_jump --policy zero --out x.json --trials 0", "trials"),
        ("verify high_jump --policy zero --trials 0 --out x", "trials"),
        ("verify high_jump --policy pretrained:xyz --out x", "pretrained policy 'xyz'"),
        ("solve pole_vault --out x", "unknown problem 'pole_vault'"),
        ("solve high_jump --out x --problem.bar 1", "--problem.bar-height"),
        ("solve high_jump --out x --problem.bar-height 9", "bar_height"),
        ("solve high_jump --second-opinion --sweep bar-height=1:2:2 --out x", "leave out --sweep"),
        ("solve --out x", "name a problem"),
        ("solve high_jump", "--out FOLDER is needed"),
        ("solve high_jump --all --out x", "not both PROBLEM and --all"),
        ("solve --all --explain y --out x", "not both --all and --explain"),
        ("solve --all", "--out FOLDER is needed"),
        ("solve --explain nowhere", "no folder at nowhere"),
        ("solve high_jump --cluster auto --out x", "--cluster is for many"),
        ("solve high_jump --continuation --out x", "--continuation goes from value to value"),
        ("solve --all --sweep bar-height=1:2:2 --out x", "--sweep is about one problem"),
        ("solve --all --processes 0 --out x", "at least one process"),
        ("solve high_jump --sweep bar-height=1:2 --out x", "FIRST:LAST:COUNT"),
        ("solve high_jump --sweep height=1:2:2 --out x", "no option 'height'"),
        ("solve high_jump --sweep bar-height=1:9:2 --out x", "between 0.3 and 2.6 m, not 9.0"),
        ("solve high_jump --sweep strength=1:2:2 --out x", "is not a number"),
        ("study tennis --out x", "tennis"),
        ("export nowhere --out x.safetensors", "no run 'nowhere'"),
        ("export . --out x.bin", "must end in .safetensors"),
        ("export . --out x.safetensors", "no checkpoint yet"),
        ("export . --result y.json --out x.safetensors", "y.json"),
        ("leaderboard --results nowhere", "nowhere"),
    ],
)
def test_a_mistake_is_told_in_a_sentence(line: str, words: str, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = sentence_of(capsys, *line.split())
    assert words in text, text
    assert list(tmp_path.iterdir()) == []  # and nothing is written


@pytest.mark.parametrize(
    "line", ["evaluate", "evaluate high_jump", "evaluate high_jump --policy x --out y --trials ten"]
)
def test_an_incomplete_line_exits_2(line: str, capsys):
    assert cli.main(line.split()) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err and (out + err).strip()


def test_a_full_disk_is_named_as_such():
    error = OSError(errno.ENOSPC, "No space left on device", "/data/run/file.json")
    assert "disk is full while writing /data/run/file.json" in cli.sentence(error)


def test_debug_shows_where(monkeypatch):
    with pytest.raises(ValueError, match="unknown command"):
        cli.main(["fly", "--debug"])


def test_no_gpu_is_a_sentence(capsys, tmp_path):
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    out = tmp_path / "x.json"
    line = f"evaluate high_jump --policy zero --trials 1 --engine warp --out {out}"
    assert "engine 'warp'" in sentence_of(capsys, *line.split())
    assert not out.exists()


def test_list_as_json(capsys):
    assert cli.main(["list", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [t["name"] for t in found["tasks"]] == list(task_names())
    jump = found["tasks"][0]
    assert (jump["body"], jump["agents"], jump["act"]) == ("smpl", 1, 69)
    assert jump["obs"] == 358 + 6  # sports page: proprioception and goal features
    assert jump["metrics"]["height"] == "m"
    problems = {p["name"] for p in found["problems"]}
    assert problems >= {"high_jump", "long_jump", "hurdling", "tennis", "javelin"}
    for policy in found["pretrained"]:
        assert Path(policy["path"]).is_file()
    thrown = {d["name"]: d for d in found["demonstrations"]}["free_throw_1.2m_human"]
    assert thrown["motion"] == "refined in MuJoCo and Drake from a certified throw"
    assert thrown["plan_certified"] is True
    assert thrown["certified"] is thrown["throw"]["certified"] is True
    assert thrown["throw"]["mujoco"]["basket"] == thrown["throw"]["drake"]["basket"] == 1.0


def test_a_refined_throw_is_told_apart_in_the_table(capsys, monkeypatch):
    from olympics_opt import catalogue

    monkeypatch.setenv("COLUMNS", "400")
    rows = catalogue.catalogue()["demonstrations"]
    one, other = (row for row in rows if row["throw"])
    one["throw"]["why_not"] = "it was pushed"
    monkeypatch.setattr(catalogue, "catalogue", lambda: {"demonstrations": rows})
    assert cli.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    text = " ".join(" ".join(lines).split())
    assert text.count("Not certified:") == text.count("Not certified: it was pushed") == 1
    for throw in (one["throw"], other["throw"]):
        assert f"drake: {throw['drake']['release_speed']:.2f} m/s" in text
    assert text.count("refined in MuJoCo and Drake from a certified throw") == 2


SCHEMA = {
    *("task", "algo", "policy_sha256", "engine", "strength", "limits", "trials", "seed"),
    *("commit", "versions", "hardware", "metrics", "overflow", "nan_worlds"),
}
"""Fields that every result file must have."""


def test_evaluate_writes_the_schema_and_repeats_itself(tmp_path: Path):
    results = []
    for name in ("a.json", "b.json"):
        out = tmp_path / name
        line = f"evaluate long_jump --policy random --trials 3 --seed 5 --out {out}"
        assert cli.main(line.split()) == 0
        results.append(json.loads(out.read_text()))
    assert results[0].keys() >= SCHEMA
    assert results[0] == results[1]
    success = results[0]["metrics"]["success"]
    assert success.keys() == {"mean", "ci95", "n", "unit"} and success["n"] == 3


def test_felt_damping_is_played_and_told(tmp_path: Path, capsys):
    """The same falls on the ground, another motion; the result says with what it was made."""
    results = []
    for switch in ("", "--felt-damping"):
        out = tmp_path / f"x{switch}.json"
        line = f"evaluate hurdling --policy random --trials 2 {switch} --out {out}"
        assert cli.main(line.split()) == 0
        results.append(json.loads(out.read_text()))
    plain, felt = results
    assert "felt_damping" not in plain and felt["felt_damping"] is True
    assert plain["metrics"] != felt["metrics"]
    out = tmp_path / "drake.json"
    line = f"evaluate hurdling --policy zero --engine drake --felt-damping --out {out}"
    assert "always feel the joints' damping" in sentence_of(capsys, *line.split())
    assert not out.exists()


def test_worlds_that_vary_are_played_and_told(tmp_path: Path, capsys):
    """Four times as fine, with what swords touch rebounding: other bouts; mistakes are told."""
    line = "evaluate fencing --policy zero --trials 2 --seed 3"
    finer = "--timestep-divisor 4"
    varied = f"{finer} --vary --variation.rebound-share 1 --variation.friction 1 1"
    results = []
    for name, options in (
        ("plain", ""),
        ("finer", finer),
        ("varied", varied),
        ("again", varied),
        ("drake", "--like-drake"),
    ):
        out = tmp_path / f"{name}.json"
        assert cli.main(f"{line} {options} --out {out}".split()) == 0
        results.append(json.loads(out.read_text()))
    plain, fine, other, again, drake = results
    assert "timestep_divisor" not in plain and "variation" not in fine
    assert fine["timestep_divisor"] == 4 and fine["substeps"] == 4 * plain["substeps"]
    assert other["variation"]["rebound_share"] == 1.0 and other["variation"]["own_stride"] == 4
    assert other["metrics"] == again["metrics"]
    assert drake["variation"]["impratio"] == [2.0, 40.0] and drake["timestep"] == plain["timestep"]
    out = tmp_path / "wrong.json"
    for wrong, told in (
        ("--engine drake --vary", "drake has worlds of its own"),
        ("--engine drake --like-drake", "drake has worlds of its own"),
        ("--engine drake --timestep-divisor 2", "drake has time steps of its own"),
        ("--variation.rebound-share 1", "give --vary as well"),
        ("--timestep-divisor 0", "must be at least 1"),
        ("--vary --variation.rebound-share 1 --variation.rebound-links Sword", "no link"),
    ):
        assert told in sentence_of(capsys, *f"{line} {wrong} --out {out}".split())
        assert not out.exists()


def finer_policy(folder: Path, **settings: object) -> Path:
    """A small policy of the long jump whose card says at which time step it was trained."""
    from rl.policy import export_policy
    from rl.train import TrainConfig, train

    small = PPOConfig(hidden=(16, 16), steps=4, minibatches=1, epochs=1)
    config = TrainConfig("long_jump", folder / "run", worlds=2, samples=8, ppo=small, quiet=True)
    train(dataclasses.replace(config, **settings))
    return export_policy(folder / "run", folder / "policy")


@pytest.mark.parametrize("divisor, vary", [(1, False), (2, True)])
def test_every_policy_is_played_at_the_tasks_own_step(divisor, vary, tmp_path: Path, capsys):
    """4 x 1/120 s whatever its card says, and a line where the card says something else."""
    policy = finer_policy(tmp_path, timestep_divisor=divisor, vary=vary)
    out = tmp_path / "x.json"
    assert cli.main(f"evaluate long_jump --policy {policy} --trials 2 --out {out}".split()) == 0
    text = capsys.readouterr().out
    result = json.loads(out.read_text())
    assert (result["timestep"], result["substeps"]) == (pytest.approx(1 / 120), 4)
    assert "mujoco at 4 x 1/120 s" in text
    assert ("note: the policy was trained at 8 x 1/240 s" in text) == (divisor == 2)
    assert ("some of its worlds" in text) == vary


def test_a_switch_before_the_name_is_not_taken_for_its_option():
    config = cli.parse("solve", cli.COMMANDS["solve"], "--second-opinion high_jump --out y".split())
    assert (config.name, config.second_opinion) == ("high_jump", True)
    line = "--no-second-opinion high_jump --out y --problem.bar-height 1.2".split()
    assert cli.chosen_options(cli.parse("solve", cli.COMMANDS["solve"], line), "problem") == {
        "bar_height": 1.2
    }


def test_an_exported_policy_plays_like_its_run(tmp_path: Path, capsys):
    """From a run to a policy file with its measured card, and on to fine-tuning with its critic."""
    from rl.policy import load_policy
    from rl.train import TrainConfig, train

    run, out = tmp_path / "run", tmp_path / "policy.safetensors"
    finer_policy(tmp_path)
    line = f"evaluate long_jump --trials 2 --policy {run} --out {tmp_path / 'run.json'}"
    assert cli.main(line.split()) == 0
    line = f"export {run} --out {out} --critic --result {tmp_path / 'run.json'} --looks idle"
    assert cli.main(line.split()) == 0
    assert f"wrote {out}" in capsys.readouterr().out
    policy, whole = load_policy(out, "long_jump"), load_policy(run, "long_jump")
    result = json.loads((tmp_path / "run.json").read_text())
    assert policy.metadata["metrics"] == result["metrics"]
    assert policy.metadata["looks"] == "idle"
    obs = 3.0 * torch.randn(20, 1, policy.metadata["obs_size"])
    torch.testing.assert_close(policy(obs), whole(obs), atol=5e-3, rtol=5e-3)  # fp16
    limits = (1e-4, 1e-3)  # an actor that begins as another begins at the least rate
    small = PPOConfig(
        hidden=(16, 16), steps=4, minibatches=1, epochs=2, learning_rate_limits=limits
    )
    seen = []
    tuned = TrainConfig(
        "long_jump", tmp_path / "tuned", worlds=2, samples=8, init=str(out), ppo=small, quiet=True
    )
    train(tuned, on_iteration=seen.append)
    assert seen[0]["kl"] > 1e-6  # its actor learns at once: there is a critic

    # An evaluation of the export is one of the run; that of another policy is refused.
    again = f"export {run} --out {out} --critic --result {tmp_path / 'again.json'}"
    for of, code in ((out, 0), (tmp_path / "tuned", 2)):
        before, sha = out.read_bytes(), load_policy(of, "long_jump").metadata["sha256"]
        (tmp_path / "again.json").write_text(json.dumps({**result, "policy_sha256": sha}))
        assert cli.main(again.split()) == code
        assert out.read_bytes() == before
    assert "metrics are of another policy" in capsys.readouterr().err


def test_an_export_may_be_the_mean_of_several(tmp_path: Path, capsys):
    from rl.policy import load_policy

    run, out = tmp_path / "run", tmp_path / "mean.safetensors"
    finer_policy(tmp_path, keep_policies=True, checkpoint_iterations=1)
    kept = sorted((run / "policies").glob("*.safetensors"))
    assert [path.stem for path in kept] == ["000000000008"]
    line = f"export {run} --mean {kept[0]} --shares 1 3 --out {out}"
    assert cli.main(line.split()) == 0
    assert f"wrote {out}" in capsys.readouterr().out
    obs = torch.randn(20, 1, load_policy(run, "long_jump").metadata["obs_size"])
    mean, whole = load_policy(out, "long_jump"), load_policy(run, "long_jump")
    torch.testing.assert_close(mean(obs), whole(obs), atol=5e-3, rtol=5e-3)
    assert [part["share"] for part in mean.metadata["averaged"]] == [0.25, 0.75]
    for wrong, told in (
        (f"--mean {tmp_path / 'nothing'}", "there is no run"),
        ("--shares 1", "give the other policies with --mean"),
        (f"--mean {kept[0]} --shares 1", "2 policies need as many shares, not 1"),
        (f"--mean {tmp_path}", "has no checkpoint yet"),
    ):
        line = f"export {run} {wrong} --out {tmp_path / 'x.safetensors'}"
        assert told in sentence_of(capsys, *line.split())
        assert not (tmp_path / "x.safetensors").exists()


def test_an_export_in_int8_plays_its_task_unless_asked_not_to(tmp_path: Path, capsys, monkeypatch):
    from rl import calibration

    monkeypatch.setattr(calibration, "WORLDS", 2)
    monkeypatch.setattr(calibration, "STEPS", 5)
    policy = finer_policy(tmp_path)
    sizes, contents = set(), set()
    for name, flags in (("a", ""), ("b", "--no-fit")):
        out = tmp_path / f"{name}.safetensors"
        line = f"export {policy} --out {out} --precision int8 {flags}"
        assert cli.main(line.split()) == 0
        assert ("playing long_jump" in capsys.readouterr().out) == (flags == "")
        sizes.add(out.stat().st_size)
        contents.add(out.read_bytes())
    assert len(sizes) == 1 and len(contents) == 2


def test_evaluate_survives_no_place_to_write(tmp_path: Path, capsys):
    (tmp_path / "file").write_text("in the way")
    out = tmp_path / "file" / "result.json"
    line = f"evaluate high_jump --policy zero --trials 1 --out {out}"
    assert "file" in sentence_of(capsys, *line.split())


def test_a_result_does_not_take_the_place_of_the_policys_card(tmp_path: Path, capsys):
    weights = pretrained.locate("long_jump", "ppo")
    for suffix in (".safetensors", ".json"):
        shutil.copy(weights.with_suffix(suffix), tmp_path / f"jumper{suffix}")
    card = (tmp_path / "jumper.json").read_bytes()
    line = f"evaluate long_jump --policy {tmp_path / 'jumper.safetensors'} --trials 1 --out "
    said = sentence_of(capsys, *line.split(), str(tmp_path / "jumper.json"))
    assert "jumper.json is the card of jumper.safetensors" in said
    assert (tmp_path / "jumper.json").read_bytes() == card


def test_a_reader_that_has_seen_enough_is_no_mistake():
    done = subprocess.run(
        f"{sys.executable} -m olympics_opt list --json | head -c 10",
        shell=True,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout.startswith("{") and done.stderr == ""


def test_render_wants_something_to_write(capsys):
    assert "--sheet" in sentence_of(capsys, "render", "high_jump", "--policy", "zero")
    line = "render high_jump --policy zero --out picture.gif"
    assert ".mp4" in sentence_of(capsys, *line.split())


def test_reasons_are_told_again(capsys):
    data = Path(__file__).parents[2] / "warmstart" / "data"
    assert cli.main(["solve", "--explain", str(data)]) == 0
    out = capsys.readouterr().out
    assert "high_jump_1m_human: certified" in out and " passed" in out.splitlines()[-1]


def test_sweep_values():
    from olympics_opt.solve_many import sweep_values

    assert sweep_values("bar-height=0.8:1.4:3") == ("bar_height", [0.8, 1.1, 1.4])
    with pytest.raises(ValueError, match="FIRST:LAST:COUNT"):
        sweep_values("bar-height=0.8")
