"""Props: things that are drawn and never touched, as objects of the scene that is drawn.

A prop is a ``SceneObject`` that a picture adds to a scene (a flag, a basket's net, a tape), so
that every renderer draws it like any other object; physics never sees it. World frame; m.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal

from olympics_opt.scenery.paint import rgba
from sports.humanoid.body import Shape
from sports.scene import SceneObject

Point = tuple[float, float, float]

NET_ALPHA = 0.34
"""Opacity of a net without its strings."""
MESH = 0.12
"""Width of the meshes that are drawn (m); finer ones could not be seen."""


def box(center: Point, half: Point) -> Shape:
    """A box along the axes, from its centre and half its extents."""
    return Shape("box", center, half, 0.0)


def rod(start: Point, end: Point, radius: float) -> Shape:
    """A rod with round ends."""
    return Shape("capsule", start, (radius,), 0.0, end=end)


def plate(start: Point, end: Point, radius: float) -> Shape:
    """A disc, or a rod with flat ends."""
    return Shape("cylinder", start, (radius,), 0.0, end=end)


def prop(
    name: str,
    color: str,
    shapes: Iterable[Shape],
    *,
    alpha: float = 1.0,
    motion: Literal["fixed", "mocap"] = "fixed",
    pos: Point = (0.0, 0.0, 0.0),
) -> SceneObject:
    """Something to look at. ``mocap`` ones are moved by what a recording shows."""
    return SceneObject(
        name, tuple(shapes), motion, pos, rgba=rgba(color, alpha), meets_ground=False
    )


def is_net(name: str) -> bool:
    """Whether an object is drawn as meshes that one sees through."""
    return name.split("_")[0].rstrip("0123456789") == "net" or name.endswith("_net")


def net_box(name: str, center: Point, half: Point, color: str = "#e9edf0") -> SceneObject:
    """A flat net in a frame; ``name`` must be one of a net."""
    return prop(name, color, [box(center, half)], alpha=NET_ALPHA)


def basket_net(name: str, x: float, z: float, radius: float) -> SceneObject:
    """The cords under a rim at (x, 0, z): 0.40 m long and narrower at the lower end."""
    cords, length, narrow = 12, 0.40, 0.62
    shapes = []
    for i in range(cords):
        for turn in (0.5, -0.5):  # crossing cords make the meshes
            a, b = (2 * math.pi * (i + k) / cords for k in (0.0, turn))
            top = (x + radius * math.cos(a), radius * math.sin(a), z)
            low = radius * narrow
            shapes.append(rod(top, (x + low * math.cos(b), low * math.sin(b), z - length), 0.006))
    return prop(name, "#f4f4f0", shapes)
