"""Do the MuJoCo and the Drake athlete have the same dynamics? Figures, not opinions.

Compared on random states, MuJoCo's compiled MJCF against Drake's plant, joints by name: mass
matrix M (armature on both sides), bias forces C (Coriolis and centrifugal), gravity forces g,
centre of mass, link origins and rotations. Each figure is the largest difference divided by the
largest entry of MuJoCo's quantity over all states. Masses, gains, limits and the order of the
joints are compared as read back from the two compiled models.

Both are brought to MuJoCo's velocities (v_W, w_B, rates). With v_D = T(q) qvel, equal power
gives M_mj = T' M_D T, and C_mj = T' C_D because d/dt v_D = T d/dt qvel: the only rotating part
is R w_B, and d/dt (R w_B) = R d/dt w_B.
"""

# The stubs of Drake and MuJoCo type arrays, ports and modules more narrowly than they are.
# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from sports.humanoid.body import Body, equipment_names, load_body
from sports.humanoid.drake_plant import PlantModel, build_plant
from sports.humanoid.mjcf import body_name, build_model, dof_order

TOLERANCE = 1e-9
"""Largest allowed difference, relative to the largest entry of the quantity."""


@dataclass(frozen=True)
class ParityRow:
    """One compared quantity."""

    quantity: str
    mujoco: float | str
    """MuJoCo's largest entry (or a text: joint order, counts)."""
    drake: float | str
    difference: float
    """Largest difference relative to MuJoCo's largest entry; for texts 0 if equal, else 1."""
    unit: str
    tolerance: float = TOLERANCE

    @property
    def ok(self) -> bool:
        return self.difference <= self.tolerance


def body_variants() -> Iterator[tuple[str, tuple[str, ...]]]:
    """(body, equipment) for SMPL, SMPL-X, and each equipment on each body that has its link."""
    for name in ("smpl", "smplx"):
        yield name, ()
        for equipment in equipment_names():
            try:
                load_body(name, equipment=(equipment,))
            except ValueError:  # the body lacks the link the equipment replaces
                continue
            yield name, (equipment,)


