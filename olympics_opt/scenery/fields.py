"""Football and basketball: fields with their lines, goals and baskets.

Sources: the task's dimensions; FIFA Futsal Laws of the Game 1 for the marks of a field of this
size (centre circle 3 m, penalty area of arcs of 6 m); FIBA Official Basketball Rules 2 and 3 for
the court (lines of 5 cm; three-point line 6.75 m from under the basket, 0.90 m from the side).
"""

from __future__ import annotations

import math

import numpy as np

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
from olympics_opt.scenery.props import basket_net, box, net_box, prop, rod
from sports.hoop import RING_RADIUS
from sports.humanoid.body import Shape
from sports.penalty_kick import SPOT
from sports.scene import Scene, SceneObject
from sports.soccer import GOAL_HALF_WIDTH, HALF_LENGTH, HALF_WIDTH

LINE = 0.05

# Football (m): circle, penalty area, spot, the depth of a goal.
CENTRE_CIRCLE, AREA, SPOT_RADIUS = 3.0, 6.0, 0.06
GOAL_DEPTH = 1.0
GRASS, MOWN, STRIPE = "#9cc48c", "#93bc83", 4.0

# Basketball (m).
RIM_TO_END = 1.575
"""From under the basket's centre to the end line."""
SIDE_Y = 7.5
THREE, THREE_Y = 6.75, SIDE_Y - 0.90
KEY_LENGTH, KEY_Y, CIRCLE, NO_CHARGE = 5.80, 2.45, 1.80, 1.25
SQUARE_Y, SQUARE_Z = 0.295, 0.45
"""The rectangle painted on the board: half its width, its height; its lower edge at the rim."""
HALF_COURT = 14.5
"""From the end line of a single basket to the middle of its court."""
WOOD, AROUND, KEY_PAINT = "#e3c79c", "#d2b184", "#c98e6a"


def _half_field() -> list[Mark]:
    """The marks of one half: penalty area, goal line between the posts, second half of lines."""
    marks = [across(HALF_LENGTH - AREA + LINE / 2, -GOAL_HALF_WIDTH, GOAL_HALF_WIDTH, LINE)]
    for s in (-1.0, 1.0):
        a, b = (math.pi / 2, math.pi) if s > 0 else (math.pi, 3 * math.pi / 2)
        marks += ring(HALF_LENGTH, s * GOAL_HALF_WIDTH, AREA, LINE, start=a, end=b)
    return marks


def _grass() -> list[Mark]:
    marks = [
        rectangle(-HALF_LENGTH - 3, HALF_LENGTH + 3, -HALF_WIDTH - 3, HALF_WIDTH + 3, "#b3d3a4")
    ]
    marks.append(rectangle(-HALF_LENGTH, HALF_LENGTH, -HALF_WIDTH, HALF_WIDTH, GRASS))
    for i in range(int(2 * HALF_LENGTH / STRIPE)):
        if i % 2:
            x = -HALF_LENGTH + i * STRIPE
            marks.append(rectangle(x, x + STRIPE, -HALF_WIDTH, HALF_WIDTH, MOWN))
    return marks


def soccer(scene: Scene) -> list[Mark]:
    """Touch and goal lines, halfway line, centre circle and both penalty areas."""
    return [
        *_grass(),
        *border(-HALF_LENGTH, HALF_LENGTH, -HALF_WIDTH, HALF_WIDTH, LINE),
        across(0.0, -HALF_WIDTH, HALF_WIDTH, LINE),
        *ring(0.0, 0.0, CENTRE_CIRCLE, LINE),
        disc(0.0, 0.0, SPOT_RADIUS, PAINT),
        *mirrored(_half_field()),
    ]


def penalty_kick(scene: Scene) -> list[Mark]:
    """The field with the spot from which the kick is taken."""
    return [*soccer(scene), disc(*SPOT, 0.10, PAINT)]


def goal_nets(scene: Scene) -> list[SceneObject]:
    """Nets behind the goals of the scene: at their backs, on top and on both sides."""
    found = []
    for goal in scene.objects:
        if not goal.name.startswith("goal"):
            continue
        x, half, high = np.abs([[s.center, s.end] for s in goal.shapes]).max((0, 1))
        s = np.sign(goal.shapes[0].center[0])
        middle, depth = s * (x + GOAL_DEPTH / 2), GOAL_DEPTH / 2
        back = (s * (x + GOAL_DEPTH), 0.0, high / 2)
        found += [
            net_box(f"{goal.name}_back_net", back, (0.01, half, high / 2)),
            net_box(f"{goal.name}_top_net", (middle, 0.0, high), (depth, half, 0.01)),
        ]
        for side, y in (("a", half), ("b", -half)):
            name, size = f"{goal.name}_{side}_net", (depth, 0.01, high / 2)
            found.append(net_box(name, (middle, y, high / 2), size))
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
    """The court around the scene's baskets: the whole of it for two, half of it for one."""
    rims = [o.pos[0] for o in scene.objects if o.name.endswith("_rim")]
    end = max(rims) + RIM_TO_END
    start = -end if len(rims) > 1 else end - HALF_COURT
    half = _basket_half(max(rims))
    marks = [
        rectangle(start - 2, end + 2, -SIDE_Y - 2, SIDE_Y + 2, AROUND),
        rectangle(start, end, -SIDE_Y, SIDE_Y, WOOD),
        *(mirrored(half) if len(rims) > 1 else half),
        *border(start, end, -SIDE_Y, SIDE_Y, LINE),
    ]
    if len(rims) > 1:
        marks += [across(0.0, -SIDE_Y, SIDE_Y, LINE), *ring(0.0, 0.0, CIRCLE, LINE)]
    return marks


def baskets(scene: Scene) -> list[SceneObject]:
    """Of each of the scene's hoops: cords, the square on the board, and a post to hold it."""
    found = []
    objects = {o.name: o for o in scene.objects}
    for name, hoop in objects.items():
        if not name.endswith("_rim"):
            continue
        name = name.removesuffix("_rim")
        board = objects[f"{name}_board"]
        (plate,) = board.shapes
        s = math.copysign(1.0, plate.center[0])
        x, _, z = hoop.pos
        face = board.pos[0] + plate.center[0] - s * plate.size[0]
        found += [
            basket_net(f"{name}_cords", x, z, RING_RADIUS),
            prop(f"{name}_square", "#c4452f", _square(face - s * 0.003, z)),
            prop(f"{name}_post", "#5a646e", _post(face, s)),
        ]
    return found


def _square(x: float, z: float) -> list[Shape]:
    """The rectangle on a board's face at ``x``, above the height ``z`` of the rim."""
    edge, middle = 0.025, z + SQUARE_Z / 2
    return [
        box((x, 0.0, z), (0.003, SQUARE_Y, edge)),
        box((x, 0.0, z + SQUARE_Z), (0.003, SQUARE_Y, edge)),
        *(box((x, t * SQUARE_Y, middle), (0.003, edge, SQUARE_Z / 2)) for t in (-1, 1)),
    ]


def _post(face: float, s: float) -> list[Shape]:
    """A post behind the end line and an arm to the board, whose face is at ``face``."""
    x, arm = face + s * 1.5, 3.3
    start = (face + s * 0.08, 0.0, arm + 0.1)
    return [rod((x, 0.0, 0.0), (x, 0.0, arm), 0.09), rod((x, 0.0, arm), start, 0.06)]
