"""Rigid-body terms in CasADi, generated from the Drake plant.

A :class:`Tree` holds the constants that the recursion needs, read from a finalized
``MultibodyPlant`` (masses, centres of mass, inertias, joint axes and offsets, armature, damping,
effort limits). :func:`newton_euler` is the recursive Newton-Euler algorithm in link frames
(Craig, Introduction to Robotics, section 6.5; Featherstone, Rigid Body Dynamics Algorithms,
chapter 5) over symbols or numbers. Hinges held at a number cost nothing: their rotations fold
into constants, so one function serves the sagittal model and the full body alike.

Coordinates. The root carries (x, y, z, pitch, roll, yaw) with R_WB = Ry(pitch) Rx(roll)
Rz(yaw): singular only at a roll of 90 degrees, so somersaults are harmless. Generalised forces
of the root are MuJoCo's: force in W, moment about the root origin in B.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from sports.humanoid.body import Body
from sports.physics.base import GRAVITY

ROOT_COORDINATES = ("x", "y", "z", "pitch", "roll", "yaw")
_ROOT_AXES = (1, 0, 2)
_UNIT = np.eye(3)


@dataclass(frozen=True)
class Tree:
    """Constants of a humanoid, link by link, as the Drake plant holds them."""

    links: tuple[str, ...]
    parent: tuple[int, ...]
    offset: np.ndarray
    """(B, 3) origin of each link in its parent's frame (m)."""
    mass: np.ndarray
    """(B,) kg."""
    com: np.ndarray
    """(B, 3) centre of mass in the link frame (m)."""
    inertia: np.ndarray
    """(B, 3, 3) about the centre of mass, link frame (kg m^2)."""
    dofs: tuple[str, ...]
    """Hinge names in ``Body.dofs`` order; three per link but the root, intrinsic X-Y-Z."""
    armature: np.ndarray
    damping: np.ndarray
    effort: np.ndarray

    @property
    def num_dofs(self) -> int:
        return len(self.dofs)

    @property
    def total_mass(self) -> float:
        return float(self.mass.sum())

    def link(self, name: str) -> int:
        """Index of a link. Raises KeyError naming it."""
        if name not in self.links:
            raise KeyError(f"the plant has no link '{name}'")
        return self.links.index(name)

    def hinges(self, link: int) -> tuple[int, int, int]:
        """Indices in ``dofs`` of the three hinges of a link other than the root."""
        first = self.dofs.index(f"{self.links[link]}_x")
        return first, first + 1, first + 2


