"""Where episodes start: noise, frames of demonstrations, and a stock of starts worked out ahead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sports.physics.base import PhysicsState
from sports.scene import Scene
from sports.task import Memory, constant

START_NOISE = 0.02
"""Joint noise of a training start (rad), uniform."""
ELAPSED = "elapsed"
"""Label of a frame in the middle of an episode: seconds since the episode began. Rules that depend
on the task's clock (``View.clock``) go on from there; NaN for an episode that begins."""


@dataclass
class Starts:
    """Frames of demonstrations from which episodes may start (reference-state initialisation)."""

    qpos: Tensor
    """(F, 7 + num_dofs) of one athlete, task world."""
    qvel: Tensor
    """(F, 6 + num_dofs)"""
    context: dict[str, Tensor]
    """(F,) labels of the frame's demonstration that the task understands (``bar_height``), and
    ``ELAPSED``."""
    probability: float = 0.5
    """Share of resets that start from a frame."""
    object_qpos: Tensor | None = None
    """(F, 7 k) of the k free objects of the scene in its order; NaN where a frame leaves them where
    they are. None where no frame has any."""
    object_qvel: Tensor | None = None
    """(F, 6 k)"""
    blocks: int = 1
    """The worlds come in so many blocks that draw the same frames, with the same noise."""
    noise: float = 0.0
    """+- joint noise (rad) of every start and athlete; see :func:`add_noise`."""

    def to(self, device: torch.device | str) -> Starts:
        """The same frames on a device."""
        things = (x if x is None else x.to(device) for x in (self.object_qpos, self.object_qvel))
        return Starts(
            self.qpos.to(device),
            self.qvel.to(device),
            {k: v.to(device) for k, v in self.context.items()},
            self.probability,
            *things,
            blocks=self.blocks,
            noise=self.noise,
        )

    def draw(self, state: PhysicsState, scene: Scene, generator: torch.Generator) -> Memory:
        """Puts drawn frames into some rows of ``state``; labels (N,), NaN for the other rows.

        Raises ValueError where the frames have another number of objects than the scene.
        """
        device, frames = self.qpos.device, self.qpos.shape[0]
        each = state.qpos.shape[0] // self.blocks
        draw = torch.rand(each, 2, device=device, generator=generator).repeat(self.blocks, 1)
        use = draw[:, 0] < self.probability
        frame = (draw[:, 1] * frames).long().clamp(max=frames - 1)
        q, v = scene.agent_qpos(0), scene.agent_qvel(0)
        state.qpos[:, q] = torch.where(use[:, None], self.qpos[frame], state.qpos[:, q])
        state.qvel[:, v] = torch.where(use[:, None], self.qvel[frame], state.qvel[:, v])
        if self.noise > 0.0:
            add_noise(state, scene, generator, self.noise, self.blocks)
        if self.object_qpos is not None and self.object_qvel is not None:
            free = len(scene.free_objects)
            if self.object_qpos.shape[1] != 7 * free:
                raise ValueError(
                    f"the frames have {self.object_qpos.shape[1] // 7} objects, scene "
                    f"'{scene.name}' has {free}"
                )
            for whole, part in (
                (state.qpos[:, -7 * free :], self.object_qpos[frame]),
                (state.qvel[:, -6 * free :], self.object_qvel[frame]),
            ):
                whole[:] = torch.where(use[:, None] & ~part.isnan(), part, whole)
        nan = torch.full((), torch.nan, device=device)
        return {k: torch.where(use, c[frame], nan) for k, c in self.context.items()}


def add_noise(
    state: PhysicsState,
    scene: Scene,
    generator: torch.Generator,
    most: float = START_NOISE,
    blocks: int = 1,
) -> None:
    """Moves the joints of all athletes, uniformly by up to +-``most`` (rad): each world by other
    numbers, or so many ``blocks`` of worlds by the same."""
    noise = most * loose_joints(scene, state.qpos.device)
    for agent in range(scene.num_agents):
        joints = state.qpos[:, scene.agent_qpos(agent)][:, 7:]
        size = (len(joints) // blocks, joints.shape[1])
        draw = torch.rand(size, device=joints.device, generator=generator).repeat(blocks, 1)
        joints += noise * (2.0 * draw - 1.0)


def loose_joints(scene: Scene, device: torch.device) -> Tensor:
    """(num_dofs,) 1 for the joints that may start elsewhere, 0 for those of ``Scene.steady``."""
    return constant(tuple(float(dof.name not in scene.steady) for dof in scene.body.dofs), device)


@dataclass
class Stock:
    """A start of an episode for every world, worked out for all of them at once: ready when the
    world needs it, which saves two thirds of the time that a few resets in each step cost."""

    state: PhysicsState
    context: Memory
    """Of ``Task.begin``."""
    clock: Tensor
    """(N,) long: control steps of the episode that are over."""
    shown: Any
    """The engine's, of the state."""
    memory: Memory
    obs: Tensor
    """(N, A, obs)"""
    curriculum: Memory
    """That it was drawn for."""
    used: Tensor
    """(N,) bool: each start serves once."""

    def serves(self, worlds: Tensor, curriculum: Memory) -> bool:
        """Whether it has a start for each of these worlds."""
        same = all(
            torch.equal(v[worlds], curriculum[k][worlds]) for k, v in self.curriculum.items()
        )
        return same and not self.used.numpy()[worlds.numpy()].any()

    def state_dict(self) -> dict[str, Tensor]:
        """What it can be worked out from again."""
        state = {k: v for k, v in vars(self.state.clone()).items() if v is not None}
        state["used"] = self.used.clone()
        state |= {f"context/{k}": v.clone() for k, v in self.context.items()}
        return state | {f"curriculum/{k}": v.clone() for k, v in self.curriculum.items()}
