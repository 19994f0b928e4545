"""A small software renderer: every pixel is a ray, every shape is intersected exactly.

It needs numpy only, so pictures exist on machines without any GL library. Shapes are the four
of the body table (box, sphere, capsule, cylinder) over the ground (a plane, or golf's waves) with
painted marks, a grid and the shadows of a high sun. Some shapes are seen through: nets are drawn
as their meshes. World frame z up; m; colours are linear 0..1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from olympics_opt.scenery import Mark, Terrain, rgb

SUN = np.array([-0.28, -0.42, 0.86]) / np.linalg.norm([-0.28, -0.42, 0.86])
SKY_HIGH, SKY_LOW = np.array(rgb("#c9dcec")), np.array(rgb("#f4f7fa"))
GROUND = np.array(rgb("#dfe4e6"))
FAR = 250.0
"""Rays start this far before the picture plane (m)."""
STRIDE = 0.2
"""Horizontal steps in which a ray looks for the first wave in its way (m)."""


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
    alpha: float = 1.0
    """Opacity; what is behind a shape with less than 1 shines through."""
    mesh: float = 0.0
    """Width of a net's meshes (m): a box is drawn as strings that far apart, in a veil of its
    opacity. 0 for a closed surface."""

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
    horizon: float = 6.0
    """The ground ends this far behind the target (m): seen in parallel it has no horizon."""

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


def grid_step(view: View) -> float:
    """Distance of the lines of the ground's grid and of the ruler (m): 1, 5 or 10."""
    return 1.0 if view.scale >= 40 else 5.0 if view.scale >= 8 else 10.0


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


def _cover(mark: Mark, points: np.ndarray, foot: np.ndarray) -> np.ndarray:
    """(...) how much of a convex mark's colour ground points (..., 2) show.

    ``foot`` (2, 2) maps a direction on the ground to the size of a pixel along it (m): a mark
    thinner than a pixel is drawn a pixel wide and paler, so that no line gets lost.
    """
    corners = np.asarray(mark.corners)
    edges = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(edges, axis=1).clip(1e-9)
    normal = np.stack((-edges[:, 1], edges[:, 0]), axis=1) / length[:, None]
    depth = (corners @ normal.T).T - (corners * normal).sum(1)[:, None]  # (edges, corners)
    turn = 1.0 if depth.max() >= -depth.min() else -1.0
    width = np.ptp(depth, axis=1)
    pixel = np.linalg.norm(normal @ foot, axis=1)
    slack = np.maximum(pixel - width, 0.0) / 2
    inside = np.ones(points.shape[:-1], dtype=bool)
    for n, start, s in zip(normal, corners, slack):
        inside &= ((points - start) @ n) * turn >= -s
    return inside * max(float((width / np.maximum(width, pixel)).min()), 0.35)


def _lines(x: np.ndarray, width: float, step: float) -> np.ndarray:
    """1 on lines of the given width (m) at whole multiples of a step, else 0."""
    return (np.abs(x - step * np.round(x / step)) < width / 2).astype(float)


def _ground(
    view: View,
    marks: Sequence[Mark],
    hit: np.ndarray,
    points: np.ndarray,
    rough: float,
    step: float,
    k: int,
) -> np.ndarray:
    """(H, W, 3) colours of the ground: plain, a grid of ``step`` (m), painted marks; ``rough``:
    how far it may lie above or below z = 0 (m), ``k``: the view's pixels to one of the picture."""
    image = np.broadcast_to(GROUND, points.shape).copy()
    right, up, into = view.axes
    line = 1.2 / view.scale
    grid = np.maximum(*(_lines(points[..., i], line, step) for i in (0, 1)))
    image -= 0.07 * grid[..., None]
    foot = np.stack((right[:2], up[:2] / max(into[2] ** 2, 1e-6)), axis=1) * k / view.scale
    for mark in marks:
        corners = np.asarray(mark.corners)
        near = np.c_[corners, np.zeros(len(corners))]
        box = _box(view, near, rough)
        if box is None:
            continue
        cover = (_cover(mark, points[box][..., :2], foot) * hit[box])[..., None]
        # The grid stays faintly visible through the paint.
        tone = np.array(rgb(mark.color)) - 0.04 * grid[box][..., None]
        image[box] += cover * (tone - image[box])
    return image


