"""``solve --all`` on two made-up problems: the table, what is kept, what is refused."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from olympics_opt.solve_many import solve_all
from tests.warmstart.fakes import FAKE
from warmstart.explain import explain
from warmstart.problems import PROBLEMS

HEAD = {"commit", "versions", "hardware", "system", "rows"}
"""What every table of measured figures in results/ holds."""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """A registry of two problems, one of which has no solution, and its log of solves."""
    (tmp_path / "fake_registry.py").write_text(FAKE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "log"))
    yield tmp_path / "log"
    sys.modules.pop("fake_registry", None)


def run(out: Path, **settings):
    return solve_all(
        out, **{"certify": False, "track": False, "registry": "fake_registry", **settings}
    )


def test_every_problem_is_a_row_and_a_failure_stops_nothing(fake, tmp_path, capsys):
    out = tmp_path / "out"
    results = run(out)
    assert [(r.name, r.status) for r in results] == [("high_jump", "solved"), ("hop", "infeasible")]
    assert "no flight after a stance" in results[0].opinion["why not"]
    found = json.loads((out / "warmstart.json").read_text())
    assert found.keys() >= HEAD and "numpy" in found["versions"]
    jump, hop = found["rows"]
    assert (jump["problem"], jump["asked"], jump["unit"]) == ("high_jump", 1.0, "m")
    assert jump["figures"]["iterations"] == 7 and jump["figures"]["violation"] == 1e-7
    assert jump["made"]["commit"] == found["commit"]
    assert hop["status"] == "infeasible" and "L_Ankle_y" in hop["reason"]
    text = capsys.readouterr().out
    for words in ("high_jump 0.5 7 1.0e-07 1 m – – – – – solved", "hop – 1 m"):
        assert any(words in " ".join(line.split()) for line in text.splitlines()), text
    assert "hop: infeasible: nobody hops: torque of L_Ankle_y" in text
    assert "high_jump: no second opinion: " in text
    assert [case.status for case in explain(out)] == ["solved", "infeasible"]

    # Started again, nothing is solved; without one result, that one.
    lines = fake.read_text()
    assert run(out) == results and fake.read_text() == lines
    (out / "high_jump.npz").unlink()
    assert [r.status for r in run(out)] == ["solved", "infeasible"]
    assert fake.read_text() == lines + "1 None\n"


def test_another_table_is_not_written_over(fake, tmp_path):
    out = tmp_path / "out"
    run(out, second_opinion=False)
    before = (out / "warmstart.json").read_bytes()
    with pytest.raises(ValueError, match="made with the settings"):
        run(out, second_opinion=True)
    assert (out / "warmstart.json").read_bytes() == before
    (out / "warmstart.json").write_text('{"rows": []}')
    with pytest.raises(ValueError, match="not a table of"):
        run(out)


def test_the_registered_problems_have_what_a_row_needs():
    for name, problem in PROBLEMS.items():
        asked = getattr(problem.config(), problem.outcome)
        assert name == problem.name and asked > 0 and problem.unit
