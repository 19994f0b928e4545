"""The penalty kick: closed forms, Drake's mass matrix, and a recorded solution by other code."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from sports.humanoid.body import load_body
from sports.humanoid.drake_plant import build_plant
from sports.humanoid.mjcf import build_model
from sports.humanoid.parity import drake_dynamics
from sports.penalty_kick import SPOT
from sports.soccer import BALL_MASS, BALL_RADIUS, HALF_LENGTH, RESTITUTION
from warmstart import kick
from warmstart.certificate import certify, required
from warmstart.demonstration import name_of
from warmstart.inverse_dynamics import inverse_dynamics_drake, inverse_dynamics_mujoco
from warmstart.judged import RULES
from warmstart.outcome import link_poses
from warmstart.problems import get_problem, jumper, penalty_kick, striker
from warmstart.replay import scene_of
from warmstart.solution import Solution

DATA = Path(__file__).parent / "data"
G = 9.81
START = np.array([*SPOT, BALL_RADIUS])


@pytest.fixture(scope="module")
def kicked() -> Solution:
    return Solution.load(DATA / "penalty_kick_15_human.npz")


# The ball's way.


@pytest.mark.parametrize("target", [(-1.8, 0.2), (0.0, 1.0), (1.5, 1.4)])
@pytest.mark.parametrize("speed", [15.0, 22.0])
def test_the_parabola_meets_its_target(speed, target):
    """Stepped in small steps under gravity alone, by no formula of the range."""
    velocity = speed * kick.direction(speed, target)
    assert np.linalg.norm(velocity) == pytest.approx(speed)
    place, dt = START.copy(), 1e-5
    while place[0] < HALF_LENGTH:
        velocity[2] -= 0.5 * G * dt
        place += dt * velocity
        velocity[2] -= 0.5 * G * dt
    np.testing.assert_allclose(place[1:], target, atol=2e-3)
    np.testing.assert_allclose(
        kick.passes(START, speed * kick.direction(speed, target)), target, atol=1e-9
    )


def test_a_mirrored_target_asks_for_the_mirrored_direction():
    mirror = np.array([1.0, -1.0, 1.0])
    left, right = (kick.direction(16.0, (side * 1.2, 0.9)) for side in (1.0, -1.0))
    np.testing.assert_allclose(left, mirror * right, atol=1e-12)


def test_a_ball_that_does_not_come_or_rolls():
    assert np.isnan(kick.passes(START, np.array([-1.0, 0.0, 0.0]))).all()
    rolling = kick.passes(START, np.array([12.0, 1.0, 0.0]))
    np.testing.assert_allclose(rolling, (1.0, BALL_RADIUS))


@pytest.mark.parametrize("mass", [0.3, 1.0, 1e9])
def test_the_gain_conserves_momentum_and_gives_back_restitution(mass):
    """A foot as a free mass at u against a ball at rest: the textbook's central impact."""
    u = 10.0
    ball = kick.gain(mass) * u
    foot = u - BALL_MASS * ball / mass
    assert ball - foot == pytest.approx(RESTITUTION * u, rel=1e-6)
    assert 0.5 * BALL_MASS * ball**2 + 0.5 * mass * foot**2 <= 0.5 * mass * u**2 + 1e-6 * mass
    assert kick.foot_speed(kick.gain(kick.EFFECTIVE_MASS) * u) == pytest.approx(u)


def test_the_effective_mass_by_drakes_mass_matrix():
    """1 / n' J M^-1 J' n with Drake's M."""
    body = load_body("smpl", strength="human")
    qpos = np.zeros(7 + body.num_dofs)
    qpos[2:4] = 1.0
    qpos[7:] = np.random.default_rng(3).uniform(-0.4, 0.4, body.num_dofs)
    n = body.num_dofs + 6
    mass = drake_dynamics(build_plant(body, time_step=0.0, ground=False), qpos, np.zeros(n))["M"]
    point, normal = np.array(kick.face(body)), np.array([0.9, 0.1, 0.3])
    normal /= np.linalg.norm(normal)
    model = build_model(body)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    i = 1 + body.link_index(kick.LINK)
    jac = np.zeros((3, n))
    where = data.xpos[i] + data.xmat[i].reshape(3, 3) @ point
    mujoco.mj_jac(model, data, jac, None, where, i)
    push = normal @ jac
    expected = 1.0 / (push @ np.linalg.solve(mass, push))
    found = kick.effective_mass(body, qpos, kick.LINK, point, normal)
    assert found == pytest.approx(expected, rel=1e-6)
    assert 0.1 < found < body.mass


# A solution, checked by other code.


def test_the_motion_obeys_both_engines_at_every_knot(kicked):
    weight = kicked.body.mass * G
    names = ("qpos", "qvel", "qacc", "contact_force")
    motion = {field: getattr(kicked, field) for field in names}
    for compute in (inverse_dynamics_mujoco, inverse_dynamics_drake):
        tau = compute(kicked, motion, kicked.body)
        assert np.abs(tau[:, :6]).max() / weight < 1e-5
        np.testing.assert_allclose(tau[:, 6:], kicked.torque, atol=1e-4)
    share = np.abs(kicked.torque) / kicked.body.array("effort")
    assert share.max() <= striker.SHARE + 1e-5


