"""Where an athlete's links are and how they move, from its joints, for many worlds at once.

MuJoCo computes the links of the state *before* a step. Asking it for those of the state after
costs a fifth of a control step, since it computes inertias and contacts along the way; this costs
a twentieth. Formulas: every link hangs on three hinges, ``R_parent_link = Rx Ry Rz`` (``body.py``);
positions, attitudes and velocities are summed up from the root (Featherstone 2008, section 5.3).

Arrays are float32 with the components first and the worlds last, positions relative to the root,
so that rounding is 1e-7 m wherever the athlete is.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import mujoco
import numpy as np

from sports.humanoid.body import Body
from sports.humanoid.mjcf import body_name
from sports.physics.vectors import cross, rotation

# The product of quaternions a b is the sum over k of a[k] * _SIGN[k] * b[_PART[k]].
_PART = np.array(((0, 1, 2, 3), (1, 0, 3, 2), (2, 3, 0, 1), (3, 2, 1, 0)))
_SIGN = np.array(((1, 1, 1, 1), (-1, 1, -1, 1), (-1, 1, 1, -1), (-1, -1, 1, 1)), np.float32)


@dataclass(frozen=True)
class Pose:
    """The links of n athletes, level by level of the tree: see ``Kinematics.table``."""

    quat: np.ndarray
    """(4, B, n)"""
    rot: np.ndarray
    """(3, 3, B, n) R_WB"""
    pos: np.ndarray
    """(3, B, n) origins, from the root's (m)."""
    spin: np.ndarray
    """(3, B, n) angular velocities, world frame (rad/s)."""
    velocity: np.ndarray
    """(3, B, n) of the origins (m/s)."""


@dataclass(frozen=True)
class Whole:
    """n athletes as one body each."""

    inertia: np.ndarray
    """(6, n) about the centre of mass: xx, yy, zz, xy, xz, yz (kg m^2)."""
    angular: np.ndarray
    """(3, n) angular momentum about the centre of mass (N m s)."""
    velocity: np.ndarray
    """(3, n) of the centre of mass (m/s)."""
    com: np.ndarray
    """(3, n) from the root (m)."""


