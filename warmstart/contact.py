"""Where the athlete can touch the world: sole points and the body's outline.

Sole points are box corners of ankle and toe, the points at which MuJoCo and Drake make contact.
The outline is a set of small balls that cover every shape, for clearances against the ground,
a bar or a hurdle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sports.humanoid.body import Body, Shape, support_points


@dataclass(frozen=True)
class Ball:
    """A ball fixed to a link: centre in the link frame (m) and radius (m)."""

    link: str
    center: tuple[float, float, float]
    radius: float


def _corners(shape: Shape) -> np.ndarray:
    return np.array([point for point, _ in support_points(shape)])


def sole_points(body: Body, side: str) -> tuple[tuple[str, tuple[float, float, float]], ...]:
    """Six points of a foot: two heel corners (ankle box), then four toe-box corners.

    The front corners of the ankle box are left out: they lie between heel and toe joint and
    would make the forces of a flat foot ambiguous. ``side`` is ``L`` or ``R``.
    """
    ankle = _corners(body.links[body.link_index(f"{side}_Ankle")].shapes[0])
    toe = _corners(body.links[body.link_index(f"{side}_Toe")].shapes[0])
    bottom = ankle[ankle[:, 2] < ankle[:, 2].mean()]
    heel = bottom[bottom[:, 0] < bottom[:, 0].mean()]
    ball = toe[toe[:, 2] < toe[:, 2].mean()]
    points = [(f"{side}_Ankle", p) for p in heel] + [(f"{side}_Toe", p) for p in ball]
    return tuple((link, (float(p[0]), float(p[1]), float(p[2]))) for link, p in points)


def outline(body: Body, sagittal: bool = False) -> tuple[Ball, ...]:
    """Balls on every shape: capsule ends, box corners and cylinder rims (radius 0), spheres.

    With ``sagittal`` the two sides of a box are merged into its middle plane: enough for a bar
    along y when the athlete hardly rolls, at a third of the rows. Long capsules also get their
    middle.
    """
    balls = []
    for link in body.links:
        for shape in link.shapes:
            points = support_points(shape)
            if shape.kind == "capsule":
                (a, r), (b, _) = points
                if np.linalg.norm(b - a) > 1.5 * r:
                    points = [(a, r), ((a + b) / 2, r), (b, r)]
                elif sagittal:
                    points = [((a + b) / 2, r)]
            if shape.kind == "box" and sagittal:
                flat = {(round(float(p[0]), 9), round(float(p[2]), 9)) for p, _ in points}
                points = [(np.array([x, shape.center[1], z]), 0.0) for x, z in sorted(flat)]
            balls += [
                Ball(link.name, (float(p[0]), float(p[1]), float(p[2])), float(r))
                for p, r in points
            ]
    return tuple(balls)
