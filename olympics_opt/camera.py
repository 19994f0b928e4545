"""Where the camera stands: every athlete and the ball in the picture, as large as that allows.

A solo athlete without a ball is followed from the right of the way it goes. In every other sport
the camera has a direction of its own, and a picture holds all athletes, what they throw or play
with, and the sport's anchors (a goal, a rim). World frame, z up; m.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from olympics_opt.episode import Player, heading
from olympics_opt.raycast import View
from olympics_opt.scenery.golf import FLAG_HEIGHT
from sports.scene import Scene

MARGIN = 1.16
"""A picture is this much higher than what it must show: its captions need room."""
SMALLEST = 2.6
"""No picture is less high (m)."""
ARMS, HEAD, FEET = 0.85, 0.95, 1.05
"""An athlete reaches this far from its root: to the sides, up, down (m)."""
BALL = 0.35
"""Least room around a ball or what else is thrown (m)."""
INSET_ABOVE = 7.5
"""Where a picture is higher than this (m), a second one shows an athlete from near."""
INSET_HEIGHT, INSET_SHARE = 2.9, 0.42
"""The inset: metres from its lower to its upper edge, its share of the picture's height."""
FIELD_HORIZON = 80.0
"""Fields are drawn to this distance behind the target (m)."""


@dataclass(frozen=True)
class Stand:
    """Where a sport is seen from."""

    azimuth: float = 90.0
    """Direction of view about +z (deg): 0 looks along +x, 90 along +y."""
    pitch: float = 12.0
    """Downward tilt (deg)."""
    near: float = 6.5
    """Pictures up to this many metres high share one scale; the wider ones share another."""
    anchors: tuple[tuple[float, float, float], ...] = ()
    """Points that every picture holds."""
    above_target: float = 0.0
    """What stands at the target is so high (m)."""


_STANDS = {
    "javelin": Stand(pitch=9.0),
    "golf": Stand(azimuth=58.0, pitch=26.0, above_target=FLAG_HEIGHT),
    # From behind the athlete, as on television: along the court it would be a narrow strip.
    "tennis": Stand(azimuth=145.0, pitch=24.0, anchors=((-11.9, 0.0, 0.0), (11.9, 0.0, 0.0))),
    "table_tennis": Stand(pitch=14.0, anchors=((-1.4, 0.0, 0.7), (1.4, 0.0, 0.7))),
    "fencing": Stand(azimuth=84.0, pitch=9.0),
    "boxing": Stand(azimuth=74.0, pitch=12.0),
    "penalty_kick": Stand(
        azimuth=62.0, pitch=17.0, anchors=((17.4, -2.1, 0.0), (16.0, 2.1, 0.0), (17.4, 2.1, 2.1))
    ),
    "soccer": Stand(pitch=32.0),
    "free_throw": Stand(pitch=7.0, anchors=((4.9, 0.0, 3.9),)),
    "basketball": Stand(pitch=27.0),
}


def stand(scene: Scene) -> Stand | None:
    """Where the scene's sport is seen from; None where one athlete is followed."""
    found = _STANDS.get(re.sub(r"_\dv\d$", "", scene.name))
    if found is None and (scene.num_agents > 1 or things(scene)):
        return Stand()
    return found


def things(scene: Scene) -> tuple[str, ...]:
    """What is thrown or played with: the moving objects a picture must show."""
    return tuple(o.name for o in scene.free_objects if "ball" in o.name or "javelin" in o.name)


def reach(scene: Scene, name: str) -> float:
    """How far an object reaches from its origin (m)."""
    (found,) = (o for o in scene.objects if o.name == name)
    far = 0.0
    for shape in found.shapes:
        size = math.hypot(*shape.size) if shape.kind == "box" else shape.size[0]
        ends = [shape.center] if shape.end is None else [shape.center, shape.end]
        far = max(far, size + max(math.hypot(*end) for end in ends))
    return far


def must_show(player: Player, frame: int, view: View, own: Stand | None = None) -> np.ndarray:
    """(K, 3) world points that a picture of a frame must hold; ``own``: another stand than the
    sport's."""
    right, up, _ = view.axes
    z = np.array([0.0, 0.0, 1.0])
    points = []
    for p in player.roots()[frame]:
        points += [p + ARMS * right, p - ARMS * right, p + HEAD * z, p - FEET * z]
    for name in things(player.scene):
        p, room = player.thing(name)[frame], max(BALL, reach(player.scene, name))
        points += [p + s * room * axis for axis in (right, up) for s in (1, -1)]
    own = own or stand(player.scene)
    points += [np.asarray(a) for a in own.anchors] if own else []
    for p in player.targets(frame):
        points += [p, p + (own.above_target if own else 0.0) * z]
    return np.array(points)


def _fitted(points: np.ndarray, view: View) -> View:
    """The view moved and scaled to hold world points (K, 3)."""
    right, up, into = view.axes
    a, b, c = points @ right, points @ up, points @ into
    wide = np.ptp(a) * view.height_px / view.width_px
    metres = max(float(wide), float(np.ptp(b)), SMALLEST / MARGIN) * MARGIN
    target = (
        (a.max() + a.min()) / 2 * right
        + (b.max() + b.min()) / 2 * up
        + (c.max() + c.min()) / 2 * into
    )
    return replace(view, target=target, height=metres)


def _plain(own: Stand, width: int, height: int) -> View:
    return View(
        np.zeros(3),
        math.radians(own.azimuth),
        math.radians(own.pitch),
        SMALLEST,
        width,
        height,
        horizon=FIELD_HORIZON,
    )


