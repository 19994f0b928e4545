"""Where an athlete's links are and how they move, from its joints, for many worlds at once.

MuJoCo computes the links of the state *before* a step. Asking it for those of the state after
costs a fifth of a control step, since it computes inertias and contacts along the way; this costs
a twentieth. Formulas: every link hangs on three hinges, ``R_parent_link = Rx Ry Rz`` (``body.py``);
positions, attitudes and velocities are summed up from the root (Featherstone 2008, section 5.3).

Arrays are float32 with the components first and the worlds last, positions relative to the root,
so that rounding is 1e-7 m wherever the athlete is.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from sports.humanoid.body import Body
from sports.humanoid.mjcf import body_name
from sports.physics.vectors import cross, rotation

# The product of quaternions a b is the sum over k of a[k] * c[_PART[k]], where c is (b, -b).
_PART = np.array(((0, 1, 2, 3), (5, 0, 7, 2), (6, 3, 0, 5), (7, 6, 1, 0)))


@dataclass(frozen=True)
class Pose:
    """The links of n athletes."""

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
        self._parent = body.parents()[1:]
        ids = np.array([model.body(body_name(agent, name)).id for name in body.link_names])
        self._offset = _columns(model.body_pos[ids[1:]])
        self._center = _columns(model.body_ipos[ids])
        mass = model.body_mass[ids]
        self._share = (mass / mass.sum()).astype(np.float32)
        self._root_mass = np.sqrt(mass).astype(np.float32)[:, None]
        # A link's second moment of mass about its centre is S = s + F F^T with s its least
        # eigenvalue and F (3, 2); its inertia is trace(S) - S.
        half = model.body_inertia[ids].sum(1, keepdims=True) / 2
        moments = half - model.body_inertia[ids]
        least = moments.min(1, keepdims=True)
        axes = np.empty((len(ids), 9))
        for k, i in enumerate(ids):
            mujoco.mju_quat2Mat(axes[k], model.body_iquat[i])
        factor = axes.reshape(-1, 3, 3) * np.sqrt(moments - least)[:, None]
        wide = np.argsort(moments, axis=1)[:, None, 1:]
        factor = np.take_along_axis(factor, np.repeat(wide, 3, axis=1), axis=2)
        self._factor = np.ascontiguousarray(np.moveaxis(factor, 0, 2), np.float32)
        self._inertia = (half - least)[:, 0].astype(np.float32)
        self._least = np.float32(least.sum())

    def pose(self, qpos: np.ndarray, qvel: np.ndarray, out: Pose) -> None:
        """Of the athlete's qpos (7 + 3 (B - 1), n) and qvel (6 + 3 (B - 1), n), float32."""
        parent, n = self._parent, qpos.shape[1]
        half = 0.5 * qpos[7:].reshape(-1, 3, n).swapaxes(0, 1)
        rate = qvel[6:].reshape(-1, 3, n).swapaxes(0, 1)
        (sa, sb, sc), (ca, cb, cc) = np.sin(half), np.cos(half)
        cb_cc, sb_sc, sb_cc, cb_sc = cb * cc, sb * sc, sb * cc, cb * sc
        turn = np.empty((8, len(parent), n), np.float32)  # Rx Ry Rz of the joints, and the negative
        np.subtract(ca * cb_cc, sa * sb_sc, out=turn[0])
        np.add(sa * cb_cc, ca * sb_sc, out=turn[1])
        np.subtract(ca * sb_cc, sa * cb_sc, out=turn[2])
        np.add(ca * cb_sc, sa * sb_cc, out=turn[3])
        np.negative(turn[:4], out=turn[4:])
        factors, quat = turn[_PART], out.quat
        np.divide(qpos[3:7], np.sqrt((qpos[3:7] * qpos[3:7]).sum(0)), out=quat[:, 0])
        for i, j in enumerate(parent):
            np.einsum("kn,kmn->mn", quat[:, j], factors[:, :, i], out=quat[:, i + 1])

        rot = rotation(quat, out.rot)
        base, own = rot[:, :, parent], rot[:, :, 1:]  # of the links' parents, and their own
        parts = np.empty((6, len(parent), n), np.float32)
        arm, about = parts[:3], parts[3:]
        np.einsum("ijbn,jb->ibn", base, self._offset, out=arm)
        # Hinge axes: x of the parent, z of the link, and between them y turned back about z.
        np.multiply(base[:, 0], rate[0], out=about)
        about += own[:, 0] * (2.0 * sc * cc * rate[1])
        about += own[:, 1] * ((cc * cc - sc * sc) * rate[1])
        about += own[:, 2] * rate[2]

        pos, spin, velocity = out.pos, out.spin, out.velocity
        pos[:, 0], velocity[:, 0] = 0.0, qvel[:3]
        np.einsum("ijn,jn->in", rot[:, :, 0], qvel[3:6], out=spin[:, 0])
        self._sum_up(pos, arm)
        self._sum_up(spin, about)
        self._sum_up(velocity, cross(spin[:, parent], arm))

    def whole(self, pose: Pose) -> Whole:
        """Mass properties and momentum of poses."""
        rot, spin = pose.rot, pose.spin
        links, n = spin.shape[1:]
        # Second moments of the whole: those of the links and of points at their centres.
        moments = np.empty((3, 3, links, n), np.float32)
        factor, center = moments[:, :2], moments[:, 2]
        np.einsum("ijbn,jkb->ikbn", rot, self._factor, out=factor)  # R F
        arm = np.einsum("ijbn,jb->ibn", rot, self._center)
        np.add(pose.pos, arm, out=center)
        velocity = cross(spin, arm)
        velocity += pose.velocity
        com, mean = (np.einsum("b,ibn->in", self._share, v) for v in (center, velocity))
        center -= com[:, None]
        velocity -= mean[:, None]
        center *= self._root_mass
        velocity *= self._root_mass
        angular = cross(center, velocity).sum(1)
        angular += np.einsum("b,ibn->in", self._inertia, spin)
        angular -= np.einsum("ikbn,kbn->in", factor, np.einsum("ikbn,ibn->kbn", factor, spin))
        x, y, z = moments.reshape(3, -1, n)
        xx, yy, zz = (np.einsum("kn,kn->n", v, v) + self._least for v in (x, y, z))
        xy, xz, yz = (np.einsum("kn,kn->n", a, b) for a, b in ((x, y), (x, z), (y, z)))
        return Whole(np.stack((yy + zz, xx + zz, xx + yy, -xy, -xz, -yz)), angular, mean, com)

    def _sum_up(self, total: np.ndarray, part: np.ndarray) -> None:
        """Adds to each link's ``part`` (k, B - 1, n) the ``total`` (k, B, n) of its parent."""
        for i, j in enumerate(self._parent):
            np.add(total[:, j], part[:, i], out=total[:, i + 1])


def _columns(values: np.ndarray) -> np.ndarray:
    """(3, B) float32 of (B, 3)."""
    return np.array(values.T, np.float32, order="C")
