"""A planned free throw refined until it goes in in both engines, from starts that are not exact.

:mod:`warmstart.refine` stops at the first basket of MuJoCo, and such a throw may be one by luck:
turned by a degree by noise of 1e-5 rad, and none in Drake. Here the same numbers are sought, but
each candidate is thrown ``COPIES`` times, with noise on its targets and on its first pose, with
more and with less friction, in the worlds of the task and in others whose hands are more like
Drake's (:mod:`warmstart.other_worlds`). What counts is the mean of the copies and the worst one.

Drake itself is a hundred times as slow. It throws only the middle of what was found, a few times.
By what its throws then differ from those of its stand-ins, the stand-ins are corrected, and the
search goes on: space mapping (Bandler et al. 1994, IEEE Transactions on Microwave Theory and
Techniques 42(12)). It ends with a middle that is a basket of the task and whose throws in the two
engines themselves are good enough.

``python -m warmstart.robust_throw SOLUTION.npz --out DIR`` writes ``free_throw_..._human.npz`` and
the certificate of its plan beside it, with what the clip does in both engines
(:mod:`warmstart.refined_throw`).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from sports.physics import default_state, make_physics
from warmstart.certificate import Certificate, certify
from warmstart.clip import Clip
from warmstart.cross_entropy import CrossEntropy
from warmstart.demonstration import Demonstration, name_of, no_success, save_demonstration
from warmstart.other_worlds import FIRM, Other, OtherWorlds
from warmstart.performance import numbers_near
from warmstart.refine import TASK, UNITS, Flight, Thrower, changed, throw
from warmstart.refined_throw import labelled, shown
from warmstart.solution import Solution

MOTION = "refined in MuJoCo and Drake from a certified throw"
"""What such a clip is, in its own ``meta`` and in ``list``."""
TASKS = Other()
"""The worlds of the task."""
COPIES = (
    (TASKS, (0.0, 1e-3)),
    (replace(TASKS, friction=0.9), (3e-4,)),
    (FIRM, (3e-4,)),
    (replace(FIRM, friction=1.1), (1e-3,)),
    (Other(finer=4, felt=True, hold_time=0.0021, cone=True), (1e-3,)),
)
"""Worlds in which a candidate is thrown, and the noise (rad) of its throws there: the standard
deviation of what is added to every target of every control step and to every hinge at the start."""
DRAKES = (0.0, 1e-3, 1e-3)
"""The same of the throws in Drake."""
WORST = 0.5
"""Weight of the worst copy against the mean of all."""


@dataclass(frozen=True)
class Search:
    """Settings of the search."""

    candidates: int = 32
    """Of a round."""
    rounds: int = 24
    """Before the first throws in Drake."""
    turns: int = 6
    """Corrections by Drake at most..."""
    again: int = 6
    """... and the rounds after each."""
    level: float = 0.15
    """A basket of the task whose throws in both engines cost less than this (m) ends the search."""
    seed: int = 0


@dataclass(frozen=True)
class Noise:
    """What is added to a throw (rad)."""

    targets: np.ndarray
    """(K, n)"""
    start: np.ndarray
    """(nq,)"""


@dataclass(frozen=True)
class Progress:
    """What a search tells after every round and after every visit to Drake."""

    done: int
    """Rounds so far."""
    cost: float
    """Of the middle: of its copies after a round, of its throws in the engines after a visit."""
    throws: tuple[float, ...]
    """What each of those throws is off (m and more, see ``Thrower.cost``)."""
    drake: bool


class Crowd:
    """Copies of candidates in the worlds of ``COPIES``, and throws in Drake."""

    def __init__(self, solution: Solution, candidates: int, threads: int = 0) -> None:
        self.thrower = thrower = Thrower(solution, 1, threads)
        self.worlds = [
            (OtherWorlds(thrower.scene, candidates, threads, other), noises)
            for other, noises in COPIES
        ]
        self.drake = make_physics("drake", thrower.scene, 1)
        self.drift = np.zeros((2, 3))
        """Place (m) and velocity (m/s) of the ball in Drake less those in its stand-ins."""

    def noise(self, generator: np.random.Generator, size: float) -> Noise:
        """Drawn anew."""
        scene, hinges = self.thrower.scene, self.thrower.scene.nu
        start = np.zeros(scene.nq)
        targets = generator.standard_normal((self.thrower.steps, hinges))
        start[scene.agent_qpos(0)][7:] = generator.standard_normal(hinges)
        return Noise(size * targets, size * start)

    def targets(self, numbers: np.ndarray) -> np.ndarray:
        """(N, K, n) of candidates (N, P), in their units."""
        return np.stack([self.thrower.targets(row, self.thrower.steps) for row in numbers])

    def fly(self, ctrl: np.ndarray, seed: int) -> list[tuple[Other, Flight]]:
        """The copies of throws with targets (N, K, n) in all worlds; the noise is that of the
        ``seed``, the same for all N."""
        generator, out = np.random.default_rng(seed), []
        for worlds, noises in self.worlds:
            for size in noises:
                noise = self.noise(generator, size)
                start = worlds.scene.default_qpos() + noise.start
                out.append((worlds.other, self.thrower.fly(worlds, ctrl + noise.targets, start)))
        return out

    def judge(self, numbers: np.ndarray, seed: int) -> np.ndarray:
        """(C, N) what the copies of candidates (N, P) are off, those of stand-ins as Drake would
        have them."""
        rows = []
        for other, flight in self.fly(self.targets(numbers), seed):
            drift = self.drift if other.felt else np.zeros((2, 3))
            place, velocity = flight.place + drift[0], flight.velocity + drift[1]
            before = flight.before + drift[1]
            moved = replace(flight, place=place, velocity=velocity, before=before)
            rows.append(self.thrower.cost(moved))
        return np.array(rows)

    def visit(self, numbers: np.ndarray, seed: int) -> np.ndarray:
        """What throws of the numbers (P,) are off in the two engines themselves: in the worlds of
        the task and in Drake. From now on stand-ins are corrected by these."""
        ctrl = self.targets(numbers[None])
        copies = self.fly(ctrl, seed)
        generator = np.random.default_rng(seed)
        drakes = [self.thrown(ctrl[0], self.noise(generator, size)) for size in DRAKES]
        ours = [flight for other, flight in copies if other.felt]
        self.drift = np.array(
            [
                np.mean([getattr(f, name)[0] for f in drakes], axis=0)
                - np.mean([getattr(f, name)[0] for f in ours], axis=0)
                for name in ("place", "velocity")
            ]
        )
        own = [flight for other, flight in copies if not other.felt]
        return np.concatenate([self.thrower.cost(flight) for flight in (*own, *drakes)])

    def thrown(self, ctrl: np.ndarray, noise: Noise) -> Flight:
        """One throw in Drake. Raises RuntimeError when it diverges."""
        physics, scene, lowest = self.drake, self.thrower.scene, np.inf
        state = default_state(scene, 1, physics.device)
        state.qpos[0] += torch.as_tensor(noise.start, dtype=torch.float32)
        physics.reset(torch.ones(1, dtype=torch.bool), state)
        before = np.zeros((1, 3))
        for k, row in enumerate(ctrl + noise.targets):
            before = physics.object_linvel[:, 0].double().numpy().copy()
            physics.step(torch.as_tensor(row[None], dtype=torch.float32))
            if bool(physics.bad.any()):
                raise RuntimeError(f"the throw diverged in Drake at control step {k}")
            if k * scene.control_timestep < self.thrower.release:
                lowest = min(lowest, float(physics.object_pos[0, 0, 2]))
        place, velocity = (
            x[:, 0].double().numpy().copy() for x in (physics.object_pos, physics.object_linvel)
        )
        return Flight(place, velocity, before, np.array([lowest]))


def total(off: np.ndarray) -> np.ndarray:
    """Cost of copies (C, ...) that are so far off: the mean, and a share of the worst."""
    return off.mean(0) + WORST * off.max(0)


def search(
    solution: Solution,
    settings: Search | None = None,
    *,
    near: np.ndarray | None = None,
    threads: int = 0,
    progress: Callable[[Progress], None] | None = None,
) -> Clip:
    """The first basket whose throws in both engines are good enough (``Search.level``), else the
    best, played in the task from its own start, with its ``numbers``; ``near`` (P,) is where to
    begin. Whether it goes in is for the caller to see.

    Raises RuntimeError when the simulation of a middle diverges.
    """
    settings = settings or Search()
    crowd = Crowd(solution, settings.candidates, threads)
    sought = CrossEntropy(len(UNITS), settings.candidates, settings.seed, near=near, noisy=True)
    done, found, least = 0, None, (True, np.inf)

    def tell(cost: float, off: np.ndarray, drake: bool) -> None:
        if progress is not None:
            progress(Progress(done, cost, tuple(float(x) for x in off), drake))

    for turn in range(settings.turns + 1):
        for _ in range(settings.again if turn else settings.rounds):
            asked = sought.ask()
            off = crowd.judge(asked, 1000 * settings.seed + done)
            cost = total(off) + changed(asked)
            done += 1
            tell(float(cost[1]), off[:, 1], False)
            sought.tell(cost)
        off = crowd.visit(sought.mean, 1000 * settings.seed + 500 + turn)
        cost = float(total(off))
        tell(cost, off, True)
        clip = throw(solution, crowd.thrower, sought.mean)
        rank = (clip.meta["achieved"].get("success") != 1.0, cost)
        if found is None or rank < least:
            numbers = [round(float(x), 6) for x in sought.mean]
            found = replace(clip, meta=clip.meta | {"motion": MOTION, "numbers": numbers})
            least = rank
        if least <= (False, settings.level):
            break
    crowd.drake.close()
    assert found is not None
    return found


def demonstrate(clip: Clip, certificate: Certificate) -> Demonstration:
    """The clip and the certificate of its plan with what the clip does in both engines. It is a
    demonstration where its plan is certified and the task in MuJoCo counts a basket."""
    if not certificate.passed:
        return Demonstration(certificate, None, "; ".join(certificate.failures))
    reason = ""
    if clip.meta["achieved"].get("success") != 1.0:
        reason = no_success(clip, "thrown")
    clip, certificate = labelled(clip, certificate)
    return Demonstration(certificate, clip, reason)


def main(arguments: Sequence[str] | None = None) -> int:
    """Searches and writes clip and certificate; 1 when it is no demonstration, 2 for a bad file."""
    parser = argparse.ArgumentParser(prog="python -m warmstart.robust_throw", description=__doc__)
    parser.add_argument("solution", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=Search.rounds)
    parser.add_argument("--turns", type=int, default=Search.turns)
    parser.add_argument("--seed", type=int, default=Search.seed)
    parser.add_argument("--near", type=Path, help="a clip of this command, to search around")
    options = parser.parse_args(arguments)
    reading = options.solution
    try:
        solution = Solution.load(reading)
        if solution.problem != TASK:
            raise ValueError(f"it is a motion of '{solution.problem}', not of '{TASK}'")
        reading = options.near
        near = numbers_near(reading, len(UNITS))
    except ValueError as error:
        print(f"{reading}: {error}", file=sys.stderr)
        return 2

    def progress(now: Progress) -> None:
        throws = ", ".join(f"{x:.2f}" for x in now.throws)
        where = "MuJoCo and Drake" if now.drake else "copies"
        print(f"round {now.done}: {where} {now.cost:.2f} ({throws})", flush=True)

    settings = Search(rounds=options.rounds, turns=options.turns, seed=options.seed)
    clip = search(solution, settings, near=near, progress=progress)
    found, name = demonstrate(clip, certify(solution)), name_of(solution)
    if not found.passed or found.clip is None:
        print(f"{name}: no demonstration: {found.reason}", file=sys.stderr)
        return 1
    save_demonstration(found, options.out / f"{name}.npz", options.out / f"{name}.json")
    print(f"{name}: {shown(found.certificate.clip)}; {found.clip.meta['why_not'] or 'certified'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
