"""A motion put back into simulation: a solution's torques, a clip's targets.

:func:`replay` plays a solution on any engine, open loop, or with the feedback of
:mod:`warmstart.feedback` where the solution says so (``stats["feedback"]``); :func:`play` plays a
clip in its task's environment, where the task's own rules measure what it achieves.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from sports.env import Starts, make_env, make_scene
from sports.humanoid.body import Body, load_body
from sports.physics import PhysicsState, make_physics
from sports.registry import get_task, task_names
from sports.scene import Scene, humanoid_scene
from warmstart.clip import Clip
from warmstart.solution import Solution

REPLAY_RATE = 480.0
"""Control and simulation rate of a solution's replay (Hz)."""
FEEDBACK = "feedback"
"""Key of a solution's stats: whether it is replayed in closed loop."""


@dataclass(frozen=True)
class Replayed:
    """What an engine made of a solution, of a scene's athlete and its free objects."""

    times: np.ndarray
    """(T + 1,) s from the first frame."""
    qpos: np.ndarray
    """(T + 1, nq)"""
    qvel: np.ndarray
    """(T + 1, nv)"""
    ctrl: np.ndarray
    """(T, num_dofs) targets of the servos in each step (rad)."""
    feedback: np.ndarray
    """(T, num_dofs) what feedback asked for beyond the plan (N m); zero in an open loop."""


