"""Golf: the tee, the turf with its waves, the flag at the target.

The waves are those of the scene's surface, over which the ball law lets the ball roll:
h(x, y) = amplitude (cos(k x + a) + cos(k y + b)), growing from nothing between two distances from
the tee (smoothstep). The athlete stands on the plane z = 0, as the surface is flat there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from olympics_opt.scenery.paint import Mark, disc, rectangle, ring
from olympics_opt.scenery.props import plate, prop, rod
from sports.scene import Scene, SceneObject

FAIRWAY, GREEN, TEE = "#8fbf7e", "#a9d494", "#79ad6c"
AREA_X, AREA_Y = (-8.0, 32.0), (-14.0, 14.0)
"""What is drawn of the turf (m)."""
MESH = 0.5
"""Distance of a drawn mesh's points (m): 20 to a wave, at most 1.3 cm off it."""
FLAG_HEIGHT, HOLE = 1.6, 0.054
"""The flag's height is drawn low; the hole's radius is that of the rules (4 1/4 in across)."""


@dataclass(frozen=True)
class Terrain:
    """Ground that is not a plane."""

    phases: tuple[float, float]
    """a and b (rad)."""
    amplitude: float = 0.25
    """Of each of the two waves (m)."""
    k: float = 2 * math.pi / 10.0
    """Wave number (rad/m)."""
    inner: float = 2.0
    outer: float = 6.0
    """The waves begin and have their whole height at these distances from the origin (m)."""

    @property
    def highest(self) -> float:
        """No point is higher, nor lower than the negative of it (m)."""
        return 2 * self.amplitude

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height (m) at places (any shape; m)."""
        waves = np.cos(self.k * x + self.phases[0]) + np.cos(self.k * y + self.phases[1])
        s = np.clip((np.hypot(x, y) - self.inner) / (self.outer - self.inner), 0.0, 1.0)
        return self.amplitude * waves * (s * s * (3 - 2 * s))

    def normal(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(..., 3) unit upward normal at places, by central differences over 2 cm."""
        e = 0.01
        dx = (self.height(x + e, y) - self.height(x - e, y)) / (2 * e)
        dy = (self.height(x, y + e) - self.height(x, y - e)) / (2 * e)
        n = np.stack((-dx, -dy, np.ones_like(dx)), axis=-1)
        return n / np.linalg.norm(n, axis=-1, keepdims=True)

    def mesh(self, step: float = MESH) -> np.ndarray:
        """(rows, columns, 3) points of a mesh over the drawn area: y by rows, x by columns."""
        (x0, x1), (y0, y1) = AREA_X, AREA_Y
        x = np.linspace(x0, x1, round((x1 - x0) / step) + 1)
        y = np.linspace(y0, y1, round((y1 - y0) / step) + 1)
        xs, ys = np.meshgrid(x, y)
        return np.stack((xs, ys, self.height(xs, ys)), axis=-1)


def marks(scene: Scene) -> list[Mark]:
    """Turf, tee, and rings of equal distance from the tee every 5 m."""
    found = [
        rectangle(*AREA_X, *AREA_Y, FAIRWAY),
        rectangle(-1.5, 1.5, -1.2, 2.2, TEE),
    ]
    for metre in (5, 10, 15, 20):
        found += ring(0.0, 0.0, metre + 0.02, 0.04, "#c9e3bd", -0.62, 0.62)
        # A small disc carries the name, where the line of play crosses the ring.
        found.append(disc(float(metre), 0.0, 0.06, "#c9e3bd", f"{metre} m"))
    return found


def flag(scene: Scene) -> list[SceneObject]:
    """The flag in its hole, with a small green around it: moved to the target."""
    pole = rod((0.0, 0.0, 0.0), (0.0, 0.0, FLAG_HEIGHT), 0.012)
    cloth = [
        rod((0.0, 0.02, z), (0.0, 0.02 + 0.42 * (1 - i / 9), z), 0.02)
        for i, z in enumerate(np.linspace(FLAG_HEIGHT - 0.03, FLAG_HEIGHT - 0.31, 9).tolist())
    ]
    return [
        prop("target_pole", "#f4f4ef", [pole], motion="mocap"),
        prop("target_flag", "#d8322a", cloth, motion="mocap"),
        prop(
            "target_hole",
            "#25302a",
            [plate((0, 0, -0.01), (0, 0, 0.012), 2 * HOLE)],
            motion="mocap",
        ),
    ]


def tee(scene: Scene) -> list[SceneObject]:
    """The peg under the ball."""
    return [prop("tee", "#d9b98a", [rod((0.0, 0.0, 0.0), (0.0, 0.0, 0.045), 0.005)])]