def random_states(body: Body, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """MuJoCo states: qpos (count, 7 + n) and qvel (count, 6 + n), any root attitude.

    Root within metres of the origin, joints within +-1.2 rad and their limits, speeds of a few
    m/s and rad/s.
    """
    rng = np.random.default_rng(seed)
    n = body.num_dofs
    lower = np.maximum(body.array("lower"), -1.2)
    upper = np.minimum(body.array("upper"), 1.2)
    quat = rng.normal(size=(count, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    qpos = np.concatenate(
        [rng.normal(size=(count, 3)), quat, rng.uniform(lower, upper, (count, n))], axis=-1
    )
    return qpos, rng.normal(scale=2.0, size=(count, 6 + n))


def mujoco_dynamics(
    model: mujoco.MjModel, body: Body, qpos: np.ndarray, qvel: np.ndarray
) -> dict[str, np.ndarray]:
    """One state in MuJoCo: M (nv, nv), C (nv,), g (nv,), com (3,), p_WB (B, 3), R_WB (B, 3, 3)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    gravity = data.qfrc_bias.copy()
    data.qvel[:] = qvel
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    ids = [model.body(body_name(0, name)).id for name in body.link_names]
    return {
        "M": M,
        "C": data.qfrc_bias - gravity,
        "g": gravity,
        "com": data.subtree_com[ids[0]].copy(),
        "p_WB": data.xpos[ids].copy(),
        "R_WB": data.xmat[ids].reshape(-1, 3, 3).copy(),
    }


def drake_dynamics(model: PlantModel, qpos: np.ndarray, qvel: np.ndarray) -> dict[str, np.ndarray]:
    """The same quantities from Drake, in MuJoCo's velocity convention."""
    plant, humanoid = model.plant, model.humanoid
    context = plant.CreateDefaultContext()
    q, v = humanoid.to_drake(qpos, qvel)
    full_q, full_v = np.zeros(plant.num_positions()), np.zeros(plant.num_velocities())
    full_q[humanoid.q_index], full_v[humanoid.v_index] = q, v
    plant.SetPositions(context, full_q)
    plant.SetVelocities(context, full_v)
    v_index, T = humanoid.v_index, humanoid.velocity_map(q[:4])
    X_WB = [plant.EvalBodyPoseInWorld(context, link) for link in humanoid.links]
    return {
        "M": T.T @ plant.CalcMassMatrix(context)[np.ix_(v_index, v_index)] @ T,
        "C": T.T @ plant.CalcBiasTerm(context)[v_index],
        "g": -T.T @ plant.CalcGravityGeneralizedForces(context)[v_index],
        "com": plant.CalcCenterOfMassPositionInWorld(context, [humanoid.instance]),
        "p_WB": np.array([X.translation() for X in X_WB]),
        "R_WB": np.array([X.rotation().matrix() for X in X_WB]),
    }


_DYNAMICS = {
    "M": ("mass matrix", "kg, kg m, kg m^2"),
    "C": ("Coriolis and centrifugal forces", "N, N m"),
    "g": ("gravity forces", "N, N m"),
    "com": ("centre of mass", "m"),
    "p_WB": ("link origins", "m"),
    "R_WB": ("link rotations", "1"),
}


def dynamics_rows(body: Body, states: int = 50, seed: int = 0) -> list[ParityRow]:
    """Mass matrix, bias, gravity, centre of mass and kinematics on random states."""
    mj, drake = build_model(body), build_plant(body, time_step=0.0, ground=False)
    largest_mj, largest_drake, difference = (dict.fromkeys(_DYNAMICS, 0.0) for _ in range(3))
    for qpos, qvel in zip(*random_states(body, states, seed), strict=True):
        ours = mujoco_dynamics(mj, body, qpos, qvel)
        theirs = drake_dynamics(drake, qpos, qvel)
        for key in _DYNAMICS:
            largest_mj[key] = max(largest_mj[key], float(np.abs(ours[key]).max()))
            largest_drake[key] = max(largest_drake[key], float(np.abs(theirs[key]).max()))
            gap = float(np.abs(ours[key] - theirs[key]).max())
            difference[key] = max(difference[key], gap)
    return [
        ParityRow(
            f"{label}, {states} states",
            largest_mj[key],
            largest_drake[key],
            difference[key] / largest_mj[key],
            unit,
        )
        for key, (label, unit) in _DYNAMICS.items()
    ]


def parameter_rows(body: Body) -> list[ParityRow]:
    """Masses, gains, efforts, damping, armature, ranges and joint order of the two models."""
    mj, drake = build_model(body), build_plant(body, ground=False)
    plant, humanoid = drake.plant, drake.humanoid
    context = plant.CreateDefaultContext()
    order = dof_order(mj)
    joints = {joint.name(): joint for joint in humanoid.joints}
    actuators = {actuator.joint().name(): actuator for actuator in humanoid.actuators}
    address = [mj.joint(f"agent0/{name}").dofadr[0] for name in order]
    servo = [mj.actuator(f"agent0/{name}").id for name in order]
    ids = [mj.body(body_name(0, name)).id for name in body.link_names]

    def row(quantity: str, unit: str, ours: object, theirs: object) -> ParityRow:
        a, b = np.asarray(ours, dtype=float), np.asarray(theirs, dtype=float)
        scale = max(float(np.abs(a).max()), 1e-300)
        gap = float(np.abs(a - b).max()) / scale
        return ParityRow(quantity, float(np.abs(a).max()), float(np.abs(b).max()), gap, unit)

    links = [link.default_mass() for link in humanoid.links]
    by_position = [j.name() for j in sorted(humanoid.joints, key=lambda j: j.position_start())]
    rows = [
        row("total mass", "kg", mj.body_mass.sum(), plant.CalcTotalMass(context)),
        row("link masses", "kg", mj.body_mass[ids], links),
        row(
            "servo gain kp",
            "N m/rad",
            mj.actuator_gainprm[servo, 0],
            [actuators[name].get_controller_gains().p for name in order],
        ),
        row(
            "servo gain kd inside the limit",
            "N m s/rad",
            -mj.actuator_biasprm[servo, 2],
            [actuators[name].get_controller_gains().d for name in order],
        ),
        row(
            "joint damping kd",
            "N m s/rad",
            mj.dof_damping[address].reshape(len(order), -1)[:, 0],
            [joints[name].default_damping() for name in order],
        ),
        row(
            "effort limit",
            "N m",
            mj.actuator_forcerange[servo, 1],
            [actuators[name].effort_limit() for name in order],
        ),
        row(
            "armature",
            "kg m^2",
            mj.dof_armature[address],
            [actuators[name].default_reflected_inertia() for name in order],
        ),
        row(
            "joint ranges",
            "rad",
            [mj.joint(f"agent0/{name}").range for name in order],
            [[joints[n].position_lower_limit(), joints[n].position_upper_limit()] for n in order],
        ),
        row("gravity", "m/s^2", mj.opt.gravity, plant.gravity_field().gravity_vector()),
    ]
    same = set(order) == set(joints) and order == [dof.name for dof in body.dofs]
    rows.append(
        ParityRow(
            "joints, matched by name",
            f"{len(order)}: {order[0]} .. {order[-1]}",
            f"{len(by_position)}: {by_position[0]} .. {by_position[-1]}",
            0.0 if same else 1.0,
            "",
        )
    )
    return rows


def parity_table(body: Body, states: int = 50, seed: int = 0) -> list[ParityRow]:
    """Everything that must be equal before two engines are compared on a score."""
    return [*parameter_rows(body), *dynamics_rows(body, states, seed)]


def format_table(rows: list[ParityRow]) -> str:
    """Plain text, one row per quantity."""

    def text(value: float | str) -> str:
        return value if isinstance(value, str) else f"{value:.6g}"

    lines = [f"{'quantity':<46}{'MuJoCo':>28}{'Drake':>28}{'difference':>12}  ok"]
    for r in rows:
        label = f"{r.quantity} ({r.unit})" if r.unit else r.quantity
        lines.append(
            f"{label:<46}{text(r.mujoco):>28}{text(r.drake):>28}{r.difference:>12.1e}"
            f"  {'yes' if r.ok else 'NO'}"
        )
    return "\n".join(lines)
