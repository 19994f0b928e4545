"""A free throw by the athlete of the task: SMPL-X, with the ball between its hands.

The certified throws of ``solve free_throw`` begin in another stance. Here the task's own athlete
throws its own ball from its own hold: both arms swing back and then forth, the left one as the
mirror image of the right one, and everything else stays where the hold has it. Numbers say how far
and how fast; see ``BACK`` and ``FORTH``. They are sought by the cross-entropy method, each
candidate in several worlds at once which differ in the start and in noise on the actions as those
of training do: a throw that goes in from one start alone is of no use to learn from. Targets are
held over control steps of 1/30 s as a policy's are, and every frame of the clip is a state which
MuJoCo reached from the task's own start.

``python -m warmstart.ball_throw --out FILE.npz`` writes the clip.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from sports.env import Env, make_env
from sports.humanoid.body import Strength
from warmstart.clip import Clip
from warmstart.cross_entropy import CrossEntropy
from warmstart.performance import numbers_near, perform, searched_clip

TASK, BALL = "free_throw", "ball"
JOINTS = tuple(f"{link}_{axis}" for link in ("Shoulder", "Elbow", "Wrist") for axis in "xyz")
BACK = (1.9046, 1.2992, 1.4888, -0.4135, 1.9114, -1.2674, -2.5723, -0.239, -1.9044)
"""Targets of the right arm's ``JOINTS`` at the end of the back swing, from the hold (rad)..."""
FORTH = (1.4828, -1.217, 0.6711, -0.6766, -0.335, 0.9439, 0.0276, -2.056, 1.2617)
"""... and at the end of the throw; found by a random search of 2000 throws."""
BASE = np.array([*BACK, *FORTH, 0.12, 0.212])
"""``BACK``, ``FORTH`` and how long either takes (s)."""
UNITS = np.array([0.3] * 18 + [0.05, 0.05])
LEAST = (0.03, 0.07)
"""Shortest swings (s)."""
WATCHED = 75
"""Control steps after which a throw has gone in or not."""
WORST, FOUL, PULL = 5.0, 0.5, 0.004
"""How far off a throw is counted that never rises to the rim's plane (m); cost of a foul and of
the squared numbers. A basket is worth 1."""


@dataclass(frozen=True)
class Search:
    """Settings of the search."""

    candidates: int = 32
    """Of a round."""
    starts: int = 4
    """Worlds of each candidate."""
    noise: float = 0.02
    """Standard deviation of the noise on the actions (action units)."""
    rounds: int = 80
    seed: int = 0


class Thrower:
    """Candidates for a throw in MuJoCo, from the task's start."""

    def __init__(self, strength: Strength, settings: Search, threads: int = 0) -> None:
        self.strength: Strength = strength
        self.settings = settings
        self.env = make_env(
            TASK,
            num_worlds=settings.candidates * settings.starts,
            strength=strength,
            seed=settings.seed,
            options={"entry": 1.0},
            physics_options={"threads": threads} if threads else None,
        )
        body = self.env.physics.scene.body
        self.right, self.left = ([body.dof_index(f"{s}_{n}") for n in JOINTS] for s in "RL")
        self.mirror = torch.tensor([1.0 if n.endswith("y") else -1.0 for n in JOINTS])

    def actions(self, numbers: np.ndarray, step: int) -> torch.Tensor:
        """(N, act) actions of throws (N, P), in their units, at a control step."""
        numbers = BASE + numbers * UNITS
        back, forth = (torch.tensor(numbers[:, k : k + 9], dtype=torch.float32) for k in (0, 9))
        first, second = (
            torch.tensor(numbers[:, k].clip(min=least), dtype=torch.float32)[:, None]
            for k, least in zip((18, 19), LEAST)
        )
        time = (step + 1) * self.env.physics.scene.control_timestep
        swing = (time / first).clamp(max=1.0)
        push = ((time - first) / second).clamp(0.0, 1.0)
        angles = swing * back + push * (forth - back)
        out = torch.zeros(len(numbers), self.env.action_size)
        out[:, self.right], out[:, self.left] = angles, angles * self.mirror
        return (out / self.env.action_scale).clamp(-1.0, 1.0)

    def judge(self, numbers: np.ndarray) -> np.ndarray:
        """(C,) cost of candidates (C, P): how far off the ball would come down through the rim's
        plane (m, mean) were ring and board not there, less the share of baskets, which ``baskets``
        (C,) holds afterwards. Where it does come down says less: what hits the ring comes down
        half a metre off, from whichever side of it."""
        s, env = self.settings, self.env
        each = np.repeat(numbers, s.starts, axis=0)
        generator = torch.Generator().manual_seed(s.seed)
        env.reset()
        worlds = env.num_worlds
        over = torch.zeros(worlds, dtype=torch.bool)
        basket, foul, entry = (torch.zeros(worlds) for _ in range(3))
        for step in range(WATCHED):
            noise = torch.randn(s.starts, env.action_size, generator=generator)
            action = self.actions(each, step) + s.noise * noise.repeat(s.candidates, 1)
            result = env.step(action[:, None].clamp(-1.0, 1.0))
            now, seen = result.ended & ~over, result.metrics
            entry = torch.where(over, entry, result.terms["entry"][:, 0])
            basket = torch.where(now, seen["success"], basket)
            foul = torch.where(now, seen["foul"], foul)
            over |= result.ended
            if over.all():
                break
        off = (-0.25 * entry.clamp(min=1e-30).log()).clamp(min=0.0).sqrt()  # of exp(-4 off^2)
        cost = torch.where(entry > 0.0, off, WORST) - basket + FOUL * foul
        self.baskets = basket.view(-1, s.starts).mean(1).numpy()
        return cost.view(-1, s.starts).mean(1).numpy() + PULL * (numbers**2).sum(1)


