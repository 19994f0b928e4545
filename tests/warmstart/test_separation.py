"""Rows that keep limbs apart, against MuJoCo's own collision detection on random poses."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from warmstart.separation import axis_balls, keep_apart

ca = pytest.importorskip("casadi")
BODY = load_body("smpl")


def rows_of(model):
    """The rows as one function of reduced coordinates; all must be at least 0."""
    captured = []
    program = SimpleNamespace(model=model, rows=lambda name, knots, build: captured.append(build))
    keep_apart(program, BODY, [0])
    q = ca.SX.sym("q", model.n)
    out = []
    for build in captured:
        for _, expression, low, high in build(q, ca.SX.sym("p")):
            assert low == 0.0 and high == np.inf
            out.append(expression)
    return ca.Function("rows", [q], [ca.vertcat(*out)])


def test_poses_that_satisfy_the_rows_do_not_overlap():
    from warmstart.problems import jumper
    from warmstart.rigid_body import to_full_state

    model = jumper.make_model(BODY)
    rows = rows_of(model)
    compiled = build_model(BODY)
    data = mujoco.MjData(compiled)
    names = [compiled.body(i).name.split("/")[-1] for i in range(compiled.nbody)]
    legs = {f"{s}_{n}" for s in "LR" for n in ("Hip", "Knee", "Ankle", "Toe")}
    hands = {f"{s}_{n}" for s in "LR" for n in ("Wrist", "Hand")}
    rng = np.random.default_rng(0)
    accepted = crossed = 0
    for _ in range(400):
        q = np.zeros(model.n)
        for side in "LR":
            q[model.index(f"{side}_Hip_x")] = rng.uniform(-0.3, 0.3)
            q[model.index(f"{side}_Hip_y")] = rng.uniform(-2.0, 0.6)
            q[model.index(f"{side}_Hip_z")] = rng.uniform(-0.3, 0.3)
            q[model.index(f"{side}_Knee_y")] = rng.uniform(0.05, 2.2)
            q[model.index(f"{side}_Shoulder_z")] = rng.uniform(-2, 2)
        q[model.index("z")] = 3.0
        zero = np.zeros((1, model.n))
        data.qpos[:] = to_full_state(model, q[None], zero, zero)[0][0]
        mujoco.mj_fwdPosition(compiled, data)
        deepest = 0.0
        for contact in data.contact:
            pair = {names[compiled.geom_bodyid[g]] for g in contact.geom}
            if pair <= legs | hands:
                deepest = max(deepest, -contact.dist)
        satisfied = float(np.array(rows(q)).min()) >= 0.0
        accepted += satisfied
        crossed += deepest > 0.02
        assert not (satisfied and deepest > 0.02), deepest
    assert accepted > 20 and crossed > 10  # both kinds were tried


@pytest.mark.parametrize("link", ["L_Hip", "R_Knee", "L_Toe", "R_Ankle", "R_Hand"])
def test_balls_lie_on_the_axis_of_their_shape(link):
    shape = BODY.links[BODY.link_index(link)].shapes[0]
    balls = axis_balls(BODY, link, 3)
    assert len(balls) == (3 if shape.kind == "capsule" else 2 if link == "R_Ankle" else 1)
    if link == "R_Ankle":  # the balls reach heel and front of the foot
        reach = [b.center[0] + s * b.radius for b, s in zip(balls, (-1, 1))]
        front = shape.center[0] + np.array([-1, 1]) * shape.size[0]
        assert np.allclose(reach, front)
    middle = np.mean([b.center for b in balls], axis=0)
    end = shape.center if shape.end is None else shape.end
    assert np.allclose(middle, (np.array(shape.center) + end) / 2)
    assert min(shape.size) <= balls[0].radius <= max(shape.size)
