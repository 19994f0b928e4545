"""What a stroke keeps apart: arms, trunk, head, knees, and what the right hand holds.

Engines push overlapping limbs apart, so a motion that lets them touch is not replayed, however
little the touch is. Limbs are balls here (:func:`warmstart.separation.axis_balls`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from sports.humanoid.body import Body
from warmstart.contact import Ball
from warmstart.rigid_body import Motion, ReducedModel
from warmstart.separation import axis_balls
from warmstart.transcription import Transcription

if TYPE_CHECKING:
    from warmstart.problems.striker import Event

TRUNK = ("Pelvis", "Torso", "Chest", "Head")
TOOL_ROOM = 0.04
"""What is held keeps this far (m) off the body at knots: it moves 0.4 m between two of them."""
CORNERS = 0.03
"""How far (m) the corners of head and pelvis stick out of their balls."""


def _end(body: Body, link: str) -> Ball:
    return axis_balls(body, link)[-1]


def _forearm(body: Body, side: str) -> list[Ball]:
    hand = f"{side}_Hand" if f"{side}_Hand" in body.link_names else f"{side}_Wrist"
    return [*axis_balls(body, f"{side}_Elbow", 3), _end(body, hand)]


def obstacles(body: Body) -> list[Ball]:
    """What a thing in the right hand can meet: trunk, head, upper arms, left arm, thighs."""
    return [
        *(_end(body, link) for link in TRUNK),
        *(replace(b, radius=b.radius + CORNERS) for b in axis_balls(body, "Head")),
        *_forearm(body, "L")[1:],
        *(b for s in "LR" for b in axis_balls(body, f"{s}_Hip", 3)),
        *(b for s in "LR" for b in axis_balls(body, f"{s}_Shoulder", 3)[1:]),
    ]


def tool_off(program: Transcription, body: Body, tool: Sequence[Ball], knots) -> None:
    """What is held, as balls, stays off the body."""
    keep_off(program, [(a, b) for a in tool for b in obstacles(body)], knots, TOOL_ROOM)


def shaft_off(
    program: Transcription, body: Body, event: Event, radius: float, knots, room: float = TOOL_ROOM
) -> None:
    """A long shaft of a ``radius`` (m), along the event's axis through its point, stays off the
    body: the distance of balls from a line."""
    model = program.model

    def off(q, p):
        motion = model.motion(q)
        along, through = _shaft(model, motion, event)
        gaps = []
        for b in obstacles(body):
            to = motion.point(model.tree.link(b.link), b.center) - through
            gaps.append(ca.sumsqr(to) - ca.dot(to, along) ** 2 - (b.radius + radius + room) ** 2)
        return [("shaft apart", ca.vertcat(*gaps) / 0.05, 0.0, np.inf)]

    program.rows("shaft off", knots, off)


def beside_shaft(
    program: Transcription, event: Event, balls: Sequence[Ball], radius: float, knots
) -> None:
    """Balls stay to the left of that shaft or below it, on one side of the plane through it that
    rises to the left: a distance has no sign, and a limb might pass through between two knots."""
    model = program.model

    def beside(q, p):
        motion = model.motion(q)
        along, through = _shaft(model, motion, event)
        up = ca.DM([0.0, 0.0, 1.0]) - along[2] * along
        left = ca.cross(up, along)  # as long as ``up``
        side = (left - up) / ca.sqrt(ca.sumsqr(left) + ca.sumsqr(up) + 1e-9)
        gaps = [
            ca.dot(motion.point(model.tree.link(b.link), b.center) - through, side)
            - (b.radius + radius + TOOL_ROOM)
            for b in balls
        ]
        return [("beside the shaft", ca.vertcat(*gaps) / 0.1, 0.0, np.inf)]

    program.rows("beside the shaft", knots, beside)


def _shaft(model: ReducedModel, motion: Motion, event: Event):
    """Direction (3,) of the shaft of an event and a point (3,) on it (m), world; symbolic."""
    link = model.tree.link(event.link)
    return motion.R_WL[link] @ ca.DM(list(event.axis)), motion.point(link, event.point)


def arms_off(program: Transcription, body: Body, knots) -> None:
    """Arms stay off trunk, head and each other; knees off each other."""
    arms = {s: _forearm(body, s) for s in "LR"}
    trunk = [_end(body, link) for link in TRUNK]
    pairs = [(a, b) for s in "LR" for a in arms[s][1:] for b in trunk]
    pairs += [(a, b) for a in arms["L"] for b in arms["R"]]
    for side, other in ("LR", "RL"):  # an arm across the chest
        beyond = [_end(body, f"{other}_Thorax"), *axis_balls(body, f"{other}_Shoulder")]
        pairs += [(a, b) for a in arms[side] for b in beyond]
    head = [replace(b, radius=b.radius + CORNERS / 2) for b in axis_balls(body, "Head")]
    pairs += [(a, b) for s in "LR" for a in axis_balls(body, f"{s}_Shoulder", 3)[1:] for b in head]
    hips = [replace(b, radius=b.radius + CORNERS) for b in axis_balls(body, "Pelvis")]
    pairs += [(_end(body, f"{s}_Wrist"), b) for s in "LR" for b in hips]
    waist = [_end(body, link) for link in ("Torso", "Spine")]
    pairs += [(a, b) for s in "LR" for a in axis_balls(body, f"{s}_Shoulder", 3)[1:] for b in waist]
    pairs += [(axis_balls(body, "L_Knee")[0], axis_balls(body, "R_Knee")[0])]
    keep_off(program, pairs, knots)


def keep_off(
    program: Transcription, pairs: Sequence[tuple[Ball, Ball]], knots, margin: float = 0.0
) -> None:
    """The two balls of every pair stay ``margin`` (m) apart."""
    model = program.model

    def off(q, p):
        motion = model.motion(q)

        def at(ball: Ball):
            return motion.point(model.tree.link(ball.link), ball.center)

        gaps = [ca.sumsqr(at(a) - at(b)) - (a.radius + b.radius + margin) ** 2 for a, b in pairs]
        return [("apart", ca.vertcat(*gaps) / 0.05, 0.0, np.inf)]

    program.rows("keep off", knots, off)
