"""A javelin throw that goes far from starts that are not exact, in firmer hands too.

:mod:`warmstart.javelin_throw` keeps the longest single throw it meets, and the longest one may be
one by luck: a policy that learns it starts from poses with noise, and says what it has learned with
errors. Here each candidate is thrown several times: in the worlds of the task with the noise of an
evaluation on its start and some on every target, and once in firmer hands
(:mod:`warmstart.other_worlds`), which are more like Drake's. The mean of the copies counts, and a
share of the worst. What is judged in the end is the middle of the search, played in the task from
its own start.

``python -m warmstart.robust_javelin --near FILE.npz --out FILE.npz`` goes on from a clip of either
command.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from sports.humanoid.body import Strength
from sports.scene import Scene
from sports.starts import START_NOISE, loose_joints
from warmstart.clip import Clip
from warmstart.cross_entropy import CrossEntropy
from warmstart.javelin_throw import UNITS, WATCHED, Flown, Thrower, length_of, size_of, throw
from warmstart.other_worlds import FIRM, Other, OtherWorlds
from warmstart.performance import numbers_near

COPIES = (Other(), Other(), FIRM)
"""Worlds in which a candidate is thrown, each time with noise of its own."""
NOISE = 2e-3
"""Of every target of every control step (rad)."""
WORST = 0.3
"""Weight of the worst copy against the mean of all."""


@dataclass(frozen=True)
class Search:
    """Settings of the search."""

    candidates: int = 32
    """Of a round."""
    rounds: int = 150
    spread: float = 0.12
    """Of the candidates at the start, in units."""
    strict: float = 1.0
    """Weight of what is wrong with the hold, the release and the landing against a metre."""
    seed: int = 0


class Crowd:
    """Copies of candidates in the worlds of ``COPIES``."""

    def __init__(self, strength: Strength, candidates: int, threads: int = 0) -> None:
        self.thrower = Thrower(strength, 1, threads)
        self.scene: Scene = self.thrower.scene
        made = {other: OtherWorlds(self.scene, candidates, threads, other) for other in COPIES}
        self.worlds = [made[other] for other in COPIES]
        self.loose = loose_joints(self.scene, torch.device("cpu")).numpy()

    def fly(self, numbers: np.ndarray, seed: int) -> list[Flown]:
        """The copies of candidates (N, P); the noise is that of the ``seed``, the same for all."""
        generator = np.random.default_rng(seed)
        ctrl = np.stack([self.thrower.targets(row, WATCHED) for row in numbers])
        out = []
        for worlds in self.worlds:
            start = self.scene.default_qpos()
            joints = start[self.scene.agent_qpos(0)][7:]
            joints += START_NOISE * self.loose * generator.uniform(-1.0, 1.0, len(joints))
            noise = NOISE * generator.standard_normal(ctrl.shape[1:])
            out.append(self.thrower.fly(worlds, ctrl + noise, start))
        return out

    def judge(self, numbers: np.ndarray, seed: int, strict: float) -> np.ndarray:
        """(N,) cost of candidates (N, P)."""
        copies = np.array([flown.cost(strict) for flown in self.fly(numbers, seed)])
        copies = np.nan_to_num(copies, nan=1e3, posinf=1e3)
        return copies.mean(0) + WORST * copies.max(0) + size_of(numbers)


def search(
    strength: Strength,
    near: np.ndarray,
    settings: Search | None = None,
    *,
    threads: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> Clip:
    """The throw of the middle of a search around ``near`` (P,), played in the task.

    ``progress(round, cost)`` is called after every round with the cost of the middle. Raises
    RuntimeError when the simulation diverges.
    """
    settings = settings or Search()
    crowd = Crowd(strength, settings.candidates, threads)
    sought = CrossEntropy(
        len(UNITS),
        settings.candidates,
        settings.seed,
        near=near,
        spread=settings.spread,
        noisy=True,
    )
    for done in range(settings.rounds):
        asked = sought.ask()
        cost = crowd.judge(asked, 10_000 * settings.seed + done, settings.strict)
        sought.tell(cost)
        if progress is not None:
            progress(done + 1, float(cost[1]))
    return throw(crowd.thrower, sought.mean)


def main(arguments: Sequence[str] | None = None) -> int:
    """Searches and writes the clip; 1 when the throw does not count, 2 for a bad file."""
    parser = argparse.ArgumentParser(prog="python -m warmstart.robust_javelin", description=__doc__)
    parser.add_argument("--near", type=Path, required=True, help="a clip, to search around")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--strength", choices=("paper", "human"), default="paper")
    parser.add_argument("--rounds", type=int, default=Search.rounds)
    parser.add_argument("--spread", type=float, default=Search.spread)
    parser.add_argument("--strict", type=float, default=Search.strict)
    parser.add_argument("--seed", type=int, default=Search.seed)
    options = parser.parse_args(arguments)
    settings = Search(
        rounds=options.rounds, spread=options.spread, strict=options.strict, seed=options.seed
    )
    try:
        near = numbers_near(options.near, len(UNITS))
    except ValueError as error:
        print(f"{options.near}: {error}", file=sys.stderr)
        return 2
    assert near is not None

    def progress(done: int, cost: float) -> None:
        print(f"round {done}: {cost:.2f}", flush=True)

    clip = search(options.strength, near, settings, progress=progress)
    if length_of(clip) < 0.0:
        print(f"no throw: {clip.meta['achieved']}", file=sys.stderr)
        return 1
    clip.save(options.out)
    print(f"{options.out}: {clip.meta['achieved']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
