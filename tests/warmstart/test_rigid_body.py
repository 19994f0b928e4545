"""The CasADi recursion against Drake and against C MuJoCo, full body and reduced."""

import casadi as ca
import mujoco
import numpy as np
import pytest

from sports.humanoid.body import load_body
from sports.humanoid.drake_plant import build_plant, rotate
from sports.humanoid.mjcf import build_model
from warmstart.rigid_body import (
    from_full_state,
    load_tree,
    reduce_tree,
    state_function,
    to_full_state,
)

SAGITTAL = ["L_Hip_y", "R_Hip_y", "L_Knee_y", "R_Knee_y", "L_Ankle_y", "R_Toe_y", "Chest_x"]


def random_states(n, count=6, seed=0):
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.0, 1.0, (count, n))
    q[:, 3] = rng.uniform(-3.0, 3.0, count)
    return q, rng.normal(0, 3.0, (count, n)), rng.normal(0, 20.0, (count, n))


@pytest.mark.parametrize(
    ("name", "equipment", "free"),
    [("smpl", (), None), ("smplx", (), None), ("smpl", ("racket",), None), ("smpl", (), SAGITTAL)],
)
def test_inverse_dynamics_agrees_with_drake_and_mujoco(name, equipment, free):
    """Base wrench and joint torques, with forces at two feet, within 1e-9 of the largest."""
    body = load_body(name, strength="human", equipment=equipment)
    tree = load_tree(body)
    pose = {"L_Shoulder_x": -1.2, "R_Shoulder_x": 1.2, "L_Elbow_z": -0.7}
    model = reduce_tree(tree, tree.dofs if free is None else free, pose)
    q, v, a = (ca.SX.sym(c, model.n) for c in "qva")
    f = ca.SX.sym("f", 3, 2)
    links, points = ("L_Toe", "R_Ankle"), ((0.07, 0.04, -0.02), (-0.06, 0.0, -0.06))
    forces = [(tree.link(link), p, f[:, i]) for i, (link, p) in enumerate(zip(links, points))]
    casadi_id = ca.Function("id", [q, v, a, f], [model.inverse_dynamics(q, v, a, forces)])

    drake = build_plant(body, time_step=0.0, ground=False)
    plant, human = drake.plant, drake.humanoid
    context = plant.CreateDefaultContext()
    mj = build_model(body)
    data = mujoco.MjData(mj)
    worst = {"drake": 0.0, "mujoco": 0.0, "smooth": 0.0}
    rng = np.random.default_rng(1)
    for qk, vk, ak in zip(*random_states(model.n)):
        fk = rng.normal(0, 500.0, (3, 2))
        ours = np.array(casadi_id(qk, vk, ak, fk)).ravel()
        qpos, qvel, qacc = (x[0] for x in to_full_state(model, qk[None], vk[None], ak[None]))

        # Drake: M vdot + C - tau_g - J' f, mapped by power to MuJoCo's velocities.
        T = human.velocity_map(qpos[3:7])
        q_drake, v_drake = human.to_drake(qpos, qvel)
        _, vdot = human.to_drake(qpos, qacc)  # w_W dot = R (w_B dot): no extra term
        full_q, full_v, full_a = (
            np.zeros(plant.num_positions()),
            *np.zeros((2, plant.num_velocities())),
        )
        full_q[human.q_index], full_v[human.v_index] = q_drake, v_drake
        full_a[human.v_index] = vdot
        plant.SetPositions(context, full_q)
        plant.SetVelocities(context, full_v)
        from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces

        external = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, external)
        external.mutable_generalized_forces()[:] = 0.0  # drop joint damping
        for link, p, force in zip(links, points, fk.T):
            J = plant.CalcJacobianTranslationalVelocity(
                context,
                JacobianWrtVariable.kV,
                plant.GetFrameByName(link),
                p,
                plant.world_frame(),
                plant.world_frame(),
            )
            external.mutable_generalized_forces()[:] += J.T @ force
        drake_tau = T.T @ plant.CalcInverseDynamics(context, full_a, external)[human.v_index]
        scale = np.abs(drake_tau).max()
        worst["drake"] = max(worst["drake"], np.abs(ours - drake_tau).max() / scale)

        # MuJoCo: mj_inverse without contact or passive forces.
        mj.opt.disableflags |= (
            mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_DAMPER
        )
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos, qvel, qacc
        mujoco.mj_inverse(mj, data)
        mj_tau = np.array(data.qfrc_inverse)
        for link, p, force in zip(links, points, fk.T):
            body_id = 1 + body.link_index(link)
            p_W = data.xpos[body_id] + data.xmat[body_id].reshape(3, 3) @ np.array(p)
            J = np.zeros((3, mj.nv))
            mujoco.mj_jac(mj, data, J, None, p_W, body_id)
            mj_tau -= J.T @ force
        worst["mujoco"] = max(worst["mujoco"], np.abs(ours - mj_tau).max() / scale)
    print(f"{name} {equipment}: relative error {worst}")
    assert worst["drake"] < 1e-9
    assert worst["mujoco"] < 1e-9


def test_full_state_round_trip_and_rates():
    """Reduced -> MuJoCo -> reduced is the identity; qvel is the time derivative of qpos."""
    tree = load_tree(load_body("smpl"))
    model = reduce_tree(tree, SAGITTAL, {})
    q, v, a = random_states(model.n, count=4, seed=3)
    back = from_full_state(model, *to_full_state(model, q, v, a))
    for ours, again in zip((q, v, a), back):
        np.testing.assert_allclose(np.cos(ours - again), 1.0, atol=1e-9)
        np.testing.assert_allclose(ours[:, 4:], again[:, 4:], atol=1e-9)
    root, h = state_function(model), 1e-6
    for qk, vk, ak in zip(q, v, a):
        R0, w, alpha = (np.array(x) for x in root(qk, vk, ak))
        R1, w1, _ = (np.array(x) for x in root(qk + h * vk, vk + h * ak, ak))
        skew = R0.T @ (R1 - R0) / h
        np.testing.assert_allclose([skew[2, 1], skew[0, 2], skew[1, 0]], w.ravel(), atol=1e-3)
        np.testing.assert_allclose((w1 - w).ravel() / h, alpha.ravel(), rtol=1e-3, atol=1e-3)


def test_a_plant_without_a_link_is_named():
    tree = load_tree(load_body("smpl"))
    with pytest.raises(ValueError, match="no hinge 'L_Tail_x'"):
        reduce_tree(tree, ["L_Tail_x"], {})
    assert rotate(np.array([1.0, 0, 0, 0]), np.array([0.0, 1, 0])).tolist() == [0, 1, 0]
