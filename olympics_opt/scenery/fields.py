"""Football and basketball: fields with their lines, goals and baskets.

Sources: the task's dimensions; FIFA Futsal Laws of the Game 1 for the marks of a field of this
size (centre circle 3 m, penalty area of arcs of 6 m); FIBA Official Basketball Rules 2 and 3 for
the court (lines of 5 cm; three-point line 6.75 m from under the basket, 0.90 m from the side).
"""

from __future__ import annotations

import math
from itertools import pairwise

from olympics_opt.scenery.paint import (
    PAINT,
    Mark,
    across,
    along,
    border,
    disc,
    mirrored,
    rectangle,
    ring,
)
from olympics_opt.scenery.props import basket_net, box, has, net_box, prop, rod
from sports.scene import Scene, SceneObject

LINE = 0.05

# Football (m): half the field, the goal, the penalty area.
FIELD_X, FIELD_Y, GOAL_Y, GOAL_Z = 16.0, 10.0, 2.0, 2.0
CENTRE_CIRCLE, AREA, SPOT = 3.0, 6.0, 0.06
PENALTY_SPOT_X = 4.0
"""Of ``penalty_kick``: 12 m from the goal plane, as in the paper."""
GOAL_DEPTH = 1.0
GRASS, MOWN, STRIPE = "#9cc48c", "#93bc83", 4.0

# Basketball (m).
COURT_X, COURT_Y = 14.5, 7.5
RIM_TO_END = 1.575
"""From under the basket's centre to the end line."""
RIM_Z, RIM_RADIUS = 3.05, 0.23
THREE, THREE_Y = 6.75, COURT_Y - 0.90
KEY_LENGTH, KEY_Y, CIRCLE, NO_CHARGE = 5.80, 2.45, 1.80, 1.25
BOARD_GAP = 0.15
"""From the rim's nearest edge to the board's face."""
BOARD_Y, BOARD_BOTTOM, BOARD_TOP = 0.9, 2.90, 3.95
SQUARE_Y, SQUARE_Z = 0.295, 0.45
"""The rectangle painted on the board: half its width, its height; its lower edge at the rim."""
WOOD, KEY_PAINT = "#e3c79c", "#c98e6a"


def _half_field() -> list[Mark]:
    """The marks of one half: penalty area, goal line between the posts, second half of lines."""
    marks = [across(FIELD_X - AREA + LINE / 2, -GOAL_Y, GOAL_Y, LINE)]
    for s in (-1.0, 1.0):
        a, b = (math.pi / 2, math.pi) if s > 0 else (math.pi, 3 * math.pi / 2)
        marks += ring(FIELD_X, s * GOAL_Y, AREA, LINE, start=a, end=b)
    return marks


def _grass() -> list[Mark]:
    marks = [rectangle(-FIELD_X - 3, FIELD_X + 3, -FIELD_Y - 3, FIELD_Y + 3, "#b3d3a4")]
    marks.append(rectangle(-FIELD_X, FIELD_X, -FIELD_Y, FIELD_Y, GRASS))
    for i in range(int(2 * FIELD_X / STRIPE)):
        if i % 2:
            x = -FIELD_X + i * STRIPE
            marks.append(rectangle(x, x + STRIPE, -FIELD_Y, FIELD_Y, MOWN))
    return marks


def soccer(scene: Scene) -> list[Mark]:
    """Touch and goal lines, halfway line, centre circle and both penalty areas."""
    return [
        *_grass(),
        *border(-FIELD_X, FIELD_X, -FIELD_Y, FIELD_Y, LINE),
        across(0.0, -FIELD_Y, FIELD_Y, LINE),
        *ring(0.0, 0.0, CENTRE_CIRCLE, LINE),
        disc(0.0, 0.0, SPOT, PAINT),
        *mirrored(_half_field()),
    ]


def penalty_kick(scene: Scene) -> list[Mark]:
    """The field with the spot from which the kick is taken."""
    return [*soccer(scene), disc(PENALTY_SPOT_X, 0.0, 0.10, PAINT, "spot")]


def goal_nets(scene: Scene) -> list[SceneObject]:
    """Nets behind the goal mouths that the scene has: both, or the one a penalty is shot at."""
    if has(scene, "net"):
        return []
    sides = (1,) if scene.name == "penalty_kick" else (-1, 1)
    found = []
    for s in sides:
        x, half = s * (FIELD_X + GOAL_DEPTH / 2), GOAL_DEPTH / 2
        end = "east" if s > 0 else "west"
        back = (s * (FIELD_X + GOAL_DEPTH), 0.0, GOAL_Z / 2)
        found.append(net_box(f"{end}_back_net", back, (0.01, GOAL_Y, GOAL_Z / 2)))
        found.append(net_box(f"{end}_top_net", (x, 0.0, GOAL_Z), (half, GOAL_Y, 0.01)))
        for side, y in (("left", GOAL_Y), ("right", -GOAL_Y)):
            name, size = f"{end}_{side}_net", (half, 0.01, GOAL_Z / 2)
            found.append(net_box(name, (x, y, GOAL_Z / 2), size))
    return found


