"""The statistics of a verification against published values and closed forms; its verdicts."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from olympics_opt import cli
from olympics_opt.verify import compare, compare_metric, judge, success_difference


def sample(hits: int, trials: int) -> np.ndarray:
    return (np.arange(trials) < hits).astype(float)


@pytest.mark.parametrize(
    "first, second, low, high",
    [
        # Newcombe 1998 (Statistics in Medicine 17, 873-890), table II, method 10: p1 - p2.
        ((56, 70), (48, 80), 0.0524, 0.3339),
        ((9, 10), (3, 10), 0.1705, 0.8090),
        ((5, 56), (0, 29), -0.0381, 0.1926),
        ((10, 10), (0, 10), 0.6075, 1.0000),
    ],
)
def test_interval_of_a_difference_is_the_published_one(first, second, low, high):
    d = success_difference(sample(*second), sample(*first))
    assert (d.low, d.high) == pytest.approx((low, high), abs=6e-5)


@given(st.integers(1, 60), st.integers(1, 60), st.data())
def test_interval_holds_the_difference_and_mirrors(n: int, m: int, data):
    a = sample(data.draw(st.integers(0, n)), n)
    b = sample(data.draw(st.integers(0, m)), m)
    there, back = success_difference(a, b), success_difference(b, a)
    assert -1 - 1e-9 <= there.low <= there.difference <= there.high <= 1 + 1e-9
    assert (back.low, back.high) == pytest.approx((-there.high, -there.low))


def test_permutation_test_is_exact_on_small_samples():
    rng = np.random.default_rng(3)
    a, b = rng.normal(0, 1, 5), rng.normal(1.2, 1, 4)
    found = compare_metric("m", a, b)
    pooled = np.concatenate([a, b])
    gaps = []
    for rows in itertools.combinations(range(9), 5):
        rest = [i for i in range(9) if i not in rows]
        gaps.append(pooled[list(rows)].mean() - pooled[rest].mean())
    below = np.mean(np.array(gaps) <= a.mean() - b.mean() + 1e-12)
    above = np.mean(np.array(gaps) >= a.mean() - b.mean() - 1e-12)
    assert found is not None
    assert found.permutation_p == pytest.approx(min(1, 2 * min(below, above)), abs=1e-9)


def test_ks_distance_is_the_largest_gap_of_the_distributions():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=40), rng.normal(0.5, size=30)
    found = compare_metric("m", np.append(a, np.nan), b)
    grid = np.concatenate([a, b])
    gap = max(abs(np.mean(a <= x) - np.mean(b <= x)) for x in grid)
    assert found is not None and found.ks == pytest.approx(gap)
    assert found.reference_mean == pytest.approx(a.mean())


def test_a_sample_without_values_is_not_compared():
    assert compare_metric("m", np.array([1.0, np.nan]), np.ones(5)) is None
    with pytest.raises(ValueError, match="at least one trial"):
        success_difference(np.array([]), np.ones(3))


def run(mujoco: float, half: float, drake: float, bad: int = 0, parity: bool = True):
    rates = {"mujoco": mujoco, "mujoco-half-step": half, "drake": drake}
    return judge(rates, {"mujoco": 0, "mujoco-half-step": 0, "drake": bad}, parity)


def test_verdicts():
    assert run(1.0, 1.0, 0.95).passed
    assert run(0.5, 0.5, 0.45).passed  # it keeps 90 % of the success, not 90 % success
    failed = run(1.0, 1.0, 0.85)
    assert not failed.passed and "85%" in failed.reasons[0]
    both = run(1.0, 0.8, 0.85)  # half the step loses as much: the policy, not the engine
    assert both.passed and "time step" in both.notes[0]
    assert not run(1.0, 0.88, 0.85).passed  # it loses less than Drake
    assert run(1.0, 0.5, 1.0).notes
    assert not run(0.0, 0.0, 0.0).passed
    assert not run(1.0, 1.0, 1.0, bad=1).passed
    assert not run(1.0, 1.0, 1.0, parity=False).passed


def test_a_comparison_of_equal_samples_finds_nothing():
    rng = np.random.default_rng(0)
    sample_ = {"success": (rng.random(50) < 0.9).astype(float), "height": rng.normal(size=50)}
    runs = ("mujoco", "mujoco-half-step", "drake")
    found = compare(
        {r: {"overflow": 0, "nan_worlds": 0} for r in runs}, dict.fromkeys(runs, sample_)
    )
    assert found["verdict"]["passed"] and found["verdict"]["kept"] == 1.0
    for run_ in runs[1:]:
        assert found["success"][run_]["low"] < 0 < found["success"][run_]["high"]
        (height,) = found["comparisons"][run_]
        assert height["ks"] == 0.0 and height["permutation_p"] > 0.9


def test_standing_still_verifies_nothing_and_still_gets_its_report(tmp_path: Path, capsys):
    """The whole command on a policy that only stands: parity first, then scores, then exit 1."""
    line = ["verify", "high_jump", "--policy", "zero", "--trials", "2", "--processes", "1"]
    line += ["--parting-steps", "5"]
    assert cli.main([*line, "--out", str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert out.index("mass matrix") < out.index("trials")
    assert "never succeeds in MuJoCo" in out
    report = json.loads((tmp_path / "report.json").read_text())
    assert not report["verdict"]["passed"]
    assert all(row["ok"] for row in report["parity"])
    assert set(report["results"]) == {"mujoco", "mujoco-half-step", "drake"}
    half, whole = (report["results"][r]["timestep"] for r in ("mujoco-half-step", "mujoco"))
    assert half == pytest.approx(whole / 2)
    page = (tmp_path / "report.html").read_text()
    assert "Parity of the models" in page and "replay-verify" in page
    # Standing still, engines hardly part, and only feet touch the ground.
    assert report["parting"]["steps"] == 4 * 5 and report["parting"]["velocity"] < 0.1
    assert {f["link"][2:] for f in report["parting"]["forces"]} == {"Ankle", "Toe"}
    assert "Where the engines part" in page and "MuJoCo at 1/480 s" in page
    for step in ("4 x 1/120 s", "8 x 1/240 s", "16 x 1/480 s"):  # of the three runs
        assert f">{step}<" in page


def test_models_that_differ_are_not_scored(tmp_path: Path, monkeypatch, capsys):
    def different(task, strength, limits):
        row = {"quantity": "mass", "mujoco": 1.0, "drake": 2.0, "difference": 1.0}
        return [{**row, "unit": "kg", "tolerance": 1e-9, "ok": False}]

    monkeypatch.setattr("olympics_opt.verify.parity_rows", different)
    line = ["verify", "high_jump", "--policy", "zero", "--trials", "2", "--out", str(tmp_path)]
    assert cli.main(line) == 1
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["results"] == {} and report["parting"] is None
    assert "differ" in report["verdict"]["reasons"][0]
    assert "must not be compared" in (tmp_path / "report.html").read_text()