def _waves(view: View, ground: Terrain, back: np.ndarray) -> np.ndarray:
    """(H, W) distance of the first wave in the way of each ray from ``back``; inf for none."""
    into, high = view.axes[2], ground.highest
    slope = max(-into[2], 1e-9)
    first = (back[..., 2] - high) / slope
    span = 2 * high / slope
    steps = max(2, math.ceil(span * math.hypot(into[0], into[1]) / STRIDE))

    def over(t: np.ndarray) -> np.ndarray:
        p = back + t[..., None] * into
        return p[..., 2] - ground.height(p[..., 0], p[..., 1])

    low, up = first, over(first)
    found = np.full(first.shape, False)
    a, b, ya, yb = (np.zeros_like(first) for _ in range(4))
    for i in range(1, steps + 1):
        t = first + span * i / steps
        y = over(t)
        new = (y <= 0) & ~found
        a, b = np.where(new, low, a), np.where(new, t, b)
        ya, yb = np.where(new, up, ya), np.where(new, y, yb)
        found |= new
        low, up = t, y
    for _ in range(3):  # regula falsi: a metre's wave is nearly straight over a stride
        t = a + (b - a) * ya / np.where(ya - yb == 0, 1.0, ya - yb)
        y = over(t)
        a, ya = np.where(y > 0, t, a), np.where(y > 0, y, ya)
        b, yb = np.where(y > 0, b, t), np.where(y > 0, yb, y)
    return np.where(found, t, np.inf)


def _strings(solid: Solid, points: np.ndarray, pixel: float) -> np.ndarray:
    """(...) opacity of a net at world points on it: its strings, ``pixel`` (m) or more wide."""
    p = (points - solid.pos) @ solid.rot
    across = np.argsort(solid.size)[-2:]
    width = max(0.012, min(pixel, 0.4 * solid.mesh))
    string = np.zeros(points.shape[:-1])
    for axis in across:
        string = np.maximum(string, _lines(p[..., axis] + solid.size[axis], width, solid.mesh))
    return np.maximum(solid.alpha * 0.35, string * 0.85)