def goal_props(scene: Scene) -> list[SceneObject]:
    """Nets, and posts and bars where the scene has none to draw."""
    found = goal_nets(scene)
    if has(scene, "post") or has(scene, "goal"):
        return found
    sides = (1,) if scene.name == "penalty_kick" else (-1, 1)
    for s in sides:
        x, y, z = s * FIELD_X, GOAL_Y + 0.05, GOAL_Z + 0.05
        frame = [rod((x, t * y, 0.0), (x, t * y, z), 0.05) for t in (-1, 1)]
        frame.append(rod((x, -y, z), (x, y, z), 0.05))
        found.append(prop("east_goal" if s > 0 else "west_goal", "#f7f7f7", frame))
    return found


def _basket_half(rim_x: float) -> list[Mark]:
    """The marks under a basket at ``rim_x`` > 0, up to the free-throw circle."""
    end = rim_x + RIM_TO_END
    line = end - KEY_LENGTH
    bend = rim_x - math.sqrt(THREE**2 - THREE_Y**2)
    angle = math.asin(THREE_Y / THREE)
    marks = [
        rectangle(line, end, -KEY_Y, KEY_Y, KEY_PAINT),
        *border(line, end, -KEY_Y, KEY_Y, LINE),
        *ring(line + LINE / 2, 0.0, CIRCLE, LINE, start=math.pi / 2, end=3 * math.pi / 2),
        *ring(rim_x, 0.0, THREE, LINE, start=math.pi - angle, end=math.pi + angle),
        *ring(rim_x, 0.0, NO_CHARGE + LINE, LINE, start=math.pi / 2, end=3 * math.pi / 2),
    ]
    marks += [along(s * (THREE_Y - LINE / 2), bend, end, LINE) for s in (-1, 1)]
    return marks


def basketball(scene: Scene) -> list[Mark]:
    """The whole court of 29 x 15 m."""
    rim_x = COURT_X - RIM_TO_END
    return [
        rectangle(-COURT_X - 2, COURT_X + 2, -COURT_Y - 2, COURT_Y + 2, "#d2b184"),
        rectangle(-COURT_X, COURT_X, -COURT_Y, COURT_Y, WOOD),
        *mirrored(_basket_half(rim_x)),
        *border(-COURT_X, COURT_X, -COURT_Y, COURT_Y, LINE),
        across(0.0, -COURT_Y, COURT_Y, LINE),
        *ring(0.0, 0.0, CIRCLE, LINE),
    ]


FREE_THROW_RIM_X = 4.5


def free_throw(scene: Scene) -> list[Mark]:
    """Half a court around a basket over x = 4.5; the line's far edge is then at x = 0.275."""
    end = FREE_THROW_RIM_X + RIM_TO_END
    half = end - COURT_X
    return [
        rectangle(half - 1, end + 2, -COURT_Y - 2, COURT_Y + 2, "#d2b184"),
        rectangle(half, end, -COURT_Y, COURT_Y, WOOD),
        *_basket_half(FREE_THROW_RIM_X),
        *border(half, end, -COURT_Y, COURT_Y, LINE),
    ]


def _basket(x: float, tag: str, scene: Scene) -> list[SceneObject]:
    """Cords, the square on the board and a post; rim and board where the scene has none."""
    s = math.copysign(1.0, x)
    face = x + s * (RIM_RADIUS + BOARD_GAP)
    z = RIM_Z + SQUARE_Z / 2
    front, edge = face - s * 0.004, 0.025
    square = [
        box((front, 0.0, RIM_Z), (0.003, SQUARE_Y, edge)),
        box((front, 0.0, RIM_Z + SQUARE_Z), (0.003, SQUARE_Y, edge)),
        *(box((front, t * SQUARE_Y, z), (0.003, edge, SQUARE_Z / 2)) for t in (-1, 1)),
    ]
    post_x, arm = face + s * 1.4, 3.3
    post = [
        rod((post_x, 0.0, 0.0), (post_x, 0.0, arm), 0.09),
        rod((post_x, 0.0, arm), (face + s * 0.08, 0.0, arm + 0.1), 0.06),
    ]
    found = [
        basket_net(f"cords{tag}", x, RIM_Z, RIM_RADIUS),
        prop(f"square{tag}", "#c4452f", square),
        prop(f"post{tag}", "#5a646e", post),
    ]
    if not has(scene, "board"):
        size = (0.015, BOARD_Y, (BOARD_TOP - BOARD_BOTTOM) / 2)
        board = box((face + s * 0.015, 0.0, (BOARD_TOP + BOARD_BOTTOM) / 2), size)
        found.append(prop(f"board{tag}", "#f4f6f7", [board]))
    if not has(scene, "rim"):
        turns = [2 * math.pi * i / 16 for i in range(17)]
        r, points = RIM_RADIUS + 0.01, []
        points = [(x + r * math.cos(t), r * math.sin(t), RIM_Z) for t in turns]
        hoop = [rod(a, b, 0.01) for a, b in pairwise(points)]
        found.append(prop(f"rim{tag}", "#e0592b", hoop))
    return found


def basketball_props(scene: Scene) -> list[SceneObject]:
    """Both baskets."""
    rim_x = COURT_X - RIM_TO_END
    return [*_basket(rim_x, "0", scene), *_basket(-rim_x, "1", scene)]


def free_throw_props(scene: Scene) -> list[SceneObject]:
    """The one basket."""
    return _basket(FREE_THROW_RIM_X, "", scene)
