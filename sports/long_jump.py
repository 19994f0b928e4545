"""Long jump: a 20 m run-up, one flight from behind the line, measured to the nearest mark.

A jump is one flight: RUN until no link touches the ground with the root beyond the line, FLIGHT
until the first ground contact of any link, LANDED for 9 more steps; the length is the smallest x
of any ground contact point in those steps, minus 20. A link on the ground on or beyond the line
before the flight is a foul. Source: SMPLOlympics section 4 for goal and reward; World Athletics
technical rules for the foul and for measuring to the nearest mark left by any part of the body.
Those rules also forbid somersaults; the paper's task does not, so that is an option, and
``rotation`` tells them apart: the angle that the pelvis turns about the lateral axis in flight
(2 pi for a front somersault).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sports.humanoid.body import Body
from sports.physics.base import GRAVITY, Marks
from sports.scene import Scene
from sports.task import (
    Advance,
    Memory,
    Task,
    View,
    clamp01,
    constant,
    nan_where,
    nothing_to_draw,
    progress,
)
from sports.task import length as magnitude

LINE_X = 20.0
START, LINE, GOAL = (0.0, 0.0, 0.0), (LINE_X, 0.0, 0.0), (30.0, 0.0, 1.0)
RUNWAY_HALF_WIDTH, PIT_HALF_WIDTH = 0.5, 1.5
RUN, FLIGHT, LANDED = 0, 1, 2
MARK_STEPS = 9
"""Steps after the landing step in which marks count."""
TOUCH = 1e-3
"""A support point this close to the ground (m) leaves a mark."""


@dataclass(frozen=True)
class LongJump:
    """Options of the long jump."""

    somersaults: bool = True
    """Allow them, as the paper does. False: who turns over in flight, so that the pelvis is more
    upside down than upright, has failed, by rule 30 of World Athletics' technical rules."""


def scene(config: LongJump, body: Body) -> Scene:
    """Runway and pit on one plane."""
    return Scene(
        name="long_jump",
        body=body,
        sites={"start": START, "line": LINE, "goal": GOAL},
    )


def begin(view: View, context: Memory) -> Memory:
    """Memory after a reset: running, no mark yet."""
    root = view.root_pos[:, 0]
    zero = torch.zeros_like(root[:, 0])
    return {
        "root": root.clone(),
        "rear": _marks(view).rear,
        "mode": zero.long(),
        "since_landing": zero.clone(),
        "mark": torch.full_like(zero, torch.inf),
        "flight_steps": zero.clone(),
        "rotation": zero.clone(),
        "takeoff_speed": torch.full_like(zero, torch.nan),
        "takeoff_com_z": torch.full_like(zero, torch.nan),
        "landing_com_z": torch.full_like(zero, torch.nan),
    }


def features(view: View, memory: Memory) -> dict[str, Tensor]:
    """Start, line and goal as seen from the athlete (9)."""
    root = view.root_pos
    marks = constant((*START, *LINE, *GOAL), root.device).view(3, 3)
    start, line, goal = view.heading.local(marks - root[:, :, None]).unbind(2)
    return {"start": start, "line": line, "goal": goal}


