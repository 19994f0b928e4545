"""Track and field: runways, pits, mats, the hurdles' lane, the javelin's sector.

Distances and widths are those of the tasks' rules.
"""

from __future__ import annotations

from olympics_opt.scenery.paint import PAINT, Mark, across, along, rectangle, slanted
from sports import hurdling as rules
from sports.javelin import HALF_FIELD, LINE_X, half_sector
from sports.scene import Scene

TRACK, SAND, SAND_LINE, MAT, TURF = "#c9806a", "#e6d3a6", "#cdb684", "#7fa3c4", "#a9c99a"
LINE = 0.05
"""Width of a track's lines (m)."""

SECTOR_LENGTH = 100.0


def long_jump(scene: Scene) -> list[Mark]:
    """Runway, board and pit, with the metres written beside it."""
    marks = [
        rectangle(-1.5, 20.0, -0.5, 0.5, TRACK),
        rectangle(-1.5, 20.0, -0.53, -0.5, PAINT),
        rectangle(-1.5, 20.0, 0.5, 0.53, PAINT),
        rectangle(20.0, 45.0, -1.5, 1.5, SAND),
        rectangle(19.8, 20.0, -0.5, 0.5, PAINT, "board"),
    ]
    for metre in range(1, 25):
        text = f"{metre} m" if metre % 5 == 0 or metre in (3, 7, 8, 9) else ""
        marks.append(across(20.0 + metre, -1.5, 1.5, 0.03, SAND_LINE, text))
    return marks


def high_jump(scene: Scene) -> list[Mark]:
    """Run-up, mat and the plane of the bar."""
    return [
        rectangle(-1.5, 19.6, -0.5, 8.0, TRACK),
        rectangle(20.1, 24.0, 4.0, 8.0, MAT),
        across(20.0, 3.2, 8.8, 0.03),
    ]


def hurdling(scene: Scene) -> list[Mark]:
    """One lane with the start, the finish, and a tick at each hurdle and every ten metres."""
    half, finish = rules.LANE_HALF_WIDTH, rules.FINISH_X
    marks = [
        rectangle(-3.0, finish + 20.0, -half - 0.6, half + 0.6, TRACK),
        along(-half - LINE / 2, -3.0, finish + 20.0, LINE),
        along(half + LINE / 2, -3.0, finish + 20.0, LINE),
        across(-LINE / 2, -half, half, LINE),
        # A race ends at the edge of the finishing line that is nearer to the start.
        across(finish + LINE / 2, -half, half, LINE),
    ]
    for x in range(10, int(finish), 10):
        marks.append(across(float(x), -half - 0.25, -half, 0.03, label=f"{x} m"))
    for k in range(rules.HURDLES):
        x = rules.FIRST_X + rules.GAP * k
        marks += [across(x, -half - 0.5, -half - 0.25, 0.05, "#3f6fa5")]
    return marks


def javelin(scene: Scene) -> list[Mark]:
    """Runway, foul line, the sector's sides, and a line every ten metres from the foul line."""

    def half_width(x: float) -> float:
        return half_sector(x - LINE_X)

    end = LINE_X + SECTOR_LENGTH
    first, last = half_width(LINE_X), half_width(end)
    field = ((LINE_X, -first), (end, -last), (end, last), (LINE_X, first))
    marks = [
        Mark(field, TURF),
        rectangle(-8.0, LINE_X, -HALF_FIELD, HALF_FIELD, TRACK),
        along(-HALF_FIELD - LINE / 2, -8.0, LINE_X, LINE),
        along(HALF_FIELD + LINE / 2, -8.0, LINE_X, LINE),
    ]
    for side in (-1.0, 1.0):
        start, stop = (LINE_X, side * first), (end, side * last)
        marks.append(slanted(start, stop, LINE))
    for metre in range(10, int(SECTOR_LENGTH), 10):
        x = LINE_X + metre
        marks.append(across(x, -half_width(x), half_width(x), 0.05, label=f"{metre} m"))
    reach = max(HALF_FIELD, first) + 0.75
    # The rule book's line is 0.07 m wide, and its edge nearer to the sector counts.
    marks.append(across(LINE_X - 0.035, -reach, reach, 0.07))
    return marks