def replay(
    solution: Solution, engine: str, hold: float = 0.5, scene: Scene | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Plays the torques at ``REPLAY_RATE``: targets q + torque / kp, clipped by the servo, then the
    last targets for ``hold`` s. The athlete is alone on the ground. Open loop, unless the solution
    asks for feedback: then that is added to the torques while the plan lasts.

    Returns times (T,) s from the first frame and qpos (T, 7 + n). Raises RuntimeError when the
    simulation diverges.
    """
    times, qpos, _ = replay_states(solution, engine, hold, scene)
    return times, qpos


def replay_states(
    solution: Solution,
    engine: str,
    hold: float = 0.5,
    scene: Scene | None = None,
    objects: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same with qvel (T, nv), in a ``scene`` stepped at ``REPLAY_RATE`` or alone on the ground.

    ``objects``: qpos and qvel of the scene's free objects at the first frame, one after the other;
    theirs follow the athlete's in what is returned.
    """
    played = replay_all(solution, engine, hold, scene, objects)
    return played.times, played.qpos, played.qvel


def replay_all(
    solution: Solution,
    engine: str,
    hold: float = 0.5,
    scene: Scene | None = None,
    objects: tuple[np.ndarray, np.ndarray] | None = None,
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> Replayed:
    """The same with what the servos were given. ``start``: qpos and qvel of the athlete in place
    of the plan's first ones."""
    scene = scene or humanoid_scene(solution.body)
    planned = math.floor(solution.duration * REPLAY_RATE)
    steps = planned + round(hold * REPLAY_RATE)
    middle = np.minimum((np.arange(steps) + 0.5) / REPLAY_RATE, solution.duration)
    motion = solution.sample(solution.times[0] + middle)
    targets = motion["qpos"][:, 7:] + motion["torque"] / solution.body.array("kp")
    things = objects or (np.zeros(0), np.zeros(0))
    own = start or (solution.qpos[0], solution.qvel[0])
    qpos, qvel = ([np.concatenate([mine, its])] for mine, its in zip(own, things, strict=True))
    correct = _corrections(solution)
    held = int((solution.loaded(middle) > 0.5).sum())
    added = _play(engine, scene, targets[:held], qpos, qvel, correct)
    if held < steps:  # what was thrown is no longer in the hand
        empty = replace(scene, body=solution.empty_handed)
        added += _play(engine, empty, targets[held:], qpos, qvel, correct)
    feedback = np.array(added).reshape(steps, -1)
    ctrl = targets + feedback / solution.body.array("kp")
    return Replayed(
        np.arange(len(qpos)) / REPLAY_RATE, np.array(qpos), np.array(qvel), ctrl, feedback
    )


_Correct = Callable[[int, np.ndarray, np.ndarray], np.ndarray]


def _corrections(solution: Solution) -> _Correct | None:
    """Torques beyond the plan (n,) by step and state; None in an open loop."""
    if not solution.stats.get(FEEDBACK):
        return None
    return solution.following.torque


def _play(
    engine: str,
    scene: Scene,
    targets: np.ndarray,
    qpos: list[np.ndarray],
    qvel: list[np.ndarray],
    correct: _Correct | None = None,
) -> list[np.ndarray]:
    """Appends what an engine makes of the targets (T, n) from the last state in the lists; returns
    the torques that were added to them (T, n)."""
    scene = replace(scene, timestep=1.0 / REPLAY_RATE, substeps=1)
    physics = make_physics(engine, scene, 1)
    state = PhysicsState(
        torch.tensor(qpos[-1][None], dtype=torch.float32),
        torch.tensor(qvel[-1][None], dtype=torch.float32),
        torch.zeros(1, 0, 3),
    )
    physics.reset(torch.ones(1, dtype=torch.bool), state)
    qpos[-1] = physics.qpos[0].double().numpy().copy()
    qvel[-1] = physics.qvel[0].double().numpy().copy()
    added, (wide, kp) = [], (scene.body.num_dofs, scene.body.array("kp"))
    for target in targets:
        extra = np.zeros(wide)
        if correct is not None:
            extra = correct(len(qpos) - 1, qpos[-1][: 7 + wide], qvel[-1][: 6 + wide])
        added.append(extra)
        physics.step(torch.tensor((target + extra / kp)[None], dtype=torch.float32))
        if bool(physics.bad.any()):
            raise RuntimeError(f"the replay diverged in {engine} after {len(qpos)} steps")
        qpos.append(physics.qpos[0].double().numpy().copy())
        qvel.append(physics.qvel[0].double().numpy().copy())
    physics.close()
    return added


_OPTIONS = {"high_jump": {"bar_height": "bar_height"}, "hurdling": {"hurdle_height": "height"}}
"""By task: which ``asked`` outcome sets which of its options."""


def scene_options(clip: Clip) -> dict[str, Any]:
    """The options of the clip's task that its ``asked`` outcome sets (``bar_height``)."""
    asked = clip.meta.get("asked")
    known = _OPTIONS.get(clip.meta.get("problem", ""), {})
    return {known[k]: asked[k] for k in known if isinstance(asked, dict) and k in asked}


def body_of(clip: Clip) -> Body:
    """The athlete of a clip at the strength (``paper`` without one) and with the equipment that its
    metadata names."""
    meta = clip.meta
    return load_body(
        clip.body,
        strength=meta.get("strength", "paper"),
        equipment=meta.get("equipment", ()),
    )


def scene_of(clip: Clip) -> Scene:
    """The scene of the clip's problem, or the athlete alone where no task of its body has that
    name (a javelin thrown by the body without fingers)."""
    problem = clip.meta.get("problem")
    if problem in task_names() and get_task(problem).body == clip.body:
        return make_scene(
            problem, strength=clip.meta.get("strength", "paper"), options=scene_options(clip)
        )
    return humanoid_scene(body_of(clip))


def _first(rows: np.ndarray | None) -> torch.Tensor | None:
    return None if rows is None else torch.tensor(rows[:1], dtype=torch.float32)


def play(
    clip: Clip,
    task: str,
    options: dict[str, Any],
    body: Body,
    timestep_divisor: int = 1,
    hold: bool = True,
) -> tuple[Clip, dict[str, float]]:
    """Plays the clip's targets open loop from its first frame in the task's environment.

    Where they end, the last ones are held until the task ends the episode; without ``hold`` the
    motion ends with them. Returns the motion that came out, at the control rate, and the task's
    metrics at that moment (those that are not NaN). The environment rounds states to
    float32 and its actions are limited, exactly as in training.
    """
    assert clip.ctrl is not None
    starts = Starts(
        qpos=torch.tensor(clip.qpos[:1], dtype=torch.float32),
        qvel=torch.tensor(clip.qvel[:1], dtype=torch.float32),
        context={},
        probability=1.0,
        object_qpos=_first(clip.object_qpos),
        object_qvel=_first(clip.object_qvel),
    )
    env = make_env(
        task,
        num_worlds=1,
        strength=body.strength,
        limits=body.limits,
        training=False,
        options=options,
        starts=starts,
        timestep_divisor=timestep_divisor,
    )
    env.keep_snapshot = True
    offset = env.physics.scene.action_offset()
    q, v = env.physics.scene.agent_qpos(0), env.physics.scene.agent_qvel(0)
    qpos, qvel, ctrl, metrics = [clip.qpos[0]], [clip.qvel[0]], [], {}
    for step in range(env.max_steps if hold else len(clip.ctrl) - 1):
        target = clip.ctrl[min(step, len(clip.ctrl) - 1)]
        action = torch.tensor((target - offset) / body.action_scale(), dtype=torch.float32)
        result = env.step(action[None, None])
        ctrl.append(target)
        metrics = {k: float(m[0]) for k, m in result.metrics.items()}
        if not bool(result.valid[0]):
            raise RuntimeError(f"the simulation diverged at step {step} of the replayed clip")
        qpos.append(env.final_snapshot["qpos"][0, q].double().numpy())
        qvel.append(env.final_snapshot["qvel"][0, v].double().numpy())
        if bool(result.terminated[0] | result.truncated[0]):
            break
    rate = 1.0 / env.physics.scene.control_timestep
    env.close()
    ctrl.append(ctrl[-1])
    out = replace(
        clip,
        fps=rate,
        qpos=np.array(qpos),
        qvel=np.array(qvel),
        ctrl=np.array(ctrl),
        object_qpos=None,
        object_qvel=None,
        meta=dict(clip.meta),
    )
    return out, {k: round(m, 6) for k, m in metrics.items() if np.isfinite(m)}
