"""Worlds in which the latent prior learns: the tracker's, with absolute PD targets and trouble.

Pushes, noise and falls lead the student to states that no clip holds; the tracker's answer to them
is what the prior knows of recovery.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from rl.config import TRACKING, TrainConfig
from rl.latent_config import PriorConfig, options_of
from rl.policy import Policy, load_policy
from rl.tracker import Tracking, TrackingConfig, TrackingEnv, make_tracking_env
from rl.tracker_evaluation import tracking_config
from sports import quaternion
from sports.physics import PhysicsState
from sports.task import Advance, Memory, Move, View

DROP = 0.9
"""Height (m) of the root at the beginning of a fall: nobody reaches the ground from there yet."""
TILT = (math.radians(60.0), math.radians(120.0))
"""By how much a falling athlete's root is tilted."""
GRACE = 45
"""Control steps in which an athlete that starts with a fall may be far from the reference."""


class Trouble:
    """Task functions of the tracker, with pushes and falls.

    Draws come from the environment's own generator, so they are part of its state.
    """

    def __init__(self, env: TrackingEnv, config: PriorConfig) -> None:
        self.tracking: Tracking = env.tracking
        self.config, self.generator, self.device = config, env.generator, env.device
        seconds = env.physics.scene.control_timestep
        self._chance = min(seconds / config.push_seconds, 1.0) if config.push_seconds else 0.0

    def _rand(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator, device=self.device)

    def start(
        self,
        view: View,
        state: PhysicsState,
        context: Memory,
        generator: torch.Generator,
        training: bool,
    ) -> tuple[PhysicsState, Memory]:
        """As the tracker's; some athletes hang tilted in the air, at rest, and fall."""
        state, context = self.tracking.start(view, state, context, generator, training)
        worlds = len(state.qpos)
        chance, about, angle = self._rand(3, worlds)
        falls = chance < self.config.fallen
        about, angle = 2.0 * math.pi * about, TILT[0] + (TILT[1] - TILT[0]) * angle
        half = 0.5 * angle
        axis = (half.sin() * about.cos(), half.sin() * about.sin(), torch.zeros_like(half))
        tilt = torch.stack((half.cos(), *axis), -1)
        root = state.qpos[:, :7].clone()
        root[:, 2] = DROP
        root[:, 3:] = quaternion.multiply(tilt, state.qpos[:, 3:7])
        row = falls[:, None]
        qpos = torch.cat((torch.where(row, root, state.qpos[:, :7]), state.qpos[:, 7:]), 1)
        qvel = state.qvel.masked_fill(row, 0.0)
        return replace(state, qpos=qpos, qvel=qvel), context | {"falls": falls}

    def begin(self, view: View, context: Memory) -> Memory:
        """As the tracker's, with ``grace``: steps that a falling athlete has left."""
        memory = self.tracking.begin(view, context)
        return memory | {"grace": GRACE * context["falls"].float()}

    def advance(self, view: View, memory: Memory) -> Advance:
        """As the tracker's, then some athletes are pushed."""
        step = self.tracking.advance(view, memory)
        spared = memory["grace"] > 0
        step.terminated = step.terminated & ~spared[:, None]
        if step.truncated is not None:  # a clip that ends in a fall ends all the same
            over = step.memory["frame"] >= self.tracking.tables.last[step.memory["frame"]]
            step.truncated = over & ~step.terminated[:, 0]
        step.memory = step.memory | {"grace": (memory["grace"] - 1.0).clamp(min=0.0)}
        if self._chance > 0.0:
            draw = self._rand(4, len(spared))
            pushed = draw[0] < self._chance
            kick = self.config.push * (2.0 * draw[1:3].T - 1.0)
            qvel = view.physics.qvel.clone()
            qvel[:, :2] += kick * pushed[:, None]
            step.move = Move(pushed, view.physics.qpos.clone(), qvel)
        return step


def trouble(env: TrackingEnv, config: PriorConfig) -> TrackingEnv:
    """The same worlds with pushes and falls; they begin anew."""
    troubled = Trouble(env, config)
    env.task = replace(
        env.task, start=troubled.start, begin=troubled.begin, advance=troubled.advance
    )
    env.memory = {}
    env.reset()
    return env


def teacher_of(config: TrainConfig) -> Policy:
    """The tracker that a run learns from. Raises PolicyError where it is none, ValueError where
    none is named."""
    if not config.tracker:
        raise ValueError("the prior learns from a motion tracker: give --tracker RUN or a file")
    teacher = load_policy(config.tracker, TRACKING)
    if teacher.actor is None:
        raise ValueError(f"--tracker {config.tracker} is a baseline: there is nothing to learn")
    return teacher


def make_distillation_env(
    config: TrainConfig, seed: int, physics_options: dict[str, Any]
) -> TrackingEnv:
    """Worlds for a run of the task ``prior``: the tracker's own, whose actions are absolute."""
    options = options_of(config.options)
    teacher = teacher_of(config)
    own = tracking_config(teacher.metadata)
    limit = (options.tolerance, options.tolerance)
    athlete = {name: str(teacher.metadata[name]) for name in ("strength", "limits")}
    for name, value in athlete.items():
        if getattr(config, name) not in ("paper", value):
            raise ValueError(f"the tracker's athlete is one of {name} '{value}': leave it out")
    changed: TrackingConfig = replace(own, split=options.split, action="absolute", tolerance=limit)
    env = make_tracking_env(
        config.clips,
        engine=config.engine,
        num_worlds=config.num_worlds,
        seed=seed,
        strength=athlete["strength"],
        limits=athlete["limits"],
        config=changed,
        physics_options=physics_options,
        timestep_divisor=config.timestep_divisor,
    )
    return trouble(env, options)
