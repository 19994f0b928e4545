"""The step after a hurdle, which makes a stride cycle of the stride over it.

The lead leg lands on the ball of its foot (``land``), softly: the toes are at rest as they touch,
as every contact of :mod:`warmstart.transcription` begins. The heel stays up. Then the athlete
leaves the ground again (``step``) and the trail leg comes down in front of it, which ends the
cycle: from one touch-down of the take-off foot to its next one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import PchipInterpolator

from warmstart.phases import Phase
from warmstart.problems import jumper
from warmstart.transcription import Transcription

LAND, STEP = (0.09, 0.20), (0.10, 0.30)
"""Durations (s): the stance of the lead leg, the flight of the next step. The optimiser would have
both shorter: forces on stiff legs cost it little."""
DURATIONS = (0.13, 0.12)
"""The same of a first guess."""
SOFT = 0.12
"""Share of the flight, at its end, in which the lead foot may be as low as it likes: it comes down
without speed, so it is low for a while."""
POSES = (
    ((-0.9, 1.5, 0.0, 0.0), (0.45, 0.1, 0.2, -0.7), {"pitch": 0.2}),
    ((-0.5, 0.35, 0.2, 0.0), (0.2, 1.4, 0.0, 0.0), {}),
)
"""Key poses at the end of both phases (rad): hip, knee, ankle, toe y of the trail and of the lead
leg; trunk."""
ARMS = (-0.6, -0.3)
"""Swing of the arms in them (rad)."""


def phases(knots: Callable[[int], int], lead: str) -> list[Phase]:
    """What comes after the flight over the hurdle; ``lead`` is the side of the leg that lands."""
    return [
        Phase("land", knots(24), LAND, {lead: "toe"}, grading=2.0),
        Phase("step", knots(18), STEP, grading=2.0),
    ]


def rows(program: Transcription, push: str, lead: str) -> None:
    """Feet off the ground where they do not stand, the heel of the lead foot at all times.

    ``push``: the side of the trail leg, which is the one that took off.
    """
    first, trail = (jumper.foot(program.body, side) for side in (lead, push))
    flight, step = program.knots("flight"), program.knots("step")
    soft = round(SOFT * (len(flight) - 1))
    program.ground(first, np.arange(flight[-1 - soft]))
    program.ground(first, flight[-1 - soft : -1], margin=0.0)
    program.ground(first, step[1:4], margin=0.0)
    program.ground(first, step[4:])
    program.ground(trail, np.arange(flight[-1] + 1, step[-1]))
    toe = program.model.index(f"{lead}_Toe_y")
    program.bound(program.q[program.knots("land"), toe], None, 0.0)


def go_on(
    program: Transcription,
    q: np.ndarray,
    t: np.ndarray,
    knot: int,
    speed: float,
    legs: tuple[str, str],
) -> None:
    """Fills in a guess (K, n) after a knot: key poses, a dip in stance, a flight, at a speed (m/s).

    ``t`` (K,) are its times (s), ``legs`` the sides of the leg that took off and of the lead leg.
    """
    model, push, lead = program.model, *legs
    down, off = t[knot], t[knot] + DURATIONS[0]
    poses = [q[knot]]
    for (trail, first, trunk), s in zip(POSES, ARMS, strict=True):
        left, right = (trail, first) if push == "L" else (first, trail)
        frame = jumper.legs(left, right, **trunk, L_Shoulder_z=-s, R_Shoulder_z=s)
        poses.append(np.array([frame.get(name, 0.0) for name in model.names]))
    ends, after = down + np.cumsum([0.0, *DURATIONS]), np.arange(len(t)) > knot
    q[after] = PchipInterpolator(ends, poses, axis=0)(t[after])
    share = np.clip((t - down) / DURATIONS[0], 0.0, 1.0)[after]
    fly = np.clip(t - off, 0.0, None)[after]
    q[after, 0] = q[knot, 0] + speed * (t - down)[after]
    q[after, 1] = q[knot, 1]
    q[after, 2] = q[knot, 2] - 0.2 * share * (1 - share) + 4.905 * fly * (DURATIONS[1] - fly)
    stance = program.knots("land")
    half = len(stance) // 2
    jumper.plant_foot(model, q, stance[:half], stance[half:], lead)
