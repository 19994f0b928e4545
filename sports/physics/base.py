"""What every engine offers: one protocol of batched torch tensors. Task code sees nothing else.

Shapes: N worlds, A agents, B links, P contact pairs, O free objects, M mocap objects.
World frame, z up; quaternions (w, x, y, z); m, kg, s, rad, N. Tensors are float32 on
``device``. They are valid after ``step`` and ``reset`` and overwritten in place by the next
call: keep a clone of what must outlive it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from sports import quaternion
from sports.humanoid.body import Body, Shape, support_points
from sports.scene import Scene


@dataclass
class PhysicsState:
    """Everything that decides a world's future, for resets and warm starts."""

    qpos: Tensor
    """(N, nq)"""
    qvel: Tensor
    """(N, nv); a root's angular velocity in its own frame, as in MuJoCo."""
    mocap_pos: Tensor
    """(N, M, 3) positions of the movable fixtures."""
    wave_phase: Tensor | None = None
    """(N, 2) as ``Physics.wave_phase``; None to leave them as they are."""

    def clone(self) -> PhysicsState:
        return PhysicsState(**{k: v.clone() for k, v in vars(self).items() if v is not None})


class Physics(Protocol):
    """A batch of worlds of one scene on one engine."""

    engine: str
    """``mujoco``, ``warp`` or ``drake``."""
    scene: Scene
    num_worlds: int
    device: torch.device
    geometry: Geometry
    """Support points of the scene's body."""

    qpos: Tensor
    """(N, nq)"""
    qvel: Tensor
    """(N, nv)"""
    mocap_pos: Tensor
    """(N, M, 3)"""
    body_pos: Tensor
    """(N, A, B, 3) link origins p_WB."""
    body_quat: Tensor
    """(N, A, B, 4) link rotations R_WB."""
    body_rot: Tensor
    """(N, A, B, 3, 3) the same as matrices."""
    felt: Tensor | None
    """(N, A, 15 B - 2) proprioception of ``sports.frames``, where the engine knows a quick way."""
    whole: Tensor | None
    """(N, A, 6) centres of mass of the athletes (m) and their velocities (m/s), likewise."""
    body_linvel: Tensor
    """(N, A, B, 3) velocity of the link origins, world frame."""
    body_angvel: Tensor
    """(N, A, B, 3) angular velocity w_WB, world frame."""
    ground_force: Tensor
    """(N, A, B, 3) force of the ground on each link, world frame, in that substep of the last
    control step in which it was largest; zero where the link never touched."""
    link_force: Tensor
    """(N, A, B, 3) the same of everything but the ground, where ``Scene.link_contacts`` asks for
    it; else no worlds (0, A, B, 3)."""
    pair_force: Tensor
    """(N, P) largest net contact force over the substeps between the scene's named pairs."""
    object_pos: Tensor
    """(N, O, 3) origins of the free objects."""
    object_quat: Tensor
    """(N, O, 4)"""
    object_linvel: Tensor
    """(N, O, 3) world frame."""
    object_angvel: Tensor
    """(N, O, 3) world frame."""
    ball_hits: Tensor
    """(N, S) int32, impacts of the ball of the ball law on each of ``Scene.surfaces`` in the last
    control step. A ball that rolls has one in every substep, one at rest has none."""
    ball_hit_time: Tensor
    """(N, S) seconds from the beginning of the control step to the first of them, else inf."""
    ball_hit_pos: Tensor
    """(N, S, 3) centre of the ball at the first of them, else zero."""
    wave_phase: Tensor
    """(N, 2) phases a and b of the waves of the scene (rad); set by a reset."""
    bad: Tensor
    """(N,) bool: the last step left NaN or absurd numbers, or overflowed a buffer, in this
    world. The caller must reset it; until then its tensors are meaningless."""
    nan_worlds: int | Tensor
    """Worlds found bad for numbers so far (a device tensor where reading it would wait)."""
    overflow: int | Tensor
    """Worlds whose constraint or contact buffers overflowed so far."""

    def step(self, ctrl: Tensor) -> None:
        """Advances one control step with PD targets ``ctrl`` (N, nu), rad, held constant."""
        ...

    def overflows(self) -> dict[str, int]:
        """Which buffers overflowed so far, by their names in the engine, and in how many worlds'
        control steps; waits for the device. Only ``warp`` has buffers of fixed sizes."""
        ...

    def reset(self, mask: Tensor, state: PhysicsState) -> None:
        """Puts the worlds where ``mask`` (N,) is true into their rows of ``state``.

        Kinematic tensors are current afterwards in every world; contact forces are zero in the
        reset ones.
        """
        ...

    def move(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Changes states in mid-episode where ``mask`` (N,) is true, to rows of ``qpos`` (N, nq)
        and ``qvel`` (N, nv). What a row leaves as it is goes on undisturbed; kinematic tensors are
        current afterwards, contact forces remain those of the last step."""
        ...

    def extent(self, direction: Tensor) -> Tensor:
        """(N, A, B) furthest reach of each link's shapes along unit ``direction`` (3,), m."""
        ...

    def close(self) -> None:
        """Frees threads and device memory."""
        ...


def default_state(scene: Scene, num_worlds: int, device: torch.device | str) -> PhysicsState:
    """The scene's start pose at rest, repeated over the worlds."""

    def rows(values: np.ndarray) -> Tensor:
        row = torch.as_tensor(values, dtype=torch.float32, device=device)
        return row.expand(num_worlds, *row.shape).clone()

    return PhysicsState(
        qpos=rows(scene.default_qpos()),
        qvel=torch.zeros(num_worlds, scene.nv, device=device),
        mocap_pos=rows(scene.default_mocap_pos()),
        wave_phase=torch.zeros(num_worlds, 2, device=device) if scene.has_waves else None,
    )


def _middle(shape: Shape) -> np.ndarray:
    center = np.asarray(shape.center, dtype=float)
    return center if shape.end is None else (center + np.asarray(shape.end)) / 2


class Marks(NamedTuple):
    """Where N athletes meet the ground along the x axis (m)."""

    standing: Tensor
    """(N, B) bool, links of which a ball is near the ground."""
    rear: Tensor
    """(N, B) smallest x of each link, near the ground or not."""
    nearest: Tensor
    """(N,) smallest x of the points near the ground; inf where there is none."""
    furthest: Tensor
    """(N,) largest x of them; -inf where there is none."""


class Geometry:
    """Support points of the body's links: where a link ends in a direction, where it touches.

    The same table on every engine, so that lengths and clearances do not depend on one.
    """

    def __init__(self, body: Body, device: torch.device | str) -> None:
        points, radii, owner = [], [], []
        for i, link in enumerate(body.links):
            for shape in link.shapes:
                for point, radius in support_points(shape):
                    points.append(point)
                    radii.append(radius)
                    owner.append(i)
        self.num_links = body.num_links
        self.points = torch.tensor(np.array(points), dtype=torch.float32, device=device)
        """(K, 3) in the owner link's frame."""
        self.radii = torch.tensor(radii, dtype=torch.float32, device=device)
        self.owner = torch.tensor(owner, device=device)
        """(K,) link index."""
        counts = np.bincount(owner, minlength=body.num_links)
        starts = np.concatenate(([0], np.cumsum(counts)[:-1]))
        # Padded per link, so that a reduction over a link's points is one gather and one max.
        padded = starts[:, None] + np.minimum(np.arange(counts.max()), counts[:, None] - 1)
        self.padded = torch.tensor(padded, device=device)
        mass = np.array([sum(s.mass for s in link.shapes) for link in body.links])
        moment = np.array([sum(s.mass * _middle(s) for s in link.shapes) for link in body.links])
        self.mass = torch.tensor(mass, dtype=torch.float32, device=device)
        """(B,) kg"""
        center = moment / mass[:, None]
        self.center = torch.tensor(center, dtype=torch.float32, device=device)
        """(B, 3) centre of mass of each link in its own frame (m)."""

    @cached_property
    def _padded_points(self) -> Tensor:
        return self.points[self.padded]  # (B, K', 3)

    @cached_property
    def _point_columns(self) -> tuple[Tensor, Tensor, Tensor]:
        x, y, z = self._padded_points.permute(2, 1, 0)[..., None].contiguous()
        return x, y, z

    @cached_property
    def _padded_radii(self) -> Tensor:
        return self.radii[self.padded]

    def _along(self, body_pos: Tensor, rotation: Tensor, axis: int) -> Tensor:
        """(K', B, N) coordinate of the padded points along a world axis."""
        x, y, z = rotation[:, :, axis].permute(2, 1, 0)  # (B, N) each
        px, py, pz = self._point_columns  # (K', B, 1) each
        return torch.addcmul(body_pos[:, :, axis].T, x, px).addcmul_(y, py).addcmul_(z, pz)

    def marks(self, body_pos: Tensor, rotation: Tensor, below: float) -> Marks:
        """Where athletes meet the ground: with balls that reach ``below`` (m) a height.
        ``body_pos`` (N, B, 3) and ``rotation`` R_WB (N, B, 3, 3) are the links'."""
        x, z = (self._along(body_pos, rotation, axis) for axis in (0, 2))
        radii = self._padded_radii.T[..., None]
        clearance = z - radii
        above = clearance >= below
        return Marks(
            standing=(clearance.amin(0) < below).T,
            rear=(x - radii).amin(0).T,
            nearest=torch.where(above, torch.inf, x).amin((0, 1)),
            furthest=torch.where(above, -torch.inf, x).amax((0, 1)),
        )

    def lowest_near(self, body_pos: Tensor, rotation: Tensor, x: float, reach: float) -> Tensor:
        """(N,) height (m) of the lowest of the balls whose centres are less than ``reach`` from a
        plane across the x axis; inf where there is none. The links as for ``marks``."""
        along, z = (self._along(body_pos, rotation, axis) for axis in (0, 2))
        aside = (along - x).abs() >= reach
        return torch.where(aside, torch.inf, z - self._padded_radii.T[..., None]).amin((0, 1))

    def world_points(self, body_pos: Tensor, body_quat: Tensor) -> Tensor:
        """(..., K, 3) support points in the world; the balls around them have ``radii``."""
        pos, quat = body_pos[..., self.owner, :], body_quat[..., self.owner, :]
        return pos + quaternion.rotate(quat, self.points)

    def center_of_mass(self, physics: Physics, agent: int) -> tuple[Tensor, Tensor]:
        """(N, 3) centre of mass of an athlete (m) and (N, 3) its velocity (m/s), world frame."""
        if physics.whole is not None:
            whole = physics.whole[:, agent]
            return whole[:, :3], whole[:, 3:]
        # Components first, worlds last.
        x, y, z = physics.body_rot[:, agent].permute(3, 2, 1, 0)  # columns, (3, B, N)
        cx, cy, cz = self.center.T[..., None]  # (B, 1)
        arm = torch.addcmul(x * cx, y, cy).addcmul_(z, cz)
        pos, linear, (p, q, r) = (
            v[:, agent].permute(2, 1, 0)
            for v in (physics.body_pos, physics.body_linvel, physics.body_angvel)
        )
        a, b, c = arm
        turning = torch.stack((q * c - r * b, r * a - p * c, p * b - q * a))
        share = (self.mass / self.mass.sum())[:, None]
        position, velocity = ((share * v).sum(1).T for v in (pos + arm, linear + turning))
        return position, velocity

    def extent(self, body_pos: Tensor, body_quat: Tensor, direction: Tensor) -> Tensor:
        """(..., B) furthest reach along unit ``direction`` (3,) of each link, m."""
        local = quaternion.rotate(quaternion.conjugate(body_quat), direction)  # (..., B, 3)
        reach = torch.einsum("...bi,bki->...bk", local, self._padded_points) + self._padded_radii
        return (body_pos * direction).sum(-1) + reach.amax(-1)


GRAVITY = 9.81
"""m/s^2, along -z"""
NO_FORCE = 0.1
"""A root force (N, N m) below this is rounding of self-contacts: the athlete touches nothing."""
SPEED_LIMIT = 2000.0
"""A generalised velocity above this (m/s or rad/s) means that a world has diverged. A bar hit at
12 m/s spins about its thin axis at 400 rad/s."""


def diverged(qpos: Tensor, qvel: Tensor) -> Tensor:
    """(N,) worlds whose numbers are not finite or beyond any athlete or bar."""
    # NaN is the largest of all, and not below any bound.
    furthest, fastest = qpos.abs().amax(-1), qvel.abs().amax(-1)
    return ~((furthest < torch.inf) & (fastest < SPEED_LIMIT))
