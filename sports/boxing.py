"""Boxing: land a glove on the opponent's trunk or head, in a ring whose ropes hold one in.

Both athletes stand on guard 3 m apart, both hands gloves of 0.08 m radius. Blows with anything else
score nothing. A bout ends when somebody falls (who does so has lost it), else after 300 steps. The
ropes are solid, so that the rules need no bounds. Source: SMPLOlympics, section 4, for the ring of
5 x 5 m; AIBA technical rules for its ropes; rules in ``combat.py``.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from sports import combat
from sports.humanoid.body import Body, Shape
from sports.scene import Scene, SceneObject
from sports.task import Advance, Memory, Task, View, nothing_to_draw

HALF_RING = 2.5
ROPE_HEIGHTS, ROPE_RADIUS = (0.4, 0.8, 1.3), 0.02
"""Of a ring with three ropes (m)."""
GLOVES = (combat.Weapon("L_Hand", "L_Hand", 0.0), combat.Weapon("R_Hand", "R_Hand", 0.0))
GUARD = {
    "L_Shoulder_x": -1.1,
    "L_Shoulder_z": -0.45,
    "L_Elbow_x": 0.25,
    "L_Elbow_z": -1.9,
    "R_Shoulder_x": 1.1,
    "R_Shoulder_z": 0.35,
    "R_Elbow_x": -0.25,
    "R_Elbow_z": 2.1,
    "L_Hip_x": 0.04,
    "L_Hip_y": -0.48,
    "L_Knee_y": 0.43,
    "L_Ankle_x": -0.04,
    "L_Ankle_y": 0.05,
    "R_Hip_x": -0.04,
    "R_Hip_y": 0.02,
    "R_Knee_y": 0.34,
    "R_Ankle_x": 0.04,
    "R_Ankle_y": -0.36,
    "R_Ankle_z": -0.28,
}
"""On guard (rad): left foot 0.34 m before the right, gloves before the shoulders. The feet are
placed so that the pose stands by itself for 10 s (tests)."""
GUARD_Z = 0.9
"""Height of the root on guard (m)."""


@dataclass(frozen=True)
class Boxing(combat.Options):
    """Options of boxing."""


def _ropes() -> tuple[SceneObject, ...]:
    """Three ropes on each side of the ring. A side is an object: as one the ring would surround
    the athletes, and every step would look for contacts with every rope (10 % of a step)."""
    h = HALF_RING
    corners = ((h, -h), (h, h), (-h, h), (-h, -h))
    return tuple(
        SceneObject(
            name=f"ropes_{side}",
            shapes=tuple(
                Shape("capsule", (*corners[i - 1], z), (ROPE_RADIUS,), 1.0, end=(*corners[i], z))
                for z in ROPE_HEIGHTS
            ),
            motion="fixed",
            pos=(0.0, 0.0, 0.0),
            rgba=(0.91, 0.89, 0.84, 1.0),
            meets_ground=False,
        )
        for i, side in enumerate(("right", "front", "left", "back"))
    )


def scene(config: Boxing, body: Body) -> Scene:
    """Two athletes on guard in a ring."""
    return Scene(
        name="boxing",
        body=body,
        agents=combat.on_guard(GUARD, GUARD_Z),
        offset=GUARD,
        objects=_ropes(),
        contact_pairs=combat.contact_pairs(GLOVES),
        link_contacts=True,
        rows_per_world=combat.ROWS,
        contacts_per_world=combat.CONTACTS,
    )


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset."""
    return combat.begin(view, GLOVES)


def features(view: View, memory: Memory) -> dict[str, Tensor]:
    """The opponent as seen from the athlete (234)."""
    return combat.features(view, GLOVES)


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    return combat.advance(view, memory, GLOVES, {"fell": view.fallen()})


TASK = Task(
    name="boxing",
    config=Boxing,
    scene=scene,
    start=nothing_to_draw,
    begin=begin,
    features=features,
    advance=advance,
    metrics={
        "success": "fraction",
        "draw": "fraction",
        "touches_for": "touches",
        "touches_against": "touches",
        "knock_down": "fraction",
        "fell": "fraction",
        "opponent_fell": "fraction",
    },
    main_metric="success",
    max_steps=300,
    equipment=("gloves",),
    summary="Land gloves on the opponent's trunk and head and stay on your feet.",
)
