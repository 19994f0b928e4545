"""A planned free throw made one that a policy could throw: with the real ball, in the task.

Played open loop the plan lets go a little late, because real contacts are soft, and a policy's
targets are held over control steps of 1/30 s. A few numbers change the plan's targets: when it
starts, how far it leads, how hard it drives, when the fingers open, and bumps on the targets of
both arms around the release. They are sought by the cross-entropy method (Rubinstein 1999) on
batches of MuJoCo worlds, until the task's own rules call the throw a basket. Every frame of the
clip that comes out is a state which MuJoCo reached from the task's own start.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sports.env import Env, make_scene
from sports.free_throw import LOWEST, RIM
from sports.hoop import RING_RADIUS
from sports.physics.base import GRAVITY
from warmstart import thrown
from warmstart.bank import START
from warmstart.clip import Clip
from warmstart.cross_entropy import CrossEntropy
from warmstart.held_ball import fingers
from warmstart.performance import perform
from warmstart.solution import Solution
from warmstart.tracking import Worlds

TASK = "free_throw"
BUMPED = ("Shoulder_x", "Shoulder_y", "Shoulder_z", "Elbow_z", "Wrist_x", "Wrist_z")
"""Joints of the arms with bumps on their targets; left and right mirror each other..."""
MIRROR = {"x": -1.0, "y": 1.0, "z": -1.0}
"""... so that the left angle is this times the right one."""
BUMPS = (-0.2, -0.1, 0.0)
"""Middles of the bumps, from the release (s); each is as wide as they are apart."""
WIDTH = 0.1
UNITS = np.array([0.02, 0.02, 0.3, 0.03, *[0.12] * (len(BUMPS) * len(BUMPED)), 0.1])
"""Of the parameters: start (s), lead (s), drive (of the torque), opening of the fingers (s), bumps
(rad), and how far both shoulders turn to one side (rad)."""
LATENCY = 0.02
"""How much later than the plan the targets start (s), besides the parameter."""
WATCHED = 0.14
"""How long after the release a candidate is judged by its flight (s)."""


@dataclass(frozen=True)
class Search:
    """Settings of the search."""

    worlds: int = 24
    """Candidates of a round."""
    rounds: int = 20
    near: float = 0.10
    """A ball that comes down within this of the ring's middle (m) is tried in the task."""
    level: float = 0.15
    """A basket whose apex is within this of the asked one (m) ends the search."""
    seed: int = 0


@dataclass(frozen=True)
class Refined:
    """What the search found."""

    clip: Clip
    """The throw as the task played it, from its own start, with the ball; ``meta["achieved"]`` has
    the task's metrics."""
    rounds: int

    @property
    def success(self) -> bool:
        """Whether the task counts a basket."""
        return self.clip.meta["achieved"].get("success") == 1.0


@dataclass(frozen=True)
class Flight:
    """The ball of N throws at the end of a candidate's last control step."""

    place: np.ndarray
    velocity: np.ndarray
    """(N, 3) of its centre, world (m, m/s)."""
    before: np.ndarray
    """(N, 3) its velocity one control step earlier (m/s)."""
    lowest: np.ndarray
    """(N,) how low it sank before the release (m)."""