def throw(thrower: Thrower, numbers: np.ndarray) -> Clip:
    """The throw of the numbers (P,), played in the task until it ends."""
    env = thrower.env
    offset, scale = env.action_offset.numpy(), env.action_scale.numpy()
    action = [thrower.actions(numbers[None], step)[0].numpy() for step in range(WATCHED)]
    touched: list[bool] = []

    def watch(world: Env) -> bool:
        touched.append(bool(world.physics.pair_force[0, 0] > 0))
        return bool(world.memory["thrown"][0])

    targets = offset + np.array(action) * scale
    played = perform(TASK, thrower.strength, BALL, targets, watch)
    return searched_clip(played, touched, TASK, thrower.strength, numbers)


def search(
    strength: Strength,
    settings: Search | None = None,
    *,
    near: np.ndarray | None = None,
    threads: int = 0,
    progress: Callable[[int, float, float], None] | None = None,
) -> Clip:
    """The throw in the middle of what was found; ``near`` (P,) is where to begin.

    ``progress(round, cost, baskets)`` is told the cost of the middle and its share of baskets.
    Raises RuntimeError when the simulation diverges.
    """
    settings = settings or Search()
    thrower = Thrower(strength, settings, threads)
    sought = CrossEntropy(len(UNITS), settings.candidates, settings.seed, near=near, noisy=True)
    middle, least = sought.mean.copy(), np.inf
    for done in range(1, settings.rounds + 1):
        asked = sought.ask()
        cost = thrower.judge(asked)
        if cost[1] < least:  # the middle, not the luckiest: the noise differs every round
            middle, least = asked[1].copy(), float(cost[1])
        sought.tell(cost)
        if progress is not None:
            progress(done, float(cost[1]), float(thrower.baskets[1]))
    clip = throw(thrower, middle)
    thrower.env.close()
    return clip


def main(arguments: Sequence[str] | None = None) -> int:
    """Searches and writes the clip; 1 when the throw is no basket, 2 for a bad file."""
    parser = argparse.ArgumentParser(prog="python -m warmstart.ball_throw", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--strength", choices=("paper", "human"), default="paper")
    parser.add_argument("--rounds", type=int, default=Search.rounds)
    parser.add_argument("--seed", type=int, default=Search.seed)
    parser.add_argument("--near", type=Path, help="a clip of this command, to search around")
    options = parser.parse_args(arguments)
    try:
        near = numbers_near(options.near, len(UNITS))
    except ValueError as error:
        print(f"{options.near}: {error}", file=sys.stderr)
        return 2

    def progress(done: int, cost: float, baskets: float) -> None:
        print(f"round {done}: cost {cost:.2f}, baskets {100 * baskets:.0f} %", flush=True)

    settings = Search(rounds=options.rounds, seed=options.seed)
    clip = search(options.strength, settings, near=near, progress=progress)
    if clip.meta["achieved"].get("success") != 1.0:
        print(f"no basket: {clip.meta['achieved']}", file=sys.stderr)
        return 1
    clip.save(options.out)
    print(f"{options.out}: {clip.meta['achieved']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
