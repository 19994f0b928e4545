"""What a sport is to the rest of the project: a scene and four pure functions, in one record.

A sport's module defines a frozen config dataclass, ``scene``, ``start``, ``features`` and
``advance``, and registers them as a :class:`Task`. See docs/new_sport.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import torch
from torch import Tensor

from sports.frames import Heading
from sports.humanoid.body import Body
from sports.physics.base import Geometry, Physics, PhysicsState
from sports.scene import Scene

Memory = dict[str, Tensor]
"""What a task remembers of each world between steps: (N, ...) tensors by name."""


@dataclass
class View:
    """What a task function may look at: the engine's tensors, the frames, the clocks."""

    physics: Physics
    geometry: Geometry
    config: Any
    curriculum: Memory
    clock: Tensor
    """(N,) control steps since the episode began: 0 after a reset to the task's own start, more
    where it starts from a frame in the middle of a throw (``sports.starts.ELAPSED``)."""
    control_timestep: float
    lowest: Tensor
    """(B,) heights (m) below which a link's origin means a fall; -inf for ankles, toes, tools."""
    heaviest: Tensor
    """(B,) squared forces of the ground (N^2) above which a link has fallen; inf for those."""
    ctrl: Tensor | None = None
    """(N, A, act) PD targets (rad) of the last step; None before the first."""
    _heading: Heading | None = None
    _pressure: Tensor | None = None

    def refresh(self) -> None:
        """Tells the view that the engine's tensors have changed."""
        self._heading = self._pressure = None

    @property
    def heading(self) -> Heading:
        """The athletes' heading frames, computed once a step."""
        if self._heading is None:
            self._heading = Heading(self.physics.body_rot[:, :, 0])
        return self._heading

    @property
    def rotation(self) -> Tensor:
        """(N, A, B, 3, 3) R_WB of the links."""
        return self.physics.body_rot

    @property
    def root_pos(self) -> Tensor:
        """(N, A, 3)"""
        return self.physics.body_pos[:, :, 0]

    @property
    def root_linvel(self) -> Tensor:
        """(N, A, 3) world frame."""
        return self.physics.body_linvel[:, :, 0]

    @property
    def pressure(self) -> Tensor:
        """(N, A, B) squared force of the ground on each link (N^2), computed once a step."""
        if self._pressure is None:
            self._pressure = squared(self.physics.ground_force)
        return self._pressure

    def touching(self) -> Tensor:
        """(N, A, B) links with a ground contact in any substep of the last control step."""
        return self.pressure > 0

    def fallen(self) -> Tensor:
        """(N, A) sports.md, Common: a link other than ankles, toes and the tool below 0.15 m (head
        0.30 m) or pressed on the ground with more than 50 N; from the second control step on."""
        low = self.physics.body_pos[..., 2] < self.lowest
        return (low | (self.pressure > self.heaviest)).any(-1) & (self.clock >= 2)[:, None]


def falling_heights(link_names: Sequence[str], foot_links: Sequence[bool]) -> list[float]:
    """``View.lowest`` of a body's links (m), of which those may stand on the ground."""
    heights = [0.30 if name == "Head" else 0.15 for name in link_names]
    return [-math.inf if foot else h for h, foot in zip(heights, foot_links)]


def falling_forces(foot_links: Sequence[bool]) -> list[float]:
    """Forces (N) of the ground above which those links have fallen that may not stand on it."""
    return [math.inf if foot else 50.0 for foot in foot_links]


@dataclass
class Move:
    """What the sport itself puts elsewhere in mid-episode: a new serve, a ball dropped where it
    went out, an athlete put back on its feet. See :func:`place_object`."""

    mask: Tensor
    """(N,) bool, the worlds in which something moves."""
    qpos: Tensor
    """(N, nq) the whole state; rows of other worlds are not used."""
    qvel: Tensor
    """(N, nv)"""


@dataclass
class Advance:
    """What a control step meant in the sport."""

    memory: Memory
    terms: dict[str, Tensor]
    """Reward terms by name, each (N, A); their sum is the reward."""
    terminated: Tensor
    """(N, A) whose episode ended in the sport: no bootstrap. The world begins anew when any
    athlete's ended; for the others it was cut off."""
    metrics: dict[str, Tensor]
    """(N,) episode metrics so far; NaN where undefined; read where the episode ended."""
    success: Tensor
    """(N,) bool, meaningful where terminated: promotes the curriculum."""
    remaining_paid: Tensor | None = None
    """(N,) bool: pay this step's reward for the steps left (outcome decided early)."""
    truncated: Tensor | None = None
    """(N,) bool: the world begins anew without an outcome: bootstrap, as at the time limit."""
    move: Move | None = None
    """Done after the step, before it is observed; not where the world begins anew."""
    outcome: Tensor | None = None
    """(N,) float of a contest: 1 where side 0 (the first half of the athletes) has won by the
    sport's own score if the episode ends here, -1 where side 1 has, 0 for a draw."""


