"""MuJoCo worlds unlike those of the task, for motions that must not live on one engine's numbers.

A throw that is right in the task alone may hang on how far a ball sinks into a finger. Here the
same scene is played with other friction and with contacts more like Drake's: firmer hands, a finer
time step, a round friction cone and joint damping that the contact solver feels
(``sports/physics/variation.py``; docs/physics.md, "What Drake feels and MuJoCo does not").
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from sports.humanoid.mjcf import firm_ground, holds
from sports.physics.variation import split_damping
from sports.scene import Scene
from warmstart.tracking import Worlds


@dataclass(frozen=True)
class Other:
    """How worlds differ from those of their task."""

    friction: float = 1.0
    """Factor of every friction coefficient."""
    finer: int = 1
    """Time steps in one of the task's."""
    felt: bool = False
    """Whether contacts feel the joints' damping, on firm ground."""
    hold_time: float | None = None
    """Time constant of the contacts of athletes with what they hold (s), at least two time steps;
    None as the task has it."""
    cone: bool = False
    """Whether friction has a round cone, not a pyramid."""

    def __post_init__(self) -> None:
        if not self.friction > 0.0 or self.finer < 1:
            raise ValueError(
                f"worlds need friction above 0 and at least 1 time step, not {self.friction} and "
                f"{self.finer}"
            )


FIRM = Other(finer=2, felt=True, hold_time=0.0042, cone=True)
"""Firmer hands on a finer time step."""


class OtherWorlds(Worlds):
    """A batch like :class:`warmstart.tracking.Worlds`, in worlds that differ. Raises ValueError for
    contacts that are quicker than two time steps."""

    def __init__(self, scene: Scene, worlds: int, threads: int, other: Other) -> None:
        self.other = other
        finer = replace(
            scene, timestep=scene.timestep / other.finer, substeps=scene.substeps * other.finer
        )
        if other.hold_time is not None and other.hold_time < 2.0 * finer.timestep:
            raise ValueError(
                f"contacts of {other.hold_time:g} s need a time step of half of that, not "
                f"{finer.timestep:g} s: raise finer"
            )
        self._finer = finer
        super().__init__(finer, worlds, threads)
        self._applied = self.batch.bind("qfrc_applied")

    def _compiled(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        other = self.other
        if other.cone:
            spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        model = spec.compile()
        model.geom_friction[:, 0] *= other.friction
        if other.hold_time is not None:
            model.geom_solref[holds(model.geom_solref), 0] = other.hold_time
        self._damping = np.zeros(model.nv)
        if other.felt:
            firm_ground(model)
            damping = model.dof_damping.reshape(model.nv, -1)
            split = split_damping(
                damping[None, :, 0],
                self._finer.joint_dofs(),
                np.array([True]),
                np.array([self._finer.timestep]),
            )
            damping[:, 0], self._damping = split.own[0], split.force[0]
            model.dof_armature[:] += split.armature[0]
        return model

    def _substep(self, stage: int) -> None:
        self._applied[self.ids] = -self._damping * self.qvel[self.ids]
        super()._substep(stage)
