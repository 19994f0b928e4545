"""When a ball that is kicked needs the fine time step in Drake, and when it does not.

Only a kick, a rebound and a hard bounce do. A ball that rolls or flies and an athlete far from it
are content with the step of an athlete alone; of a game of football that is four fifths. So a
scene has two plants, a fine one and a coarse one. The ball of the coarse one is softer, since its
stiffness is what gives it its restitution at a time step; carried from one to the other it is
raised or lowered, so that the ground presses it as before.

Nothing rests on the forecast: a coarse control step in which the ball met anything but the ground,
or the ground with more than :data:`LIGHT` times its weight, is taken back and made finely.
"""

from __future__ import annotations

import numpy as np

from sports.physics.base import GRAVITY
from sports.physics.drake_objects import PlantObject, floating
from sports.physics.drake_scene import ScenePlant
from sports.scene import Scene

REACH = 0.4
"""A ball nearer to an athlete's joint than this (m) may be touched: radius and half a shin."""
AHEAD = 1.2
"""So many control steps their closing speed is taken to last."""
NEARLY = 0.05
"""m more, for limbs that are only about to move."""
LIGHT = 3.0
"""A ball that the ground presses with more than so many times its weight bounces."""


class CalmBalls:
    """The balls that are kicked, in both plants of a scene."""

    def __init__(self, scene: Scene, fine: ScenePlant, coarse: ScenePlant) -> None:
        self.coarse = coarse
        self._fine = fine
        self._timestep = scene.control_timestep
        self._links = scene.num_agents * scene.body.num_links
        self._balls = []
        for ball in scene.kicked:
            (sphere,) = ball.shapes
            (k,) = [i for i, obj in enumerate(fine.free) if obj.name == ball.name]
            self._balls.append((k, LIGHT * sphere.mass * GRAVITY))

    def to_coarse(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The fine plant's state for the coarse one: balls in the ground are pressed as before."""
        return self._carried(self._fine, self.coarse, q), v

    def to_fine(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse of :meth:`to_coarse`."""
        return self._carried(self.coarse, self._fine, q), v

    def _carried(self, at: ScenePlant, to: ScenePlant, q: np.ndarray) -> np.ndarray:
        q = q.copy()
        for k, _ in self._balls:
            height = _height(at.free[k])
            here, there = at.free[k], to.free[k]
            sunk = here.reach - q[height]
            q[height] = there.reach - sunk * (here.stiffness / there.stiffness if sunk > 0 else 1.0)
        return q

    def soon(self, q: np.ndarray, pos: np.ndarray, linvel: np.ndarray) -> bool:
        """Whether a ball may be touched in the control step to come, or is in a bounce. q: the fine
        plant's; pos, linvel (B, 3): of links, then of free objects."""
        limbs, speeds = pos[: self._links], linvel[: self._links]
        for k, light in self._balls:
            obj = self._fine.free[k]
            if (obj.reach - q[_height(obj)]) * obj.stiffness > light:
                return True
            way = pos[self._links + k] - limbs
            far = np.linalg.norm(way, axis=1)
            closing = ((speeds - linvel[self._links + k]) * way).sum(1) / np.maximum(far, 1e-6)
            comes = AHEAD * self._timestep * np.maximum(closing, 0.0)
            if (far < REACH + NEARLY + comes).any():
                return True
        return False

    def meets(self, world: int) -> bool:
        """Whether in the coarse plant's last time step a ball met more than the ground it rolls
        on."""
        coarse = self.coarse
        return any(coarse.load(world, coarse.free[k].rigid) > light for k, light in self._balls)


def _height(ball: PlantObject) -> int:
    """Where in q its height over the ground is."""
    return floating(ball.joint)[0] + 6
