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


def rotation(quat: np.ndarray) -> np.ndarray:
    """(..., 3, 3) matrix of unit quaternions (w, x, y, z)."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(N, 3) solution of N systems (N, 3, 3) by Cramer's rule; NaN, never an error, for the
    world of an athlete whose inertia has become singular (it has diverged)."""
    a, b, c = matrix[:, :, 0], matrix[:, :, 1], matrix[:, :, 2]
    bc = np.cross(b, c)
    with np.errstate(all="ignore"):
        determinant = np.einsum("ni,ni->n", a, bc)[:, None]
        rows = (bc, np.cross(c, a), np.cross(a, b))
        numerator = np.stack([np.einsum("ni,ni->n", r, right) for r in rows], axis=1)
        return numerator / determinant


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
        self.target = np.full((num_worlds, 6), np.nan)
        """(N, 6) momentum expected of the state measured next; NaN where unknown."""
        self.path = np.full((num_worlds, 3), np.nan)
        """(N, 3) where the centre of mass should be in that state; NaN where unknown."""

    def forget(self, ids: np.ndarray | slice) -> None:
        """The next measurement of these worlds is taken as it is (after a reset)."""
        self.target[ids] = np.nan
        self.path[ids] = np.nan

    def correct(self, tree: Tree, current: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What to add to the root after a substep.

        ``current`` false: the fields describe the state *before* the substep just taken (as after
        a plain step), so the correction comes one substep late. True: they describe the state
        after it (but for ``root_force``, which is always of the substep).

        Returns (N, 6) spatial velocity (rotation, then velocity of the centre of mass; world),
        (N, 6) the same as a change of the free joint's ``qvel``, (N, 3) shift of the root.
        """
        h = np.broadcast_to(np.asarray(self.timestep, dtype=float), tree.com.shape[:1])[:, None]
        momentum = np.concatenate((tree.angular, self.mass * tree.velocity), axis=1)
        matrix = rotation(tree.root_quat)
        arm = tree.root_pos - tree.com
        force = tree.root_force[:, :3]
        moment = np.einsum("nij,nj->ni", matrix, tree.root_force[:, 3:]) + np.cross(arm, force)
        impulse = h * np.concatenate((moment, force + self.mass * GRAVITY), axis=1)
        flying = (np.abs(tree.root_force).sum(1) < NO_FORCE)[:, None]

        known = np.isfinite(self.target)
        expected = self.target + impulse if current else self.target
        error = np.where(known, expected - momentum, 0.0)
        twist = np.empty_like(error)
        tensor = tree.inertia[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)
        twist[:, :3] = _solve(tensor, error[:, :3])
        twist[:, 3:] = error[:, 3:] / self.mass
        self.target = momentum + error + (0.0 if current else impulse)

        # Position: the path of the momentum while nothing is touched.
        velocity = (momentum + error)[:, 3:] / self.mass
        here = self.path + h * velocity if current else self.path
        shift = np.where(np.isfinite(here) & flying, here - tree.com, 0.0)
        ahead = tree.com + shift
        self.path = ahead if current else ahead + h * (self.target[:, 3:] / self.mass)
        change = np.concatenate(
            (
                twist[:, 3:] + np.cross(twist[:, :3], arm),
                np.einsum("nji,nj->ni", matrix, twist[:, :3]),
            ),
            axis=1,
        )
        return twist, change, shift


class AthleteKeeper:
    """Keeps the momentum of one athlete of N simulations of a plain MuJoCo model.

    The model needs the athlete's two momentum sensors, as ``mjcf.build_spec`` adds them; its
    contact sensors may be deleted. Works on a batch and, with one row, on an ``MjData``::

        keeper = AthleteKeeper(model, batch.bind, "agent0/Pelvis")
        keeper = AthleteKeeper(model, rows_of(data), "agent0/Pelvis")

    Call :meth:`correct` after every single substep: with ``current`` false after a plain
    ``batch.step()`` or ``mj_step``, with ``current`` true after ``batch.step(stage=mjSTAGE_VEL)``
    (or ``mj_step`` and ``mj_step1``'s stages again), which the last substep before the links are
    read wants. It writes ``qpos`` and ``qvel``. Links read after a ``current`` correction were
    computed before it: add the returned shift to their positions, the twist to ``cvel``. Call
    :meth:`forget` for simulations whose state was set from outside.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        bind: Callable[[str], np.ndarray],
        root: str,
        num_worlds: int | None = None,
    ) -> None:
        """
        Args:
            model: its time step and the mass of the root's subtree are used.
            bind: gives a live (N, ...) array of an MjData field; ``Batch.bind`` or ``rows_of``.
            root: name of the athlete's root body, the one with the free joint.
            num_worlds: keep the first so many simulations; None for all.

        Raises:
            ValueError: the model has no such body, or lacks its momentum sensors.
        """
        names = [model.sensor(i).name for i in range(model.nsensor)]
        missing = [s for s in (f"angmom:{root}", f"linvel:{root}") if s not in names]
        if missing:
            raise ValueError(f"the model has no sensor '{missing[0]}'; see sports.humanoid.mjcf")
        body = model.body(root)
        q, v = model.jnt_qposadr[body.jntadr[0]], model.jnt_dofadr[body.jntadr[0]]
        spin, speed = (model.sensor(f"{k}:{root}").adr[0] for k in ("angmom", "linvel"))
        n = slice(num_worlds)
        self._pos, self._vel = bind("qpos")[n, q : q + 3], bind("qvel")[n, v : v + 6]
        self._inertia = bind("crb")[n, body.id, :6]
        self._angular = bind("sensordata")[n, spin : spin + 3]
        self._velocity = bind("sensordata")[n, speed : speed + 3]
        self._com = bind("subtree_com")[n, body.id]
        self._root_pos, self._root_quat = bind("xpos")[n, body.id], bind("xquat")[n, body.id]
        self._root_force = bind("qfrc_constraint")[n, v : v + 6]
        mass = float(model.body_subtreemass[body.id])
        self.expected = MomentumKeeper(len(self._pos), mass, model.opt.timestep)
        """The momentum and the path expected, and the time step."""

    def forget(self, worlds: np.ndarray | slice = slice(None)) -> None:
        """The next measurement of these simulations is taken as it is."""
        self.expected.forget(worlds)

    def measured(self) -> np.ndarray:
        """(N, 9) as the fields show it: centre of mass (m), its velocity (m/s), angular momentum
        about it (N m s); world frame. For a single ``MjData``, valid after ``mj_forward``."""
        return np.concatenate((self._com, self._velocity, self._angular), axis=1)

    def whole(self) -> np.ndarray:
        """(N, 9) the same as :meth:`measured`, of the state as a ``current`` :meth:`correct` has
        left it."""
        momentum = self.expected.target
        speed = momentum[:, 3:] / self.expected.mass
        return np.concatenate((self.expected.path, speed, momentum[:, :3]), axis=1)

    def correct(self, current: bool) -> tuple[np.ndarray, np.ndarray]:
        """Corrects the state after a substep; see the class.

        Returns (N, 6) the added spatial velocity (rotation, then velocity of the centre of mass,
        as ``cvel``; world) and (N, 3) the shift of the whole athlete.
        """
        tree = Tree(
            inertia=self._inertia,
            angular=self._angular,
            velocity=self._velocity,
            com=self._com,
            root_pos=self._root_pos,
            root_quat=self._root_quat,
            root_force=self._root_force,
        )
        with np.errstate(all="ignore"):  # a simulation may have diverged
            twist, change, shift = self.expected.correct(tree, current)
            self._vel += change
            self._pos += shift
        return twist, shift


def rows_of(data: mujoco.MjData) -> Callable[[str], np.ndarray]:
    """Live arrays of one ``MjData`` as those of a batch of one, for :class:`AthleteKeeper`."""
    return lambda name: getattr(data, name)[None]
