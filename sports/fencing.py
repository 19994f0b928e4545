"""Fencing: touch the opponent with the sword's point, on a piste that one must not leave.

Both athletes stand on guard 3 m apart, a sword in place of the right hand. The last 0.05 m of the
blade score, on trunk and head; the blade's side, the feet and the own body score nothing. A bout
ends when somebody falls or leaves the piste with the root (who does so has lost it), else after
300 steps. Source: SMPLOlympics, section 4; FIE technical rules for the piste (14 x 2 m); rules in
``combat.py``.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from sports import combat
from sports.humanoid.body import Body
from sports.scene import Scene
from sports.task import Advance, Memory, Task, View, constant, nothing_to_draw

HALF_LENGTH, HALF_WIDTH = 7.0, 1.0
SWORD = (combat.Weapon("R_Hand", "R_Hand:1", 0.98),)
"""Shape 1 of the hand is the blade's last 0.05 m (equipment.csv)."""
GUARD = {
    "R_Shoulder_x": 0.9,
    "R_Shoulder_z": 0.73,
    "R_Elbow_x": 0.12,
    "R_Elbow_z": 0.91,
    "L_Shoulder_x": -0.8,
    "L_Shoulder_z": 0.4,
    "L_Elbow_z": -0.6,
    "R_Hip_x": -0.05,
    "R_Hip_y": -0.5,
    "R_Knee_y": 0.42,
    "R_Ankle_x": 0.05,
    "R_Ankle_y": 0.08,
    "L_Hip_x": 0.04,
    "L_Hip_y": -0.02,
    "L_Knee_y": 0.37,
    "L_Ankle_x": -0.04,
    "L_Ankle_y": -0.35,
    "L_Ankle_z": 0.59,
}
"""On guard (rad): right foot 0.34 m before the left, which is turned out; the blade points at the
opponent's chest. The feet are placed so that the pose stands by itself for 10 s (tests)."""
GUARD_Z = 0.9
"""Height of the root on guard (m)."""


@dataclass(frozen=True)
class Fencing(combat.Options):
    """Options of fencing."""


def scene(config: Fencing, body: Body) -> Scene:
    """Two athletes on guard on a plane."""
    return Scene(
        name="fencing",
        body=body,
        agents=combat.on_guard(GUARD, GUARD_Z),
        offset=GUARD,
        contact_pairs=combat.contact_pairs(SWORD),
        link_contacts=True,
        rows_per_world=combat.ROWS,
        contacts_per_world=combat.CONTACTS,
    )


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset."""
    return combat.begin(view, SWORD)


def features(view: View, memory: Memory) -> dict[str, Tensor]:
    """The opponent, then the piste: its corners ahead on the left and behind on the right, as the
    athlete stands at the start, seen from it on the ground plane (223)."""
    corner = (HALF_LENGTH, HALF_WIDTH, 0.0)
    ends = (*corner, *(-c for c in corner))
    corners = constant((*ends, *(-c for c in ends)), view.root_pos.device).view(2, 2, 3)
    bounds = view.heading.local(corners - view.root_pos[:, :, None])[..., :2]
    return combat.features(view, SWORD) | {"bounds": bounds.flatten(2)}


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    x, y, _ = view.root_pos.unbind(-1)
    out = (x.abs() > HALF_LENGTH) | (y.abs() > HALF_WIDTH)
    return combat.advance(view, memory, SWORD, {"fell": view.fallen(), "out": out})


TASK = Task(
    name="fencing",
    config=Fencing,
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
        "out": "fraction",
        "opponent_out": "fraction",
    },
    main_metric="success",
    max_steps=300,
    equipment=("sword",),
    tools=("R_Hand",),
    summary="Touch the opponent with the sword's point and stay on the piste.",
)