@dataclass(frozen=True)
class Task:
    """A sport, as data and functions. All functions are batched, pure and engine-free.

    A row of their results depends on that row alone. Starts may be drawn ahead of need, with
    ``begin`` and ``features`` called on a view that shows them.
    """

    name: str
    config: type
    scene: Callable[[Any, Body], Scene]
    """(config, body) -> Scene."""
    start: Callable[
        [View, PhysicsState, Memory, torch.Generator, bool], tuple[PhysicsState, Memory]
    ]
    """(view, state, context, generator, training) -> state and context for a reset of every
    world: moves fixtures, draws heights and targets. ``context`` holds the labels of the
    reference frame a world starts from (empty tensors' NaN where it starts standing)."""
    begin: Callable[[View, Memory], Memory]
    """(view after the reset, context) -> memory of the view's worlds."""
    features: Callable[[View, Memory], dict[str, Tensor]]
    """(view, memory) -> goal features by name, each (N, A, k), in order."""
    advance: Callable[[View, Memory], Advance]
    metrics: Mapping[str, str]
    """Episode metrics and their units."""
    main_metric: str
    max_steps: int
    reward_scale: float = 1.0
    body: str = "smpl"
    equipment: tuple[str, ...] = ()
    tools: tuple[str, ...] = ()
    """Links that hold the equipment: they may be low and touch the ground like feet
    (``View.fallen``)."""
    curriculum: Callable[[Any, int, torch.device], Memory] | None = None
    """(config, num_worlds, device) -> curriculum state, (N,) tensors."""
    promote: Callable[[View, Memory, Advance, Tensor], Memory] | None = None
    """(view, memory, advance, ended (N,)) -> new curriculum state."""
    targets: Callable[[View, Memory, Tensor], Tensor] | None = None
    """(view, memory, action (N, A, act) in [-1, 1]) -> PD targets (N, A, act), rad, where they are
    not the body's scale times the action around the scene's offset."""
    age_at_start: bool = True
    """Whether training starts episodes' truncation clocks at random ages."""
    sees: tuple[str, ...] = ()
    """Options that add to what is observed: a policy that learned with one is played with it."""
    shown: tuple[str, ...] = ("target", "phases")
    """What recordings keep of a world's memory for pictures, where there is such a thing: where
    the target is, (N, 3) or (N, A, 3) m, and how golf's waves lie, (N, 2) rad."""
    summary: str = ""
    notes: Mapping[str, str] = field(default_factory=dict)


def nothing_to_draw(
    view: View,
    state: PhysicsState,
    context: Memory,
    generator: torch.Generator,
    training: bool,
) -> tuple[PhysicsState, Memory]:
    """``Task.start`` of a sport whose scene is its start."""
    return state, {}


def _changed(view: View, onto: Move | None) -> tuple[Tensor, Tensor]:
    """qpos and qvel to write to: those of what else moves, else copies of the present ones."""
    if onto is not None:
        return onto.qpos, onto.qvel
    return view.physics.qpos.clone(), view.physics.qvel.clone()


def place_object(
    view: View,
    mask: Tensor,
    name: str,
    pos: Tensor,
    linvel: Tensor,
    quat: Tensor | None = None,
    angvel: Tensor | None = None,
    onto: Move | None = None,
) -> Move:
    """Puts a free object elsewhere where ``mask`` (N,) is true.

    ``pos``, ``linvel`` (N, 3) world frame; ``quat`` (N, 4), upright by default; ``angvel`` (N, 3)
    in the object's own frame, zero by default. ``onto``: what else moves.
    """
    scene = view.physics.scene
    q, v = scene.object_qpos(name), scene.object_qvel(name)
    qpos, qvel = _changed(view, onto)
    if quat is None:
        quat = constant((1.0, 0.0, 0.0, 0.0), pos.device).expand(len(pos), 4)
    spin = torch.zeros_like(linvel) if angvel is None else angvel
    row = mask[:, None]
    qpos[:, q] = torch.where(row, torch.cat((pos, quat), -1), qpos[:, q])
    qvel[:, v] = torch.where(row, torch.cat((linvel, spin), -1), qvel[:, v])
    return Move(mask if onto is None else mask | onto.mask, qpos, qvel)


def place_athlete(
    view: View,
    mask: Tensor,
    agent: int,
    x: Tensor,
    y: Tensor,
    yaw: Tensor,
    onto: Move | None = None,
) -> Move:
    """Puts an athlete on its feet, at rest in its start pose, where ``mask`` (N,) is true: at
    ``x``, ``y`` (N,), facing ``yaw`` (N,) about +z (rad). ``onto``: what else moves."""
    scene = view.physics.scene
    q, v = scene.agent_qpos(agent), scene.agent_qvel(agent)
    qpos, qvel = _changed(view, onto)
    pose = constant(scene.start_qpos[q], x.device)
    zero = torch.zeros_like(x)
    root = torch.stack(
        (x, y, zero + pose[2], (0.5 * yaw).cos(), zero, zero, (0.5 * yaw).sin()), dim=-1
    )
    standing = torch.cat((root, pose[7:].expand(len(x), -1)), -1)
    row = mask[:, None]
    qpos[:, q] = torch.where(row, standing, qpos[:, q])
    qvel[:, v] = qvel[:, v].masked_fill(row, 0.0)
    return Move(mask if onto is None else mask | onto.mask, qpos, qvel)


@cache
def constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    """A small constant on a device, made once: making it in a step would wait for the device."""
    return torch.tensor(values, device=device)


def progress(before: Tensor, now: Tensor, goal: Tensor) -> Tensor:
    """(...) metres gained on ``goal`` since the last step: d(before, goal) - d(now, goal)."""
    was, now = length(torch.stack((before, now)) - goal).unbind()
    return was - now


def squared(v: Tensor) -> Tensor:
    """(...) squared length of vectors (..., 3)."""
    x, y, z = v.unbind(-1)
    return torch.addcmul(x * x, y, y).addcmul_(z, z)


def length(v: Tensor) -> Tensor:
    """(...) Euclidean length of vectors (..., 3); quicker than torch's norm on a CPU."""
    return squared(v).sqrt_()


def clamp01(x: Tensor) -> Tensor:
    """x limited to [0, 1]."""
    return x.clamp(0.0, 1.0)


def nan_where(mask: Tensor, value: Tensor) -> Tensor:
    """``value`` with NaN where ``mask`` is true: an undefined metric."""
    return value.masked_fill(mask, torch.nan)
