"""Keeps an athlete's limbs out of each other: rows for the optimisation problems.

Engines push overlapping limbs apart, so a motion with crossed thighs cannot be replayed. Pairwise
distances of all limbs would be hundreds of rows a knot; two facts make it few. Left and right are
apart if each leg and each hand stays on its own side of the pelvis's middle plane. A hand meets, of
the links on its side, only the leg while it is lifted, so it keeps its distance from balls there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sports.humanoid.body import Body, Shape
from warmstart.contact import Ball

if TYPE_CHECKING:
    from warmstart.transcription import Transcription

ALLOWED = 0.002
"""How far (m) a limb may reach over its border. The certificate allows two limbs 0.02 m, but a
foot is longer than the ball that stands for it."""
CORNERS = 0.02
"""How much further (m) a hand keeps from a leg, and twice that from a foot: the corners of a box
stick out of its ball."""
LEG = ("Hip", "Knee", "Ankle", "Toe")
HAND = ("Wrist", "Hand")


def axis_balls(body: Body, link: str, count: int = 2) -> list[Ball]:
    """Balls along a link's first shape: ``count`` on a capsule's axis, one or two in a box.

    A box's balls have its middle half-extent as radius (half the width of a foot) and reach both
    ends of its longest side; one does where that is hardly longer.
    """
    shape: Shape = body.links[body.link_index(link)].shapes[0]
    center = np.array(shape.center)
    if shape.end is None:
        points, radius = [center], float(shape.size[0])
        if shape.kind == "box":
            size = np.array(shape.size)
            radius = float(np.sort(size)[1])
            reach = np.where(size == size.max(), size - radius, 0.0)
            if reach.max() > 0.02:
                points = [center - reach, center + reach]
    else:
        share = np.linspace(0.0, 1.0, count)
        points = [center + s * (np.array(shape.end) - center) for s in share]
        radius = float(shape.size[0])
    return [Ball(link, (float(p[0]), float(p[1]), float(p[2])), radius) for p in points]


def keep_apart(
    program: Transcription,
    body: Body,
    knots: Sequence[int] | np.ndarray,
    straight: bool = False,
) -> None:
    """Adds the rows at knots: legs and hands on their sides, hands off the legs (50 a knot).

    ``straight``: hands may pass knees that are hardly bent, so they keep off the upper ends of the
    shins as well, which the thighs cover otherwise (4 rows more a knot).
    """
    import casadi as ca

    model = program.model
    hands = {s: [axis_balls(body, f"{s}_{n}")[-1] for n in HAND] for s in "LR"}
    own = {s: [b for n in LEG for b in axis_balls(body, f"{s}_{n}")] + hands[s] for s in "LR"}
    shin = slice(0 if straight else 1, None)
    lifted = {
        s: axis_balls(body, f"{s}_Hip", 3)
        + axis_balls(body, f"{s}_Knee", 3)[shin]
        + [b for n in ("Ankle", "Toe") for b in axis_balls(body, f"{s}_{n}")]
        for s in "LR"
    }

    def at(motion, ball: Ball):
        return motion.point(model.tree.link(ball.link), ball.center)

    def sides(q, p):
        motion = model.motion(q)
        pelvis = model.tree.link(body.links[0].name)
        across, origin = motion.R_WL[pelvis][:, 1], motion.point(pelvis, (0.0, 0.0, 0.0))
        gaps = [
            sign * ca.dot(at(motion, b) - origin, across) - b.radius + ALLOWED
            for sign, side in ((1.0, "L"), (-1.0, "R"))
            for b in own[side]
        ]
        return [("left and right apart", ca.vertcat(*gaps) / 0.1, 0.0, np.inf)]

    def off(q, p):
        motion = model.motion(q)
        gaps = []
        for side in "LR":
            for a in hands[side]:
                for b in lifted[side]:
                    corners = CORNERS * (2 if b.link.endswith(("Ankle", "Toe")) else 1)
                    reach = a.radius + b.radius + corners - ALLOWED
                    gaps.append(ca.sumsqr(at(motion, a) - at(motion, b)) - reach**2)
        return [("hands off the legs", ca.vertcat(*gaps) / 0.05, 0.0, np.inf)]

    program.rows("left and right apart", knots, sides)
    program.rows("hands off the legs", knots, off)
