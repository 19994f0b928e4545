"""``olympics-opt polish`` from the command line."""

from __future__ import annotations

from pathlib import Path

from olympics_opt import cli
from rl.policy import load_policy


def test_a_policy_is_polished_with_the_options_of_its_task(tmp_path: Path, capsys):
    out = tmp_path / "polished"
    words = ["polish", "hurdling", "--policy", "pretrained:latent", "--out", str(out)]
    words += ["--candidates", "4", "--episodes", "1", "--generations", "1", "--components", "0"]
    words += ["--objective", "success=1 time=-0.3@18.2", "--task.finish-ends"]
    assert cli.main(words) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "iteration 1 |" in text and "olympics-opt evaluate hurdling" in text
    card = load_policy(out / "policy.safetensors", "hurdling").metadata
    assert card["polish"]["episodes"] == 5
    assert card["polish"]["objective"] == "success=1 time=-0.3@18.2"


def test_mistakes_are_one_sentence(tmp_path: Path, capsys):
    base = ["polish", "long_jump", "--out", str(tmp_path / "none")]
    for more, said in (
        (["--policy", "zero", "--minutes", "1"], "no weights"),
        (["--policy", "pretrained"], "generations or minutes"),
        (["--policy", "pretrained", "--minutes", "1", "--objective", "x=1"], "no metric 'x'"),
    ):
        assert cli.main(base + more) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
