"""Where two engines part: every control step of episodes in Drake, once more in MuJoCo.

Outcomes say that a policy does worse in the other engine, not why. So each control step of a few
episodes is played again by MuJoCo at a fine time step, from the same state with the same targets:
within 1/30 s nothing has had the time to grow, and what moves differently is what touches
something. The forces of the ground on each link say what that is: a club that goes through the
turf, a toe that lands before its heel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from rl.policy import Policy, as_trained
from rl.trials import Share, opened
from sports.physics import make_physics
from sports.physics.base import PhysicsState
from sports.scene import finer

FINE = 4
"""MuJoCo's time step is the scene's divided by this: Drake's of most scenes."""
MOVED = 0.3
"""Roots that are further apart (m) after one control step were not moved by physics: a referee
parted the athletes, or a new episode began."""
SHOWN = 8
"""Steps told, of those that part most."""
TOUCH = 1.0
"""N"""


@dataclass(frozen=True)
class LinkForce:
    """The ground on one link. Forces (N) are those of the substep in which they are largest."""

    athlete: int
    link: str
    touching: float
    """Share of the steps in which it touches the ground in either engine."""
    other: float
    """Mean over these steps, in the engine of the episodes."""
    mujoco: float
    other_peak: float
    """99th percentile."""
    mujoco_peak: float
    blame: float
    """Correlation, over all steps, of the two engines' difference here with that of the joints'
    velocities; 0 where either never varies."""


@dataclass(frozen=True)
class PartedStep:
    """A control step after which the engines are far apart, and the link that explains most."""

    world: int
    seconds: float
    """Since the episode began."""
    velocity: float
    """Difference of the joints' velocities, rms (rad/s)."""
    athlete: int
    link: str
    """On which the ground's forces (N) differ most."""
    other: float
    mujoco: float


@dataclass(frozen=True)
class Parting:
    """What one control step from the same states comes to in two engines."""

    engine: str
    """Of the episodes."""
    steps: int
    """Compared."""
    timestep: float
    """Of MuJoCo (s)."""
    velocity: float
    """Difference of the joints' velocities after a step, rms over the joints (rad/s): median."""
    velocity_p95: float
    forces: tuple[LinkForce, ...]
    """Of the links that touch the ground, those first whose forces differ most on average."""
    worst: tuple[PartedStep, ...]


@dataclass(frozen=True)
class _Steps:
    """(S,) world and seconds, (S,) rms difference (rad/s), (S, A, B) forces (N)."""

    world: np.ndarray
    seconds: np.ndarray
    velocity: np.ndarray
    other: np.ndarray
    mujoco: np.ndarray


def find_parting(
    policy: Policy,
    task: str,
    *,
    engine: str = "drake",
    worlds: int = 4,
    steps: int = 60,
    seed: int = 0,
    strength: str | None = None,
    limits: str | None = None,
    options: dict[str, Any] | None = None,
    divisor: int = FINE,
) -> Parting:
    """Plays ``steps`` control steps of ``worlds`` worlds and each of them again in MuJoCo.

    Args:
        policy: whose mean actions are played.
        task: name of the task.
        engine: of the episodes.
        worlds: number of worlds.
        steps: control steps of each.
        seed: of the starts.
        strength: torque limits; None for those that the policy was trained with.
        limits: joint limits; likewise.
        options: the task's options.
        divisor: of the scene's time step, in MuJoCo.

    Raises ValueError for an unknown task or option or counts below 1, PolicyError for a policy that
    does not fit, RuntimeError where an engine cannot run.
    """
    if min(worlds, steps) < 1:
        raise ValueError(f"worlds and steps must be positive, not {worlds} and {steps}")
    share = Share(
        task=task,
        engine=engine,
        trials=worlds,
        worlds=worlds,
        seed=seed,
        **as_trained(policy, task, strength, limits, options)._asdict(),
    )
    with opened(policy, share) as env:
        scene = finer(env.physics.scene, divisor)
        mujoco = make_physics("mujoco", scene, worlds)
        try:
            found = _play(policy, env, mujoco, steps)
        finally:
            mujoco.close()
    return _summary(found, engine, scene.timestep, scene.body.link_names)


