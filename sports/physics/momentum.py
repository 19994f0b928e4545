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

from sports.humanoid.mjcf import WHOLE_SENSORS

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


# Rows of a symmetric matrix (xx, yy, zz, xy, xz, yz), two of them and two columns repeated: with
# these its cofactors are products of shifted blocks.
_CYCLIC = np.array(((0, 3, 4), (3, 1, 5), (4, 5, 2)))[np.ix_((0, 1, 2, 0, 1), (0, 1, 2, 0, 1))]


def _solve(inertia: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(3, N) solution of N symmetric systems (6, N: xx, yy, zz, xy, xz, yz) by Cramer's rule;
    NaN, never an error, for an athlete whose inertia has become singular (it has diverged)."""
    m = inertia[_CYCLIC]
    adjugate = m[1:4, 1:4] * m[2:5, 2:5] - m[1:4, 2:5] * m[2:5, 1:4]
    determinant = np.einsum("jn,jn->n", m[0, :3], adjugate[0])
    return np.einsum("ijn,jn->in", adjugate, right) / determinant


@dataclass
class Tree:
    """One athlete of every world, as the engine's derived fields show it."""

    inertia: np.ndarray
    """(N, 6) of the whole athlete about its centre of mass: xx, yy, zz, xy, xz, yz."""
    motion: np.ndarray
    """(N, 21) angular momentum about the centre of mass, its velocity, its position; position of
    the root, x, y and z axes of the root."""
    root_force: np.ndarray
    """(N, 6) constraint force on the free joint: world force, moment in the root's frame."""


class MomentumKeeper:
    """The correction for one athlete of N worlds, float64."""

    def __init__(self, num_worlds: int, mass: float, timestep: np.ndarray | float) -> None:
        """``timestep``: s, () or (N,); may be changed between substeps."""
        self.mass = mass
        self.timestep = timestep
        # Components first, so that each operation runs over all worlds.
        self._expected = np.full((9, num_worlds), np.nan)
        self._jacobian = np.zeros((2, 3, 3, num_worlds))
        self._weight = np.array((0.0, 0.0, 0.0, *(mass * GRAVITY)))[:, None]

    @property
    def target(self) -> np.ndarray:
        """(N, 6) momentum expected of the state measured next; NaN where unknown. A view."""
        return self._expected[:6].T

    @property
    def path(self) -> np.ndarray:
        """(N, 3) where the centre of mass should be in that state; NaN where unknown. A view."""
        return self._expected[6:].T

    def forget(self, ids: np.ndarray | slice) -> None:
        """The next measurement of these worlds is taken as it is (after a reset)."""
        self._expected[:, ids] = np.nan

    def correct(self, tree: Tree, current: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What to add to the root after a substep.

        ``current`` false: the fields describe the state *before* the substep just taken (as after
        a plain step), so the correction comes one substep late. True: they describe the state
        after it (but for ``root_force``, which is always of the substep).

        Returns (6, N) spatial velocity (rotation, then velocity of the centre of mass; world),
        (6, N) the same as a change of the free joint's ``qvel``, (3, N) shift of the root.
        """
        motion, force = tree.motion.T.copy(), tree.root_force.T.copy()
        shown = motion[:9]
        shown[3:6] *= self.mass
        jacobian = self._turning(motion[9:12] - shown[6:], motion[12:])
        # The generalised force of the root is a wrench at the centre of mass.
        wrench = np.concatenate((np.einsum("ijn,in->jn", jacobian, force), force[:3]))
        wrench += self._weight
        touching = np.abs(force).sum(0) >= NO_FORCE
        if current:
            self._advance(wrench)
        error = self._expected - shown
        np.copyto(error, 0.0, where=np.isnan(error))
        np.copyto(error[6:], 0.0, where=touching)  # there the contacts decide
        np.add(shown, error, out=self._expected)
        if not current:
            self._advance(wrench)
        twist, shift = error[:6], error[6:]
        twist[:3] = _solve(tree.inertia.T.copy(), twist[:3])
        twist[3:] /= self.mass
        change = np.einsum("ijn,jn->in", jacobian, twist[:3])
        change[:3] += twist[3:]
        return twist, change, shift

    def _turning(self, arm: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """(6, 3, N) Jacobian of the free joint's ``qvel`` by a rotation about the centre of mass,
        which turns the root at ``arm`` (3, N) from there with ``axes`` (9, N)."""
        cross, turn = self._jacobian
        x, y, z = arm
        cross[0, 1], cross[1, 2], cross[2, 0] = z, x, y
        np.negative(arm, out=arm)
        cross[1, 0], cross[2, 1], cross[0, 2] = z, x, y
        turn[:] = axes.reshape(3, 3, -1)
        return self._jacobian.reshape(6, 3, -1)

    def _advance(self, wrench: np.ndarray) -> None:
        """Lets the expected momentum and path go on by a time step."""
        momentum, path = self._expected[:6], self._expected[6:]
        momentum += self.timestep * wrench
        path += self.timestep / self.mass * momentum[3:]


class AthleteKeeper:
    """Keeps the momentum of one athlete of N simulations of a plain MuJoCo model.

    The model needs the athlete's ``WHOLE_SENSORS``, as ``mjcf.build_spec`` adds them; its
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
            ValueError: the model lacks a sensor of the athlete.
        """
        names = [model.sensor(i).name for i in range(model.nsensor)]
        for name in (f"{kind.lower()}:{root}" for kind in WHOLE_SENSORS):
            if name not in names:
                raise ValueError(f"the model has no sensor '{name}'; see sports.humanoid.mjcf")
        n, body = slice(num_worlds), model.body(root)
        q, v = model.jnt_qposadr[body.jntadr[0]], model.jnt_dofadr[body.jntadr[0]]
        first = model.sensor(f"{WHOLE_SENSORS[0].lower()}:{root}").adr[0]
        self._pos, self._vel = bind("qpos")[n, q : q + 3], bind("qvel")[n, v : v + 6]
        self.tree = Tree(
            inertia=bind("crb")[n, body.id, :6],
            motion=bind("sensordata")[n, first : first + 3 * len(WHOLE_SENSORS)],
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
        angular, velocity, com = np.split(self.tree.motion[:, :9], 3, axis=1)
        return np.concatenate((com, velocity, angular), axis=1)

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
            self._vel += change.T
            self._pos += shift.T
        return twist.T, shift.T


def rows_of(data: mujoco.MjData) -> Bind:
    """Live arrays of one ``MjData`` as those of a batch of one, for :class:`AthleteKeeper`."""
    return lambda name: getattr(data, name)[None]
