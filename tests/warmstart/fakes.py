"""A registry of made-up problems that worker processes can import: quick, and bad on demand."""

from __future__ import annotations

FAKE = """
import os, time
from dataclasses import dataclass, field
from pathlib import Path
import numpy as np
from sports.humanoid.body import load_body
from warmstart.solution import Solution

class Infeasible(RuntimeError):
    pass

@dataclass(frozen=True)
class Config:
    bar_height: float = 1.0
    log: str = os.environ.get("FAKE_LOG", "")
    knots: int = 3
    wait: str = ""
    fussy: bool = False
    picky: bool = False
    def __post_init__(self):
        if self.bar_height > 10.0:
            raise ValueError(f"bar_height must be at most 10 m, not {self.bar_height}")

class Problem:
    outcome, unit, summary = "bar_height", "m", ""
    config = Config
    def __init__(self, name):
        self.name = name
    def solve(self, config, guess=None, progress=None):
        height = config.bar_height
        if config.log:
            with open(config.log, "a") as file:
                file.write(f"{height:g} {guess.asked['bar_height'] if guess else None}\\n")
        if config.wait and height > 1.1:
            Path(config.wait + ".pid").write_text(str(os.getpid()))
            while not Path(config.wait).exists():
                time.sleep(0.02)
        if 2.0 < height <= 2.5:
            os._exit(9)
        if config.fussy and height > 1.4 and guess is None:
            raise Infeasible("no motion from key poses: start it from a neighbour")
        if config.picky and height > 1.4 and guess is not None:
            raise Infeasible("the neighbour is too far off")
        if self.name == "hop":
            raise Infeasible("nobody hops: torque of L_Ankle_y")
        if height > 2.5:
            raise Infeasible(f"no motion clears {height} m: torque of L_Knee_y")
        if height > 1.9:
            raise ZeroDivisionError("a bug")
        body = load_body("smpl")
        n, k = body.num_dofs, config.knots
        qpos = np.zeros((k, 7 + n)); qpos[:, 3] = 1; qpos[:, 2] = height
        zero = np.zeros((k, 6 + n))
        torque = height * np.tile(body.array("effort") / 10.0, (k, 1))
        return Solution("high_jump", body, {"bar_height": height}, "paper",
            0.1 * np.arange(k), qpos, zero, zero, torque, (("L_Toe", (0., 0., 0.)),),
            np.zeros((k, 1, 3)), (("flight", 0, k - 1, ()),),
            {"objective": 2 * height, "solve_s": 0.5, "iterations": 7, "max_violation": 1e-7})

PROBLEMS = {name: Problem(name) for name in ("high_jump", "hop")}

def get_problem(name):
    if name not in PROBLEMS:
        raise ValueError(f"unknown problem '{name}'")
    return PROBLEMS[name]
"""
