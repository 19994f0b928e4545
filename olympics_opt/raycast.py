"""A small software renderer: every pixel is a ray, every shape is intersected exactly.

It needs numpy only, so pictures exist on machines without any GL library. Shapes are the four
of the body table (box, sphere, capsule, cylinder) over a ground plane with painted marks, a
one-metre grid and the shadows of a high sun. World frame z up; m; colours are linear 0..1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from olympics_opt.scenery import Mark, rgb

SUN = np.array([-0.28, -0.42, 0.86]) / np.linalg.norm([-0.28, -0.42, 0.86])
SKY_HIGH, SKY_LOW = np.array(rgb("#c9dcec")), np.array(rgb("#f4f7fa"))
GROUND = np.array(rgb("#dfe4e6"))
FOG = 0.02
"""Fading of the ground grid and marks with distance (1/m)."""


@dataclass(frozen=True)
class Solid:
    """One shape in the world.

    ``size``: box half-extents (3); sphere radius (1); capsule and cylinder radius and half
    length along local z (2).
    """

    kind: str
    pos: np.ndarray
    """(3,) centre."""
    rot: np.ndarray
    """(3, 3) R_WS."""
    size: np.ndarray
    color: tuple[float, float, float]

    @property
    def radius(self) -> float:
        """Radius of the bounding ball (m)."""
        if self.kind == "box":
            return float(np.linalg.norm(self.size))
        if self.kind == "sphere":
            return float(self.size[0])
        return float(self.size[0] + self.size[1])


@dataclass(frozen=True)
class View:
    """An orthographic camera looking at ``target``; the scale is the same at every depth."""

    target: np.ndarray
    """(3,) the point in the middle of the picture."""
    azimuth: float
    """Direction of view about +z (rad); 0 looks along +x, pi/2 along +y."""
    pitch: float
    """Downward tilt (rad)."""
    height: float
    """Metres from the lower to the upper edge."""
    width_px: int
    height_px: int

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit vectors to the right, up the picture and into it."""
        c, s = math.cos(self.azimuth), math.sin(self.azimuth)
        into = np.array([c * math.cos(self.pitch), s * math.cos(self.pitch), -math.sin(self.pitch)])
        right = np.array([s, -c, 0.0])
        return right, np.cross(right, into), into

    @property
    def scale(self) -> float:
        """Pixels per metre."""
        return self.height_px / self.height

    def project(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) pixel coordinates (x right, y down) of world points (..., 3)."""
        right, up, _ = self.axes
        d = np.asarray(points) - self.target
        return np.stack(
            (
                self.width_px / 2 + (d @ right) * self.scale,
                self.height_px / 2 - (d @ up) * self.scale,
            ),
            axis=-1,
        )

    def origins(self, rows: slice, cols: slice) -> np.ndarray:
        """(H, W, 3) points on the picture plane through ``target``, one per pixel."""
        right, up, _ = self.axes
        x = (np.arange(self.width_px)[cols] + 0.5 - self.width_px / 2) / self.scale
        y = (self.height_px / 2 - np.arange(self.height_px)[rows] - 0.5) / self.scale
        return self.target + x[None, :, None] * right + y[:, None, None] * up


def _ball(o: np.ndarray, d: np.ndarray, center: float, radius: float) -> np.ndarray:
    """Entry distance of rays ``o + t d`` (local frame) into a ball on the z axis; inf if none."""
    w = o - np.array([0.0, 0.0, center])
    b = w @ d
    q = b * b - (np.einsum("...i,...i", w, w) - radius * radius)
    return np.where(q > 0, -b - np.sqrt(np.maximum(q, 0)), np.inf)


def intersect(solid: Solid, origins: np.ndarray, direction: np.ndarray) -> tuple:
    """Where parallel rays enter a solid.

    Args:
        solid: the shape.
        origins: (..., 3) ray origins, world frame.
        direction: (3,) unit direction of all rays.

    Returns:
        Distances (...), inf where missed, and unit outward normals (..., 3), world frame.
    """
    o = (origins - solid.pos) @ solid.rot
    d = direction @ solid.rot
    if solid.kind == "box":
        step = np.where(np.abs(d) < 1e-12, 1e-12, d)
        a, b = (-solid.size - o) / step, (solid.size - o) / step
        near, far = np.minimum(a, b), np.maximum(a, b)
        t, out = near.max(-1), far.min(-1)
        hit = np.where(t < out, t, np.inf)
        axis = near.argmax(-1)
        n = np.zeros_like(o)
        np.put_along_axis(n, axis[..., None], -np.sign(step)[axis][..., None], -1)
        return hit, n @ solid.rot.T
    if solid.kind == "sphere":
        hit = _ball(o, d, 0.0, float(solid.size[0]))
        n = o + np.where(np.isfinite(hit), hit, 0.0)[..., None] * d
        return hit, (n / np.linalg.norm(n, axis=-1, keepdims=True).clip(1e-9)) @ solid.rot.T
    r, h = float(solid.size[0]), float(solid.size[1])
    a = max(d[0] ** 2 + d[1] ** 2, 1e-12)
    b = o[..., 0] * d[0] + o[..., 1] * d[1]
    q = b * b - a * (o[..., 0] ** 2 + o[..., 1] ** 2 - r * r)
    side = np.where(q > 0, (-b - np.sqrt(np.maximum(q, 0))) / a, np.inf)
    z = o[..., 2] + np.where(np.isfinite(side), side, 0.0) * d[2]
    side = np.where(np.abs(z) <= h, side, np.inf)
    if solid.kind == "capsule":
        hit = np.minimum(side, np.minimum(_ball(o, d, -h, r), _ball(o, d, h, r)))
        p = o + np.where(np.isfinite(hit), hit, 0.0)[..., None] * d
        n = p - np.clip(p[..., 2:], -h, h) * np.array([0.0, 0.0, 1.0])
        return hit, (n / np.linalg.norm(n, axis=-1, keepdims=True).clip(1e-9)) @ solid.rot.T
    dz = d[2] if abs(d[2]) > 1e-12 else 1e-12
    cap = (-math.copysign(h, dz) - o[..., 2]) / dz
    p = o + cap[..., None] * d
    cap = np.where(p[..., 0] ** 2 + p[..., 1] ** 2 <= r * r, cap, np.inf)
    hit = np.minimum(side, cap)
    p = o + np.where(np.isfinite(hit), hit, 0.0)[..., None] * d
    n = np.where(
        (cap <= side)[..., None],
        np.array([0.0, 0.0, -math.copysign(1.0, dz)]),
        p * np.array([1.0, 1.0, 0.0]) / r,
    )
    return hit, n @ solid.rot.T


def _box(view: View, centers: np.ndarray, radius: float) -> tuple[slice, slice] | None:
    """Rows and columns of the picture that balls around ``centers`` may cover."""
    px, r = view.project(np.atleast_2d(centers)), radius * view.scale + 2
    low, high = np.floor(px.min(0) - r).astype(int), np.ceil(px.max(0) + r).astype(int)
    x0, x1 = max(low[0], 0), min(high[0], view.width_px)
    y0, y1 = max(low[1], 0), min(high[1], view.height_px)
    return (slice(y0, y1), slice(x0, x1)) if x0 < x1 and y0 < y1 else None


def _inside(mark: Mark, points: np.ndarray) -> np.ndarray:
    """(...) whether ground points (..., 2) lie inside a convex mark."""
    corners = np.asarray(mark.corners)
    edges = np.roll(corners, -1, axis=0) - corners
    rel = points[..., None, :] - corners
    cross = edges[:, 0] * rel[..., 1] - edges[:, 1] * rel[..., 0]
    return np.logical_or((cross >= 0).all(-1), (cross <= 0).all(-1))


def _lines(x: np.ndarray, width: float) -> np.ndarray:
    """1 on lines of the given width (m) at whole metres, else 0."""
    return (np.abs(x - np.round(x)) < width / 2).astype(float)


def _ground(view: View, marks: Sequence[Mark], hit: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(H, W, 3) colours of the ground: plain, one-metre grid, painted marks."""
    image = np.broadcast_to(GROUND, points.shape).copy()
    line = 1.2 / view.scale
    grid = np.maximum(_lines(points[..., 0], line), _lines(points[..., 1], line))
    image -= 0.07 * grid[..., None]
    for mark in marks:
        corners = np.asarray(mark.corners)
        near = np.c_[corners, np.zeros(len(corners))]
        box = _box(view, near, 0.0)
        if box is None:
            continue
        inside = _inside(mark, points[box][..., :2]) & hit[box]
        patch = image[box]
        # The grid stays faintly visible through the paint.
        tone = np.array(rgb(mark.color)) - 0.04 * grid[box][..., None]
        patch[inside] = tone[inside]
    return image


