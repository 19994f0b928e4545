"""Keeps an athlete's momentum: what only the world outside can change.

The engines integrate joint coordinates semi-implicitly, and at 1/120 s that does not conserve
momentum: an athlete who flails through a 0.67 s flight gained 5.7 m/s forward and 5.1 m/s up
(1/240 s: 1.3 and 2.4 m/s; 1/1920 s: 0.09 and 0.21). Policies find this: at strength ``human`` one
swam 18.9 m through the air. So after every substep the root is given the small twist that brings
the momentum of the whole body back to

    h[k+1] = h[k] + dt (gravity + contact wrench),

which holds for any rigid-body system (Newton and Euler; Featherstone 2008, section 2.13). Contact
forces are the engine's own: the constraint forces on the free joint of the root. In flight the
centre of mass is also put back on the path of that momentum; on the ground the contacts decide.

Momentum is taken at the centre of mass, world axes: ``(L, P)``, N m s and N s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from sports.physics.vectors import cross

Bind = Callable[[str], np.ndarray]
"""Gives a live (N, ...) array of an MjData field by its name."""
GRAVITY = np.array((0.0, 0.0, -9.81))
NO_FORCE = 0.1
"""A root force (N, N m) below this is rounding of self-contacts: the athlete touches nothing."""


def spatial_momentum(cinert: np.ndarray, cvel: np.ndarray) -> np.ndarray:
    """(..., 6) angular, then linear momentum summed over links, at the centre of mass.

    ``cinert`` (..., B, 10) and ``cvel`` (..., B, 6) are MuJoCo's, which refer to that point.
    """
    i = np.moveaxis(cinert, -1, 0)
    v = np.moveaxis(cvel, -1, 0)
    rows = (
        i[0] * v[0] + i[3] * v[1] + i[4] * v[2] - i[8] * v[4] + i[7] * v[5],
        i[3] * v[0] + i[1] * v[1] + i[5] * v[2] + i[8] * v[3] - i[6] * v[5],
        i[4] * v[0] + i[5] * v[1] + i[2] * v[2] - i[7] * v[3] + i[6] * v[4],
        i[8] * v[1] - i[7] * v[2] + i[9] * v[3],
        i[6] * v[2] - i[8] * v[0] + i[9] * v[4],
        i[7] * v[0] - i[6] * v[1] + i[9] * v[5],
    )
    return np.stack([row.sum(-1) for row in rows], axis=-1)


def _rotate(w: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(3, N) vectors ``v`` rotated by the unit quaternions of scalar ``w`` and vector ``u``."""
    t = 2.0 * cross(u, v)
    return v + w * t + cross(u, t)


