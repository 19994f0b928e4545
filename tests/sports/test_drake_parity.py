"""The MuJoCo and the Drake athlete have the same dynamics; each test prints its figure.

``pytest -q -s tests -k parity`` shows the figures, and so does the summary line of each test.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("pydrake")

from sports.humanoid.body import load_body
from sports.humanoid.drake_plant import build_plant
from sports.humanoid.parity import (
    body_variants,
    dynamics_rows,
    format_table,
    parameter_rows,
    random_states,
)

STATES = 50
TOLERANCE = 1e-9
VARIANTS = list(body_variants())


@pytest.mark.parametrize(("name", "equipment"), VARIANTS, ids=lambda v: "+".join(v) or "bare")
def test_parity_dynamics(name, equipment, capsys):
    rows = dynamics_rows(load_body(name, equipment=equipment), states=STATES)
    label = "+".join((name, *equipment))
    worst = max(rows, key=lambda row: row.difference)
    with capsys.disabled():
        print(
            f"\nparity {label:<14} {STATES} states: "
            + ", ".join(f"{r.quantity.split(',')[0]} {r.difference:.1e}" for r in rows)
        )
    assert len(rows) == 6
    assert worst.difference < TOLERANCE, format_table(rows)


@pytest.mark.parametrize("strength", ["paper", "human"])
@pytest.mark.parametrize("limits", ["paper", "anatomical"])
@pytest.mark.parametrize("name", ["smpl", "smplx"])
def test_parity_parameters(name, strength, limits):
    rows = parameter_rows(load_body(name, strength=strength, limits=limits))
    assert all(row.ok for row in rows), format_table(rows)


def test_parity_every_equipment_is_covered():
    covered = {e for _, equipment in VARIANTS for e in equipment}
    assert {"club", "racket", "paddle", "sword", "gloves"} <= covered
    assert ("smplx", ("racket",)) in VARIANTS


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31 - 1))
def test_state_map_round_trip(seed):
    body = load_body()
    humanoid = build_plant(body, ground=False).humanoid
    qpos, qvel = random_states(body, 3, seed)
    back_qpos, back_qvel = humanoid.from_drake(*humanoid.to_drake(qpos, qvel))
    np.testing.assert_allclose(back_qpos, qpos, atol=1e-14)
    np.testing.assert_allclose(back_qvel, qvel, atol=1e-13)


def test_state_map_gives_the_speed_of_a_moving_point():
    """Drake's velocity of a hand equals the finite difference of its position along qvel."""
    body = load_body()
    model = build_plant(body, time_step=0.0, ground=False)
    plant, humanoid = model.plant, model.humanoid
    context = plant.CreateDefaultContext()
    (qpos,), (qvel,) = random_states(body, 1, 4)
    hand = humanoid.links[body.link_index("R_Hand")]

    def place(qpos, qvel):
        q, v = humanoid.to_drake(qpos, qvel)
        full_q, full_v = np.zeros(plant.num_positions()), np.zeros(plant.num_velocities())
        full_q[humanoid.q_index], full_v[humanoid.v_index] = q, v
        plant.SetPositions(context, full_q)
        plant.SetVelocities(context, full_v)
        return plant.EvalBodyPoseInWorld(context, hand).translation().copy()

    import mujoco

    from sports.humanoid.mjcf import build_model

    mj = build_model(body)
    h = 1e-6
    ahead, behind = qpos.copy(), qpos.copy()
    mujoco.mj_integratePos(mj, ahead, qvel, h)
    mujoco.mj_integratePos(mj, behind, qvel, -h)
    difference = (place(ahead, qvel) - place(behind, qvel)) / (2 * h)
    place(qpos, qvel)
    V_WB = plant.EvalBodySpatialVelocityInWorld(context, hand)
    np.testing.assert_allclose(V_WB.translational(), difference, atol=1e-6)


def test_wrong_width_is_named():
    humanoid = build_plant(load_body(), ground=False).humanoid
    with pytest.raises(ValueError, match="76 positions and 75 velocities, not 7 and 75"):
        humanoid.to_drake(np.zeros(7), np.zeros(75))


def test_tamsi_is_refused():
    with pytest.raises(ValueError, match="ignores PD gains"):
        build_plant(load_body(), contact_approximation="tamsi")


def test_no_self_contact_in_the_t_pose_and_contact_points_match_mujoco():
    """Points that touch the ground are MuJoCo's: sole corners, at the same places."""
    import mujoco

    from sports.humanoid.mjcf import build_model

    body = load_body()
    mj = build_model(body)
    data = mujoco.MjData(mj)
    qpos = np.zeros(mj.nq)
    qpos[2], qpos[3] = body.standing_height(clearance=-0.001), 1.0
    data.qpos[:] = qpos
    mujoco.mj_forward(mj, data)
    expected = sorted(tuple(np.round(c.pos[:2], 4)) for c in data.contact)

    model = build_plant(body)
    plant, humanoid = model.plant, model.humanoid
    root = model.diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    q, _ = humanoid.to_drake(qpos, np.zeros(75))
    full = np.zeros(plant.num_positions())
    full[humanoid.q_index] = q
    plant.SetPositions(context, full)
    query = plant.get_geometry_query_input_port().Eval(context)
    pairs = query.ComputePointPairPenetration()
    found = sorted(tuple(np.round((p.p_WCa + p.p_WCb)[:2] / 2, 4)) for p in pairs)
    assert len(found) >= 8
    np.testing.assert_allclose(found, expected, atol=2e-4)