def advance(view: View, memory: Memory) -> Advance:
    """One control step by the rules of the sport."""
    root = view.root_pos[:, 0]
    x, y, z = root.unbind(-1)
    goal = constant(GOAL, root.device)
    touched = view.touching()[:, 0]  # (N, B) in any substep
    marks = _marks(view)  # now
    # A link that touched within the step and is off again: all of it was at or beyond this x.
    never = ~touched | marks.standing
    brief_x = torch.minimum(marks.rear, memory["rear"])
    nearest = torch.minimum(marks.nearest, brief_x.masked_fill(never, torch.inf).amin(1))
    front = torch.maximum(marks.furthest, brief_x.masked_fill(never, -torch.inf).amax(1))
    touches = nearest < torch.inf

    mode = memory["mode"]
    running, over_line = mode == RUN, x > LINE_X
    fell = running & view.fallen()[:, 0]
    half_width = RUNWAY_HALF_WIDTH + (PIT_HALF_WIDTH - RUNWAY_HALF_WIDTH) * over_line
    off_track = y.abs() > half_width

    takes_off = running & ~touches & over_line
    lands = (mode == FLIGHT) & touches
    mode = mode + takes_off + lands  # from RUN to FLIGHT to LANDED
    flying, landed = mode == FLIGHT, mode == LANDED
    foul = running & (front >= LINE_X)
    if not view.config.somersaults:
        foul = foul | (flying & (view.rotation[:, 0, 0, 2, 2] < 0.0))
    mark = torch.minimum(memory["mark"], nearest.masked_fill(~landed, torch.inf))
    since_landing = memory["since_landing"] + (landed & ~lands)
    measured = landed & (since_landing >= MARK_STEPS)
    failed = foul | fell | off_track
    success = measured & ~failed
    length = mark - LINE_X

    terms = {
        "progress": clamp01(progress(memory["root"], root, goal)),
        "speed": 0.01 * view.root_linvel[:, 0, 0],
        "flight": 0.1 * z * flying,
        "length": (30.0 * length).masked_fill(~success, 0.0),
    }

    com, com_velocity = view.geometry.center_of_mass(view.physics, 0)
    takeoff_speed = torch.where(takes_off, magnitude(com_velocity), memory["takeoff_speed"])
    takeoff_com_z = torch.where(takes_off, com[:, 2], memory["takeoff_com_z"])
    landing_com_z = torch.where(lands, com[:, 2], memory["landing_com_z"])
    flight_steps = memory["flight_steps"] + flying
    turn = view.physics.body_angvel[:, 0, 0, 1] * view.control_timestep
    rotation_angle = memory["rotation"] + turn * flying
    measures = {
        "length": length,
        "flight_time": flight_steps * view.control_timestep,
        "rotation": rotation_angle,
        "takeoff_speed": takeoff_speed,
        "length_bound": length_bound(takeoff_speed, takeoff_com_z, landing_com_z),
    }
    metrics = dict(zip(measures, nan_where(~success, torch.stack(tuple(measures.values())))))
    metrics |= {"success": success.float(), "foul": foul.float()}
    memory = {
        "root": root.clone(),
        "rear": marks.rear,
        "mode": mode,
        "since_landing": since_landing,
        "mark": mark,
        "flight_steps": flight_steps,
        "rotation": rotation_angle,
        "takeoff_speed": takeoff_speed,
        "takeoff_com_z": takeoff_com_z,
        "landing_com_z": landing_com_z,
    }
    return Advance(
        memory=memory,
        terms={name: term[:, None] for name, term in terms.items()},
        terminated=(failed | success)[:, None],
        metrics=metrics,
        success=success,
    )


def length_bound(speed: Tensor, takeoff_z: Tensor, landing_z: Tensor) -> Tensor:
    """(N,) length (m) that no jump from this take-off can pass: the best ballistic range of the
    centre of mass, (v / g) sqrt(v^2 + 2 g dz), plus 1.2 m of body."""
    drop = (speed.square() + 2 * GRAVITY * (takeoff_z - landing_z)).clamp(min=0.0)
    return speed / GRAVITY * drop.sqrt() + 1.2


def _marks(view: View) -> Marks:
    return view.geometry.marks(view.physics.body_pos[:, 0], view.rotation[:, 0], TOUCH)


TASK = Task(
    name="long_jump",
    config=LongJump,
    scene=scene,
    start=nothing_to_draw,
    begin=begin,
    features=features,
    advance=advance,
    metrics={
        "success": "fraction",
        "length": "m",
        "flight_time": "s",
        "rotation": "rad",
        "takeoff_speed": "m/s",
        "length_bound": "m",
        "foul": "fraction",
    },
    main_metric="length",
    max_steps=600,
    reward_scale=10.0,
    summary="Run up 20 m and jump from behind the line.",
)