def _play(policy: Policy, env: Any, mujoco: Any, steps: int) -> _Steps:
    scene = env.physics.scene
    agents = range(scene.num_agents)
    everyone = torch.ones(env.num_worlds, dtype=torch.bool)
    env.keep_snapshot = True
    kept: list[tuple[np.ndarray, ...]] = []
    obs = env.reset()
    for _ in range(steps):
        p, clock = env.physics, env.view.clock.clone()
        mujoco.reset(everyone, PhysicsState(p.qpos, p.qvel, p.mocap_pos, p.wave_phase))
        result = env.step(policy(obs))
        obs = result.obs
        mujoco.step(env.view.ctrl.flatten(1))
        after = env.final_snapshot
        q, v = after["qpos"] - mujoco.qpos, after["qvel"] - mujoco.qvel
        roots = [q[:, scene.agent_qpos(a)][:, :3].norm(dim=-1) for a in agents]
        turned = [v[:, scene.agent_qvel(a)][:, 6:] for a in agents]
        comparable = result.valid & ~mujoco.bad & (torch.stack(roots).amax(0) < MOVED)
        rows = comparable.nonzero()[:, 0]
        values = (
            rows,
            (clock + 1)[rows] * scene.control_timestep,
            torch.cat(turned, -1).square().mean(-1).sqrt()[rows],
            after["ground_force"].norm(dim=-1)[rows],
            mujoco.ground_force.norm(dim=-1)[rows],
        )
        kept.append(tuple(v.double().numpy().copy() for v in values))
    return _Steps(*(np.concatenate(column) for column in zip(*kept)))


def _summary(found: _Steps, engine: str, timestep: float, links: tuple[str, ...]) -> Parting:
    """Raises ValueError where no step could be compared."""
    if not len(found.velocity):
        raise ValueError("no control step could be compared: every one of them diverged")
    gap = np.abs(found.other - found.mujoco)
    forces = []
    for a, b in zip(*np.nonzero((np.maximum(found.other, found.mujoco) > TOUCH).any(0))):
        other, mujoco = found.other[:, a, b], found.mujoco[:, a, b]
        touches = np.maximum(other, mujoco) > TOUCH
        forces.append(
            LinkForce(
                athlete=int(a),
                link=links[b],
                touching=float(touches.mean()),
                other=float(other[touches].mean()),
                mujoco=float(mujoco[touches].mean()),
                other_peak=float(np.quantile(other, 0.99)),
                mujoco_peak=float(np.quantile(mujoco, 0.99)),
                blame=_correlation(gap[:, a, b], found.velocity),
            )
        )
    worst = []
    for s in np.argsort(-found.velocity, kind="stable")[:SHOWN]:
        a, b = np.unravel_index(np.argmax(gap[s]), gap[s].shape)
        worst.append(
            PartedStep(
                world=int(found.world[s]),
                seconds=float(found.seconds[s]),
                velocity=float(found.velocity[s]),
                athlete=int(a),
                link=links[b],
                other=float(found.other[s, a, b]),
                mujoco=float(found.mujoco[s, a, b]),
            )
        )
    return Parting(
        engine=engine,
        steps=len(found.velocity),
        timestep=timestep,
        velocity=float(np.median(found.velocity)),
        velocity_p95=float(np.quantile(found.velocity, 0.95)),
        forces=tuple(sorted(forces, key=lambda f: -f.touching * abs(f.other - f.mujoco))),
        worst=tuple(worst),
    )


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    if len(x) < 2 or x.std() == 0.0 or y.std() == 0.0:
        return 0.0
    return float(np.corrcoef(x, y)[0, 1])
