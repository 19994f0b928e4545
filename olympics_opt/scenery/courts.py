"""Rackets and combat: tennis court, table, piste and ring.

Sources: ITF Rules of Tennis 1; ITTF laws 2.1 and 2.2; FIE rules t.13 to t.17; AIBA technical rules
19 and 20. Lines belong to the area they bound, so they are painted inside it.
"""

from __future__ import annotations

from olympics_opt.scenery.paint import PAINT, Mark, across, along, border, rectangle
from olympics_opt.scenery.props import box, prop, rod
from sports import table_tennis as table
from sports import tennis as tennis_rules
from sports.boxing import HALF_RING
from sports.fencing import HALF_LENGTH, HALF_WIDTH
from sports.scene import Scene, SceneObject

# Tennis (m): lines at most 5 cm, base lines 10 cm.
BASE_X, SINGLES_Y = tennis_rules.HALF_LENGTH, tennis_rules.HALF_WIDTH
DOUBLES_Y, SERVICE_X = 5.485, 6.40
LINE, BASE_LINE, CENTRE_MARK = 0.05, 0.10, 0.10
COURT, AROUND = "#86b08c", "#b4cdb0"

# Table tennis (m): side lines 2 cm, centre line 3 mm (drawn 8 mm wide).
TABLE_LINE, TABLE_CENTRE = 0.02, 0.008
FLOOR = "#d9c3ae"

# Fencing (m): on-guard lines, and where the last two metres begin.
GUARD_X, WARNING_X = 2.0, 5.0
PISTE, WARNING = "#b9c2c9", "#cfb9ab"

APRON = 0.85
"""The floor goes on this far beyond the ropes (m)."""
CANVAS, EDGE = "#c3d2de", "#8fa5b8"
CORNERS = ("#cf3b30", "#f2f2f2", "#2f6fd0", "#f2f2f2")


def tennis(scene: Scene) -> list[Mark]:
    """The court: singles inside doubles, service boxes and centre marks."""
    marks = [
        rectangle(-18.3, 18.3, -9.15, 9.15, AROUND),  # ITF: 6.40 m behind, 3.66 m beside the court
        rectangle(-BASE_X, BASE_X, -DOUBLES_Y, DOUBLES_Y, COURT),
    ]
    for y in (SINGLES_Y, DOUBLES_Y):
        marks += [along(s * (y - LINE / 2), -BASE_X, BASE_X, LINE) for s in (-1, 1)]
    for s in (-1, 1):
        marks += [
            across(s * (BASE_X - BASE_LINE / 2), -DOUBLES_Y, DOUBLES_Y, BASE_LINE),
            across(s * (SERVICE_X - LINE / 2), -SINGLES_Y, SINGLES_Y, LINE),
            across(s * (BASE_X - CENTRE_MARK / 2), -LINE / 2, LINE / 2, CENTRE_MARK),
        ]
    marks.append(along(0.0, -SERVICE_X, SERVICE_X, LINE))
    return marks


def tennis_props(scene: Scene) -> list[SceneObject]:
    """Posts, and the tape on a net that is level."""
    net = [o for o in scene.objects if o.name.startswith("net")]
    level = len(net) == 1
    top = _top(net[0]) if level else tennis_rules.NET_POSTS
    posts = [
        rod(
            (0.0, s * tennis_rules.NET_HALF_WIDTH, 0.0),
            (0.0, s * tennis_rules.NET_HALF_WIDTH, top),
            0.04,
        )
        for s in (-1.0, 1.0)
    ]
    found = [prop("posts", "#4a5560", posts)]
    if level:
        found.append(
            prop(
                "tape",
                PAINT,
                [box((0.0, 0.0, top - 0.025), (0.015, tennis_rules.NET_HALF_WIDTH, 0.025))],
            )
        )
    return found


def table_tennis(scene: Scene) -> list[Mark]:
    """The playing space of 14 x 7 m."""
    return [rectangle(-7.0, 7.0, -3.5, 3.5, FLOOR), *border(-7.0, 7.0, -3.5, 3.5, 0.05, "#c2a78e")]


def table_tennis_props(scene: Scene) -> list[SceneObject]:
    """Lines on the table, and the tape on its net."""
    up, thin = table.HEIGHT + 0.001, 0.0015
    lines = [
        box(
            (0.0, s * (table.HALF_WIDTH - TABLE_LINE / 2), up),
            (table.HALF_LENGTH, TABLE_LINE / 2, thin),
        )
        for s in (-1.0, 1.0)
    ]
    lines += [
        box(
            (s * (table.HALF_LENGTH - TABLE_LINE / 2), 0.0, up),
            (TABLE_LINE / 2, table.HALF_WIDTH, thin),
        )
        for s in (-1.0, 1.0)
    ]
    lines.append(box((0.0, 0.0, up), (table.HALF_LENGTH, TABLE_CENTRE / 2, thin)))
    tape = box(
        (0.0, 0.0, table.HEIGHT + table.NET_HEIGHT - 0.006), (0.008, table.NET_HALF_WIDTH, 0.006)
    )
    return [
        prop("lines", PAINT, lines),
        prop("tape", PAINT, [tape]),
    ]


def fencing(scene: Scene) -> list[Mark]:
    """The piste: centre line, on-guard lines, and its last two metres at each end."""
    marks = [rectangle(-HALF_LENGTH, HALF_LENGTH, -HALF_WIDTH, HALF_WIDTH, PISTE)]
    for s in (-1, 1):
        marks += [
            across(
                s * (HALF_LENGTH + WARNING_X) / 2,
                -HALF_WIDTH,
                HALF_WIDTH,
                HALF_LENGTH - WARNING_X,
                WARNING,
            ),
            across(s * (HALF_LENGTH - 0.025), -HALF_WIDTH, HALF_WIDTH, 0.05),
            across(s * GUARD_X, -HALF_WIDTH, HALF_WIDTH, 0.04),
        ]
    # The centre line is broken, so that it is not taken for another.
    pieces = 8
    step = 2 * HALF_WIDTH / pieces
    marks += [
        across(0.0, -HALF_WIDTH + i * step, -HALF_WIDTH + (i + 0.6) * step, 0.04)
        for i in range(pieces)
    ]
    return marks


def boxing(scene: Scene) -> list[Mark]:
    """The ring's floor: the canvas between the ropes, and the apron around it."""
    out = HALF_RING + APRON
    return [
        rectangle(-out, out, -out, out, EDGE),
        rectangle(-HALF_RING, HALF_RING, -HALF_RING, HALF_RING, CANVAS),
        *border(-HALF_RING, HALF_RING, -HALF_RING, HALF_RING, 0.06, PAINT),
    ]


def boxing_props(scene: Scene) -> list[SceneObject]:
    """Corner posts in their colours."""
    r = HALF_RING + 0.08
    places = [(-r, -r), (-r, r), (r, r), (r, -r)]
    return [
        prop(f"corner{i}", color, [rod((x, y, 0.0), (x, y, 1.42), 0.05)])
        for i, ((x, y), color) in enumerate(zip(places, CORNERS))
    ]


def _top(net: SceneObject) -> float:
    """Height of a net that is one upright box (m)."""
    shape = net.shapes[0]
    return net.pos[2] + shape.center[2] + shape.size[2]
