"""Worlds that differ a little, so that a policy cannot live on one engine's numbers.

Violent motion on the ground depends on the time step of every engine: a policy trained on one
world alone won 91 % of its long jumps at 1/120 s and none at 1/240 s or in Drake (measured, on
MuJoCo's default ground). In training each world may have its own friction, gains, contact softness,
damping and impedance, and time step, and contacts that feel the joints' damping or do not.

MuJoCo's integrator takes the damping of the joints implicitly, its contact solver does not know of
it: a joint of 80 N m s/rad that carries a foot of 0.7 kg forgets its motion in 0.3 ms, and the
solver, which looks 8 ms ahead, pushes at a foot that it believes to be free. That is most of what
depends on the time step at strength ``paper`` (docs/physics.md, "What Drake feels and MuJoCo does
not"). Where contacts feel the damping D, the solver works with M + h D, which is also what the
implicit step divides by, so that the motion without contact is the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from sports.humanoid.body import Body
from sports.humanoid.mjcf import holds, is_bounce, rebound_geoms, yields
from sports.scene import Scene
from sports.variation import FELT, RANGES, Variation

REBOUND_SOLREF, REBOUND_IMPEDANCE = (0.0045, 0.3), 0.99
"""Time constant (s), damping ratio and impedance of contacts that rebound: with 0.45 of the
approach at fine time steps; at 1/480 s with 0.2 to 1.8 of it, as the instant of contact falls."""
LEAST_SUBSTEPS = 4
"""In a control step, of the coarsest worlds: the usual number."""


@dataclass(frozen=True)
class Draw:
    """What each world got; all (N,)."""

    friction: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    contact_time: np.ndarray
    contact_damping: np.ndarray
    contact_impedance: np.ndarray
    stride: np.ndarray
    """int, substeps taken in one"""
    felt: np.ndarray
    """bool, whether contacts feel the joints' damping"""
    hold_time: np.ndarray
    own: np.ndarray
    """bool, whether it is the task's own, with the model's contacts whatever is drawn above"""
    side: np.ndarray
    """share by which gains on the left are greater and on the right smaller"""
    cone: np.ndarray
    """bool, whether friction has a round cone"""
    rebound: np.ndarray
    """bool, whether links that may rebound do"""
    impratio: np.ndarray
    """stiffness of friction by that of the normal force"""

    def gains(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        """(N, nu) factors of the servos' stiffness and (N, nv) of the damping."""
        sides = _sides(scene.body)
        uneven = 1.0 + self.side[:, None] * sides
        stiffness = self.stiffness[:, None] * np.tile(uneven, scene.num_agents)
        damping = np.repeat(self.damping[:, None], scene.nv, axis=1)
        for agent in range(scene.num_agents):
            damping[:, scene.agent_qvel(agent)][:, 6:] *= uneven
        return stiffness, damping

    def timesteps(self, timestep: float, substeps: int) -> list[np.ndarray] | None:
        """(N,) time step of every substep: ``stride`` substeps in one, then none until the next;
        None where all worlds take them one by one."""
        if (self.stride == 1).all():
            return None
        return [np.where(i % self.stride == 0, self.stride * timestep, 0) for i in range(substeps)]


def draw(
    variation: Variation,
    num_worlds: int,
    substeps: int,
    seed: int,
    all_felt: bool = False,
    blocks: int = 1,
) -> Draw:
    """One draw for each world of a scene with so many substeps in a control step. ``all_felt``:
    with felt damping, whatever the share, and none of them the task's own. ``blocks``: the worlds
    come in so many blocks that are alike, for policies to be compared in. Raises ValueError for an
    ``own_stride`` that does not divide the substeps, or blocks that do not divide the worlds."""
    if num_worlds % blocks:
        raise ValueError(f"variation: {blocks} blocks do not divide {num_worlds} worlds")
    if blocks > 1:
        one = draw(variation, num_worlds // blocks, substeps, seed, all_felt)
        return Draw(**{name: np.tile(values, blocks) for name, values in vars(one).items()})
    if substeps % variation.own_stride:
        raise ValueError(
            f"variation: own_stride {variation.own_stride} does not divide {substeps} substeps"
        )
    rng = np.random.default_rng(seed)

    def uniform(span: tuple[float, float]) -> np.ndarray:
        return rng.uniform(*span, size=num_worlds)

    values = {name: uniform(getattr(variation, name)) for name in RANGES}
    coarse = rng.random(num_worlds) < variation.coarse_share
    strides = [s for s in (2, 4, 8) if substeps % s == 0 and substeps // s >= LEAST_SUBSTEPS]
    drawn = np.array(strides or [1])[rng.integers(len(strides or [1]), size=num_worlds)]
    felt = (rng.random(num_worlds) < variation.felt_share) | all_felt
    for name in FELT:
        own = uniform(getattr(variation, f"felt_{name}"))
        values[name] = np.where(felt, own, values[name])
    values["hold_time"] = uniform(variation.hold_time)
    stride = np.where(coarse, drawn, 1)
    own = (rng.random(num_worlds) < variation.own_share) & (not all_felt)
    for name in ("friction", "stiffness", "damping"):
        values[name] = np.where(own, 1.0, values[name])
    stride, felt = np.where(own, variation.own_stride, stride), felt & ~own
    side = np.where(own, 0.0, uniform((-variation.uneven, variation.uneven)))
    cone = (rng.random(num_worlds) < variation.cone_share) & (~own | variation.own_cone)
    rebound = (rng.random(num_worlds) < variation.rebound_share) & ~own
    stride = np.where(rebound, 1, stride)
    low, high = np.log(variation.impratio)
    impratio = np.where(own, 1.0, np.exp(rng.uniform(low, high, size=num_worlds)))
    return Draw(
        **values,
        stride=stride,
        felt=felt,
        own=own,
        side=side,
        cone=cone,
        rebound=rebound,
        impratio=impratio,
    )


def _sides(body: Body) -> np.ndarray:
    """(num_dofs,) 1 for a joint of the left side, -1 of the right, 0 in the middle."""
    return np.array([{"L": 1.0, "R": -1.0}.get(dof.link.split("_")[0], 0.0) for dof in body.dofs])


class Damping(NamedTuple):
    """Where the damping of the joints goes in each world; all (N, nv), N m s/rad and kg m^2."""

    own: np.ndarray
    """For the engine's implicit step, of which its contact solver knows nothing."""
    force: np.ndarray
    """Applied as a force -damping x rate at the beginning of every substep ..."""
    armature: np.ndarray
    """... with this added to the inertia, which makes that step the implicit one."""


def split_damping(
    damping: np.ndarray, joints: np.ndarray, felt: np.ndarray, timestep: np.ndarray
) -> Damping:
    """Lets contacts feel the ``damping`` (N, nv) of ``joints`` (nv,) bool in the worlds ``felt``
    (N,) bool with time steps (N,) (s).

    An implicit step of v' = (f - D v) / M is (M + h D) (v[k+1] - v[k]) = h (f - D v[k]): an
    explicit one with the inertia M + h D, which the contact solver then sees.
    """
    moved = felt[:, None] & joints
    force = np.where(moved, damping, 0.0)
    return Damping(damping - force, force, timestep[:, None] * force)


def contact_softness(model: mujoco.MjModel, drawn: Draw) -> tuple[np.ndarray, np.ndarray]:
    """(N, geoms, 2) ``solref`` and (N, geoms, 5) ``solimp`` of every world: as drawn for athletes
    and ground, for links that rebound, and for hands and what they hold; else, and in the task's
    own worlds, the ``model``'s. A ball bounces in one time step, however long that of its world
    is."""
    solref, solimp = model.geom_solref, model.geom_solimp
    varied = ~drawn.own[:, None]
    ground = (yields(solref) & varied)[..., None]
    softness = np.stack((drawn.contact_time, drawn.contact_damping), axis=-1)[:, None]
    impedance = np.repeat(solimp[None], len(drawn.contact_impedance), axis=0)
    impedance[..., :2] = drawn.contact_impedance[:, None, None]
    own = np.repeat(solref[None], len(drawn.stride), axis=0)
    own[..., 1] /= np.where(is_bounce(solref), drawn.stride[:, None], 1)
    own[..., 0] = np.where(holds(solref) & varied, drawn.hold_time[:, None], own[..., 0])
    solref, solimp = np.where(ground, softness, own), np.where(ground, impedance, solimp[None])
    rebounds = drawn.rebound[:, None] & rebound_geoms(model)
    solref[rebounds], solimp[rebounds, :2] = REBOUND_SOLREF, REBOUND_IMPEDANCE
    return solref, solimp
