"""What a sport's ground looks like, and the colours of an athlete: shared by every renderer.

Nothing here touches physics. World frame, z up, play along +x; m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sports import free_throw, hurdling
from sports.scene import Scene


def rgb(color: str) -> tuple[float, float, float]:
    """Red, green, blue (0..1) of a ``"#rrggbb"`` colour."""
    return tuple(int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))  # type: ignore[return-value]


@dataclass(frozen=True)
class Mark:
    """A convex polygon painted on the ground."""

    corners: tuple[tuple[float, float], ...]
    """Points (x, y), in order around the polygon (m)."""
    color: str
    label: str = ""
    """Short text beside it, such as ``20 m``; empty for none."""


def _rectangle(x0: float, x1: float, y0: float, y1: float, color: str, label: str = "") -> Mark:
    return Mark(((x0, y0), (x1, y0), (x1, y1), (x0, y1)), color, label)


TRACK, PAINT, SAND, SAND_LINE, MAT = "#c9806a", "#ffffff", "#e6d3a6", "#cdb684", "#7fa3c4"
WOOD, KEY = "#dcbc8c", "#b9775a"


def _long_jump() -> list[Mark]:
    marks = [
        _rectangle(-1.5, 20.0, -0.5, 0.5, TRACK),
        _rectangle(-1.5, 20.0, -0.53, -0.5, PAINT),
        _rectangle(-1.5, 20.0, 0.5, 0.53, PAINT),
        _rectangle(20.0, 45.0, -1.5, 1.5, SAND),
        _rectangle(19.8, 20.0, -0.5, 0.5, PAINT, "board"),
    ]
    for metre in range(1, 25):
        text = f"{metre} m" if metre % 5 == 0 or metre in (3, 7, 8, 9) else ""
        marks.append(_rectangle(20 + metre - 0.015, 20 + metre + 0.015, -1.5, 1.5, SAND_LINE, text))
    return marks


def _high_jump() -> list[Mark]:
    return [
        _rectangle(-1.5, 19.6, -0.5, 8.0, TRACK),
        _rectangle(20.1, 24.0, 4.0, 8.0, MAT),
        _rectangle(19.985, 20.015, 3.2, 8.8, PAINT),
    ]


def _hurdling() -> list[Mark]:
    half = hurdling.LANE_HALF_WIDTH
    marks = [
        _rectangle(-3.0, 130.0, -1.2, 1.2, TRACK),
        _rectangle(-3.0, 130.0, -half - 0.05, -half, PAINT),
        _rectangle(-3.0, 130.0, half, half + 0.05, PAINT),
        _rectangle(-0.025, 0.025, -half, half, PAINT),
        _rectangle(109.975, 110.025, -1.2, 1.2, PAINT, "110 m"),
    ]
    for k in range(hurdling.HURDLES):
        x = hurdling.FIRST_X + hurdling.GAP * k
        for side in (-half, half - 0.15):
            marks.append(_rectangle(x - 0.025, x + 0.025, side, side + 0.15, PAINT))
    return marks


def _frame(x0: float, x1: float, y0: float, y1: float, inside: str) -> list[Mark]:
    """An area with a line of 5 cm within its edge."""
    line = 0.05
    return [
        _rectangle(x0, x1, y0, y1, PAINT),
        _rectangle(x0 + line, x1 - line, y0 + line, y1 - line, inside),
    ]


def _key(rim_x: float, side: float) -> list[Mark]:
    """The restricted area before a basket, from the free-throw line to the end line (FIBA)."""
    ends = sorted((rim_x - side * 4.225, rim_x + side * 1.575))
    return _frame(ends[0], ends[1], -2.45, 2.45, KEY)


def _free_throw() -> list[Mark]:
    end = free_throw.RIM[0] + 1.575
    return [*_frame(end - 14.0, end, -7.5, 7.5, WOOD), *_key(free_throw.RIM[0], 1.0)]


_MARKS = {
    "long_jump": _long_jump,
    "high_jump": _high_jump,
    "hurdling": _hurdling,
    "free_throw": _free_throw,
}


def ground_marks(scene: Scene) -> list[Mark]:
    """Marks painted on a scene's ground, from its name (a task's) and its named sites."""
    marks: list[Mark] = []
    for task, make in _MARKS.items():
        if scene.name.startswith(task):
            marks += make()
    for name, (x, y, _z) in scene.sites.items():
        marks.append(_rectangle(x - 0.06, x + 0.06, y - 0.06, y + 0.06, "#b0563c", name))
    return marks


# Left cool, right warm, trunk neutral; arms light, legs dark, hands and feet strongest, so that
# a picture shows at a glance which hand or foot touches what.
TRUNK, HEAD = "#d9d2c5", "#c9b8a2"
LIMBS = {
    "L_arm": "#7db8e8",
    "L_hand": "#12c2d6",
    "L_leg": "#2f6fc0",
    "L_foot": "#123a8c",
    "R_arm": "#f2b27a",
    "R_hand": "#f0d000",
    "R_leg": "#dd6236",
    "R_foot": "#9c1f14",
}
_ARM = ("Thorax", "Shoulder", "Elbow")
_FOOT = ("Ankle", "Toe")
_LEG = ("Hip", "Knee")


def link_color(link: str) -> str:
    """Colour of an athlete's link by side and limb."""
    side, _, rest = link.partition("_")
    if side not in ("L", "R"):
        return HEAD if link in ("Head", "Neck") else TRUNK
    part = "arm" if rest in _ARM else "leg" if rest in _LEG else "foot" if rest in _FOOT else "hand"
    return LIMBS[f"{side}_{part}"]


def complete_qpos(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """(T, nq) positions of a whole scene from positions of a whole scene or of its first athlete.

    Missing athletes and objects stay where the scene puts them. Raises ValueError for any other
    width.
    """
    qpos = np.atleast_2d(np.asarray(qpos, dtype=float))
    if qpos.shape[1] == scene.nq:
        return qpos
    agent = scene.agent_qpos(0)
    if qpos.shape[1] != agent.stop:
        raise ValueError(
            f"qpos has {qpos.shape[1]} columns; scene '{scene.name}' needs {scene.nq}, "
            f"or {agent.stop} for its first athlete alone"
        )
    full = np.tile(scene.default_qpos(), (len(qpos), 1))
    full[:, agent] = qpos
    return full
