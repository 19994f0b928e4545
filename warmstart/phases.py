"""What a motion is made of: phases with contacts, boxes of its coordinates, cost weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

HEEL, TOE = (0, 1), (2, 3, 4, 5)
ELASTIC_REACH = 4.0
"""An elastic program may use this multiple of a torque limit."""
ELASTIC_PRICE = 10.0
"""Cost of one unit of a joint's torque limit in an elastic program."""
MODES = {"flat": (*HEEL, *TOE), "toe": TOE}


@dataclass(frozen=True)
class Phase:
    """A stretch of the motion with constant contacts."""

    name: str
    intervals: int
    duration: tuple[float, float]
    """Shortest and longest duration (s)."""
    feet: Mapping[str, str] = field(default_factory=dict)
    """Contact mode by side, e.g. ``{"L": "flat"}``; modes: ``flat``, ``toe``."""
    grading: float = 1.0
    """Length of the later intervals over the first: small steps where motion is abrupt."""
    closing: float = 1.0
    """Length of the earlier intervals over the last: small steps before a blow."""
    loaded: bool = True
    """Whether what the athlete holds is still in its hand."""
    abrupt: bool = False
    """A moment in which torques, forces and accelerations may change at no cost: a hand opens."""

    def spacing(self) -> np.ndarray:
        """(intervals,) lengths relative to their mean: growing over the first third, shrinking over
        the last one, else equal."""
        i = np.arange(self.intervals) / max(self.intervals / 3, 1)
        w = np.minimum(1 / self.grading + (1 - 1 / self.grading) * i, 1.0)
        w = np.minimum(w, (1 / self.closing + (1 - 1 / self.closing) * i)[::-1])
        return w / w.mean()


@dataclass(frozen=True)
class Grip:
    """Two hands that hold one thing between them.

    It is rigid on the ``first`` link of the loaded athlete. While it is held neither hand moves
    against the other, and the second one pushes it with a force that is free and whose reaction
    the first one feels: the thing's own force is what the first hand adds to that. Forces act at
    the thing's centre of mass; hands that turn it do so together.
    """

    first: str
    point: tuple[float, float, float]
    """The thing's centre of mass in the frame of the first link (m)."""
    second: str
    other: tuple[float, float, float]
    """The same place in the frame of the second link (m)."""
    turned: tuple[tuple[float, float, float], ...]
    """(3, 3) R_first_second, which they keep."""
    drift: float = 0.003
    """How far the hands may be off that (m; rad over a lever of 0.1 m)."""
    most: float = 100.0
    """Largest component of the second hand's force (N)."""


@dataclass(frozen=True)
class Weights:
    """Cost weights. Effort is the integral of the squared torque over its limit."""

    effort: float = 1.0
    torque_rate: float = 3e-3
    """On the integral of the squared rate of torque over its limit (per s)."""
    force_rate: float = 2e-4
    """On the integral of the squared rate of force over body weight (per s)."""
    shear: float = 0.0
    """On the integral of squared horizontal force at contact points over body weight. Feet that
    push against each other save effort, but the soft friction of engines creeps under load."""
    press: float = 0.02
    """On the integral of the squared force of the second hand of a grip over 20 N."""
    press_rate: float = 1e-4
    """On the integral of the squared rate of that (per s)."""
    acceleration: float = 2e-3
    """On the integral of squared joint acceleration over 50 rad/s^2."""
    acceleration_rate: float = 4e-4
    """On the integral of the squared rate of joint acceleration over 50 rad/s^2 (per s)."""


@dataclass(frozen=True)
class Bounds:
    """Boxes of the reduced coordinates (K-independent), by coordinate name."""

    position: Mapping[str, tuple[float, float]]
    rate: Mapping[str, tuple[float, float]]
    acceleration: float = 400.0
    """Largest acceleration of any coordinate (m/s^2, rad/s^2)."""
    hinge_rate: float = 20.0
    """Largest rate of a coordinate without a box of its own (rad/s)."""
    friction_x: float = 0.8
    """|f_x| <= friction_x f_z; with friction_y inside the circle of the ground's mu = 1."""
    friction_y: float = 0.5
    torque_share: float = 0.97
    """Share of the torque limit that the optimiser may use at knots."""

    def limits(self) -> dict[str, float]:
        """The bounds that no coordinate names: what a second opinion must use as well."""
        return {k: v for k, v in vars(self).items() if isinstance(v, float)}

    def boxes(self) -> dict[str, dict[str, tuple[float, float]]]:
        """The others, ``position`` and ``rate``, by coordinate name: as much a part of the problem,
        for what one problem forbids another one may need."""
        return {"position": dict(self.position), "rate": dict(self.rate)}
