"""Racket sports on states made by hand: where the ball is, what it touched and when."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from torch import Tensor

from sports.task import Advance
from tests.sports.hand_made import HandMade

AIR, GRAVITY = 1.204, 9.81
DRAG = {"tennis": (0.55, 0.032, 0.058), "table_tennis": (0.45, 0.020, 0.0027)}
"""Coefficient, radius (m), mass (kg) of the balls: the table of the physics page."""


class HandMadeRally(HandMade):
    """Worlds whose next step is decided by the test."""

    def __init__(self, task: str, num_worlds: int = 1, **options: object) -> None:
        super().__init__(task, num_worlds, **options)
        self.scene = self.env.physics.scene
        self._lean = torch.zeros(())
        self._clean = self.state.clone()
        self.quiet()

    def restore(self) -> None:
        """As new."""
        self.state = self._clean.clone()
        self.quiet()

    def quiet(self) -> None:
        """Nothing is touched."""
        n, surfaces = self.env.num_worlds, len(self.scene.surfaces)
        physics = self.env.physics
        physics.ball_hits = torch.zeros(n, surfaces, dtype=torch.int32)
        physics.ball_hit_time = torch.full((n, surfaces), torch.inf)
        physics.ball_hit_pos = torch.zeros(n, surfaces, 3)

    def start(self, luck: Tensor | None = None) -> None:
        """Begins an episode in the placed state, by random numbers of the test or new ones."""
        self._apply()
        context = {"luck": luck if luck is not None else self.luck(0)}
        self.env.memory = self.env.task.begin(self.env.view, context)
        self.env.view.clock = torch.full((self.env.num_worlds,), 5)

    def luck(self, seed: int) -> Tensor:
        """(N, 16, 9) uniform numbers."""
        generator = torch.Generator().manual_seed(seed)
        return torch.rand(self.env.num_worlds, 16, 9, generator=generator)

    def put_ball(self, pos: Sequence[float] | Tensor, linvel: Sequence[float] | Tensor) -> None:
        """In every world, or (N, 3)."""
        q, v = self.scene.object_qpos("ball"), self.scene.object_qvel("ball")
        self.state.qpos[:, q.start : q.start + 3] = torch.as_tensor(pos, dtype=torch.float32)
        self.state.qvel[:, v.start : v.start + 3] = torch.as_tensor(linvel, dtype=torch.float32)

    def touch(self, surface: str, pos: Sequence[float], time: float = 0.01, count: int = 1) -> None:
        """The ball meets a surface in the next step."""
        s, physics = self.scene.surface_index(surface), self.env.physics
        physics.ball_hits[:, s] = count
        physics.ball_hit_time[:, s] = time
        physics.ball_hit_pos[:, s] = torch.tensor(pos)

    def lean(self, forces: Sequence[float]) -> None:
        """Contact forces (N) of the next step: of each athlete the whole and the racket's hand, on
        each of table and nets."""
        self._lean = torch.tensor(forces, dtype=torch.float32)

    def go(
        self,
        pos: Sequence[float],
        linvel: Sequence[float] = (0.0, 0.0, -1.0),
        forces: dict | None = None,
    ) -> Advance:
        """One step that ends with the ball there, after the touches asked for."""
        self.put_ball(pos, linvel)
        self._apply()
        physics = self.env.physics
        for link, newtons in (forces or {}).items():
            physics.ground_force[:, 0, physics.scene.body.link_index(link), 2] = newtons
        physics.pair_force[:] = self._lean
        self._lean = torch.zeros(())
        self.env.view.clock = self.env.view.clock + 1
        step = self.env.task.advance(self.env.view, self.env.memory)
        self.env.memory = step.memory
        self.quiet()
        return step

    def observe(self) -> Tensor:
        """(N, A, obs)"""
        return self.env._observe().clone()

    def goal(self, name: str) -> Tensor:
        """(N, A, k) one of the goal features."""
        return self.observe()[..., self.env.obs_slices[f"goal/{name}"]]


def launched(step: Advance) -> bool:
    """Whether the machine launched a ball in the first world."""
    return step.move is not None and bool(step.move.mask[0])


@cache
def _world(task: str, num_worlds: int, options: tuple[tuple[str, object], ...]) -> HandMadeRally:
    return HandMadeRally(task, num_worlds, **dict(options))


def made(task: str, num_worlds: int = 1, **options: object) -> HandMadeRally:
    """As new; built once for all tests."""
    world = _world(task, num_worlds, tuple(options.items()))
    world.restore()
    return world


def flights(law: str, pos: np.ndarray, linvel: np.ndarray, dt: float = 1e-3) -> np.ndarray:
    """(T, N, 3) positions of balls without spin for 2.5 s: gravity and quadratic drag, by the
    classical Runge-Kutta method in double precision."""
    coefficient, radius, mass = DRAG[law]
    k = 0.5 * AIR * coefficient * math.pi * radius**2 / mass

    def slope(v: np.ndarray) -> np.ndarray:
        return -k * np.linalg.norm(v, axis=-1, keepdims=True) * v - np.array((0, 0, GRAVITY))

    p, v = np.array(pos, dtype=float), np.array(linvel, dtype=float)
    out = [p]
    for _ in range(int(2.5 / dt)):
        a = slope(v)
        b = slope(v + dt / 2 * a)
        c = slope(v + dt / 2 * b)
        d = slope(v + dt * c)
        p = p + dt * v + dt * dt / 6 * (a + b + c)
        v = v + dt / 6 * (a + 2 * b + 2 * c + d)
        out.append(p)
    return np.array(out)


def where_through(way: np.ndarray, axis: int, value: float) -> np.ndarray:
    """(N, 3) where ways (T, N, 3) first fall through a coordinate; NaN where they do not."""
    out = np.full(way.shape[1:], np.nan)
    for i in range(way.shape[1]):
        x = way[:, i, axis]
        k = np.nonzero((x[:-1] > value) & (x[1:] <= value))[0]
        if k.size:
            share = (x[k[0]] - value) / (x[k[0]] - x[k[0] + 1])
            out[i] = way[k[0], i] + share * (way[k[0] + 1, i] - way[k[0], i])
    return out