class Thrower:
    """Candidates in MuJoCo, from the task's start."""

    def __init__(self, solution: Solution, worlds: int, threads: int) -> None:
        self.solution, self.scene = solution, make_scene(TASK, strength=solution.body.strength)
        self.worlds = Worlds(self.scene, worlds, threads)
        self.release = float(solution.stats["event"]["time"])
        self.steps = math.ceil((self.release + WATCHED) / self.scene.control_timestep)
        body = self.scene.body
        self.bent, self.hold = fingers(body), self.scene.action_offset()
        self.kp, self.limit = body.array("kp"), body.action_scale()

    def targets(self, numbers: np.ndarray, steps: int) -> np.ndarray:
        """(steps, n) PD targets (rad) of the parameters (P,), in their units."""
        body, parts = self.scene.body, self.scene.substeps
        start, lead, drive, opening, *rest = numbers * UNITS
        bumps, aside = np.array(rest[:-1]).reshape(len(BUMPS), len(BUMPED)), rest[-1]
        middle = (np.arange(steps)[:, None] + (np.arange(parts) + 0.5) / parts).ravel()
        t = middle * self.scene.control_timestep - LATENCY + start
        motion = self.solution.sample(np.clip(t + lead, 0.0, self.solution.duration))
        out = motion["qpos"][:, 7:] + (1.0 + drive) * motion["torque"] / self.kp
        held = t < self.release + opening
        out[:, self.bent] = np.where(held[:, None], self.hold[self.bent], 0.0)
        for when, sizes in zip(BUMPS, bumps):
            shape = np.maximum(0.0, 1.0 - np.abs(t - self.release - when) / WIDTH)
            for joint, size in zip(BUMPED, sizes):
                out[:, body.dof_index(f"R_{joint}")] += size * shape
                out[:, body.dof_index(f"L_{joint}")] += MIRROR[joint[-1]] * size * shape
        turned = np.clip((t - self.release + 0.25) / 0.1, 0.0, 1.0) * (t < self.release + 0.03)
        for side in "LR":
            out[:, body.dof_index(f"{side}_Shoulder_z")] += aside * turned
        out = out.reshape(steps, parts, -1).mean(1)
        return np.clip(out, self.hold - self.limit, self.hold + self.limit)

    def fly(self, worlds: Worlds, ctrl: np.ndarray, start: np.ndarray | None = None) -> Flight:
        """The throws of targets (N, K, n) (rad) in worlds of the task, from ``start`` (nq,) at rest
        (None: the task's own), until ``WATCHED`` after the release."""
        count, scene = len(ctrl), worlds.scene
        worlds.put(
            count,
            scene.default_qpos() if start is None else start,
            np.zeros(scene.nv),
            np.zeros(scene.nv),
        )
        ball, rate = scene.object_qpos("ball"), scene.object_qvel("ball")
        lowest, before = np.full(count, np.inf), np.zeros((count, 3))
        for k in range(self.steps):
            before = worlds.qvel[:count, rate][:, :3].copy()
            worlds.step(ctrl[:, k])
            if k * scene.control_timestep < self.release:
                lowest = np.minimum(lowest, worlds.qpos[:count, ball][:, 2])
        place, velocity = worlds.qpos[:count, ball][:, :3], worlds.qvel[:count, rate][:, :3]
        return Flight(place.copy(), velocity.copy(), before, lowest)

    def cost(self, flight: Flight) -> np.ndarray:
        """(N,) how far throws are off: where the ball would come down (m) and how high it goes, a
        ball that sinks too low or is not free."""
        step, asked = self.scene.control_timestep, self.solution.asked["apex"]
        push = (flight.velocity - flight.before) / step + (0.0, 0.0, GRAVITY)
        cost = 5.0 * np.maximum(LOWEST + 0.02 - flight.lowest, 0.0)
        cost += 0.2 * np.maximum(np.linalg.norm(push, axis=1) - 1.0, 0.0)
        self.miss = np.zeros(len(cost))
        for i, (place, velocity) in enumerate(zip(flight.place, flight.velocity)):
            found = thrown.fall(place, velocity, np.array(RIM))
            self.miss[i] = found["miss"] if found["apex"] > RING_RADIUS else np.inf
            cost[i] += found["miss"] + 0.5 * abs(found["apex"] - asked)
            cost[i] += 2.0 * (found["apex"] < RING_RADIUS)
        return np.nan_to_num(cost, nan=1e6, posinf=1e6)

    def judge(self, numbers: np.ndarray) -> np.ndarray:
        """(N,) cost of candidates (N, P): how far their throws are off and the size of the
        changes."""
        ctrl = np.stack([self.targets(row, self.steps) for row in numbers])
        return self.cost(self.fly(self.worlds, ctrl)) + changed(numbers)


def changed(numbers: np.ndarray) -> np.ndarray:
    """(N,) cost of the parameters (N, P), in their units, for their size."""
    return 0.01 * (numbers**2).sum(1)


def refine(
    solution: Solution,
    settings: Search | None = None,
    *,
    threads: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Refined:
    """Seeks a throw with the real ball that the task calls a basket, from a planned one.

    ``progress(round, rounds)`` is called after every round. The best throw is returned whether
    the task calls it a basket or not. Raises RuntimeError when the simulation diverges.
    """
    settings = settings or Search()
    thrower = Thrower(solution, settings.worlds, threads)
    search = CrossEntropy(len(UNITS), settings.worlds, settings.seed)
    miss, tried = np.inf, None
    found: Refined | None = None
    done = 0
    for done in range(1, settings.rounds + 1):
        better = search.tell(thrower.judge(search.ask()))
        if better is not None:
            miss = thrower.miss[better]
        if progress is not None:
            progress(done, settings.rounds)
        if miss <= settings.near and search.best is not tried:
            tried = search.best
            now = Refined(throw(solution, thrower, search.best), done)
            if found is None or _rank(now) > _rank(found):
                found = now
            if found.success and _off(found) <= settings.level:
                return found
    return found or Refined(throw(solution, thrower, search.best), done)


def _off(found: Refined) -> float:
    """How far the apex is off the asked one (m)."""
    meta = found.clip.meta
    return abs(meta["achieved"].get("apex", math.inf) - meta["asked"]["apex"])


def _rank(found: Refined) -> tuple[bool, float]:
    return found.success, -_off(found)


def throw(solution: Solution, thrower: Thrower, numbers: np.ndarray) -> Clip:
    """The throw of the parameters (P,), played in the task with the ball until it ends."""
    strength = solution.body.strength
    steps = math.ceil(solution.duration / thrower.scene.control_timestep)
    played = perform(TASK, strength, "ball", thrower.targets(numbers, steps), _thrown)
    clip, achieved, events = played.clip, dict(played.metrics), {START: 0.0}
    if True in played.seen:
        # Thrown after two free steps: the frame before them is still in the hands.
        release = max(played.seen.index(True) - 2, 0)
        events["release"] = release / clip.fps
        assert clip.object_qpos is not None and clip.object_qvel is not None
        place, velocity = clip.object_qpos[release + 2, :3], clip.object_qvel[release + 2, :3]
        achieved["apex"] = thrown.fall(place, velocity, np.array(RIM))["apex"]
    meta: dict[str, Any] = {
        "problem": TASK,
        "asked": dict(solution.asked),
        "achieved": {name: round(value, 6) for name, value in achieved.items()},
        "strength": strength,
        "options": solution.stats.get("options", {}),
        "source": "trajectory optimisation, thrown in MuJoCo with the real ball",
        "licence": "Apache-2.0",
        "events": events,
    }
    return replace(clip, meta=meta)


def _thrown(env: Env) -> bool:
    return bool(env.memory["thrown"][0])
