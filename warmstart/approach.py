"""The way to the ball: two steps from where the task starts to where a certified kick begins.

The certified kicks (:mod:`warmstart.problems.penalty_kick`) begin beside the ball, 0.48 m ahead of
the task's start. The steps are planned by themselves: at rest as the task begins, the right foot
steps, then the left one, at rest in the kick's first pose; feet land and leave with no velocity.
Played open loop they drift by 8 cm in 1.8 s, and from the task's start, on stiff legs, they fall.
So steps and kick are followed together in closed loop (:mod:`warmstart.tracking`), from the task's
own start, and the task's rules say what came of it. There is no certificate of the steps: what
counts is the episode that MuJoCo played. A kick after one step that both engines certify is an
option of the problem itself (``approach``).

``python -m warmstart.approach KICK.npz --out CLIP.npz``
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sports.env import make_scene
from sports.humanoid.body import Body
from sports.penalty_kick import SPOT, START, PenaltyKick, scene
from sports.soccer import BALL_RADIUS, HALF_LENGTH
from warmstart import bank
from warmstart.aim import Search, aim
from warmstart.clip import Clip, clip_from_solution
from warmstart.outcome import link_poses
from warmstart.performance import perform
from warmstart.phases import Bounds, Phase, Weights
from warmstart.problems import Infeasible, clearance, guard, jumper, penalty_kick, striker
from warmstart.replay import body_of
from warmstart.rigid_body import from_full_state, load_tree, reduce_tree
from warmstart.solution import Solution
from warmstart.tracking import Tracking, track
from warmstart.transcription import Transcription

TASK = "penalty_kick"
FREE = (*penalty_kick.FREE, "L_Elbow_z", "R_Elbow_z")
"""The arms go from the task's pose to the kick's."""
BOTH, LEFT, RIGHT = {"L": "flat", "R": "flat"}, {"L": "flat"}, {"R": "flat"}
DURATIONS = {
    "lean": (0.20, 0.50),
    "right": (0.25, 0.45),
    "shift": (0.15, 0.45),
    "left": (0.25, 0.45),
    "settle": (0.20, 0.60),
}
"""Shortest and longest phases (s): named after the foot in the air, and between them."""
POSITION = {
    "x": (-0.2, 0.8),
    "y": (-0.4, 0.4),
    "z": (0.80, 1.0),
    "pitch": (-0.5, 0.6),
    "Hip_y": (-1.6, 0.8),
    "Knee_y": (0.0, 2.0),
    "Ankle_y": (-0.8, 0.8),
    "L_Shoulder_x": (-1.45, 0.2),
    "R_Shoulder_x": (-0.2, 1.45),
    "L_Shoulder_z": (-1.5, 1.2),
    "R_Shoulder_z": (-1.2, 1.5),
    "L_Elbow_z": (-2.4, 0.1),
    "R_Elbow_z": (-0.1, 2.4),
}
"""Pose boxes (rad, m) that differ from those of a stroke."""
RATE = {"x": (-1.0, 2.0), "yaw": (-3.0, 3.0)}
START_SLACK, END_SLACK = 0.12, 0.02
"""How far (rad, m) the first knot may be from the task's start, which stands on stiff legs with its
arms out, and the last one from the kick's first pose."""
LIFT = 0.02
"""How high a stepping foot passes over the ground in the middle of its step (m)."""
SHEAR, EVEN = 100.0, 0.2
"""Price of horizontal force on the feet, and of load that is not spread over them."""
AT = 0.02
"""How far an ankle may be from where the task puts it (m, each way)."""
FOLLOWING = Tracking(worlds=48, iterations=2)
"""Half of what a jump needs: there is no flight in which a mistake grows."""
MOVED = 0.005
"""A ball that is so far from its spot (m) was kicked."""


def plan(
    kick: Clip, detail: float = 1.0, progress: Callable[[int, float], None] | None = None
) -> Solution:
    """The least-effort steps from the task's start to the first pose of a kick.

    ``detail``: knots relative to the standard grid. Raises ValueError for a clip that is no kick,
    Infeasible where no steps are found.
    """
    if kick.meta.get("problem") != TASK:
        raise ValueError(f"the clip is of '{kick.meta.get('problem')}', not of a penalty kick")
    body = body_of(kick)
    goal = kick.qpos[:1].copy()
    goal[0, :2] -= START
    program = transcribe(body, goal, detail)
    result = jumper.run(program, _guess(program, goal), [], False, progress)
    if not jumper.solved(result):
        raise Infeasible(f"no steps to the kick were found (solver: {result.status})")
    asked = {"to_ball": float(np.linalg.norm(np.array(SPOT) - START))}
    return striker.placed(program.solution(TASK, asked, result, placed=[*START, 0.0]), *START)