def tree_from_plant(plant, body: Body) -> Tree:
    """Reads a :class:`Tree` from a finalized Drake plant that holds ``body``.

    Links and joints are found by name. Raises ValueError where the plant does not have the
    structure that the recursion assumes (intrinsic X-Y-Z hinges at the link origin).
    """
    context = plant.CreateDefaultContext()
    offset = np.zeros((body.num_links, 3))
    mass = np.zeros(body.num_links)
    com = np.zeros((body.num_links, 3))
    inertia = np.zeros((body.num_links, 3, 3))
    armature, damping, effort = [], [], []
    for i, link in enumerate(body.links):
        M_BBo_B = plant.GetBodyByName(link.name).CalcSpatialInertiaInBodyFrame(context)
        mass[i], com[i] = M_BBo_B.get_mass(), M_BBo_B.get_com()
        inertia[i] = M_BBo_B.Shift(M_BBo_B.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
        if link.parent is None:
            continue
        for k, axis in enumerate("xyz"):
            name = f"{link.name}_{axis}"
            joint = plant.GetJointByName(name)
            X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
            X_CM = joint.frame_on_child().GetFixedPoseInBodyFrame()
            straight = X_PF.rotation().IsExactlyIdentity() and X_CM.IsExactlyIdentity()
            if not straight or not np.array_equal(joint.revolute_axis(), _UNIT[k]):
                raise ValueError(
                    f"joint '{name}' of the plant is not a hinge about its {axis} axis"
                )
            if k == 0:
                if joint.parent_body().name() != link.parent:
                    raise ValueError(f"joint '{name}' of the plant hangs on the wrong link")
                offset[i] = X_PF.translation()
            elif np.any(X_PF.translation()):
                raise ValueError(f"joint '{name}' of the plant is off the link origin")
            actuator = plant.GetJointActuatorByName(name)
            gear, rotor = actuator.default_gear_ratio(), actuator.default_rotor_inertia()
            armature.append(gear**2 * rotor)
            damping.append(float(joint.GetDamping(context)))
            effort.append(actuator.effort_limit())
    return Tree(
        links=body.link_names,
        parent=tuple(int(p) for p in body.parents()),
        offset=offset,
        mass=mass,
        com=com,
        inertia=inertia,
        dofs=tuple(dof.name for dof in body.dofs),
        armature=np.array(armature),
        damping=np.array(damping),
        effort=np.array(effort),
    )


@lru_cache(maxsize=8)
def load_tree(body: Body) -> Tree:
    """The :class:`Tree` of a body through its Drake plant (continuous, no ground)."""
    from sports.humanoid.drake_plant import build_plant

    return tree_from_plant(build_plant(body, time_step=0.0, ground=False).plant, body)


def _rotation(axis: int, angle):
    """Rotation matrix about a coordinate axis; a float angle gives a constant."""
    if isinstance(angle, float):
        c, s = math.cos(angle), math.sin(angle)
    else:
        c, s = ca.cos(angle), ca.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = ca.SX(3, 3)
    R[axis, axis] = 1
    R[i, i], R[j, j], R[j, i], R[i, j] = c, c, s, -s
    return R


def _is_zero(value) -> bool:
    return isinstance(value, float) and value == 0.0


@dataclass(frozen=True)
class Motion:
    """Link motions of one state. Vectors are 3x1 ``SX``; lists run over links."""

    R_WL: list
    p_WL: list
    R_PL: list
    hinge_R: list
    """Per link the rotations of its y and z hinges, for projecting joint moments."""
    w: list
    """Angular velocity, link frame."""
    v: list
    """Velocity of the origin, link frame."""
    alpha: list
    """Angular acceleration, link frame."""
    acc: list
    """Acceleration of the origin less gravity, link frame."""

    def point(self, link: int, p_link: Sequence[float]):
        """World position of a point fixed to a link."""
        return self.p_WL[link] + self.R_WL[link] @ ca.DM(list(p_link))

    def point_velocity(self, link: int, p_link: Sequence[float]):
        """World velocity of a point fixed to a link."""
        return self.R_WL[link] @ (self.v[link] + ca.cross(self.w[link], ca.DM(list(p_link))))


def propagate(tree: Tree, q: Sequence, v: Sequence, a: Sequence) -> Motion:
    """Outward recursion: positions, velocities and accelerations of every link.

    ``q``, ``v``, ``a``: 6 + num_dofs entries each (root coordinates first), every entry an SX
    scalar or a float; floats fold into constants.
    """
    R_WL, p_WL, R_PL, hinge_R, ws, vs, alphas, accs = ([] for _ in range(8))
    for i in range(len(tree.links)):
        if i == 0:
            R = ca.SX.eye(3)
            w, alpha = ca.SX(3, 1), ca.SX(3, 1)
            vel = ca.vertcat(*v[:3])
            acc = ca.vertcat(a[0], a[1], a[2] + GRAVITY)
            axes, first = _ROOT_AXES, 3
            p_origin, R_parent = ca.vertcat(*q[:3]), ca.SX.eye(3)
        else:
            p = tree.parent[i]
            r = ca.DM(tree.offset[i])
            R = ca.SX.eye(3)
            w, alpha = ws[p], alphas[p]
            wr = ca.cross(w, r)
            vel = vs[p] + wr
            acc = accs[p] + ca.cross(alpha, r) + ca.cross(w, wr)
            axes, first = (0, 1, 2), 6 + tree.hinges(i)[0]
            R_parent = R_WL[p]
            p_origin = p_WL[p] + R_parent @ r
        rotations = []
        for k, axis in enumerate(axes):
            angle, rate, rate2 = q[first + k], v[first + k], a[first + k]
            if _is_zero(angle):
                R_k = None
            else:
                R_k = _rotation(axis, angle)
                back = R_k.T
                R, w, alpha, vel, acc = R @ R_k, back @ w, back @ alpha, back @ vel, back @ acc
            rotations.append(R_k)
            if not (_is_zero(rate) and _is_zero(rate2)):
                e = ca.DM(_UNIT[axis])
                alpha = alpha + ca.cross(w, e) * rate + e * rate2
                w = w + e * rate
        R_WL.append(R_parent @ R)
        p_WL.append(p_origin)
        R_PL.append(R)
        hinge_R.append(rotations)
        ws.append(w)
        vs.append(vel)
        alphas.append(alpha)
        accs.append(acc)
    return Motion(R_WL, p_WL, R_PL, hinge_R, ws, vs, alphas, accs)


def newton_euler(
    tree: Tree,
    motion: Motion,
    a: Sequence,
    forces: Sequence[tuple[int, Sequence[float], object]] = (),
):
    """Inward recursion: the generalised forces (6 + num_dofs) that the motion needs.

    ``forces``: (link, point in the link frame, world force 3x1) acting on the athlete. Returns
    root force (W) and moment (B), then joint torques including armature (N, N m).
    """
    B = len(tree.links)
    f, n = [], []
    for i in range(B):
        c, w, alpha = ca.DM(tree.com[i]), motion.w[i], motion.alpha[i]
        inertia = ca.DM(tree.inertia[i])
        force = tree.mass[i] * (motion.acc[i] + ca.cross(alpha, c) + ca.cross(w, ca.cross(w, c)))
        f.append(force)
        n.append(inertia @ alpha + ca.cross(w, inertia @ w) + ca.cross(c, force))
    for link, p_link, f_W in forces:
        f_L = motion.R_WL[link].T @ f_W
        f[link] -= f_L
        n[link] -= ca.cross(ca.DM(list(p_link)), f_L)
    tau = [None] * tree.num_dofs
    for i in range(B - 1, 0, -1):
        x, y, z = tree.hinges(i)
        moment = n[i]
        for index, axis in ((z, 2), (y, 1), (x, 0)):
            armature = tree.armature[index] * a[6 + index]
            tau[index] = moment[axis] + armature
            R_k = motion.hinge_R[i][axis]
            if R_k is not None:
                moment = R_k @ moment
        p = tree.parent[i]
        f_P = motion.R_PL[i] @ f[i]
        f[p] += f_P
        n[p] += moment + ca.cross(ca.DM(tree.offset[i]), f_P)
    return ca.vertcat(motion.R_WL[0] @ f[0], n[0], *tau)


def center_of_mass(tree: Tree, motion: Motion):
    """World position and velocity of the centre of mass (3x1 each; m, m/s)."""
    p, v = ca.SX(3, 1), ca.SX(3, 1)
    for i, mass in enumerate(tree.mass / tree.total_mass):
        p += mass * motion.point(i, tree.com[i])
        v += mass * motion.point_velocity(i, tree.com[i])
    return p, v


@dataclass(frozen=True)
class ReducedModel:
    """A tree whose hinges are free where named and held at a constant pose elsewhere."""

    tree: Tree
    free: tuple[str, ...]
    """Names of the free hinges, in ``dofs`` order."""
    pose: np.ndarray
    """(num_dofs,) the held angles (rad); entries of free hinges are not used."""
    free_index: np.ndarray
    """(m,) index of the free hinges in ``dofs``."""

    @property
    def n(self) -> int:
        """Coordinates: 6 of the root and the free hinges."""
        return 6 + len(self.free)

    @property
    def names(self) -> tuple[str, ...]:
        return (*ROOT_COORDINATES, *self.free)

    def index(self, name: str) -> int:
        """Index of a reduced coordinate by name. Raises KeyError naming it."""
        if name not in self.names:
            raise KeyError(f"'{name}' is not a free coordinate of the model")
        return self.names.index(name)

    def expand(self, x, held: Sequence[float] | None = None) -> list:
        """Full list of 6 + num_dofs entries from a reduced SX vector; held ones are floats."""
        rest = [float(value) for value in (self.pose if held is None else held)]
        for k, index in enumerate(self.free_index):
            rest[index] = x[6 + k]
        return [*(x[i] for i in range(6)), *rest]

    def motion(self, q, v=None, a=None) -> Motion:
        """Link motions for reduced SX vectors; missing rates are zero."""
        zero = [0.0] * self.tree.num_dofs
        still = [0.0] * (6 + self.tree.num_dofs)
        return propagate(
            self.tree,
            self.expand(q),
            still if v is None else self.expand(v, zero),
            still if a is None else self.expand(a, zero),
        )

    def inverse_dynamics(self, q, v, a, forces=(), motion: Motion | None = None):
        """Generalised forces (6 + num_dofs), see :func:`newton_euler`."""
        motion = self.motion(q, v, a) if motion is None else motion
        return newton_euler(self.tree, motion, self.expand(a, [0.0] * self.tree.num_dofs), forces)


def reduce_tree(tree: Tree, free: Sequence[str], pose: Mapping[str, float]) -> ReducedModel:
    """A model with ``free`` hinges; the others are held at ``pose`` (rad, by name) or at 0.

    Raises ValueError for a hinge the body does not have.
    """
    unknown = [name for name in (*free, *pose) if name not in tree.dofs]
    if unknown:
        raise ValueError(f"the body has no hinge '{unknown[0]}'")
    index = np.array(sorted(tree.dofs.index(name) for name in set(free)), dtype=int)
    held = np.zeros(tree.num_dofs)
    for name, value in pose.items():
        held[tree.dofs.index(name)] = value
    return ReducedModel(tree, tuple(tree.dofs[i] for i in index), held, index)


def root_rate_matrix(roll, yaw):
    """3x3 E with w_B = E (pitch, roll, yaw) rates, from R_WB = Ry(pitch) Rx(roll) Rz(yaw)."""
    back = _rotation(2, yaw).T
    return ca.horzcat(
        back @ (_rotation(0, roll).T @ ca.DM([0, 1, 0])), back[:, 0], ca.DM([0, 0, 1])
    )


def state_function(model: ReducedModel) -> ca.Function:
    """(q, v, a) reduced -> (R_WB (3x3), w_B, dw_B/dt): for conversion to MuJoCo's state."""
    q, v, a = (ca.SX.sym(name, model.n) for name in "qva")
    motion = model.motion(q, v, a)
    return ca.Function("root_state", [q, v, a], [motion.R_WL[0], motion.w[0], motion.alpha[0]])


def to_full_state(
    model: ReducedModel, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reduced (K, n) arrays -> MuJoCo qpos (K, 7 + dofs), qvel, qacc (K, 6 + dofs)."""
    K, m = len(q), model.tree.num_dofs
    qpos, qvel, qacc = np.zeros((K, 7 + m)), np.zeros((K, 6 + m)), np.zeros((K, 6 + m))
    root = state_function(model)
    qpos[:, :3], qvel[:, :3], qacc[:, :3] = q[:, :3], v[:, :3], a[:, :3]
    qpos[:, 7:] = model.pose
    qpos[:, 7 + model.free_index] = q[:, 6:]
    qvel[:, 6 + model.free_index] = v[:, 6:]
    qacc[:, 6 + model.free_index] = a[:, 6:]
    for k in range(K):
        R, w, alpha = root(q[k], v[k], a[k])
        qpos[k, 3:7] = _quaternion(np.array(R))
        qvel[k, 3:6], qacc[k, 3:6] = np.array(w).ravel(), np.array(alpha).ravel()
        if k and np.dot(qpos[k, 3:7], qpos[k - 1, 3:7]) < 0:
            qpos[k, 3:7] *= -1
    return qpos, qvel, qacc


def from_full_state(
    model: ReducedModel, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse of :func:`to_full_state` (held hinges are dropped); pitch is continuous in time."""
    K = len(qpos)
    q, v, a = np.zeros((K, model.n)), np.zeros((K, model.n)), np.zeros((K, model.n))
    q[:, :3], v[:, :3], a[:, :3] = qpos[:, :3], qvel[:, :3], qacc[:, :3]
    q[:, 6:] = qpos[:, 7 + model.free_index]
    v[:, 6:] = qvel[:, 6 + model.free_index]
    a[:, 6:] = qacc[:, 6 + model.free_index]
    roll, yaw = ca.SX.sym("roll"), ca.SX.sym("yaw")
    E = ca.Function("E", [roll, yaw], [root_rate_matrix(roll, yaw)])
    root = state_function(model)
    for k in range(K):
        w, x, y, z = qpos[k, 3:7]
        R12 = 2 * (y * z - w * x)
        R02, R22 = 2 * (x * z + w * y), 1 - 2 * (x * x + y * y)
        R10, R11 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z)
        q[k, 3:6] = math.atan2(R02, R22), math.asin(np.clip(-R12, -1, 1)), math.atan2(R10, R11)
        E_k = np.array(E(q[k, 4], q[k, 5]))
        v[k, 3:6] = np.linalg.solve(E_k, qvel[k, 3:6])
        bias = np.array(root(q[k], v[k], np.zeros(model.n))[2]).ravel()
        a[k, 3:6] = np.linalg.solve(E_k, qacc[k, 3:6] - bias)
    q[:, 3:6] = np.unwrap(q[:, 3:6], axis=0)
    return q, v, a


def _quaternion(R: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z) of a rotation matrix (Shepperd 1978)."""
    t = np.array([np.trace(R), R[0, 0], R[1, 1], R[2, 2]])
    k = int(np.argmax(t))
    if k == 0:
        quat = [1 + t[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]
    else:
        i = k - 1
        j, m = (i + 1) % 3, (i + 2) % 3
        quat = [0.0] * 4
        quat[0] = R[m, j] - R[j, m]
        quat[1 + i] = 1 + 2 * R[i, i] - t[0]
        quat[1 + j] = R[j, i] + R[i, j]
        quat[1 + m] = R[m, i] + R[i, m]
    return np.array(quat) / np.linalg.norm(quat)