def shots(player: Player, frames: Sequence[int], width: int, height: int) -> list[View]:
    """A view for each of some frames; the near ones at one scale, the wide ones at another."""
    own = stand(player.scene)
    if own is None:
        return side_views(player, frames, width, height)
    plain = _plain(own, width, height)
    views = [_fitted(must_show(player, f, plain), plain) for f in frames]
    near = [v.height for v in views if v.height <= own.near]
    scales = {True: max(near, default=0.0), False: max((v.height for v in views), default=0.0)}
    return [replace(v, height=scales[v.height <= own.near]) for v in views]


def shot(player: Player, frame: int, width: int, height: int, own: Stand) -> View:
    """The view of one frame from a stand of the caller's."""
    plain = _plain(own, width, height)
    return _fitted(must_show(player, frame, plain, own), plain)


def tracking(player: Player, width: int, height: int) -> list[View]:
    """A view for every frame, without jerks: for videos."""
    count, own = len(player), stand(player.scene)
    if own is None:
        root = smooth(player.qpos[:, :3], 0.15 / player.episode.dt)
        metres = 3.2
        azimuth = heading(player.qpos) + math.pi / 2 - 0.3
        low = metres / 2 - 0.3
        targets = [np.array([p[0], p[1], max(low, p[2] + 0.9 - metres / 2)]) for p in root]
        pitch = math.radians(9.0)
        return [View(t, azimuth, pitch, metres, width, height) for t in targets]
    plain = _plain(own, width, height)
    views = [_fitted(must_show(player, f, plain), plain) for f in range(count)]
    targets = smooth(np.array([v.target for v in views]), 0.3 / player.episode.dt)
    # The target lags behind: what leaves the picture on one side needs as much room as it lags.
    lag = np.array([np.linalg.norm(v.target - t) for v, t in zip(views, targets)])
    heights = np.array([v.height for v in views])
    tops = _steady(heights + 2 * lag, player.episode.dt)
    return [replace(v, target=t, height=h) for v, t, h in zip(views, targets, tops)]


def side_views(
    player: Player, frames: Sequence[int], width: int, height: int, max_metres: float = 3.8
) -> list[View]:
    """Side views at one scale, from the right of the direction of travel, following the athlete.

    The ground stays in the picture as long as ``max_metres`` allow; higher flights are followed.
    """
    agent = player.qpos[:, :7]
    chosen = agent[list(frames)]
    top = float(chosen[:, 2].max()) + 1.0
    metres = min(max(2.4, top + 0.2), max_metres)
    azimuth = heading(chosen) + math.pi / 2
    lowest = metres / 2 - 0.3
    return [
        View(
            np.array([p[0], p[1], max(lowest, p[2] + 1.0 - metres / 2)]),
            azimuth,
            math.radians(7.0),
            metres,
            width,
            height,
        )
        for p in chosen
    ]


def leading(player: Player, frame: int) -> int:
    """The athlete to look at: the one nearest to the ball, else the first."""
    names = things(player.scene)
    if not names:
        return 0
    away = player.roots()[frame] - player.thing(names[0])[frame]
    return int(np.linalg.norm(away, axis=-1).argmin())


def inset(player: Player, frame: int, view: View) -> View | None:
    """A near view of one athlete for a corner of a wide picture; None where it needs none."""
    if view.height <= INSET_ABOVE:
        return None
    root = player.roots()[frame, leading(player, frame)]
    size = round(INSET_SHARE * view.height_px)
    return replace(
        view,
        target=root + np.array([0.0, 0.0, max(0.25, INSET_HEIGHT / 2 - 0.35 - root[2])]),
        height=INSET_HEIGHT,
        pitch=min(view.pitch, math.radians(16.0)),
        width_px=size,
        height_px=size,
    )


def focus(player: Player, lens: float, aspect: float = 16 / 9) -> tuple[np.ndarray, np.ndarray]:
    """Where a perspective camera looks and from how far, smoothed: (T, 3) points, (T,) metres.

    ``lens``: focal length over the picture's half height; ``aspect``: width over height.
    """
    views = tracking(player, round(540 * aspect), 540)
    targets = np.array([v.target for v in views])
    reach = [
        _distance(must_show(player, i, view) - view.target, view, lens, aspect)
        for i, view in enumerate(views)
    ]
    return targets, MARGIN * _steady(np.array(reach), player.episode.dt)


def _distance(points: np.ndarray, view: View, lens: float, aspect: float) -> float:
    """How far (m) a camera must be from its target to see points (K, 3) relative to it."""
    right, up, into = view.axes
    side, high = np.abs(points @ right) * lens / aspect, np.abs(points @ up) * lens
    return float((np.maximum(side, high) - points @ into).max())


def _steady(sizes: np.ndarray, dt: float) -> np.ndarray:
    """(T,) sizes (m) smoothed over time, and no smaller than those of the next half second: what
    comes must fit already, or it would leave the picture."""
    reach, count = max(1, round(0.5 / dt)), len(sizes)
    most = np.array([sizes[max(0, i - reach) : i + reach + 1].max() for i in range(count)])
    return smooth(most[:, None], 0.3 / dt)[:, 0]


def smooth(values: np.ndarray, sigma: float) -> np.ndarray:
    """(T, k) values smoothed over time by a Gaussian of ``sigma`` frames."""
    reach = math.ceil(3 * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    return np.stack(
        [np.convolve(column, kernel / kernel.sum(), mode="valid") for column in padded.T], axis=1
    )
