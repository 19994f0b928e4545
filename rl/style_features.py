"""What a discriminator of motion sees: features of a posture, and windows of demonstrations.

One function of (qpos, qvel) serves the agent, whose state is the engine's, and the demonstrations,
whose velocities are those stored in the clip. Nothing is differentiated here: a difference quotient
on one side only would tell the two apart at once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sports import quaternion
from sports.frames import Heading
from sports.humanoid.body import Body, is_finger
from warmstart.bank import Window
from warmstart.clip import Clip

KEY_LINKS = ("Ankle", "Toe", "Wrist", "Hand")
"""Links of each side whose place is a feature; SMPL-X, which has no hand, shows a knuckle."""
KNUCKLE = "Middle1"


def key_links(body: Body) -> list[str]:
    """Names of the links whose place is a feature, those of the left side first."""
    have = body.link_names
    names = []
    for side in ("L_", "R_"):
        names += [side + n for n in KEY_LINKS if side + n in have]
        if side + "Hand" not in have and side + KNUCKLE in have:
            names.append(side + KNUCKLE)
    return names


def hinge_matrices(angles: Tensor) -> Tensor:
    """(..., 3, 3) rotation Rx(a) Ry(b) Rz(c) of a joint's hinges (..., 3) = a, b, c (rad)."""
    ca, cb, cc = angles.cos().unbind(-1)
    sa, sb, sc = angles.sin().unbind(-1)
    rows = (
        cb * cc,
        -cb * sc,
        sb,
        ca * sc + sa * sb * cc,
        ca * cc - sa * sb * sc,
        -sa * cb,
        sa * sc - ca * sb * cc,
        sa * cc + ca * sb * sc,
        ca * cb,
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


class StyleFeatures:
    """Features of one athlete's state: where it is and which way it faces do not matter.

    In order, all vectors in the heading frame (sports.frames): root attitude in 6-D; linear and
    angular velocity of the root (m/s, rad/s); rotation of each joint in 6-D (first two columns of
    its matrix, Zhou et al. 2019); hinge rates (rad/s); places of the key links from the root (m).
    The root's height is left out, as in the SMPLOlympics paper: a jump is higher than its
    demonstration. Fingers are left out too: a grasp is the task's, and the clip does not have it.
    """

    def __init__(self, body: Body, device: torch.device | str = "cpu") -> None:
        """Args:
        body: whose table gives the skeleton.
        device: where the states live.
        """
        self.num_dofs = body.num_dofs
        self.keys = key_links(body)
        parents, names = body.parents(), body.link_names
        shown = [i for i in range(1, len(names)) if not is_finger(names[i])]
        wanted: set[int] = set()
        for name in self.keys:
            i = names.index(name)
            while i > 0:
                wanted.add(i)
                i = int(parents[i])
        depth = {0: 0}
        for i in sorted(wanted):  # a parent comes before its children in the table
            depth[i] = depth[int(parents[i])] + 1
        order = sorted(depth, key=lambda i: (depth[i], i))
        place = {link: at for at, link in enumerate(order)}

        def index(values: Sequence[int]) -> Tensor:
            return torch.tensor(values, dtype=torch.long, device=device)

        self._levels = []
        for level in range(1, max(depth.values()) + 1):
            links = [i for i in order if depth[i] == level]
            parent = index([place[int(parents[i])] for i in links])
            offset = torch.tensor([body.links[i].offset for i in links], device=device)
            self._levels.append((index([i - 1 for i in links]), parent, offset[..., None]))
        self._key_places = index([place[names.index(name)] for name in self.keys])
        self._joints = index([i - 1 for i in shown])
        self.size = 12 + 9 * len(shown) + 3 * len(self.keys)
        """Features F of a frame."""

    def __call__(self, state: Tensor) -> Tensor:
        """(..., 13 + 2 n) of qpos (7 + n) and qvel (6 + n) -> (..., F) float32."""
        n = self.num_dofs
        qpos, qvel = state[..., : 7 + n], state[..., 7 + n :]
        shape = state.shape[:-1]
        root = quaternion.matrix(qpos[..., 3:7])
        heading = Heading(root)
        columns = heading.local(root.transpose(-1, -2))  # (..., 3, 3): row i is column i of R
        attitude = columns.transpose(-1, -2)
        spin = (root @ qvel[..., 3:6, None]).squeeze(-1)
        joints = hinge_matrices(qpos[..., 7:].unflatten(-1, (-1, 3)))
        # Forward kinematics level by level, from a root at the origin of the heading frame.
        rotations, places = attitude.unsqueeze(-3), torch.zeros_like(attitude[..., None, :, 0])
        for joint, parent, offset in self._levels:
            above = rotations.index_select(-3, parent)
            moved = places.index_select(-2, parent) + (above @ offset).squeeze(-1)
            turned = above @ joints.index_select(-3, joint)
            rotations = torch.cat((rotations, turned), -3)
            places = torch.cat((places, moved), -2)
        parts = (
            columns[..., :2, :],
            heading.local(qvel[..., :3]),
            heading.local(spin),
            joints.index_select(-3, self._joints)[..., :2].transpose(-1, -2),
            qvel[..., 6:].unflatten(-1, (-1, 3)).index_select(-2, self._joints),
            places.index_select(-2, self._key_places),
        )
        return torch.cat([p.reshape(*shape, -1) for p in parts], -1)


class Athletes:
    """The athletes of an environment as a source of style features; every agent is one."""

    def __init__(self, env: Any, device: torch.device | str) -> None:
        """Args:
        env: sports.env.Env; its snapshots are switched on, for the states before a reset.
        device: of the learner.
        """
        env.keep_snapshot = True
        self.env, self.features = env, StyleFeatures(env.physics.scene.body, device)
        self.state_size = 13 + 2 * self.features.num_dofs

    def state(self) -> Tensor:
        """(M, 13 + 2 n) qpos and qvel of every athlete after the last step, before any reset."""
        scene, last = self.env.physics.scene, self.env.final_snapshot
        each = [
            torch.cat(
                (last["qpos"][:, scene.agent_qpos(a)], last["qvel"][:, scene.agent_qvel(a)]), -1
            )
            for a in range(self.env.num_agents)
        ]
        return torch.stack(each, 1).flatten(0, 1)


@dataclass(frozen=True)
class Demonstrations:
    """States of demonstrations, one clip after the other, and where windows may begin."""

    states: Tensor
    """(D, S)"""
    begins: Tensor
    """(W,) long: a window is so many rows of ``states`` from here on."""
    optimised: Tensor
    """(W,) bool: the window is of an optimised motion, not of a captured one."""


def load_demonstrations(
    paths: Sequence[Path], env: Any, frames: int, mirror: bool
) -> Demonstrations:
    """Windows of ``frames`` control steps of clip files, at the task's control rate.

    Args:
        paths: npz clips, optimised or captured.
        env: environment of the task, for its body and rate.
        frames: length H of a window.
        mirror: add each clip's mirror image.

    What comes after a clip's landing is left out, as in the starts of episodes: there it only
    falls. Raises ValueError, a sentence, without clips, for one of another body and for one with
    fewer frames than a window.
    """
    if not paths:
        raise ValueError("--algo amp learns from demonstrations: give npz clips with --clips")
    scene = env.physics.scene
    rate = 1.0 / scene.control_timestep
    states, begins, optimised, at = [], [], [], 0
    for path in paths:
        clip = Clip.load(path)
        if clip.body != scene.body.name:
            raise ValueError(
                f"{path} is a motion of body '{clip.body}', but task '{env.task.name}' has body "
                f"'{scene.body.name}': give clips of that body"
            )
        clip = _until_landing(clip)
        count = round(clip.duration * rate, 6)
        if count + 1 < frames:
            raise ValueError(
                f"{path} is too short for a window of {frames} frames: it has {int(count) + 1} at "
                f"{rate:g} frames a second; leave it out, or give a smaller --amp.frames"
            )
        clip = clip.resample(rate)
        for shown in (clip, clip.mirrored()) if mirror else (clip,):
            states.append(np.concatenate((shown.qpos, shown.qvel), -1))
            windows = len(shown.qpos) - frames + 1
            begins.append(at + np.arange(windows))
            optimised.append(np.full(windows, "problem" in clip.meta))
            at += len(shown.qpos)
    return Demonstrations(
        states=torch.tensor(np.concatenate(states), dtype=torch.float32),
        begins=torch.tensor(np.concatenate(begins)),
        optimised=torch.tensor(np.concatenate(optimised)),
    )


def _until_landing(clip: Clip) -> Clip:
    rows = Window().rows(clip)
    if len(rows) < 2:
        return dataclasses.replace(clip, qpos=clip.qpos[:2], qvel=clip.qvel[:2], ctrl=None)
    return clip.cut(rows[0] / clip.fps, rows[-1] / clip.fps)