def transcribe(body: Body, goal: np.ndarray, detail: float = 1.0) -> Transcription:
    """The nonlinear program of the steps to ``goal`` (1, 7 + n), in the task's start frame."""
    pose = {n: float(goal[0, 7 + body.dof_index(n)]) for n in penalty_kick.POSE if n not in FREE}
    model = reduce_tree(load_tree(body), FREE, pose)
    knots = jumper.scaled(detail)
    steps = (("lean", 8, BOTH), ("right", 12, LEFT), ("shift", 8, BOTH))
    steps += (("left", 12, RIGHT), ("settle", 8, BOTH))
    program = Transcription(
        body,
        model,
        [Phase(name, knots(k), DURATIONS[name], feet) for name, k, feet in steps],
        Bounds(
            striker.boxes({**striker.POSITION, **POSITION}, FREE)
            | {k: v for k, v in POSITION.items() if k in "xyz"},
            striker.boxes({**striker.RATE, **RATE}, FREE),
            hinge_rate=12.0,
            acceleration=300.0,
            torque_share=striker.SHARE,
        ),
        Weights(shear=SHEAR),
        held_limits=jumper.HELD_LIMITS,
        standing=True,
    )
    for name in (*guard.ROOT, *FREE):
        slack = 0.0 if "Toe" in name else START_SLACK
        program.bound(program.q[0, model.index(name)], -slack, slack)
    for name in "xy":
        program.bound(program.q[0, model.index(name)], -0.03, 0.03)
    for index, value in zip(program.q[-1], _reduced(program, goal), strict=True):
        program.bound(index, value - END_SLACK, value + END_SLACK)
    program.fix(program.v[0], 0.0)
    program.fix(program.v[-1], 0.0)
    guard.even(program, EVEN)
    clearance.arms_off(program, body, np.arange(program.K))
    for side, name in (("R", "right"), ("L", "left")):
        air, sole = program.knots(name)[1:-1], jumper.foot(body, side)
        program.ground(sole, air, margin=0.0)
        program.ground(sole, air[len(air) // 4 : -len(air) // 4], margin=LIFT)
    _feet_at_start(program, body)
    return program


def _reduced(program: Transcription, goal: np.ndarray) -> np.ndarray:
    """(n,) coordinates of a pose (1, 7 + hinges)."""
    rest = np.zeros((1, goal.shape[1] - 1))
    return from_full_state(program.model, goal, rest, rest)[0][0]


def _feet_at_start(program: Transcription, body: Body) -> None:
    """The feet stand where the task has them."""
    model = program.model
    pos, _ = link_poses(body, scene(PenaltyKick(), body).default_qpos()[None, : 7 + body.num_dofs])
    stand = [
        (model.tree.link(f"{side}_Ankle"), pos[0, body.link_index(f"{side}_Ankle"), :2] - START)
        for side in "LR"
    ]

    def feet(q, p):
        motion = model.motion(q)
        return [
            (f"foot {'xy'[j]}", motion.p_WL[link][j] - float(at[j]), -AT, AT)
            for link, at in stand
            for j in range(2)
        ]

    program.rows("feet", [0], feet)


def _guess(program: Transcription, goal: np.ndarray) -> np.ndarray:
    """Key poses: weight to one side, a bent leg in each step, the kick's first pose."""
    model = program.model
    end = dict(zip(model.names, _reduced(program, goal), strict=True))
    stand = jumper.legs((-0.05, 0.1, -0.05, 0.0), (-0.05, 0.1, -0.05, 0.0), z=0.93)
    half = jumper.legs((0.1, 0.15, -0.2, 0.0), (-0.4, 0.45, -0.05, 0.0), x=0.15, z=0.89)
    arms = {k: 0.5 * v for k, v in end.items() if "Shoulder" in k or "Elbow" in k}
    frames = [
        stand,
        {**stand, "y": 0.06},
        {**stand, "x": 0.08, "y": 0.07, "R_Hip_y": -0.5, "R_Knee_y": 0.8, "R_Ankle_y": -0.2},
        {**half, **arms, "y": 0.03},
        {**half, **arms, "x": 0.27, "y": -0.05},
        {**half, **arms, "x": 0.36, "y": -0.1, "L_Hip_y": -0.4, "L_Knee_y": 0.9, "L_Ankle_y": -0.2},
        end,
        end,
    ]
    durations = [0.35, 0.35, 0.3, 0.35, 0.4]
    t = np.cumsum([0.0, *durations])
    times = [t[0], t[1], (t[1] + t[2]) / 2, t[2], t[3], (t[3] + t[4]) / 2, t[4], t[5]]
    at = program.nominal_times(durations)
    return program.guess(jumper.key_frames(model, times, frames, at), durations)


# From the steps and a kick to an episode of the task.


def reference(steps: Solution, kick: Clip) -> Clip:
    """Steps and kick one after the other at the task's control rate, as one motion to follow. Its
    first frame is the task's own start."""
    world = make_scene(TASK, strength=steps.body.strength)
    rate = 1.0 / world.control_timestep
    kick, walk = kick.resample(rate), clip_from_solution(steps, rate)
    if kick.ctrl is None or walk.ctrl is None:
        raise ValueError("the kick has no targets: it must be a clip that MuJoCo played")
    joined = [
        np.concatenate([first[:-1], then])
        for first, then in ((walk.qpos, kick.qpos), (walk.qvel, kick.qvel), (walk.ctrl, kick.ctrl))
    ]
    joined[0][0], joined[1][0] = world.default_qpos()[world.agent_qpos(0)], 0.0
    later = (walk.num_frames - 1) / rate
    events = {name: t + later for name, t in kick.meta.get("events", {}).items()}
    return replace(
        kick,
        qpos=joined[0],
        qvel=joined[1],
        ctrl=joined[2],
        meta={**kick.meta, "achieved": {}, "events": events},
    )


def approached(
    kick: Clip,
    steps: Solution,
    settings: Tracking = FOLLOWING,
    *,
    threads: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Clip:
    """Steps and kick as the task in MuJoCo played them from its own start, the ball aimed at the
    kick's target (:mod:`warmstart.aim`).

    ``progress(step, steps)`` as in :func:`warmstart.tracking.track`. Raises RuntimeError when the
    simulation diverges.
    """
    wanted = reference(steps, kick)
    found = track(wanted, settings=settings, threads=threads, progress=progress).clip
    assert found.ctrl is not None and wanted.ctrl is not None
    clip = episode(kick, found.ctrl[: len(wanted.ctrl)])
    target = kick.meta.get("options", {}).get("target")
    if target is None:
        return clip
    search = Search(seed=settings.seed)
    return aim(clip, tuple(target), lambda ctrl: episode(kick, ctrl), search, threads=threads)


def episode(kick: Clip, ctrl: np.ndarray) -> Clip:
    """What the task in MuJoCo makes of targets (K, n) (rad) from its own start, with the ball.

    ``meta["achieved"]`` has the task's metrics (whether it was a goal near the *task's* target is
    not among them: that target is drawn) and those of :func:`ball_of`.
    """
    played = perform(TASK, kick.meta["strength"], "ball", ctrl, lambda env: True)
    metrics = {k: v for k, v in played.metrics.items() if k not in ("success", "error")}
    flight, events = ball_of(played.clip, kick.meta.get("options", {}).get("target"))
    return replace(
        played.clip,
        meta={
            "problem": TASK,
            "asked": kick.meta["asked"],
            "achieved": {k: round(v, 6) for k, v in (metrics | flight).items()},
            "strength": kick.meta["strength"],
            "options": kick.meta.get("options", {}),
            "source": "trajectory optimisation with an approach, tracked in MuJoCo",
            "licence": "Apache-2.0",
            "events": {bank.START: 0.0, **events},
        },
    )


def ball_of(
    clip: Clip, target: Sequence[float] | None = None
) -> tuple[dict[str, float], dict[str, float]]:
    """What the ball of an episode did: its speed (m/s) in the second frame after the kick, y and z
    (m) in the goal plane and how far from a ``target`` (y, z) that was; and the event ``release``,
    the last frame in which it lay on its spot (s). Empty where it was not kicked."""
    assert clip.object_qpos is not None and clip.object_qvel is not None
    place, speed = clip.object_qpos[:, :3], np.linalg.norm(clip.object_qvel[:, :3], axis=1)
    gone = np.flatnonzero(np.linalg.norm(place - (*SPOT, BALL_RADIUS), axis=1) > MOVED)
    if not gone.size:
        return {}, {}
    first = int(gone[0])
    out = {"ball_speed": float(speed[min(first + 1, len(speed) - 1)])}
    over = np.flatnonzero((place[1:, 0] >= HALF_LENGTH) & (place[:-1, 0] < HALF_LENGTH))
    if over.size:
        a, b = place[over[0]], place[over[0] + 1]
        at = (a + (HALF_LENGTH - a[0]) / (b[0] - a[0]) * (b - a))[1:]
        out |= {"ball_y": float(at[0]), "ball_z": float(at[1])}
        if target is not None:
            out["ball_off_target"] = float(np.linalg.norm(at - target))
    return out, {"release": float(clip.times[first - 1])}


def main(arguments: Sequence[str] | None = None) -> int:
    """Plans and follows an approach and writes the episode; 1 when it is no goal, 2 for a file
    that is no kick."""
    parser = argparse.ArgumentParser(prog="python -m warmstart.approach", description=__doc__)
    parser.add_argument("kick", type=Path, help="a certified kick, as in warmstart/data")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--detail", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    try:
        kick = Clip.load(options.kick)
        steps = plan(kick, options.detail)
    except (ValueError, OSError) as error:
        print(f"{options.kick}: {error}", file=sys.stderr)
        return 2
    print(jumper.shown(steps), flush=True)
    clip = approached(kick, steps, replace(FOLLOWING, seed=options.seed))
    print(f"{options.out}: {clip.meta['achieved']}")
    if clip.meta["achieved"].get("goal") != 1.0:
        print("no goal: try another --seed", file=sys.stderr)
        return 1
    clip.save(options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
