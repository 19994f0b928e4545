import json
from pathlib import Path

import numpy as np
import pytest

from olympics_opt.cli import main
from warmstart.bank import demonstration_files

KICK = str(demonstration_files("penalty_kick")[0])


def test_panel_of_a_demonstration_is_printed_and_written(tmp_path: Path, capsys) -> None:
    out, picture = tmp_path / "kick.json", tmp_path / "kick.png"
    assert main(["likeness", KICK, "--out", str(out), "--chart", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "people, at most" in printed and "penalty_kick_15mps_human" in printed
    panel = json.loads(out.read_text())
    assert panel["reference"]["split"] == "held_out" and panel["motions"] == 1
    assert panel["likeness"]["torque"]["mean"] <= 1.001  # it was optimised within these limits
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_policies_are_played_each_in_its_task(tmp_path: Path, capsys) -> None:
    words = ["likeness", "pretrained", "--task", "long_jump", "--trials", "2"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    names = sorted(p.name for p in tmp_path.glob("*.json"))
    latent, *names = names
    assert latent == "likeness_long_jump_latent_human.json"
    assert names == ["likeness_long_jump_ppo_human.json", "likeness_long_jump_ppo_paper.json"]
    human, paper = (json.loads((tmp_path / n).read_text()) for n in names)
    assert human["strength"] == "human" and paper["strength"] == "paper"
    assert human["trials"] == paper["trials"] == 2
    assert human["likeness"]["torque"]["mean"] < 1.01 < paper["likeness"]["torque"]["mean"]
    assert "metrics" not in human  # so that no table of scores takes it for one
    printed = capsys.readouterr().out
    assert "long_jump_ppo_paper" in printed and "*" in printed


def test_a_policy_file_is_played_in_the_task_of_its_card(tmp_path: Path) -> None:
    from rl.pretrained import locate

    file = str(locate("long_jump", "ppo-human"))
    assert main(["likeness", file, "--trials", "1", "--out", str(tmp_path / "a.json")]) == 0
    assert json.loads((tmp_path / "a.json").read_text())["task"] == "long_jump"


def test_a_run_is_played_in_the_task_that_it_trains(tmp_path: Path) -> None:
    run = tmp_path / "run"
    words = ["train", "long_jump", "--algo", "ppo", "--engine", "mujoco", "--worlds", "4"]
    assert main([*words, "--samples", "200", "--out", str(run)]) == 0
    out = tmp_path / "panels"
    assert main(["likeness", str(run), KICK, "--trials", "1", "--out", str(out)]) == 0
    assert json.loads((out / "likeness_run.json").read_text())["task"] == "long_jump"
    assert (out / "likeness_penalty_kick_15mps_human.json").exists()


def test_panel_stands_beside_the_score(tmp_path: Path, capsys) -> None:
    out = tmp_path / "jump.json"
    words = ["evaluate", "long_jump", "--policy", "pretrained", "--trials", "3", "--out", str(out)]
    assert main([*words, "--likeness", "reference"]) == 0
    result = json.loads(out.read_text())
    assert result["trials"] == 3 and result["metrics"]["success"]["n"] == 3
    assert result["likeness"]["motions"] == 3
    assert result["likeness"]["likeness"]["frechet"]["within"] is False
    assert "people, at most" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nothing.npz"], "nothing.npz"),
        (["random"], "--task"),
        (["pretrained", "--task", "running"], "running"),
        (["pretrained:chess"], "no policy"),
        ([KICK, "--trials", "0"], "trials"),
        ([KICK, KICK, "--out", "a.json"], "folder"),
        ([KICK, "--chart", "a.pdf"], ".png"),
        ([KICK, "--clips", "nowhere.npz"], "nowhere.npz"),
    ],
)
def test_mistakes_are_one_sentence_and_write_nothing(
    words: list[str], says: str, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["likeness", *words]) == 2
    error = capsys.readouterr().err
    assert says in error and "Traceback" not in error
    assert not list(tmp_path.iterdir())


def test_a_library_of_ones_own_can_be_the_reference(tmp_path: Path) -> None:
    from tests.rl.motions_still import BODY, standing, swinging
    from warmstart.clip import Clip
    from warmstart.library import Origin, pack

    named, i = [], 0
    while len(named) < 12:
        name, i = f"mine/{i}", i + 1
        if Origin(name, "", "", "", "").held_out:
            motion = swinging(standing(61), 0.2 + 0.03 * len(named), 1.0, ("L_Shoulder_x",))
            named.append((name, Clip(30.0, "smpl", motion.qpos, np.zeros((61, 6 + BODY.num_dofs)))))
    pack(named).save(tmp_path / "library.npz")
    out = tmp_path / "out.json"
    words = ["likeness", KICK, "--clips", str(tmp_path / "library.npz"), "--out", str(out)]
    assert main(words) == 0
    assert set(json.loads(out.read_text())["reference"]["archives"]) == {"mine"}
