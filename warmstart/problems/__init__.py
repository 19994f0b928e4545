"""Optimisation problems by name: each asks for an outcome and minimises effort.

``PROBLEMS[name]`` tells how to configure, solve and sweep a problem without importing CasADi;
the modules load when they are first used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from warmstart.solution import Solution


class Infeasible(RuntimeError):
    """No motion was found; the message names the outcome and the limiting constraint."""


@dataclass(frozen=True)
class Problem:
    """One entry of the registry."""

    name: str
    summary: str
    outcome: str
    """Config field that prescribes the outcome."""
    unit: str
    sweep: tuple[float, ...]
    """Outcomes for a standard sweep, easiest first, so that each can start from the last."""
    module: str

    @property
    def config(self) -> type:
        """Frozen dataclass of options; every field has a docstring and a default."""
        return import_module(self.module).Config

    def solve(
        self,
        config: Any,
        guess: Solution | None = None,
        progress: Callable[[int, float], None] | None = None,
    ) -> Solution:
        """Solves one problem, from a neighbour's solution if given.

        ``progress(iteration, objective)`` is called after every iteration. Raises ValueError
        for an impossible option and :class:`Infeasible` when no motion is found.
        """
        return import_module(self.module).solve(config, guess=guess, progress=progress)


PROBLEMS: dict[str, Problem] = {
    problem.name: problem
    for problem in (
        Problem(
            name="high_jump",
            summary="take-off step, clearance and landing over a bar of given height",
            outcome="bar_height",
            unit="m",
            sweep=(0.8, 1.0, 1.2, 1.5),
            module="warmstart.problems.high_jump",
        ),
        Problem(
            name="long_jump",
            summary="take-off step, flight and touch-down at a given length",
            outcome="length",
            unit="m",
            sweep=(3.0, 5.0, 7.0),
            module="warmstart.problems.long_jump",
        ),
        Problem(
            name="tennis",
            summary="forehand or backhand that returns a machine's ball to a target",
            outcome="ball_speed",
            unit="m/s",
            sweep=(20.0, 24.0, 28.0),
            module="warmstart.problems.tennis",
        ),
        Problem(
            name="table_tennis",
            summary="forehand or backhand that returns a machine's ball to a spot on the table",
            outcome="ball_speed",
            unit="m/s",
            sweep=(6.0, 7.0, 8.0),
            module="warmstart.problems.table_tennis",
        ),
        Problem(
            name="javelin",
            summary="throw from a stand at a given release speed, angle and height",
            outcome="release_speed",
            unit="m/s",
            sweep=(10.0, 12.0, 14.0, 16.0, 18.0),
            module="warmstart.problems.javelin",
        ),
        Problem(
            name="golf",
            summary="stroke off the tee, from chip to swing, at a given club-head speed and loft",
            outcome="club_speed",
            unit="m/s",
            sweep=(6.0, 9.0, 12.0, 15.0),
            module="warmstart.problems.golf",
        ),
        Problem(
            name="free_throw",
            summary="throw with both hands from the free-throw line on a path into the basket",
            outcome="apex",
            unit="m",
            sweep=(0.7, 0.9, 1.2),
            module="warmstart.problems.free_throw",
        ),
        Problem(
            name="set_shot",
            summary="shot at the basket with one hand, by the athlete without fingers",
            outcome="apex",
            unit="m",
            sweep=(0.7, 0.9, 1.2),
            module="warmstart.problems.set_shot",
        ),
        Problem(
            name="hurdling",
            summary="one stride cycle over a hurdle of given height at a given run speed",
            outcome="hurdle_height",
            unit="m",
            sweep=(0.762, 0.838, 0.914, 0.991, 1.067),
            module="warmstart.problems.hurdling",
        ),
        Problem(
            name="boxing",
            summary="jab or cross that meets the opponent's head or chest at a given fist speed",
            outcome="fist_speed",
            unit="m/s",
            sweep=(5.0, 5.5, 6.0),
            module="warmstart.problems.boxing",
        ),
        Problem(
            name="fencing",
            summary="lunge whose point touches the opponent's chest at a given reach",
            outcome="reach",
            unit="m",
            sweep=(1.9, 2.1),  # 2.0 is refused: 3.2 cm off in MuJoCo (docs/strikes.md)
            module="warmstart.problems.fencing",
        ),
        Problem(
            name="penalty_kick",
            summary="kick of the ball, from a stand or after a step, to a target in the goal",
            outcome="ball_speed",
            unit="m/s",
            sweep=(15.0, 16.0, 17.0),
            module="warmstart.problems.penalty_kick",
        ),
    )
}


def get_problem(name: str) -> Problem:
    """The problem of that name. Raises ValueError listing the known ones."""
    if name not in PROBLEMS:
        raise ValueError(f"unknown problem '{name}'; known: {', '.join(PROBLEMS)}")
    return PROBLEMS[name]