def _solve(inertia: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(3, N) solution of N symmetric systems (6, N: xx, yy, zz, xy, xz, yz) by Cramer's rule;
    NaN, never an error, for an athlete whose inertia has become singular (it has diverged)."""
    xx, yy, zz, xy, xz, yz = inertia
    x, y, z = right
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy  # the adjugate's rows
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    solution = np.stack((a * x + b * y + c * z, b * x + d * y + e * z, c * x + e * y + f * z))
    return solution / (xx * a + xy * b + xz * c)


@dataclass
class Tree:
    """One athlete of every world, as the engine's derived fields show it."""

    inertia: np.ndarray
    """(N, 6) of the whole athlete about its centre of mass: xx, yy, zz, xy, xz, yz."""
    angular: np.ndarray
    """(N, 3) angular momentum about the centre of mass."""
    velocity: np.ndarray
    """(N, 3) of the centre of mass."""
    com: np.ndarray
    """(N, 3)"""
    root_pos: np.ndarray
    """(N, 3)"""
    root_quat: np.ndarray
    """(N, 4)"""
    root_force: np.ndarray
    """(N, 6) constraint force on the free joint: world force, moment in the root's frame."""


class MomentumKeeper:
    """The correction for one athlete of N worlds, float64."""

    def __init__(self, num_worlds: int, mass: float, timestep: np.ndarray | float) -> None:
        """``timestep``: s, () or (N,); may be changed between substeps."""
        self.mass = mass
        self.timestep = timestep
        # Components first, so that each operation runs over all worlds.
        self._target = np.full((6, num_worlds), np.nan)
        self._path = np.full((3, num_worlds), np.nan)
        self._weight = np.array((0.0, 0.0, 0.0, *(mass * GRAVITY)))[:, None]

    @property
    def target(self) -> np.ndarray:
        """(N, 6) momentum expected of the state measured next; NaN where unknown. A view."""
        return self._target.T

    @property
    def path(self) -> np.ndarray:
        """(N, 3) where the centre of mass should be in that state; NaN where unknown. A view."""
        return self._path.T

    def forget(self, ids: np.ndarray | slice) -> None:
        """The next measurement of these worlds is taken as it is (after a reset)."""
        self._target[:, ids] = np.nan
        self._path[:, ids] = np.nan

    def correct(self, tree: Tree, current: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What to add to the root after a substep.

        ``current`` false: the fields describe the state *before* the substep just taken (as after
        a plain step), so the correction comes one substep late. True: they describe the state
        after it (but for ``root_force``, which is always of the substep).

        Returns (N, 6) spatial velocity (rotation, then velocity of the centre of mass; world),
        (N, 6) the same as a change of the free joint's ``qvel``, (N, 3) shift of the root.
        """
        h = self.timestep
        com, quat = np.ascontiguousarray(tree.com.T), np.ascontiguousarray(tree.root_quat.T)
        wrench = np.ascontiguousarray(tree.root_force.T)
        w, u = quat[0], quat[1:]
        arm = tree.root_pos.T - com
        momentum = np.concatenate((tree.angular.T, self.mass * tree.velocity.T))
        flying = np.abs(wrench).sum(0) < NO_FORCE
        force = wrench[:3]
        moment = _rotate(w, u, wrench[3:]) + cross(arm, force)
        impulse = h * (np.concatenate((moment, force)) + self._weight)

        expected = self._target + impulse if current else self._target
        np.copyto(expected, momentum, where=np.isnan(expected))
        error = expected - momentum
        spin = _solve(np.ascontiguousarray(tree.inertia.T), error[:3])
        speed = error[3:] / self.mass
        self._target = expected if current else expected + impulse

        # Position: the path of the momentum while nothing is touched.
        here = self._path + h * (expected[3:] / self.mass) if current else self._path
        shift = np.where(flying & np.isfinite(here), here - com, 0.0)
        ahead = com + shift
        self._path = ahead if current else ahead + h * (self._target[3:] / self.mass)
        change = np.concatenate((speed + cross(spin, arm), _rotate(w, -u, spin)))
        return np.concatenate((spin, speed)).T, change.T, shift.T


class AthleteKeeper:
    """Keeps the momentum of one athlete of N simulations of a plain MuJoCo model.

    The model needs the athlete's two momentum sensors, as ``mjcf.build_spec`` adds them; its
    contact sensors may be deleted. Works on a batch and, with one row, on an ``MjData``::

        keeper = AthleteKeeper(model, batch.bind, "agent0/Pelvis")
        keeper = AthleteKeeper(model, rows_of(data), "agent0/Pelvis")

    Call :meth:`correct` after every single substep: with ``current`` false after a plain
    ``batch.step()`` or ``mj_step``; with ``current`` true after the last substep before the links
    are read, when the fields show the state that it led to, as they do after
    ``batch.step(stage=mjSTAGE_VEL)`` or ``mj_step`` and ``mj_step1``. It writes ``qpos`` and
    ``qvel``. Links read after a ``current`` correction were computed before it: add the returned
    shift to their positions, the twist to ``cvel``. Call :meth:`forget` for simulations whose
    state was set from outside.
    """

    def __init__(
        self, model: mujoco.MjModel, bind: Bind, root: str, num_worlds: int | None = None
    ) -> None:
        """
        Args:
            model: its time step and the mass of the root's subtree are used.
            bind: gives a live (N, ...) array of an MjData field; ``Batch.bind`` or ``rows_of``.
            root: name of the athlete's root body, the one with the free joint.
            num_worlds: keep the first so many simulations; None for all.

        Raises:
            ValueError: the model lacks the athlete's momentum sensors.
        """
        names = [model.sensor(i).name for i in range(model.nsensor)]
        for name in (f"angmom:{root}", f"linvel:{root}"):
            if name not in names:
                raise ValueError(f"the model has no sensor '{name}'; see sports.humanoid.mjcf")
        n, body = slice(num_worlds), model.body(root)
        q, v = model.jnt_qposadr[body.jntadr[0]], model.jnt_dofadr[body.jntadr[0]]
        spin, speed = (model.sensor(f"{k}:{root}").adr[0] for k in ("angmom", "linvel"))
        sensors = bind("sensordata")
        self._pos, self._vel = bind("qpos")[n, q : q + 3], bind("qvel")[n, v : v + 6]
        self.tree = Tree(
            inertia=bind("crb")[n, body.id, :6],
            angular=sensors[n, spin : spin + 3],
            velocity=sensors[n, speed : speed + 3],
            com=bind("subtree_com")[n, body.id],
            root_pos=bind("xpos")[n, body.id],
            root_quat=bind("xquat")[n, body.id],
            root_force=bind("qfrc_constraint")[n, v : v + 6],
        )
        """What the fields show; live."""
        mass = float(model.body_subtreemass[body.id])
        self.expected = MomentumKeeper(len(self._pos), mass, model.opt.timestep)
        """The momentum and the path expected, and the time step."""

    def forget(self, worlds: np.ndarray | slice = slice(None)) -> None:
        """The next measurement of these simulations is taken as it is."""
        self.expected.forget(worlds)

    def measured(self) -> np.ndarray:
        """(N, 9) as the fields show it: centre of mass (m), its velocity (m/s), angular momentum
        about it (N m s); world frame. The fields must be current, as after ``mj_forward``."""
        tree = self.tree
        return np.concatenate((tree.com, tree.velocity, tree.angular), axis=1)

    def whole(self) -> np.ndarray:
        """(N, 9) the same as :meth:`measured`, of the state as a ``current`` :meth:`correct` has
        left it."""
        momentum = self.expected.target
        speed = momentum[:, 3:] / self.expected.mass
        return np.concatenate((self.expected.path, speed, momentum[:, :3]), axis=1)

    def correct(self, current: bool, after: Tree | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Corrects the state after a substep; see the class.

        ``after``: the athlete after the substep, for a ``current`` correction where the model's
        fields do not show it.

        Returns (N, 6) the added spatial velocity (rotation, then velocity of the centre of mass,
        as ``cvel``; world) and (N, 3) the shift of the whole athlete.
        """
        tree = after or self.tree
        with np.errstate(all="ignore"):  # a simulation may have diverged
            twist, change, shift = self.expected.correct(tree, current)
            self._vel += change
            self._pos += shift
        return twist, shift


def rows_of(data: mujoco.MjData) -> Bind:
    """Live arrays of one ``MjData`` as those of a batch of one, for :class:`AthleteKeeper`."""
    return lambda name: getattr(data, name)[None]
