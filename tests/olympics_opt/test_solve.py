"""``solve`` beside its second opinion: the real command on a stored optimum and on none."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("casadi")
pytest.importorskip("pydrake")

import warmstart.drake_nlp
from olympics_opt import cli
from tests.olympics_opt.test_study import standing
from tests.warmstart.test_drake_nlp import DATA, HELD
from warmstart.certificate import Certificate
from warmstart.problems import Infeasible
from warmstart.solution import Solution

REAL = warmstart.drake_nlp.second_opinion
LINE = ["solve", "high_jump", "--no-track", "--second-opinion", "--out"]


def stored(problem: str, config: object, out: Path) -> Solution:
    """In place of the optimiser: its solution for a bar of 1.0 m."""
    return Solution.load(DATA / "high_jump_1.0_human.npz")


def test_a_second_opinion_is_printed_stored_and_shown(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr("olympics_opt.solve.optimise", stored)
    quick = lambda solution: REAL(solution, iterations=2, held_limits=HELD)  # noqa: E731
    monkeypatch.setattr("warmstart.drake_nlp.second_opinion", quick)
    code = cli.main([*LINE, str(tmp_path)])
    out = capsys.readouterr().out
    assert "second opinion: Drake " in out
    data = json.loads((tmp_path / "certificate.json").read_text())
    opinion = data["second_opinion"]
    # SNOPT has hardly begun, but Drake's derivatives say already that the motion is optimal.
    assert opinion["stationarity"] < 0.02 and opinion["reference_violation"] < 1e-4
    assert opinion["asked"] == {"bar_height": 1.0}
    saved = 1.0 - opinion["cost"] / opinion["reference_cost"]
    assert opinion["improvement"] == pytest.approx(saved)
    certificate = Certificate.from_json(tmp_path / "certificate.json")
    assert (code == 0) == certificate.passed  # an opinion neither proves nor refuses a motion
    assert "Second opinion</h2>" in (tmp_path / "preview.html").read_text()


def test_without_a_flight_there_is_nothing_to_ask(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr("olympics_opt.solve.optimise", standing)
    assert cli.main([*LINE, str(tmp_path)]) == 2
    assert "no flight after a stance" in capsys.readouterr().err
    assert not (tmp_path / "demo.npz").exists()


def test_a_failure_is_kept_with_its_reason_and_told_again(tmp_path: Path, monkeypatch, capsys):
    """The certificate of an earlier solve with other options does not stay beside it."""

    def impossible(problem: str, config: object, out: Path) -> Solution:
        raise Infeasible("a bar at 2.4 m is infeasible: L_Ankle_y 137 %")

    monkeypatch.setattr("olympics_opt.solve.optimise", impossible)
    for name in ("certificate.json", "demo.npz", "solution.npz"):
        (tmp_path / name).write_text("of another bar")
    line = ["solve", "high_jump", "--problem.bar-height", "2.4", "--out", str(tmp_path)]
    assert cli.main(line) == 2
    assert "L_Ankle_y 137 %" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["solution.json"]
    assert cli.main(["solve", "--explain", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "infeasible (high_jump, asked 2.4)" in out and "L_Ankle_y 137 %" in out
    assert "0 of 1 passed" in out
