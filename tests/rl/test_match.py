"""Matches: sides cancel, A against B is B against A turned, known orders, the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from olympics_opt.cli import COMMANDS, chosen_options, main, parse
from olympics_opt.match import find_task
from rl.elo import difference
from rl.match import Pair, Setting, _half, play_games, play_ladder, play_match, task_of
from rl.policy import PolicyError
from rl.pretrained import locate
from tests.rl.contest import Contest, speaker

TOY = Setting(task="contest", trials=60, worlds=8)


def make(worlds: int, seed: int) -> Contest:
    return Contest(worlds, seed)


def half_of(pair, games: int = 40, seed: int = 3) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    return _half(pair, make, games, seed, 8, lambda done: None)


def test_changing_sides_turns_every_game():
    """The same numbers are shown, so each single game turns, not only their sum."""
    a, b = speaker(0.0), speaker(0.35)
    ours, figures = half_of((a, b))
    theirs, others = half_of((b, a))
    assert np.array_equal(ours, -theirs) and {-1.0, 1.0} <= set(ours)
    assert np.array_equal(figures["success"], (ours > 0).astype(float))
    assert np.array_equal(others["success"], (ours < 0).astype(float))


def test_a_match_is_antisymmetric():
    a, b = speaker(0.0), speaker(0.35)
    there, back = play_match(a, b, TOY, make=make), play_match(b, a, TOY, make=make)
    for name, other in (("wins", "losses"), ("draws", "draws"), ("losses", "wins")):
        assert there["metrics"][name] == back["metrics"][other]
    score, turned = there["metrics"]["score"], back["metrics"]["score"]
    assert 0.5 < score["mean"] < 1.0 and score["n"] == 60
    assert score["mean"] + turned["mean"] == pytest.approx(1.0, abs=1e-12)
    elo, other = (m["metrics"]["elo_difference"] for m in (there, back))
    assert elo["mean"] == pytest.approx(-other["mean"])
    assert elo["ci95"] == pytest.approx([-x for x in other["ci95"][::-1]])
    assert elo["mean"] == pytest.approx(difference(score["mean"]))
    assert there["opponent_metrics"] == {"success": back["metrics"]["success"]}
    assert (there["algo"], there["policy_sha256"]) == ("ppo against ppo", "0.0")


def test_a_pair_moves_each_team_by_its_own_policy():
    """Two against two; the sum of a team's says is its policy's."""
    a, b = speaker(0.1, seed=1), speaker(-0.4, seed=2)
    obs = torch.rand(5, 4, 2, generator=torch.Generator().manual_seed(0))
    pair = Pair(a, b)
    told = pair(obs)
    assert torch.equal(told[:, :2], a(obs[:, :2])) and torch.equal(told[:, 2:], b(obs[:, 2:]))
    pair.check(Contest(2, half=2))
    assert pair.metadata["algo"] == "ppo against ppo"


def test_equals_draw():
    games = play_games(speaker(0.2), speaker(0.2), make, 20, worlds=4)
    assert (games.wins, games.draws, games.losses, games.unrated) == (0, 20, 0, 0)


def test_a_game_that_diverged_is_not_rated():
    class Broken(Contest):
        """World 1 diverges in the second step."""

        def step(self, action):
            result = super().step(action)
            result.valid = ~((self.age == 2) & (torch.arange(self.num_worlds) == 1))
            return result

    def broken(worlds: int, seed: int) -> Broken:
        return Broken(worlds, seed)

    games = play_games(speaker(0.0), speaker(0.35), broken, 16, worlds=8)
    assert games.unrated == 2
    assert games.wins + games.draws + games.losses == 14


def test_a_ladder_puts_the_strongest_first(tmp_path):
    """law(x) = 0.8 x - 0.1 is -0.1 in the mean: who says a number nearer to that is stronger."""
    cards = []
    for bias in (0.6, -0.1, 0.2):
        cards.append(speaker(bias))
    result = play_ladder(cards, TOY, make=make)
    assert [p["policy_sha256"] for p in result["players"]] == ["-0.1", "0.2", "0.6"]
    assert len(result["matches"]) == 3
    ratings = {p["policy_sha256"]: p["elo"] for p in result["players"]}
    assert ratings["0.6"]["mean"] == 0.0 and ratings["0.6"]["n"] == 120
    low, high = ratings["0.2"]["ci95"]
    assert low < ratings["0.2"]["mean"] < high < ratings["-0.1"]["mean"] + 400
    total = sum(p["wins"] - p["losses"] for p in result["players"])
    assert total == 0 and sum(p["wins"] for p in result["players"]) <= 180
    with pytest.raises(ValueError, match="two policies"):
        play_ladder(cards[:1], TOY, make=make)


def test_mistakes_are_sentences():
    with pytest.raises(ValueError, match="even"):
        play_games(speaker(0.0), speaker(0.1), make, 7)
    with pytest.raises(ValueError, match="--task"):
        task_of(["zero", "random"], "")
    with pytest.raises(ValueError, match="no two sides"):
        play_match("zero", "zero", Setting(task="long_jump", trials=2))
    stranger = speaker(0.0)
    stranger.metadata["obs_size"] = 3
    with pytest.raises(PolicyError, match="obs_size"):
        play_games(stranger, speaker(0.1), make, 4)


def test_the_command_writes_a_result_of_the_schema(tmp_path, capsys):
    """Real fencing: who stands still against who thrashes about."""
    out = tmp_path / "match.json"
    args = ["match", "zero", "random", "--task", "fencing", "--trials", "6", "--out", str(out)]
    assert main(args) == 0
    result = json.loads(out.read_text())
    needed = "task algo policy_sha256 engine strength limits trials seed commit versions hardware"
    assert set(needed.split()) <= set(result)
    assert (result["task"], result["algo"], result["trials"]) == (
        "fencing",
        "zero against random",
        6,
    )
    assert result["metrics"]["wins"]["mean"] == 1.0  # the other one falls
    assert result["metrics"]["opponent_fell"]["mean"] == 1.0
    assert result["opponent_metrics"]["fell"]["mean"] == 1.0
    assert result["metrics"]["elo_difference"]["mean"] is None  # infinite
    assert result["metrics"]["elo_difference"]["ci95"][0] > 0.0
    assert "wins" in capsys.readouterr().out
    args[-1] = str(tmp_path / "parted.json")
    assert main([*args, "--task.part", "--task.knock-down", "2.5"]) == 0
    parted = json.loads((tmp_path / "parted.json").read_text())
    assert parted["options"] == {"part": True, "knock_down": 2.5} and result["options"] == {}
    capsys.readouterr()
    mistakes = [["zero"], ["zero", "zero", "zero"], ["zero", "nobody", "--task", "boxing"]]
    mistakes += [["zero", "random", "--task.part"], ["zero", "nobody", "--task.part"]]
    mistakes.append(["zero", "random", "--task", "boxing", "--task.parts"])
    for wrong in mistakes:
        assert main(["match", *wrong]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
    for value in ("part=2", "point=-1", "point=true", "point=x"):
        assert main(["match", "zero", "random", "--task", "boxing", f"--task.{value}"]) == 2
        assert value.partition("=")[2] in capsys.readouterr().err


def test_whose_options_are_set_is_found_on_the_line():
    boxer = str(locate("boxing", "selfplay"))
    for line, task in (
        ("zero random", None),
        (f"{boxer} zero --trials 4", None),
        ("zero random --task.part --task boxing", "boxing"),
        ("--task=fencing zero random", "fencing"),
        (f"zero {boxer} --task.knock-down 2.5", "boxing"),
        (f"--ladder --task.no-part {boxer} zero random", "boxing"),
    ):
        assert find_task(line.split()) == task
    config = parse("match", COMMANDS["match"], [boxer, "zero", "--task.part"])
    assert (config.policies, config.sport) == ((boxer, "zero"), "")
    assert chosen_options(config, "task") == {"part": True}
    assert chosen_options(parse("match", COMMANDS["match"], [boxer, "zero"]), "task") == {}
