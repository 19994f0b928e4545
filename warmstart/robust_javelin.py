"""The numbers of a javelin throw that goes far from starts that are not exact, in other worlds too.

The longest single throw of :mod:`warmstart.javelin_throw` may be one by luck: a policy that learns
it starts from poses with noise, and says what it has learned with errors. So each candidate is
thrown several times: in the worlds of the task with the noise of an evaluation on its start and
some on every target, and in others (:mod:`warmstart.other_worlds`), whose hands are more like
Drake's. The mean of the copies counts, and a share of the worst. All candidates of a round meet the
same noise. The search is CMA-ES (Hansen 2016, arXiv:1604.00772): it learns which numbers go
together. What is kept is its middle, played in the task from its own start, when the throw counts
there.

``python -m warmstart.robust_javelin --out FILE.npz`` searches from nothing, with ``--near
FILE.npz`` around a clip of its own. The file is written every ten rounds, so a search that was
stopped goes on from there.
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
from warmstart.evolution import strategy
from warmstart.javelin_throw import UNITS, WATCHED, Flown, Thrower, size_of, throw
from warmstart.other_worlds import FIRM, Other, OtherWorlds
from warmstart.performance import numbers_near

COPIES = (Other(), Other(friction=0.9), FIRM, Other(finer=2, felt=True))
"""Worlds in which a candidate is thrown, each time with noise of its own."""
NOISE = 2e-3
"""Of every target of every control step (rad)."""
WORST = 0.3
"""Weight of the worst copy against the mean of all."""


@dataclass(frozen=True)
class Search:
    """Settings of the search."""

    candidates: int = 40
    """Of a round."""
    rounds: int = 400
    spread: float = 0.4
    """Of the candidates at the start, in units."""
    strict: float = 2.0
    """Weight of what is wrong with the hold, the delivery and the landing against a metre."""
    seed: int = 0
    kept_every: int = 10
    """Rounds after which the middle is played in the task."""


class Crowd:
    """Copies of candidates in the worlds of ``COPIES``."""

    def __init__(self, strength: Strength, candidates: int, threads: int = 0) -> None:
        self.thrower = Thrower(strength)
        self.scene: Scene = self.thrower.scene
        many = candidates + 1
        made = {other: OtherWorlds(self.scene, many, threads, other) for other in COPIES}
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
    near: np.ndarray | None = None,
    settings: Search | None = None,
    *,
    threads: int = 0,
    progress: Callable[[int, float, Clip | None], None] | None = None,
) -> Clip:
    """The throw of the middle of a search around ``near`` (P,) or from nothing, as the task plays
    it.

    ``progress(round, cost, clip)`` is called after every round with the cost of the middle and,
    when that was played in the task, what became of it. Raises RuntimeError when the simulation
    diverges.
    """
    settings = settings or Search()
    crowd = Crowd(strength, settings.candidates, threads)
    rng = np.random.default_rng(settings.seed)
    start = np.zeros(len(UNITS)) if near is None else near
    sought = strategy(start, settings.spread, settings.candidates, lambda: rng)
    clip = None
    for done in range(1, settings.rounds + 1):
        asked, middle = np.array(sought.ask()), np.array(sought.mean)
        seed = 10_000 * settings.seed + done
        costs = crowd.judge(np.vstack((asked, middle)), seed, settings.strict)
        sought.tell(list(asked), costs[:-1].tolist())
        clip = None
        if done == settings.rounds or done % settings.kept_every == 0:
            clip = throw(crowd.thrower, np.array(sought.mean))
        if progress is not None:
            progress(done, float(costs[-1]), clip)
    return clip or throw(crowd.thrower, np.array(sought.mean))


def main(arguments: Sequence[str] | None = None) -> int:
    """Searches and writes the clip; 1 when no middle is a throw that counts, 2 for a bad file."""
    parser = argparse.ArgumentParser(prog="python -m warmstart.robust_javelin", description=__doc__)
    parser.add_argument("--near", type=Path, help="a clip of this command, to search around")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--strength", choices=("paper", "human"), default="paper")
    parser.add_argument("--candidates", type=int, default=Search.candidates)
    parser.add_argument("--rounds", type=int, default=Search.rounds)
    parser.add_argument("--spread", type=float, default=Search.spread)
    parser.add_argument("--strict", type=float, default=Search.strict)
    parser.add_argument("--seed", type=int, default=Search.seed)
    parser.add_argument("--threads", type=int, default=0, help="0 for all cores")
    options = parser.parse_args(arguments)
    names = ("candidates", "rounds", "spread", "strict", "seed")
    settings = Search(**{name: getattr(options, name) for name in names})
    try:
        near = numbers_near(options.near, len(UNITS))
    except ValueError as error:
        print(f"{options.near}: {error}", file=sys.stderr)
        return 2
    kept = None

    def progress(done: int, cost: float, clip: Clip | None) -> None:
        nonlocal kept
        print(f"round {done}: {cost:.2f}", flush=True)
        if clip is not None:
            print(f"  in the task: {clip.meta['achieved']}", flush=True)
            if clip.meta["achieved"].get("success") == 1.0:
                clip.save(options.out)
                kept = clip

    clip = search(options.strength, near, settings, threads=options.threads, progress=progress)
    if kept is None:
        print(f"no throw: {clip.meta['achieved']}", file=sys.stderr)
        return 1
    print(f"{options.out}: {kept.meta['achieved']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