def draw(
    solids: Sequence[Solid],
    view: View,
    marks: Sequence[Mark] = (),
    *,
    supersample: int = 2,
    ruler: bool = True,
) -> np.ndarray:
    """Draws solids on the ground.

    Args:
        solids: shapes in the world.
        view: the camera.
        marks: convex polygons painted on the ground, later ones on top.
        supersample: samples per pixel and axis.
        ruler: draws lines of equal height, one metre apart, behind everything; they are true
            in the vertical plane through ``view.target`` that faces the camera.

    Returns:
        (height_px, width_px, 3) uint8 picture.
    """
    k = supersample
    view = View(
        view.target, view.azimuth, view.pitch, view.height, view.width_px * k, view.height_px * k
    )
    right, _up, into = view.axes
    origins = view.origins(slice(None), slice(None))
    shape = origins.shape[:2]
    ramp = np.linspace(0, 1, shape[0])[:, None, None]
    image = np.broadcast_to(SKY_HIGH * (1 - ramp) + SKY_LOW * ramp, origins.shape).copy()
    back = origins - 60.0 * into  # rays start well before the scene

    if ruler:
        # Height above ground where the ray meets the upright plane through the target.
        face = np.array([into[0], into[1], 0.0]) / math.hypot(into[0], into[1])
        t = ((view.target - back) @ face) / (into @ face)
        z = back[..., 2] + t * into[2]
        along = (back + t[..., None] * into) @ right
        line = 1.2 / view.scale
        grid = np.maximum(_lines(z, line), _lines(along, line)) * (z > 0)
        image -= 0.08 * grid[..., None]

    t_ground = back[..., 2] / max(-into[2], 1e-9)
    points = back + t_ground[..., None] * into
    # An orthographic ground has no horizon of its own: end it some metres behind the athlete.
    flat = np.array([into[0], into[1]]) / math.hypot(into[0], into[1])
    hit = (points[..., :2] - view.target[:2]) @ flat < 6.0
    ground = _ground(view, marks, hit, points)
    shadow = np.zeros(shape, dtype=bool)
    for solid in solids:
        # A shadow lies on the ground between the body's foot point and its sun shift.
        reach = solid.radius
        drop = solid.pos - SUN * (solid.pos[2] / SUN[2])
        spread = reach / SUN[2] * 1.1
        box = _box(view, drop, spread)
        if box is None or solid.pos[2] < -1.0:
            continue
        t, _ = intersect(solid, points[box], SUN)
        shadow[box] |= np.isfinite(t) & (t > 0)
    ground *= np.where(shadow, 0.72, 1.0)[..., None]
    image[hit] = ground[hit]
    depth = np.where(hit, t_ground, np.inf)

    half = SUN - into
    half /= np.linalg.norm(half)
    for solid in solids:
        box = _box(view, solid.pos, solid.radius)
        if box is None:
            continue
        t, normal = intersect(solid, back[box], into)
        front = t < depth[box]
        if not front.any():
            continue
        n = normal[front]
        lit = np.clip(n @ SUN, 0, 1)
        sky = 0.5 + 0.5 * n[:, 2]
        rim = np.clip(1 + n @ into, 0, 1) ** 3
        shade = 0.52 + 0.20 * sky + 0.40 * lit - 0.30 * rim
        gloss = 0.10 * np.clip(n @ half, 0, 1) ** 24
        image[box][front] = np.asarray(solid.color) * shade[:, None] + gloss[:, None]
        depth[box][front] = t[front]
    image = image.reshape(shape[0] // k, k, shape[1] // k, k, 3).mean((1, 3))
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
