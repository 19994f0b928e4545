"""Reasons in words: hand-made certificates with known faults, failures kept, bad folders."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from importlib import resources
from pathlib import Path

import pytest

from warmstart.atomic import write_json
from warmstart.certificate import LIMITS, PROBLEM_LIMITS, Certificate, Check
from warmstart.explain import ELSE, advice_for, by_how_much, explain
from warmstart.job import Result


def certificate(**changed: float) -> Certificate:
    """Of a long jump that is well inside every limit but those that are given."""
    required = LIMITS | PROBLEM_LIMITS["long_jump"]
    checks = []
    for name, (sense, limit, unit) in required.items():
        inside = {"<=": min(0.0, limit - 1.0), ">=": limit + 1.0, "recorded": 1.0}[sense]
        value = changed.get(name.replace(" ", "_"), inside)
        checks.append(Check(name, value, sense, limit, unit, "L_Toe_y" if changed else ""))
    assert set(changed) <= {name.replace(" ", "_") for name in required}
    return Certificate("long_jump", {"length": 5.0}, "human", {"planned": 5.0}, tuple(checks), {})


def result(name: str, status: str, reason: str = "", **more) -> Result:
    return Result(name, "long_jump", 5.0, 5.0, status, reason, 1.0, **more)


def put(folder: Path, found: Result, proof: Certificate | None = None) -> None:
    write_json(folder / f"{found.name}.json", asdict(found))
    if found.status not in ("infeasible", "crashed"):
        (folder / f"{found.name}.npz").write_bytes(b"")
    if proof is not None:
        proof.to_json(folder / f"{found.name}.certificate.json")


def test_which_check_failed_by_how_much_and_what_to_try(tmp_path):
    put(tmp_path, result("a", "rejected"), certificate(friction=0.011, planned_outcome=-0.5))
    (case,) = explain(tmp_path)
    assert not case.passed and [c.name for c in case.failed] == ["friction", "planned outcome"]
    text = "\n".join(case.lines())
    assert "friction: is 0.011 body weight, must be <= 0.001: 0.01 off, 11 times it" in text
    assert "planned outcome: is -0.5 m, must be >= 0: 0.5 off" in text
    assert "L_Toe_y" in text and "the foot would slip" in text
    assert f"{case.checks - 2} of {case.checks} checks" in text


def test_what_could_not_be_computed_says_why(tmp_path):
    broken = replace(
        certificate(friction=float("nan")), stats={"not computed": ["contact: ValueError: no foot"]}
    )
    put(tmp_path, result("a", "rejected"), broken)
    text = "\n".join(explain(tmp_path)[0].lines())
    assert "friction: could not be computed" in text and "ValueError: no foot" in text


def test_failures_without_a_motion_are_told_too(tmp_path):
    put(tmp_path, result("a", "infeasible", "no motion within the torque limits of L_Knee_y"))
    put(tmp_path, result("b", "crashed", "its process ended with code 9"))
    put(tmp_path, result("c", "untracked", "it fell"), certificate())
    put(tmp_path, result("d", "certified", start="long_jump_4"), certificate())
    # Beside an attempt without a motion lies the certificate of an earlier one: not its own.
    certificate().to_json(tmp_path / "a.certificate.json")
    cases = {case.name: case for case in explain(tmp_path)}
    assert [case.passed for case in cases.values()] == [False, False, False, True]
    lines = {name: case.lines() for name, case in cases.items()}
    assert "L_Knee_y" in lines["a"][1] and "--continuation" in lines["a"][-1]
    assert "code 9" in lines["b"][1] and "run the same command again" in lines["b"][-1]
    assert "it fell" in lines["c"][1]
    assert len(lines["d"]) == 1 and "from long_jump_4" in lines["d"][0]


def test_what_a_file_says_of_itself_is_not_believed(tmp_path):
    put(tmp_path, result("a", "certified"), certificate(friction=0.5))
    assert explain(tmp_path)[0].status == "rejected"
    data = json.loads((tmp_path / "a.certificate.json").read_text())
    data["checks"] = [c for c in data["checks"] if c["name"] != "friction"] and data["checks"][:3]
    data["passed"] = True
    (tmp_path / "a.certificate.json").write_text(json.dumps(data))
    (case,) = explain(tmp_path)
    assert case.status == "rejected" and "friction is missing" in case.reason


def test_shipped_certificates_pass():
    cases = explain(Path(str(resources.files("warmstart").joinpath("data"))))
    assert len(cases) >= 7
    assert all(case.passed for case in cases), [c.lines() for c in cases if not c.passed]


def test_a_folder_of_a_single_solve(tmp_path):
    """``solve`` names its files after what they are; the folder's name tells which motion it is."""
    out = tmp_path / "jump"
    put(out, result("solution", "rejected"))
    certificate(friction=0.5).to_json(out / "certificate.json")
    for folder in (out, tmp_path):  # itself, or the folder of several
        (case,) = explain(folder)
        assert case.name == "jump" and [c.name for c in case.failed] == ["friction"]


def test_every_check_has_advice():
    for name, (sense, limit, unit) in (LIMITS | PROBLEM_LIMITS["long_jump"]).items():
        assert advice_for(Check(name, 1.0, sense, limit, unit)) != ELSE, name
    assert advice_for(Check("something new", 1.0, "<=", 0.0, "m")) == ELSE
    assert by_how_much(Check("x", 0.5, "<=", 0.0, "m")) == "is 0.5 m, must be <= 0: 0.5 off"


def test_a_folder_without_results_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no folder at"):
        explain(tmp_path / "nowhere")
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match="holds no result"):
        explain(tmp_path)
    (tmp_path / "certificate.json").write_text('{"checks": [{}]}')
    with pytest.raises(ValueError, match="not a readable certificate"):
        explain(tmp_path)
