"""The golf stroke against closed forms, the compiled ball law, the task's scene and MuJoCo."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from sports import golf as course
from sports.ball import BALLS, landing
from sports.humanoid.body import load_body
from sports.humanoid.mjcf import body_name, build_model
from warmstart import rotation, shot, tee_shot
from warmstart.certificate import certify, required
from warmstart.demonstration import name_of, strike_clip
from warmstart.inverse_dynamics import inverse_dynamics_drake, inverse_dynamics_mujoco
from warmstart.judged import RULES
from warmstart.outcome import link_poses
from warmstart.problems import get_problem, golf, jumper, striker
from warmstart.solution import Solution
from warmstart.strike import Moment

DATA = Path(__file__).parent / "data"
G = 9.81


@pytest.fixture(scope="module")
def body():
    return load_body("smpl", strength="human", equipment=["club"])


@pytest.fixture(scope="module")
def stroke() -> Solution:
    return Solution.load(DATA / "golf_9_human.npz")


@pytest.fixture(scope="module")
def swing() -> Solution:
    return Solution.load(DATA / "golf_20_human.npz")


@pytest.fixture(scope="module")
def certificate(stroke):
    return certify(stroke)


def moment(velocity, normal, turn=None) -> Moment:
    turn = np.eye(3) if turn is None else turn
    return Moment(0.0, 0.0, np.zeros(3), np.array(velocity), turn, np.array(normal))


# The ball's way.


def test_the_ball_lies_where_the_task_tees_it(body):
    """And the planned face touches it at one point, behind it."""
    scene = tee_shot.scene(body)
    (ball,) = scene.objects
    np.testing.assert_allclose(ball.pos, (0.0, 0.0, tee_shot.LYING))
    (start,) = scene.agents
    config = golf.Config(loft=7.0)
    event = golf.make_event(config, body)
    # As placed: the athlete's own frame is turned and shifted to where the task has it.
    turn = rotation.exp(np.array([0.0, 0.0, start.yaw]))
    told = event.at(0.0, start.x, start.y, start.yaw)
    apart = np.array(ball.pos) - np.array(told["place"])
    np.testing.assert_allclose(apart, course.BALL.radius * np.array(told["normal"]), atol=1e-12)
    np.testing.assert_allclose(
        told["normal"], (math.cos(math.radians(7)), 0.0, math.sin(math.radians(7))), atol=1e-12
    )
    assert told["velocity"][0] > 0.0 and abs(told["velocity"][1]) < 1e-12
    np.testing.assert_allclose(rotation.rotate(turn, np.array([1.0, 0, 0])), (0, -1, 0), atol=1e-12)


def test_face_and_corners_are_those_of_the_scenes_head(body):
    """The head as the engines' ball law has it, a box of the scene."""
    head = tee_shot.scene(body).surfaces[course.HEAD]
    corners, face = tee_shot.head_corners(body), np.array(tee_shot.face_point(body))
    np.testing.assert_allclose(corners.min(0), np.array(head.center) - np.array(head.size))
    np.testing.assert_allclose(corners.max(0), np.array(head.center) + np.array(head.size))
    front = corners[corners[:, 0] > head.center[0]]
    np.testing.assert_allclose(front.mean(0), face, atol=1e-12)


