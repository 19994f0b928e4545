"""Colours of athletes: by side and limb, by team, and of what they hold in their hands.

Left cool, right warm, trunk neutral; arms light, legs dark, hands and feet strongest, so that a
picture shows at a glance which hand or foot touches what. Where athletes play against each other
each side wears its shirt, and the limbs lean towards its colour.
"""

from __future__ import annotations

from dataclasses import replace

from olympics_opt.scenery.paint import rgb
from sports.humanoid.body import Body, with_equipment
from sports.scene import Scene

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

SHIRTS = ("#2f6fd0", "#cf3b30")
"""Of team 0, which plays towards +x, and of team 1."""
_SHADES = {"trunk": 1.0, "Head": 1.28, "arm": 1.16, "hand": 1.45, "leg": 0.80, "foot": 0.52}
"""How light the parts of a team's athlete are beside its shirt."""
_LEFT = 0.88
"""The left side is this much darker than the right."""

TOOLS = {
    "club": ("#3b4048", "#22262c"),
    "racket": ("#e8e4d2", "#33373d"),
    "paddle": ("#c42f2a", "#9a6a3c"),
    "sword": ("#aeb6bf",),
}
"""Colours of the shapes of a piece of equipment, in the order of its rows; gloves are hands."""


def teams(scene: Scene) -> tuple[int, ...]:
    """Team of each athlete: the first half of them plays against the second."""
    half = (scene.num_agents + 1) // 2
    return tuple(int(agent >= half) for agent in range(scene.num_agents))


def _part(link: str) -> tuple[str, str]:
    side, _, rest = link.partition("_")
    if side not in ("L", "R"):
        return "", "Head" if link in ("Head", "Neck") else "trunk"
    part = "arm" if rest in _ARM else "leg" if rest in _LEG else "foot" if rest in _FOOT else "hand"
    return side, part


def _mixed(color: str, k: float) -> str:
    """A colour made lighter (k > 1, towards white) or darker."""
    channels = [c * k if k <= 1 else 1 - (1 - c) * (2 - k) for c in rgb(color)]
    return "#" + "".join(f"{round(255 * min(max(c, 0.0), 1.0)):02x}" for c in channels)


def link_color(link: str, team: int | None = None) -> str:
    """Colour of an athlete's link by side and limb, and by its team where it has one."""
    side, part = _part(link)
    if team is not None:
        return _mixed(SHIRTS[team % 2], _SHADES[part] * (_LEFT if side == "L" else 1.0))
    if not side:
        return HEAD if part == "Head" else TRUNK
    return LIMBS[f"{side}_{part}"]


def _tools(body: Body) -> dict[tuple[str, int], str]:
    """Colours of equipment by link and index of the shape: the last shapes of its link."""
    bare = [replace(link, shapes=()) for link in body.links]
    found: dict[tuple[str, int], str] = {}
    for name in set(body.equipment) & set(TOOLS):
        for link in with_equipment(bare, (name,)):
            first = len(body.links[body.link_index(link.name)].shapes) - len(link.shapes)
            for k, color in zip(range(len(link.shapes)), TOOLS[name]):
                found[link.name, first + k] = color
    return found


def shape_colors(scene: Scene, agent: int) -> dict[str, tuple[str, ...]]:
    """Colour of every shape of an athlete, by link."""
    team = teams(scene)[agent] if scene.num_agents > 1 else None
    tools = _tools(scene.body)
    return {
        link.name: tuple(
            tools.get((link.name, k), link_color(link.name, team)) for k in range(len(link.shapes))
        )
        for link in scene.body.links
    }
