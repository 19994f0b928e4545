"""Keeps an athlete's momentum: what only the world outside can change.

The engines integrate joint coordinates semi-implicitly, and at 1/120 s that does not conserve
momentum: an athlete who flails through a 0.67 s flight gained 5.7 m/s forward and 5.1 m/s up
(1/240 s: 1.3 and 2.4 m/s; 1/1920 s: 0.09 and 0.21). Policies find this: at strength ``human`` one
swam 18.9 m through the air. So after every substep the root is given the small twist that brings
the momentum of the whole body back to

    h[k+1] = h[k] + dt (gravity + contact wrench),

which holds for any rigid-body system (Newton and Euler; Featherstone 2008, section 2.13). Contact
forces are the engine's own: the constraint forces on the free joint of the root; what is applied to
a link besides (the impact of a ball) is told. In flight the
centre of mass is also put back on the path of that momentum; on the ground the contacts decide.

Momentum is taken at the centre of mass, world axes: ``(L, P)``, N m s and N s.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from sports.humanoid.mjcf import WHOLE_SENSORS
from sports.physics.athletes import Kept, keep_measured
from sports.physics.base import GRAVITY, NO_FORCE

Bind = Callable[[str], np.ndarray]
"""Gives a live (N, ...) array of an MjData field by its name."""


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
        self,
        model: mujoco.MjModel,
        bind: Bind,
        root: str,
        num_worlds: int | None = None,
        applied: np.ndarray | None = None,
    ) -> None:
        """
        Args:
            model: its time step and the mass of the root's subtree are used.
            bind: gives a live (N, ...) array of an MjData field; ``Batch.bind`` or ``rows_of``.
            root: name of the athlete's root body, the one with the free joint.
            num_worlds: keep the first so many simulations; None for all.
            applied: live array (N, 6) of what else acts on the athlete from outside in a substep,
                force (N) and moment about the world's origin (N m), world frame; None for nothing.

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
        self._motion = bind("sensordata")[n, first : first + 3 * len(WHOLE_SENSORS)]
        if applied is None:
            applied = np.zeros((len(self._motion), 6))
        self.applied = applied
        """(N, 6) force and moment about the world's origin; see ``__init__``."""
        self._fields = (
            self._motion,
            bind("crb")[n, body.id, :6],
            bind("qfrc_constraint")[n, v : v + 6],
            applied,
            bind("qpos")[n, q : q + 7],
            bind("qvel")[n, v : v + 6],
        )
        mass, num = float(model.body_subtreemass[body.id]), len(self._motion)
        self.kept = Kept(
            expected=np.full((num, 9), np.nan),
            timestep=np.full(num, model.opt.timestep),
            mass=mass,
            weight=-mass * GRAVITY,
            no_force=NO_FORCE,
        )
        """The momentum and the path expected of the state measured next; the time step of each
        simulation, which may be changed between substeps."""
        self._added = np.zeros((num, 9))

    @property
    def target(self) -> np.ndarray:
        """(N, 6) momentum expected of the state measured next; NaN where unknown. A view."""
        return self.kept.expected[:, :6]

    @property
    def path(self) -> np.ndarray:
        """(N, 3) where the centre of mass should be in that state; NaN where unknown. A view."""
        return self.kept.expected[:, 6:]

    def forget(self, worlds: np.ndarray | slice = slice(None)) -> None:
        """The next measurement of these simulations is taken as it is."""
        self.kept.expected[worlds] = np.nan

    def measured(self) -> np.ndarray:
        """(N, 9) as the fields show it: centre of mass (m), its velocity (m/s), angular momentum
        about it (N m s); world frame. The fields must be current, as after ``mj_forward``."""
        angular, velocity, com = np.split(self._motion[:, :9], 3, axis=1)
        return np.concatenate((com, velocity, angular), axis=1)

    def whole(self) -> np.ndarray:
        """(N, 9) the same as :meth:`measured`, of the state as a ``current`` :meth:`correct` has
        left it."""
        angular, linear = np.split(self.target, 2, axis=1)
        return np.concatenate((self.path, linear / self.kept.mass, angular), axis=1)

    def correct(self, current: bool) -> tuple[np.ndarray, np.ndarray]:
        """Corrects the state after a substep.

        ``current`` false: the fields describe the state *before* the substep just taken (as after
        a plain step), so the correction comes one substep late. True: they describe the state
        after it (but for the constraint forces, which are always of the substep).

        Returns (N, 6) the added spatial velocity (rotation, then velocity of the centre of mass,
        as ``cvel``; world) and (N, 3) the shift of the whole athlete: views, until the next call.
        """
        keep_measured(self.kept, current, *self._fields, self._added)
        return self._added[:, :6], self._added[:, 6:]


def rows_of(data: mujoco.MjData) -> Bind:
    """Live arrays of one ``MjData`` as those of a batch of one, for :class:`AthleteKeeper`."""
    return lambda name: getattr(data, name)[None]