def test_a_vertical_face_through_the_clubs_centre_gives_the_textbooks_speed(monkeypatch, body):
    """Level blow on the ball by a club whose centre of mass is behind the contact: u (1 + e) M /
    (M + m), and no spin."""
    mass, u = 0.45, 9.0
    tool = np.zeros(10)
    tool[0], tool[1:4], tool[4:7] = mass, (0.0, 0.0, 0.0), 1.0 / (mass * 0.01)
    monkeypatch.setattr(shot, "tool_numbers", lambda scene: tool)
    point = np.array([0.05, 0.0, 0.0])
    ball = tee_shot.struck(body, moment((u, 0, 0), (1, 0, 0)), point)
    law = BALLS["golf"]
    expected = u * (1 + law.tool_restitution) * mass / (mass + law.mass)
    np.testing.assert_allclose(ball.linvel, (expected, 0.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(ball.angvel, 0.0, atol=1e-6)


@pytest.mark.parametrize("loft", [0.0, 8.0, 14.0])
def test_loft_raises_the_ball_and_spins_it_backwards(body, loft):
    """A level blow: the ball leaves between the path of the club and the normal of the face, its
    top turning back; in the world mirrored across the line of play, with the club held from the
    other side, it leaves as mirrored."""
    a = math.radians(loft)
    normal = np.array([math.cos(a), 0.0, math.sin(a)])
    point, balls = np.array(tee_shot.face_point(body)), []
    for side in (1.0, -1.0):
        # The shaft comes down from the athlete at half a right angle.
        shaft = np.array([0.0, side, 1.0]) / math.sqrt(2)
        y = shaft - (shaft @ normal) * normal
        y /= np.linalg.norm(y)
        turn = np.stack([normal, y, np.cross(normal, y)], 1)
        balls.append(tee_shot.struck(body, moment((9.0, 0, 0), normal, turn), point))
    left, right = balls
    angle = tee_shot.flight(left)["launch angle"]
    assert -1.0 < angle <= loft + 1e-9
    if loft:
        assert angle > 0.6 * loft
        assert left.angvel[1] < 0.0
    mirror = np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(left.linvel, mirror * right.linvel, atol=1e-9)
    np.testing.assert_allclose(left.angvel, -mirror * right.angvel, atol=1e-6)


def test_the_flight_is_that_of_the_compiled_law_and_nearly_the_parabola():
    """Carry and side by ``sports.ball.landing``; the vacuum's range is an upper bound."""
    v = np.array([11.0, 0.8, 3.0])
    ball = shot.Ball(0.0, np.array([0.0, 0.0, tee_shot.LYING]), v, np.array([0.0, -60.0, 0.0]))
    found = tee_shot.flight(ball)
    state = [torch.tensor(x[None], dtype=torch.float32) for x in (ball.pos, v, ball.angvel)]
    spot, _ = landing("golf", *state, course.BALL.radius)
    np.testing.assert_allclose((found["carry"], found["aside"]), spot[0, :2], atol=5e-3)
    drop = tee_shot.LYING - course.BALL.radius
    time = (v[2] + math.sqrt(v[2] ** 2 + 2 * G * drop)) / G
    still = replace(ball, angvel=np.zeros(3))  # no lift
    assert 0.9 * v[0] * time < tee_shot.flight(still)["carry"] < v[0] * time
    assert found["launch speed"] == pytest.approx(np.linalg.norm(v))
    assert found["launch angle"] == pytest.approx(math.degrees(math.asin(3.0 / np.linalg.norm(v))))


def test_a_ball_that_stays_on_its_tee_goes_nowhere():
    lying = shot.Ball(0.0, np.array([0.0, 0.0, tee_shot.LYING]), np.zeros(3), np.zeros(3))
    assert set(tee_shot.flight(lying).values()) == {0.0}


def test_the_head_over_the_ground_is_that_of_mujocos_geometry(body):
    """Against the lowest corner of MuJoCo's own geom, for hand-made poses."""
    model = build_model(body)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    i = model.body(body_name(0, course.TOOL)).id
    box = [g for g in range(model.ngeom) if model.geom_bodyid[g] == i and model.geom_type[g] == 6]
    rows, expected = [], []
    for _ in range(5):
        data.qpos[:] = 0.3 * rng.standard_normal(model.nq)
        data.qpos[2], data.qpos[3:7] = 1.2, (1.0, 0.0, 0.0, 0.0)
        mujoco.mj_forward(model, data)
        (g,) = box
        reach = np.abs(data.geom_xmat[g].reshape(3, 3)[2]) @ model.geom_size[g]
        expected.append(data.geom_xpos[g][2] - reach)
        rows.append(data.qpos.copy())
    for row, low in zip(rows, expected, strict=True):
        assert tee_shot.over_the_ground(body, row[None]) == pytest.approx(low, abs=1e-9)
    assert tee_shot.over_the_ground(body, np.array(rows)) == pytest.approx(min(expected), abs=1e-9)


# A solution, checked by other code.


def test_the_motion_obeys_both_engines_at_every_knot(stroke):
    """No force on the root, torques as stored and within the limits; both soles carry."""
    weight, effort = stroke.body.mass * G, stroke.body.array("effort")
    names = ("qpos", "qvel", "qacc", "contact_force")
    motion = {field: getattr(stroke, field) for field in names}
    for compute in (inverse_dynamics_mujoco, inverse_dynamics_drake):
        tau = compute(stroke, motion, stroke.body)
        assert np.abs(tau[:, :6]).max() / weight < 1e-5
        np.testing.assert_allclose(tau[:, 6:], stroke.torque, atol=1e-4)
    assert (np.abs(stroke.torque) / effort).max() <= striker.SHARE + 1e-5
    sides = np.array([link[0] for link, _ in stroke.contact_points])
    for side in "LR":
        up = stroke.contact_force[:, sides == side, 2].sum(1) / weight
        assert up.min() > golf.BOTH - 1e-4


def test_the_face_meets_the_ball_as_asked(stroke):
    """By MuJoCo's kinematics at the knot of the event."""
    event, body = stroke.stats["event"], stroke.body
    model = build_model(body)
    data = mujoco.MjData(model)
    k = int(np.argmin(np.abs(stroke.times - event["time"])))
    data.qpos[:], data.qvel[:] = stroke.qpos[k], stroke.qvel[k]
    mujoco.mj_forward(model, data)
    i = 1 + body.link_index(event["link"])
    turn = data.xmat[i].reshape(3, 3)
    where = data.xpos[i] + turn @ np.array(event["point"])
    jac = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jac, None, where, i)
    velocity = jac @ data.qvel
    assert np.linalg.norm(velocity) == pytest.approx(9.0, abs=1e-4)
    loft, attack = (math.degrees(math.asin(x)) for x in (turn[2, 0], velocity[2] / 9.0))
    assert loft == pytest.approx(11.0, abs=1e-3) and attack == pytest.approx(2.0, abs=1e-2)
    # The ball's centre is one radius before the face, on its tee at the origin.
    centre = where + course.BALL.radius * turn[:, 0]
    np.testing.assert_allclose(centre, (0.0, 0.0, course.TEE_HEIGHT + 0.02135), atol=1e-5)
    assert velocity[0] > 8.9 and abs(velocity[1]) < 1e-4


def test_it_begins_at_address_takes_the_club_back_and_follows_through(stroke):
    """A golf stroke: still at first with the head behind the ball, turned round on the far side,
    the hands together all the time, club and hands past the ball at the end."""
    body = stroke.body
    pos, quat = link_poses(body, stroke.qpos)
    hand = body.link_index("R_Hand")
    point = np.broadcast_to(np.array(stroke.stats["event"]["point"]), (len(pos), 3))
    face = pos[:, hand] + rotation.rotate(quat[:, hand], point)
    np.testing.assert_allclose(stroke.qvel[0], 0.0, atol=1e-9)
    assert -0.2 < face[0, 0] < -course.BALL.radius and abs(face[0, 1]) < 0.05
    top = stroke.phases[0][2]
    assert stroke.phases[0][0] == "back" and face[top, 0] < -0.5 and face[top, 2] > 0.5
    assert abs(np.gradient(face[:, 0], stroke.times)[top]) < 1.0
    assert face[-1, 0] > 0.5 and face[-1, 2] > golf.CLUB_UP - 1e-6
    left = pos[:, body.link_index("L_Hand")]
    assert np.linalg.norm(left - pos[:, hand], axis=1).max() < 0.25
    assert pos[0, 0, 1] == pytest.approx(course.PLAYER_Y, abs=0.3)
    for side in "LR":
        toe = pos[:, body.link_index(f"{side}_Toe")]
        assert np.ptp(toe, axis=0).max() < 1e-3


def test_it_is_certified_and_says_what_it_achieved(stroke, certificate):
    assert certificate.passed, certificate.failures
    values = {c.name: c.value for c in certificate.checks}
    for engine in ("mujoco", "drake"):
        head = f"replay in {engine}: "
        assert certificate.achieved[f"replay_{engine}"] == pytest.approx(9.0, rel=0.1)
        # The engine's own ball on its tee, struck with the blow felt, against the law by itself.
        for name, off in (("launch speed", 0.05), ("carry", 0.15)):
            planned = values[f"planned {name}"]
            assert values[f"{head}ball: {name}"] == pytest.approx(planned, rel=off), name
    clip = strike_clip(stroke, certificate)
    assert clip.meta["achieved"]["club_speed"] == pytest.approx(
        certificate.achieved["replay_mujoco"], abs=1e-5
    )
    assert clip.meta["achieved"]["loft"] == pytest.approx(11.0, abs=3.0)
    assert name_of(stroke) == "golf_9mps_human"


def test_a_swing_of_20_mps_is_certified_and_the_club_passes_before_the_legs(swing):
    """Both replays meet the ball; by MuJoCo's collision routines every 2 ms the club touches
    nothing on its way to the ball."""
    found = certify(swing)
    assert found.passed, found.failures
    for engine in ("mujoco", "drake"):
        assert found.achieved[f"replay_{engine}"] == pytest.approx(20.0, rel=0.1)
    model = build_model(swing.body)
    data = mujoco.MjData(model)
    club = model.body(body_name(0, course.TOOL)).id
    for row in swing.sample(np.arange(0.0, swing.stats["event"]["time"], 0.002))["qpos"]:
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        met = [model.geom_bodyid[c.geom] for c in data.contact]
        assert not any(club in pair for pair in met)


def test_a_spoiled_stroke_is_refused(stroke, monkeypatch):
    """Another speed or loft asked, a head in the turf, no replay: each fails by its own check."""
    monkeypatch.setattr("warmstart.certificate._replay", lambda *_: {})
    event = dict(stroke.stats["event"])
    a = math.radians(20.0)
    lofted = event | {"normal": [math.cos(a), 0.0, math.sin(a)]}
    faster = event | {"velocity": [1.2 * v for v in event["velocity"]]}
    sunk = stroke.qpos - np.eye(stroke.qpos.shape[1])[2] * 0.03
    for found, words in (
        (replace(stroke, stats=stroke.stats | {"event": faster}), "planned speed off"),
        (replace(stroke, stats=stroke.stats | {"event": lofted}), "planned loft off"),
        (replace(stroke, qpos=sunk), "planned head over the ground"),
    ):
        failures = certify(found).failures
        assert any(f.startswith(words) for f in failures)
        assert any("replay in drake: head over the ground" in f for f in failures)
    assert "replay in mujoco: ball: launch speed off" in required("golf")
    assert RULES["golf"].unit == get_problem("golf").unit


def test_a_ball_met_beside_the_middle_of_the_face_is_seen(stroke):
    """The same swing five centimetres beside the ball, in MuJoCo. The law by itself, which does not
    know where the face ends, would say nothing."""
    true = tee_shot.played(stroke, "mujoco")
    assert true["ball: launch speed off"] < 0.05 and true["head over the ground"] > 0.0
    past = tee_shot.played(striker.placed(stroke, y=0.05), "mujoco")
    assert past["ball: launch speed off"] > 0.10


# The optimiser itself, on a coarse grid.


def test_a_coarse_stroke_from_nothing_and_a_neighbour_from_it():
    solution = golf.solve(golf.Config(club_speed=7.0, loft=8.0, detail=0.4))
    print(jumper.shown(solution))
    assert solution.stats["max_violation"] < 1e-5
    assert [name for name, *_ in solution.phases] == ["back", "swing", "follow"]
    event = solution.stats["event"]
    assert math.degrees(math.asin(event["normal"][2])) == pytest.approx(8.0)
    faster = golf.solve(golf.Config(club_speed=8.0, loft=8.0, detail=0.4), guess=solution)
    assert np.linalg.norm(faster.stats["event"]["velocity"]) == pytest.approx(8.0)
    assert faster.stats["objective"] > solution.stats["objective"]


def test_impossible_options_are_one_sentence():
    for options, words in (
        ({"club_speed": 99.0}, "club_speed must lie between"),
        ({"loft": 30.0}, "the head would meet the ground"),
        ({"loft": -1.0}, "loft must lie"),
        ({"attack": 40.0}, "attack must lie"),
        ({"detail": 9.0}, "detail must lie"),
        ({"max_iterations": 0}, "max_iterations must be"),
    ):
        with pytest.raises(ValueError, match=words):
            golf.Config(**options)


def test_the_steepest_loft_keeps_the_head_off_the_ground(body):
    """The box tilted about the contact, its shaft at the flattest and steepest a club is held."""
    config = golf.Config(loft=golf.LOFTS[1])
    event = golf.make_event(config, body)
    normal, corners = np.array(event.normal), tee_shot.head_corners(body)
    for lie in np.radians((30.0, 45.0, 60.0)):
        shaft = np.array([-math.cos(lie), 0.0, math.sin(lie)])
        y = shaft - (shaft @ normal) * normal
        y /= np.linalg.norm(y)
        turn = np.stack([normal, y, np.cross(normal, y)], 1)
        heights = event.place[2] + ((corners - np.array(event.point)) @ turn.T)[:, 2]
        assert heights.min() > golf.MARGIN - 1e-3
