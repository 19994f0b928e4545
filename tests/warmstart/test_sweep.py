"""Sweeps on a small made-up problem: resume, failures kept, processes that die, continuation."""

from __future__ import annotations

import json
import sys

import pytest

from warmstart.solution import Solution
from warmstart.sweep import sweep

FAKE = """
import os
from dataclasses import dataclass
import numpy as np
from sports.humanoid.body import load_body
from warmstart.solution import Solution

class Infeasible(RuntimeError):
    pass

@dataclass(frozen=True)
class Config:
    bar_height: float = 1.0
    log: str = ""

class Problem:
    config = Config
    def solve(self, config, guess=None):
        with open(config.log, "a") as file:
            file.write(f"{config.bar_height:g} {guess.asked['bar_height'] if guess else None}\\n")
        if config.bar_height > 2.5:
            raise Infeasible(f"no motion clears {config.bar_height} m: torque of L_Knee_y")
        if config.bar_height > 2.0:
            os._exit(9)
        if config.bar_height > 1.9:
            raise ZeroDivisionError("a bug")
        body = load_body("smpl")
        n = body.num_dofs
        qpos = np.zeros((3, 7 + n)); qpos[:, 3] = 1; qpos[:, 2] = config.bar_height
        zero = np.zeros((3, 6 + n))
        return Solution("high_jump", body, {"bar_height": config.bar_height}, "paper",
            np.array([0.0, 0.1, 0.2]), qpos, zero, zero, zero[:, 6:], (("L_Toe", (0., 0., 0.)),),
            np.zeros((3, 1, 3)), (("flight", 0, 2, ()),), {"objective": 2 * config.bar_height})

def get_problem(name):
    if name != "high_jump":
        raise ValueError(f"unknown problem '{name}'")
    return Problem()
"""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """Name of a registry module that spawned processes can import, and its log of solves."""
    (tmp_path / "fake_registry.py").write_text(FAKE)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "fake_registry", tmp_path / "log"
    sys.modules.pop("fake_registry", None)


def run(fake, out, values, **more):
    registry, log = fake
    return sweep(
        "high_jump",
        "bar_height",
        values,
        out,
        **{"options": {"log": str(log)}, "certify": False, "show": False, "registry": registry}
        | more,
    )


def test_failures_are_kept_and_the_rest_goes_on(fake, tmp_path):
    results = run(fake, tmp_path / "out", [0.8, 3.0, 2.2, 1.95])
    assert [r.status for r in results] == ["solved", "infeasible", "crashed", "crashed"]
    assert results[0].objective == 1.6
    assert "torque of L_Knee_y" in results[1].reason
    assert "code 9" in results[2].reason  # its process died without a word
    assert "a bug" in results[3].reason and "fake_registry.py" in results[3].reason
    table = json.loads((tmp_path / "out" / "sweep.json").read_text())
    assert [r["status"] for r in table["results"]] == [r.status for r in results]
    solution = Solution.load(tmp_path / "out" / "high_jump_bar_height_0.8.npz")
    assert solution.asked == {"bar_height": 0.8}


def test_a_second_run_solves_only_what_is_missing(fake, tmp_path):
    out = tmp_path / "out"
    first = run(fake, out, [0.8, 3.0])
    fake[1].unlink()
    again = run(fake, out, [0.8, 3.0, 1.0])
    assert fake[1].read_text() == "1 None\n"
    assert again[:2] == first
    # A result without its solution, a damaged result and a crash are done again.
    fake[1].unlink()
    (out / "high_jump_bar_height_0.8.npz").unlink()
    (out / "high_jump_bar_height_3.json").write_text('{"name": ')
    run(fake, out, [0.8, 3.0, 1.0])
    assert sorted(fake[1].read_text().split("\n")) == ["", "0.8 None", "3 None"]
    assert not list(out.glob(".*"))


def test_continuation_starts_from_the_nearest_neighbour(fake, tmp_path):
    run(fake, tmp_path / "out", [0.8, 1.0, 1.5], continuation=True, processes=1)
    assert fake[1].read_text() == "0.8 None\n1 0.8\n1.5 1.0\n"


def test_what_makes_no_sweep_is_refused(fake, tmp_path):
    out = tmp_path / "out"
    for values in ([], [1.0, 1.0], [float("nan")]):
        with pytest.raises(ValueError, match="different finite values"):
            run(fake, out, values)
    with pytest.raises(ValueError, match="no option 'height'"):
        sweep("high_jump", "height", [1.0], out, registry=fake[0], show=False)
    run(fake, out, [0.8])
    with pytest.raises(ValueError, match="holds a sweep of high_jump"):
        run(fake, out, [0.8], options={})
    with pytest.raises(ValueError, match="unknown problem"):
        sweep("golf", "x", [1.0], out, registry=fake[0])


def test_the_gate_decides_what_is_certified(fake, tmp_path):
    """A motionless athlete in the air is no jump: certified means that the gate passed."""
    (result,) = run(fake, tmp_path / "out", [1.0], certify=True)
    assert result.status == "rejected" and "base force residual" in result.reason
    stored = json.loads((tmp_path / "out" / "high_jump_bar_height_1.certificate.json").read_text())
    assert stored["passed"] is False