class Kinematics:
    """The tree of one athlete of a scene."""

    def __init__(self, model: mujoco.MjModel, body: Body, agent: int = 0) -> None:
        """``model`` as ``mjcf.build_model`` makes it of a scene with that body."""
        parents = body.parents()
        depth = np.zeros(body.num_links, int)
        for i in range(1, len(depth)):
            depth[i] = depth[parents[i]] + 1
        order = np.argsort(depth, kind="stable")
        self.table = np.argsort(order)
        """(B,) where the links of the body's table are in a pose."""
        self._parent = self.table[parents[order[1:]]]
        ends = np.searchsorted(depth[order], np.arange(1, depth.max() + 2))
        self._levels = [
            (slice(a, b), slice(a - 1, b - 1), self._parent[a - 1 : b - 1])
            for a, b in itertools.pairwise(ends)
        ]
        self._joint = order[1:] - 1

        ids = np.array([model.body(body_name(agent, name)).id for name in body.link_names])[order]
        self._offset = _columns(model.body_pos[ids[1:]])
        self._center = _columns(model.body_ipos[ids])
        mass = model.body_mass[ids]
        self._share = (mass / mass.sum()).astype(np.float32)[:, None]
        self._root_mass = np.sqrt(mass).astype(np.float32)[:, None]
        # A link's second moment of mass about its centre is S = F F^T, its inertia trace(S) - S.
        half = model.body_inertia[ids].sum(1, keepdims=True) / 2
        widths = np.sqrt(np.maximum(half - model.body_inertia[ids], 0.0))
        axes = np.empty((len(ids), 9))
        for k, i in enumerate(ids):
            mujoco.mju_quat2Mat(axes[k], model.body_iquat[i])
        factor = axes.reshape(-1, 3, 3) * widths[:, None]
        self._factor = np.ascontiguousarray(np.moveaxis(factor, 0, 2)[..., None], np.float32)
        self._trace = half.astype(np.float32)

    def pose(self, qpos: np.ndarray, qvel: np.ndarray) -> Pose:
        """Of the athlete's qpos (n, 7 + 3 (B - 1)) and qvel (n, 6 + 3 (B - 1))."""
        n, links = len(qpos), len(self.table)
        angle, rate = (
            np.array(hinges.T, np.float32, order="C").reshape(-1, 3, n)[self._joint].swapaxes(0, 1)
            for hinges in (qpos[:, 7:], qvel[:, 6:])
        )
        half = 0.5 * angle
        (sa, sb, sc), (ca, cb, cc) = sin, cos = np.sin(half), np.cos(half)
        cb_cc, sb_sc, sb_cc, cb_sc = cb * cc, sb * sc, sb * cc, cb * sc
        turn = np.empty((4, links - 1, n), np.float32)  # Rx Ry Rz of the joints
        turn[0] = ca * cb_cc - sa * sb_sc
        turn[1] = sa * cb_cc + ca * sb_sc
        turn[2] = ca * sb_cc - sa * cb_sc
        turn[3] = ca * cb_sc + sa * sb_cc
        factors = turn[_PART] * _SIGN[..., None, None]
        quat = np.empty((4, links, n), np.float32)
        root = qpos[:, 3:7].T
        quat[:, 0] = root / np.sqrt((root * root).sum(0))
        for level, joints, parents in self._levels:
            products = quat[:, None, parents] * factors[:, :, joints]
            np.add.reduce(products, axis=0, out=quat[:, level])

        rot = rotation(quat)
        base, own = rot[:, :, self._parent], rot[:, :, 1:]  # of the links' parents, and their own
        parts = np.empty((6, links - 1, n), np.float32)
        arm, about = parts[:3], parts[3:]
        np.multiply(base[:, 0], self._offset[0], out=arm)
        arm += base[:, 1] * self._offset[1]
        arm += base[:, 2] * self._offset[2]
        # Hinge axes: x of the parent, z of the link, and between them y turned back about z.
        cos_z, sin_z = cos[2] * cos[2] - sin[2] * sin[2], 2.0 * sin[2] * cos[2]
        np.multiply(base[:, 0], rate[0], out=about)
        about += own[:, 0] * (sin_z * rate[1])
        about += own[:, 1] * (cos_z * rate[1])
        about += own[:, 2] * rate[2]

        sums, velocity = np.empty((6, links, n), np.float32), np.empty((3, links, n), np.float32)
        pos, spin = sums[:3], sums[3:]
        x, y, z = qvel[:, 3:6].T
        pos[:, 0] = 0.0
        spin[:, 0] = rot[:, 0, 0] * x + rot[:, 1, 0] * y + rot[:, 2, 0] * z
        velocity[:, 0] = qvel[:, :3].T
        self._sum_up(sums, parts)
        self._sum_up(velocity, cross(spin[:, self._parent], arm))
        return Pose(quat, rot, pos, spin, velocity)

    def whole(self, pose: Pose) -> Whole:
        """Mass properties and momentum of poses."""
        rot, spin = pose.rot, pose.spin
        arm = rot[:, 0] * self._center[0]
        arm += rot[:, 1] * self._center[1]
        arm += rot[:, 2] * self._center[2]
        center, velocity = pose.pos + arm, pose.velocity + cross(spin, arm)
        com, mean = (center * self._share).sum(1), (velocity * self._share).sum(1)
        center -= com[:, None]
        velocity -= mean[:, None]
        center *= self._root_mass
        velocity *= self._root_mass
        angular = cross(center, velocity).sum(1)
        factor = rot[:, 0, None] * self._factor[0]
        factor += rot[:, 1, None] * self._factor[1]
        factor += rot[:, 2, None] * self._factor[2]  # (3, 3, B, n): R F
        along = factor[0] * spin[0]
        along += factor[1] * spin[1]
        along += factor[2] * spin[2]
        angular += (self._trace * spin).sum(1)
        angular -= (factor * along).sum((1, 2))
        # Second moments of the whole: those of the links and of points at their centres.
        x, y, z = np.concatenate((factor.reshape(3, -1, len(com[0])), center), axis=1)
        xx, yy, zz = ((v * v).sum(0) for v in (x, y, z))
        xy, xz, yz = ((a * b).sum(0) for a, b in ((x, y), (x, z), (y, z)))
        return Whole(np.stack((yy + zz, xx + zz, xx + yy, -xy, -xz, -yz)), angular, mean, com)

    def _sum_up(self, total: np.ndarray, part: np.ndarray) -> None:
        """Adds to each link's ``part`` (k, B - 1, n) the ``total`` (k, B, n) of its parent."""
        for level, joints, parents in self._levels:
            np.add(total[:, parents], part[:, joints], out=total[:, level])


def _columns(values: np.ndarray) -> np.ndarray:
    """(3, B, 1) float32 of (B, 3)."""
    return np.array(values.T[..., None], np.float32, order="C")
