"""Reference motions as flat tensors: every frame of every clip is a row, mirrored ones behind.

A frame's row holds where all links are, how they move, and the hinge angles. Velocities are the
library's where it has them; else they come from differences of rotations along the tree of links,
never of hinge angles: those wrap.
Each clip is followed by one frame more, its last moved on at its last velocities, so that every
frame has a next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sports import quaternion
from sports.humanoid.body import Body, load_body
from sports.physics.base import Geometry
from warmstart import rotation
from warmstart.clip import Clip
from warmstart.library import FPS, Library

DOWN = 0.015
"""A link whose lowest point is below this (m) and slower than ``REST`` is on the ground ..."""
REST = 0.3
"""m/s"""
OFF = 0.05
"""... and one above this height (m) is not; in between nobody can say."""


class Reference(NamedTuple):
    """Where links are in some frames (N); world frame, m, m/s, rad/s."""

    pos: Tensor
    """(N, B, 3) origins."""
    rot: Tensor
    """(N, B, 3, 3) R_WB."""
    linvel: Tensor
    """(N, B, 3) of the origins."""
    angvel: Tensor
    """(N, B, 3)"""


@dataclass(frozen=True)
class LinkMotion:
    """Kinematics of a path of T frames, numpy float64."""

    qpos: np.ndarray
    """(T, 7 + n)"""
    qvel: np.ndarray
    """(T, 6 + n)"""
    pos: np.ndarray
    """(T, B, 3)"""
    quat: np.ndarray
    """(T, B, 4)"""
    linvel: np.ndarray
    """(T, B, 3)"""
    angvel: np.ndarray
    """(T, B, 3) world frame."""


def link_motion(
    body: Body, qpos: np.ndarray, fps: float, qvel: np.ndarray | None = None
) -> LinkMotion:
    """Links of a path (T, 7 + n), T >= 2, and of one frame more behind it: (T + 1, ...).

    Velocities are those of ``qvel`` (T, 6 + n) or, without it, central differences of the root's
    place and of each joint's rotation, summed up along the tree:
    v_child = v_parent + w_parent x arm (Featherstone 2008, section 5.3).
    """
    angles = qpos[:, 7:].reshape(len(qpos), -1, 3)
    if qvel is None:
        spin = rotation.spin(rotation.from_hinges(angles), fps)
        rates = rotation.hinge_rates(angles, spin).reshape(len(qpos), -1)
        linear = np.gradient(qpos[:, :3], 1.0 / fps, axis=0, edge_order=2 if len(qpos) > 2 else 1)
        qvel = np.concatenate([linear, rotation.spin(qpos[:, 3:7], fps), rates], axis=1)
    else:
        spin = rotation.hinge_spin(angles, qvel[:, 6:].reshape(len(qpos), -1, 3))
    linear, root_spin, rates = qvel[:, :3], qvel[:, 3:6], qvel[:, 6:]
    turned = rotation.multiply(qpos[-1, 3:7], rotation.exp(root_spin[-1] / fps))
    onward = np.concatenate(
        [qpos[-1, :3] + linear[-1] / fps, turned, qpos[-1, 7:] + rates[-1] / fps]
    )
    qpos, qvel = np.vstack([qpos, onward]), np.vstack([qvel, qvel[-1]])
    spin = np.concatenate([spin, spin[-1:]])

    local = rotation.from_hinges(qpos[:, 7:].reshape(len(qpos), -1, 3))
    shape = (len(qpos), body.num_links)
    pos, quat = np.empty((*shape, 3)), np.empty((*shape, 4))
    linvel, angvel = np.empty((*shape, 3)), np.empty((*shape, 3))
    for i, parent in enumerate(body.parents()):
        if parent < 0:
            pos[:, i], quat[:, i] = qpos[:, :3], qpos[:, 3:7]
            linvel[:, i] = qvel[:, :3]
            angvel[:, i] = rotation.rotate(quat[:, i], qvel[:, 3:6])
            continue
        arm = rotation.rotate(quat[:, parent], np.asarray(body.links[i].offset))
        pos[:, i] = pos[:, parent] + arm
        quat[:, i] = rotation.multiply(quat[:, parent], local[:, i - 1])
        linvel[:, i] = linvel[:, parent] + np.cross(angvel[:, parent], arm)
        angvel[:, i] = angvel[:, parent] + rotation.rotate(quat[:, i], spin[:, i - 1])
    return LinkMotion(qpos, qvel, pos, quat, linvel, angvel)


class MotionTables:
    """All frames of a library on a device: F of them, then the same F seen in a mirror."""

    def __init__(self, library: Library, device: torch.device | str) -> None:
        self.library, self.device = library, torch.device(device)
        body = load_body(library.body)
        geometry = Geometry(body, "cpu")
        self.num_links, self.num_dofs = body.num_links, body.num_dofs
        plain, seen = [], []
        for c in range(len(library.lengths)):
            path, rates = library.qpos(c), library.qvel(c)
            known = np.zeros((len(path), 6 + body.num_dofs)) if rates is None else rates
            mirror = Clip(fps=FPS, body=body.name, qpos=path, qvel=known).mirrored()
            turned = None if rates is None else mirror.qvel
            plain.append(_rows(link_motion(body, path, FPS, rates), geometry))
            seen.append(_rows(link_motion(body, mirror.qpos, FPS, turned), geometry))
        self._rows = torch.cat(plain + seen).to(self.device)
        """(2 F, W) float32, the fields of ``_at`` side by side."""
        lengths = library.lengths
        counts = lengths + 1
        first = np.cumsum(counts) - counts
        self.num_frames = int(counts.sum())
        """F, the frames behind the clips counted in."""
        self.first = torch.tensor(first, device=self.device)
        """(C,) first frame of each clip."""
        ends = np.repeat(first + lengths - 1, counts)
        last = np.concatenate([ends, ends + self.num_frames])
        self.last = torch.tensor(last, device=self.device)
        """(2 F,) last frame of the clip of each frame."""
        self.lengths = torch.tensor(lengths, device=self.device)
        """(C,) frames of each clip."""
        b, n = self.num_links, self.num_dofs
        widths = [3 * b, 4 * b, 3 * b, 3 * b, 7, 6, n, n, 1, b]
        ends = np.cumsum(widths)
        self._at = [slice(int(e - w), int(e)) for e, w in zip(ends, widths)]

    def at(self, frame: Tensor) -> Reference:
        """The links in frames (N,)."""
        rows = self._rows.index_select(0, frame)
        pos, quat, linvel, angvel = (rows[:, s] for s in self._at[:4])
        return Reference(
            pos.unflatten(1, (-1, 3)),
            quaternion.matrix(quat.unflatten(1, (-1, 4))),
            linvel.unflatten(1, (-1, 3)),
            angvel.unflatten(1, (-1, 3)),
        )

    def joints(self, frame: Tensor) -> Tensor:
        """(N, n) hinge angles (rad) in frames (N,), within half a turn."""
        return self._rows[:, self._at[6]].index_select(0, frame)

    def rates(self, frame: Tensor) -> Tensor:
        """(N, n) hinge rates (rad/s) in frames (N,)."""
        return self._rows[:, self._at[7]].index_select(0, frame)

    def contact(self, frame: Tensor) -> Tensor:
        """(N, B) in frames (N,): 1 for links on the ground, -1 for links off it, 0 where the
        motion leaves it open."""
        return self._rows[:, self._at[9]].index_select(0, frame)

    def state(self, frame: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 7 + n) qpos and (N, 6 + n) qvel to start from in frames (N,).

        The athlete is lifted by as much as it reaches below the ground.
        """
        rows = self._rows.index_select(0, frame)
        root, spin, joints, rates, lift = (rows[:, s] for s in self._at[4:9])
        up = torch.nn.functional.pad(lift, (2, 4))
        return torch.cat((root + up, joints), 1), torch.cat((spin, rates), 1)


def _rows(motion: LinkMotion, geometry: Geometry) -> Tensor:
    """(T, W) float32 of a clip."""
    frames = len(motion.qpos)
    angles = motion.qpos[:, 7:]
    wrapped = angles - 2 * np.pi * np.round(angles / (2 * np.pi))
    pos, quat = (torch.tensor(x, dtype=torch.float32) for x in (motion.pos, motion.quat))
    down = torch.tensor([0.0, 0.0, -1.0])
    height = -geometry.extent(pos, quat, down)  # (T, B) of the lowest point
    slow = torch.tensor(np.linalg.norm(motion.linvel, axis=-1)) < REST
    contact = ((height < DOWN) & slow).float() - (height > OFF).float()
    lift = (-height.amin(-1, keepdim=True)).clamp(min=0.0)
    parts = [
        motion.pos,
        motion.quat,
        motion.linvel,
        motion.angvel,
        motion.qpos[:, :7],
        motion.qvel[:, :6],
        wrapped,
        motion.qvel[:, 6:],
    ]
    flat = [torch.tensor(p.reshape(frames, -1), dtype=torch.float32) for p in parts]
    return torch.cat([*flat, lift, contact], dim=1)