def draw(
    solids: Sequence[Solid],
    view: View,
    marks: Sequence[Mark] = (),
    *,
    ground: Terrain | None = None,
    supersample: int = 2,
    ruler: bool = True,
) -> np.ndarray:
    """Draws solids on the ground.

    Args:
        solids: shapes in the world.
        view: the camera.
        marks: convex polygons painted on the ground, later ones on top.
        ground: waves instead of the plane z = 0.
        supersample: samples per pixel and axis.
        ruler: draws lines of equal height, as far apart as the grid's, behind everything; they
            are true in the vertical plane through ``view.target`` that faces the camera.

    Returns:
        (height_px, width_px, 3) uint8 picture.
    """
    k = supersample
    step = grid_step(view)
    view = replace(view, width_px=view.width_px * k, height_px=view.height_px * k)
    right, _up, into = view.axes
    origins = view.origins(slice(None), slice(None))
    shape = origins.shape[:2]
    ramp = np.linspace(0, 1, shape[0])[:, None, None]
    image = np.broadcast_to(SKY_HIGH * (1 - ramp) + SKY_LOW * ramp, origins.shape).copy()
    back = origins - FAR * into

    if ruler:
        # Height above ground where the ray meets the upright plane through the target.
        face = np.array([into[0], into[1], 0.0]) / math.hypot(into[0], into[1])
        t = ((view.target - back) @ face) / (into @ face)
        z = back[..., 2] + t * into[2]
        along = (back + t[..., None] * into) @ right
        line = 1.2 / view.scale
        grid = np.maximum(_lines(z, line, step), _lines(along, line, step)) * (z > 0)
        image -= 0.08 * grid[..., None]

    t_ground = back[..., 2] / max(-into[2], 1e-9) if ground is None else _waves(view, ground, back)
    points = back + np.where(np.isfinite(t_ground), t_ground, 0.0)[..., None] * into
    flat = np.array([into[0], into[1]]) / math.hypot(into[0], into[1])
    hit = ((points[..., :2] - view.target[:2]) @ flat < view.horizon) & np.isfinite(t_ground)
    rough = 0.0 if ground is None else ground.highest
    tone = _ground(view, marks, hit, points, rough, step, k)
    if ground is not None:
        n = ground.normal(points[..., 0], points[..., 1])
        tone *= (0.45 + 0.55 * np.clip(n @ SUN, 0, 1) / SUN[2])[..., None]
        tone *= 1.0 + 0.12 * points[..., 2:] / ground.highest  # crests are paler than hollows
    tone *= (1.0 - 0.28 * _shadows(view, solids, points, rough))[..., None]
    image[hit] = tone[hit]
    depth = np.where(hit, t_ground, np.inf)

    clear = [s for s in solids if s.alpha < 1.0 or s.mesh > 0.0]
    for solid in solids:
        if solid.alpha >= 1.0 and solid.mesh == 0.0:
            _paint(view, solid, image, depth, back, k)
    for solid in sorted(clear, key=lambda s: -float((s.pos - view.target) @ into)):
        _paint(view, solid, image, depth, back, k)
    image = image.reshape(shape[0] // k, k, shape[1] // k, k, 3).mean((1, 3))
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def _shadows(view: View, solids: Sequence[Solid], points: np.ndarray, rough: float) -> np.ndarray:
    """(H, W) how much of the sun solids keep from ground points (H, W, 3), 0..1."""
    shadow = np.zeros(points.shape[:2])
    for solid in solids:
        # A shadow lies on the ground between the body's foot point and its sun shift.
        drop = solid.pos - SUN * (solid.pos[2] / SUN[2])
        spread = (solid.radius / SUN[2] + rough / SUN[2]) * 1.1
        box = _box(view, drop, spread)
        if box is None or solid.pos[2] < -1.0:
            continue
        t, _ = intersect(solid, points[box], SUN)
        dark = 0.35 if solid.mesh else solid.alpha
        shadow[box] = np.maximum(shadow[box], dark * (np.isfinite(t) & (t > 0)))
    return shadow


def _paint(
    view: View, solid: Solid, image: np.ndarray, depth: np.ndarray, back: np.ndarray, k: int
) -> None:
    """Draws one solid over a picture (H, W, 3) where it is nearer than ``depth`` (H, W)."""
    box = _box(view, solid.pos, solid.radius)
    if box is None:
        return
    into = view.axes[2]
    t, normal = intersect(solid, back[box], into)
    front = t < depth[box]
    if not front.any():
        return
    half = SUN - into
    half /= np.linalg.norm(half)
    n = normal[front]
    lit = np.clip(n @ SUN, 0, 1)
    sky = 0.5 + 0.5 * n[:, 2]
    rim = np.clip(1 + n @ into, 0, 1) ** 3
    shade = 0.52 + 0.20 * sky + 0.40 * lit - 0.30 * rim
    gloss = 0.10 * np.clip(n @ half, 0, 1) ** 24
    color = np.asarray(solid.color) * shade[:, None] + gloss[:, None]
    if solid.alpha >= 1.0 and solid.mesh == 0.0:
        image[box][front] = color
        depth[box][front] = t[front]
        return
    alpha = np.full(len(color), solid.alpha)
    if solid.mesh:
        points = back[box][front] + t[front][:, None] * into
        alpha = _strings(solid, points, k / view.scale)
    under = image[box][front]
    image[box][front] = under + alpha[:, None] * (color - under)
