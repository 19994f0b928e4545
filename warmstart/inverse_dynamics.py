"""What forces does a motion need? Asked of MuJoCo and of Drake, each by its own algorithm.

Both models come from the body table and from nothing else; contact forces enter at the links'
points by each engine's own kinematics. Their agreement is a figure of the certificate.
"""

# The stubs of Drake type arrays more narrowly than they are.
# pyright: reportArgumentType=false

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from sports.humanoid.body import Body
from sports.humanoid.mjcf import body_name, build_model
from warmstart.solution import Solution


def needed(
    compute: Callable[[Solution, dict[str, np.ndarray], Body], np.ndarray],
    solution: Solution,
    times: np.ndarray,
) -> np.ndarray:
    """(T, nv) forces that a solution needs at times (T,) s, by one of the functions below.

    While a hand opens, the share of the payload that it still holds counts: inverse dynamics is
    linear in the masses.
    """
    motion, share = solution.sample(times), solution.loaded(times)
    out = compute(solution, motion, solution.body)
    if share.min() < 1.0:
        empty = compute(solution, motion, solution.empty_handed)
        out = share[:, None] * out + (1.0 - share[:, None]) * empty
    return out


def inverse_dynamics_mujoco(
    solution: Solution, motion: dict[str, np.ndarray], body: Body | None = None
) -> np.ndarray:
    """(T, nv) forces needed besides gravity, damping and contact, by MuJoCo.

    The first three act on the root in world axes (N), the next three are the moment about its
    origin in the root's axes (N m); both are zero for a true motion. The rest are servo torques.
    """
    model = build_model(body or solution.body)
    model.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    )
    data = mujoco.MjData(model)
    links = [model.body(body_name(0, link)).id for link, _ in solution.contact_points]
    out, jac = np.zeros((len(motion["qpos"]), model.nv)), np.zeros((3, model.nv))
    for t in range(len(out)):
        data.qpos[:], data.qvel[:] = motion["qpos"][t], motion["qvel"][t]
        data.qacc[:] = motion["qacc"][t]
        mujoco.mj_inverse(model, data)
        out[t] = data.qfrc_inverse
        for c, (_, point) in enumerate(solution.contact_points):
            where = data.xpos[links[c]] + data.xmat[links[c]].reshape(3, 3) @ np.array(point)
            mujoco.mj_jac(model, data, jac, None, where, links[c])
            out[t] -= jac.T @ motion["contact_force"][t, c]
    return out


def inverse_dynamics_drake(
    solution: Solution, motion: dict[str, np.ndarray], body: Body | None = None
) -> np.ndarray:
    """(T, nv) the same as :func:`inverse_dynamics_mujoco`, by Drake, in MuJoCo's coordinates."""
    from pydrake.multibody.math import SpatialForce
    from pydrake.multibody.tree import MultibodyForces

    from sports.humanoid.drake_plant import build_plant, rotate

    built = build_plant(body or solution.body, time_step=0.0, ground=False)
    plant, human = built.plant, built.humanoid
    context = plant.CreateDefaultContext()
    world = plant.world_frame()
    points = [
        (human.links[solution.body.link_index(link)], np.array(point))
        for link, point in solution.contact_points
    ]
    quat = motion["qpos"][:, 3:7]
    out = np.zeros((len(quat), 6 + solution.body.num_dofs))
    q, v, a = (np.zeros(n) for n in (plant.num_positions(), *[plant.num_velocities()] * 2))
    for t in range(len(out)):
        q[human.q_index], v[human.v_index] = human.to_drake(motion["qpos"][t], motion["qvel"][t])
        qacc = motion["qacc"][t]
        spin_up = rotate(quat[t], qacc[3:6])  # d/dt (R w_B) = R d/dt w_B
        a[human.v_index] = np.concatenate([spin_up, qacc[:3], qacc[6:]])
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)  # gravity and joint damping
        for c, (link, point) in enumerate(points):
            push = SpatialForce(tau=np.zeros(3), f=motion["contact_force"][t, c])
            arm = link.body_frame().CalcRotationMatrixInWorld(context).matrix() @ point
            link.AddInForce(context, arm, push, world, forces)
        tau = plant.CalcInverseDynamics(context, a, forces)[human.v_index]
        out[t] = human.velocity_map(quat[t]).T @ tau
    return out
