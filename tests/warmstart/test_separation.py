"""Rows that keep limbs apart, against MuJoCo's own collision detection on random poses."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import mujoco
import numpy as np
import pytest

from sports.humanoid.body import load_body
from sports.humanoid.mjcf import build_model
from warmstart.problems import jumper
from warmstart.rigid_body import to_full_state
from warmstart.separation import axis_balls, keep_apart

BODY = load_body("smpl")


def rows_of(model, straight=False):
    """The rows as one function of reduced coordinates; all must be at least 0."""
    captured = []
    program = SimpleNamespace(model=model, rows=lambda name, knots, build: captured.append(build))
    keep_apart(program, BODY, [0], straight)
    q = ca.SX.sym("q", model.n)
    out = []
    for build in captured:
        for _, expression, low, high in build(q, ca.SX.sym("p")):
            assert low == 0.0 and high == np.inf
            out.append(expression)
    return ca.Function("rows", [q], [ca.vertcat(*out)])


class Overlap:
    """How deep MuJoCo finds legs and hands in each other in poses of a jumper (m)."""

    def __init__(self, model):
        self.model, self.compiled = model, build_model(BODY)
        self.data = mujoco.MjData(self.compiled)
        bodies = [self.compiled.body(i).name.split("/")[-1] for i in range(self.compiled.nbody)]
        self.links = [bodies[i] for i in self.compiled.geom_bodyid]
        legs = {f"{s}_{n}" for s in "LR" for n in ("Hip", "Knee", "Ankle", "Toe")}
        self.limbs = legs | {f"{s}_{n}" for s in "LR" for n in ("Wrist", "Hand")}

    def deepest(self, q):
        zero = np.zeros((1, self.model.n))
        self.data.qpos[:] = to_full_state(self.model, q[None], zero, zero)[0][0]
        mujoco.mj_fwdPosition(self.compiled, self.data)
        pairs = [({self.links[g] for g in c.geom}, -c.dist) for c in self.data.contact]
        return max((depth for pair, depth in pairs if pair <= self.limbs), default=0.0)


def pose(model, rng, hip, knee):
    """Random legs, hips and knees bent within ranges (rad), and arms, high above the ground."""
    q = np.zeros(model.n)
    for side in "LR":
        q[model.index(f"{side}_Hip_x")] = rng.uniform(-0.3, 0.3)
        q[model.index(f"{side}_Hip_y")] = rng.uniform(*hip)
        q[model.index(f"{side}_Hip_z")] = rng.uniform(-0.3, 0.3)
        q[model.index(f"{side}_Knee_y")] = rng.uniform(*knee)
        q[model.index(f"{side}_Shoulder_z")] = rng.uniform(-2, 2)
    q[model.index("z")] = 3.0
    return q


def test_poses_that_satisfy_the_rows_do_not_overlap():
    model = jumper.make_model(BODY)
    rows, overlap = rows_of(model), Overlap(model)
    rng = np.random.default_rng(0)
    accepted = crossed = 0
    for _ in range(400):
        q = pose(model, rng, (-2.0, 0.6), (0.05, 2.2))
        deepest = overlap.deepest(q)
        satisfied = float(np.array(rows(q)).min()) >= 0.0
        accepted += satisfied
        crossed += deepest > 0.02
        assert not (satisfied and deepest > 0.02), deepest
    assert accepted > 20 and crossed > 10  # both kinds were tried


def test_hands_at_straight_knees_need_the_rows_for_them():
    """Folded forward over knees that are hardly bent, as at the landing of a long jump."""
    model = jumper.make_model(BODY)
    plain, straight, overlap = rows_of(model), rows_of(model, straight=True), Overlap(model)
    rng = np.random.default_rng(0)
    accepted = missed = 0
    for _ in range(300):
        q = pose(model, rng, (-2.1, -1.4), (0.05, 0.8))
        q[model.index("Torso_y")], q[model.index("Chest_y")] = rng.uniform(0.2, 0.5, 2)
        if float(np.array(plain(q)).min()) < 0.0:
            continue
        deepest = overlap.deepest(q)
        missed += deepest > 0.02
        if float(np.array(straight(q)).min()) >= 0.0:
            accepted += 1
            assert deepest <= 0.02
    assert accepted > 20 and missed > 0


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
