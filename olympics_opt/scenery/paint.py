"""Paint on the ground: convex polygons, and the lines, discs and rings that fields are made of.

World frame, z up, play along +x; m. Paint is flat: it lies on whatever ground there is.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

PAINT = "#ffffff"
SEGMENTS = 48
"""Corners of a full circle."""


def rgb(color: str) -> tuple[float, float, float]:
    """Red, green, blue (0..1) of a ``"#rrggbb"`` colour."""
    return tuple(int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))  # type: ignore[return-value]


def rgba(color: str, alpha: float = 1.0) -> tuple[float, float, float, float]:
    """Red, green, blue and opacity (0..1) of a ``"#rrggbb"`` colour."""
    return (*rgb(color), alpha)


@dataclass(frozen=True)
class Mark:
    """A convex polygon painted on the ground."""

    corners: tuple[tuple[float, float], ...]
    """Points (x, y), in order around the polygon (m)."""
    color: str
    label: str = ""
    """Short text beside it, such as ``20 m``; empty for none."""


def rectangle(x0: float, x1: float, y0: float, y1: float, color: str, label: str = "") -> Mark:
    """An area between two values of x and two of y."""
    return Mark(((x0, y0), (x1, y0), (x1, y1), (x0, y1)), color, label)


def across(
    x: float, y0: float, y1: float, width: float, color: str = PAINT, label: str = ""
) -> Mark:
    """A line along y in the middle of which is ``x``."""
    return rectangle(x - width / 2, x + width / 2, y0, y1, color, label)


def along(y: float, x0: float, x1: float, width: float, color: str = PAINT) -> Mark:
    """A line along x in the middle of which is ``y``."""
    return rectangle(x0, x1, y - width / 2, y + width / 2, color)


def border(
    x0: float, x1: float, y0: float, y1: float, width: float, color: str = PAINT
) -> list[Mark]:
    """Four lines *inside* a rectangle: a field's lines belong to it."""
    return [
        rectangle(x0, x0 + width, y0, y1, color),
        rectangle(x1 - width, x1, y0, y1, color),
        rectangle(x0, x1, y0, y0 + width, color),
        rectangle(x0, x1, y1 - width, y1, color),
    ]


def slanted(
    start: tuple[float, float], end: tuple[float, float], width: float, color: str = PAINT
) -> Mark:
    """A line from one point to another."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    scale = width / 2 / math.hypot(dx, dy)
    u, v = -dy * scale, dx * scale
    corners = (
        (start[0] + u, start[1] + v),
        (start[0] - u, start[1] - v),
        (end[0] - u, end[1] - v),
        (end[0] + u, end[1] + v),
    )
    return Mark(corners, color)


def disc(x: float, y: float, radius: float, color: str, label: str = "") -> Mark:
    """A filled circle."""
    turns = [2 * math.pi * i / SEGMENTS for i in range(SEGMENTS)]
    corners = tuple((x + radius * math.cos(t), y + radius * math.sin(t)) for t in turns)
    return Mark(corners, color, label)


def ring(
    x: float,
    y: float,
    radius: float,
    width: float,
    color: str = PAINT,
    start: float = 0.0,
    end: float = 2 * math.pi,
) -> list[Mark]:
    """A circle's line, or an arc of it from ``start`` to ``end`` (rad), as convex pieces.

    ``radius`` is that of its outer edge: circles are measured to it, as fields are.
    """
    count = max(1, round(SEGMENTS * abs(end - start) / (2 * math.pi)))
    turns = [start + (end - start) * i / count for i in range(count + 1)]
    marks = []
    for a, b in pairwise(turns):
        corners = tuple(
            (x + r * math.cos(t), y + r * math.sin(t))
            for r, t in ((radius - width, a), (radius, a), (radius, b), (radius - width, b))
        )
        marks.append(Mark(corners, color))
    return marks


def mirrored(marks: Iterable[Mark]) -> list[Mark]:
    """The marks and their mirror images beyond x = 0: the other half of a field."""
    marks = list(marks)
    other = [replace(m, corners=tuple((-x, y) for x, y in m.corners)) for m in marks]
    return [*marks, *other]