def test_the_foot_meets_the_ball_where_it_lies(kicked):
    """By MuJoCo's kinematics: the front of the toes touches the ball on the spot, moving along its
    own normal, which is where a ball without friction goes; the left foot stands beside it."""
    event, body = kicked.stats["event"], kicked.body
    model = build_model(body)
    data = mujoco.MjData(model)
    k = int(np.argmin(np.abs(kicked.times - event["time"])))
    data.qpos[:], data.qvel[:] = kicked.qpos[k], kicked.qvel[k]
    mujoco.mj_forward(model, data)
    i = 1 + body.link_index(kick.LINK)
    turn = data.xmat[i].reshape(3, 3)
    where = data.xpos[i] + turn @ np.array(kick.face(body))
    normal = turn @ np.array(kick.AXIS)
    np.testing.assert_allclose(where + BALL_RADIUS * normal, START, atol=1e-4)
    jac = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jac, None, where, i)
    velocity = jac @ data.qvel
    np.testing.assert_allclose(np.cross(velocity, normal), 0.0, atol=1e-3)
    np.testing.assert_allclose(
        normal, kick.direction(kicked.asked["ball_speed"], kicked.stats["target"]), atol=1e-4
    )
    pos, _ = link_poses(body, kicked.qpos)
    toe = pos[:, body.link_index("L_Toe")]
    assert np.ptp(toe, axis=0).max() < 1e-3
    assert toe[0, 1] > SPOT[1] + BALL_RADIUS
    np.testing.assert_allclose(kicked.qvel[0], 0.0, atol=1e-9)


def test_it_is_certified_and_the_ball_flies_in_both_engines(kicked):
    certificate = certify(kicked)
    assert certificate.passed, certificate.failures
    asked = kicked.asked["ball_speed"]
    assert certificate.achieved["planned"] == pytest.approx(asked, rel=0.05)
    values = {c.name: c.value for c in certificate.checks}
    for engine in ("mujoco", "drake"):
        assert values[f"replay in {engine}: miss"] < 0.03
        assert certificate.achieved[f"replay_{engine}"] == pytest.approx(asked, rel=0.1)
        # The engine's own ball, by its own contact: it passes the goal plane near its target.
        assert values[f"replay in {engine}: ball: speed"] == pytest.approx(asked, rel=0.15)
        assert values[f"replay in {engine}: ball: off target"] < 2.0
    assert name_of(kicked).startswith("penalty_kick_15mps_human")
    assert get_problem("penalty_kick").unit == RULES["penalty_kick"].unit == "m/s"


def test_a_spoiled_kick_is_refused(kicked, monkeypatch):
    monkeypatch.setattr("warmstart.certificate._replay", lambda *_: {})
    event = dict(kicked.stats["event"])
    faster = event | {"velocity": [1.2 * v for v in event["velocity"]]}
    aside = event | {"place": [event["place"][0], event["place"][1] + 0.01, event["place"][2]]}
    for stats, words in (
        (kicked.stats | {"event": faster}, "planned speed off"),
        (kicked.stats | {"event": aside}, "planned miss"),
        (kicked.stats | {"target": [1.5, 1.5]}, "planned off target"),
        ({k: v for k, v in kicked.stats.items() if k != "target"}, "planned outcome"),
    ):
        found = certify(replace(kicked, stats=stats))
        assert not found.passed
        assert any(words in f for f in found.failures)
        assert any("replay in drake: miss" in f for f in found.failures)
    assert "planned depth in the ball before the impact" in required("penalty_kick")


def test_the_clip_is_played_in_the_tasks_own_scene(kicked):
    from warmstart.clip import clip_from_solution

    world = scene_of(clip_from_solution(kicked))
    assert "ball" in [o.name for o in world.objects]


@pytest.mark.slow
def test_a_neighbours_kick_comes_from_this_one(kicked):
    """A little faster and to another target."""
    config = penalty_kick.Config(ball_speed=15.2, target=(0.6, 0.8), max_iterations=120)
    solution = penalty_kick.solve(config, guess=kicked)
    print(jumper.shown(solution))
    assert solution.stats["max_violation"] < 1e-5
    event = solution.stats["event"]
    apart = START - np.array(event["place"])
    np.testing.assert_allclose(apart, BALL_RADIUS * np.array(event["normal"]), atol=1e-9)
    assert np.linalg.norm(event["velocity"]) == pytest.approx(kick.foot_speed(15.2))


def test_impossible_options_are_one_sentence():
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"ball_speed": 99.0}, "ball_speed must lie"),
        ({"ball_speed": 12.0, "target": (1.5, 1.5)}, "lobbed"),
        ({"target": (3.0, 1.0)}, "target y must lie"),
        ({"target": (0.0, 2.5)}, "target z must lie"),
        ({"detail": 9.0}, "detail must lie"),
    )
    for options, words in cases:
        with pytest.raises(ValueError, match=words):
            penalty_kick.Config(**options)
