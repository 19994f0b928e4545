"""What tracking wants: links, centre of mass and momentum as in the reference, and a legal jump."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sports import long_jump
from sports.humanoid.body import Body
from sports.physics.base import Geometry
from sports.scene import Scene
from warmstart.clip import Clip


@dataclass(frozen=True)
class Weights:
    """Cost per control step of a candidate; each term is a mean over links or dofs."""

    link_position: float = 60.0
    """Per m^2 of distance of the links from the reference's, in the world."""
    link_rotation: float = 3.0
    """Per rad^2 (small angles) of the links' attitude."""
    com_position: float = 100.0
    """Per m^2 of distance of the centre of mass: it decides height and length."""
    momentum: float = 10.0
    """Per (m/s)^2 of the centre of mass's velocity: the flight is decided at take-off."""
    spin: float = 0.02
    """Per (kg m^2/s)^2 of angular momentum about the centre of mass: so is its rotation."""
    joint_rate: float = 0.003
    """Per (rad/s)^2."""
    effort: float = 0.05
    """Per squared share of the servo's range by which targets leave the reference's."""
    bar: float = 1000.0
    """Per m by which the bar has moved, and per 10 m/s at which it moves."""
    foul: float = 2000.0
    """Per m by which a contact before the take-off lies beyond the line."""
    mark: float = 400.0
    """Per m by which a contact after the landing lies behind the asked mark. A centimetre must
    weigh more than the pose of the legs, which reaches it."""
    after: float = 0.02
    """Share of the tracking terms that counts after the reference has ended."""


SPIN = {"long_jump": 0.1}
"""``Weights.spin`` by problem, where it is another one. The feet of a long jumper are 0.8 m ahead
of the centre of mass as they land: a spin of 5 kg m^2/s too much at the take-off, turned for 0.65 s
by some 12 kg m^2, is 0.2 m of length."""

AIM = 0.05
"""Tracking wants a long jump so much longer than asked (m). A link that touches between two control
steps is measured at its rear, and nothing is seen of that before it touches: jumps that aimed at
the length itself fell 2 cm short of it now and then."""


def weights_of(problem: str) -> Weights:
    """What the tracking of a problem's motions wants, if it is told nothing else."""
    return Weights(spin=SPIN.get(problem, Weights.spin))


@dataclass(frozen=True)
class Reference:
    """Kinematics of the reference at the control rate, T frames."""

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    link_pos: np.ndarray  # (T, B, 3)
    link_quat: np.ndarray  # (T, B, 4)
    whole: np.ndarray  # (T, 9) centre of mass, its velocity, angular momentum about it

    def held(self, frames: int) -> Reference:
        """With the last frame repeated: where a task needs to see what comes after."""

        def hold(x: np.ndarray) -> np.ndarray:
            return np.concatenate([x, np.repeat(x[-1:], frames, axis=0)])

        return Reference(*(hold(getattr(self, f.name)) for f in fields(self)))


class Placed(NamedTuple):
    """Where the support points and links of N candidates are (m)."""

    x: np.ndarray
    """(N, K) of the points."""
    height: np.ndarray
    """(N, K) of the balls around them over the ground."""
    rear: np.ndarray
    """(N, B) smallest x of each link."""
    standing: np.ndarray
    """(N, B) bool, links that leave a mark now."""


@dataclass(frozen=True)
class JumpRules:
    """Contacts that the long jump punishes, from the links' support points."""

    takeoff: int
    """Frame of the reference from which it flies."""
    mark: float
    """x behind which no mark shall be (m)."""
    body: Body
    weights: Weights

    @cached_property
    def _points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Support points (K, 3) in their links' frames, radii (K,), link indices (K,), and the
        first point of each link (B,)."""
        geometry = Geometry(self.body, "cpu")
        owner = geometry.owner.numpy()
        first = np.searchsorted(owner, np.arange(self.body.num_links))
        return geometry.points.numpy(), geometry.radii.numpy(), owner, first

    def placed(self, pos: np.ndarray, mat: np.ndarray) -> Placed:
        """Of links at pos (N, B, 3) with rotation matrices mat (N, B, 3, 3)."""
        points, radii, owner, first = self._points
        x, height = (
            pos[:, owner, i] + np.einsum("nkj,kj->nk", mat[:, owner, i], points) for i in (0, 2)
        )
        height = height - radii
        low = np.minimum.reduceat(height, first, axis=1)
        rear = np.minimum.reduceat(x - radii, first, axis=1)
        return Placed(x, height, rear, standing=low < long_jump.TOUCH)

    def cost(self, at: int, here: Placed, before: Placed, touched: np.ndarray) -> np.ndarray:
        """(N,) at a frame; ``before`` is the frame before it, ``touched`` (N, B) tells which links
        met the ground in the control step between them."""
        if at <= self.takeoff:
            beyond = np.where(here.height < 0.01, here.x - long_jump.LINE_X + 0.01, 0.0)
            return self.weights.foul * np.maximum(beyond.max(1), 0.0)
        if at <= self.takeoff + 4:
            return np.zeros(len(here.x))
        # Near the ground counts in part, so that candidates see a slope before they touch.
        near = np.clip(1.0 - here.height / 0.15, 0.0, 1.0)
        behind = np.maximum(self.mark - here.x, 0.0) * near
        # A link that touched and is off again is measured at its rear, here or a step before.
        brief = touched & ~here.standing
        rear = np.minimum(here.rear, before.rear)
        passed = np.maximum(self.mark - rear, 0.0) * brief
        return self.weights.mark * np.maximum(behind.max(1), passed.max(1))


def jump_rules(clip: Clip, scene: Scene, weights: Weights) -> JumpRules:
    """The long jump's rules for a clip: its take-off event, and a little more than the length
    it was asked for."""
    events, asked = clip.meta.get("events", {}), clip.meta.get("asked", {})
    return JumpRules(
        takeoff=math.ceil(float(events.get("takeoff", 0.0)) / scene.control_timestep),
        mark=long_jump.LINE_X + float(asked.get("length", 0.0)) + AIM,
        body=scene.body,
        weights=weights,
    )
